"""Interpolation of smooth functions from an even grid to one that is finer by a whole number, and its transpose."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from armperturb.arrays import Array, ComplexArray

BEFORE, AFTER = 2, 3
"""Nodes before an interval, its first one not counted, and after its start, of which the polynomial is made."""


class Refinement:
    """Lagrange interpolation by polynomials of degree five through the six nearest nodes.

    A function whose Fourier transform ends at the time tau is found at a spacing h of the nodes to about
    0.005 (2 pi tau h)^6.

    Args:
      n: numbers on the fine grid.
      factor: by how much it is finer.
    """

    def __init__(self, n: int, factor: int) -> None:
        self.n, self.factor = n, factor
        self.n_blocks = -(-n // factor)
        nodes = np.arange(-BEFORE, AFTER + 1)
        at = np.arange(factor) / factor
        self._basis = np.array(
            [
                [np.prod([(t - other) / (node - other) for other in nodes if other != node]) for node in nodes]
                for t in at
            ],
            dtype=complex,
        )

    @property
    def places(self) -> Array:
        """Where nodes are, in steps of the fine grid from its first number, (node,)."""
        return self.factor * np.arange(-BEFORE, self.n_blocks + AFTER, dtype=float)

    def fine(self, nodes: ComplexArray, blocks: slice = slice(None)) -> ComplexArray:
        """Values (..., node) on the fine grid, or on blocks of it, each of `factor` numbers, (..., number)."""
        first, last, _ = blocks.indices(self.n_blocks)
        windows = sliding_window_view(nodes[..., first : last + BEFORE + AFTER], BEFORE + 1 + AFTER, axis=-1)
        values = np.ascontiguousarray(windows) @ self._basis.T
        return np.asarray(values.reshape(*nodes.shape[:-1], -1)[..., : self.n - first * self.factor])

    def transpose(self, values: ComplexArray) -> ComplexArray:
        """Of `fine`: what values (..., number) have of each node, (..., node)."""
        padded = np.zeros((*values.shape[:-1], self.n_blocks * self.factor), dtype=complex)
        padded[..., : self.n] = values
        parts = padded.reshape(*values.shape[:-1], self.n_blocks, self.factor) @ self._basis
        nodes = np.zeros((*values.shape[:-1], self.n_blocks + BEFORE + AFTER), dtype=complex)
        for place in range(BEFORE + 1 + AFTER):
            nodes[..., place : place + self.n_blocks] += parts[..., place]
        return nodes
