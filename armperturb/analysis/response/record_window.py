"""What of trials whole records are: up to the first pulse, at a rate that is enough."""

from typing import NamedTuple, Self

import numpy as np
from scipy import fft

from armperturb.analysis.force_balance import EDGE
from armperturb.analysis.response.joint_records import FILTER_REACH, thinned, thinning_of
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array

LONG_RECORD = 2**18
"""Samples beyond which a record is cut, by a thousandth at most, to a length of which spectra are computed quickly."""


class RecordWindow(NamedTuple):
    """Up to where signals of trials count, and every how many samples.

    Attributes:
      end: samples before the first pulse.
      factor: every so many of them are kept of what a low-pass leaves; 1 keeps all as they are.
      first: samples at the lower rate that are left out at the start, as the low-pass spoils them.
    """

    end: int
    factor: int
    first: int

    @classmethod
    def of(cls, trials: ConditionTrials) -> Self:
        """The window of trials, at about `MODEL_RATE` where they are sampled faster, see `thinning_of`."""
        end = min(trials.first_onset, trials.n_samples - round(EDGE * trials.rate))
        if end > LONG_RECORD:
            end = quick_length(end)
        factor = thinning_of(trials.rate)
        return cls(end, factor, 0 if trials.from_rest or factor == 1 else FILTER_REACH)

    def __call__(self, values: Array) -> Array:
        """What counts of a signal (trial, time, ...)."""
        if self.factor == 1:
            return values[:, : self.end]
        return np.asarray(thinned(values[:, : self.end], self.factor, axis=1)[:, self.first : -FILTER_REACH])


def quick_length(n_samples: int) -> int:
    """Number of samples, hardly smaller, of which spectra are computed quickly."""
    return next(n for n in range(n_samples, 0, -1) if fft.next_fast_len(n) == n)
