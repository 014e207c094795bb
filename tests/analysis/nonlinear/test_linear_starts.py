"""Linear arms from which nonlinear fits start, whatever perturbs the trials."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from armperturb.analysis.nonlinear.start import SHORTEST, linear_arms
from armperturb.analysis.trials import ConditionTrials
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Pulse, Sampled
from armperturb.subject import POSITION, RELAX

RATE = 400.0


def shaken(seconds, person=POSITION):
    """Two trials of the preset that keeps position, or of somebody else, shaken by noise that never repeats."""
    lowpass = signal.butter(2, 8.0, fs=RATE, output="sos")
    forces = (
        signal.sosfilt(lowpass, 20.0 * np.random.default_rng(seed).standard_normal((round(seconds * RATE), 2)), axis=0)
        for seed in (1, 2)
    )
    trials = [Trial(subject=person, perturbation=Sampled(force=f, rate=RATE), condition="PT7.5") for f in forces]
    trials = [replace(trial, repetition=number) for number, trial in enumerate(trials)]
    instruments = Instruments(marker_noise=None, emg=None)
    return ConditionTrials.prepare(run_experiment(trials, instruments=instruments, engine="compiled"))


@pytest.mark.slow(reason="identifies an arm from noise")
def test_noise_that_does_not_repeat_tells_the_linear_arm_to_start_from():
    arm = linear_arms({"PT7.5": shaken(SHORTEST)})["PT7.5"]
    for name in ("k_s", "k_se", "k_e", "kv_s", "kv_se", "kv_e"):
        assert getattr(arm, name) == pytest.approx(getattr(POSITION, name), rel=0.15), name


def test_trials_too_short_to_start_from_are_refused():
    with pytest.raises(
        ValueError, match=r"PT: all pulses or ends come before 10 s; expected a trial .* or 10 s of noise"
    ):
        linear_arms({"PT7.5": shaken(9.0)})


@pytest.mark.slow(reason="starts a nonlinear fit")
def test_pulses_that_are_not_labelled_tell_the_linear_arm_to_start_from():
    pulses = [Pulse(peak=10.0, direction_deg=deg, onset=2.0, duration=6.0).sample(RATE, 2400) for deg in (20.0, 110.0)]
    trials = [
        Trial(subject=RELAX, perturbation=Sampled(force=d, rate=RATE), condition="RT0", repetition=number)
        for number, d in enumerate(pulses)
    ]
    arm = linear_arms({"RT0": ConditionTrials.prepare(run_experiment(trials, engine="compiled"))})["RT0"]
    for name in ("k_s", "k_e", "b_s", "b_e"):
        assert getattr(arm, name) == pytest.approx(getattr(RELAX, name), rel=0.15), name


@pytest.mark.slow(reason="identifies an arm from noise twice")
def test_an_arm_whose_grip_is_not_the_usual_one_starts_near_itself():
    springs = {"k_s": 40.0, "k_se": 15.0, "k_e": 32.0, "b_s": 3.0, "b_se": 1.0, "b_e": 2.5}
    gains = {f"{gain}_{joint}": 0.0 for gain in ("kv", "kp") for joint in ("s", "se", "e")}
    other = replace(POSITION, **springs, **gains, k_h=12e3, b_h=150.0)
    arm = linear_arms({"PT7.5": shaken(SHORTEST, other)})["PT7.5"]
    assert arm.k_h == pytest.approx(12e3, rel=0.1)
    # Stiffness and position feedback are hardly told apart by slow movements.
    assert arm.k_s + arm.kp_s == pytest.approx(40.0, rel=0.1)
    assert arm.k_e + arm.kp_e == pytest.approx(32.0, rel=0.1)
