"""Admittance of arm and environment at any number of frequencies.

It is smooth over frequency, as responses die away within seconds. A trial of an hour has half a million frequencies:
there the arm is asked at fewer, even ones, and what is between them is interpolated. The derivatives by all parameters,
which take some kB per frequency, are then made in runs of frequencies for the sake of memory. Trials of some minutes
are one run.
"""

import itertools
from collections.abc import Iterable, Iterator

import numpy as np

from armperturb.analysis.arm.linear_arm import LinearArm
from armperturb.analysis.arm.parameters import groups_of
from armperturb.analysis.numerics.refinement import Refinement
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment
from armperturb.subject import Subject

LONGEST_RUN, SHORTER_RUN = 2**14, 2**12
"""Frequencies up to which derivatives are evaluated at once, and about how many of more than these."""

NODES = 1.0 / 128.0
"""Largest distance of frequencies between which is interpolated [Hz]: arms are then exact to 1e-7, and to 2e-6 beside
zero."""

LEAST_FACTOR = 4
"""Frequencies for each at which the arm is asked, at least; with fewer it is asked at all."""

ZERO = 1e-6
"""Frequency in place of zero [Hz], as powers of it stand in denominators."""


class TotalAdmittance:
    """Admittance P from d to x, and its derivatives, at given frequencies.

    Args:
      body: gives segments and posture.
      frequency: [Hz], rising, (frequency,).
      environment: what the hand holds.
    """

    def __init__(self, body: Subject, frequency: Array, environment: Environment) -> None:
        self._environment, n = environment, len(frequency)
        step = float(frequency[-1] - frequency[0]) / (n - 1) if n > 1 else NODES
        factor = int(NODES / step)
        is_even = bool(np.all(np.abs(frequency - frequency[-1] - step * np.arange(1 - n, 1)) <= ZERO))
        self._refinement = Refinement(n, factor) if is_even and factor >= LEAST_FACTOR else None
        asked = frequency
        if self._refinement:
            asked = frequency[-1] + step * (1 - n + self._refinement.places)
        self._arm = LinearArm(body, np.where(np.abs(asked) < ZERO, ZERO, asked))
        self._block = self._refinement.factor if self._refinement else 1
        length = n if n <= LONGEST_RUN else max(SHORTER_RUN // self._block, 1) * self._block
        self._runs = [slice(*between) for between in itertools.pairwise([*range(0, n, length), n])]

    def __call__(self, values: Array) -> ComplexArray:
        """P of an arm with these parameters [m/N], (output, input, frequency)."""
        return self._at(np.moveaxis(self._arm.total_admittance(values, self._environment), 0, -1))

    def driven_slopes(
        self, values: Array, mixing: Array, loads: ComplexArray, gradient: ComplexArray | None = None
    ) -> Iterator[ComplexArray]:
        """Derivatives of P d by the free parameters, of one trial after the other, (free parameter, axis, frequency).

        Args:
          values: parameters of the arm, (parameter,).
          mixing: (arm parameter, free parameter).
          loads: DFT of d, (trial, axis, frequency).
          gradient: of these arguments, if it is known.
        """
        index = groups_of(np.any(mixing != 0.0, axis=1))[1]
        by_all = self.gradient(values, mixing) if gradient is None else gradient
        # Real and imaginary parts beside one another: the mixing is real.
        mixed = (mixing[index].T @ by_all.reshape(len(index), -1).view(float)).view(complex)
        asked = mixed.reshape(-1, *by_all.shape[1:])
        whole = self._at(asked) if len(self._runs) == 1 else None
        for first, second in loads:
            driven = np.empty((mixing.shape[1], 2, len(first)), dtype=complex)
            for run in self._runs:
                # Those of all runs would be too large to be kept for the next trial.
                gradient = self._at(asked, run) if whole is None else whole
                np.multiply(gradient[:, :, 0], first[run], out=driven[..., run])
                driven[..., run] += gradient[:, :, 1] * second[run]
            yield driven

    def slopes_along(
        self,
        values: Array,
        mixing: Array,
        loads: ComplexArray,
        directions: Iterable[ComplexArray],
        gradient: ComplexArray | None = None,
    ) -> Array:
        """Derivatives of the real part of <direction, P d> of each trial by the free parameters, (trial, parameter).

        Args:
          values: parameters of the arm, (parameter,).
          mixing: (arm parameter, free parameter).
          loads: DFT of d, (trial, axis, frequency).
          directions: of each trial, (axis, frequency).
          gradient: of these arguments, if it is known.
        """
        index = groups_of(np.any(mixing != 0.0, axis=1))[1]
        by_all = self.gradient(values, mixing) if gradient is None else gradient
        by_all = by_all.reshape(len(index), -1).view(float)
        # As x.re m.re - x.im m.im is the real part of x m, conjugates beside one another give it by one product.
        along = (direction[:, None] * load.conj() for direction, load in zip(directions, loads, strict=True))
        asked = np.array([(self._refinement.transpose(each) if self._refinement else each).ravel() for each in along])
        return np.asarray((mixing[index].T @ (by_all @ asked.view(float).T)).T)

    def gradient(self, values: Array, mixing: Array) -> ComplexArray:
        """Derivatives of P where the arm is asked, for both of the above, (parameter, output, input, asked).

        The parameters are those of the groups in which any is free.

        Args:
          values: parameters of the arm, (parameter,).
          mixing: (arm parameter, free parameter).
        """
        groups, _ = groups_of(np.any(mixing != 0.0, axis=1))
        by_all = self._arm.total_and_gradient(values, self._environment, groups)[1]
        return np.ascontiguousarray(by_all.transpose(3, 1, 2, 0))

    def _at(self, asked: ComplexArray, run: slice | None = None) -> ComplexArray:
        """What the arm answers (..., asked), at all frequencies or in a run of them, (..., frequency)."""
        if self._refinement is None:
            return asked if run is None else asked[..., run]
        blocks = slice(None) if run is None else slice(run.start // self._block, -(-run.stop // self._block))
        return self._refinement.fine(asked, blocks)
