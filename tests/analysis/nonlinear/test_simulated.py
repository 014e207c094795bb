"""Means over divisions of the elastic limits: smoother along the parameters than the response to one of them."""

import nonlinear_trials as made
import numpy as np
import pytest

from armperturb.analysis.nonlinear.estimate import free_parameters
from armperturb.analysis.nonlinear.model import Model, coordinate, true_values
from armperturb.analysis.nonlinear.problem import Problem
from armperturb.analysis.nonlinear.simulated import COORDINATE_STEP, SMOOTHED, State
from armperturb.cohort import average_person
from armperturb.planar_arm.simulation import Disturbances

PERSON = average_person().subjects["RT"]
TRUE = true_values(PERSON, {})
FREE = ("k.shoulder", "short_range_stiffness.shoulder", "elastic_limit_deg.shoulder", "elastic_limit_spread")


@pytest.fixture(scope="module")
def at_truth():
    """Two trials that move an arm by several elastic limits, and a state of four unknowns, the true one."""
    pushes = [made.push(seed, 1.5) for seed in (0, 1)]
    sets = [made.trial_set(made.record(PERSON, pushes, noisy=False, condition="RT7.5"))]
    known = {name: TRUE[name] for name in free_parameters(sets, Model()).names if name not in FREE}
    problem = Problem(free_parameters(sets, Model(fixed=known)), sets, {"RT7.5": PERSON})
    point = np.log([TRUE[name] for name in problem.parameters.names])
    return problem, State(point, np.zeros(len(problem.kind_of)), np.full(len(problem.kinds), 0.08))


@pytest.mark.slow(reason="simulates")
def test_derivatives_are_those_of_the_mean_and_smooth(at_truth):
    problem, state = at_truth
    names = problem.parameters.names
    along = np.eye(len(names))[names.index("elastic_limit_deg.shoulder")]

    def roughness(smooth):
        """How much derivatives depart from a straight line between neighbours [m], RMS, (parameter,)."""
        places = [state._replace(point=state.point + 0.01 * step * along) for step in range(-4, 5)]
        derivatives = np.array([problem.derivatives(place, smooth=smooth) for place in places])[:, :, : len(names)]
        return np.sqrt(np.mean(np.diff(derivatives, 2, axis=0) ** 2, axis=(0, 1, 3, 4)))

    ratio = roughness(smooth=True) / roughness(smooth=False)
    assert ratio.max() < 0.9
    assert np.median(ratio) < SMOOTHED**-0.5  # kinks lie elsewhere, as if they were independent
    alike = [Disturbances(problem.perturbation, problem.sets[0].rate)] * SMOOTHED
    here, there = problem.predict([state, state._replace(point=state.point + COORDINATE_STEP * along)], alike)
    found = [of_trial[int(np.argmax(along))] for of_trial in problem.derivatives(state, smooth=True)]
    np.testing.assert_allclose(found, (there - here) / COORDINATE_STEP, rtol=1e-6, atol=1e-9)


@pytest.mark.slow(reason="simulates")
def test_where_there_is_no_such_person_a_search_turns_back(at_truth):
    problem, state = at_truth
    place = problem.parameters.names.index("k.shoulder")
    nobody = state.point.copy()
    nobody[place] = coordinate("k.shoulder", -2.0 * TRUE["k.two-joint"])  # of the joint, less than nothing is left
    here, there = problem.predict([state, state._replace(point=nobody)])
    assert problem.subjects(state._replace(point=nobody)) == [None, None]
    assert np.isnan(there).all()
    np.testing.assert_array_equal(here, problem.predict([state])[0])
    assert problem.cost(state._replace(point=nobody), there) == np.inf
    assert np.isfinite(problem.cost(state, here))
    edge = state.point.copy()
    edge[place] = coordinate("k.shoulder", -TRUE["k.two-joint"])
    assert {person.k_s for person in problem.subjects(state._replace(point=edge))} == {0.0}
