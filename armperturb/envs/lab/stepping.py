"""The loop over steps, compiled: reflexes and muscles, then MuJoCo's own `mj_step`, for one arm after the other."""

import ctypes
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.extending import intrinsic

from armperturb.arrays import Array, Flags, Indices
from armperturb.controllers.compiled import act
from armperturb.controllers.lanes import Table
from armperturb.jit import compiled
from armperturb.models.rig import BIARTICULAR, JOINTS, REFLEXES, SLIDES, STRAIN_GAUGE

ARRAYS = ("qpos", "qvel", "ctrl", "qfrc_applied", "sensordata")
"""Fields of `MjData` that the loop reads and writes."""

DIVERGED = tuple(
    int(getattr(mujoco.mjtWarning, f"mjWARN_{name}")) for name in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")
)
"""Warnings of MuJoCo that it could not integrate an arm; each has a pair of numbers, of which the second counts."""

MUSCLES = ("jnt_stiffness", "dof_damping", "tendon_stiffness", "tendon_damping")
"""Fields of `MjModel` that springs and dampers of the muscles are in."""

EXCITATION, VELOCITY, HANDLE, ANGLE, FORCE, SHOULDER = (slice(first, first + 2) for first in range(0, 12, 2))
"""Columns of a log; the last where a strap lets the shoulder move."""


@functools.cache
def library() -> ctypes.CDLL:
    """MuJoCo's own library."""
    return ctypes.CDLL(str(next(Path(mujoco.__file__).parent.glob("libmujoco.*"))))


@functools.cache
def step_address() -> int:
    """Where `mj_step` is in memory."""
    return ctypes.cast(library().mj_step, ctypes.c_void_p).value or 0


def arm_table(models: Sequence[mujoco.MjModel], datas: Sequence[mujoco.MjData]) -> Table:
    """Where arms are in memory, and where in their arrays joints and motors are, (arm,)."""
    sizes = {name: (getattr(datas[0], name).shape[0]) for name in ARRAYS}
    sizes |= {name: getattr(models[0], name).size for name in MUSCLES}
    columns: dict[str, list[int]] = {
        "model": [model._address for model in models],
        "data": [data._address for data in datas],
        **{name: [getattr(data, name).ctypes.data for data in datas] for name in ARRAYS},
        **{name: [getattr(model, name).ctypes.data for model in models] for name in MUSCLES},
        **{f"n_{name}": [size] * len(models) for name, size in sizes.items()},
        "hinge": [model.joint(JOINTS[0]).qposadr[0] for model in models],
        "slide": [model.joint(SLIDES[0]).qposadr[0] for model in models],
        "two_joint": [model.tendon(BIARTICULAR).id for model in models],
        "motor": [model.actuator(REFLEXES[0]).id for model in models],
        "warnings": [data.warning.number.ctypes.data for data in datas],
        "gauge": [model.sensor(STRAIN_GAUGE).adr[0] for model in models],
    }
    table = np.zeros(len(models), [(name, np.intp) for name in columns])
    for name, values in columns.items():
        table[name] = values
    return table


def _call_step(typing_context: Any, address: Any, model: Any, data: Any) -> Any:
    """Call the C function at an address with a model and its data."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = ir.IntType(8).as_pointer()
        function = ir.FunctionType(ir.VoidType(), [pointer, pointer]).as_pointer()
        where, *objects = arguments
        builder.call(builder.inttoptr(where, function), [builder.inttoptr(item, pointer) for item in objects])
        return context.get_dummy_value()

    return types.void(types.intp, types.intp, types.intp), generate


def _pointer_to(kind: Any) -> Any:
    """What makes an address a pointer to numbers of a kind, which `carray` takes."""

    def point(typing_context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return types.CPointer(kind)(types.intp), generate

    return intrinsic(point)


step_once: Any = intrinsic(_call_step)
numbers_at, _counts = _pointer_to(types.float64), _pointer_to(types.int32)


@compiled(nogil=True)
def advance(
    mj_step: int, arms: Table, table: Table, memory: Table, known: Array, timestep: float, log: Array, diverged: Flags
) -> None:
    """Some steps of all arms.

    Args:
      mj_step: from `step_address`.
      arms: from `arm_table`.
      table: of the people, see `ArmControl`.
      memory: of theirs.
      known: what the motors of `KNOWN` do, `AHEAD` steps after the first step and on, (arm, step, motor).
      timestep: of the simulation [s].
      log: state at the start of each step and at the end of the last, to fill, (arm, step + 1, column); the force is
        that of the same moment, but at the end that of a step before, as MuJoCo's sensors have it.
      diverged: whether MuJoCo has put an arm back because it could not integrate it, to fill, (arm,).
    """
    work, held, sent, angle, velocity = np.zeros((4, 3)), np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    for lane in range(len(arms)):
        a = arms[lane]
        qpos, qvel = carray(numbers_at(a.qpos), (a.n_qpos,)), carray(numbers_at(a.qvel), (a.n_qvel,))
        ctrl, applied = carray(numbers_at(a.ctrl), (a.n_ctrl,)), carray(numbers_at(a.qfrc_applied), (a.n_qfrc_applied,))
        sensors = carray(numbers_at(a.sensordata), (a.n_sensordata,))
        p, m = table[lane], memory[lane]
        for step in range(known.shape[1] + 1):
            row = log[lane, step]
            for i in range(2):
                angle[i], velocity[i] = qpos[a.hinge + i], qvel[a.hinge + i]
                row[2 + i], row[4 + i], row[6 + i] = velocity[i], qpos[a.slide + i], angle[i]
                if log.shape[2] > 10:
                    row[10 + i] = qpos[i]
            if step == known.shape[1]:
                for i in range(2):
                    row[i], row[8 + i] = log[lane, step - 1, i], log[lane, step - 1, 8 + i]
                break
            act(p, m, angle, velocity, timestep, work, held, sent)
            for i in range(2):
                row[i] = m.excitation[i]
                applied[a.hinge + i], ctrl[a.motor + i] = held[i], sent[i]
            for i in range(4):
                ctrl[a.motor + 2 + i] = known[lane, step, i]
            step_once(mj_step, a.model, a.data)
            for i in range(2):
                row[8 + i] = sensors[a.gauge + i]
        counts = carray(_counts(a.warnings), (2 * max(DIVERGED) + 1,))
        diverged[lane] = False
        for warning in DIVERGED:
            diverged[lane] |= counts[2 * warning] > 0


@compiled()
def set_muscles(arms: Table, which: Indices, stiffness: Array, damping: Array) -> None:
    """Change springs and dampers of the muscles of some arms.

    Args:
      arms: from `arm_table`.
      which: indices of those.
      stiffness: of the groups (shoulder, two-joint, elbow) [Nm/rad], (arm, element).
      damping: of the groups [Nms/rad], likewise.
    """
    for i in range(len(which)):
        a = arms[which[i]]
        for joints, n_joints, tendons, n_tendons, groups in (
            (a.jnt_stiffness, a.n_jnt_stiffness, a.tendon_stiffness, a.n_tendon_stiffness, stiffness[i]),
            (a.dof_damping, a.n_dof_damping, a.tendon_damping, a.n_tendon_damping, damping[i]),
        ):
            of_joints, of_tendons = carray(numbers_at(joints), (n_joints,)), carray(numbers_at(tendons), (n_tendons,))
            of_joints[a.hinge], of_joints[a.hinge + 1], of_tendons[a.two_joint] = groups[0], groups[2], groups[1]
