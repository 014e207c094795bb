"""Latency of answers to pulses, of EMG that a known delay after a known movement makes."""

import numpy as np
import pytest
from invented_emg import EMG_RATE, noise, recorded

from armperturb.analysis.emg.envelope import envelopes
from armperturb.analysis.emg.onset import onsets
from armperturb.analysis.trials import ConditionTrials

N_TRIALS, N = 8, 8000
DELAY = 0.034
PULSES = np.linspace(1.5, 2.5, N_TRIALS)


def person(seed, gain=0.6, saturation=np.inf, spread=0.0, *, unloads=False):
    """A shoulder that pulses push towards flexion, which stretches the extensor; and may silence the flexor."""
    rng = np.random.default_rng(seed)
    time = np.arange(N) / EMG_RATE
    # A half-sine of force for 80 ms gives a mass a velocity, which a damper takes; and slow, small movement.
    since = np.clip(time - PULSES[:, None], 0.0, None)
    velocity = np.sin(np.pi * np.minimum(since, 0.08) / 0.16) ** 2 * np.exp(-np.maximum(since - 0.08, 0.0) / 0.05)
    velocity += 0.05 * np.sin(2 * np.pi * 1.3 * time + rng.uniform(0, 6, (N_TRIALS, 1)))
    angle = np.cumsum(velocity, axis=1) / EMG_RATE
    seen = velocity / (1.0 + np.abs(velocity) / saturation)
    late = np.array([np.interp(time - DELAY, time, each) for each in seen])
    drive = gain * (1.0 + spread * rng.uniform(-1.0, 1.0, (N_TRIALS, 1))) * late
    both = np.stack([-drive, drive], axis=1)
    amplitude = np.maximum(0.1 + (both if unloads else np.maximum(both, 0.0)), 0.0)
    volts = amplitude * noise((N_TRIALS, 2, N), seed)
    recording = recorded(volts, pulse_onset=PULSES.tolist(), pulse_direction=[20.0] * N_TRIALS)
    joints = np.stack([angle[:, ::10], np.zeros_like(angle[:, ::10])], axis=2)
    rotation = ("trial", "time", "joint"), joints, {"units": "rad"}
    return recording.assign(joint_angle=rotation).assign_coords(joint=["shoulder", "elbow"])


def answers(recording):
    result = onsets([ConditionTrials.prepare(recording)], envelopes(recording))
    return result, result.latencies.set_index("muscle")


@pytest.mark.slow(reason="simulates many responses")
@pytest.mark.parametrize(("saturation", "spread"), [(np.inf, 0.0), (1.0, 0.5)])
def test_latency_is_the_delay_that_was_made(saturation, spread):
    """Also if the size of the answer differs from trial to trial."""
    people = [person(seed, saturation=saturation, spread=spread) for seed in range(4)]
    rows = [answers(each)[1].loc["extensor"] for each in people]
    errors = np.array([row["latency_s"] - DELAY for row in rows])
    assert np.abs(errors.mean()) < 2e-3
    for row, error in zip(rows, errors, strict=True):
        half = (row["upper_95_s"] - row["lower_95_s"]) / 2.0
        assert half < 0.01
        assert abs(error) < 2.0 * half


@pytest.mark.slow(reason="simulates many responses")
def test_shortening_may_silence_muscles_and_is_no_stretch_reflex():
    rows = [answers(person(seed, unloads=True))[1] for seed in range(4)]
    for each in rows:
        assert each.loc["flexor", "p"] < 1e-6
        assert np.isnan(each.loc["flexor", "latency_s"])
    lower, upper = np.array([each.loc["extensor", ["lower_95_s", "upper_95_s"]] for each in rows], dtype=float).T
    assert np.sum((lower <= DELAY) & (upper >= DELAY)) >= 3


def test_a_muscle_that_is_not_stretched_does_not_answer():
    result, rows = answers(person(0))
    assert np.isnan(rows.loc["flexor", "latency_s"])
    assert rows.loc["flexor", "p"] > 1e-6
    assert rows.loc["extensor", "p"] < 1e-6
    assert (rows["trials"] == N_TRIALS).all()
    after = (result.time > 0.05) & (result.time < 0.15)
    assert result.average[0, 1, after].mean() > 2.0 * result.average[0, 1, result.time < 0.0].mean()


def test_no_reflex_has_no_latency():
    result, rows = answers(person(1, gain=0.0))
    assert rows["latency_s"].isna().all()
    assert "no muscle that pulses stretch answers clearly (p < 1e-06)" in result.summary()


def test_trials_without_pulses_are_refused():
    recording = recorded(noise((2, 2, N)))
    with pytest.raises(ValueError, match=r"onsets: no trial of RT7.5 has a pulse; expected some \(labels.pulse_onset"):
        onsets([ConditionTrials.prepare(recording)], envelopes(recording))


def test_what_are_no_trials_is_refused():
    recording = recorded(noise((2, 2, N)))
    with pytest.raises(TypeError, match=r"onsets: trials of a condition = .*; expected a ConditionTrials$"):
        onsets([recording], envelopes(recording))


def test_pulses_that_come_too_early_are_not_said_to_be_missing():
    recording = recorded(noise((2, 2, N)), pulse_onset=[0.1, 0.2], pulse_direction=[20.0] * 2)
    with pytest.raises(ValueError, match=r"the latest pulse of RT7.5 comes after 0.2 s; expected some after 0.23 s"):
        onsets([ConditionTrials.prepare(recording)], envelopes(recording))


def test_trials_that_were_taken_go_with_their_own_emg():
    """Of trials with pulses at other times, the later ones alone answer as they do among all."""
    recording = person(0)
    taken, amplitudes = ConditionTrials.prepare(recording).take(range(4, N_TRIALS)), envelopes(recording)
    result = onsets([taken], amplitudes)
    assert (result.latencies["trials"] == 4).all()
    latency = result.latencies.set_index("muscle").loc["extensor", "latency_s"]
    assert latency == pytest.approx(DELAY, abs=5e-3)


def test_a_result_describes_and_draws_itself():
    result, _ = answers(person(0))
    assert "Answers of the muscles of A to pulses in RT7.5" in result.summary()
    assert "extensor" in result.summary()
    assert result.to_frame().iloc[0, -2:].to_dict() == {"condition": "RT7.5", "subject": "A"}
    assert result.plot().shape == (2, 1)
