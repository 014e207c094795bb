"""Whether the joint angles of a trial belong to its path: they show an axis or a joint that is named wrongly.

The path that angles and segment lengths give is compared with the displacement, both without their means. A balance of
forces does not show what is turned or mirrored in all signals alike; angles do.
"""

import math

import numpy as np

from armperturb.analysis.measures.kinematics import hand_position
from armperturb.arrays import Array
from armperturb.convert.faults import Timed

OFF = 0.02
"""Share of the path's power that angles leave unexplained from which on other axes and joints are tried [-]."""

FAR_BETTER = 0.1
"""Largest ratio of what a change leaves unexplained to what the declared angles leave, to be named [-]."""

_X, _Y, _SWAP = np.diag([-1.0, 1.0]), np.diag([1.0, -1.0]), np.array([[0.0, 1.0], [1.0, 0.0]])

OF_AXES = {
    "x mirrored": _X,
    "y mirrored, or both angles negated": _Y,
    "x and y mirrored": _X @ _Y,
    "x and y swapped": _SWAP,
    "x and y swapped, then x mirrored": _X @ _SWAP,
    "x and y swapped, then y mirrored": _Y @ _SWAP,
    "x and y swapped, then both mirrored": _X @ _Y @ _SWAP,
}
"""Change of the axes to what it makes of a displacement, (axis, axis)."""

OF_JOINTS = {
    "the angle of the shoulder negated": _X,
    "the angle of the elbow negated": _Y,
    "shoulder and elbow swapped": _SWAP,
    "shoulder and elbow swapped, then the shoulder's angle negated": _X @ _SWAP,
    "shoulder and elbow swapped, then the elbow's angle negated": _Y @ _SWAP,
    "shoulder and elbow swapped, then both angles negated": _X @ _Y @ _SWAP,
}
"""Change of the joints to what it makes of angles, (joint, joint)."""


def require_path_of_angles(trial: Timed) -> None:
    """Refuse angles that would give the path far better with other axes or joints; without lengths nothing is checked.

    Args:
      trial: in SI and our axes.

    Raises:
      ValueError: there is such a change; the message names it.
    """
    lengths = tuple(trial.labels.get(name, math.nan) for name in ("l_h", "l_f"))
    if "joint_angle" not in trial.signals or np.isnan(lengths).any():
        return
    angle, moved = trial.signals["joint_angle"], trial.signals["displacement"]
    power = _power(moved)
    declared = _power(moved - hand_position(angle, *lengths))
    if not declared > OFF * power > 0.0:
        return
    left = {
        **{name: _power(moved @ turn.T - hand_position(angle, *lengths)) for name, turn in OF_AXES.items()},
        **{name: _power(moved - hand_position(angle @ turn.T, *lengths)) for name, turn in OF_JOINTS.items()},
    }
    best = min(left, key=left.__getitem__)
    if left[best] < FAR_BETTER * declared:
        raise ValueError(
            f"{trial.where}: joint_angle, l_h and l_f leave {declared / power:.2g} of the power of displacement "
            f"unexplained, but {left[best] / power:.2g} with {best}; expected angles of the arm that moves the handle, "
            "and axes as the seated person sees them (axes and signals.joint_angle.channels of the sidecar)"
        )


def _power(path: Array) -> float:
    """Of a path without its mean [m^2]."""
    return float(np.square(path - path.mean(axis=0)).sum())
