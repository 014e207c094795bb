"""What an arm looks like to an analysis that thinks of it as two segments in the plane of the handle."""

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from armperturb.arrays import Array
from armperturb.validation import RANGES

UPRIGHT = 1e-6
"""Largest horizontal component of the axis of a hinge that is vertical [-]."""

SHORTEST: float = RANGES["Subject"]["l_h"]["at_least"]
"""Length below which a segment is none [m]."""

EXACT = 12
"""Decimals to which lengths [m] and angles [rad] are read off a model."""


@dataclass(frozen=True, kw_only=True)
class Segments:
    """Lengths and start posture in the plane of the handle, as a recording has them: of a left arm as in a mirror.

    Attributes:
      is_left: whether the elbow bends to the other side than a right arm's, so that x points the other way.
      l_h: from shoulder to elbow [m].
      l_f: from elbow to hand [m].
      theta_s_deg: angle of the first from the handle's x axis [deg].
      theta_e_deg: angle of the second from the first [deg].
      hinges: where the angles of shoulder and elbow are in qpos; none where other joints move the hand as well.
      signs: of these angles, (joint,).
      offsets: to add to them [rad], (joint,).
      unknown: why lengths and angles are nan, and what mends it.
    """

    is_left: bool = False
    l_h: float = np.nan
    l_f: float = np.nan
    theta_s_deg: float = np.nan
    theta_e_deg: float = np.nan
    hinges: tuple[int, ...] = ()
    signs: tuple[float, ...] = ()
    offsets: tuple[float, ...] = ()
    unknown: str = ""

    @property
    def refused(self) -> str:
        """Why `identify` and a video refuse such an arm, and what mends it, in a line; empty where they take it."""
        if self.unknown:
            return self.unknown
        for field, joint, mend in (
            ("theta_s_deg", "shoulder", "turn_deg turns the axes from which it is measured"),
            ("theta_e_deg", "elbow", "posture_deg bends it"),
        ):
            low, high = (RANGES["Subject"][field][end] for end in ("at_least", "at_most"))
            if not low <= getattr(self, field) <= high:
                return f"identify and video expect the {joint} at {low:g} to {high:g} deg; the option {mend}"
        return ""


def moving_joints(model: mujoco.MjModel, body: int) -> list[int]:
    """Ids of the joints between the world and a body."""
    joints: list[int] = []
    while body:
        first = model.body_jntadr[body]
        joints = [*range(first, first + model.body_jntnum[body]), *joints]
        body = model.body_parentid[body]
    return joints


def segments_of(
    model: mujoco.MjModel, data: mujoco.MjData, hand: int, turn: float, named: tuple[str, str] | None
) -> Segments:
    """The two segments of an arm in its posture.

    Args:
      model: of the arm.
      data: in its posture.
      hand: id of the site in the middle of the grip.
      turn: of the handle's x axis about the vertical [rad].
      named: joints whose places count as shoulder and elbow; None takes the only two that move the hand, if these are
        hinges about the vertical, and segments are no points.

    Raises:
      ValueError: a named joint does not move the hand, the elbow is not between shoulder and hand, or a segment is a
        point.
    """
    joints = moving_joints(model, int(model.site_bodyid[hand]))
    planar = len(joints) == 2 and all(
        model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and np.hypot(*data.xaxis[j, :2]) < UPRIGHT for j in joints
    )
    if named is None and len(joints) < 2:
        return Segments(unknown="one joint moves the hand; identify and video need two")
    if named is None and not planar:
        return Segments(
            unknown="lengths and angles are unknown, which identify and video need; the option joints names two joints"
        )
    ends = joints if named is None else [model.joint(name).id for name in named]
    if not (set(ends) <= set(joints) and joints.index(ends[0]) < joints.index(ends[1])):
        moving = ", ".join(model.joint(j).name for j in joints)
        raise ValueError(
            f"Laboratory: joints = {named!r}; expected shoulder and elbow, two of the joints that move the hand, in "
            f"the order in which they stand between trunk and hand: {moving}"
        )
    upper, lower = np.diff([*data.xanchor[ends, :2], data.site_xpos[hand, :2]], axis=0)
    first, second = (np.arctan2(along[1], along[0]) for along in (upper, lower))
    angle = _wrapped(np.array([first - turn, second - first]))
    is_left = bool(angle[1] < 0.0)
    angle = np.round(_wrapped(np.array([np.pi, 0.0]) - angle) if is_left else angle, EXACT)
    length = np.round(np.hypot(*np.array([upper, lower]).T), EXACT)
    if length.min() < SHORTEST:
        if named is None:
            return Segments(
                unknown=f"segments are {length[0]:.3g} and {length[1]:.3g} m long; identify and video need at least "
                f"{SHORTEST:g} m (a hand that is not at a joint)"
            )
        raise ValueError(
            f"Laboratory: joints = {named!r}; expected segments of at least {SHORTEST:g} m in the plane, and not of "
            f"{length[0]:.3g} and {length[1]:.3g} m (other joints, or another hand_site)"
        )
    segments = Segments(
        is_left=is_left,
        l_h=float(length[0]),
        l_f=float(length[1]),
        theta_s_deg=float(np.round(np.degrees(angle[0]), EXACT - 2)),
        theta_e_deg=float(np.round(np.degrees(angle[1]), EXACT - 2)),
    )
    if not planar or ends != joints:
        return segments
    hinges = model.jnt_qposadr[joints]
    signs = np.sign(data.xaxis[joints, 2]) * (-1.0 if is_left else 1.0)
    offsets = np.round(angle - signs * data.qpos[hinges], EXACT - 2)  # not wrapped: recorded angles start at `angle`
    return replace(segments, hinges=tuple(map(int, hinges)), signs=tuple(signs), offsets=tuple(offsets + 0.0))


def _wrapped(angle: Array) -> Array:
    """Above -pi, up to pi [rad]; what is -pi within rounding becomes pi."""
    most = np.pi + 10.0 ** (2 - EXACT)
    return most - (most - angle) % (2.0 * np.pi)
