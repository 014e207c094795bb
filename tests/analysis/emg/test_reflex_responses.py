"""Delay, gains and response of EMG that a known filter makes of rotation, and averages about pulses."""

import numpy as np
import pytest
from invented_emg import EMG_RATE, noise, recorded
from scipy import signal

from armperturb.analysis.emg.envelope import envelopes
from armperturb.analysis.emg.reflex import pulse_averages, reflexes
from armperturb.analysis.trials import ConditionTrials

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
def result(recording):
    return reflexes(ConditionTrials.prepare(recording), envelopes(recording), window_start=1.0)


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


def test_response_without_a_model_is_that_of_the_filter(result):
    s = 2j * np.pi * result.frequency
    true = (VELOCITY * s + POSITION) * np.exp(-s * DELAY)
    off = np.abs(result.response[1, 0] - true) / result.response_error[1, 0]
    inside = result.frequency < 10.0
    assert np.median(off[inside]) < 2.0
    assert np.median(result.coherence[:, inside]) > 0.5


def test_no_reflex_is_found_where_there_is_none(recording):
    still = recording.assign(
        emg=recording["emg"].copy(data=np.float32(0.2) * noise((N_TRIALS, 2, N), 5).swapaxes(1, 2))
    )
    nothing = reflexes(ConditionTrials.prepare(still), envelopes(still), window_start=1.0)
    assert (nothing.responses["p"] > 1e-3).all()
    assert (nothing.responses["coherence"] < 0.05).all()


def test_average_about_pulses_is_the_burst_in_its_window(recording):
    rows = pulse_averages(envelopes(recording), range(N_TRIALS)).set_index("muscle")
    assert rows.loc["extensor", "long"] > 5.0 * rows.loc["extensor", "long_error"]
    assert abs(rows.loc["flexor", "long"]) < 4.0 * rows.loc["flexor", "long_error"]


def test_trials_that_are_too_short_are_named(recording):
    with pytest.raises(
        ValueError, match=r"last at most 18 s before the pulse; expected 21 s \(an earlier --window-start"
    ):
        reflexes(ConditionTrials.prepare(recording), envelopes(recording), window_start=17.0)


def test_a_result_describes_itself(result):
    assert "Reflexes of A in RT7.5" in result.summary()
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
