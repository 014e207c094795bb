"""The vector of parameters by which responses of the arm are computed and differentiated."""

import numpy as np
from numpy.typing import NDArray

from armperturb.arrays import Array
from armperturb.subject import Subject

TRIPLES = ("b", "k", "kv", "kp", "ka", "kf")

_OF_MUSCLES = [f"{quantity}_{joint}" for quantity in TRIPLES for joint in ("s", "se", "e")]

PARAMETERS = (
    *("m_h", "m_f", *_OF_MUSCLES, "Td_s", "Td_e", "fact_s", "fact_e", "b_h", "k_h"),
    *("i_s", "i_se", "i_e", "zeta_act"),
)
"""Every parameter by which the arm's responses can be differentiated: fields of `Subject`, SI."""

MASSES, DELAYS, CUTOFFS, INERTIA = slice(0, 2), slice(20, 22), slice(22, 24), slice(26, 29)

GRIP_DAMPING, GRIP_STIFFNESS, ACTIVE_DAMPING = 24, 25, 29

GROUPS = {
    "m": MASSES,
    **{quantity: slice(2 + 3 * n, 5 + 3 * n) for n, quantity in enumerate(TRIPLES)},
    "Td": DELAYS,
    "fact": CUTOFFS,
    "grip": slice(24, 26),
    "i": INERTIA,
    "zeta": slice(29, 30),
}

MATRIX = {
    quantity: np.array([[rows.start, rows.start + 1], [rows.start + 1, rows.start + 2]])
    for quantity, rows in GROUPS.items()
    if quantity in (*TRIPLES, "i")
}
"""Quantity to the indices of its joint matrix's entries, (joint, joint)."""


def parameter_vector(subject: Subject) -> Array:
    """The parameters of an arm in the order of `PARAMETERS`, (parameter,)."""
    return np.array([getattr(subject, name) for name in PARAMETERS])


def groups_of(parameters: NDArray[np.bool_]) -> tuple[tuple[str, ...], NDArray[np.int64]]:
    """Groups of parameters by which derivatives come together.

    Args:
      parameters: whether each of `PARAMETERS` is wanted.

    Returns:
      The groups that hold them, and the index of each parameter of these groups.
    """
    groups = tuple(group for group, rows in GROUPS.items() if parameters[rows].any())
    return groups, np.concatenate([np.arange(len(PARAMETERS))[GROUPS[group]] for group in groups])
