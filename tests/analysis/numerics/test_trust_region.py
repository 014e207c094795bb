"""Steps of the trust-region search against scipy's `least_squares`."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import optimize

from armperturb.analysis.numerics.trust_region import (
    EVALUATIONS_REACHED,
    INSIDE,
    NO_GRADIENT,
    first_radius,
    inside,
    judge,
    next_point,
)

N, M = 6, 20
TIGHT = {"ftol": 1e-13, "xtol": 1e-11, "max_nfev": 500}


def minimise(problem, start, lower, upper, *, ftol, xtol, max_nfev):
    """x, cost, status and number of evaluations of a search that takes these steps."""

    @np.errstate(all="ignore")
    def squares(x):
        residual, jacobian = problem(x), problem.slope(x)
        cost = 0.5 * residual @ residual if np.isfinite(jacobian).all() else np.inf
        return cost, jacobian.T @ residual, jacobian.T @ jacobian

    x = inside(start, lower, upper, INSIDE)
    cost, gradient, hessian = squares(x)
    radius, damping = first_radius(x, gradient, lower, upper), 0.0
    for n in range(1, max_nfev):
        if not gradient.any():
            return x, cost, NO_GRADIENT, n
        there, step = next_point(x, gradient, hessian, lower, upper, radius, damping)
        new_cost, *derivatives = squares(there)
        radius, damping, status = judge(step, cost, new_cost, ftol, xtol)
        if new_cost < cost:
            x, cost, (gradient, hessian) = there, new_cost, derivatives
        if status:
            return x, cost, status, n + 1
    return x, cost, EVALUATIONS_REACHED, max_nfev


@dataclass(frozen=True, eq=False)
class Waves:
    """Residuals A x + c sin(A x) - b."""

    a: np.ndarray
    b: np.ndarray
    c: float

    def __call__(self, x):
        u = self.a @ x
        return u + self.c * np.sin(u) - self.b

    def slope(self, x):
        return (1 + self.c * np.cos(self.a @ x))[:, None] * self.a


def scipys(problem, start, lower, upper, **options):
    return optimize.least_squares(problem, start, problem.slope, bounds=(lower, upper), gtol=None, **options)


def drawn(n_problems, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(n_problems):
        problem = Waves(rng.normal(size=(M, N)), 3 * rng.normal(size=M), rng.uniform(0, 0.8))
        yield problem, rng.uniform(-0.5, 0.5, N)


@pytest.mark.slow(reason="solves many problems with SciPy")
@pytest.mark.parametrize("limit", [0.2, 0.6, np.inf])
def test_optima_are_those_of_scipy(limit):
    bound, active = np.full(N, limit), []
    for problem, anywhere in drawn(60):
        start = np.clip(anywhere, -0.9 * limit, 0.9 * limit)
        x, cost, status, _ = minimise(problem, start, -bound, bound, **TIGHT)
        expected = scipys(problem, start, -bound, bound, **TIGHT)
        assert status > 0
        assert cost == pytest.approx(expected.cost, rel=1e-9)
        np.testing.assert_allclose(x, expected.x, atol=1e-6)
        assert (np.abs(x) <= limit).all()
        active += (np.abs(x) > limit - 1e-6).tolist()
    assert np.mean(active) > 0.1 if np.isfinite(limit) else not any(active)


@pytest.mark.slow(reason="solves many problems with SciPy")
def test_tolerances_mean_what_they_mean_to_scipy():
    bound = np.full(N, 0.4)
    for options in ({"ftol": 1e-3, "xtol": 1e-12}, {"ftol": 1e-14, "xtol": 1e-2}, {"ftol": 1e-14, "xtol": 1e-14}):
        limit, same = 6 if options["ftol"] == options["xtol"] else 100, []
        for problem, anywhere in drawn(40, seed=1):
            start = np.clip(anywhere, -0.3, 0.3)
            _, _, status, n = minimise(problem, start, -bound, bound, max_nfev=limit, **options)
            expected = scipys(problem, start, -bound, bound, max_nfev=limit, **options)
            same.append((status, n) == (expected.status, expected.nfev))
        # The last digit of a step may decide.
        assert np.mean(same) >= 0.9, options


def test_directions_without_effect_are_left_alone():
    bound = np.full(N, 50.0)
    for problem, start in drawn(20, seed=3):
        problem.a[:, 1] = 2 * problem.a[:, 0]
        problem.a[:, 2] = 0.0
        x, cost, status, _ = minimise(problem, start, -bound, bound, **TIGHT)
        assert status > 0
        assert x[2] == pytest.approx(start[2], rel=1e-12)
        assert cost == pytest.approx(scipys(problem, start, -bound, bound, **TIGHT).cost, rel=1e-9)


class Cliff:
    """Residuals that are not finite beyond an edge: sqrt(edge - x) and x - 2."""

    def __init__(self, edge):
        self.edge = edge

    def __call__(self, x):
        return np.concatenate([np.sqrt(self.edge - x), x - 2])

    def slope(self, x):
        return np.array([-0.5 / np.sqrt(self.edge - x), [1.0]])


@pytest.mark.parametrize("edge", [1.0, 1.5, 10.0])
def test_what_is_not_finite_is_a_step_too_long(edge):
    x, cost, _, _ = minimise(Cliff(edge), np.zeros(1), np.array([-5.0]), np.array([5.0]), **TIGHT)
    assert np.isfinite(cost)
    # (edge - x) + (x - 2)^2 is least at 2.5, where there is such a place.
    assert x[0] == pytest.approx(2.5, abs=1e-6) if edge > 2.5 else 0.9 * edge < x[0] < edge


def test_a_search_ends_where_there_is_no_gradient():
    problem = Waves(np.eye(N), np.zeros(N), 0.0)
    bound = np.full(N, 1.0)
    assert minimise(problem, np.zeros(N), -bound, bound, **TIGHT)[2:] == (NO_GRADIENT, 1)
