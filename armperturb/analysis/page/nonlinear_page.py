"""The page of a muscle law that was identified: the same skeleton, style and sections where they apply."""

from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from armperturb.analysis.fit.maximum_likelihood import LARGE_LACK, SUSPICIOUS
from armperturb.analysis.nonlinear.identify import NonlinearIdentification
from armperturb.analysis.nonlinear.result import NonlinearEstimate
from armperturb.analysis.nonlinear.search import MOST_SPREAD
from armperturb.analysis.page import figures
from armperturb.analysis.page.data_check import DataCheck, check_data
from armperturb.analysis.page.page import WORDS, Origin, parameter_rows
from armperturb.analysis.page.verdict import Verdict, numbers_of, with_imbalance
from armperturb.analysis.results import plain
from armperturb.analysis.trials import ConditionTrials
from armperturb.files import write_whole
from armperturb.pages.page import Picture, rendered, versions
from armperturb.plots.style import new_figure

SEVERITY = ("trust", "care", "reject")
"""Levels of a verdict, the most severe last."""


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
    checks = {label: check_data(parts, origin.window_start, origin.period) for label, parts in trials.items()}
    sections: dict[str, dict[str, Any]] = {
        "parameters": {"rows": parameter_rows({"": estimate}, estimate.unit_of), "triples": False, "conditions": [""]},
        "pulses": {"are_fitted": False},
        "data": {"checks": checks, "notes": origin.notes},
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
        verdicts={"": nonlinear_verdict(result, checks)},
        words=WORDS,
        plain=plain,
        versions=versions("armperturb", "numpy", "scipy", "numba", "matplotlib"),
    )
    write_whole(path, content)


def nonlinear_verdict(result: NonlinearIdentification, checks: Mapping[str, DataCheck]) -> Verdict:
    """Whether to trust the parameters of a muscle law.

    Args:
      result: of `identify_nonlinear`.
      checks: condition to the check of its trials.
    """
    of_fit = _of_fit(result.estimate)
    wrong = [check.imbalance for check in checks.values() if check.imbalance is not None]
    worst_first = sorted(wrong, key=lambda imbalance: -imbalance.bias)
    counted = [with_imbalance(of_fit, result.estimate, imbalance) for imbalance in worst_first]
    return max(counted, key=lambda each: SEVERITY.index(each.level), default=of_fit)


def _of_fit(estimate: NonlinearEstimate) -> Verdict:
    """Whether the law explains the movement."""
    law = estimate.model.law
    if not estimate.converged:
        return Verdict("reject", f"The search did not end at an optimum ({estimate.message}).")
    left = {label: test for label, test in estimate.lack_of_fit.items() if test.p_value < SUSPICIOUS}
    apart = [f"{quantity} [{task}]" for (task, quantity), sd in estimate.spread.items() if sd >= MOST_SPREAD]
    if apart and not left:
        return Verdict(
            "care",
            f"Trials differ by {100.0 * MOST_SPREAD:.0f} % or more in {', '.join(apart)}, or the {law} law is wrong, "
            "which intervals do not count.",
        )
    if not left:
        return Verdict("trust", f"The {law} law leaves nothing that the perturbation explains.")
    label, worst = max(left.items(), key=lambda each: each[1].chi2 / each[1].dof)
    explains = (
        f"In {', '.join(left)} the perturbation explains part of what the {law} law leaves (in {label}: "
        f"{numbers_of(worst)})"
    )
    if worst.chi2 > LARGE_LACK * worst.dof:
        return Verdict("reject", f"{explains}: the law is wrong, or the signals are.")
    return Verdict("care", f"{explains}: the law is not the whole truth there, which intervals do not count.")
