"""Strain gauge and encoders against their settings."""

import numpy as np
import pytest
from scipy import signal

from armperturb.envs.lab.emg import Emg
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Pulse
from armperturb.subject import RELAX


def test_strain_gauge_noise_has_the_set_size():
    noisy = Instruments(force_noise=0.3).read_force(np.full((20000, 2), 7.0), np.random.default_rng(0))
    assert noisy.mean() == pytest.approx(7.0, abs=0.01)
    assert noisy.std() == pytest.approx(0.3, rel=0.02)


def test_marker_noise_has_the_set_size():
    rest = np.full((20000, 2), 0.01)
    noisy = Instruments(marker_noise=2e-3).read_marker(rest, np.random.default_rng(0))
    np.testing.assert_allclose(noisy.mean(axis=0), 0.01, atol=1e-4)
    np.testing.assert_allclose(noisy.std(axis=0), 2e-3, rtol=0.02)


def test_position_error_is_that_of_two_quantised_angles():
    rng = np.random.default_rng(1)
    places = rng.uniform(-0.3, 0.3, (20000, 2))
    instruments = Instruments()
    error = instruments.read_displacement(places) - places
    # Angles are off by up to half a step: RMS step / sqrt 12, through the Jacobian of the links.
    step = 2 * np.pi / 2**17
    arm = places - instruments.base
    second = np.linalg.norm(arm, axis=1)
    near, far = instruments.link_lengths
    cosine = (second**2 - near**2 - far**2) / (2 * near * far)
    elbow = np.arccos(cosine)
    first = np.arctan2(arm[:, 1], arm[:, 0]) - np.arctan2(far * np.sin(elbow), near + far * np.cos(elbow))
    distal = far * np.stack([-np.sin(first + elbow), np.cos(first + elbow)], axis=-1)
    proximal = near * np.stack([-np.sin(first), np.cos(first)], axis=-1) + distal
    expected = step / np.sqrt(12) * np.sqrt(np.mean(proximal**2 + distal**2, axis=0))
    np.testing.assert_allclose(np.sqrt(np.mean(error**2, axis=0)), expected, rtol=0.03)


def test_finer_encoders_lose_less():
    place = np.array([[0.0123, -0.0456]])
    coarse, fine = (np.abs(Instruments(encoder_bits=bits).read_displacement(place) - place).max() for bits in (10, 26))
    assert fine < 1e-7 < coarse


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"force_noise": -1.0}, r"force_noise = -1.0; expected a finite number at least 0"),
        ({"encoder_bits": 0}, "encoder_bits = 0; expected a finite number at least 1"),
        ({"link_lengths": (0.5, 0.0)}, "link_lengths = 0.0; expected a finite number above 0"),
        ({"link_lengths": (0.5, 0.5, 0.5)}, r"link_lengths = \(0.5, 0.5, 0.5\); expected two numbers"),
        ({"base": (0.0, 1.5)}, "expected the handle's start within reach"),
        ({"base": (0.0, np.nan)}, "base = nan; expected a finite number"),
        ({"antialias": 0.0}, r"antialias = 0.0; expected a finite number above 0"),
        ({"marker_noise": -1e-3}, r"marker_noise = -0.001; expected a finite number at least 0"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        Instruments(**change)


def test_what_is_of_another_type_is_refused():
    with pytest.raises(TypeError, match="emg = True; expected Emg or None"):
        Instruments(emg=True)
    with pytest.raises(TypeError, match=r"encoder_bits = 16.5; expected a whole number"):
        Instruments(encoder_bits=16.5)
    assert Instruments(emg=Emg(noise=0.0)).emg.noise == 0.0


def counts(instruments, displacement):
    """Angles of both links in encoder steps, from the recorded positions by trigonometry of its own."""
    near, far = instruments.link_lengths
    hand = displacement - instruments.base
    reach = np.hypot(*hand.T)
    inner = np.arccos((near**2 + reach**2 - far**2) / (2 * near * reach))
    first = np.arctan2(hand[:, 1], hand[:, 0]) - inner
    elbow = hand - near * np.stack([np.cos(first), np.sin(first)], axis=-1)
    second = np.arctan2(elbow[:, 1], elbow[:, 0]) - first
    return np.stack([first, second], axis=-1) * 2**instruments.encoder_bits / (2 * np.pi)


def test_every_reading_is_a_whole_number_of_encoder_steps():
    instruments = Instruments(link_lengths=(0.5, 0.7))
    places = np.random.default_rng(2).uniform(-0.1, 0.1, (1000, 2))
    found = counts(instruments, instruments.read_displacement(places))
    np.testing.assert_allclose(found, np.rint(found), atol=1e-6)


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.15, -0.1), (-0.2, 0.1)])
def test_a_step_of_the_first_encoder_moves_the_handle_by_reach_times_angle(place):
    instruments = Instruments()
    reach = np.hypot(*np.subtract(place, instruments.base))
    step = 2 * np.pi / 2**17 * reach
    # Along a circle around the robot's shoulder only the first encoder counts.
    angle = np.arctan2(*np.subtract(place, instruments.base)[::-1]) + np.linspace(0.0, 40 * step / reach, 4001)
    read = instruments.read_displacement(instruments.base + reach * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    moved = np.linalg.norm(np.diff(read, axis=0), axis=1)
    steps = moved[moved > 1e-7]
    assert len(steps) in (39, 40, 41)
    # The second angle was rounded, and with it the reach.
    np.testing.assert_allclose(steps, step, rtol=1e-3)


def test_lowpass_is_that_of_its_settings():
    sections = Instruments(antialias=60.0).lowpass(1e-3, 200.0)
    frequency = np.array([6.0, 60.0, 170.0])
    _, response = signal.sosfreqz(sections, frequency, fs=1000.0)
    gain = np.abs(response)
    assert gain[0] == pytest.approx(1.0, abs=1e-3)
    assert gain[1] == pytest.approx(np.sqrt(0.5))
    # The first frequency that a recorder at 200 Hz folds onto 30 Hz.
    assert gain[2] < 0.02
    assert Instruments(antialias=None).lowpass(1e-3, 200.0) is None


def test_lowpass_that_lets_frequencies_fold_is_refused():
    with pytest.raises(ValueError, match=r"antialias = 80.0; expected a finite number above 0 and below 50"):
        Instruments().lowpass(1e-3, 100.0)


@pytest.mark.parametrize("options", [{}, {"engine": "compiled"}, {"linear": True}])
def test_what_dies_away_in_the_filter_does_not_end_in_denormal_numbers(options):
    pulse = Pulse(peak=60.0, direction_deg=20.0, onset=0.1, duration=4.0)
    recording = run_experiment([Trial(subject=RELAX, perturbation=pulse)], instruments=Instruments(emg=None), **options)
    filtered = np.abs(recording["perturbation"].values)
    assert not filtered[0, -1].any()
    assert 0.0 < filtered[filtered > 0.0].min() < 1e-20
    for values in (each.values for each in recording.data_vars.values()):
        assert np.abs(values[values != 0.0]).min() > np.finfo(float).tiny
