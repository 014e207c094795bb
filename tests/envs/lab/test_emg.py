"""The signal model of surface EMG against its settings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from armperturb.envs.lab.emg import CHUNK, CONTRACTED, HIGHPASS_ORDER, NEIGHBOURS, STULEN_DE_LUCA, Emg
from armperturb.recording import ACTIONS, MUSCLES
from armperturb.subject import POSITION, RELAX

RATE, DURATION = 200.0, 20.0
SILENCE = np.zeros((round(DURATION * RATE), 2))
FLEXORS = {"pectoralis_major_clavicular", "deltoideus_anterior", "biceps_short_head", "brachioradialis"}


def read(subject, excitation=SILENCE, emg=None, seed=0):
    return (emg or Emg()).read(subject, excitation, RATE, np.random.default_rng(seed))


def stretched(joint, torque):
    """Excitation of one joint that is held from 1 s on."""
    excitation = np.zeros((400, 2))
    excitation[200:, joint] = torque
    return excitation


def active(subject, excitation):
    activation = Emg().activation(subject, excitation, RATE)
    return {muscle for muscle, course in zip(MUSCLES, activation, strict=True) if course[-1] > course[0] + 1e-9}


def test_every_muscle_serves_a_joint_and_is_named_as_in_the_thesis():
    assert {muscle for muscle, action in ACTIONS.items() if action.sign > 0} == FLEXORS
    assert [muscle for muscle, action in ACTIONS.items() if action.joints == "se"] == [
        "biceps_short_head",
        "triceps_longum",
    ]


def test_noise_of_a_silent_muscle_is_the_setting():
    for noise in (5e-3, 0.1):
        floor = read(RELAX, emg=Emg(noise=noise)).std(axis=0)
        np.testing.assert_allclose(floor, noise, rtol=0.03)


def test_cocontraction_follows_stiffness():
    np.testing.assert_allclose(read(POSITION, emg=Emg(crosstalk=0.0)).std(axis=0), 0.2, rtol=0.05)
    half = replace(POSITION, **{f: (getattr(POSITION, f) + getattr(RELAX, f)) / 2 for f in ("k_s", "k_se", "k_e")})
    np.testing.assert_allclose(Emg().activation(half, SILENCE, RATE), 0.1, rtol=1e-12)
    assert not Emg().activation(replace(RELAX, k_s=1.0), SILENCE, RATE).any()


@pytest.mark.parametrize(
    ("joint", "torque", "expected"),
    [
        (0, 10.0, {"latissimus_dorsi", "deltoideus_posterior", "triceps_longum"}),
        (0, -10.0, {"pectoralis_major_clavicular", "deltoideus_anterior", "biceps_short_head"}),
        (1, 10.0, {"triceps_lateralis", "triceps_longum"}),
        (1, -10.0, {"brachioradialis", "biceps_short_head"}),
    ],
)
def test_a_stretch_excites_the_muscles_that_resist_it(joint, torque, expected):
    assert active(POSITION, stretched(joint, torque)) == expected


def test_reflex_comes_after_the_neural_delay_and_ends_at_full_activation():
    subject = replace(RELAX, Td_s=0.05, Td_e=0.1)
    activation = Emg().activation(subject, stretched(1, 25.0), RATE)[MUSCLES.index("triceps_lateralis")]
    # The step of the excitation lies between samples 199 and 200, at 1 s.
    assert activation[219] == 0.0
    assert activation[220] == pytest.approx(0.5)
    assert Emg().activation(subject, stretched(1, 500.0), RATE).max() == 1.0


def test_band_starts_at_20_hz_and_reaches_half_the_rate():
    power = np.mean(np.abs(np.fft.rfft(read(POSITION), axis=0)) ** 2, axis=1)
    frequency = np.fft.rfftfreq(round(DURATION * 2000), 1 / 2000)

    def density(low, high):
        return power[(frequency >= low) & (frequency < high)].mean()

    # Twelve decibels per octave below 20 Hz, on top of the f^2 of muscle.
    assert density(2, 8) < 1e-2 * density(40, 120)
    assert frequency[np.argmax(np.convolve(power, np.ones(400), "same"))] == pytest.approx(75, abs=25)
    assert density(900, 1000) > 0


def test_converter_has_16_bits_and_a_full_scale():
    emg = Emg(gain=5.0, full_scale=1.0)
    counts = read(POSITION, emg=emg) / np.float32(emg.adc_step)
    np.testing.assert_array_equal(counts, np.rint(counts))
    assert (counts.min(), counts.max()) == (-(2**15), 2**15 - 1)


def test_a_longer_trial_begins_the_same_and_other_seeds_differ():
    whole, first = read(POSITION), read(POSITION, SILENCE[:400])
    assert first.dtype == np.float32
    assert first.shape == (4000, 8)
    np.testing.assert_array_equal(whole[:4000], first)
    assert not np.array_equal(first, read(POSITION, SILENCE[:400], seed=1))


def test_neighbours_alone_share_a_signal_and_none_do_without_crosstalk():
    correlation = np.corrcoef(read(POSITION, emg=Emg(crosstalk=0.0)).T) - np.eye(8)
    assert np.abs(correlation).max() < 0.05
    with_crosstalk = np.corrcoef(read(POSITION, emg=Emg(crosstalk=0.2)).T) - np.eye(8)
    near = {tuple(sorted(map(MUSCLES.index, pair))) for pair in NEIGHBOURS}
    assert {(i, j) for i, j in zip(*np.nonzero(np.triu(with_crosstalk) > 0.2), strict=True)} == near


def test_a_maximal_contraction_is_full_activation_for_its_time():
    volts = Emg(crosstalk=0.0).read(RELAX, SILENCE, RATE, np.random.default_rng(0), contraction=1.0)
    first, last = (round(2000 * time) for time in CONTRACTED)
    np.testing.assert_allclose(volts[first + 50 : last].std(axis=0), 1.0, rtol=0.05)
    assert volts[last + 500 :].std() < 0.01
    # Contracting takes time: what begins with a step would be a spike of the channel.
    assert 0.05 < volts[first - 250 : first - 150].std() < 0.95


def test_fatigue_raises_the_amplitude_with_the_activation_that_was():
    volts = Emg(crosstalk=0.0, fatigue=0.1).read(POSITION, SILENCE, RATE, np.random.default_rng(0))
    end = volts[-4000:].std(axis=0).mean()
    assert end == pytest.approx(0.2 * (1.0 + 0.1 * 0.2 * (DURATION - 1.0)), rel=0.02)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"noise": -1e-3}, "Emg: noise = -0.001; expected a finite number at least 0"),
        ({"rate": 30.0}, "Emg: rate = 30.0; expected a finite number above 40"),
        ({"highpass": 0.0}, "Emg: highpass = 0.0; expected a finite number above 0"),
        ({"full_scale": 0.0}, "Emg: full_scale = 0.0; expected a finite number above 0"),
        ({"position_activation": 1.2}, "position_activation = 1.2; expected a finite number at least 0 and at most 1"),
        ({"reflex_torque": np.inf}, "reflex_torque = inf; expected a finite number above 0"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        Emg(**change)


def test_what_is_read_is_what_filters_of_scipy_make_of_the_noise():
    emg, excitation = Emg(), np.random.default_rng(1).normal(0.0, 20.0, (round(2.2 * CHUNK / 10), 2))
    volts = read(POSITION, excitation, emg, seed=5)
    low, high = (2.0 * np.pi * frequency for frequency in STULEN_DE_LUCA)
    colour = signal.zpk2sos(*signal.bilinear_zpk([0.0], [-low, -high, -high], 1.0, emg.rate))
    amplifier = signal.butter(HIGHPASS_ORDER, emg.highpass, "highpass", fs=emg.rate, output="sos")
    impulse = signal.unit_impulse(4000)
    both, alone = (np.linalg.norm(signal.sosfilt(amplifier, of)) for of in (signal.sosfilt(colour, impulse), impulse))
    time = np.arange(len(volts)) / emg.rate
    amplitude = emg.gain * emg.activation(POSITION, excitation, RATE, time)
    streams = [stream.spawn(2) for stream in np.random.default_rng(5).spawn(len(MUSCLES))]
    driven, electrodes = np.array(
        [[each.standard_normal(len(volts), dtype=np.float32) for each in pair] for pair in streams]
    ).swapaxes(0, 1)
    driven = amplitude * signal.sosfilt(colour, driven) / both
    for muscle, name in enumerate(MUSCLES):
        near = [MUSCLES.index(other) for pair in NEIGHBOURS if name in pair for other in pair if other != name]
        expected = driven[muscle] + emg.crosstalk * driven[near].sum(axis=0) + emg.noise / alone * electrodes[muscle]
        np.testing.assert_allclose(volts[:, muscle], signal.sosfilt(amplifier, expected), atol=0.6 * emg.adc_step)
