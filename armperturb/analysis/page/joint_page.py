"""The page of an identification, for a joint: the same skeleton, style and sections where they apply."""

from importlib import metadata
from pathlib import Path

from armperturb.analysis.fit.maximum_likelihood import LARGE_LACK, SUSPICIOUS
from armperturb.analysis.joint.identify import JointIdentification
from armperturb.analysis.page.page import WORDS, Origin, parameter_rows
from armperturb.analysis.page.verdict import Verdict, numbers_of
from armperturb.analysis.results import Description, Table, plain
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
    best = result.tried[0].score
    tried = Description(
        title="Structures tried, the best first",
        table=Table(
            ("structure", "free parameters", "score behind the best"),
            tuple(
                (each.estimate.structure.name, str(len(each.estimate.values)), plain(each.score - best, 4))
                for each in result.tried
            ),
        ),
    )
    content = rendered(
        __package__,
        "joint.html",
        {
            "parameters": {"rows": parameter_rows({label: result}, result.unit_of), "triples": False},
            "joint_prediction": {},
            "remarks": {"remarks": [result.sentence, *result.remarks, *origin.notes], "causes": {}, "nonlinear": {}},
            "structures": {"choices": {label: tried}},
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
    """Whether to trust the parameters of a joint.

    What the structure lacks is judged by what a free model predicts beyond it and by its lack of fit; on a force servo,
    where there is no free model, by the lack of fit alone.
    """
    if not result.converged:
        return Verdict("care", "Noise and parameters did not settle together.")
    lack = result.lack_of_fit
    lacking = (
        f"A linear response to the servo's input explains more than the parallel cascade does ({numbers_of(lack)})"
        if lack.p_value < SUSPICIOUS
        else ""
    )
    if result.free_model is None:
        if not lacking:
            return Verdict(
                "trust", f"The cascade explains the movement as far as the noise shows ({numbers_of(lack)})."
            )
        if lack.chi2 <= LARGE_LACK * lack.dof:
            return Verdict("care", f"{lacking}: intervals are too short.")
        return Verdict("reject", f"{lacking}: the structure is wrong.")
    ahead = result.free_model.left_out_vaf - result.vaf["total"]
    text = (
        f"The parallel cascade accounts for {result.vaf['total']:.1f} % of the torque's variance, a free model for "
        f"{result.free_model.left_out_vaf:.1f} % of it on left-out data."
    )
    if ahead > CARE:
        return Verdict("reject", text)
    if lacking:
        return Verdict("care", f"{text} {lacking}: intervals are too short.")
    return Verdict("trust" if ahead <= TRUSTED else "care", text)
