"""The page of a muscle law that was identified: the same skeleton, style and sections where they apply."""

from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from armperturb.analysis.nonlinear.identify import NonlinearIdentification
from armperturb.analysis.page import figures
from armperturb.analysis.page.data_check import check_data
from armperturb.analysis.page.page import WORDS, Origin, parameter_rows
from armperturb.analysis.page.verdict import Verdict
from armperturb.analysis.results import plain
from armperturb.analysis.trials import ConditionTrials
from armperturb.files import write_whole
from armperturb.pages.page import Picture, rendered, versions
from armperturb.plots.style import new_figure

UNLIKELY = 0.01
"""Probability of a lack of fit as large as that found, below which the law does not explain a condition [-]."""


def write_nonlinear_page(
    result: NonlinearIdentification, trials: Mapping[str, Sequence[ConditionTrials]], path: str | Path, origin: Origin
) -> None:
    """Write the page, one HTML file that needs no other and no network.

    Args:
      result: of `identify_nonlinear`.
      trials: condition to its trials, those of one length together.
      path: of the page.
      origin: where the result comes from.

    Raises:
      OSError: the folder cannot be written to.
    """
    estimate = result.estimate
    drawn = new_figure(1.0)
    estimate.plot(drawn)
    pictures = {
        "parameters": Picture.of(drawn),
        **{f"traces_{k}": figures.traces(parts[0]) for k, parts in enumerate(trials.values())},
    }
    if result.pulses["nonlinear"]:
        of_pulses = new_figure(1.0)
        result.plot(of_pulses)
        pictures["pulses"] = Picture.of(of_pulses)
    said = [*result.model_facts(), *estimate.remarks]
    sections: dict[str, dict[str, Any]] = {
        "parameters": {"rows": parameter_rows({"": estimate}, estimate.unit_of), "triples": False, "conditions": [""]},
        "pulses": {},
        "data": {
            "checks": {label: check_data(parts, origin.window_start, origin.period) for label, parts in trials.items()},
            "notes": origin.notes,
        },
        "traces": {},
        "remarks": {"remarks": said, "causes": {}, "nonlinear": {}},
        "method": {"origin": origin, "licence": metadata.metadata("armperturb")["License-Expression"]},
    }
    content = rendered(
        __package__,
        "nonlinear.html",
        {name: values for name, values in sections.items() if name != "pulses" or "pulses" in pictures},
        WORDS["sections"],
        pictures,
        conditions=list(trials),
        description=result.describe(),
        person=next(iter(estimate.parameters.bodies.values())).name,
        verdicts={"": nonlinear_verdict(result)},
        words=WORDS,
        plain=plain,
        versions=versions("armperturb", "numpy", "scipy", "numba", "matplotlib"),
    )
    write_whole(path, content)


def nonlinear_verdict(result: NonlinearIdentification) -> Verdict:
    """Whether to trust the parameters of a muscle law."""
    estimate = result.estimate
    if not estimate.converged:
        return Verdict("care", f"The search did not settle: {estimate.message}.")
    left = [label for label, test in estimate.lack_of_fit.items() if test.p_value < UNLIKELY]
    if left:
        return Verdict(
            "care",
            f"In {', '.join(left)} the perturbation explains part of what the {estimate.model.law} law leaves "
            f"(p below {UNLIKELY:g}): the law is not the whole truth there.",
        )
    return Verdict("trust", f"The {estimate.model.law} law leaves nothing that the perturbation explains.")
