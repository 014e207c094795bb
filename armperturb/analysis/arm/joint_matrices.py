"""Two-by-two matrices of joints or axes over frequency, and derivatives by groups of parameters.

Matrices have their rows and columns first, (row, column, frequency), which makes their products plain sums.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armperturb.analysis.arm.parameters import GROUPS, MATRIX
from armperturb.arrays import Array, ComplexArray

_ENTRIES = np.stack([MATRIX[quantity] for quantity in ("b", "k", "kv", "kp", "ka", "kf", "i")])


def joint_matrices(values: Array) -> Array:
    """Joint matrices b, k, kv, kp, ka, kf and i, ready for frequencies, (quantity, joint, joint, ..., 1)."""
    return values[_ENTRIES][..., None]


def laplace(frequency: ArrayLike) -> ComplexArray:
    """j 2 pi frequency [1/s]."""
    return 2j * np.pi * np.asarray(frequency, dtype=float)


def product(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """a b."""
    return a[:, :1] * b[:1] + a[:, 1:] * b[1:]


def inverse(a: NDArray[Any]) -> NDArray[Any]:
    """a^-1."""
    (p, q), (r, t) = a
    adjugate = np.array([[t, -q], [-r, p]])
    adjugate /= p * t - q * r
    return adjugate


def matrix_last(a: NDArray[Any]) -> NDArray[Any]:
    """Row and column as the last axes."""
    return a.transpose(*range(2, a.ndim), 0, 1)  # moveaxis takes ten times as long


def matrix_first(a: NDArray[Any]) -> NDArray[Any]:
    """Row and column as the first axes."""
    return a.transpose(a.ndim - 2, a.ndim - 1, *range(a.ndim - 2))


def parameter_last(gradient: ComplexArray) -> ComplexArray:
    """From (parameter, output, input, frequency) to (..., frequency, output, input, parameter)."""
    return gradient.transpose(*range(3, gradient.ndim), 1, 2, 0)


def by_triple(outer: ComplexArray) -> ComplexArray:
    """Derivative by (s, se, e) from that by the entries, (output, row, column, input, n) to (3, output, input, n)."""
    return np.stack([outer[:, 0, 0], outer[:, 0, 1] + outer[:, 1, 0], outer[:, 1, 1]])


class Gradient:
    """Derivatives by groups of parameters as they are computed.

    Attributes:
      values: of the wanted groups one after the other, (parameter, output, input, frequency).
    """

    def __init__(self, shape: tuple[int, ...], groups: Sequence[str]) -> None:
        sizes = [GROUPS[group].stop - GROUPS[group].start for group in groups]
        ends = np.cumsum(sizes)
        self.values = np.empty((int(ends[-1]), 2, 2, *shape), dtype=complex)
        self._rows = {
            group: slice(end - size, end) for group, size, end in zip(groups, sizes, ends.tolist(), strict=True)
        }

    def wants(self, *groups: str) -> bool:
        """Whether any of these groups is wanted."""
        return any(group in self._rows for group in groups)

    def put(self, group: str, values: ComplexArray) -> None:
        """Keep the derivatives by a wanted group."""
        self.values[self._rows[group]] = values


@dataclass(frozen=True, kw_only=True, eq=False)
class Joints:
    """What joint impedance and its derivatives share; rows are joints.

    Attributes:
      delayed: transfer function of the delay, (joint, frequency).
      active: that of the activation filter, (joint, frequency).
      loop: (1 - R Kf)^-1, (joint, joint, frequency); None without force feedback, where it is 1.
      muscle: from q to tau, (joint, joint, frequency).
      reflex: from q to u_r, (joint, joint, frequency).
      impedance: Z, (joint, joint, frequency).
    """

    delayed: ComplexArray
    active: ComplexArray
    loop: ComplexArray | None
    muscle: ComplexArray
    reflex: ComplexArray
    impedance: ComplexArray

    @cached_property
    def compliance(self) -> ComplexArray:
        """Z^-1, (joint, joint, frequency)."""
        return inverse(self.impedance)
