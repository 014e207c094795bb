"""Delay, gains and response of EMG that a known filter makes of rotation, and averages about pulses."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from invented_emg import EMG_RATE, RATE, noise, recorded
from scipy import signal, stats

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.emg.envelope import LABELS, Envelopes, envelopes
from armperturb.analysis.emg.pulse_average import pulse_averages
from armperturb.analysis.emg.reflex import reflexes
from armperturb.analysis.trials import ConditionTrials
from armperturb.recording import Action
from armperturb.subject import RELAX

N_TRIALS, N = 6, 40_000
DELAY = 0.037
VELOCITY, POSITION = 0.1, 1.5
"""Gains of the extensor over its background [s/rad, 1/rad]."""


@pytest.fixture(scope="module")
def recording():
    """Rotation of the shoulder that modulates antagonists after a delay, and a pulse's response at 18 s."""
    rng = np.random.default_rng(0)
    band = signal.butter(2, (0.5, 10.0), "bandpass", fs=EMG_RATE, output="sos")
    angle = signal.sosfiltfilt(band, rng.standard_normal((N_TRIALS, 2, N)))
    angle *= 0.05 / angle.std()
    time = np.arange(N) / EMG_RATE
    late = np.array([[np.interp(time - DELAY, time, each) for each in trial] for trial in angle])
    drive = VELOCITY * np.gradient(late[:, 0], 1.0 / EMG_RATE, axis=-1) + POSITION * late[:, 0]
    burst = np.where((time > 18.05) & (time < 18.1), 1.5, 0.0)
    amplitude = 0.2 * np.stack([np.clip(1.0 - drive, 0.0, None), np.clip(1.0 + drive, 0.0, None) + burst], axis=1)
    result = recorded(
        amplitude * noise((N_TRIALS, 2, N), 1), pulse_onset=[18.0] * N_TRIALS, pulse_direction=[20.0] * N_TRIALS
    )
    rotation = ("trial", "time", "joint"), angle[:, :, ::10].swapaxes(1, 2), {"units": "rad"}
    return result.assign(joint_angle=rotation).assign_coords(joint=["shoulder", "elbow"])


@pytest.fixture(scope="module")
def amplitudes(recording):
    return envelopes(recording)


@pytest.fixture(scope="module")
def result(recording, amplitudes):
    return reflexes(ConditionTrials.prepare(recording), amplitudes, window_start=1.0)


def turning(n_trials, seconds, seed=0):
    """Trials whose joints turn at random up to 10 Hz, without EMG."""
    n = round(seconds * RATE)
    low = signal.butter(2, 10.0, fs=RATE, output="sos")
    angle = signal.sosfilt(low, np.random.default_rng(seed).standard_normal((n_trials, n, 2)), axis=1)
    made = recorded(np.zeros((n_trials, 2, 10 * n))).drop_dims("emg_time")
    made = made.assign(joint_angle=(("trial", "time", "joint"), 0.05 * angle / angle.std(), {"units": "rad"}))
    return ConditionTrials.prepare(made.assign_coords(joint=["shoulder", "elbow"]))


def of_amplitude(amplitude, labels):
    """Envelopes that are known, (trial, time, muscle), without noise of the channels."""
    n = amplitude.shape[2]
    return Envelopes(
        muscles={f"muscle {k}": Action("s", 1) for k in range(n)},
        labels=labels,
        rate=RATE,
        power=amplitude**2,
        rectified=amplitude.astype(np.float32),
        noise=np.zeros(n),
        knows_noise=np.ones(n, dtype=bool),
        reference="RT7.5",
        reference_volts=np.ones(n),
        averaging=0.01,
        samples_per_second=np.full((len(amplitude), n), 400.0),
        faults=(),
        crosstalk=(),
        hum={},
    )


def test_delay_is_that_which_was_made(result):
    for row in result.responses.to_dict("records"):
        assert row["delay_s"] == pytest.approx(DELAY, abs=2e-3)
        assert row["lower_95_s"] < row["delay_s"] < row["upper_95_s"]
        assert abs(row["delay_s"] - DELAY) < 3.0 * row["delay_error_s"]
        assert row["delay_by_phase_s"] == pytest.approx(DELAY, abs=4e-3)


def test_gains_have_the_sign_and_size_of_each_muscle(result):
    rows = result.responses.set_index("muscle")
    for muscle, sign in (("flexor", -1.0), ("extensor", 1.0)):
        row = rows.loc[muscle]
        scale = row["velocity_s"] / VELOCITY * sign
        assert scale == pytest.approx(1.0, rel=0.1)
        assert row["position_s"] == pytest.approx(sign * POSITION, abs=4.0 * row["position_s_error"])
        assert abs(row["velocity_e"]) < 4.0 * row["velocity_e_error"]


def test_muscles_that_answer_to_shortening_are_named(recording, amplitudes, result):
    assert result.remarks == ()
    swapped = replace(amplitudes, muscles={name: Action("s", -each.sign) for name, each in amplitudes.muscles.items()})
    trials = ConditionTrials.prepare(recording)
    (said,) = reflexes(trials, swapped, window_start=1.0).remarks
    assert said.startswith(
        "EMG of flexor, extensor in RT7.5 answers to shortening: flexors that are named as extensors"
    )
    assert said in replace(result, remarks=(said,)).summary()
    # Where nothing perturbs the arm, activity may come first.
    still = recording.assign(perturbation=0.0 * recording["perturbation"])
    assert reflexes(ConditionTrials.prepare(still), swapped, window_start=1.0).remarks == ()


def test_response_without_a_model_is_that_of_the_filter(result):
    s = 2j * np.pi * result.frequency
    true = (VELOCITY * s + POSITION) * np.exp(-s * DELAY)
    off = np.abs(result.response[1, 0] - true) / result.response_error[1, 0]
    inside = result.frequency < 10.0
    assert np.median(off[inside]) < 2.0
    assert np.median(result.coherence[:, inside]) > 0.5


def test_the_grip_of_an_arm_is_taken_off_what_the_handle_shows(recording, amplitudes, result):
    arm = replace(RELAX, k_h=2000.0, b_h=8.0)
    angle, trials = recording["joint_angle"].values, ConditionTrials.prepare(recording)
    hand = angle @ hand_jacobian(trials.body).T
    force = 25.0 * np.gradient(hand, 1.0 / RATE, axis=1)
    frequency = np.fft.rfftfreq(2 * angle.shape[1], 1.0 / RATE)
    softness = 1.0 / (arm.b_h * 2j * np.pi * frequency + arm.k_h)
    give = np.fft.irfft(np.fft.rfft(force, 2 * angle.shape[1], axis=1) * softness[:, None], axis=1)[:, : angle.shape[1]]
    handled = recording.drop_vars(["joint_angle", "joint"]).assign(
        displacement=recording["displacement"].copy(data=hand + give), force=recording["force"].copy(data=force)
    )
    alone, with_grip = (
        reflexes(ConditionTrials.prepare(handled), amplitudes, window_start=1.0, arm=each).responses
        for each in (None, arm)
    )
    expected = result.responses["delay_s"][1]
    assert with_grip["delay_s"][1] == pytest.approx(expected, abs=5e-4)
    assert abs(alone["delay_s"][1] - expected) > 5e-3


def test_no_reflex_is_found_where_there_is_none(recording):
    still = recording.assign(
        emg=recording["emg"].copy(data=np.float32(0.2) * noise((N_TRIALS, 2, N), 5).swapaxes(1, 2))
    )
    nothing = reflexes(ConditionTrials.prepare(still), envelopes(still), window_start=1.0)
    assert (nothing.responses["p"] > 1e-3).all()
    assert (nothing.responses["coherence"] < 0.05).all()


@pytest.mark.slow(reason="many draws of noise")
@pytest.mark.parametrize("cutoff", [None, 3.0])
def test_noise_is_said_to_respond_as_often_as_the_level_of_the_test(cutoff):
    """Also at the best of all delays, while weak responses are found."""
    n_noise, n_weak = 400, 5
    trials = turning(2, 6.0)
    angle, rng = trials.recording["joint_angle"].values, np.random.default_rng(1)
    own = rng.standard_normal((2, angle.shape[1], n_noise + n_weak))
    if cutoff is not None:
        own = 2.5 * signal.sosfilt(signal.butter(1, cutoff, fs=RATE, output="sos"), own, axis=1)
    amplitude = 1.0 + 0.1 * own
    late = round(0.04 * RATE)
    amplitude[:, late:, n_noise:] += 0.4 * angle[:, :-late, :1]
    labels = pd.DataFrame({name: trials.recording[name].values for name in LABELS})
    rows = reflexes(trials, of_amplitude(amplitude, labels), window_start=0.0).responses
    p = rows["p"].to_numpy()
    for level in (0.05, 0.01):
        low, high = stats.binom.interval(0.999, n_noise, level)
        assert low <= np.sum(p[:n_noise] < level) <= high, level
    assert (p[n_noise:] < 0.001).all()
    assert (rows["coherence"][n_noise:] < 0.3).all()


def test_trials_that_were_taken_go_with_their_own_emg(recording, amplitudes, result):
    taken = ConditionTrials.prepare(recording).take([1, 4, 5]).take([1])
    alone = reflexes(taken, amplitudes, window_start=1.0)
    assert (alone.averages["trials"] == 1).all()
    for row, of_all in zip(alone.responses.to_dict("records"), result.responses.to_dict("records"), strict=True):
        assert row["delay_s"] == pytest.approx(DELAY, abs=4e-3)
        assert row["coherence"] == pytest.approx(of_all["coherence"], rel=0.2)


def test_emg_of_other_trials_is_refused(recording, amplitudes):
    some = ConditionTrials.prepare(recording.isel(trial=[1, 4]))
    with pytest.raises(ValueError, match=r"it has 6 trials of RT7.5, the other signals 2; expected the same trials"):
        reflexes(some, amplitudes, window_start=1.0)


def test_trials_with_too_few_lines_together_are_refused(recording, amplitudes):
    trials = ConditionTrials.prepare(recording)
    with pytest.raises(ValueError, match=r"RT7.5 \(1 x 5 s before the pulse\) have 2.6 independent lines in 1 Hz"):
        reflexes(trials.take([0]), amplitudes, window_start=13.0)
    assert len(reflexes(trials.take([0, 1]), amplitudes, window_start=13.0).frequency) > 10


def test_a_joint_that_does_not_turn_is_named(recording, amplitudes):
    stiff = recording.copy(deep=True)
    stiff["joint_angle"].values[..., 1] = 0.3
    with pytest.raises(ValueError, match=r"no rotation of elbow in trials of RT7.5; expected that of both joints"):
        reflexes(ConditionTrials.prepare(stiff), amplitudes, window_start=1.0)


def test_average_about_pulses_is_the_burst_in_its_window(amplitudes):
    rows = pulse_averages(amplitudes, range(N_TRIALS)).set_index("muscle")
    assert rows.loc["extensor", "long"] > 5.0 * rows.loc["extensor", "long_error"]
    assert abs(rows.loc["flexor", "long"]) < 4.0 * rows.loc["flexor", "long_error"]


def test_trials_that_are_too_short_are_named(recording):
    with pytest.raises(
        ValueError, match=r"last at most 18 s before the pulse; expected 21 s \(an earlier --window-start"
    ):
        reflexes(ConditionTrials.prepare(recording), envelopes(recording), window_start=17.0)


def test_a_result_describes_itself(result):
    assert "Reflexes of A in RT7.5" in result.summary()
    assert result.to_frame().iloc[0, -2:].to_dict() == {"condition": "RT7.5", "subject": "A"}
    assert result.to_xarray()["response"].shape == (2, 2, len(result.frequency))
    assert result.plot().shape == (3, 2)


def test_a_channel_of_zeros_says_nothing_and_the_others_what_they_did(recording, result):
    silent = recording.copy(deep=True)
    silent["emg"].values[:, :, 0] = 0.0
    dead = reflexes(ConditionTrials.prepare(silent), envelopes(silent), window_start=1.0)
    first, second = dead.responses.to_dict("records")
    assert np.isnan(first["delay_s"])
    assert np.isnan(first["delay_by_phase_s"])
    assert first["p"] == 1.0
    assert second["delay_s"] == pytest.approx(result.responses["delay_s"][1], abs=1e-6)
    assert "flexor" in dead.summary()


def without(amplitudes, trials, column):
    """The same envelopes, whose channel is dead in some trials."""
    power, rectified = amplitudes.power.copy(), amplitudes.rectified.copy()
    power[trials, :, column] = rectified[trials, :, column] = np.nan
    return replace(amplitudes, power=power, rectified=rectified)


def test_trials_in_which_a_channel_is_dead_are_none_of_its_muscles(recording, amplitudes, result):
    trials = ConditionTrials.prepare(recording)
    others = reflexes(trials.take([2, 3, 4, 5]), amplitudes, window_start=1.0)
    dead = reflexes(trials, without(amplitudes, [0, 1], 0), window_start=1.0)
    for row, expected in ((0, others), (1, result)):
        numbers = (each.responses.drop(columns="muscle").loc[row].astype(float) for each in (dead, expected))
        np.testing.assert_allclose(*numbers, rtol=1e-9)
        np.testing.assert_allclose(dead.response[row], expected.response[row])
        np.testing.assert_allclose(dead.coherence[row], expected.coherence[row])
    averages = dead.averages.set_index("muscle")
    assert averages["trials"].to_dict() == {"flexor": 4, "extensor": 6}
    expected = others.averages.set_index("muscle").loc["flexor"].to_dict()
    assert averages.loc["flexor"].to_dict() == pytest.approx(expected)


def test_a_channel_that_is_dead_in_nearly_all_trials_is_unknown(recording, amplitudes, result):
    dead = reflexes(ConditionTrials.prepare(recording), without(amplitudes, [0, 1, 2, 3, 4, 5], 0), window_start=1.0)
    first, second = dead.responses.to_dict("records")
    assert np.isnan([first["delay_s"], first["velocity_s"]]).all()
    assert np.isnan(dead.response[0]).all()
    assert second["delay_s"] == result.responses["delay_s"][1]
    assert dead.plot().shape == (3, 2)
