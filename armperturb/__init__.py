"""Human-arm perturbation experiments on synthetic people in MuJoCo, and their analysis."""

import importlib
from typing import TYPE_CHECKING, Any

from armperturb.analysis.arm.linear_arm import arm_admittance as arm_admittance
from armperturb.analysis.fit.identify import identify as identify
from armperturb.analysis.response.best_linear import estimate_best_linear as estimate_best_linear
from armperturb.analysis.response.estimate import estimate_response as estimate_response
from armperturb.cohort import draw_cohort as draw_cohort
from armperturb.cohort import draw_person as draw_person
from armperturb.environment import Environment as Environment
from armperturb.environment import Strap as Strap
from armperturb.envs.learning.registration import load_dm_env as load_dm_env
from armperturb.envs.learning.registration import register_environments
from armperturb.perturbations import Multisine as Multisine
from armperturb.perturbations import MultisineThenPulse as MultisineThenPulse
from armperturb.perturbations import Pulse as Pulse
from armperturb.perturbations import load_perturbation as load_perturbation
from armperturb.perturbations import save_perturbation as save_perturbation
from armperturb.recording import load_recording as load_recording
from armperturb.recording import save_recording as save_recording
from armperturb.subject import POSITION as POSITION
from armperturb.subject import RELAX as RELAX
from armperturb.subject import Subject as Subject

if TYPE_CHECKING:
    from armperturb.envs.lab.experiment import run_experiment as run_experiment
    from armperturb.envs.lab.instruments import Instruments as Instruments
    from armperturb.envs.lab.trial import Trial as Trial
    from armperturb.models import build_model as build_model

register_environments()

# These need MuJoCo, which an analysis of recordings does not: they are fetched on first use.
_SIMULATOR = {
    "Instruments": "armperturb.envs.lab.instruments",
    "Trial": "armperturb.envs.lab.trial",
    "build_model": "armperturb.models",
    "run_experiment": "armperturb.envs.lab.experiment",
}


def __getattr__(name: str) -> Any:
    if name in _SIMULATOR:
        return getattr(importlib.import_module(_SIMULATOR[name]), name)
    raise AttributeError(f"module 'armperturb' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_SIMULATOR})
