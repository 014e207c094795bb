"""Error of an arm model against an admittance, with its derivative and the penalty on instability (eqs 2.18-2.21)."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize

from armperturb.analysis.arm.linear_arm import Delay, LinearArm
from armperturb.analysis.arm.parameters import groups_of
from armperturb.analysis.fit.structures import Structure
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment
from armperturb.subject import Subject
from armperturb.validation import require_one_of

MAX_EVALUATIONS = 1000

NEGLIGIBLE_PENALTY = 1e-9
"""A penalty this close to one has no slope worth computing."""

UNIDENTIFIED = 1e-10
"""Directions of the parameters, each scaled by its effect, whose effect is this small beside the largest have none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """What an arm model is fitted to.

    Attributes:
      frequency: [Hz], (frequency,).
      admittance: estimated H_xf [m/N], (frequency, output, input).
      body: gives task, segments and posture; its other parameters do not matter.
      environment: what the hand held, for the stability of the whole.
      coherence: multiple coherence [-], (frequency, output); one if not given.
    """

    frequency: ArrayLike
    admittance: ArrayLike
    body: Subject
    environment: Environment
    coherence: ArrayLike | None = None


def penalty_factor(pole: ArrayLike) -> Array:
    """Factor on the error that keeps a fit stable; one for poles left of about -0.8 1/s (eq. 2.21, figure C.1).

    Args:
      pole: largest real part of a pole of arm and environment [1/s], of any shape, which the factor gets.
    """
    # Beyond 10^50 it only has to be large: powers of it must not overflow.
    return np.asarray(10.0 * 10.0 ** np.minimum(10.0 * (np.asarray(pole) + 0.5), 50.0) + 1.0)


def least_squares(
    problem: "AdmittanceProblem", start: Array, *, with_penalty: bool, most: int = MAX_EVALUATIONS
) -> optimize.OptimizeResult:
    """Bounded least squares from one start, of so many evaluations at most; the result holds parameters in SI."""
    scale = np.where(start != 0, np.abs(start), 1.0)
    lower, upper = problem.lower, problem.upper
    solution = optimize.least_squares(
        lambda v: problem.residual(v * scale, with_penalty),
        np.clip(start, lower, upper) / scale,
        lambda v: problem.jacobian(v * scale, with_penalty) * scale,
        bounds=(lower / scale, upper / scale),
        x_scale="jac",
        xtol=1e-10,
        ftol=1e-12,
        gtol=1e-12,
        max_nfev=most,
    )
    solution.x = np.clip(solution.x * scale, lower, upper)
    return solution


@dataclass(frozen=True, eq=False)
class AdmittanceProblem:
    """Residual and its derivative for one admittance."""

    frequency: Array
    admittance: ComplexArray
    weight: Array
    environment: Environment
    model: LinearArm
    mixing: Array
    constant: Array
    lower: Array
    upper: Array
    latest_pole: dict[bytes, complex] = field(default_factory=dict)

    @cached_property
    def _asked(self) -> tuple[tuple[str, ...], Array]:
        """Groups of parameters in which any is free, and their rows of the mixing."""
        groups, index = groups_of(np.any(self.mixing != 0.0, axis=1))
        return groups, self.mixing[index]

    def parameters(self, values: Array) -> Array:
        """Parameters of the arm from the free ones, (parameter,)."""
        return np.asarray(self.constant + self.mixing @ values)

    def penalty(self, values: Array) -> float:
        """Factor of eq. 2.21."""
        return float(penalty_factor(self.largest_pole(values).real))

    def largest_pole(self, values: Array) -> complex:
        """Rightmost pole of arm and environment [1/s]."""
        # An optimiser asks for the derivative where it has just asked for the residual.
        key = values.tobytes()
        if key not in self.latest_pole:
            poles = self.model.poles(self.parameters(values), self.environment)
            self.latest_pole.clear()
            self.latest_pole[key] = complex(poles[np.argmax(poles.real)])
        return self.latest_pole[key]

    def log_error(self, values: Array) -> ComplexArray:
        """Weighted complex log error, (4 frequency,)."""
        error = self.weight * np.log(self.admittance / self.model.admittance(self.parameters(values)))
        return np.asarray(error.reshape(-1))

    def log_error_and_slope(self, values: Array) -> tuple[ComplexArray, ComplexArray]:
        """`log_error` and its derivative, (4 frequency,) and (4 frequency, parameter)."""
        groups, mixing = self._asked
        model, gradient = self.model.admittance_and_gradient(self.parameters(values), groups)
        error = self.weight * np.log(self.admittance / model)
        slope = gradient * (-self.weight / model)[..., None]
        return np.asarray(error.reshape(-1)), np.asarray(slope.reshape(error.size, -1) @ mixing)

    def modulus_and_slope(self, values: Array) -> tuple[Array, Array]:
        """Modulus of `log_error` and its derivative, (4 frequency,) and (4 frequency, parameter)."""
        error, slope = self.log_error_and_slope(values)
        modulus = np.abs(error)
        direction = np.divide(error.conj(), modulus, out=np.zeros_like(error), where=modulus > 0)
        return modulus, (direction[:, None] * slope).real

    def residual(self, values: Array, with_penalty: bool) -> Array:
        """Weighted complex log error, real then imaginary parts; with penalty and then a zero, (8 frequency [+ 1],)."""
        error = stack(self.log_error(values))
        return np.append(error * self.penalty(values), 0.0) if with_penalty else error

    def jacobian(self, values: Array, with_penalty: bool) -> Array:
        """Derivative of the residual, (8 frequency [+ 1], parameter).

        The zero that comes with the penalty changes neither criterion nor gradient, whatever its row here. The row adds
        the second derivative of the penalty, most of its curvature, to the Gauss-Newton step: without it the optimiser
        creeps along the border of stability.
        """
        error, slope = map(stack, self.log_error_and_slope(values))
        if not with_penalty:
            return slope
        factor, gradient = self.penalty_and_gradient(values)
        if factor - 1.0 < NEGLIGIBLE_PENALTY:
            return np.vstack([slope, gradient])
        curvature = np.linalg.norm(error) * np.sqrt(factor / (factor - 1.0)) * gradient
        return np.vstack([slope * factor + np.outer(error, gradient), curvature])

    def penalty_and_gradient(self, values: Array) -> tuple[float, Array]:
        """Penalty and its derivative, (parameter,), which is zero where the penalty is one or out of all bounds."""
        pole = self.largest_pole(values)
        factor = float(penalty_factor(pole.real))
        if factor - 1.0 < NEGLIGIBLE_PENALTY or factor >= penalty_factor(np.inf):
            return factor, np.zeros_like(values)
        gradient = self.model.pole_gradient(self.parameters(values), self.environment, pole)
        return factor, (factor - 1.0) * 10.0 * np.log(10.0) * (gradient @ self.mixing)


def stack(values: ComplexArray) -> Array:
    """Real parts, then imaginary parts."""
    return np.concatenate([values.real, values.imag])


def silent_directions(jacobian: Array) -> Array:
    """Directions of the columns, each scaled by its norm, in which nothing changes, (direction, column)."""
    scale = np.linalg.norm(jacobian, axis=0)
    if not scale.all():
        return np.eye(len(scale))[scale == 0]
    _, singular, basis = np.linalg.svd(jacobian / scale, full_matrices=len(jacobian) < len(scale))
    return np.asarray(basis[np.count_nonzero(singular > UNIDENTIFIED * singular[0]) :])


def standard_error(modulus: Array, jacobian: Array) -> Array:
    """Eq. 2.22; infinite for columns that share in a direction without effect.

    Args:
      modulus: of the log error, (n,).
      jacobian: its derivative, (n, parameter).
    """
    silent = np.abs(silent_directions(jacobian)).max(axis=0, initial=0.0) > 1e-6
    known = jacobian[:, ~silent]
    scale = np.linalg.norm(known, axis=0)
    _, singular, basis = np.linalg.svd(known / scale, full_matrices=False)
    variance = np.sum((basis / singular[:, None]) ** 2, axis=0) / scale**2 * np.mean(modulus**2)
    sem = np.full(len(silent), np.inf)
    sem[~silent] = np.sqrt(variance)
    return sem


def checked_problem(target: Target, structure: Structure, delay: Delay) -> AdmittanceProblem:
    """The problem of one target.

    Raises:
      ValueError: as `fit_admittance`.
    """
    f, h = np.asarray(target.frequency, dtype=float), np.asarray(target.admittance, dtype=complex)
    c = np.ones((f.size, 2)) if target.coherence is None else np.asarray(target.coherence, dtype=float)
    if f.ndim != 1 or h.shape != (f.size, 2, 2) or c.shape != (f.size, 2):
        raise ValueError(
            f"frequency, admittance and coherence have shapes {f.shape}, {h.shape}, {c.shape}; "
            "expected (n,), (n, 2, 2), (n, 2)"
        )
    for name, values in (("frequency", f), ("admittance", h), ("coherence", c)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} holds {values[~np.isfinite(values)][0]}; expected finite values")
    if (f <= 0).any():
        raise ValueError(f"frequency = {f.min():g} Hz; expected frequencies above 0")
    if (h == 0).any():
        raise ValueError(f"admittance at {f[np.argwhere(h == 0)[0][0]]:g} Hz is 0; expected a response to fit")
    if (c < 0).any() or (c > 1).any():
        raise ValueError(f"coherence from {c.min():g} to {c.max():g}; expected 0 to 1")
    require_one_of("fit_admittance", "delay", delay, get_args(Delay))
    if 8 * f.size <= len(structure.free):
        raise ValueError(f"{f.size} frequencies for {len(structure.free)} parameters; expected more frequencies")
    weight = np.broadcast_to(np.sqrt(c)[:, :, None], h.shape)
    lower, upper = np.array(list(structure.bounds.values())).T
    return AdmittanceProblem(
        f,
        h,
        weight,
        target.environment,
        LinearArm(target.body, f, delay),
        structure.mixing,
        structure.constant(target.body.task),
        lower,
        upper,
    )
