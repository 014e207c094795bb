"""From a person and a manipulator to one compiled MuJoCo model (thesis 2.2, 2.7; appendix B.1)."""

import functools
import math
from pathlib import Path

import mujoco
import numpy as np

from armperturb.arrays import Array
from armperturb.environment import TIMESTEP, Environment, Strap
from armperturb.subject import Subject
from armperturb.validation import require_number, require_one_of, require_type, require_whole

ARM_XML, MANIPULATOR_XML, RIG_XML = (Path(__file__).parent / f"{name}.xml" for name in ("arm", "manipulator", "rig"))
"""The MJCF files; each loads on its own, `rig.xml` includes the other two."""

JOINTS = ("shoulder", "elbow")
"""Hinges of the arm: qpos is the angle [rad], the shoulder's from the x axis, the elbow's from the humerus."""

SLIDES = ("carriage_x", "carriage_y")
"""Slides of the manipulator: qpos is the displacement of the handle from its start [m]."""

STRAP = ("strap_x", "strap_y")
"""Slides of the shoulder on the seat, where a strap lets it move: qpos is its displacement from its start [m]."""

REFLEXES = ("reflex_shoulder", "reflex_elbow")
"""Motors: ctrl is the torque added at the joint [Nm], which acts after the neural delay of that joint."""

KNOWN = ("torque_shoulder", "torque_elbow", "push_x", "push_y")
"""Motors of what is known ahead: ctrl is the torque on the joint [Nm], force on the handle [N], `AHEAD` steps later."""

AHEAD = 3
"""Steps that MuJoCo must know ahead to interpolate a control by a cubic; no neural delay is shorter."""

ANGLE_SENSORS = ("shoulder_angle", "elbow_angle")
"""Joint angles [rad]."""

HANDLE_SENSORS = ("handle_x", "handle_y")
"""Displacement of the handle from its start [m]."""

STRAIN_GAUGE = "strain_gauge"
"""Force that the handle exerts on the hand [N], world axes (x, y, z)."""

GRIP = ("grip_right", "grip_left", "grip_front", "grip_back")
"""Tendons of the grip, from the hand to its anchors around the handle."""

BIARTICULAR = "biarticular"
"""Tendon of the two-joint muscles."""

ROPE = "rope"
"""Tendon that carries the arm's weight."""

HAND_SITE = "hand"
"""Site at the end of the forearm: the middle of the grip."""

ROPES = ("ideal", "pendulum")
"""What a rope does beside carrying the arm: nothing, or pull it back under the ceiling point as a pendulum does."""

GRAVITY = 9.81
MEMORY = 2**18
"""Of MuJoCo's stack in each `MjData` [bytes]; limits are all that needs any."""
ROPE_LENGTH = 2.0


def history_length(subject: Subject, timestep: float = TIMESTEP) -> int:
    """Number of past controls that MuJoCo must keep to delay both reflex torques of a person.

    Args:
      subject: whose delays.
      timestep: step of the simulation [s].

    Returns:
      The number of samples. Models of one `mujoco.batch.Batch` need the same: the largest of theirs.

    Raises:
      ValueError: timestep is not positive, or a delay is shorter than three of them.
    """
    require_number("history_length", "timestep", timestep, above=0.0)
    for field in ("Td_s", "Td_e"):
        # MuJoCo's cubic takes two stored controls on either side, and the newest is that of the step before.
        require_number("Subject", field, getattr(subject, field), at_least=round(AHEAD * timestep, 12))
    # Rounded, so that 0.3 / 0.1 is three.
    return max(math.ceil(round(delay / timestep, 9)) for delay in (subject.Td_s, subject.Td_e)) + 2


def build_model(
    subject: Subject,
    environment: Environment = Environment(),  # noqa: B008
    *,
    timestep: float = TIMESTEP,
    rope: str = "ideal",
    strap: Strap | None = None,
    n_history: int | None = None,
    visual: bool = True,
) -> mujoco.MjModel:
    """Compile the rig: a person's arm that grips the manipulator, at rest at the start posture.

    `MjData(model)` starts in equilibrium. Intrinsic muscle and grip are in the model; reflexes are torques that a
    controller writes to `ctrl` at the start of each step, undelayed: the model delays them. So are perturbations, which
    it writes to the motors of `KNOWN`, `AHEAD` steps ahead; `start_motors` tells these what comes before that.

    Args:
      subject: whose arm, grip and delays.
      environment: virtual mass, spring, damper and workspace of the manipulator.
      timestep: step of the simulation [s], > 0.
      rope: "ideal" (the hinges carry the arm's weight W and the rope only shows), or "pendulum" (a rope of length
        h = 2 m carries W over the middle of the forearm, and pulls it back with W / h per displacement).
      strap: what lets the shoulder move; None holds it in place. The slides of `STRAP` come before the other joints.
      n_history: past controls kept per motor, at least `history_length(subject, timestep)`, which is the default. More
        changes no trajectory.
      visual: False leaves out all that only draws (geoms, cameras, lights, an ideal rope): a step costs less, and
        trajectories stay the same to the last bit.

    Returns:
      The model. Models of different people have the same sizes if n_history, rope, visual and whether there
      is a strap agree.

    Raises:
      ValueError: a delay is shorter than three steps, rope is unknown, timestep or n_history is out of range, or the
        subject has what `Subject.require_simulable` refuses.
      TypeError: subject is no `Subject`, timestep or n_history no number, or strap no `Strap`.
    """
    require_type("build_model: subject", subject, Subject, "a Subject, e.g. POSITION")
    return build_spec(
        subject, environment, timestep=timestep, rope=rope, strap=strap, n_history=n_history, visual=visual
    ).compile()


def build_spec(
    subject: Subject,
    environment: Environment,
    *,
    timestep: float,
    rope: str,
    strap: Strap | None,
    n_history: int | None = None,
    visual: bool = True,
) -> mujoco.MjSpec:
    """The rig before it is compiled, to read or change it; arguments and errors as in `build_model`."""
    subject.require_simulable()
    needed = history_length(subject, timestep)
    require_one_of("build_model", "rope", rope, ROPES)
    if strap is not None and not isinstance(strap, Strap):
        raise TypeError(f"build_model: strap = {strap!r}; expected Strap or None")
    n_history = needed if n_history is None else n_history
    require_whole("build_model", "n_history", n_history, at_least=needed)

    spec = _parsed_rig().copy()
    spec.option.timestep = timestep
    _set_arm(spec, subject)
    _set_strap(spec, subject, strap)
    _set_rope(spec, subject, rope)
    _set_manipulator(spec, subject, environment)
    for name, delay in zip(REFLEXES, (subject.Td_s, subject.Td_e), strict=True):
        motor = spec.actuator(name)
        motor.delay = delay
        motor.nsample = int(n_history)
    for name in KNOWN:
        spec.actuator(name).delay = AHEAD * timestep
    spec.memory = MEMORY
    if not visual:
        _leave_out_visuals(spec, rope)
    return spec


def build_arm(subject: Subject, *, timestep: float = TIMESTEP) -> mujoco.MjSpec:
    """The arm alone with the motors of its reflexes, as a model that `Laboratory` takes; see `build_model`."""
    spec = build_spec(subject, Environment(), timestep=timestep, rope="ideal", strap=None)
    spec.delete(spec.body("manipulator"))  # and with it what refers to its parts
    for name in KNOWN[:2]:
        spec.delete(spec.actuator(name))
    return spec


def start_motors(model: mujoco.MjModel, data: mujoco.MjData, first: int, known: Array) -> None:
    """Tell the motors of `KNOWN` what they do in the first steps.

    Args:
      model: of the rig.
      data: at rest, at time zero.
      first: index of the first of these motors.
      known: torques [Nm] and forces [N] one step before time zero, at it, and in the two steps that follow, (4, motor).
    """
    times = np.arange(-len(known), 0) * model.opt.timestep
    for motor, values in enumerate(np.transpose(known), start=first):
        mujoco.mj_initCtrlHistory(model, data, motor, times, np.ascontiguousarray(values))


@functools.cache
def _parsed_rig() -> mujoco.MjSpec:
    """The rig as its file has it; parsed once, to be copied."""
    return mujoco.MjSpec.from_file(str(RIG_XML))


def _hand_position(subject: Subject) -> np.ndarray:
    """Position of the hand in the shoulder's frame at the start posture [m], (axis,) (thesis eq. B.28)."""
    theta_s, theta_e = subject.posture
    elbow = subject.l_h * np.array([math.cos(theta_s), math.sin(theta_s)])
    return elbow + subject.l_f * np.array([math.cos(theta_s + theta_e), math.sin(theta_s + theta_e)])


def _sling_position(subject: Subject) -> np.ndarray:
    """Position of the middle of the forearm in the shoulder's frame at the start posture [m], (axis,)."""
    theta_s = subject.posture[0]
    elbow = subject.l_h * np.array([math.cos(theta_s), math.sin(theta_s)])
    return (elbow + _hand_position(subject)) / 2


def _set_arm(spec: mujoco.MjSpec, subject: Subject) -> None:
    """Segments with mass and inertia, posture, and linear intrinsic muscle (thesis fig. 2.8, eqs 2.6, 2.10)."""
    stretch = {"humerus": subject.l_h / spec.body("forearm").pos[0], "forearm": subject.l_f / spec.site("hand").pos[0]}
    for name, length, mass, centre, radius in (
        ("humerus", subject.l_h, subject.m_h, subject.c_h, subject.r_h),
        ("forearm", subject.l_f, subject.m_f, subject.c_f, subject.r_f),
    ):
        body = spec.body(name)
        body.mass = mass
        body.ipos = [centre * length, 0.0, 0.0]
        # A thin rod; what it has about its own axis takes no part in movements in the plane.
        body.inertia = body.inertia + mass * (radius * length) ** 2 * np.array([0.0, 1.0, 1.0])
        for geom in body.geoms:
            geom.pos = geom.pos * [stretch[name], 1.0, 1.0]
            if not np.isnan(geom.fromto[0]):
                geom.fromto = geom.fromto * [stretch[name], 1.0, 1.0, stretch[name], 1.0, 1.0]
    spec.body("forearm").pos = [subject.l_h, 0.0, 0.0]
    spec.site("sling").pos = [subject.l_f / 2, 0.0, 0.0]
    spec.site("hand").pos = [subject.l_f, 0.0, 0.0]

    k_s, k_se, k_e = subject.muscle_groups("k")
    b_s, b_se, b_e = subject.muscle_groups("b")
    for body_name, joint_name, angle, k, b in (
        ("humerus", "shoulder", subject.posture[0], k_s, b_s),
        ("forearm", "elbow", subject.posture[1], k_e, b_e),
    ):
        spec.body(body_name).alt.euler = [0.0, 0.0, angle]
        joint = spec.joint(joint_name)
        joint.ref = joint.springref = angle
        # The first coefficient is the linear one; single-joint groups may be negative, the matrix is what counts.
        joint.stiffness[0], joint.damping[0] = k, b
    biarticular = spec.tendon(BIARTICULAR)
    biarticular.stiffness[0], biarticular.damping[0] = k_se, b_se
    biarticular.springlength = [subject.posture.sum()] * 2


def _set_strap(spec: mujoco.MjSpec, subject: Subject, strap: Strap | None) -> None:
    """Spring, damper and mass between shoulder and seat; slides are deleted where the shoulder is held in place."""
    cosine, sine = math.cos(subject.posture[0]), math.sin(subject.posture[0])
    for name, axis in zip(STRAP, ([cosine, -sine, 0.0], [sine, cosine, 0.0]), strict=True):
        slide = spec.joint(name)
        if strap is None:
            spec.delete(slide)
        else:
            slide.axis = axis  # world axes in the frame of the humerus
            slide.stiffness[0], slide.damping[0], slide.armature = strap.stiffness, strap.damping, strap.mass


def _set_rope(spec: mujoco.MjSpec, subject: Subject, rope: str) -> None:
    """Ceiling point over the sling; as a pendulum, a spring of rest length zero that pulls up with the arm's weight."""
    spec.site("ceiling").pos = [*_sling_position(subject), spec.body("humerus").pos[2] + ROPE_LENGTH]
    if rope == "pendulum":
        spec.tendon(ROPE).stiffness[0] = (subject.m_h + subject.m_f) * GRAVITY / ROPE_LENGTH


def _set_manipulator(spec: mujoco.MjSpec, subject: Subject, environment: Environment) -> None:
    """The virtual environment under this person's hand, and the grip (thesis eqs 2.11, 2.13)."""
    spec.body("manipulator").pos = [*_hand_position(subject), spec.body("humerus").pos[2]]
    spec.body("carriage").mass = environment.m_env
    for name in SLIDES:
        slide = spec.joint(name)
        slide.stiffness[0], slide.damping[0] = environment.k_env, environment.b_env
        slide.range = [-environment.workspace, environment.workspace]
    spec.geom("workspace").size[:2] = environment.workspace
    for name in GRIP:
        tendon = spec.tendon(name)
        tendon.stiffness[0], tendon.damping[0] = subject.k_h / 2, subject.b_h / 2


def _leave_out_visuals(spec: mujoco.MjSpec, rope: str) -> None:
    """Delete everything that takes part in no force."""
    spec.compiler.discardvisual = True  # materials and textures
    for element in (*spec.geoms, *spec.meshes, *spec.cameras, *spec.lights):
        spec.delete(element)
    if rope == "ideal":
        spec.delete(spec.tendon(ROPE))
