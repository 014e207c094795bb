"""The foreign arms obey their own theory and MuJoCo, and what the package estimates without a model is right."""

from dataclasses import replace

import foreign_mujoco
import numpy as np
import pytest
from foreign_arms import admittance, paths, simulate
from foreign_recordings import KINDS, LOADS, draw_foreign, write_csv

from armperturb.analysis.response.estimate import response
from armperturb.convert.importer import import_recording

ARMS = [(reflex, grip) for reflex in ("none", "position") for grip in ("rigid", "spring")]
RATE = 200.0


def tones(n, step, periods=5):
    """Lines of a whole period, faded in; and the lines."""
    time, frequency = np.arange(n) * step, np.array([0.4, 1.0, 1.8, 3.2, 5.6, 9.0, 14.8, 19.4])
    phase = np.random.default_rng(5).uniform(0.0, 2 * np.pi, (2, len(frequency)))
    d = np.cos(2 * np.pi * frequency * time[:, None, None] + phase).sum(axis=2)
    return d * np.clip(time, 0.0, 1.0)[:, None], frequency


def respond(setup, *, step, engine=simulate, linear=False, duration=30.0):
    """F and x at 200 Hz without noise, and d."""
    every = round(1.0 / (RATE * step))
    d, frequency = tones(2 * every * round(duration * RATE) + 1, 0.5 * step)
    f, x = engine(setup.arm, setup.load, d, np.zeros_like(d), step, every, linear)
    return d[:: 2 * every], f, x, frequency


@pytest.mark.parametrize(("reflex", "grip"), ARMS)
def test_the_linear_arm_has_the_admittance_of_its_matrices(reflex, grip):
    setup = draw_foreign(1, reflex=reflex, grip=grip)
    d, f, x, frequency = respond(setup, step=5e-4, linear=True)
    last = slice(-1001, -1)  # two periods of 2.5 s
    lines = np.rint(frequency * 5.0).astype(int)
    f, x, d = (np.fft.rfft(part[last], axis=0)[lines] for part in (f, x, d))
    np.testing.assert_allclose(x, np.einsum("fij,fj->fi", admittance(setup.arm, frequency), f), rtol=2e-4, atol=1e-7)
    from_d = np.einsum("fij,fj->fi", paths(setup.arm, setup.load, frequency)[0], d)
    np.testing.assert_allclose(x, from_d, rtol=0.0, atol=1e-4 * np.abs(x).max())


@pytest.mark.parametrize(("reflex", "grip"), ARMS)
def test_halving_the_step_changes_less_than_a_ten_thousandth(reflex, grip):
    setup = draw_foreign(2, reflex=reflex, grip=grip)
    coarse, fine = (respond(setup, step=step, duration=6.0) for step in (1e-3, 5e-4))
    for a, b in zip(coarse[1:3], fine[1:3], strict=True):
        assert np.abs(a - b).max() < 1e-4 * np.abs(b).max()


@pytest.mark.slow(reason="integrates the equations of motion")
@pytest.mark.parametrize(("reflex", "grip"), ARMS)
def test_mujoco_moves_as_the_equations_of_motion(reflex, grip):
    setup = draw_foreign(3, reflex=reflex, grip=grip, n_trials=1, duration=3.0, amid=False, rms=0.03)
    for mine, theirs in zip(setup.record(), setup.record(foreign_mujoco.simulate), strict=True):
        assert np.abs(mine - theirs).max() < 2e-4 * np.abs(mine).max()


@pytest.mark.parametrize("kind", KINDS)
def test_displacement_has_the_wanted_size(kind):
    setup = draw_foreign(4, kind=kind, n_trials=2, duration=30.0, linear=True, remnant=0.0)
    _, _, x = setup.record()
    assert np.sqrt(np.mean(x**2)) == pytest.approx(setup.rms, rel=0.35)


@pytest.fixture(scope="module")
def setups():
    return [draw_foreign(seed, period=6.0, duration=20.0, n_trials=4, rate=RATE, linear=True) for seed in range(4)]


@pytest.mark.slow(reason="simulates many trials")
@pytest.mark.parametrize("kind", ["multisine", "noise", "filtered noise"])
def test_the_admittance_without_a_model_is_inside_its_circles(setups, kind):
    covered = []
    for setup in setups:
        setup = replace(setup, kind=kind)
        method = "multisine" if kind == "multisine" else "noise"
        found = response(setup.recording(), method, window_start=0.0)
        inside = found.covers(admittance(setup.arm, found.frequency))
        covered.append(inside[found.frequency <= setup.top].mean())
    assert 0.90 < np.mean(covered) < 0.99, covered


@pytest.mark.slow(reason="draws many arms")
def test_loads_and_structures_are_all_drawn():
    drawn = [draw_foreign(seed) for seed in range(24)]
    assert {setup.truth["reflex"] for setup in drawn} == {"none", "velocity", "position"}
    assert {setup.truth["grip"] for setup in drawn} == {"rigid", "spring"}
    assert {setup.load for setup in drawn} == set(LOADS)


@pytest.mark.slow(reason="simulates and converts")
def test_a_laboratory_file_is_the_same_recording(tmp_path):
    setup = replace(draw_foreign(6), n_trials=2, duration=10.0)
    arrays = setup.record()
    read = import_recording([write_csv(setup, *arrays, tmp_path)]).recording
    for name, values in zip(("perturbation", "force", "displacement"), arrays, strict=True):
        np.testing.assert_allclose(read[name].values, values, rtol=1e-6, atol=1e-8)
