"""The force balance of the environment at the lines of a spectrum: force and displacement as all instruments tell them.

What is moved by d - f obeys d - f = E^-1 x, with E^-1 = m s^2 + b s + k, and the person has no part in that. What the
recorded signals leave of it is the noise of the instruments (see `Balance.displacement`),

    N = D - F - E^-1 X,    white noise s_f of F, white noise s_x of X.

The covariance of F with N is -s_f^2, that of X with N is -s_x^2 conj(E^-1), as the person's own movement cancels in N.
The best linear correction of both so is

    F + s_f^2 N / Phi_nn,    X + s_x^2 conj(E^-1) N / Phi_nn,    Phi_nn = s_f^2 + s_x^2 |E^-1|^2,

and obeys the balance to the last digit. At high frequencies the gauge tells what encoders cannot resolve, at low ones
the other way round. As E^-1 and both factors are smooth in frequency, leakage stays as smooth as it was.

It is used where it holds, which the data tell: N must not answer to d. A manipulator with friction, or clocks that
differ, are found out by that, and then signals stay as they were recorded.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armperturb.analysis.force_balance import EDGE, Balance
from armperturb.analysis.response.local_polynomial import LocalFit
from armperturb.analysis.smoother import NoiseLevels
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment

SHORTEST = 10 * EDGE
"""Records that are shorter have no part in finding the environment [s]."""

HOLDS = 2.0
"""Mean of |response of N to d|^2 over its variance up to which the balance holds [-]; of noise it is just above one."""


class LineBalance(NamedTuple):
    """Manipulator and instruments of some recordings.

    Attributes:
      environment: mass, damping and stiffness.
      levels: white noise of the instruments.
    """

    environment: Environment
    levels: NoiseLevels

    def _stiffness(self, frequency: Array) -> ComplexArray:
        s, held = 2j * np.pi * frequency, self.environment
        return np.asarray(held.m_env * s**2 + held.b_env * s + held.k_env, dtype=complex)[:, None]

    def left_over(self, frequency: Array, perturbation: ComplexArray, answer: ComplexArray) -> ComplexArray:
        """N, (line, axis), from frequency [Hz], (line,); D, (line, axis); and F and X, (line, 4)."""
        return np.asarray(perturbation - answer[:, :2] - self._stiffness(frequency) * answer[:, 2:])

    def corrected(self, frequency: Array, perturbation: ComplexArray, answer: ComplexArray) -> ComplexArray:
        """F and X as all instruments together tell them, (line, 4); arguments as in `left_over`."""
        stiffness = self._stiffness(frequency)
        force, displacement = self.levels.force**2, self.levels.displacement**2
        noise = self.left_over(frequency, perturbation, answer) / (force + displacement * np.abs(stiffness) ** 2)
        return answer + np.concatenate([force * noise, displacement * stiffness.conj() * noise], axis=1)


def find_balance(trials: Sequence[ConditionTrials]) -> LineBalance | None:
    """Manipulator and instruments from all recordings together; None if there is no balance, or too little for one."""
    rate = trials[0].rate
    long_enough = [part for part in trials if part.n_samples >= SHORTEST * rate]
    if not long_enough:
        return None
    try:
        if len(long_enough) == 1:
            return LineBalance(*long_enough[0].instruments)
        n = min(part.n_samples for part in long_enough)
        pieces = [
            [values[:, first : first + n] for values in part.signals]
            for part in long_enough
            for first in range(0, part.n_samples - n + 1, n)
        ]
        d, f, x = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
        return LineBalance(*Balance(d, f, x, rate).fit())
    except ValueError:
        return None


def holds(fits: Sequence[LocalFit]) -> bool:
    """Whether N does not answer to d, from its local fits: `answer` and `noise` are (2, 2)."""
    ratios = [
        np.mean(np.abs(fit.answer) ** 2 / np.outer(np.diagonal(fit.noise).real, np.diagonal(fit.factor).real))
        for fit in fits
    ]
    return bool(np.mean(ratios) < HOLDS)
