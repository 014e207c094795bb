from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from armperturb.analysis.force_balance import EDGE, Balance
from armperturb.analysis.smoother import NoiseLevels
from armperturb.environment import Environment

RATE, N_SAMPLES, N_TRIALS = 200.0, 6000, 4
ENVIRONMENT = Environment(m_env=3.1, b_env=1.4, k_env=25.0)
LEVELS = NoiseLevels(force=0.02, displacement=8e-6)
INNER = slice(round(EDGE * RATE), -round(EDGE * RATE))


def moving(seed, late=0.0, environment=ENVIRONMENT):
    """A handle that starts at rest and is amid movement at the end [m], and the force that this takes, late [N]."""
    rng = np.random.default_rng(seed)
    n = 2 * N_SAMPLES
    frequency = np.fft.rfftfreq(n, 1 / RATE)
    smooth = (frequency > 0.1) & (frequency < 42.0)
    random = rng.normal(size=(2, len(frequency), N_TRIALS * 2)) * (smooth / (1.0 + (frequency / 1.5) ** 2))[:, None]
    time = np.arange(n) / RATE
    fade = np.clip(np.minimum(time, 60.0 - time), 0.0, 1.0)
    path = 2.0 * np.fft.irfft(random[0] + 1j * random[1], n, axis=0) * (0.5 - 0.5 * np.cos(np.pi * fade))[:, None]
    s = 2j * np.pi * frequency[:, None]
    impedance = (environment.m_env * s**2 + environment.b_env * s + environment.k_env) * np.exp(-s * late)
    load = np.fft.irfft(impedance * np.fft.rfft(path, axis=0), n, axis=0)
    return tuple(values[:N_SAMPLES].reshape(N_SAMPLES, N_TRIALS, 2).swapaxes(0, 1) for values in (path, load))


def recorded(seed, late=0.0, levels=LEVELS):
    """Balance of noisy signals, and the true path [m]; some of the load is d, the rest -f."""
    path, load = moving(seed, late)
    rng = np.random.default_rng([seed, 1])
    d = rng.normal(size=load.shape)
    force = d - load + levels.force * rng.normal(size=load.shape)
    return Balance(d, force, path + levels.displacement * rng.normal(size=path.shape), RATE), path


@pytest.fixture(scope="module")
def balances():
    return [recorded(seed) for seed in range(12)]


@pytest.mark.slow(reason="balances many recordings")
def test_environment_and_noise_of_both_instruments_come_out_of_the_balance(balances):
    found = [balance.fit() for balance, _ in balances]
    for environment, levels in found:
        assert environment.m_env == pytest.approx(ENVIRONMENT.m_env, rel=5e-4)
        assert environment.b_env == pytest.approx(ENVIRONMENT.b_env, rel=0.03)
        assert environment.k_env == pytest.approx(ENVIRONMENT.k_env, rel=0.01)
        assert levels.force == pytest.approx(LEVELS.force, rel=0.15)
        assert levels.displacement == pytest.approx(LEVELS.displacement, rel=0.03)
    assert np.mean([levels.force for _, levels in found]) == pytest.approx(LEVELS.force, rel=0.04)
    scatter = np.std([[environment.m_env, environment.b_env, environment.k_env] for environment, _ in found], axis=0)
    covariance = np.mean(
        [balance.covariance(*each) for (balance, _), each in zip(balances, found, strict=True)], axis=0
    )
    assert scatter == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.5)  # of twelve recordings
    # No bias: least squares would make the mass too small by more than this.
    mass = np.array([environment.m_env for environment, _ in found])
    assert abs(mass.mean() - ENVIRONMENT.m_env) < 3 * mass.std(ddof=1) / np.sqrt(len(mass))


@pytest.mark.parametrize("gauge", [0.2, 2.0])
def test_noise_levels_hold_for_other_instruments(gauge):
    levels = NoiseLevels(force=gauge, displacement=3e-5)
    found = recorded(0, levels=levels)[0].fit()[1]
    assert found.force == pytest.approx(levels.force, rel=0.15)
    assert found.displacement == pytest.approx(levels.displacement, rel=0.05)


@pytest.mark.slow(reason="balances many recordings")
def test_combined_displacement_has_the_variance_of_theory_and_is_better_than_either_instrument(balances):
    frequency = np.fft.rfftfreq(N_SAMPLES - 2 * round(EDGE * RATE), 1 / RATE)[1:]
    s = 2j * np.pi * frequency
    impedance = ENVIRONMENT.m_env * s**2 + ENVIRONMENT.b_env * s + ENVIRONMENT.k_env
    gauge = LEVELS.force**2 / np.abs(impedance) ** 2  # as a meter of displacement
    theory = 1.0 / (1.0 / gauge + 1.0 / LEVELS.displacement**2)
    power = np.zeros(len(frequency))
    for balance, path in balances:
        error = (balance.displacement(*balance.fit()) - path)[:, INNER]
        taper = np.hanning(error.shape[1])
        spectrum = np.fft.rfft(error * taper[:, None], axis=1)[:, 1:] / np.linalg.norm(taper)
        power += np.mean(np.abs(spectrum) ** 2, axis=(0, 2)) / len(balances)
    for low, high in ((1, 3), (3, 6), (6, 12), (12, 25), (25, 40)):
        band = (frequency > low) & (frequency < high)
        assert power[band].mean() == pytest.approx(theory[band].mean(), rel=0.05)
        assert power[band].mean() < 1.03 * min(gauge[band].mean(), LEVELS.displacement**2)
    band = (frequency > 6) & (frequency < 12)
    assert power[band].mean() < 0.9 * min(gauge[band].mean(), LEVELS.displacement**2)
    assert power[frequency > 35].mean() < (LEVELS.displacement / 25) ** 2


STIFF = Environment(m_env=8.0, b_env=2.0, k_env=2000.0)


@pytest.mark.parametrize(
    ("environment", "levels"),
    [
        (ENVIRONMENT, NoiseLevels(force=0.02, displacement=4e-5)),
        (ENVIRONMENT, NoiseLevels(force=1.0, displacement=2e-6)),
        (replace(ENVIRONMENT, b_env=200.0), NoiseLevels(force=0.02, displacement=4e-5)),
        (STIFF, NoiseLevels(force=0.005, displacement=1e-5)),
    ],
)
@pytest.mark.parametrize("first", [0, 1000])
def test_the_combined_displacement_is_as_good_at_both_ends_as_amid(environment, levels, first):
    """Whether a record begins at rest or amid the movement, on whose way it ends."""
    path, load = (signal[:, first : first + 4000] for signal in moving(0, environment=environment))
    rng = np.random.default_rng(1)
    noisy = path + levels.displacement * rng.normal(size=path.shape)
    balance = Balance(np.zeros_like(load), levels.force * rng.normal(size=load.shape) - load, noisy, RATE)
    error = np.sqrt(np.mean((balance.displacement(environment, levels) - path) ** 2, axis=(0, 2)))
    amid = np.sqrt(np.mean(error[1000:3000] ** 2))
    for end in (error[:40], error[40:200], error[-200:-40], error[-40:]):
        assert np.sqrt(np.mean(end**2)) < min(2.5 * amid, 1.2 * levels.displacement)
    assert error.max() < 2.0 * levels.displacement


@pytest.mark.parametrize(
    ("environment", "levels"),
    [
        (ENVIRONMENT, NoiseLevels(force=1e-12, displacement=1e-5)),
        (Environment(m_env=2.0, b_env=0.0, k_env=500.0), NoiseLevels(force=0.002, displacement=1e-3)),
        (Environment(m_env=0.5, b_env=60.0, k_env=50.0), NoiseLevels(force=0.001, displacement=1e-4)),
        (Environment(m_env=2.0, b_env=5.0, k_env=0.0), NoiseLevels(force=1e-4, displacement=1e-4)),
    ],
)
def test_ends_that_reach_each_other_are_told_apart(environment, levels):
    """On manipulators that swing or creep for longer than the record lasts."""
    path, load = (signal[:, 1000:2200] for signal in moving(0, environment=environment))
    rng = np.random.default_rng(1)
    noisy = path + levels.displacement * rng.normal(size=path.shape)
    balance = Balance(np.zeros_like(load), levels.force * rng.normal(size=load.shape) - load, noisy, RATE)
    error = np.sqrt(np.mean((balance.displacement(environment, levels) - path) ** 2))
    assert error < 0.2 * levels.displacement


@pytest.mark.parametrize(
    ("environment", "levels"),
    [
        (replace(ENVIRONMENT, m_env=15.0), NoiseLevels(force=0.05, displacement=3e-4)),
        (replace(ENVIRONMENT, m_env=0.5), NoiseLevels(force=0.5, displacement=2e-6)),
        (STIFF, NoiseLevels(force=0.05, displacement=3e-4)),
    ],
)
def test_noisy_instruments_are_no_wrong_sign(environment, levels):
    path, load = moving(0, environment=environment)
    rng = np.random.default_rng(2)
    d = 0.5 * load
    x, f = (of + sd * rng.normal(size=of.shape) for of, sd in ((path, levels.displacement), (d - load, levels.force)))
    balance = Balance(d, f, x, RATE)
    found, noise = balance.fit()
    assert found.m_env == pytest.approx(environment.m_env, rel=0.02)
    assert noise.force == pytest.approx(levels.force, rel=0.5)
    assert balance.unexplained(found) < 0.02
    with pytest.raises(ValueError, match="force must be the reaction force"):
        Balance(d, load + d + levels.force * rng.normal(size=load.shape), x, RATE).fit()


@pytest.mark.slow(reason="balances many recordings")
def test_skew_of_the_clocks_is_measured(balances):
    none = np.array([balance.skew(*balance.fit()) for balance, _ in balances])
    assert np.sqrt(np.mean((none[:, 0] / none[:, 1]) ** 2)) == pytest.approx(1.0, abs=0.5)
    assert none[:, 1].max() < 2e-5
    for late in (-2e-4, 2e-4, 1e-3):
        balance, _ = recorded(0, late)
        skew = balance.skew(*balance.fit())
        assert skew.time == pytest.approx(late, rel=0.02, abs=4 * skew.standard_error)
        assert abs(skew.time) > 10 * skew.standard_error


def test_perfect_instruments_are_taken_as_they_are():
    balance, path = recorded(0, levels=NoiseLevels(0.0, 0.0))
    environment, levels = balance.fit()
    assert environment.m_env == pytest.approx(ENVIRONMENT.m_env, rel=1e-6)
    assert levels.force < 1e-5
    # Also at the end, where the record breaks off amid movement.
    assert np.abs(balance.displacement(environment, levels) - path).max() < 2e-4 * np.abs(path).max()
    assert abs(balance.skew(environment, levels).time) < 1e-7


@pytest.mark.slow(reason="draws many records")
@pytest.mark.parametrize("cutoff", [None, 40.0])
def test_frequencies_without_noise_are_no_good_instruments(cutoff):
    """Of recordings at a higher rate than their noise reaches, resampled or low-passed."""
    path, load = moving(0)
    rng = np.random.default_rng(1)
    signals = [rng.normal(size=load.shape), path + LEVELS.displacement * rng.normal(size=path.shape)]
    signals.insert(1, signals[0] - load + LEVELS.force * rng.normal(size=load.shape))
    signals = [signal.resample_poly(each, 10, 1, axis=1, padtype="line") for each in signals]
    if cutoff is not None:
        low_pass = signal.butter(2, cutoff, fs=10 * RATE, output="sos")
        signals = [signal.sosfiltfilt(low_pass, each, axis=1) for each in signals]
    environment, _ = Balance(*signals, 10 * RATE).fit()
    assert environment.m_env == pytest.approx(ENVIRONMENT.m_env, rel=2e-3)
    assert environment.k_env == pytest.approx(ENVIRONMENT.k_env, rel=0.03)


def test_what_is_no_balance_is_refused():
    path, load = moving(0)
    with pytest.raises(ValueError, match=r"mass comes out at -.*expected a positive mass"):
        Balance(load * 0, load, path, RATE).fit()
    with pytest.raises(ValueError, match=r"lasts 4 s; expected at least 5 s"):
        Balance(load[:, :800], load[:, :800], path[:, :800], RATE)
