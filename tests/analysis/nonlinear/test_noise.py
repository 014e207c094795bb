"""Weights and draws of the noise against noise whose spectrum is known."""

import numpy as np
import pytest
from scipy import signal, stats

from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.analysis.nonlinear.draws import MOST_ATTEMPTS, borne, borne_ahead, is_borne, run_away
from armperturb.analysis.nonlinear.noise import Noise, NoiseDraws
from armperturb.environment import Environment
from armperturb.planar_arm.lanes import lane_table
from armperturb.planar_arm.simulation import Disturbances
from armperturb.subject import RELAX

RATE, N, N_TRIALS = 100.0, 3000, 8
SHAPE = signal.butter(2, 3.0, fs=RATE, output="sos")
MIXING = np.array([[1.0, 0.0], [0.6, 0.5]])
"""Of independent noises along the axes."""


@pytest.fixture(scope="module")
def forces():
    """Hand forces of coloured, correlated noise [N], (trial, time, axis)."""
    white = np.random.default_rng(0).standard_normal((N_TRIALS, N, 2))
    return signal.sosfilt(SHAPE, white, axis=1) @ MIXING.T


@pytest.fixture(scope="module")
def residual(forces):
    return simulate_linear(RELAX, Environment(), forces, RATE).displacement


@pytest.fixture
def noise(residual):
    found = Noise(RELAX, Environment(), N, N_TRIALS, RATE)
    found.weigh(residual)
    return found


def test_white_residuals_have_unit_variance_and_are_uncorrelated(noise, residual):
    white = noise.white(residual)
    n = white.shape[1] // 4  # of each axis, real and imaginary
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.05)
    x, y = np.moveaxis(white.reshape(N_TRIALS, 2, 2, n), 2, 0)
    assert abs(np.mean(x * y)) < 3.0 / np.sqrt(2 * N_TRIALS * n) + 0.01
    # At all frequencies alike, in spite of a spectrum that falls by orders of magnitude.
    power = np.mean(x**2 + y**2, axis=(0, 1)) / 2.0
    np.testing.assert_allclose([part.mean() for part in np.array_split(power[10:], 6)], 1.0, atol=0.15)


def test_other_draws_of_the_same_noise_are_as_white(noise):
    other = signal.sosfilt(SHAPE, np.random.default_rng(1).standard_normal((N_TRIALS, N, 2)), axis=1) @ MIXING.T
    white = noise.white(simulate_linear(RELAX, Environment(), other, RATE).displacement)
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.08)


def test_draws_move_the_handle_as_the_noise_does(noise, residual):
    rng = np.random.default_rng(2)
    strength, small = np.ones(len(noise.root)), 1e-3  # so small that the arm is linear
    torque = np.array([noise.torque(noise.root, strength, rng.standard_normal((N, 2))) for _ in range(20)])
    pushes = Disturbances(np.zeros_like(torque), RATE).with_torque(small * torque)
    lanes = lane_table([RELAX], [Environment()], pushes.timestep)
    draws = pushes.responses(np.repeat(lanes, len(torque)), np.arange(len(torque))) / small

    def spectra(signals):
        options = {"fs": RATE, "nperseg": 500, "axis": 1}
        frequency, auto = signal.welch(signals, **options)
        _, cross = signal.csd(signals[:, :, 0], signals[:, :, 1], **options)
        return frequency, np.column_stack([auto.mean(axis=0), cross.mean(axis=0).real])

    (frequency, found), (_, expected) = spectra(draws), spectra(residual)
    for low, high in ((0.4, 1.5), (1.5, 4.0), (4.0, 10.0), (10.0, 20.0)):
        band = (frequency >= low) & (frequency < high)
        (x, y, shared), (wanted_x, wanted_y, wanted) = (each[band].mean(axis=0) for each in (found, expected))
        np.testing.assert_allclose([x, y], [wanted_x, wanted_y], rtol=0.12)
        assert shared / np.sqrt(x * y) == pytest.approx(wanted / np.sqrt(wanted_x * wanted_y), abs=0.03)


def test_noise_of_instruments_is_not_taken_for_the_persons_however_fast_they_sample():
    white, torque = np.random.default_rng(3).standard_normal((N_TRIALS, 4 * N, 2)), []
    force = signal.sosfilt(signal.butter(2, 3.0, fs=4 * RATE, output="sos"), white, axis=1)
    path = simulate_linear(RELAX, Environment(), force, 4 * RATE).displacement
    for every in (4, 1):
        added = np.random.default_rng(4).standard_normal(path[:, ::every].shape) / np.sqrt(every)
        sampled = path[:, ::every] + 2e-6 * added  # of one density at all rates
        noise = Noise(RELAX, Environment(), sampled.shape[1], N_TRIALS, 4 * RATE / every)
        noise.weigh(sampled)
        standard = np.random.default_rng(5).standard_normal(sampled.shape[1:])
        torque.append(noise.torque(noise.root, np.ones(len(noise.root)), standard).std(axis=0))
    np.testing.assert_allclose(*torque, rtol=0.2)


def test_strength_makes_up_for_draws_that_are_too_weak(noise, residual):
    white = noise.white(residual)
    np.testing.assert_allclose(noise.matched_strength(white, white / 1.5), 1.5)
    np.testing.assert_allclose(noise.matched_strength(white, white * 1.5), 1.0 / 1.5)
    # Of each frequency for itself, on average over some.
    n = white.shape[1] // 4
    weaker = np.tile(np.where(np.arange(n) < n // 2, 0.5, 1.0), 4) * white
    strength = noise.matched_strength(white, weaker)
    np.testing.assert_allclose(strength[: n // 4], 2.0)
    np.testing.assert_allclose(strength[-n // 4 :], 1.0)


def test_log_determinant_is_what_scaling_the_noise_changes(residual):
    found = Noise(RELAX, Environment(), N, N_TRIALS, RATE)
    found.weigh(residual)
    before = found.log_determinant
    found.weigh(3.0 * residual)
    numbers = found.white(residual).shape[1]
    # Minus twice the log density of noise that is three times as strong: the cost stays, log det grows.
    assert before - found.log_determinant == pytest.approx(2.0 * numbers * np.log(3.0), rel=1e-9)


def test_lack_of_fit_sees_a_response_that_is_left_and_no_other(noise, residual):
    rng = np.random.default_rng(3)
    push = signal.sosfilt(SHAPE, rng.standard_normal((N_TRIALS, N, 2)), axis=1)
    left = 0.3 * simulate_linear(RELAX, Environment(), push, RATE).displacement
    noise.weigh(residual)
    both = np.array([noise.white(residual), noise.white(residual + left)])
    (right, wrong), dof = noise.lack_of_fit(both, push)
    assert dof % 8 == 0
    assert 0.005 < stats.chi2.sf(right, dof) < 0.995
    assert stats.chi2.sf(wrong, dof) < 1e-6
    np.testing.assert_allclose(noise.lack_of_fit(both[0], push)[0], right)


@pytest.mark.slow(reason="many sets of trials")
def test_estimates_vary_by_more_as_they_weigh_trials_by_the_noise_of_these():
    n, n_trials, n_sets, n_signals = 500, 2, 1200, 8
    rng = np.random.default_rng(3)
    forces = rng.standard_normal((n_sets * n_trials + n_signals, n, 2))
    moved = simulate_linear(RELAX, Environment(), forces, RATE).displacement
    signals, sets = moved[:n_signals], moved[n_signals:].reshape(n_sets, n_trials, n, 2)
    known = Noise(RELAX, Environment(), n, n_trials, RATE)
    known.root = np.sqrt(float(np.sum(known._taper**2))) * np.broadcast_to(np.eye(2), known.root.shape)
    known._white = np.sqrt(2.0) * known._to_force / known.root[0, 0, 0].real
    found = Noise(RELAX, Environment(), n, n_trials, RATE)
    squares = np.zeros(3)
    for own, other in zip(sets, np.roll(sets, 1, axis=0), strict=True):
        found.weigh(own)
        columns = found.white(signals)
        information = n_trials * np.sum(columns**2, axis=1)
        # What the set itself gives, and what draws of noise of the spectrum that was found would give.
        estimates = columns @ found.white(own).sum(axis=0) / information
        drawn = known.white(other).sum(axis=0)
        counted, not_counted = ((columns / sure) @ drawn / information for sure in (found.sure, 1.0))
        squares += [np.sum(values**2) for values in (estimates, counted, not_counted)]
    assert squares[0] == pytest.approx(squares[1], rel=0.04)
    assert squares[0] > 1.05 * squares[2]


def test_noise_that_is_drawn_anew_is_of_its_trial_alone():
    draws, shape = NoiseDraws((), (), 3, 5), (4, 50, 2)
    attempts = np.zeros((3, 4))
    attempts[1, 2] = 2
    before, after = (np.array([*each.standard(shape)]) for each in (draws, draws._replace(attempts=attempts)))
    np.testing.assert_array_equal((before != after).any(axis=(2, 3)), attempts > 0)
    assert np.corrcoef(before[1, 2].ravel(), after[1, 2].ravel())[0, 1] == pytest.approx(0.0, abs=0.3)


class Wild:
    """In place of a problem: an arm runs away where the first number of its noise is above one."""

    n_trials = 40
    unstable = ()
    """States whose arm runs away with any noise."""

    def predict_with(self, draws):
        self.draws = draws

    def predict(self, states):
        return np.array([np.nan if state in self.unstable else 0.0 for state in states])

    def disturbed(self, draws, pairs=range(100)):
        drawn = enumerate(draws.standard((self.n_trials, 3, 2)))
        return [(standard,) for pair, standard in drawn if pair in pairs]

    def sensitivity(self, state, disturbances=(), trials=None, *, first=0, n_divisions=1):
        if not disturbances:
            return np.ones(self.n_trials)
        # As in predictions, each half of a pair has its own division.
        assert first in range(0, n_divisions, 2)
        runs_away = (disturbances[0][:, 0, 0] > 1.0) | (state in self.unstable)
        return np.where(runs_away, 100.0, 2.0)[slice(None) if trials is None else trials]


def test_noise_with_which_an_arm_runs_away_is_drawn_anew_and_no_other():
    draws, problem = NoiseDraws((), (), 5, 9), Wild()
    found = borne(problem, None, draws)
    before, after = (np.array([each for (each,) in problem.disturbed(of)]) for of in (draws, found))
    assert (before[..., 0, 0] > 1.0).sum() > 10
    assert not (after[..., 0, 0] > 1.0).any()
    np.testing.assert_array_equal((before != after).any(axis=(2, 3)), before[..., 0, 0] > 1.0)
    assert found.attempts.max() < MOST_ATTEMPTS
    assert is_borne(problem, None, found)
    assert not is_borne(problem, None, draws)
    assert borne(problem, None, found) is found
    # An arm that runs away with any noise ends the search for better one.
    problem.unstable = ("there",)
    assert (borne(problem, "there", draws).attempts == MOST_ATTEMPTS).all()


def test_noise_is_not_drawn_anew_for_an_arm_that_is_unstable_ahead():
    draws, problem = NoiseDraws((), (), 5, 9), Wild()
    found = borne_ahead(problem, "here", "there", draws)
    assert found is problem.draws is not draws
    assert is_borne(problem, "there", found)
    assert borne_ahead(problem, "here", "there", found) is found
    problem.unstable = ("there",)
    assert borne_ahead(problem, "here", "there", draws) is problem.draws is draws


def test_a_trial_that_stands_out_is_told():
    rng = np.random.default_rng(0)
    alike = [size * rng.normal(size=(3, 20)) for size in (0.5, 1.0, 2.0)]
    assert not run_away(alike)
    assert run_away([*alike, 1e3 * alike[0]])
