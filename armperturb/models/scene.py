"""The manipulator and the grip around an arm that somebody else has modelled."""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.extras import naming_the_extra
from armperturb.models.copies import require_moderate
from armperturb.models.rig import AHEAD, GRIP, KNOWN, MANIPULATOR_XML, RIG_XML, SLIDES, STRAIN_GAUGE

PREFIX = "lab/"
"""Before the names of what the laboratory adds to a model."""

PUSHES = KNOWN[2:]
"""Motors of the handle, see `rig.KNOWN`."""

UPRIGHT = ("grip_above", "grip_below")
"""Tendons that hold a hand which could leave the plane at the height of the handle."""

NEVER_DISABLED = 31
"""Group of actuators that no option of a model can disable, as it can those up to 30."""

MYO_SIM = "myo_sim:"
"""Begins the name of a model of the package myo-sim, where one could also name a file."""


@dataclass(frozen=True, kw_only=True)
class Grip:
    """How the hand holds the handle: a spring and a damper that are the same in all directions of the plane.

    Attributes:
      stiffness: [N/m], > 0.
      damping: [Ns/m], >= 0.
      upright: whether it also holds the hand at the height of the handle.
    """

    stiffness: float
    damping: float
    upright: bool


def load_arm(source: str | Path | mujoco.MjSpec) -> mujoco.MjSpec:
    """An arm's model, to be changed, in which every joint and actuator has a name, and masses are those that it moves.

    One without is called after its kind and its place among them, from 0: "joint0", "actuator2".

    Args:
      source: an MJCF file, "myo_sim:NAME" for a model of the package myo-sim, or a specification, which stays as it is.

    Raises:
      ValueError: the file is no MJCF, or the package has no such model.
      OSError: the file cannot be read.
      MissingExtraError: the package myo-sim is not installed.
    """
    spec = source.copy() if isinstance(source, mujoco.MjSpec) else _read(source)
    for kind, elements in (("joint", spec.joints), ("actuator", spec.actuators)):
        taken = {element.name for element in elements}
        for place, element in enumerate(elements):
            if not element.name:
                element.name = f"{kind}{place}"
                while element.name in taken:
                    element.name += "_"
    _scale_to_total_mass(spec)
    return spec


def _scale_to_total_mass(spec: mujoco.MjSpec) -> None:
    """Give the arm the masses that its compiler's `settotalmass` means, which would scale the manipulator as well."""
    total, spec.compiler.settotalmass = spec.compiler.settotalmass, -1.0
    if total > 0.0:
        share = total / spec.copy().compile().body_mass.sum()
        for geom in spec.geoms:
            geom.mass, geom.density = geom.mass * share, geom.density * share
        for body in spec.bodies:
            body.mass *= share
            body.inertia, body.fullinertia = body.inertia * share, body.fullinertia * share


def _read(source: str | Path) -> mujoco.MjSpec:
    """A model as it is; errors as in `load_arm`."""
    if not str(source).startswith(MYO_SIM):
        require_moderate(Path(source))
    try:
        if str(source).startswith(MYO_SIM):
            with naming_the_extra(str(source)):
                import myo_sim
            return myo_sim.load_spec(str(source).removeprefix(MYO_SIM))
        with open(source, "rb"):  # MuJoCo's own messages do not tell a missing file from a damaged one
            return mujoco.MjSpec.from_file(str(source))
    except ValueError as error:
        raise ValueError(f"{source}: {' '.join(str(error).split())}; expected a model in MJCF") from None


def require_forces(arm: mujoco.MjSpec) -> None:
    """Refuse an option of a model that disables forces on which the laboratory, or what is asked of it, is built.

    Args:
      arm: whose gravity is that which acts.

    Raises:
      ValueError: there is such an option.
    """
    disable = mujoco.mjtDisableBit
    for name, flag, asked in (
        ("spring", disable.mjDSBL_SPRING, "springs of the arm, the grip and the manipulator"),
        ("damper", disable.mjDSBL_DAMPER, "dampers of the arm, the grip and the manipulator"),
        ("actuation", disable.mjDSBL_ACTUATION, "actuators of the arm and the manipulator"),
        ("gravity", disable.mjDSBL_GRAVITY if np.any(arm.option.gravity) else 0, "weights, as gravity = True asks,"),
    ):
        if arm.option.disableflags & flag:
            raise ValueError(
                f'Laboratory: <flag {name}="disable"/> of the model; expected no such flag, for {asked} to act'
            )


def in_laboratory(
    arm: mujoco.MjSpec, hand: str, environment: Environment, grip: Grip, place: Array, turn: float, timestep: float
) -> mujoco.MjSpec:
    """The arm's model with the manipulator, whose handle its hand grips.

    What the model says about itself stays: joints, tendons, actuators and sensors of the arm come first, and are called
    as they are. Nothing collides, and steps are those of the laboratory.

    Args:
      arm: from `load_arm`; stays as it is.
      hand: name of the site in the middle of the grip.
      environment: the manipulator.
      grip: of the hand.
      place: of the handle's start in the arm's world [m], (3,).
      turn: of the manipulator's x axis from the world's about the vertical [rad].
      timestep: of the simulation [s].
    """
    spec = arm.copy()
    for key in list(spec.keys):  # their sizes are those of the arm alone
        spec.delete(key)
    spec.option.timestep, spec.option.integrator = timestep, mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)  # the strain gauge is one
    frame = spec.worldbody.add_frame(pos=place, quat=[np.cos(turn / 2.0), 0.0, 0.0, np.sin(turn / 2.0)])
    _attach_manipulator(spec, frame, environment, grip.upright, timestep)
    _add_grip(spec, hand, grip)
    return spec


def _attach_manipulator(
    spec: mujoco.MjSpec, frame: mujoco.MjsFrame, environment: Environment, upright: bool, timestep: float
) -> None:
    """The manipulator, its motors and its strain gauge, in a frame that stands at the handle's start."""
    machine = mujoco.MjSpec.from_file(str(MANIPULATOR_XML))
    machine.body("manipulator").pos = np.zeros(3)
    machine.body("carriage").mass = environment.m_env
    machine.body("carriage").gravcomp = 1.0  # its table bears it, wherever the arm's world has its down
    for name in SLIDES:
        slide = machine.joint(name)
        slide.stiffness[0], slide.damping[0] = environment.k_env, environment.b_env
        slide.range = [-environment.workspace, environment.workspace]
    machine.geom("workspace").size[:2] = environment.workspace
    if upright:
        reach = machine.site("anchor_right").pos[0]
        for name, height in (("anchor_above", reach), ("anchor_below", -reach)):
            machine.body("gauge").add_site(name=name, pos=[0.0, 0.0, height], group=4)
    # Here, where the arm's own defaults do not reach.
    for name, slide in zip(PUSHES, SLIDES, strict=True):
        motor = machine.add_actuator(
            name=name, target=slide, trntype=mujoco.mjtTrn.mjTRN_JOINT, gear=[1.0, 0, 0, 0, 0, 0]
        )
        motor.set_to_motor()
        motor.group = NEVER_DISABLED
        motor.delay, motor.nsample, motor.interp = AHEAD * timestep, AHEAD + 1, 2  # a cubic
    machine.add_sensor(
        name=STRAIN_GAUGE,
        type=mujoco.mjtSensor.mjSENS_FORCE,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname="gauge",
    )
    spec.attach(machine, prefix=PREFIX, frame=frame)


def _add_grip(spec: mujoco.MjSpec, hand: str, grip: Grip) -> None:
    """Tendons from the hand to the anchors around the handle, as those of the rig."""
    rest = mujoco.MjSpec.from_file(str(RIG_XML)).tendon(GRIP[0]).springlength
    for name in (*GRIP, *(UPRIGHT if grip.upright else ())):
        tendon = spec.add_tendon(name=PREFIX + name, springlength=rest, group=4)
        tendon.limited = tendon.actfrclimited = False  # whatever the arm's tendons are by default
        tendon.frictionloss, tendon.armature, tendon.stiffness[:], tendon.damping[:] = 0.0, 0.0, 0.0, 0.0
        tendon.stiffness[0], tendon.damping[0] = grip.stiffness / 2, grip.damping / 2
        tendon.wrap_site(hand)
        tendon.wrap_site(PREFIX + name.replace("grip", "anchor"))
