"""The search of the likelihood, on least squares whose minimum is known."""

import numpy as np
import pytest

from armperturb.analysis.fit.likelihood_search import search_from
from armperturb.analysis.fit.whittle import Normal


class Valley:
    """Residuals x and 1 + curvature x^2 / 2: the least sum of squares is one, at zero.

    Gauss and Newton take its second derivative for one, where it is 1 + curvature.
    """

    lower, upper = np.array([-10.0]), np.array([10.0])

    def __init__(self, curvature):
        self.curvature = curvature

    def pole(self, values):
        return -1.0

    def weigh(self, values):
        pass

    def cost(self, values):
        (x,) = values
        return x**2 + (1.0 + 0.5 * self.curvature * x**2) ** 2

    def normal(self, values):
        (x,) = values
        rows = np.array([1.0, self.curvature * x])
        residual = np.array([x, 1.0 + 0.5 * self.curvature * x**2])
        return Normal(self.cost(values), -(rows @ residual)[None, None], (rows @ rows)[None, None, None])


class Alike(Valley):
    """Two parameters of which data hardly tell more than the sum; what they are worth is rounded."""

    lower, upper = np.full(2, -10.0), np.full(2, 10.0)
    information = np.array([[1.0, 0.9999], [0.9999, 1.0]])

    def __init__(self, rounded):
        self.rounded = rounded

    def cost(self, values):
        return round(float(values @ self.information @ values) / self.rounded) * self.rounded

    def normal(self, values):
        return Normal(self.cost(values), -(self.information @ values)[None], self.information[None])


@pytest.mark.parametrize("curvature", [0.0, 0.5, 0.95])
def test_a_search_does_not_go_to_and_fro_where_steps_are_too_long(curvature):
    end = search_from(Valley(curvature), np.array([0.5]))
    assert end.converged
    assert end.n_rounds <= 8
    assert abs(end.values[0]) < 0.01


def test_a_search_that_round_off_ends_has_converged_if_no_step_is_worth_more():
    near = search_from(Alike(1e-3), np.array([0.5, -0.5]))
    assert (near.converged, near.n_rounds) == (True, 1)
    assert near.status.startswith("converged: ")
    far = search_from(Alike(100.0), np.array([1.0, 1.0]))
    assert (far.converged, far.status) == (False, "not converged: no smaller step increases the likelihood")
