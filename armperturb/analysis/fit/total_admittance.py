"""Admittance of arm and environment at any number of frequencies, in runs of them for the sake of memory.

The derivatives by all parameters take some kB per frequency, and a trial of an hour has half a million frequencies.
Trials of some minutes are one run.
"""

import itertools
from collections.abc import Iterable, Iterator

import numpy as np

from armperturb.analysis.arm.linear_arm import LinearArm
from armperturb.analysis.arm.parameters import groups_of
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment
from armperturb.subject import Subject

LONGEST_RUN, SHORTER_RUN = 2**14, 2**12
"""Frequencies up to which derivatives are evaluated at once, and how many of more than these."""


class TotalAdmittance:
    """Admittance P from d to x, and its derivatives, at given frequencies.

    Args:
      body: gives segments and posture.
      frequency: [Hz], (frequency,).
      environment: what the hand holds.
    """

    def __init__(self, body: Subject, frequency: Array, environment: Environment) -> None:
        self._environment = environment
        length = LONGEST_RUN if len(frequency) <= LONGEST_RUN else SHORTER_RUN
        ends = [*range(0, len(frequency), length), len(frequency)]
        self._runs = [slice(*between) for between in itertools.pairwise(ends)]
        self._arms = [LinearArm(body, frequency[run]) for run in self._runs]

    def __call__(self, values: Array) -> ComplexArray:
        """P of an arm with these parameters [m/N], (output, input, frequency)."""
        parts = [np.moveaxis(arm.total_admittance(values, self._environment), 0, -1) for arm in self._arms]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)

    def driven_slopes(
        self,
        values: Array,
        mixing: Array,
        loads: ComplexArray,
        scale: ComplexArray | None = None,
    ) -> Iterator[ComplexArray]:
        """Derivatives of P d by the free parameters, of one trial after the other, (free parameter, axis, frequency).

        Args:
          values: parameters of the arm, (parameter,).
          mixing: (arm parameter, free parameter).
          loads: DFT of d, (trial, axis, frequency).
          scale: of P, if it is not 1, (frequency,).
        """
        gradients = [self._gradient(0, values, mixing, scale)] if len(self._runs) == 1 else None
        for first, second in loads:
            driven = np.empty((mixing.shape[1], 2, len(first)), dtype=complex)
            for number, run in enumerate(self._runs):
                # Those of all runs would be too large to be kept for the next trial.
                gradient = gradients[0] if gradients else self._gradient(number, values, mixing, scale)
                np.multiply(gradient[:, :, 0], first[run], out=driven[..., run])
                driven[..., run] += gradient[:, :, 1] * second[run]
            yield driven

    def slopes_along(
        self, values: Array, mixing: Array, loads: ComplexArray, directions: Iterable[ComplexArray]
    ) -> Array:
        """Derivatives of the real part of <direction, P d> of each trial by the free parameters, (trial, parameter).

        Args:
          values: parameters of the arm, (parameter,).
          mixing: (arm parameter, free parameter).
          loads: DFT of d, (trial, axis, frequency).
          directions: of each trial, (axis, frequency).
        """
        # As x.re m.re - x.im m.im is the real part of x m, conjugates beside one another give it by one product.
        outer = [direction[:, None] * load.conj() for direction, load in zip(directions, loads, strict=True)]
        slopes = np.zeros((mixing.shape[1], len(loads)))
        groups, index = groups_of(np.any(mixing != 0.0, axis=1))
        for arm, run in zip(self._arms, self._runs, strict=True):
            by_all = arm.total_and_gradient(values, self._environment, groups)[1].transpose(3, 1, 2, 0)
            along = np.array([each[..., run].ravel() for each in outer]).view(float)
            slopes += mixing[index].T @ (by_all.reshape(len(index), -1).view(float) @ along.T)
        return slopes.T

    def _gradient(self, number: int, values: Array, mixing: Array, scale: ComplexArray | None) -> ComplexArray:
        """Derivatives of P by the free parameters in one run, (free parameter, output, input, frequency)."""
        groups, index = groups_of(np.any(mixing != 0.0, axis=1))
        by_all = self._arms[number].total_and_gradient(values, self._environment, groups)[1].transpose(3, 1, 2, 0)
        # Real and imaginary parts beside one another: the mixing is real.
        mixed = mixing[index].T @ by_all.reshape(len(index), -1).view(float)
        gradient = mixed.view(complex).reshape(-1, *by_all.shape[1:])
        return gradient if scale is None else gradient * scale[self._runs[number]]
