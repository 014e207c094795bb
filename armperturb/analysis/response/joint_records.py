"""Perturbation and response of several trials as one open-loop system, d to (f, x).

Arm and environment form a closed loop: force moves the handle, and the handle's movement changes the force. A model
straight from f to x is biased by any other cause of movement: through the manipulator's mass the noise of x enters f
at the same instant, and no delay separates the two, as closed-loop methods require. The disturbance d is outside the
loop and correlates with none of the noise, so that from d everything is open loop, with noise of any colour,

    f = T d + noise,    x = P d + noise.

With G = [T; P] and W = a I + b T

    R = P W^-1,    dR = [-b R, I] dG W^-1,

where (a, b) is (0, 1) for the arm H (x over f), (1, -1) for the environment E (x over d - f) and (1, 0) for both, P.

The three signals pass the same anti-alias filter, which cancels in T and P. What is then sampled holds nothing above
half the sampling rate (but for traces at the onset), so that a model in discrete time has the frequency response of the
continuous system: nothing is held between samples, and x responds to d within the sample.
"""

import math
from collections.abc import Sequence
from typing import get_args

import numpy as np
from scipy import signal

from armperturb.analysis.response.frequency_response import System
from armperturb.analysis.trials import SeveralTrials, TrialRecord, prepared_recordings, records_of
from armperturb.arrays import Array, ComplexArray
from armperturb.validation import require_one_of

MODEL_RATE = 200.0
"""About the rate of records that are sampled more than 1.5 times as fast, once they are resampled [Hz]: more samples of
the same band need more lags and carry no information."""

FILTER_REACH = 10
"""Samples of the lower rate at either end of a record that the resampling filter spoils."""

FILTER_CUTOFF = 0.7
"""Cut-off of that filter over half the lower rate: signals that reach up to half the rate take many states, as no
causal model in discrete time is a mass there."""

SAME_DIRECTION = 1e-6
"""Determinant of the correlation of both disturbances below which they count as one [-]."""

BIN = 10.24
"""Length of the segments from which the power of the disturbance is estimated [s]."""

HIGHEST = 0.4
"""Frequencies up to this share of the rate are used [-]."""

EXCITED_DENSITY = 1e-3
"""Share of the largest power density above which a frequency counts as excited. It is larger than that of the lines of
a multisine (`spectra.EXCITED_LINE`), as Welch's segments leak power into neighbouring frequencies."""

_WEIGHTS = {"arm": (0.0, 1.0), "environment": (1.0, -1.0), "total": (1.0, 0.0)}


def joint_records(recording: SeveralTrials, window_start: float = 0.0) -> list[TrialRecord]:
    """The signals of trials up to their pulses, at about `MODEL_RATE` where they are sampled faster, see `thinning_of`.

    Args:
      recording: trials of one person in one condition, or several such recordings of the same rate, of any lengths.
      window_start: start of what is used [s].

    Raises:
      ValueError: as `ConditionTrials.records`; or a trial is too short to be resampled, rates differ, a channel is
        constant, or the disturbances along x and y are not independent.
    """
    records = [resampled(record) for record in records_of(prepared_recordings(recording), window_start)]
    d, response = (
        np.concatenate([part - part.mean(axis=0) for part in parts]) for parts in list(zip(*records, strict=True))[:2]
    )
    for name, values in (("perturbation", d), ("force", response[:, :2]), ("displacement", response[:, 2:])):
        for axis, spread in zip("xy", np.ptp(values, axis=0), strict=True):
            if not spread > 0.0:
                raise ValueError(f"{name} along {axis} is constant in all trials; expected a signal")
    if np.linalg.det(np.corrcoef(d.T)) < SAME_DIRECTION:
        raise ValueError(
            "the disturbances along x and y are not independent; expected independent ones (other realisations, or "
            "one trial for each direction)"
        )
    return records


def thinning_of(rate: float) -> int:
    """Every how many samples of a rate [Hz] are kept: the rate that is left is the nearest to `MODEL_RATE`.

    It is above 0.75 times that, and at most 1.5 times: halves are rounded down, so that 300 Hz stays 300 Hz.
    """
    return max(1, math.ceil(rate / MODEL_RATE - 0.5))


def resampled(record: TrialRecord) -> TrialRecord:
    """A trial at about `MODEL_RATE`, see `thinning_of`. Raises ValueError where it is too short for that."""
    factor = thinning_of(record.rate)
    if factor == 1:
        return record
    signals = np.concatenate(record[:2], axis=1)
    if len(signals) < 4 * FILTER_REACH * factor:
        raise ValueError(f"a trial holds {len(signals)} samples; expected at least {4 * FILTER_REACH * factor}")
    signals = thinned(signals, factor, axis=0)[FILTER_REACH:-FILTER_REACH]
    n_inputs = record.perturbation.shape[1]
    return TrialRecord(signals[:, :n_inputs], signals[:, n_inputs:], record.rate / factor)


def thinned(signals: Array, factor: int, axis: int) -> Array:
    """Every factor-th sample of what a low-pass leaves of signals that are zero before their start.

    Signals that pass the same filter keep their relation: it cancels. It spoils `FILTER_REACH` samples at either end.
    """
    lowpass = signal.firwin(2 * FILTER_REACH * factor + 1, FILTER_CUTOFF / factor, window=("kaiser", 5.0))
    return np.asarray(signal.resample_poly(signals, 1, factor, axis=axis, window=lowpass))


def excited_frequencies(records: Sequence[TrialRecord]) -> Array:
    """Where the disturbance has power, in steps of about 0.1 Hz, up to 0.4 of the rate [Hz], (frequency,)."""
    rate, longest = records[0].rate, max(len(record.perturbation) for record in records)
    n_bin = min(round(BIN * rate), longest)
    long_enough = [record.perturbation for record in records if len(record.perturbation) >= n_bin]
    frequency = np.fft.rfftfreq(n_bin, 1.0 / rate)
    power = np.sum([signal.welch(d, rate, nperseg=n_bin, axis=0)[1] for d in long_enough], axis=(0, 2))
    power[(frequency == 0.0) | (frequency > HIGHEST * rate)] = 0.0
    return np.asarray(frequency[power > EXCITED_DENSITY * power.max()])


def admittance_of(what: System, joint: ComplexArray) -> ComplexArray:
    """Admittance of arm, environment or both [m/N], (frequency, output, input).

    Args:
      what: "arm", "environment" or "total".
      joint: G from d to (f, x), (frequency, 4, 2); of one axis, (frequency, 2, 1).

    Raises:
      ValueError: what is something else.
    """
    return np.asarray(joint[:, joint.shape[1] // 2 :] @ _to_disturbance(what, joint))


def variance_of(what: System, joint: ComplexArray, noise: ComplexArray, spread: ComplexArray) -> Array:
    """Variance of that admittance to first order: the mean of |error|^2 [(m/N)^2], (frequency, output, input).

    Args:
      what: as in `admittance_of`.
      joint: as in `admittance_of`.
      noise: N, (frequency, 4, 4).
      spread: S, (frequency, 2, 2), such that the covariance of dG_ab and dG_cd is N_ac S_bd.

    Raises:
      ValueError: as `admittance_of`.
    """
    left, inverse = _around_error(what, joint)
    of_output = np.einsum("fia,fac,fic->fi", left, noise, left.conj()).real
    of_input = np.einsum("fbj,fbd,fdj->fj", inverse, spread, inverse.conj()).real
    return np.asarray(of_output[:, :, None] * of_input[:, None, :])


def error_of(what: System, joint: ComplexArray, change: ComplexArray) -> ComplexArray:
    """Change of that admittance to first order [m/N], (frequency, output, input).

    Args:
      what: as in `admittance_of`.
      joint: as in `admittance_of`.
      change: of G, (frequency, 4, 2).

    Raises:
      ValueError: as `admittance_of`.
    """
    left, inverse = _around_error(what, joint)
    return np.asarray(left @ change @ inverse)


def _around_error(what: System, joint: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """[-b R, I] and W^-1, between which an error of G stands."""
    inverse, response = _to_disturbance(what, joint), admittance_of(what, joint)
    unit = np.broadcast_to(np.eye(response.shape[1]), response.shape)
    return np.concatenate([-_WEIGHTS[what][1] * response, unit], axis=2), inverse


def _to_disturbance(what: System, joint: ComplexArray) -> ComplexArray:
    """W^-1: from the system's input to d."""
    require_one_of("response", "what", what, get_args(System))
    a, b = _WEIGHTS[what]
    n = joint.shape[1] // 2
    return np.asarray(np.linalg.inv(a * np.eye(n) + b * joint[:, :n]))
