"""The loop over steps of one joint, compiled: muscle law and reflexes of the arm, then MuJoCo's own `mj_step`."""

import mujoco
import numpy as np
from numba import carray

from armperturb.arrays import Array, Indices
from armperturb.controllers.compiled import act, delayed
from armperturb.controllers.lanes import Table
from armperturb.envs.lab.stepping import numbers_at, step_address, step_once
from armperturb.jit import compiled

ANGLE, VELOCITY, HELD = range(3)
"""Columns of a log: angle [rad] and velocity [rad/s] at the start of a step, torque on the limb held over it [Nm]."""

NEUTRAL, STIFFNESS, DAMPING, GAIN = range(4)
"""Columns of a course: neutral angle [rad], stiffness [Nm/rad], damping [Nms/rad] and factor on feedback [-]."""


def advance_joint(
    model: mujoco.MjModel, data: mujoco.MjData, person: Table, memory: Table, course: Array, drive: Array, noise: Array
) -> Array:
    """Simulate a joint from where its data is.

    Args:
      model: from `build_joint_model`; its spring and damper are changed.
      data: of the model.
      person: one row, see `lanes.control_columns`; the feedback gains are changed.
      memory: of the person, see `lanes.control_memory`.
      course: of the parameters at the start of each step, (step, 4).
      drive: torque of the device over each step [Nm], (step,).
      noise: torque of the person's noise over each step [Nm], (step,).

    Returns:
      Log, (step, 3), see `ANGLE`.
    """
    log = np.zeros((len(drive), 3))
    addresses = np.array(
        [
            step_address(),
            model._address,
            data._address,
            *(array.ctypes.data for array in (data.qpos, data.qvel, data.qfrc_applied)),
            *(array.ctypes.data for array in (model.jnt_stiffness, model.dof_damping, model.qpos_spring)),
        ],
        dtype=np.intp,
    )
    _advance(addresses, model.opt.timestep, person, memory, course, drive, noise, log)
    return log


@compiled(nogil=True)
def _advance(
    addresses: Indices,
    timestep: float,
    person: Table,
    memory: Table,
    course: Array,
    drive: Array,
    noise: Array,
    log: Array,
) -> None:
    work, held, sent, angle, velocity = np.zeros((4, 3)), np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    qpos, qvel = carray(numbers_at(addresses[3]), (1,)), carray(numbers_at(addresses[4]), (1,))
    applied = carray(numbers_at(addresses[5]), (1,))
    spring, damper = carray(numbers_at(addresses[6]), (1,)), carray(numbers_at(addresses[7]), (1,))
    neutral = carray(numbers_at(addresses[8]), (1,))
    p, m = person[0], memory[0]
    kv, kv_group, kp = p.kv[0], p.kv_groups[0], p.kp[0]
    n_sent = m.sent.shape[0]
    for step in range(len(drive)):
        angle[0], velocity[0] = qpos[0], qvel[0]
        neutral[0] = course[step, NEUTRAL]
        spring[0], damper[0] = course[step, STIFFNESS], course[step, DAMPING]
        gain = course[step, GAIN]
        p.kv[0], p.kv_groups[0], p.kp[0] = gain * kv, gain * kv_group, gain * kp
        act(p, m, angle, velocity, timestep, work, held, sent)
        torque = held[0] + noise[step]
        if p.reflexive != 0.0:
            newest = m.next - 1 if m.next > 0 else n_sent - 1
            # A torque that is held over a step acts at its middle.
            torque -= delayed(m.sent, 0, newest, p.delay[0] / timestep - 0.5)
        log[step, ANGLE], log[step, VELOCITY], log[step, HELD] = angle[0], velocity[0], torque
        applied[0] = torque + drive[step]
        step_once(addresses[0], addresses[1], addresses[2])
