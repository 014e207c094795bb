"""One joint and the device that is fixed to it, as a compiled MuJoCo model."""

from pathlib import Path

import mujoco

from armperturb.joint_person import JointPerson, Servo
from armperturb.validation import require_number

JOINT_XML = Path(__file__).parent / "joint.xml"

JOINT = "joint"
"""The hinge: qpos is the angle from the posture [rad]."""

JOINT_TIMESTEP = 5e-4
"""Step of simulations of one joint [s], by default: a position servo is fast."""


def build_joint_model(person: JointPerson, servo: Servo, *, timestep: float = JOINT_TIMESTEP) -> mujoco.MjModel:
    """Compile the rig: linear muscle and device are in the model, the rest are torques that a controller applies.

    Args:
      person: inertia, stiffness, short-range stiffness and damping of the joint.
      servo: the device.
      timestep: of the simulation [s], > 0.

    Raises:
      ValueError: timestep is out of its range.
    """
    require_number("build_joint_model", "timestep", timestep, above=0.0)
    spec = mujoco.MjSpec.from_file(str(JOINT_XML))
    spec.option.timestep = timestep
    joint, limb, device, tendon = spec.joint(JOINT), spec.body("limb"), spec.body("device"), spec.tendon("servo")
    joint.stiffness[0], joint.damping[0] = person.stiffness, person.damping
    limb.inertia, device.inertia = [person.inertia] * 3, [servo.inertia] * 3
    tendon.stiffness[0], tendon.damping[0] = servo.stiffness, servo.damping
    if person.muscle is not None:
        spec.tendon("short_range").stiffness[0] = person.muscle.of_elements("short_range_stiffness")[0]
    return spec.compile()
