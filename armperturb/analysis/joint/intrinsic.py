"""Impulse response of the intrinsic path without a structure: a check of inertia, damping and stiffness.

Within less than the delay of any reflex, torque that the reflex path leaves follows the movement through the intrinsic
path alone (Kearney, Stein and Parameswaran 1997). It is regressed on angle, velocity and the acceleration at lags to
either side; a rigid inertia answers at lag zero. Blocks of time that are left out tell whether the further lags explain
anything.
"""

from typing import NamedTuple

import numpy as np

from armperturb.analysis.joint.prediction import left_out_predictions, left_out_share, without_drift
from armperturb.analysis.joint.signals import EDGE, JointSignals
from armperturb.arrays import Array

REACH = 0.03
"""Longest lag to either side [s]: shorter than the delay of reflexes, and than what signals leave out at their ends."""

assert REACH < EDGE


class IntrinsicCheck(NamedTuple):
    """Intrinsic path without a structure.

    Attributes:
      lag: of the torque behind the acceleration [s], (lag,).
      response: torque per acceleration at each lag, (lag,) [kg m^2, or kg].
      left_out_vaf: of the torque without that of the reflex path, on blocks that were left out [%].
      structured_vaf: the same by inertia, damping and stiffness alone [%].
    """

    lag: Array
    response: Array
    left_out_vaf: float
    structured_vaf: float


def check_intrinsic(signals: JointSignals, reflex: Array) -> IntrinsicCheck:
    """Regress what the reflex path leaves on the movement at lags to either side.

    Args:
      signals: of trials on a position servo.
      reflex: torque of the reflex path, (trial, time).
    """
    used, step = signals.used, int(np.ceil(0.5 * signals.rate / signals.top))  # denser lags would be dependent
    n = round(REACH * signals.rate) // step
    lags = step * np.arange(-n, n + 1)
    shifted = [np.roll(signals.acceleration, lag, axis=1) for lag in lags]
    common = [signals.angle, signals.velocity]
    torque = without_drift((signals.torque - reflex)[:, used])
    shares: list[float] = []
    weights: Array = np.empty(0)
    for columns in ([*common, signals.acceleration], [*common, *shifted]):
        matrix = without_drift(np.stack(columns, axis=-1)[:, used])
        shares.append(left_out_share(torque, left_out_predictions(matrix, torque)))
        weights = np.asarray(np.linalg.lstsq(matrix.reshape(-1, matrix.shape[2]), torque.ravel(), rcond=None)[0])
    return IntrinsicCheck(lags / signals.rate, weights[len(common) :], shares[1], shares[0])
