"""Positions of a search in files: what was saved comes back, and nothing else does."""

import nonlinear_trials as made
import numpy as np
import pytest

from armperturb.analysis.nonlinear.checkpoint import digest_of, load_position, save_position
from armperturb.analysis.nonlinear.estimate import free_parameters
from armperturb.analysis.nonlinear.model import Model
from armperturb.analysis.nonlinear.noise import NoiseDraws
from armperturb.analysis.nonlinear.problem import Problem
from armperturb.analysis.nonlinear.search import Position
from armperturb.analysis.nonlinear.simulated import State
from armperturb.subject import RELAX


def state(seed):
    rng = np.random.default_rng(seed)
    return State(rng.standard_normal(4), rng.standard_normal(6), rng.random(2))


@pytest.fixture
def position():
    rng = np.random.default_rng(2)
    roots = tuple(rng.standard_normal((n, 2, 2)) + 1j * rng.standard_normal((n, 2, 2)) for n in (3, 5))
    draws = NoiseDraws(roots, (rng.random(3), rng.random(5)), 6, 7, rng.integers(0, 3, (6, 4)))
    return Position(stage="final", state=state(0), reference=state(1), damping=0.3, n_steps=9, draws=draws)


def test_what_was_saved_comes_back(position, tmp_path):
    save_position(tmp_path / "c.json.gz", "a", position)
    loaded = load_position(tmp_path / "c.json.gz", "a")
    assert (loaded.stage, loaded.damping, loaded.n_steps) == ("final", 0.3, 9)
    assert loaded.draws[2:4] == (6, 7)
    np.testing.assert_array_equal(loaded.draws.attempts, position.draws.attempts)
    arrays = [(*of.state, *of.reference, *of.draws.roots, *of.draws.strengths) for of in (loaded, position)]
    for ours, theirs in zip(*arrays, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    save_position(tmp_path / "c.json.gz", "a", Position(state=state(0), reference=state(0)))
    assert load_position(tmp_path / "c.json.gz", "a").draws is None


def test_the_checkpoint_of_another_fit_or_a_damaged_one_is_none(position, tmp_path):
    path = tmp_path / "c.json.gz"
    assert load_position(path, "a") is None
    save_position(path, "a", position)
    assert load_position(path, "b") is None
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"no such thing", b""):
        path.write_bytes(content)
        assert load_position(path, "a") is None


@pytest.mark.slow(reason="simulates trials")
def test_another_structure_other_trials_and_another_start_have_other_digests():
    def problem(model, seed):
        push = made.push(seed, 0.5, duration=6.0)
        trials = made.trial_set(made.record(RELAX, [push]))
        return Problem(free_parameters([trials], model), [trials], {"RT7.5": RELAX})

    linear = problem(Model(law="linear"), 0)
    digests = [
        digest_of(linear, 1.0),
        digest_of(linear, 2.0),
        digest_of(problem(Model(law="linear", fixed={"m_h": 2.0}), 0), 1.0),
        digest_of(problem(Model(law="linear"), 1), 1.0),
    ]
    assert len(set(digests)) == 4
    assert digests[0] == digest_of(problem(Model(law="linear"), 0), 1.0)
