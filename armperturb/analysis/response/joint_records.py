"""Perturbation and response of several trials as one open-loop system, d to (f, x).

Arm and environment are a closed loop: force moves the handle, and the handle's movement changes the force. A model
straight from f to x is biased by whatever else moves the handle: through the manipulator's mass the noise of x is in
the f of the same instant, and no delay keeps them apart, as methods for closed loops ask for. The disturbance d is
outside the loop, and nothing else correlates with it. Seen from d everything is open loop,

    f = T d + noise,    x = P d + noise,

and the noises may be as coloured and as correlated with each other as they are. With G = [T; P] and W = a I + b T

    R = P W^-1,    dR = [-b R, I] dG W^-1,

where (a, b) is (0, 1) for the arm H (x over f), (1, -1) for the environment E (x over d - f) and (1, 0) for both, P.

The three signals pass the same anti-alias filter, which cancels in T and P. What is then sampled holds nothing above
half the sampling rate (but for traces at the onset), so that a model in discrete time has the frequency response of the
continuous system: nothing is held between samples, and x answers d within the sample.
"""

from dataclasses import dataclass

import numpy as np
from scipy import signal

from armperturb.analysis.response.frequency_response import System, require_system
from armperturb.analysis.trials import SeveralTrials, prepared_recordings, records_of
from armperturb.arrays import Array, ComplexArray

MODEL_RATE = 200.0
"""Records that are sampled more than 1.5 times as fast are resampled to about this rate [Hz]: more samples of the same
band cost regressors, and say nothing."""

FILTER_REACH = 10
"""Samples of the lower rate at either end of a record that the filter for resampling spoils."""

FILTER_CUTOFF = 0.7
"""Cut-off of that filter over half the lower rate: signals that reach up to half the rate take many states, as no
causal model in discrete time is a mass there."""

SAME_DIRECTION = 1e-6
"""Determinant of the correlation of both disturbances below which they are one [-]."""

BIN = 10.24
"""Length of the pieces in which the power of the disturbance is found [s]."""

EXCITED = 1e-3
"""Share of the strongest power from which on a frequency counts as excited."""

_WEIGHTS = {"arm": (0.0, 1.0), "environment": (1.0, -1.0), "total": (1.0, 0.0)}
_AXES = ("x", "y")


@dataclass(frozen=True, kw_only=True, eq=False)
class JointRecords:
    """Trials of one system, of any lengths.

    Attributes:
      perturbation: d of each trial [N], (time, axis).
      response: f [N] and x [m] of each trial beside one another, (time, 4).
      rate: of the samples [Hz].
    """

    perturbation: tuple[Array, ...]
    response: tuple[Array, ...]
    rate: float

    @property
    def n_samples(self) -> int:
        """Samples of all trials."""
        return sum(map(len, self.perturbation))

    def excited_frequencies(self) -> Array:
        """Where the disturbance has power, in steps of about 0.1 Hz, up to 0.4 of the rate [Hz], (frequency,)."""
        n_bin = min(round(BIN * self.rate), max(map(len, self.perturbation)))
        long_enough = [d for d in self.perturbation if len(d) >= n_bin]
        frequency = np.fft.rfftfreq(n_bin, 1.0 / self.rate)
        power = np.sum([signal.welch(d, self.rate, nperseg=n_bin, axis=0)[1] for d in long_enough], axis=(0, 2))
        power[(frequency == 0.0) | (frequency > 0.4 * self.rate)] = 0.0
        return np.asarray(frequency[power > EXCITED * power.max()])


def joint_records(recording: SeveralTrials, window_start: float = 0.0) -> JointRecords:
    """The signals of trials up to their pulses.

    Args:
      recording: trials of one person in one condition, or several such recordings of the same rate, of any lengths.
      window_start: start of what is used [s].

    Raises:
      ValueError: as `ConditionTrials.records`; or a trial is too short to be resampled, rates differ, a channel is
        constant, or the disturbances along x and y are one.
    """
    originals = records_of(prepared_recordings(recording), window_start)
    rate = originals[0].rate
    factor = max(1, round(rate / MODEL_RATE))
    signals = [
        _resampled(np.concatenate([original.perturbation, original.response], axis=1), factor) for original in originals
    ]
    records = JointRecords(
        perturbation=tuple(values[:, :2] for values in signals),
        response=tuple(values[:, 2:] for values in signals),
        rate=rate / factor,
    )
    _require_moving(records)
    return records


def admittance_of(what: System, joint: ComplexArray) -> ComplexArray:
    """Arm, environment or both from the joint response.

    Args:
      what: "arm", "environment" or "total".
      joint: G from d to (f, x), (frequency, 4, 2).

    Returns:
      Admittance [m/N], (frequency, output, input).

    Raises:
      ValueError: what is something else.
    """
    return np.asarray(joint[:, 2:] @ _moving(what, joint))


def variance_of(what: System, joint: ComplexArray, noise: ComplexArray, spread: ComplexArray) -> Array:
    """Variance of that admittance, to first order.

    Args:
      what: as in `admittance_of`.
      joint: as in `admittance_of`.
      noise: N, (frequency, 4, 4).
      spread: S, (frequency, 2, 2), such that the covariance of dG_ab and dG_cd is N_ac S_bd.

    Returns:
      The mean of |error|^2 of each element [(m/N)^2], (frequency, output, input).

    Raises:
      ValueError: as `admittance_of`.
    """
    inverse, response = _moving(what, joint), admittance_of(what, joint)
    left = np.concatenate([-_WEIGHTS[what][1] * response, np.broadcast_to(np.eye(2), response.shape)], axis=2)
    of_output = np.einsum("fia,fac,fic->fi", left, noise, left.conj()).real
    of_input = np.einsum("fbj,fbd,fdj->fj", inverse, spread, inverse.conj()).real
    return np.asarray(of_output[:, :, None] * of_input[:, None, :])


def _moving(what: System, joint: ComplexArray) -> ComplexArray:
    """W^-1: from what moves the system to d."""
    require_system(what)
    a, b = _WEIGHTS[what]
    return np.asarray(np.linalg.inv(a * np.eye(2) + b * joint[:, :2]))


def _resampled(signals: Array, factor: int) -> Array:
    if factor == 1:
        return signals
    if len(signals) < 4 * FILTER_REACH * factor:
        raise ValueError(f"a trial holds {len(signals)} samples; expected at least {4 * FILTER_REACH * factor}")
    # All signals pass the same filter, so that it cancels.
    lowpass = signal.firwin(2 * FILTER_REACH * factor + 1, FILTER_CUTOFF / factor, window=("kaiser", 5.0))
    return np.asarray(signal.resample_poly(signals, 1, factor, axis=0, window=lowpass)[FILTER_REACH:-FILTER_REACH])


def _require_moving(records: JointRecords) -> None:
    d = np.concatenate([one - one.mean(axis=0) for one in records.perturbation])
    y = np.concatenate([one - one.mean(axis=0) for one in records.response])
    for name, values in (("perturbation", d), ("force", y[:, :2]), ("displacement", y[:, 2:])):
        for axis, spread in zip(_AXES, np.ptp(values, axis=0), strict=True):
            if not spread > 0.0:
                raise ValueError(f"{name} along {axis} is constant in all trials; expected a signal")
    if np.linalg.det(np.corrcoef(d.T)) < SAME_DIRECTION:
        raise ValueError(
            "the disturbances along x and y cannot be told apart; expected independent disturbances (other "
            "realisations, or one trial for each direction)"
        )
