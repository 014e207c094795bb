"""Frequency responses from any excitation, against loads whose mass, damping and stiffness are known."""

import re
from functools import cache, partial

import numpy as np
import pytest
from scipy import signal

from armperturb.analysis.numerics.periodicity import find_period
from armperturb.analysis.periods import common_period
from armperturb.analysis.response.closed_loop import estimate_noise
from armperturb.analysis.response.condition_spectra import condition_spectra, whole_periods_start
from armperturb.analysis.response.estimate import response
from armperturb.analysis.response.frequency_response import FrequencyResponse
from armperturb.analysis.response.line_balance import LineBalance
from armperturb.analysis.response.local_polynomial import Window, fit_locally, with_differences
from armperturb.analysis.response.multisines import estimate_multisine
from armperturb.analysis.smoother import NoiseLevels
from armperturb.analysis.trials import ConditionTrials
from armperturb.environment import Environment
from armperturb.recording import make_recording

RATE, PERIOD = 200.0, 20.48
N_PERIOD = round(RATE * PERIOD)
MASS = np.array([[1.8, 0.3], [0.3, 1.2]])
DAMPING = np.array([[18.0, 4.0], [4.0, 14.0]])
STIFFNESS = np.array([[240.0, 60.0], [60.0, 160.0]])
HELD = (3.27 * np.eye(2), 12.0 * np.eye(2), 22.03 * np.eye(2))
"""Mass, damping and stiffness of the manipulator; the thesis's has less damping, and a resonance within one line."""

CLUSTERS = np.concatenate([np.arange(first, first + 4) for first in (5, 13, 25, 41, 70, 130, 260, 400, 600)])


def admittance(matrices, frequency):
    s = 2j * np.pi * frequency[:, None, None]
    return np.linalg.inv(matrices[0] * s**2 + matrices[1] * s + matrices[2])


TRUE = {
    "arm": lambda frequency: admittance((MASS, DAMPING, STIFFNESS), frequency),
    "environment": lambda frequency: admittance(HELD, frequency),
    "total": lambda frequency: admittance(
        tuple(a + b for a, b in zip((MASS, DAMPING, STIFFNESS), HELD, strict=True)), frequency
    ),
}


def labels(n_trials):
    fixed = {"repetition": 0, "pulse_level": 0.0, "l_h": 0.3, "l_f": 0.3, "theta_s_deg": 22.5, "theta_e_deg": 82.3}
    empty = dict.fromkeys(("pulse_direction", "pulse_onset", "limit_time"), np.nan)
    values = {"subject": "load", "task": "PT", "condition": "PT", **fixed, **empty}
    return {name: [value] * n_trials for name, value in values.items()}


@cache
def responses(n):
    """Admittance of load and manipulator as one body, and impedance of the manipulator, at the lines of n samples."""
    frequency = np.maximum(np.fft.rfftfreq(n, 1.0 / RATE), 1e-6)
    return TRUE["total"](frequency), np.linalg.inv(TRUE["environment"](frequency))


def recorded(d, rng, *, own=0.0, instruments=0.0):
    """The load on the manipulator from rest, exact for what lies below half the rate; d is (trial, time, axis).

    `own` is the RMS of a force of the load's own below 3 Hz [N], `instruments` a factor on the instruments' noise.
    """
    n = d.shape[1]
    padded = n + round(20.0 * RATE)
    total, environment = responses(padded)
    remnant = signal.lfilter(*signal.butter(2, 3.0, fs=RATE), rng.normal(size=(len(d), n + 400, 2)), axis=1)[:, 400:]
    force, remnant = (np.fft.rfft(values, padded, axis=1) for values in (d, own / remnant.std() * remnant))
    # d and the load's own force move load and manipulator as one body.
    x = np.einsum("fij,tfj->tfi", total, force + remnant)
    f = force - np.einsum("fij,tfj->tfi", environment, x)
    f, x = (np.fft.irfft(values, padded, axis=1)[:, :n] for values in (f, x))
    f = f + 0.02 * instruments * rng.normal(size=f.shape)
    x = x + 1e-5 * instruments * rng.normal(size=x.shape)
    return make_recording({"perturbation": d, "force": f, "displacement": x}, labels(len(d)), RATE)


def multisine(rng, n_trials, duration, lines=CLUSTERS):
    n = N_PERIOD
    spectrum = np.zeros((n_trials, n // 2 + 1, 2), complex)
    spectrum[:, lines] = n / 4 * np.exp(2j * np.pi * rng.random((n_trials, len(lines), 2)))
    index = np.arange(round(duration * RATE))
    return np.take(np.fft.irfft(spectrum, n, axis=1), index, axis=1, mode="wrap")


def noise(rng, n_trials, duration):
    white = rng.normal(size=(n_trials, round(duration * RATE), 2))
    return 4.0 * signal.lfilter(*signal.butter(2, 15.0, fs=RATE), white, axis=1)


def worst(found, what):
    used = found.frequency <= 20.0
    truth = TRUE[what](found.frequency)
    error = np.abs(found.response - truth) / np.abs(truth).max(axis=(1, 2), keepdims=True)
    assert used.sum() > 6
    return error[used].max()


@pytest.fixture(scope="module")
def excited():
    """Ways to excite the load: recordings and what estimates the response from them."""
    rng = np.random.default_rng(1)
    odd = np.arange(3, 512, 2)
    return {
        "clusters": (recorded(multisine(rng, 4, 32.0), rng), estimate_multisine),
        "odd lines": (recorded(multisine(rng, 4, 32.0, odd), rng), estimate_multisine),
        "all lines": (recorded(multisine(rng, 4, 26.0, np.arange(3, 512)), rng), estimate_multisine),
        "noise": (recorded(noise(rng, 4, 32.0), rng), estimate_noise),
        "unequal": ([recorded(noise(rng, n, t), rng) for n, t in ((2, 25.0), (1, 33.3), (1, 41.0))], estimate_noise),
    }


NOISE = pytest.param("noise", marks=pytest.mark.slow(reason="averages over noise"))


@pytest.mark.parametrize("way", ["clusters", "odd lines", "all lines", NOISE, "unequal"])
@pytest.mark.parametrize("what", list(TRUE))
def test_known_load_from_every_excitation(excited, way, what):
    recordings, estimate = excited[way]
    assert worst(estimate(recordings, what=what), what) < 0.02


@pytest.fixture(scope="module")
def measured():
    """The same by the thesis's gauge and encoders."""
    rng = np.random.default_rng(8)

    def by_instruments(d):
        return recorded(d, rng, instruments=1.0)

    odd = np.arange(3, 512, 2)
    return {
        "clusters": (by_instruments(multisine(rng, 4, 32.0)), estimate_multisine),
        "odd lines": (by_instruments(multisine(rng, 4, 32.0, odd)), estimate_multisine),
        "clusters, unequal": ([by_instruments(multisine(rng, 2, t)) for t in (25.0, 44.0)], estimate_multisine),
        "noise": (by_instruments(noise(rng, 4, 32.0)), estimate_noise),
        "noise, unequal": ([by_instruments(noise(rng, n, t)) for n, t in ((2, 25.0), (2, 41.0))], estimate_noise),
    }


@pytest.mark.parametrize("way", ["clusters", "odd lines", "clusters, unequal", NOISE, "noise, unequal"])
def test_known_load_by_the_thesis_instruments(measured, way):
    recordings, estimate = measured[way]
    found = estimate(recordings)
    assert worst(found, "arm") < 0.02
    assert found.environment.m_env == pytest.approx(3.27, rel=1e-3)
    # Encoders alone do not see the load's micrometres.
    assert worst(estimate(recordings, balance=False), "arm") > 1.5 * worst(found, "arm")


@pytest.mark.slow(reason="estimates responses of long records")
def test_a_manipulator_that_does_not_balance_is_found_out(measured):
    recording, _ = measured["clusters"]
    rate = recording.attrs["rate"]
    shifted = recording["force"].copy(data=np.roll(recording["force"].values, 1, axis=1))
    heavy = recording["force"].values.copy()
    heavy[..., 1] -= 0.2 * np.gradient(
        np.gradient(recording["displacement"].values[..., 1], 1 / rate, axis=1), 1 / rate, axis=1
    )
    heavy = recording["force"].copy(data=heavy)
    for force in (shifted, heavy, -recording["force"]):
        spoiled = recording.assign(force=force)
        found, raw = (estimate_multisine(spoiled, **options) for options in ({}, {"balance": False}))
        assert found.environment is None
        np.testing.assert_array_equal(found.response, raw.response)


def test_corrected_lines_obey_the_balance_and_are_least_noisy():
    rng = np.random.default_rng(9)
    frequency = np.geomspace(0.5, 40.0, 6)
    held = 1.0 / (3.0 * (2j * np.pi * frequency) ** 2 + 5.0 * 2j * np.pi * frequency + 20.0)[:, None]
    balance = LineBalance(Environment(m_env=3.0, b_env=5.0, k_env=20.0), NoiseLevels(0.02, 1e-5))
    d, f = rng.normal(size=(2, 6, 2)) + 1j * rng.normal(size=(2, 6, 2))
    true = np.concatenate([f, held * (d - f)], axis=1)
    np.testing.assert_allclose(balance.corrected(frequency, d, true), true, atol=1e-12)
    white = rng.normal(size=(2, 4000, 6, 4)) * [0.02, 0.02, 1e-5, 1e-5]
    better = np.array([balance.corrected(frequency, d, true + one) for one in white[0] + 1j * white[1]])
    np.testing.assert_allclose(better[..., 2:], held * (d - better[..., :2]), atol=1e-12)
    # The mean of two measurements of x, weighted inversely with their variances, has the inverse sum of these.
    least = 2.0 / (1.0 / 1e-5**2 + 1.0 / np.abs(held * 0.02) ** 2)
    np.testing.assert_allclose(np.mean(np.abs(better - true) ** 2, axis=0)[:, 2:], least.repeat(2, axis=1), rtol=0.1)


def realisations(period, duration, rate, n_trials=2, top=12.0):
    """Multisines of all lines up to a frequency, computed line by line: no sample need fall on a period."""
    rng = np.random.default_rng(10)
    lines = np.arange(1, int(top * period))
    angle = 2 * np.pi * np.outer(np.arange(round(duration * rate)) / rate, lines) / period
    return [np.cos(angle[:, None] + 2 * np.pi * rng.random((2, len(lines)))).sum(axis=2) for _ in range(n_trials)]


@pytest.mark.parametrize(("period", "duration"), [(20.48, 24.0), (8.0, 9.0), (5.12, 30.0), (0.5, 4.0)])
def test_the_period_is_found(period, duration):
    rng = np.random.default_rng(11)
    d = realisations(period, duration, RATE)
    assert find_period(d, RATE) == pytest.approx(period, rel=1e-12)
    rough = [np.round((one + 0.03 * one.std() * rng.normal(size=one.shape)) / 0.1) * 0.1 for one in d]
    assert find_period([rough[0], rough[1][: round(1.2 * period * RATE)]], RATE) == pytest.approx(period, rel=1e-12)


def test_without_a_period_there_is_one_line():
    with pytest.raises(
        ValueError, match=r"rate = 199\.3 Hz; expected one at which .* period of 7\.7 s is a whole number"
    ):
        find_period(realisations(7.7, 12.0, 199.3), 199.3)
    rng = np.random.default_rng(12)
    pulse = np.zeros((1, round(10.0 * RATE), 2))
    pulse[0, 200:216, 0] = 1.0
    for d in (noise(rng, 2, 20.0), 0.0 * noise(rng, 1, 5.0), noise(rng, 1, 0.02), multisine(rng, 1, 21.0), pulse):
        with pytest.raises(ValueError, match=r"does not repeat within .* there is --method noise"):
            find_period(list(d), RATE)
    assert find_period(list(np.tile(pulse, (1, 2, 1))[:, : round(11.1 * RATE)]), RATE) == 10.0


def test_the_period_and_the_lines_are_found_in_the_recording(excited):
    recording, _ = excited["clusters"]
    stated, found = (estimate_multisine(recording, period=period) for period in (PERIOD, None))
    np.testing.assert_array_equal(found.response, stated.response)
    np.testing.assert_allclose(found.frequency * PERIOD, CLUSTERS.reshape(-1, 4).mean(axis=1))


def rested(rng, rest, *, fade=0.0, lines=CLUSTERS):
    """A recording of four trials of 30 s that begin with a rest [s], and whose multisine may fade out at the end."""
    d = multisine(rng, 4, 30.0, lines)
    d[:, : round(rest * RATE)] = 0.0
    n = round(fade * RATE)
    d[:, 6000 - n :] *= np.linspace(1.0, 0.0, n)[:, None]
    return recorded(d, rng)


def test_a_perturbation_may_begin_after_a_rest():
    recording = rested(np.random.default_rng(14), 3.5)
    found = estimate_multisine(recording)
    (remark,) = found.remarks
    assert re.fullmatch(r"nothing perturbs all trials before 3\.5\d? s: they are used from 5\.5\d? s on", remark)
    np.testing.assert_allclose(found.frequency * PERIOD, CLUSTERS.reshape(-1, 4).mean(axis=1))
    assert worst(found, "arm") < 0.02
    for options in ({"period": PERIOD}, {"window_start": 6.0}):
        assert worst(estimate_multisine(recording, **options), "arm") < 0.02
    assert estimate_multisine(recording, window_start=6.0).remarks == ()


def test_a_perturbation_may_fade_out():
    for fade in (0.0, 0.3):
        recording = rested(np.random.default_rng(15), 0.0, fade=fade)
        assert common_period([ConditionTrials.prepare(recording)], 2.0) == PERIOD
        assert worst(estimate_multisine(recording), "arm") < 0.02
        assert worst(estimate_multisine(recording, period=PERIOD), "arm") < 0.02


def test_short_trials_have_the_lines_of_their_short_period():
    """From 8 s on there is no whole period; whole records would have points between the lines, by leakage alone."""
    rng, period = np.random.default_rng(16), 2.0
    d = np.stack(realisations(period, 7.0, RATE, n_trials=4))
    trials = ConditionTrials.prepare(recorded(d, rng))
    assert whole_periods_start(trials) == 4.0
    spectra = condition_spectra([trials])
    np.testing.assert_allclose(spectra.frequency, np.arange(1, 24) / period)  # far apart: each is a point
    np.testing.assert_array_equal(spectra.n_averages, 4)
    assert np.abs(spectra.arm / TRUE["arm"](spectra.frequency) - 1.0).max() < 0.1
    assert whole_periods_start(ConditionTrials.prepare(recorded(d[:, :900], rng))) == 2.0
    assert whole_periods_start(ConditionTrials.prepare(recorded(noise(rng, 2, 7.0), rng))) is None


@pytest.mark.slow(reason="repeats estimates on drawn records")
@pytest.mark.parametrize("method", ["welch", "multitaper"])
def test_tapers_of_unequal_records(method):
    # Of a load that pushes: its own force is what their covariance is for.
    frequency = np.geomspace(0.4, 15.0, 10)
    covered, errors = [], []
    for seed in range(12):
        rng = np.random.default_rng([seed, 5])
        recordings = [recorded(noise(rng, n, t), rng, own=0.3, instruments=1.0) for n, t in ((2, 25.0), (1, 41.0))]
        found = response(recordings, method, frequency)
        covered.append(found.covers(TRUE["arm"](frequency)).mean())
        errors.append(
            np.abs(found.response - TRUE["arm"](frequency))
            / np.abs(TRUE["arm"](frequency)).max(axis=(1, 2), keepdims=True)
        )
    assert 0.90 <= np.mean(covered) <= 0.98
    assert np.abs(np.median(errors)) < 0.1


def test_tapers_against_scipy():
    # One trial, one segmentation: Welch's cross-spectra by another library function.
    rng = np.random.default_rng(13)
    recording = recorded(noise(rng, 1, 40.0), rng)
    d, f, x = (recording[name].values[0] for name in ("perturbation", "force", "displacement"))
    n = round(5.12 * RATE)

    def cross(u, y):
        return signal.csd(u[:, :, None], y[:, None], RATE, nperseg=n, axis=0)[1]

    own = np.fft.rfftfreq(n, 1 / RATE)[10:60]
    arm = np.linalg.solve(cross(d, f), cross(d, x)).swapaxes(1, 2)[10:60]
    np.testing.assert_allclose(response(recording, "welch", own).response, arm, rtol=1e-9)


@pytest.mark.slow(reason="repeats estimates on drawn records")
@pytest.mark.parametrize(
    ("draw", "estimate"),
    [(multisine, estimate_multisine), (noise, partial(estimate_noise, frequency=np.geomspace(0.4, 19.9, 16)))],
    ids=["multisine", "noise"],
)
def test_coverage(draw, estimate):
    # Over 200 seeds: `benchmarks.frequency_response`.
    covered = []
    for seed in range(16):
        rng = np.random.default_rng([seed, 3])
        found = estimate(recorded(draw(rng, 2, 28.0), rng, own=0.3, instruments=1.0))
        used = found.frequency < 20.0
        covered.append(found.covers(TRUE["arm"](found.frequency))[used].mean())
    assert 0.90 <= np.mean(covered) <= 0.98


def test_a_longer_record_says_more():
    def variance(duration):
        rng = np.random.default_rng(4)
        recording = recorded(multisine(rng, 4, 34.0), rng, own=0.3, instruments=1.0)
        recording = recording.isel(time=slice(0, round(duration * RATE)))
        return np.median(estimate_multisine(recording, period=PERIOD).covariance, axis=0).mean()

    # 11.5 s of 20.48 s twice: noise falls to 0.72 if nothing is lost.
    assert 0.55 < variance(34.0) / variance(22.5) < 0.9


def test_transients_do_not_bias():
    rng = np.random.default_rng(5)
    force = multisine(rng, 4, 32.0)
    from_rest = estimate_multisine(recorded(force, rng), window_start=0.0)
    assert worst(from_rest, "arm") < 0.02


def test_local_fit_of_polynomials_is_exact():
    rng = np.random.default_rng(6)
    frequency = np.linspace(0.8, 1.3, 25)

    def draw(*shape):
        return rng.normal(size=shape) + 1j * rng.normal(size=shape)

    level, slope, leakage = draw(4, 2), draw(4, 2), draw(2, 3, 4)
    windows = []
    for of_trial in leakage:
        d, r = draw(25, 2), (frequency - 1.0)[:, None]
        z = d @ level.T + r * (d @ slope.T) + of_trial[0] + r * of_trial[1] + r**2 * of_trial[2]
        windows.append(Window(frequency, d, z, np.ones(25, dtype=bool)))
    fit = fit_locally(windows, 1.0, order=1, leakage_order=2)
    np.testing.assert_allclose(fit.answer, level, rtol=1e-9)
    assert fit.dof == pytest.approx(50 - 2 * 2 - 2 * 3)
    assert np.abs(fit.noise).max() < 1e-20


def test_radius_holds_the_stated_share():
    rng = np.random.default_rng(7)
    n, dof = 40000, 5
    error = (rng.normal(size=n) + 1j * rng.normal(size=n)) / np.sqrt(2)
    variance = rng.gamma(dof, 1.0 / dof, size=n)  # as a sample variance of so many complex samples
    few = FrequencyResponse(
        frequency=np.ones(n),
        response=error[:, None, None],
        covariance=variance[:, None, None],
        what="arm",
        dof=np.full(n, float(dof)),
    )
    exact = FrequencyResponse(
        frequency=np.ones(n), response=error[:, None, None], covariance=np.ones((n, 1, 1)), what="arm"
    )
    for found in (few, exact):
        assert found.covers(np.zeros((n, 1, 1))).mean() == pytest.approx(0.95, abs=0.005)


def test_bands_touch_the_circle():
    found = FrequencyResponse(
        frequency=np.array([1.0, 2.0]),
        response=np.array([3.0 + 4.0j, 0.1])[:, None, None],
        covariance=np.array([0.25, 1.0])[:, None, None],
        what="arm",
    )
    circle = found.response[0] + found.radius()[0] * np.exp(1j * np.linspace(0, 2 * np.pi, 100001))
    bands = found.bands()
    np.testing.assert_allclose(
        [values[0].item() for values in bands],
        [np.abs(circle).min(), np.abs(circle).max(), np.angle(circle).min(), np.angle(circle).max()],
        rtol=1e-6,
    )
    assert bands.gain_low[1] == 0.0
    assert bands.phase_high[1] - bands.phase_low[1] == pytest.approx(2 * np.pi)


@pytest.mark.slow(reason="estimates many spectra")
def test_bad_input_is_refused(excited):
    recording, _ = excited["clusters"]
    with pytest.raises(ValueError, match=r"does not repeat after 5\.12 s"):
        estimate_multisine(recording, period=5.12)
    with pytest.raises(ValueError, match=r"holds 12 s from 20 s on; expected a whole period of 20\.48 s"):
        estimate_multisine(recording, window_start=20.0, period=PERIOD)
    with pytest.raises(ValueError, match=r"hold 0 independent spectra with 40 s of Welch's segments"):
        response(recording, "welch", segment=40.0)
    with pytest.raises(ValueError, match=r"hold 0 independent spectra with a half bandwidth of 0\.01 Hz"):
        response(recording, "multitaper", half_bandwidth=0.01)
    same = recording.copy(deep=True)
    same["perturbation"][..., 1] = same["perturbation"][..., 0]
    # More lines per average would not help.
    with pytest.raises(
        ValueError, match=r"not independent.*\(other realisations, one trial for .* direction, or the sign"
    ):
        estimate_multisine(same)
    with pytest.raises(ValueError, match="what = 'hand'; expected one of arm, environment, total"):
        estimate_multisine(recording, what="hand")
    with pytest.raises(ValueError, match=r"force of trial 0 is constant from 2 s on"):
        estimate_multisine(recording.assign(force=0.0 * recording["force"]))
    with pytest.raises(ValueError, match=r"trial 0 reached the workspace limit at 3\.000 s"):
        estimate_noise(recording.assign_coords(limit_time=("trial", np.full(4, 3.0))))
    with pytest.raises(ValueError, match="too few lines around"):
        estimate_noise(recording.isel(trial=[0], time=slice(0, 20)), frequency=np.array([10.0]))
    with pytest.raises(ValueError, match="recordings is empty"):
        estimate_noise([])
    with pytest.raises(ValueError, match="covariance = None"):
        FrequencyResponse(
            frequency=np.ones(1), response=np.ones((1, 2, 2), complex), covariance=None, what="arm"
        ).radius()


@pytest.mark.parametrize(("spread", "lowest", "highest"), [(0.0, 0.93, 0.99), (3.0, 0.9, 0.995)])
def test_variance_holds_what_differs_between_trials(spread, lowest, highest):
    """Errors of noise and of one factor on the response of each trial, smooth in frequency, drawn without the fit."""
    rng, frequency, n_trials = np.random.default_rng(4), np.geomspace(0.5, 20.0, 24), 5
    shape = (np.exp(1j * np.log(frequency)) * np.linspace(0.2, 1.0, len(frequency)))[:, None, None] * np.ones((1, 2, 2))
    held, held_by_noise = [], []
    for _ in range(150):
        noise = rng.normal(size=(n_trials, 24, 2, 2, 2)) @ [1.0, 1.0j] / np.sqrt(2.0)
        each = (noise + spread * rng.normal(size=(n_trials, 1, 1, 1)) * shape) / n_trials
        error, added = each.sum(axis=0), each - each.mean(axis=0)
        variance, dof = np.full((24, 2, 2), 1.0 / n_trials), np.full(24, 50.0)
        with_them = with_differences(frequency, variance, dof, list(added.swapaxes(0, 1)))
        for counts, (size, freedom) in ((held_by_noise, (variance, dof)), (held, with_them)):
            made = FrequencyResponse(frequency=frequency, response=error, covariance=size, what="arm", dof=freedom)
            counts.append(made.covers(np.zeros_like(error)).mean())
    assert lowest < np.mean(held) < highest
    if spread:
        assert np.mean(held_by_noise) < 0.75
