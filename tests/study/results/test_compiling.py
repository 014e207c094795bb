"""What one process of a study compiles, the others need not."""

import pytest
from numba.core import event

from armperturb.analysis.fit.thesis import fit_trials
from armperturb.cohort import average_person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.planar_arm.skeletal import simulate_skeletal
from armperturb.study.results.compiling import compile_fits, compile_simulations
from armperturb.subject import POSITION
from tests.studies import perturbed


@pytest.mark.slow(reason="compiles")
def test_a_study_compiles_nothing_more():
    trials = perturbed(average_person().subjects["PT"], 1.0, 2, HUMAN_NOISE["PT"])
    compile_simulations("mujoco")
    compile_fits()
    with event.install_recorder("numba:compile") as recorder:
        run_experiment(trials, engine="compiled")
        recording = run_experiment(trials, instruments=Instruments())
        fit_trials(recording, "1")
        simulate_skeletal(POSITION, Environment(), recording["perturbation"].values[0], recording.attrs["rate"], 200)
    assert [item.data["dispatcher"].py_func.__name__ for _, item in recorder.buffer if item.is_start] == []
