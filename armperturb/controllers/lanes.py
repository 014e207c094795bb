"""People as rows of tables that compiled code can read: what muscles and reflexes are, and what they remember."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from armperturb.arrays import Array
from armperturb.muscle_law import MuscleLaw
from armperturb.subject import Subject

NEVER = 1e6
"""Stands for an elastic limit that is infinite [rad], where infinity times a vanished stiffness would be undefined."""

PARTS = 8
"""Elasto-plastic parts that there is always room for: compiled code is made anew for each other number."""

HISTORY = 128
"""Active torques that there is always room for, likewise; longer rings double."""

TRIPLES = ("k", "b", "kv", "kp", "ka", "kf")
"""Symmetric joint matrices, as their entries (s, se, e)."""

Table = NDArray[np.void]


def elastic_limit_shape(spread: float, parts: int) -> Array:
    """Elastic limits over their mean [-], (part,): middle quantiles of a log-normal distribution, scaled to mean one.

    Args:
      spread: SD over mean of the distribution [-], >= 0.
      parts: how many quantiles.
    """
    middle = (np.arange(parts) + 0.5) / parts
    shape = np.exp(np.sqrt(np.log1p(spread**2)) * special.ndtri(middle))
    return np.ones(parts) if spread == 0 else shape / shape.mean()


def activation_filter(cutoff: float, damping_ratio: float, timestep: float) -> tuple[Array, Array]:
    """Numerator and denominator of the activation dynamics (eq. B.19) in discrete time, (3,) each.

    The poles are exact. The numerator makes the frequency response equal to the continuous one in its value and first
    two derivatives at zero frequency, and by symmetry nearly in the third: a smooth input is then answered to fourth
    order, while one that runs straight between steps (first-order hold) would lack (omega timestep)^2 / 12.

    Args:
      cutoff: [Hz].
      damping_ratio: [-].
      timestep: of the simulation [s].
    """
    omega = 2 * np.pi * cutoff * timestep
    poles = np.exp(np.roots([1.0, 2 * damping_ratio * omega, omega**2]))
    denominator = np.asarray(np.poly(poles).real, dtype=np.float64)
    # Powers of s timestep in z^-j, and in 1 / H, up to the second.
    shifts = np.array([[1.0, -j, j**2 / 2.0] for j in range(3)]).T
    first, second = 2 * damping_ratio / omega, 1.0 / omega**2
    inverse = np.array([[1.0, 0.0, 0.0], [first, 1.0, 0.0], [second, first, 1.0]])
    numerator: Array = np.linalg.solve(shifts, np.linalg.solve(inverse, shifts @ denominator))
    return numerator, denominator


def control_columns(subjects: Sequence[Subject], timestep: float, n_parts: int = 0) -> dict[str, Any]:
    """What differs between people, name to values, (lane, ...), for `table_of`.

    `short_range` is the stiffness before it yields [Nm/rad], which the model has as a spring, `part_stiffness` that of
    one part; `loss` is the inverse of the angle of loss [1/rad], `thinning` that of the thinning velocity [s/rad],
    `persistence` the share of the lost stiffness that is still lost a step later [-]; `limit` [rad] and `limit_slope`
    [s], (element, part), are the elastic limits at rest and their growth with speed; `lawful`, `reflexive`,
    `remembering` and `commanded` tell whether there are a muscle law, reflexes, acceleration or force feedback, and
    voluntary torque.

    Args:
      subjects: one per lane; one without a muscle law gets one that adds nothing.
      timestep: of the simulation [s].
      n_parts: elasto-plastic parts to have room for, if more than these people have.
    """
    laws = [subject.muscle or MuscleLaw() for subject in subjects]

    def each(field: str) -> Array:
        return np.array([law.of_elements(field) for law in laws])

    # Parts that a person does not have yield at once.
    shape = np.zeros((len(laws), 3, max(PARTS, n_parts, *(law.parts for law in laws))))
    for lane, law in enumerate(laws):
        for element, spread in enumerate(law.of_elements("elastic_limit_spread")):
            shape[lane, element, : law.parts] = elastic_limit_shape(spread, law.parts)
    kinds = {(cutoff, subject.zeta_act) for subject in subjects for cutoff in (subject.fact_s, subject.fact_e)}
    cached = {kind: activation_filter(*kind, timestep) for kind in kinds}
    filters = np.array([[cached[cutoff, s.zeta_act] for cutoff in (s.fact_s, s.fact_e)] for s in subjects])
    triples = {name: np.array([subject.joint_triple(name) for subject in subjects]) for name in TRIPLES}
    parts = np.array([float(law.parts) for law in laws])
    remembering = (triples["ka"] != 0).any(axis=1) | (triples["kf"] != 0).any(axis=1)
    return {
        "posture": np.array([subject.posture for subject in subjects]),
        "delay": np.array([(subject.Td_s, subject.Td_e) for subject in subjects]),
        **triples,
        "kv_groups": np.array([subject.muscle_groups("kv") for subject in subjects]),
        "damping_groups": np.array([subject.muscle_groups("b") for subject in subjects]),
        "numerator": filters[:, :, 0].swapaxes(1, 2),
        "denominator": filters[:, :, 1].swapaxes(1, 2),
        "saturation": each("spindle_saturation"),
        "direction": each("spindle_direction"),
        "threshold": each("spindle_threshold"),
        "short_range": each("short_range_stiffness"),
        "part_stiffness": each("short_range_stiffness") / parts[:, None],
        "parts": parts,
        "limit": shape * np.minimum(np.radians(each("elastic_limit_deg")), NEVER)[..., None],
        "limit_slope": shape * each("elastic_limit_slope")[..., None],
        "loss": 1.0 / np.radians(each("loss_angle_deg")),
        "persistence": np.exp(-timestep / each("recovery_time")),
        "thinning": 1.0 / each("thinning_velocity"),
        "commanded": np.zeros(len(laws)),
        "lawful": np.array([float(subject.muscle is not None) for subject in subjects]),
        "remembering": remembering.astype(float),
        "reflexive": (remembering | (triples["kv"] != 0).any(axis=1) | (triples["kp"] != 0).any(axis=1)).astype(float),
    }


def table_of(columns: Mapping[str, Any]) -> Table:
    """A structured array of numbers from its columns, (lane,)."""
    n_lanes = len(next(iter(columns.values())))
    table = np.zeros(n_lanes, [(name, float, np.shape(values)[1:]) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    return table


def control_memory(n_lanes: int, n_parts: int, n_history: int) -> Table:
    """What muscles and reflexes remember from step to step, of arms that have been at rest for long, (lane,).

    Of the muscle elements: `bond`, torque of each elasto-plastic part over its stiffness [rad], (element, part);
    `intact`, share of the short-range stiffness that is intact [-], and `stretch` at the last step [rad], (element,).
    Of the joints, (joint,): `law` and `law_before`, torques of the muscle law in the last two steps, `excitation` of
    the reflexes and `command` of the person's will [Nm]. `velocity` is that of the joints in the last steps, the last
    one first, (step, joint) [rad/s]: one step, or four of people with acceleration or force feedback. `filters` and
    `command_filters` are the states of the activation filters, (2, joint); `sent` is the ring of the active torques of
    the last steps, (step, joint) [Nm], and `next` its oldest.

    Args:
      n_lanes: how many arms.
      n_parts: elasto-plastic parts of each element.
      n_history: active torques to remember.
    """
    shapes: dict[str, tuple[int, ...]] = {
        **{"bond": (3, n_parts), "intact": (3,), "stretch": (3,)},
        **dict.fromkeys(("law", "law_before", "excitation", "command"), (2,)),
        **{"velocity": (4, 2), "filters": (2, 2), "command_filters": (2, 2), "sent": (n_history, 2)},
    }
    memory = np.zeros(n_lanes, [*((name, float, shape) for name, shape in shapes.items()), ("next", int)])
    memory["intact"] = 1.0
    return memory


def history_of(table: Table, timestep: float) -> int:
    """Steps to remember so that `compiled.delayed` can look back by these people's delays."""
    return doubled(int(np.ceil(table["delay"].max() / timestep)) + 3)


def doubled(n_history: int) -> int:
    """The next length of a ring that holds so many torques."""
    return HISTORY * 2 ** max(0, int(np.ceil(np.log2(n_history / HISTORY))))
