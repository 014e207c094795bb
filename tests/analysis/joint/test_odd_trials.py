"""Trials of which a signal is wrong, among others."""

import numpy as np
import one_joint
import pytest

from armperturb.analysis.cuts import inside_limit
from armperturb.analysis.joint.estimate import estimate_joint
from armperturb.analysis.joint.identify import identify_joint
from armperturb.analysis.joint.likelihood import environment_of
from armperturb.analysis.joint.model import JointStructure
from armperturb.analysis.joint.odd_trials import odd_trials
from armperturb.analysis.joint.signals import joint_signals
from armperturb.analysis.page.joint_page import joint_verdict
from armperturb.copied_trials import without_copies


def with_torque(recording, trial, change):
    """The same with another torque in one trial."""
    torque = recording["force"].values.copy()
    torque[trial] = change(torque[trial])
    return recording.assign(force=recording["force"].copy(data=torque))


def found(recording, reflex="none"):
    signals = joint_signals(recording)
    loop = environment_of(signals) if signals.servo == "force" else None
    return odd_trials(estimate_joint(JointStructure(reflex=reflex), signals, loop), signals, loop)


@pytest.mark.parametrize(
    "servo", ["position", pytest.param("force", marks=pytest.mark.slow(reason="closed loops of five trials"))]
)
def test_a_trial_of_another_inertia_is_named_and_stiffness_that_differs_is_none(servo):
    joint = one_joint.person("ankle", 4, "none")
    trials = one_joint.trials(joint, 4, 0.15, servo=servo)
    assert not found(trials).inertia
    odd = found(with_torque(trials, 1, lambda torque: 1.4 * torque))
    assert odd.inertia == {1: pytest.approx(1.4 * joint.inertia, rel=0.05)}
    assert odd.others == pytest.approx(joint.inertia, rel=0.03)


def test_of_two_trials_that_differ_either_may_be_wrong():
    trials = one_joint.trials(one_joint.person("ankle", 5, "none"), 5, 0.0, n_trials=2)
    assert not found(trials).sentence(angular=True)
    late = found(with_torque(trials, 0, lambda torque: np.roll(torque, 12, axis=0)))
    assert (set(late.inertia), late.others) == ({0, 1}, None)
    assert "movement of one of them is late" in late.sentence(angular=True)


@pytest.mark.slow(reason="identifies three trials with four structures")
def test_a_torque_that_is_lost_in_a_trial_is_named_and_its_half_wave_is_none():
    joint = one_joint.person("ankle", 6, "linear")
    lost = with_torque(one_joint.trials(joint, 6, 0.0, n_trials=3), 2, lambda torque: 0.0 * torque)
    result = identify_joint(lost)
    constant, odd = result.faults
    assert constant == "force is constant in trial 2 (at 0); leave such trials out"
    assert odd.startswith("trials differ in inertia by more than noise (0 kg m^2 in trial 2 against 0.0")
    assert set(result.faults) < set(result.remarks)
    assert joint_verdict(result).level == "reject"
    assert "reflex_threshold" not in result.at_bound


def test_a_torque_that_is_clipped_is_named_with_its_trials():
    trials = one_joint.trials(one_joint.person("ankle", 7, "none"), 7, 0.0, n_trials=3)
    limit = 1.5 * float(trials["force"].std())
    middle = float(trials["force"].mean())
    clipped = with_torque(trials, 0, lambda torque: np.clip(torque, middle - limit, middle + limit))
    fault, *_ = identify_joint(clipped, reflex="none").faults
    assert fault.startswith("force is clipped in trial 0 (at ")


def test_trials_keep_their_numbers_where_others_are_left_out():
    trials = one_joint.trials(one_joint.person("ankle", 8, "none"), 8, 0.0, n_trials=4)
    limit = ("trial", [5.0, np.nan, np.nan, np.nan])
    louder = with_torque(trials, 2, lambda torque: 1.4 * torque).assign_coords(limit_time=limit)
    (inside,), _ = inside_limit([without_copies(louder)])
    assert inside["trial"].values.tolist() == [1, 2, 3]
    (fault,) = identify_joint(louder, reflex="none").faults
    assert "kg m^2 in trial 2 against" in fault


@pytest.mark.slow(reason="closed loops of three trials")
def test_a_trial_without_perturbation_is_no_odd_one():
    trials = one_joint.trials(one_joint.person("ankle", 9, "none"), 9, 0.0, servo="force", n_trials=3)
    rest = trials["perturbation"].values.copy()
    rest[1] = 0.0
    noise = 1e-4 * np.random.default_rng(0).normal(size=rest[1].shape)
    angle, torque = (trials[name].values.copy() for name in ("displacement", "force"))
    angle[1], torque[1] = noise, 1e-2 * noise
    signals = {"perturbation": rest, "displacement": angle, "force": torque}
    at_rest = trials.assign({name: trials[name].copy(data=values) for name, values in signals.items()})
    result = identify_joint(at_rest, reflex="none")
    assert not result.faults
    assert not result.parts.spread


def test_an_angle_that_is_held_in_a_trial_is_named_and_tells_nothing():
    trials = one_joint.trials(one_joint.person("ankle", 10, "none"), 10, 0.0, n_trials=3)
    held = trials["displacement"].values.copy()
    held[2] = 0.05
    result = identify_joint(trials.assign(displacement=trials["displacement"].copy(data=held)), reflex="none")
    assert result.faults == ("displacement is constant in trial 2 (at 0.05); leave such trials out",)
    assert not result.parts.spread
