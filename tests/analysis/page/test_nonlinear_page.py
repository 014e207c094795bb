"""Whether the page of a nonlinear fit says to trust its parameters."""

from types import SimpleNamespace

import pytest

from armperturb.analysis.fit.whittle import LackOfFit
from armperturb.analysis.imbalance import Imbalance
from armperturb.analysis.page.nonlinear_page import nonlinear_verdict

GAIN = Imbalance("gain", "force appears to be 6 % too large", 0.9, 0.06)
LATE = Imbalance("displacement", "displacement is recorded 10 ms later", 0.99, 0.01, 1e-2, 1e-5)


def judged(*imbalances, chi2=100.0, converged=True, error=0.004, spread=0.1):
    estimate = SimpleNamespace(
        converged=converged,
        message="the arm has a limit cycle",
        model=SimpleNamespace(law="full"),
        values={"m_h": 1.8, "k.shoulder": 8.0, "recovery_time": 1.0},
        standard_error={"m_h": 1.0, "k.shoulder": 8.0 * error, "recovery_time": 1e-6},
        spread={("PT", "kv"): 0.1, ("PT", "b"): spread},
        lack_of_fit={"small": LackOfFit(100.0, 100), "large": LackOfFit(chi2, 100)},
    )
    checks = {str(place): SimpleNamespace(imbalance=each) for place, each in enumerate((None, *imbalances))}
    return nonlinear_verdict(SimpleNamespace(estimate=estimate), checks)


@pytest.mark.parametrize(
    ("changes", "level", "text"),
    [
        ({}, "trust", "The full law leaves nothing that the perturbation explains."),
        (
            {"chi2": 150.0},
            "care",
            "In large the perturbation explains part of what the full law leaves (in large: lack ",
        ),
        (
            {"chi2": 300.0},
            "reject",
            "over its degrees of freedom 3.00, p < 0.001): the law is wrong, or the signals are",
        ),
        ({"spread": 0.5}, "care", "Trials differ by 50 % or more in b [PT], or the full law is wrong"),
        ({"converged": False}, "reject", "The search did not end at an optimum (the arm has a limit cycle)."),
    ],
)
def test_the_verdict_counts_how_the_search_ended_and_how_large_the_lack_of_fit_is(changes, level, text):
    assert judged(**changes).level == level
    assert text in judged(**changes).text


def test_the_verdict_counts_the_force_balance():
    assert judged(GAIN).level == "reject"
    assert judged(GAIN).text.startswith("Force appears to be 6 % too large, 15 standard errors of the best-known ")
    assert judged(GAIN, error=0.015).level == "care"
    assert judged(GAIN, error=0.1).level == "trust"  # within the intervals
    assert judged(LATE, error=0.1).level == "care"
    assert judged(LATE, GAIN).text.startswith("Force appears")  # the worst of several conditions
    # Where intervals are not valid, an error is not counted in them.
    wrong = judged(LATE, converged=False, error=float("nan"))
    assert wrong.level == "reject"
    assert wrong.text.startswith("Displacement is recorded 10 ms later")
