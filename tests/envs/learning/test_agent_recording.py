"""Recordings of agents."""

import numpy as np
import pytest

import armperturb as ap

NAME = "ArmPerturb/Position-v1"
PERSON = ap.average_person().subjects["PT"]


def own(observations):
    return np.tile([1.0] * 9 + [0.0] * 2, (len(observations), 1))


def trial(duration=0.6, peak=20.0, subject=PERSON, seed=0):
    pulse = ap.Pulse(peak=peak, direction_deg=20.0, onset=0.1, duration=duration)
    return ap.Trial(subject=subject, perturbation=pulse, noise=ap.HUMAN_NOISE["PT"], seed=seed)


@pytest.mark.parametrize("engine", ["mujoco", "compiled"])
def test_with_the_own_action_it_is_the_experiments_to_the_last_bit(engine):
    trials, instruments = [trial(), trial(seed=1)], ap.Instruments(emg=None)
    recording = ap.record_agent(NAME, own, trials, engine=engine, instruments=instruments)
    assert recording.identical(ap.run_experiment(trials, engine=engine, instruments=instruments))


def test_an_agent_changes_what_is_recorded():
    relaxed = ap.record_agent(NAME, lambda seen: np.zeros((len(seen), 11)), [trial()], engine="compiled")
    held = ap.record_agent(NAME, own, [trial()], engine="compiled")
    assert np.abs(relaxed["displacement"].values).max() > 2.0 * np.abs(held["displacement"].values).max()
    np.testing.assert_array_equal(relaxed["perturbation"].values, held["perturbation"].values)


def test_it_tells_when_the_handle_reached_the_limit():
    trials = [trial(peak=3000.0), trial()]
    recording = ap.record_agent(NAME, own, trials, engine="compiled")
    expected = ap.run_experiment(trials, engine="compiled")
    assert recording["limit_time"].values[0] > 0.1
    np.testing.assert_array_equal(recording["limit_time"].values, expected["limit_time"].values)


@pytest.mark.parametrize(
    ("name", "trials", "more", "message"),
    [
        ("CartPole-v1", [trial()], {}, "name = 'CartPole-v1'; expected one of"),
        (NAME, [], {}, r"trials = \(\); expected at least one trial"),
        (NAME, [trial(0.6), trial(0.8)], {}, "trials of 0.6 to 0.8 s; expected one duration"),
        (NAME, [trial()], {"instruments": ap.Instruments()}, r"expected Instruments\(emg=None\)"),
        ("ArmPerturb/Relax-v1", [trial()], {}, "^record_agent: trial has the task PT; expected RT"),
        (NAME, [trial()], {"rate": 300.0}, "^record_agent: rate = 300.0 Hz; expected the simulation's 400 Hz over"),
        (NAME, [trial()], {"rate": 100.0, "instruments": ap.Instruments(emg=None)}, "antialias = 80"),
        (NAME, [trial()], {"rate": 1000.0}, r"\(the option timestep = 0\.001 goes with this rate\)"),
    ],
)
def test_what_cannot_be_recorded_is_refused(name, trials, more, message):
    def never(_):
        raise AssertionError("refused only after it was asked")

    with pytest.raises(ValueError, match=message):
        ap.record_agent(name, never, trials, **more)
