"""What an identification says of the trials beside its fit, which is left out here."""

from dataclasses import dataclass

import nonlinear_trials as made
import pytest

import armperturb as ap
from armperturb.analysis.nonlinear import identify
from armperturb.cohort import average_person

PERSON = average_person().subjects["RT"]


@pytest.fixture(autouse=True, scope="module")
def compiled(once):
    once("compiled arms", made.compile_arms)


@pytest.fixture(scope="module")
def recording(once):
    return once("trial of a relaxed person", lambda _: made.record(PERSON, [made.push(0, 1.5, top=20.0)]))


@dataclass(frozen=True)
class Fitted:
    """What stands for a fit."""

    remarks: tuple[str, ...] = ()


@pytest.fixture(autouse=True)
def unfitted(monkeypatch):
    monkeypatch.setattr(identify, "linear_arms", lambda sets, **_: dict.fromkeys(sets, PERSON))
    monkeypatch.setattr(identify, "fit", lambda *_, **__: Fitted())


def test_what_is_wrong_with_the_force_is_a_remark(recording):
    assert ap.identify_nonlinear(recording).estimate.remarks == ()
    large = recording.assign(force=1.1 * recording["force"])
    (remark,) = ap.identify_nonlinear(large).estimate.remarks
    assert remark.startswith("RT7.5: force appears to be ")
    assert "10 % too large" in remark
