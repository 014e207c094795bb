"""Joints that change within their trials."""

import numpy as np
import one_joint
import pytest

from armperturb.analysis.joint.estimate import estimate_joint
from armperturb.analysis.joint.likelihood import environment_of
from armperturb.analysis.joint.model import JointStructure
from armperturb.analysis.joint.part_differences import part_differences
from armperturb.analysis.joint.signals import joint_signals

JOINT = one_joint.person("ankle", 11, "none")


def differences(recording, joint=JOINT):
    signals = joint_signals(recording)
    loop = environment_of(signals) if signals.servo == "force" else None
    return part_differences(
        estimate_joint(JointStructure(reflex=joint.reflex, side=joint.side), signals, loop), signals, loop
    )


def stiffer(recording, factors):
    """The same with a stiffness that is that of the joint times factors, (trial, time)."""
    angle = recording["displacement"]
    torque = recording["force"].values + JOINT.stiffness * (factors[..., None] - 1.0) * angle.values
    return recording.assign(force=recording["force"].copy(data=torque))


@pytest.fixture(scope="module")
def record():
    return one_joint.recording(JOINT, 11, duration=20.0)


def test_a_joint_that_becomes_stiffer_says_when(record):
    later = record["time"].values > 12.0
    found = differences(stiffer(record, np.where(later, 1.5, 1.0)[None]))
    assert found.spread.keys() == {"stiffness"}
    assert 0.15 < found.spread["stiffness"] < 0.25
    assert found.at == pytest.approx(12.0, abs=0.6)
    assert found.before["stiffness"] == pytest.approx(JOINT.stiffness, rel=0.05)
    assert found.after["stiffness"] == pytest.approx(1.5 * JOINT.stiffness, rel=0.05)
    assert found.sentence.startswith("parts of the record differ by more than noise (SD over 8 parts: stiffness ")


def test_a_torque_that_dies_away_shows_in_all_parameters(record):
    torque = record["force"].where(record["time"] < 14.0, 0.0)
    found = differences(record.assign(force=torque.assign_attrs(record["force"].attrs)))
    assert found.spread.keys() == {"inertia", "damping", "stiffness"}
    assert found.at == pytest.approx(14.0, abs=0.6)
    assert abs(found.after["inertia"]) < 0.1 * JOINT.inertia


@pytest.mark.slow(reason="fits five trials four times")
def test_parts_of_a_single_trial_or_of_all_trials():
    trials = one_joint.trials(JOINT, 3, 0.08, duration=8.0)
    assert not differences(trials).spread  # trials differ, parts of them do not
    later, number = trials["time"].values > 5.0, np.arange(5)[:, None]
    assert differences(stiffer(trials, np.where(later, 1.5, np.ones((5, 1))))).where == "all trials"
    dying = trials["force"].values * np.where(later & (number == 2), 0.0, 1.0)[..., None]
    single = differences(trials.assign(force=trials["force"].copy(data=dying)))
    assert single.where == "trial 2"
    assert single.at == pytest.approx(5.0, abs=0.6)
    few = trials.isel(time=slice(0, 4000))
    assert not differences(few).spread


@pytest.mark.slow(reason="fits records with bursts of torque, and closed loops")
@pytest.mark.parametrize("servo", ["position", "force"])
def test_torque_of_the_person_makes_no_difference(servo):
    for seed in range(3):
        joint = one_joint.person("ankle", seed, "linear")
        recording = one_joint.recording(joint, seed, servo, duration=20.0)
        if servo == "position":
            bursts = one_joint.coloured(np.random.default_rng(seed), 20000, 0.2, 1.0)
            bursts *= np.where(recording["time"].values % 7.0 < 2.0, 3.0, 0.0) * 0.1 * recording["force"].values.std()
            recording = recording.assign(force=recording["force"] + bursts[:, None])
            recording["force"].attrs["units"] = "Nm"
        assert not differences(recording, joint).spread
