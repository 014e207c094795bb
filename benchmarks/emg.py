"""What the analysis of EMG is worth: `python -m benchmarks.emg` [people]; some minutes of a core.

People are drawn as in a study and do the thesis's protocol with a maximal contraction, under the published forces, with
all noise. Lines that begin with NeuroKit2 need it installed, and are left out otherwise.
"""

import importlib
import sys
import time
from dataclasses import replace

import numpy as np
from scipy import signal, stats

from armperturb.analysis.emg.activity import activity
from armperturb.analysis.emg.envelope import envelopes
from armperturb.cohort import draw_cohort
from armperturb.envs.lab.emg import Emg, _filters
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.recording import Action, make_recording
from armperturb.study.protocol import THESIS, Condition
