"""Every figure that a study allows, by name."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from armperturb.recording import REQUIRED_SIGNALS, load_recording
from armperturb.study import (
    admittance_figures,
    fit_figures,
    parameter_figures,
    perturbation_figures,
    pulse_figures,
    rig_figures,
    trajectory_figures,
)
from armperturb.study.admittance import by_task, main_conditions
from armperturb.study.axes import Marks
from armperturb.study.bars import CONDITIONS
from armperturb.study.cases import of_condition
from armperturb.study.cells import LEVELS
from armperturb.study.results import StudyResult

Drawings = dict[str, Callable[[], Figure]]

PATHS = {"PT": ("PT7.5", "max"), "RT": ("RT7.5", "min")}
"""Task to condition and level whose paths are drawn (figures 3.17, 3.18)."""

SHOWN = (("PT0", "max"), ("RT0", "min"))
"""Condition and level of the pulses that are shown in pictures."""


@dataclass(frozen=True, kw_only=True)
class Significance:
    """Which effects figures mark.

    Attributes:
      gains: task to where the gains of its conditions differ.
      joint_parameters: task to parameter to the p of the effect of the amplitude on it.
      muscle_parameters: likewise, of muscle groups.
      pulse_levels: condition to the p of the effect of the level on the pulse admittance.
    """

    gains: Mapping[str, Marks] = field(default_factory=dict)
    joint_parameters: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    muscle_parameters: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    pulse_levels: Mapping[str, float] = field(default_factory=dict)


def drawings(study: StudyResult, significance: Significance | None = None) -> Drawings:
    """Name to a function that draws the figure; figures without data are left out.

    Pictures of the rig, "rig" and "stills", raise RuntimeError where the machine cannot draw.

    Args:
      study: the analysed study; its recordings must still be there.
      significance: what to mark.
    """
    marks = significance or Significance()
    return {
        **_perturbations(study),
        **_admittances(study, marks),
        **_fits(study),
        **_parameters(study, marks),
        **_pulses(study, marks),
        **_single_pulses(study),
    }
