from dataclasses import replace

import numpy as np
import pytest

from armperturb.analysis.arm.linear_arm import total_admittance
from armperturb.analysis.arm.parameters import parameter_vector
from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.analysis.fit import frequency_bands, whittle
from armperturb.analysis.fit import likelihood as likelihood_module
from armperturb.analysis.fit import total_admittance as total_admittance_module
from armperturb.analysis.fit.likelihood import PeriodLikelihood, RecordLikelihood, Signals, whitened, whitening
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.environment import Environment
from armperturb.perturbations import Multisine
from armperturb.subject import POSITION, RELAX

RATE, N_PERIOD, TOP = 200.0, 4096, 44.0
ENVIRONMENT = Environment()
FINE = 10  # times the rate at which an arm is simulated


def multisine(seed, n_samples, rate=RATE):
    return Multisine.draw(seed=seed, rms=1.0, crested=False, duration=n_samples / rate).sample(rate, n_samples, 0.0)


def moved(arm, n_samples, n_trials=1):
    """Disturbance and the displacement of the state-space model, which knows nothing of frequency responses."""
    fine = [multisine(seed, n_samples * FINE, RATE * FINE) for seed in range(n_trials)]
    path = [simulate_linear(arm, ENVIRONMENT, d, RATE * FINE).displacement[::FINE] for d in fine]
    return np.stack([d[::FINE] for d in fine]), np.stack(path)


def by_period(d, x, arm):
    steady = slice(8 * 200, 8 * 200 + 2 * N_PERIOD)
    return PeriodLikelihood(
        Signals(d[:, steady], d[:, steady], whitened(x, RATE)[:, steady], arm, ENVIRONMENT, RATE), N_PERIOD, TOP
    )


def by_record(d, x, arm, from_rest=True):
    return RecordLikelihood(Signals(d, d, whitened(x, RATE), arm, ENVIRONMENT, RATE), TOP, from_rest=from_rest)


def unexplained(likelihood, arm):
    """Share of the displacement that an arm does not explain [-], each frequency counting alike."""
    values = parameter_vector(arm)
    left, all_ = likelihood._residual(values), likelihood._observed
    return np.sqrt(np.mean(np.abs(left) ** 2) / np.mean(np.abs(all_) ** 2))


def noisy(arm, seed, kind=None, n_trials=4, shake=0.05):
    """Response to multisines and to a white force that the hand adds: a period, or from rest; (trial, time, axis)."""
    rng = np.random.default_rng([seed, 7])
    n = N_PERIOD if kind is by_period else 5600
    d = np.stack([multisine(1000 * seed + trial, n) for trial in range(n_trials)])
    n_padded = n if kind is by_period else 2 * n
    frequency = np.maximum(np.fft.rfftfreq(n_padded, 1 / RATE), 1e-6)
    force = np.fft.rfft(d + shake * rng.normal(size=d.shape), n_padded, axis=1)
    path = np.einsum("fij,tfj->tfi", total_admittance(arm, ENVIRONMENT, frequency), force)
    x = np.fft.irfft(path, n_padded, axis=1)[:, :n]
    white = whitened(np.concatenate([x[:, -2:], x], axis=1), RATE)[:, 2:] if kind is by_period else whitened(x, RATE)
    signals = Signals(d, d, white, arm, ENVIRONMENT, RATE)
    return PeriodLikelihood(signals, N_PERIOD, TOP) if kind is by_period else RecordLikelihood(signals, TOP)


@pytest.fixture(scope="module", params=[RELAX, POSITION], ids=lambda arm: arm.task)
def response(request):
    return request.param, *moved(request.param, 8 * 200 + 2 * N_PERIOD)


def test_filter_has_the_response_that_it_is_said_to_have():
    pulse = np.zeros((1, 4096, 1))
    pulse[0, 0] = 1.0
    frequency = np.fft.rfftfreq(4096, 1 / RATE)
    found = np.fft.rfft(whitened(pulse, RATE)[0, :, 0])
    np.testing.assert_allclose(found, whitening(frequency, RATE), atol=1e-9 * np.abs(found).max())


def test_whole_record_is_predicted_as_the_state_space_moves(response):
    arm, d, x = response
    assert unexplained(by_record(d, x, arm), arm) < 6e-3
    assert unexplained(by_record(d, x, arm), replace(arm, m_f=1.05 * arm.m_f)) > 12e-3


def test_period_is_predicted_as_the_state_space_moves_after_the_transient(response):
    arm, d, x = response
    assert unexplained(by_period(d, x, arm), arm) < 3e-3
    assert unexplained(by_period(d, x, arm), replace(arm, m_f=1.05 * arm.m_f)) > 6e-3


def test_what_came_before_a_record_is_taken_out_of_its_residual(response):
    arm, d, x = response
    late = slice(1000, None)
    d, x = d[:, late], x[:, late] + [2e-3, -1e-3]
    assert unexplained(by_record(d, x, arm), arm) > 0.03
    amid = by_record(d, x, arm, from_rest=False)
    assert unexplained(amid, arm) > 0.03
    amid.weigh(parameter_vector(arm))
    left, _ = amid._without_unknowns(parameter_vector(arm))
    assert np.sqrt(np.mean(np.abs(left) ** 2) / np.mean(np.abs(amid._observed) ** 2)) < 6e-3


@pytest.mark.parametrize("kind", [by_period, by_record])
def test_slope_and_information_are_the_derivatives_that_differences_show(kind):
    structure, arm = STRUCTURES["3"], POSITION
    likelihood = noisy(arm, 0, kind)
    free = np.array([getattr(arm, name) for name in structure.free]) * 1.02
    free[structure.free.index("fact_s")] = 2.5

    def parameters(values):
        return structure.parameters("PT", values)

    likelihood.weigh(parameters(free))
    found = likelihood.normal(parameters(free), structure.mixing)
    rows, slope = [], []
    for index, value in enumerate(free):
        ends = []
        for sign in (1, -1):
            there = free.copy()
            there[index] += sign * 1e-4 * value
            predicted = likelihood._predicted(parameters(there))
            white = np.einsum("abf,tbf->taf", likelihood._white, predicted).ravel()
            ends.append((likelihood.cost(parameters(there)), np.concatenate([white.real, white.imag])))
        slope.append(-0.5 * (ends[0][0] - ends[1][0]) / (2e-4 * value))
        rows.append((ends[0][1] - ends[1][1]) / (2e-4 * value))
    information = np.array(rows) @ np.array(rows).T
    scale = np.sqrt(np.diag(information))
    np.testing.assert_allclose(
        found.information / np.outer(scale, scale), information / np.outer(scale, scale), atol=1e-4
    )
    np.testing.assert_allclose(found.slope / scale, np.array(slope) / scale, atol=1e-3 * np.abs(slope / scale).max())
    assert found.cost == likelihood.cost(parameters(free))


@pytest.mark.slow(reason="repeats estimates on drawn records")
@pytest.mark.parametrize("kind", [by_period, by_record])
def test_residual_of_the_right_arm_is_white_and_its_lack_of_fit_chi_square(kind):
    fits, costs, wrong = [], [], []
    for seed in range(16):
        likelihood = noisy(RELAX, seed, kind)
        likelihood.weigh(parameter_vector(RELAX))
        fits.append(likelihood.lack_of_fit(parameter_vector(RELAX)))
        costs.append(likelihood.cost(parameter_vector(RELAX)) / (2 * likelihood._observed.size))
        other = parameter_vector(replace(RELAX, m_f=1.1 * RELAX.m_f))
        likelihood.weigh(other)
        wrong.append(likelihood.lack_of_fit(other).p_value)
    ratio = np.array([fit.chi2 / fit.dof for fit in fits])
    assert abs(ratio.mean() - 1.0) < 4 * np.sqrt(2 / fits[0].dof / len(fits)) + 0.03  # some of it weighs itself
    assert ratio.std() == pytest.approx(np.sqrt(2 / fits[0].dof), rel=0.5)
    assert min(fit.p_value for fit in fits) > 1e-4
    assert np.mean(costs) == pytest.approx(1.0, abs=0.05)
    assert max(wrong) < 1e-3


@pytest.mark.parametrize("kind", [by_period, by_record])
def test_the_right_arm_is_the_most_likely_whatever_the_noise_weighs(kind):
    likelihood = noisy(POSITION, 1, kind)
    best = likelihood.objective(parameter_vector(POSITION))
    for name in ("m_f", "b_e", "k_s", "kv_e", "kp_se"):
        for factor in (0.7, 1.3):
            other = replace(POSITION, **{name: factor * getattr(POSITION, name)})
            assert likelihood.objective(parameter_vector(other)) > best


@pytest.mark.parametrize("kind", [by_period, by_record])
@pytest.mark.parametrize("n_trials", [1, 4])
def test_no_noise_at_all_is_round_off(kind, n_trials):
    likelihood = noisy(POSITION, 0, kind, n_trials=n_trials, shake=0.0)
    assert np.isfinite(likelihood.objective(parameter_vector(POSITION)))
    likelihood._observed = likelihood._predicted(parameter_vector(POSITION))  # exactly nothing is left
    likelihood._latest = b"", likelihood._observed
    assert likelihood.objective(parameter_vector(POSITION)) < likelihood.objective(parameter_vector(RELAX))


# What was before a record is fitted by responses that nearly depend on each other, which magnifies rounding.
@pytest.mark.parametrize(("from_rest", "tolerance"), [(True, 1e-9), (False, 1e-8)])
def test_a_long_record_takes_less_memory_to_the_same_result(from_rest, tolerance, monkeypatch):
    structure, arm = STRUCTURES["3"], POSITION
    rng = np.random.default_rng(3)
    d = np.stack([multisine(trial, 3000) for trial in range(2)])
    x = simulate_linear(arm, ENVIRONMENT, d + 0.05 * rng.normal(size=d.shape), RATE).displacement
    free = np.array([getattr(arm, name) for name in structure.free]) * 1.02
    mixing = np.pad(structure.mixing, ((0, 0), (0, 3)))  # three parameters that move no arm, as gains of EMG

    def judged():
        likelihood, values = by_record(d, x, arm, from_rest), structure.parameters("PT", free)
        objective, normals = likelihood.objective(values), []
        for quick in (True, False):
            normals += likelihood.normal(values, mixing, quick=quick)
        return [objective, *normals]

    usual = judged()
    usual[-1] = usual[3]  # of long records the information is that of quick derivatives; slopes are those of all
    monkeypatch.setattr(total_admittance_module, "LONGEST_RUN", 100)
    monkeypatch.setattr(whittle, "LONGEST_RUN", 100)
    monkeypatch.setattr(total_admittance_module, "SHORTER_RUN", 60)
    monkeypatch.setattr(frequency_bands, "LARGEST_MATRIX", 1)
    monkeypatch.setattr(likelihood_module, "LONGEST_SIGNALS", 1)
    for found, expected in zip(judged(), usual, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("axes", [1, 2])
def test_a_step_takes_many_trials_together_to_the_same_result(axes):
    structure, arm = STRUCTURES["3"], POSITION
    rng = np.random.default_rng(4)
    d = np.stack([multisine(trial, 3000) for trial in range(4)]) * (np.arange(2) < axes)
    x = simulate_linear(arm, ENVIRONMENT, d + 0.05 * rng.normal(size=d.shape), RATE).displacement
    values = structure.parameters("PT", np.array([getattr(arm, name) for name in structure.free]) * 1.02)
    likelihood = by_record(d, x, arm)
    likelihood.weigh(values)
    found = likelihood.step_normal(values, structure.mixing)
    each = likelihood.normal(values, structure.mixing, quick=True)
    assert (len(found.slopes), len(each.slopes)) == (1, 4)
    assert found.cost == pytest.approx(each.cost)
    for name in ("slope", "information"):
        expected = getattr(each, name)
        np.testing.assert_allclose(getattr(found, name), expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_bands_of_any_number_of_frequencies_have_the_same_averages(monkeypatch):
    power = np.geomspace(1e12, 1.0, 3000)[:, None] * np.random.default_rng(0).random((3000, 2))
    wanted = np.arange(0, 3000, 7)
    usual = frequency_bands.Smoother(3000, 3, wanted)(power)
    monkeypatch.setattr(frequency_bands, "LARGEST_MATRIX", 1)
    np.testing.assert_allclose(frequency_bands.Smoother(3000, 3, wanted)(power), usual, rtol=1e-13)
