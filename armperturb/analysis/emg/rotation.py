"""Rotation of the joints, to which EMG answers, as recorded or from where the hand is."""

import math

import numpy as np
from scipy import signal

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.subject import Subject


def rotation(trials: ConditionTrials, arm: Subject | None = None) -> Array:
    """Rotation of the joints, from their angles or, for small movements, from the handle [rad], (trial, time, 2).

    Args:
      trials: of one condition.
      arm: whose grip gives between handle and hand; None for a rigid one. It does not matter where angles are known.
    """
    if "joint_angle" in trials.recording.data_vars:
        return np.asarray(trials.recording["joint_angle"].values, dtype=float)
    hand, force = trials.recorded_displacement, trials.force
    if arm is not None and math.isfinite(arm.k_h):
        # f = (b_h s + k_h) of what the handle moves further than the hand.
        give = signal.bilinear([1.0], [arm.b_h, arm.k_h], trials.rate)
        first = signal.lfilter_zi(*give)[:, None] * force[:, None, 0]
        hand = hand - signal.lfilter(*give, force, axis=1, zi=first)[0]
    return np.asarray(hand @ np.linalg.inv(hand_jacobian(trials.body)).T)
