"""How an arm comes to rest with its hand at the handle, the force that the handle then bears, and its poles there."""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from armperturb.arrays import Array, Indices
from armperturb.envs.lab.trial import RK4_LIMIT

AT_REST = 1e-7
"""Acceleration, and rate of activations, below which nothing has to settle [rad/s^2, m/s^2; 1/s]."""

SETTLING = 30.0
"""Longest simulated time that an arm is given to come to rest [s]."""

PROBE = 1e-5
"""Displacement [rad, m] and velocity [rad/s, m/s] by which slopes of the acceleration are told."""

GROWTH = 0.01
"""Largest real part of the poles of a stable arm [1/s]; what rounding makes of a pole at zero is below it."""

IMMOVABLE = 1e9
"""Mass of a handle that is held [kg]."""

STILL = 1e-9
"""Displacement and change of activations in a step below which an arm counts as still [rad, m; -]."""

STILL_STEPS = 100
"""Steps in a row for which it has to."""

LEFT = 0.9
"""Share of its velocity that an arm keeps from one step to the next while it settles [-]."""


@dataclass(frozen=True)
class Settled:
    """How an arm came to rest with its hand at the handle, which was held.

    Attributes:
      force: of the handle on the hand [N], (axis,).
      time: that it took, simulated [s].
    """

    force: Array
    time: float


def settle(model: mujoco.MjModel, data: mujoco.MjData, handle: Indices, slides: Indices, gauge: int) -> Settled:
    """Let the arm find its rest with the handle held at its start; an arm that is at rest stays to the last bit.

    Controls have been what they are for ever: activations follow them, and delays are over.

    Args:
      model: of arm and manipulator.
      data: whose state changes.
      handle: where its displacement is among the positions.
      slides: where its velocity is.
      gauge: first component of the strain gauge among the sensors.

    Raises:
      ValueError: the arm does not come to rest.
    """
    _fill_delays(model, data)
    mujoco.mj_forward(model, data)
    if max(np.abs(data.qacc).max(), np.abs(data.act_dot).max(initial=0.0)) < AT_REST:
        return Settled(np.zeros(2), 0.0)
    held = copy.copy(model)
    held.dof_armature[slides] = IMMOVABLE
    n_steps = round(SETTLING / model.opt.timestep)
    step = still = 0
    while step < n_steps and still < STILL_STEPS:
        before = np.concatenate([data.qpos, data.act])
        mujoco.mj_step(held, data)
        data.qvel *= LEFT
        still = still + 1 if np.abs(np.concatenate([data.qpos, data.act]) - before).max() < STILL else 0
        step += 1
    if still < STILL_STEPS:
        moving = model.joint(model.dof_jntid[np.abs(data.qvel).argmax()])
        raise ValueError(
            f"Laboratory: the arm does not come to rest within {SETTLING:g} s, joint {moving.name!r} of body "
            f"{model.body(moving.bodyid[0]).name!r} moves; expected a posture that springs and muscles hold (another "
            "posture or activation, or joints that are locked)"
        )
    data.qpos[handle] = 0.0
    rest = data.qpos.copy(), data.act.copy(), data.ctrl.copy()
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.act[:], data.ctrl[:] = rest
    _fill_delays(model, data)
    mujoco.mj_forward(model, data)
    force = data.sensordata[gauge : gauge + 2].copy()
    return Settled(force, step * model.opt.timestep)


def _fill_delays(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Let delayed actuators have had their control of now for as long as they look back."""
    for actuator, (length, _) in enumerate(model.actuator_history):
        if length:
            times = data.time + np.arange(-length, 0) * model.opt.timestep
            mujoco.mj_initCtrlHistory(model, data, actuator, times, np.full(length, data.ctrl[actuator]))


def _poles(model: mujoco.MjModel, data: mujoco.MjData, slides: Indices, force: Array) -> Array:
    """Of arm and manipulator at rest, with activations constant [1/s], (pole,).

    Args:
      model: of arm and manipulator.
      data: at rest.
      slides: where the handle's velocity is.
      force: that the manipulator bears [N], (axis,).
    """
    probe, nv = copy.copy(data), model.nv
    probe.qfrc_applied[slides] = force

    def acceleration(turn: Array, velocity: Array) -> Array:
        probe.qpos[:] = data.qpos
        mujoco.mj_integratePos(model, probe.qpos, turn, 1.0)
        probe.qvel[:], probe.qacc_warmstart[:] = velocity, 0.0
        mujoco.mj_forward(model, probe)
        return np.array(probe.qacc)

    none = np.zeros(nv)
    slopes = [
        [(acceleration(*move(way)) - acceleration(*move(-way))) / (2.0 * PROBE) for way in PROBE * np.eye(nv)]
        for move in (lambda way: (way, none), lambda way: (none, way))
    ]
    of_position, of_velocity = (np.transpose(slope) for slope in slopes)
    matrix = np.block([[np.zeros((nv, nv)), np.eye(nv)], [of_position, of_velocity]])
    return np.asarray(np.linalg.eigvals(matrix))


def require_slow(model: mujoco.MjModel, data: mujoco.MjData, slides: Indices) -> None:
    """Refuse an arm that is too fast for the step of the simulation; arguments as in `_poles`.

    Raises:
      ValueError: it is.
    """
    fastest, timestep = float(np.abs(_poles(model, data, slides, np.zeros(2))).max()), model.opt.timestep
    if fastest * timestep > RK4_LIMIT:
        raise ValueError(
            f"Laboratory: fastest pole of arm and grip = {fastest:.4g} 1/s; expected at most "
            f"{RK4_LIMIT / timestep:.4g} 1/s at timestep = {timestep:g} s (a smaller timestep, or a softer grip)"
        )


def require_stable(model: mujoco.MjModel, data: mujoco.MjData, slides: Indices, force: Array) -> None:
    """Refuse an arm that does not return to its rest; arguments as in `_poles`.

    Raises:
      ValueError: it does not.
    """
    growth = float(_poles(model, data, slides, force).real.max())
    if growth > GROWTH:
        raise ValueError(
            f"Laboratory: the arm is unstable at rest, with {np.hypot(*force):.3g} N on the handle that the "
            f"manipulator bears (it departs with {growth:.3g} 1/s); expected a rest to which it returns (a posture "
            "or a handle nearer to where springs and muscles rest by themselves, or a stiffer arm)"
        )
