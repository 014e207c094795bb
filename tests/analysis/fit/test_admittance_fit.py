"""Fits to frequency responses whose parameters are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.fit.admittance_fit import fit_admittance
from armperturb.analysis.fit.admittance_problem import Target, checked_problem, penalty_factor
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.cohort import draw_subject
from armperturb.environment import Environment
from armperturb.study.report.tables import true_value
from armperturb.subject import POSITION, RELAX

ENVIRONMENT = Environment()
# The mean frequencies of the thesis's clusters, rounded.
FREQUENCY = np.array([0.3, 0.7, 1.1, 1.4, 1.9, 2.2, 2.6, 3.1, 3.7, 4.3, 5.1, 6.1, 7.2, 10.1, 14.2, 20.0, 28.3, 39.9])
CASES = pytest.mark.parametrize(("model", "arm"), [("1", RELAX), ("3b", POSITION)], ids=["1", "3b"])


def fit(arm, model, **options):
    admittance = arm_admittance(arm, FREQUENCY, options.get("delay", "exact"))
    return fit_admittance(FREQUENCY, admittance, arm, model, ENVIRONMENT, **options)


def truth_of(arm, model):
    return {name: true_value(arm, name) for name in STRUCTURES[model].free}


def worst_error(result, truth):
    return max(abs(result.values[name] / value - 1) for name, value in truth.items())


@pytest.mark.slow(reason="fits from twelve starts")
@pytest.mark.parametrize("delay", ["exact", "pade"])
@CASES
def test_own_response_gives_every_parameter_back_from_starts_25_percent_off(model, arm, delay):
    rng, truth = np.random.default_rng(7), truth_of(arm, model)
    for _ in range(12):
        start = {
            name: float(np.clip(value * rng.choice([0.75, 1.25]), *STRUCTURES[model].bounds[name]))
            for name, value in truth.items()
        }
        result = fit(arm, model, initial=start, delay=delay)
        assert worst_error(result, truth) < 1e-3
        assert result.converged
        assert result.status.startswith("converged: ")
        assert result.stable
        assert result.criterion < 1e-12
        assert result.at_bound == ()


@pytest.mark.slow(reason="fits drawn people")
@pytest.mark.parametrize(("model", "preset"), [("1", "relax"), ("3b", "position")])
def test_drawn_people_are_given_back_from_the_published_start(model, preset):
    for seed in range(8):
        arm = draw_subject(preset, seed)
        truth = truth_of(arm, model)
        inside = all(low < truth[name] < high for name, (low, high) in STRUCTURES[model].bounds.items())
        result = fit(arm, model)
        assert not inside or worst_error(result, truth) < 1e-3
        assert result.stable


def test_arms_close_to_instability_are_given_back_as_well():
    for factor in (1.5, 1.55, 1.6):
        gains = {name: factor * getattr(POSITION, name) for name in ("kv_s", "kv_se", "kv_e")}
        arm = replace(POSITION, **gains)
        assert -0.5 < largest_real_pole(arm, ENVIRONMENT) < 0
        assert worst_error(fit(arm, "3b"), truth_of(arm, "3b")) < 1e-3


@CASES
def test_criterion_is_the_mean_squared_weighted_log_error(model, arm):
    rng = np.random.default_rng(1)
    admittance = arm_admittance(arm, FREQUENCY) * np.exp(0.1 * rng.normal(size=(len(FREQUENCY), 2, 2)))
    coherence = rng.uniform(0.5, 1.0, (len(FREQUENCY), 2))
    result = fit_admittance(FREQUENCY, admittance, arm, model, ENVIRONMENT, coherence=coherence)
    error = np.sqrt(coherence)[:, :, None] * np.abs(np.log(admittance / arm_admittance(result.arm, FREQUENCY)))
    assert result.criterion == pytest.approx(np.mean(error**2) * result.penalty**2)
    # No neighbour is better: the criterion is at a minimum.
    for name, value in result.values.items():
        if name in result.at_bound:
            continue
        for factor in (0.99, 1.01):
            moved = STRUCTURES[model].arm(arm, list({**result.values, name: value * factor}.values()))
            other = np.sqrt(coherence)[:, :, None] * np.abs(np.log(admittance / arm_admittance(moved, FREQUENCY)))
            penalty = penalty_factor(largest_real_pole(moved, ENVIRONMENT))
            assert np.mean(other**2) * penalty**2 > result.criterion


def test_penalty_is_that_of_figure_c1():
    assert penalty_factor(-0.5) == pytest.approx(11.0)
    assert penalty_factor(-0.8) == pytest.approx(1.01)
    assert penalty_factor(-0.4) == pytest.approx(101.0)
    assert np.isfinite(penalty_factor(1e3))


@pytest.mark.parametrize("with_penalty", [False, True])
@CASES
def test_jacobian_equals_finite_differences(model, arm, with_penalty):
    slow = replace(arm, kv_s=arm.kv_s * 1.9) if model == "3b" else replace(arm, k_s=3.0, m_f=3.5)
    admittance = arm_admittance(arm, FREQUENCY)
    target = Target(frequency=FREQUENCY, admittance=admittance, body=arm, environment=ENVIRONMENT)
    problem = checked_problem(target, STRUCTURES[model], "exact")
    values = np.array(list(truth_of(slow, model).values()))
    numerical = optimize.approx_fprime(values, lambda v: problem.residual(v, with_penalty), 1e-6 * values)
    exact = problem.jacobian(values, with_penalty)
    n = 8 * len(FREQUENCY)  # the row beyond is the penalty's curvature
    scale = np.abs(exact[:n]).max(axis=0)
    np.testing.assert_allclose(exact[:n] / scale, numerical[:n] / scale, atol=1e-3)
    assert not numerical[n:].any()
    if with_penalty:
        assert problem.penalty(values) > 1.001


@pytest.mark.slow(reason="fits from many starts")
def test_fits_at_the_border_of_stability_converge():
    rng = np.random.default_rng(2)
    wild = replace(POSITION, kv_s=1.6 * POSITION.kv_s)
    admittance = arm_admittance(wild, FREQUENCY) * np.exp(0.1 * rng.normal(size=(len(FREQUENCY), 2, 2)))
    result = fit_admittance(FREQUENCY, admittance, wild, "3b", ENVIRONMENT)
    assert result.penalty > 1.001
    assert result.converged
    assert result.criterion < 0.0395  # without the penalty's curvature: 0.043 after 1000 evaluations


@pytest.mark.slow(reason="fits noisy responses")
def test_standard_errors_cover_the_truth_of_noisy_responses():
    rng, truth, ratios = np.random.default_rng(3), truth_of(RELAX, "1"), []
    for _ in range(24):
        noise = 0.02 * (rng.normal(size=(len(FREQUENCY), 2, 2)) + 1j * rng.normal(size=(len(FREQUENCY), 2, 2)))
        admittance = arm_admittance(RELAX, FREQUENCY) * np.exp(noise)
        result = fit_admittance(FREQUENCY, admittance, RELAX, "1", ENVIRONMENT)
        ratios.append([(result.values[name] - value) / result.sem[name] for name, value in truth.items()])
    # Eq. 2.22 with moduli is twice the scatter: N counts complex errors, and the modulus keeps half of what they say.
    spread = np.sqrt(np.mean(np.square(ratios)))
    assert spread == pytest.approx(0.5, rel=0.15)


def test_standard_errors_are_eq_2_22_of_the_modulus():
    rng, structure = np.random.default_rng(5), STRUCTURES["3b"]
    admittance = arm_admittance(POSITION, FREQUENCY) * np.exp(0.2 * rng.normal(size=(len(FREQUENCY), 2, 2)))
    coherence = rng.uniform(0.5, 1.0, (len(FREQUENCY), 2))
    result = fit_admittance(FREQUENCY, admittance, POSITION, structure, ENVIRONMENT, coherence=coherence)

    def error(values):
        model = arm_admittance(structure.arm(POSITION, values), FREQUENCY)
        return (np.sqrt(coherence)[:, :, None] * np.abs(np.log(admittance / model))).ravel()

    values = np.array(list(result.values.values()))
    jacobian = optimize.approx_fprime(values, error, 1e-6 * np.maximum(values, 1.0))
    n = 4 * len(FREQUENCY)
    expected = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)) * (error(values) @ error(values)) / n)
    np.testing.assert_allclose(list(result.sem.values()), expected, rtol=2e-3)


def test_parameters_at_a_bound_are_named():
    result = fit(replace(RELAX, m_h=0.7), "1")
    assert "m_h" in result.at_bound
    assert result.values["m_h"] == pytest.approx(1.0)


def test_penalty_makes_an_unstable_arm_stable_and_says_so():
    wild = replace(POSITION, kv_s=40.0, kv_e=60.0)
    assert largest_real_pole(wild, ENVIRONMENT) > 0
    without, with_penalty = (fit(wild, "3b", use_penalty=use) for use in (False, True))
    assert not without.stable
    assert worst_error(without, truth_of(wild, "3b")) < 1e-3
    assert with_penalty.stable
    assert with_penalty.penalty > 1.0


def test_structures_that_no_admittance_can_tell_apart_are_refused_with_the_direction():
    admittance = arm_admittance(POSITION, FREQUENCY)
    with pytest.raises(ValueError, match=r"cannot be identified from 2 frequencies: .* of k_s.* of kp_s"):
        fit_admittance([1e-4, 2e-4], admittance[:2], POSITION, "3b", ENVIRONMENT)
    no_gain = STRUCTURES["1"].freeing(Td_s=(0.01, 0.03, 0.05))
    with pytest.raises(ValueError, match=r"variant cannot be identified .*: \+1 s of Td_s change no response"):
        fit_admittance(FREQUENCY, admittance, POSITION, no_gain, ENVIRONMENT)


def test_what_the_data_say_nothing_about_is_said_and_has_an_infinite_error():
    # The delay acts through a gain, and the best one is none.
    structure = STRUCTURES["1"].freeing(kv_s=(-50.0, 0.0, 50.0), Td_s=(0.01, 0.03, 0.05))
    start = {name: getattr(RELAX, name) for name in structure.free}
    admittance = arm_admittance(RELAX, FREQUENCY)
    result = fit_admittance(FREQUENCY, admittance, RELAX, structure, ENVIRONMENT, initial=start, as_published=True)
    assert result.unidentified == ("Td_s",)
    assert result.status.endswith("; the data say nothing about Td_s")
    assert result.sem["Td_s"] == np.inf
    assert np.isfinite(result.sem["k_s"])


@pytest.mark.slow(reason="fits with SciPy's differences")
@pytest.mark.parametrize("use_penalty", [False, True])
def test_as_published_is_lsqnonlin_on_the_modulus_from_one_start(use_penalty):
    # Of this seed the search ends after 46 evaluations, a thousandth from the minimum.
    rng, structure = np.random.default_rng(2), STRUCTURES["3b"]
    admittance = arm_admittance(POSITION, FREQUENCY, "pade") * np.exp(0.4 * rng.normal(size=(len(FREQUENCY), 2, 2)))
    start = np.array(list(structure.initial.values()))
    lower, upper = np.array(list(structure.bounds.values())).T / start[:, None].T

    def error(v):
        arm = structure.arm(POSITION, v * start)
        penalty = penalty_factor(largest_real_pole(arm, ENVIRONMENT)) if use_penalty else 1.0
        return np.abs(np.log(admittance / arm_admittance(arm, FREQUENCY, "pade"))).ravel() * penalty

    # One-sided differences would lead along another path on each processor.
    tolerances = {"ftol": 1e-5, "xtol": 1e-6, "gtol": None}
    expected = optimize.least_squares(
        error, np.ones(13), jac="3-point", bounds=(lower, upper), diff_step=1e-5, max_nfev=428, **tolerances
    )
    result = fit_admittance(
        FREQUENCY, admittance, POSITION, "3b", ENVIRONMENT, as_published=True, use_penalty=use_penalty, delay="pade"
    )
    assert result.criterion * 72 == pytest.approx(2 * expected.cost, rel=1e-4)
    best = fit_admittance(FREQUENCY, admittance, POSITION, "3b", ENVIRONMENT, use_penalty=use_penalty, delay="pade")
    assert best.criterion <= result.criterion


@pytest.mark.parametrize("model", ["2", "3", "4", "5", "6", "3a"])
def test_every_structure_gives_its_own_response_back(model):
    structure = STRUCTURES[model]
    arm = structure.arm(POSITION, list(structure.initial.values()))
    start = {name: float(np.clip(1.1 * value, *structure.bounds[name])) for name, value in structure.initial.items()}
    result = fit_admittance(
        FREQUENCY, arm_admittance(arm, FREQUENCY), arm, model, ENVIRONMENT, initial=start, use_penalty=False
    )
    assert result.criterion < 1e-9, result.status
    np.testing.assert_allclose(list(result.values.values()), list(structure.initial.values()), rtol=0.02, atol=0.05)


def test_an_admittance_without_inverse_is_fitted_all_the_same():
    admittance = arm_admittance(RELAX, FREQUENCY)
    admittance[3] = np.ones((2, 2)) * admittance[3, 0, 0]
    result = fit_admittance(FREQUENCY, admittance, RELAX, "1", ENVIRONMENT)
    assert result.criterion > 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"structure": "7"}, "model = '7'; expected one of 1, 2, 3, 4, 5, 6, 3a, 3b"),
        ({"initial": {"m_x": 1.0}}, "initial: unknown parameter 'm_x'; model 1 has m_h"),
        ({"initial": {"m_h": 9.0}}, "initial: m_h = 9.0; expected 1 to 3 kg"),
        ({"frequency": FREQUENCY[:3]}, r"shapes \(3,\), \(18, 2, 2\)"),
        ({"frequency": FREQUENCY - 1.0}, "frequency = -0.7 Hz; expected frequencies above 0"),
        ({"coherence": np.full((18, 2), np.nan)}, "coherence holds nan; expected finite values"),
        ({"delay": "none"}, "delay = 'none'; expected one of exact, pade"),
        ({"coherence": np.full((18, 2), 1.5)}, "coherence from 1.5 to 1.5; expected 0 to 1"),
        ({"admittance": np.full((18, 2, 2), np.inf)}, r"admittance holds .*inf.*; expected finite values"),
        ({"admittance": np.zeros((18, 2, 2))}, "admittance at 0.3 Hz is 0; expected a response"),
    ],
)
def test_bad_input_is_named(change, message):
    arguments = {
        "frequency": FREQUENCY,
        "admittance": arm_admittance(RELAX, FREQUENCY),
        "body": RELAX,
        "structure": "1",
        "environment": ENVIRONMENT,
    }
    with pytest.raises(ValueError, match=message):
        fit_admittance(**{**arguments, **change})
