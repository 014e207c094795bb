"""What one process of a study compiles, the others need not."""

import pytest
from numba.core import event

from armperturb.analysis.fit.thesis import fit_trials
from armperturb.cohort import average_person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.study.results.compiling import compile_fits, compile_recording
from tests.studies import perturbed


@pytest.mark.slow(reason="compiles")
def test_a_study_compiles_nothing_more():
    trials = perturbed(average_person().subjects["PT"], 1.0, 2, HUMAN_NOISE["PT"])
    compile_recording("mujoco")
    compile_fits()
    with event.install_recorder("numba:compile") as recorder:
        run_experiment(trials, engine="compiled")
        recording = run_experiment(trials, instruments=Instruments())
        fit_trials(recording, "1")
    assert [item.data["dispatcher"].py_func.__name__ for _, item in recorder.buffer if item.is_start] == []
