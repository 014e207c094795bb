"""Where an arm starts before it comes to rest: hand, posture and keyframe, if the model has what is asked for."""

from collections.abc import Collection, Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armperturb.arrays import Array
from armperturb.envs.lab.posture import listed, take_posture
from armperturb.envs.lab.two_segments import UPRIGHT, moving_joints
from armperturb.models.scene import PREFIX
from armperturb.validation import require_number

Controls = dict[str, tuple[float, Array]]
"""Actuator to its control, and its activations (some have none)."""


def _has_joint(model: mujoco.MjModel, name: str) -> bool:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) >= 0


def require_hand(spec: mujoco.MjSpec, hand: str) -> None:
    """Refuse a hand that the model does not have.

    Raises:
      ValueError: it has no such site or body.
    """
    if spec.site(hand) is None and (spec.body(hand) is None or hand == "world"):
        sites, bodies = listed([site.name for site in spec.sites]), listed([body.name for body in spec.bodies[1:]])
        raise ValueError(
            f"Laboratory: hand_site = {hand!r}; expected a site of the model ({sites or 'it has none'}), or a body "
            f"({bodies})"
        )


def site_of_hand(spec: mujoco.MjSpec, hand: str) -> str:
    """Name of the site that is the hand, which a body gets at its origin."""
    if spec.site(hand) is not None:
        return hand
    spec.body(hand).add_site(name=PREFIX + "hand", group=4)
    return PREFIX + "hand"


def require_joints(spec: mujoco.MjSpec, names: Sequence[str], field: str) -> None:
    """Refuse names that no joint of the model has, which a field holds.

    Raises:
      ValueError: there is such a name.
    """
    for name in names:
        if spec.joint(name) is None:
            joints = listed([joint.name for joint in spec.joints])
            raise ValueError(f"Laboratory: {field} = {name!r}; expected a joint of the model ({joints})")


def start_of(
    spec: mujoco.MjSpec, posture_deg: Mapping[str, float], keyframe: str | None
) -> tuple[dict[str, ArrayLike], Controls]:
    """Joint to its coordinates [rad or m], and controls, where a keyframe and a posture [deg] say so.

    Raises:
      ValueError: the model has no such joint or keyframe, or an angle is out of its joint's range.
    """
    require_joints(spec, [*posture_deg], "posture_deg")
    model = spec.copy().compile()
    start: dict[str, ArrayLike] = {}
    controls: Controls = {}
    if keyframe is not None:
        names = [model.key(i).name for i in range(model.nkey)]
        if keyframe not in names:
            raise ValueError(
                f"Laboratory: keyframe = {keyframe!r}; expected one of the model ({listed(names) or 'it has none'})"
            )
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key(keyframe).id)
        start = {model.joint(j).name: data.joint(j).qpos.copy() for j in range(model.njnt)}
        controls = {
            model.actuator(i).name: (float(data.ctrl[i]), data.act[_activations(model, i)].copy())
            for i in range(model.nu)
        }
    for name, value in posture_deg.items():
        joint = model.joint(name)
        if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE:
            raise ValueError(f"Laboratory: posture_deg of {name!r}; expected a hinge")
        low, high = np.degrees(joint.range) if model.jnt_limited[joint.id] else (-360.0, 360.0)
        require_number("Laboratory", f"posture_deg of {name!r}", value, at_least=float(low), at_most=float(high))
        start[name] = float(np.radians(value))
    return start, controls


def _activations(model: mujoco.MjModel, actuator: int) -> slice:
    """Where those of an actuator are among the activations."""
    first = int(model.actuator_actadr[actuator])
    return slice(first, first + int(model.actuator_actnum[actuator]))


def take_controls(model: mujoco.MjModel, data: mujoco.MjData, controls: Controls) -> None:
    """Set controls and activations of the actuators that the model has; some went with joints that are locked."""
    for name, (control, activations) in controls.items():
        actuator = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
        if actuator >= 0:
            data.ctrl[actuator], data.act[_activations(model, actuator)] = control, activations


def in_posture(
    spec: mujoco.MjSpec, hand: str, start: Mapping[str, ArrayLike], held: Collection[str], place: Array | None
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The arm alone, as its joints start, of which some are held, or with its hand at a place in the world [m].

    Raises:
      ValueError: no joint moves the hand, or see `take_posture`.
    """
    arm = spec.compile()
    if not moving_joints(arm, int(arm.site(hand).bodyid[0])):
        raise ValueError(
            "Laboratory: no joint moves the hand; expected at least one (fewer locked joints, or another hand_site)"
        )
    data = mujoco.MjData(arm)
    moving = {name: value for name, value in start.items() if _has_joint(arm, name)}
    take_posture(arm, data, moving, [name for name in held if name in moving], arm.site(hand).id, place)
    return arm, data


def leaves_plane(model: mujoco.MjModel, data: mujoco.MjData, site: int) -> bool:
    """Whether joints can move the hand up or down."""
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jacobian, None, site)
    return bool(np.abs(jacobian[2]).max(initial=0.0) > UPRIGHT)
