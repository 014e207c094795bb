"""What an identification says of the trials beside its fit, which is left out here."""

import re
from dataclasses import dataclass

import nonlinear_trials as made
import numpy as np
import pytest

import armperturb as ap
from armperturb.analysis.nonlinear import identify
from armperturb.analysis.trials import ConditionTrials
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

    def subject(self, task, condition):
        return PERSON


@pytest.fixture(autouse=True)
def models(monkeypatch):
    """The structures that would have been fitted."""
    asked = []

    def fit(_, __, model, **___):
        asked.append(model)
        return Fitted()

    monkeypatch.setattr(identify, "linear_arms", lambda sets, **_: dict.fromkeys(sets, PERSON))
    monkeypatch.setattr(identify, "fit", fit)
    return asked


@pytest.mark.slow(reason="starts a nonlinear fit")
def test_what_is_wrong_with_the_force_is_a_remark(recording):
    assert ap.identify_nonlinear(recording).estimate.remarks == ()
    large = recording.assign(force=1.1 * recording["force"])
    (remark,) = ap.identify_nonlinear(large).estimate.remarks
    assert remark.startswith("RT7.5: force appears to be ")
    assert "10 % too large" in remark


def test_a_start_amid_the_movement_is_a_remark(recording):
    late = recording.isel(time=slice(300, None)).drop_vars("joint_angle")
    late = late.assign_coords(time=recording["time"].values[: late.sizes["time"]])
    late["displacement"] = late["displacement"] - late["displacement"].isel(time=0)
    (remark,) = ap.identify_nonlinear(late).estimate.remarks
    assert remark.startswith("RT7.5: trials start amid the movement, though the law has them start from rest ")


def test_a_constant_force_is_left_out_and_named(recording):
    held = recording.drop_vars("joint_angle")
    held = held.assign({name: held[name] + [10.0, -15.0] for name in ("perturbation", "force")})
    _, remark = ap.identify_nonlinear(held).estimate.remarks
    assert re.match(r"RT7.5: a constant force on the hand, x 10\.\d and y -15\.\d N, is left out: ", remark)
    without, plain = (ConditionTrials.prepare(each).drive for each in (held, recording))
    np.testing.assert_allclose(without - without.mean(axis=1), plain - plain.mean(axis=1), atol=1e-9)
    assert np.abs(without.mean(axis=1)).max() < 1e-9


def test_what_is_assumed_of_reflexes_is_a_remark_and_can_be_free(recording, models):
    position = recording.assign_coords(task=("trial", ["PT"]))
    (remark,) = ap.identify_nonlinear(position).estimate.remarks
    assert remark.startswith("reflexes are assumed to have a delay of 30 ms and a cut-off of 3.5 Hz; ")
    assert remark.endswith("(--free Td fact estimates them)")
    (remark,) = ap.identify_nonlinear(position, free=["Td"]).estimate.remarks
    assert remark.startswith("reflexes are assumed to have a cut-off of 3.5 Hz; ")
    assert remark.endswith("(--free fact estimates it)")
    assert ap.identify_nonlinear(position, free=["fact", "Td"]).estimate.remarks == ()
    assert [model.free for model in models] == [(), ("Td",), ("Td", "fact")]


@pytest.mark.parametrize(
    ("law", "free", "message"),
    [
        ("full", ["k_h"], "free: 'k_h'; expected some of Td, fact, as all else is free or off"),
        ("full", ["Td"], "free: 'Td' is no parameter of the law 'full' in these trials"),
        (
            "choose",
            ["Td"],
            r"law = 'choose' with free = \('Td',\); expected a law \(e.g. --law full\), or nothing free",
        ),
    ],
)
def test_what_cannot_be_free_is_refused_before_anything_is_fitted(recording, monkeypatch, law, free, message):
    monkeypatch.setattr(identify, "linear_arms", lambda *_, **__: pytest.fail("fitted before"))
    with pytest.raises(ValueError, match=message):
        ap.identify_nonlinear(recording, law, free=free)


@pytest.mark.slow(reason="starts a nonlinear fit")
def test_left_out_pulses_whose_end_is_not_recorded_are_a_remark(recording):
    onset = float(recording["time"][-1]) - 1.4
    pulsed = recording.assign_coords(
        pulse_onset=("trial", [onset]), pulse_level=("trial", [1.0]), pulse_direction=("trial", [20.0])
    )
    (remark,) = [line for line in ap.identify_nonlinear(pulsed).estimate.remarks if "left-out pulses" in line]
    assert remark.startswith("1 of 1 left-out pulses are not predicted, as the record ends too early")
    assert "1.5 s in RT after the onset" in remark
