"""The lockstep minimiser against scipy's `least_squares`, one problem at a time."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import optimize

from armperturb.analysis.numerics.trust_region import NO_GRADIENT, NOT_FINITE, minimise

N, M = 6, 20
TIGHT = {"ftol": 1e-13, "xtol": 1e-11, "max_nfev": 500}


@dataclass(frozen=True, eq=False)
class Waves:
    """Residuals A x + c sin(A x) - b, for each problem of a batch."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray

    def take(self, index):
        return Waves(self.a[index], self.b[index], self.c[index])

    def evaluate(self, x):
        u = (self.a @ x[..., None])[..., 0]
        c = self.c[:, None]
        return u + c * np.sin(u) - self.b, (1 + c * np.cos(u))[..., None] * self.a


def scipys(problem, start, lower, upper, **options):
    """The same of the first problem, by scipy."""
    return optimize.least_squares(
        lambda x: problem.evaluate(x[None])[0][0],
        start,
        lambda x: problem.evaluate(x[None])[1][0],
        bounds=(lower, upper),
        gtol=None,
        **options,
    )


def drawn(n_problems, seed=0):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(n_problems, M, N)), 3 * rng.normal(size=(n_problems, M))
    waves = Waves(a, b, rng.uniform(0, 0.8, n_problems))
    return waves, rng.uniform(-0.5, 0.5, (n_problems, N))


@pytest.mark.parametrize("limit", [0.2, 0.6, np.inf])
def test_optima_are_those_of_scipy(limit):
    waves, start = drawn(60)
    start, bound = np.clip(start, -0.9 * limit, 0.9 * limit), np.full(N, limit)
    found = minimise(waves, start, -bound, bound, **TIGHT)
    assert (found.status > 0).all()
    for i in range(60):
        expected = scipys(waves.take([i]), start[i], -bound, bound, **TIGHT)
        assert found.cost[i] == pytest.approx(expected.cost, rel=1e-9)
        np.testing.assert_allclose(found.x[i], expected.x, atol=1e-6)
    active = (np.abs(found.x) > limit - 1e-6).mean()
    assert (np.abs(found.x) <= limit).all()
    assert active > 0.1 if np.isfinite(limit) else active == 0


def test_tolerances_mean_what_they_mean_to_scipy():
    waves, start = drawn(40, seed=1)
    bound = np.full(N, 0.4)
    for options in ({"ftol": 1e-3, "xtol": 1e-12}, {"ftol": 1e-14, "xtol": 1e-2}, {"ftol": 1e-14, "xtol": 1e-14}):
        limit = 6 if options["ftol"] == options["xtol"] else 100
        found = minimise(waves, np.clip(start, -0.3, 0.3), -bound, bound, max_nfev=limit, **options)
        expected = [
            scipys(waves.take([i]), np.clip(start[i], -0.3, 0.3), -bound, bound, max_nfev=limit, **options)
            for i in range(40)
        ]
        same = np.array([(one.status, one.nfev) for one in expected]) == np.column_stack(
            [found.status, found.n_evaluations]
        )
        # The last digit of a step may decide.
        assert same.all(axis=1).mean() >= 0.9, options


def test_problems_do_not_see_each_other():
    waves, start = drawn(30, seed=2)
    waves.c[::3] = 5.0  # many minima: these take long
    bound = np.full(N, 0.5)
    together = minimise(waves, start, -bound, bound, **TIGHT)
    assert np.ptp(together.n_evaluations) > 5
    for i in range(30):
        alone = minimise(waves.take([i]), start[i : i + 1], -bound, bound, **TIGHT)
        np.testing.assert_allclose(together.x[i], alone.x[0], atol=1e-10)
        assert together.status[i] == alone.status[0]
        assert together.n_evaluations[i] == alone.n_evaluations[0]


def test_directions_without_effect_are_left_alone():
    waves, start = drawn(20, seed=3)
    waves.a[:, :, 1] = 2 * waves.a[:, :, 0]
    waves.a[:, :, 2] = 0.0
    bound = np.full(N, 50.0)
    found = minimise(waves, start, -bound, bound, **TIGHT)
    assert (found.status > 0).all()
    np.testing.assert_allclose(found.x[:, 2], start[:, 2], rtol=1e-12)
    for i in range(20):
        expected = scipys(waves.take([i]), start[i], -bound, bound, **TIGHT)
        assert found.cost[i] == pytest.approx(expected.cost, rel=1e-9)


def test_smaller_problems_may_share_a_batch_with_larger_ones():
    waves, start = drawn(12, seed=4)
    sizes = np.where(np.arange(12) % 2, N, N - 2)
    for i, size in enumerate(sizes):
        waves.a[i, :, size:] = start[i, size:] = 0.0
    bound = np.full(N, 0.6)
    limits = np.where(sizes == N, 500, 3)
    together = minimise(waves, start, -bound, bound, ftol=1e-13, xtol=1e-11, max_nfev=limits, sizes=sizes)
    assert (together.n_evaluations[sizes < N] == 3).all()
    for i, size in enumerate(sizes):
        own = Waves(waves.a[[i], :, :size], waves.b[[i]], waves.c[[i]])
        alone = minimise(
            own, start[[i], :size], -bound[:size], bound[:size], ftol=1e-13, xtol=1e-11, max_nfev=limits[i]
        )
        np.testing.assert_allclose(together.x[i, :size], alone.x[0], atol=1e-10)
        assert not together.x[i, size:].any()


@dataclass(frozen=True, eq=False)
class Cliffs:
    """Residuals that are not finite beyond an edge: sqrt(edge - x) and x - 2."""

    edge: np.ndarray

    def take(self, index):
        return Cliffs(self.edge[index])

    def evaluate(self, x):
        root = np.sqrt(self.edge[:, None] - x)
        return np.concatenate([root, x - 2], axis=1), np.stack([-0.5 / root, np.ones_like(x)], axis=1)


def test_what_is_not_finite_is_a_step_too_long_and_harms_no_other():
    found = minimise(Cliffs(np.array([1.0, 10.0, -1.0, 1.5])), np.zeros((4, 1)), -5.0, 5.0, **TIGHT)
    # (edge - x) + (x - 2)^2 is least at 2.5, where there is such a place.
    assert found.x[1, 0] == pytest.approx(2.5, abs=1e-6)
    assert found.status[2] == NOT_FINITE
    assert (found.x[2, 0], found.n_evaluations[2]) == (0.0, 1)
    for i, edge in ((0, 1.0), (3, 1.5)):
        assert np.isfinite(found.cost[i])
        assert 0.9 * edge < found.x[i, 0] < edge


def test_a_start_on_a_bound_gets_away_from_it_and_a_perfect_one_stays():
    a = np.tile(np.eye(M)[:, :N], (2, 1, 1))
    target = np.full(N, 0.25)
    waves = Waves(a, np.pad(np.tile(target, (2, 1)), [(0, 0), (0, M - N)]), np.zeros(2))
    found = minimise(waves, [np.full(N, 1.0), target], np.zeros(N), np.ones(N), **TIGHT)
    np.testing.assert_allclose(found.x[0], target, atol=1e-7)
    np.testing.assert_array_equal(found.x[1], target)
    assert (found.status[1], found.n_evaluations[1]) == (NO_GRADIENT, 1)


def test_crossed_bounds_are_named():
    waves, start = drawn(1)
    with pytest.raises(ValueError, match="bounds = 1 to 0; expected a lower below an upper bound"):
        minimise(waves, start, np.ones(N), np.zeros(N), **TIGHT)
