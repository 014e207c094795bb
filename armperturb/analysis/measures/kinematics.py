"""Joint rotations and velocities from the path of the handle: the closed-form inverse of a two-link arm.

The trunk is strapped, so that the shoulder stays, and the hand is taken to be where the handle is. What this neglects
is the grip's deflection, force over grip stiffness: some millimetres, which in a pulse is a few percent of a rotation
or velocity, and up to a sixth of the little that the shoulder turns in RT. A shoulder that moves all the same is put
right by its own path, from the marker on it. With the vector r from shoulder to hand,

    cos(theta_e) = (|r|^2 - l_h^2 - l_f^2) / (2 l_h l_f),
    theta_s = angle(r) - atan2(l_f sin(theta_e), l_h + l_f cos(theta_e)),

of whose two solutions the one that bends the elbow as the start posture does is the arm's.

Velocities are central differences after a zero-phase low-pass. Encoders round to steps of 2 pi / 2^17 rad, which moves
the handle by up to 29 um and so the joints by noise of some s = 30 urad; white below `rate` / 2 and cut off at f_c it
leaves a velocity of 2 pi s sqrt(2 f_c^3 / (3 rate)) at most, 0.04 deg/s at 15 Hz and 0.16 deg/s at 40 Hz, beside the 4
to 160 deg/s that are measured. So the cut-off may be where the perturbation ends, at 40 Hz: `CUTOFF`. The differences
lose 0.4 % at 5 Hz and 1.6 % at 10 Hz, little as joints move mostly below.
"""

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from armperturb.arrays import Array
from armperturb.validation import require_number

CUTOFF = 40.0
"""Cut-off of the low-pass before differentiation [Hz]; see the head of this module."""

ORDER = 4
"""Order of the Butterworth low-pass, which is run forth and back."""


def hand_position(angle: ArrayLike, l_h: ArrayLike, l_f: ArrayLike) -> Array:
    """Position of the hand from the shoulder [m], (..., axis).

    Args:
      angle: of shoulder and elbow [rad], (..., joint).
      l_h: length of the humerus [m], of the shape that `angle` has without its last axis, or one that fits it.
      l_f: length of the forearm to the middle of the grip [m], likewise.
    """
    shoulder, elbow = np.moveaxis(np.asarray(angle, dtype=float), -1, 0)
    upper, lower = np.asarray(l_h, dtype=float), np.asarray(l_f, dtype=float)
    x = upper * np.cos(shoulder) + lower * np.cos(shoulder + elbow)
    y = upper * np.sin(shoulder) + lower * np.sin(shoulder + elbow)
    return np.stack([x, y], axis=-1)


def within_reach(position: ArrayLike, l_h: ArrayLike, l_f: ArrayLike) -> NDArray[np.bool_]:
    """Whether the hand can be at a position, (...).

    Args:
      position: of the hand from the shoulder [m], (..., axis).
      l_h: as in `hand_position`.
      l_f: likewise.
    """
    return np.asarray(np.abs(_elbow_cosine(np.asarray(position, dtype=float), l_h, l_f)) <= 1.0)


def joint_angles(position: ArrayLike, l_h: ArrayLike, l_f: ArrayLike, *, flexed: ArrayLike = True) -> Array:
    """Angles of shoulder and elbow that bring the hand to a position [rad], (..., joint).

    The elbow's angle is in 0 to pi, or -pi to 0 if it is not flexed; the shoulder's in -pi to pi.

    Args:
      position: of the hand from the shoulder [m], (..., axis).
      l_h: as in `hand_position`.
      l_f: likewise.
      flexed: whether the elbow bends to the positive side, likewise.

    Raises:
      ValueError: a position is out of reach, or not finite.
    """
    hand = np.asarray(position, dtype=float)
    cosine = _elbow_cosine(hand, l_h, l_f)
    # Rounding at full stretch is no refusal.
    beyond = ~(np.abs(cosine) <= 1.0 + 1e-12)
    if beyond.any():
        where = tuple(int(index) for index in np.argwhere(beyond)[0])
        segments = [float(np.broadcast_to(np.asarray(length), cosine.shape)[where]) for length in (l_h, l_f)]
        raise ValueError(
            f"the hand is {np.linalg.norm(hand[where]):.3f} m from the shoulder at {where}; expected "
            f"{abs(segments[0] - segments[1]):.3f} to {sum(segments):.3f} m, as the segments reach"
        )
    elbow = np.where(flexed, 1.0, -1.0) * np.arccos(np.clip(cosine, -1.0, 1.0))
    upper, lower = np.asarray(l_h, dtype=float), np.asarray(l_f, dtype=float)
    shoulder = np.arctan2(hand[..., 1], hand[..., 0])
    shoulder = shoulder - np.arctan2(lower * np.sin(elbow), upper + lower * np.cos(elbow))
    return np.stack([_within_half_a_turn(shoulder), elbow], axis=-1)


def start_posture(recording: xr.Dataset) -> Array:
    """Joint angles at the start of each trial [rad], (trial, joint)."""
    return np.radians(np.stack([recording["theta_s_deg"].values, recording["theta_e_deg"].values], axis=-1))


def hand_path(recording: xr.Dataset, *, shoulder: ArrayLike | None = None) -> Array:
    """Position of the handle from the shoulder, as displacement and start posture tell [m], (trial, time, axis).

    Args:
      recording: any trials.
      shoulder: displacement of the shoulder from its start [m], (trial, time, axis), such as the recording's
        `shoulder_marker`; None for a shoulder that stays.

    Raises:
      ValueError: shoulder has another shape.
    """
    start = hand_position(start_posture(recording), recording["l_h"].values, recording["l_f"].values)
    displacement = recording["displacement"].values
    if shoulder is not None:
        moved = np.asarray(shoulder, dtype=float)
        if moved.shape != displacement.shape:
            raise ValueError(f"shoulder of shape {moved.shape}; expected {displacement.shape}, (trial, time, axis)")
        displacement = displacement - moved
    return np.asarray(start[:, None] + displacement)


def joint_rotations(recording: xr.Dataset, *, shoulder: ArrayLike | None = None) -> Array:
    """Rotations from the start posture [rad], (trial, time, joint).

    Args:
      recording: trials whose handle stays within the arm's reach.
      shoulder: as in `hand_path`.

    Raises:
      ValueError: a handle is out of reach, or shoulder has another shape.
    """
    start, path = start_posture(recording), hand_path(recording, shoulder=shoulder)
    lengths = (recording[name].values[:, None] for name in ("l_h", "l_f"))
    angles = joint_angles(path, *lengths, flexed=np.sin(start[:, 1:]) >= 0.0)
    return _within_half_a_turn(angles - start[:, None])  # the shoulder may pass 180 deg


def true_rotations(recording: xr.Dataset) -> Array:
    """Rotations from the start posture as the simulation has them [rad], (trial, time, joint).

    Raises:
      ValueError: the recording has no joint angles, as those of people.
    """
    if "joint_angle" not in recording:
        raise ValueError("the recording has no joint_angle; expected one that was simulated")
    return np.asarray(recording["joint_angle"].values - start_posture(recording)[:, None])


def joint_velocities(rotation: ArrayLike, rate: float, *, cutoff: float | None = CUTOFF) -> Array:
    """Velocities of the joints [rad/s], (..., time, joint).

    Args:
      rotation: [rad], (..., time, joint).
      rate: of the samples [Hz].
      cutoff: of the low-pass that goes before, 4th-order Butterworth forth and back [Hz]; None differentiates the
        samples as they are.

    Raises:
      TypeError: rate or cutoff is no number.
      ValueError: the cut-off is not below half the rate.
    """
    require_number("joint_velocities", "rate", rate, above=0.0)
    smooth = np.asarray(rotation, dtype=float)
    if cutoff is not None:
        require_number("joint_velocities", "cutoff", cutoff, above=0.0, below=rate / 2)
        sections = signal.butter(ORDER, cutoff, fs=rate, output="sos")
        smooth = signal.sosfiltfilt(sections, smooth, axis=-2)
    return np.asarray(np.gradient(smooth, 1.0 / rate, axis=-2, edge_order=2))


def _within_half_a_turn(angle: Array) -> Array:
    return np.asarray(np.pi - np.mod(np.pi - angle, 2 * np.pi))


def _elbow_cosine(hand: Array, l_h: ArrayLike, l_f: ArrayLike) -> Array:
    upper, lower = np.asarray(l_h, dtype=float), np.asarray(l_f, dtype=float)
    return np.asarray((np.sum(hand**2, axis=-1) - upper**2 - lower**2) / (2 * upper * lower))
