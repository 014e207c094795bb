"""The page of an identification, for a joint: the same skeleton, style and sections where they apply."""

from importlib import metadata
from pathlib import Path

from armperturb.analysis.joint.identify import JointIdentification
from armperturb.analysis.page.page import WORDS, Origin
from armperturb.analysis.page.verdict import Verdict
from armperturb.analysis.results import plain
from armperturb.files import write_whole
from armperturb.pages.page import Picture, rendered, versions
from armperturb.plots.parameters import plot_parameters
from armperturb.plots.style import new_figure

TRUSTED, CARE = 2.0, 10.0
"""VAF by which a free model may be ahead of the cascade, to trust its parameters, or to use them with care [%]."""


def write_joint_page(result: JointIdentification, path: str | Path, origin: Origin) -> None:
    """Write the page, one HTML file that needs no other and no network.

    Args:
      result: of `identify_joint`.
      path: of the page.
      origin: where the result comes from.

    Raises:
      OSError: the folder cannot be written to.
    """
    label = result.condition
    verdicts = {label: joint_verdict(result)}
    parameters, drawn = new_figure(1.0), new_figure(1.0)
    plot_parameters({label: result.to_frame()}, parameters)
    result.plot(drawn)
    rows = []
    for name, value in result.values.items():
        lower, upper = result.interval(name)
        interval = f"{plain(lower, 3)} to {plain(upper, 3)}" if lower == lower else "not known (at bound)"
        unit = result.unit_of(name)
        rows.append({"name": name, "unit": unit, "cells": [(plain(value, 4), interval)]})
    best = result.tried[0].score
    tried = [
        (each.estimate.structure.name, str(len(each.estimate.values)), plain(each.score - best, 4))
        for each in result.tried
    ]
    content = rendered(
        __package__,
        "joint.html",
        {
            "joint_parameters": {"rows": rows},
            "joint_prediction": {},
            "remarks": {"remarks": [result.sentence, *result.remarks, *origin.notes], "causes": {}, "nonlinear": {}},
            "joint_structures": {"tried": tried},
            "method": {"origin": origin, "licence": metadata.metadata("armperturb")["License-Expression"]},
        },
        WORDS["sections"],
        {"parameters": Picture.of(parameters), "joint": Picture.of(drawn)},
        conditions=[label],
        result=result,
        verdicts=verdicts,
        words=WORDS,
        plain=plain,
        versions=versions("armperturb", "numpy", "scipy", "matplotlib"),
    )
    write_whole(path, content)


def joint_verdict(result: JointIdentification) -> Verdict:
    """Whether to trust the parameters of a joint."""
    if not result.converged:
        return Verdict("care", "Noise and parameters did not settle together.")
    if result.free_model is None:
        return Verdict(
            "trust", "The parallel cascade explains the movement; no free model is compared on a force servo."
        )
    ahead = result.free_model.left_out_vaf - result.vaf["total"]
    text = (
        f"The parallel cascade accounts for {result.vaf['total']:.1f} % of the torque's variance, a free model for "
        f"{result.free_model.left_out_vaf:.1f} % of it on left-out data."
    )
    return Verdict("trust" if ahead <= TRUSTED else "care" if ahead <= CARE else "reject", text)
