"""What the analysis assumes unless a caller says otherwise: the settings of the thesis, named once."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

Estimator = Literal["thesis", "frequency", "record"]
"""The thesis's (each trial alone, averaged), or maximum likelihood of mean periods, or of whole records."""

WINDOW_START = 8.0
"""Start of the window of whole periods [s]: the transient has died away by then."""

SETTLING = 4.0
"""Least start of that window where records are too short for the usual one [s]."""

SETTLED = 2.0
"""Time from which on a disturbance is periodic [s]; the response to it need not be."""

FEWEST_TRIALS = 3
"""Trials from which on it is told what differs between them: fewer do not tell by how much."""

LINES_PER_AVERAGE = 4
"""Adjacent lines over which spectra are averaged: the clusters of the thesis's multisine."""

LINEAR_MODELS: Mapping[str, str] = MappingProxyType({"PT": "3b", "RT": "1"})
"""Task to the structure that is fitted, see `armperturb.analysis.fit.structures`."""
