"""The page of an identification, for a joint: the same skeleton, style and sections where they apply."""

from importlib import metadata
from pathlib import Path

from armperturb.analysis.fit.maximum_likelihood import LARGE_LACK, SUSPICIOUS
from armperturb.analysis.joint.identify import JointIdentification
from armperturb.analysis.joint.remarks import cut_short, outweighed, ruled_out
from armperturb.analysis.page.page import WORDS, Origin, parameter_rows
from armperturb.analysis.page.verdict import Verdict, numbers_of
from armperturb.analysis.results import Description, Table, plain
from armperturb.files import write_whole
from armperturb.pages.page import Picture, rendered, versions
from armperturb.plots.parameters import plot_parameters
from armperturb.plots.style import new_figure

TRUSTED, CARE = 2.0, 10.0
"""VAF by which a free model may be ahead of the cascade, to trust its parameters, or to use them with care [%]."""

LARGE_LACKS = {"force": LARGE_LACK, "position": 6.0}
"""Servo to the lack of fit over its degrees of freedom from which on parameters are not to be trusted [-].

Ankles of people on a position servo lack 4 to 5 where a free model is less than 10 % ahead; a torque that is 5 ms late,
which takes two thirds of the inertia, lacks 11.
"""

LARGE_SPREAD = 0.2
"""Standard deviation over parts of the record, over a parameter, from which on it is not to be trusted [-]."""

CAUSES = {
    "force": "Causes to look for: signals that are late to each other or pass different filters; a joint that does "
    "more than the cascade has",
    "position": "Causes to look for: torque and angle that are late to each other or pass different filters; noise of "
    "the angle (where the movement ends well below 30 Hz, convert --rate 100 leaves most of it out); a joint that does "
    "more than the cascade has",
}
"""Servo to why a structure may lack fit."""


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
    verdict = joint_verdict(result)
    parameters, drawn = new_figure(1.0), new_figure(1.0)
    plot_parameters({label: result.to_frame()}, parameters)
    result.plot(drawn)
    best = result.tried[0].score
    said = [
        *filter(None, [result.sentence, result.differing]),
        *(each for each in result.remarks if _sentence(each) not in verdict.text),
        *origin.notes,
    ]
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
            "remarks": {"remarks": said, "causes": {}, "nonlinear": {}},
            "structures": {"choices": {label: tried}},
            "method": {"origin": origin, "licence": metadata.metadata("armperturb")["License-Expression"]},
        },
        WORDS["sections"],
        {"parameters": Picture.of(parameters), "joint": Picture.of(drawn)},
        conditions=[label],
        result=result,
        verdicts={label: verdict},
        words=WORDS,
        plain=plain,
        versions=versions("armperturb", "numpy", "scipy", "matplotlib"),
    )
    write_whole(path, content)


def joint_verdict(result: JointIdentification) -> Verdict:
    """Whether to trust the parameters of a joint.

    What the structure lacks is judged by what a free model predicts beyond it and by its lack of fit; on a force servo,
    where there is no free model, by the lack of fit alone. Parts of the record must tell of the same joint. What rules
    parameters out is looked for first, whatever else there is to say.
    """
    lack, vaf = result.lack_of_fit, result.vaf["total"]
    ahead, explained, resisting = 0.0, "", "torque" if result.angular else "force"
    if result.free_model is not None:
        ahead = result.free_model.left_out_vaf - vaf
        explained = (
            f"The parallel cascade accounts for {vaf:.1f} % of the {resisting}'s variance, a free model for "
            f"{result.free_model.left_out_vaf:.1f} % of it on left-out data."
        )
    lacking = ""
    if lack.p_value < SUSPICIOUS:
        lacking = (
            "A linear response to the servo's input explains more than the parallel cascade does "
            f"({numbers_of(lack)}): estimates may be biased by more than their intervals say. {CAUSES[result.servo]}."
        )
    unsettled = "" if result.converged else "Noise and parameters did not settle together."
    further = [
        _sentence(each)
        for each in (
            result.parts.sentence,
            cut_short(result.structure.reflex, result.top, result.beyond),
            outweighed(result),
        )
        if each
    ]
    impossible = [_sentence(each) for each in (*result.faults, *ruled_out(result))]
    is_wrong = ahead > CARE or (lacking and lack.chi2 > LARGE_LACKS[result.servo] * lack.dof)
    if impossible or is_wrong or result.parts.largest >= LARGE_SPREAD:
        return Verdict("reject", _sentences(*impossible, explained, lacking, unsettled, *further))
    if unsettled or lacking or ahead > TRUSTED or further:
        return Verdict("care", _sentences(unsettled, explained, lacking, *further))
    fits = f"The cascade explains the movement as far as the noise shows ({numbers_of(lack)})."
    return Verdict("trust", explained or fits)


def _sentence(remark: str) -> str:
    return f"{remark[0].upper()}{remark[1:]}."


def _sentences(*texts: str) -> str:
    return " ".join(text for text in texts if text)
