"""Strain gauge and encoders against their settings."""

import numpy as np
import pytest

from armperturb.envs.instruments import Instruments


def test_strain_gauge_noise_has_the_set_size():
    noisy = Instruments(force_noise=0.3).read_force(np.full((20000, 2), 7.0), np.random.default_rng(0))
    assert noisy.mean() == pytest.approx(7.0, abs=0.01)
    assert noisy.std() == pytest.approx(0.3, rel=0.02)


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
        ({"force_noise": -1.0}, "force_noise = -1.0; expected a finite number at least 0"),
        ({"encoder_bits": 0}, "encoder_bits = 0; expected a finite number at least 1"),
        ({"link_lengths": (0.5, 0.0)}, "link_lengths = 0.0; expected a finite number above 0"),
        ({"base": (0.0, 1.5)}, "expected the handle's start within reach"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        Instruments(**change)
