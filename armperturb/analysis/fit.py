"""An arm model fitted to an admittance by the thesis's criterion (2.18-2.22, appendices C and E)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, optimize

from armperturb.analysis.arm_model import Delay, arm_admittance, hand_jacobian, largest_real_pole, state_space
from armperturb.analysis.structures import STRUCTURES, Structure, unit
from armperturb.environment import Environment
from armperturb.subject import Subject

MAX_EVALUATIONS = 1000

AT_BOUND = 1e-6
"""A parameter sits on a bound when it is closer to it than this share of the distance between its bounds."""

PERFECT = 1e-16
"""A fit whose squared error per frequency is below this cannot be improved, and needs no other start."""

SAME_MINIMUM = 1e-6
"""Starts agree when their criteria differ by less than this share (or this much, for a perfect fit)."""


_WHY_STOPPED = {
    0: "not converged: limit of evaluations reached",
    1: "converged: gradient vanished",
    2: "converged: criterion settled",
    3: "converged: parameters settled",
    4: "converged: criterion and parameters settled",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class AdmittanceFit:
    """An arm model fitted to an admittance.

    Attributes:
      structure: name of the model structure.
      arm: the fitted arm, fixed parameters included.
      values: estimate of each free parameter, SI.
      sem: standard error of each free parameter, SI (eq. 2.22); infinite where the data say nothing.
      at_bound: free parameters that sit on a bound.
      status: why the fit stopped, in words.
      converged: whether it stopped at a minimum.
      criterion: V of eq. 2.19, penalty included.
      penalty: factor p of eq. 2.21 at the estimate; one means that it did not act.
      stable: whether arm and environment are stable together.
      largest_real_pole: of arm and environment [1/s].
      n_starts: how many starts were tried.
      n_starts_agree: how many of them ended in the best minimum.
      n_evaluations: of the model, all starts together.
    """

    structure: str
    arm: Subject
    values: Mapping[str, float]
    sem: Mapping[str, float]
    at_bound: tuple[str, ...]
    status: str
    converged: bool
    criterion: float
    penalty: float
    stable: bool
    largest_real_pole: float
    n_starts: int
    n_starts_agree: int
    n_evaluations: int


def penalty_factor(pole: float) -> float:
    """Factor on the error that keeps a fit stable; one for poles left of about -0.8 1/s (eq. 2.21, figure C.1).

    Args:
      pole: largest real part of a pole of arm and environment [1/s].
    """
    # Beyond 10^50 it only has to be large: powers of it must not overflow.
    return 10.0 * 10.0 ** min(10.0 * (pole + 0.5), 50.0) + 1.0


def fit_admittance(
    frequency: ArrayLike,
    admittance: ArrayLike,
    body: Subject,
    structure: Structure | str,
    environment: Environment,
    *,
    coherence: ArrayLike | None = None,
    start: Mapping[str, float] | None = None,
    use_penalty: bool = True,
    delay: Delay = "exact",
) -> AdmittanceFit:
    """Fit an arm model to an admittance.

    Minimises eq. 2.19: the mean over frequencies and elements of (gamma |ln(H_estimated / H_model)| p)^2. The residual
    given to the optimiser is the complex logarithm, real and imaginary part: the same criterion, but one whose
    Gauss-Newton step is right, which the modulus in eq. 2.18 spoils. Parameters are normalised by their start.

    Two starts are tried, the given one and one from linear least squares on the joint impedance, first without penalty;
    only where their best fit is penalised does a second run with the penalty follow (appendix C's two steps).

    Args:
      frequency: [Hz], (frequency,).
      admittance: estimated H_xf [m/N], (frequency, output, input).
      body: gives task, segment lengths, posture and activation damping; its other parameters do not matter.
      structure: model structure, or its name in `STRUCTURES`.
      environment: what the hand held, for the stability of the whole.
      coherence: multiple coherence [-], (frequency, output); one if not given.
      start: values of free parameters to start from, SI; the published start where not given.
      use_penalty: whether to push the fit away from instability (eq. 2.21).
      delay: "exact", or the thesis's "pade".

    Raises:
      ValueError: shapes do not fit, values are not finite, an admittance is zero, or a start is unknown or outside its
        bounds.
    """
    if isinstance(structure, str):
        if structure not in STRUCTURES:
            raise ValueError(f"model = {structure!r}; expected one of {', '.join(STRUCTURES)}")
        structure = STRUCTURES[structure]
    problem = _checked(frequency, admittance, coherence, body, structure, environment, delay)
    first = _checked_start(structure, start)
    starts = [first, problem.linear_start(first)]
    solutions = [_minimise(problem, values, with_penalty=False) for values in starts]
    best = min(solutions, key=lambda solution: solution.cost)
    if use_penalty and problem.penalty(best.x) > 1.0 + 1e-6:
        # An unstable start has no use for a criterion that its penalty dwarfs; a stable optimum competes, whatever its
        # penalty: without noise it is the minimum all the same.
        stable = [values for values in starts if problem.penalty(values) < 1e3] or [_published(structure)]
        if problem.penalty(best.x) < penalty_factor(0.0):
            stable.insert(0, best.x)
        solutions = [_minimise(problem, stable[0], with_penalty=True)]
        if solutions[0].cost > PERFECT * len(problem.frequency):
            solutions += [_minimise(problem, values, with_penalty=True) for values in stable[1:]]
        best = min(solutions, key=lambda solution: solution.cost)
    tolerance = SAME_MINIMUM * (best.cost + len(problem.frequency) * SAME_MINIMUM)
    return problem.judge(
        best,
        use_penalty=use_penalty,
        n_starts=len(solutions),
        n_starts_agree=sum(bool(solution.cost - best.cost <= tolerance) for solution in solutions),
        n_evaluations=sum(solution.nfev for solution in solutions),
    )


def _minimise(problem: "_Problem", start: NDArray[np.float64], *, with_penalty: bool) -> optimize.OptimizeResult:
    """Bounded least squares from one start; the result holds parameters in SI."""
    scale = np.where(start != 0, np.abs(start), 1.0)
    lower, upper = problem.bounds
    solution = optimize.least_squares(
        lambda v: problem.residual(v * scale, with_penalty),
        np.clip(start, lower, upper) / scale,
        lambda v: problem.jacobian(v * scale, with_penalty) * scale,
        bounds=(lower / scale, upper / scale),
        x_scale="jac",
        xtol=1e-10,
        ftol=1e-12,
        gtol=1e-12,
        max_nfev=MAX_EVALUATIONS,
    )
    solution.x = np.clip(solution.x * scale, lower, upper)
    return solution


@dataclass(frozen=True, eq=False)
class _Problem:
    """Residual and its derivative for one admittance."""

    frequency: NDArray[np.float64]
    admittance: NDArray[np.complex128]
    weight: NDArray[np.float64]
    body: Subject
    structure: Structure
    environment: Environment
    delay: Delay

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        lower, upper = np.array(list(self.structure.bounds.values())).T
        return lower, upper

    def penalty(self, values: NDArray[np.float64]) -> float:
        return penalty_factor(largest_real_pole(self.structure.arm(self.body, values), self.environment))

    def residual(self, values: NDArray[np.float64], with_penalty: bool) -> NDArray[np.float64]:
        """Weighted complex log error, real then imaginary parts; with penalty and then a zero, (8 frequency [+ 1],)."""
        model = arm_admittance(self.structure.arm(self.body, values), self.frequency, self.delay)
        error = _stack(self.weight * np.log(self.admittance / model))
        return np.append(error * self.penalty(values), 0.0) if with_penalty else error

    def jacobian(self, values: NDArray[np.float64], with_penalty: bool) -> NDArray[np.float64]:
        """Derivative of the residual, (8 frequency [+ 1], parameter).

        The zero that comes with the penalty changes neither criterion nor gradient, whatever its row here. The row adds
        the second derivative of the penalty, most of its curvature, to the Gauss-Newton step: without it the optimiser
        creeps along the border of stability.
        """
        arm = self.structure.arm(self.body, values)
        model = arm_admittance(arm, self.frequency, self.delay)[..., None]
        slope = -self.weight[..., None] * self.structure.admittance_gradient(arm, self.frequency, self.delay) / model
        jacobian = np.column_stack([_stack(slope[..., i]) for i in range(slope.shape[-1])])
        if not with_penalty:
            return jacobian
        factor, error = self.penalty(values), self.residual(values, False)
        gradient = self._penalty_gradient(values, factor)
        curvature = gradient
        if gradient.any():
            curvature = np.linalg.norm(error) * np.sqrt(factor / (factor - 1.0)) * gradient
        return np.vstack([jacobian * factor + np.outer(error, gradient), curvature])

    def _penalty_gradient(self, values: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
        """Derivative of the penalty, from that of the pole as an eigenvalue: left dA right / left right."""
        if not 1e-12 < factor - 1.0 < 1e50:
            return np.zeros(len(values))  # it does not act, or is capped
        a = state_space(self.structure.arm(self.body, values), self.environment).a
        poles, left, right = linalg.eig(a, left=True)
        last = int(np.argmax(poles.real))
        to_left, to_right = left[:, last].conj(), right[:, last]
        slope = np.empty(len(values))
        for i, (value, lower, upper) in enumerate(zip(values, *self.bounds, strict=True)):
            step = 1e-6 * max(abs(value), 1e-3 * (upper - lower))
            moved = values.copy()
            moved[i] += step if value + step <= upper else -step
            change = state_space(self.structure.arm(self.body, moved), self.environment).a - a
            slope[i] = (to_left @ change @ to_right / (to_left @ to_right)).real / (moved[i] - value)
        return 10.0 * np.log(10.0) * (factor - 1.0) * slope

    def linear_start(self, guess: NDArray[np.float64]) -> NDArray[np.float64]:
        """Parameters from bounded linear least squares on the joint impedance J^T (H - G)^-1 J.

        It is linear in all but the grip G, which is taken from the guess, so that no start has to be guessed for them.
        """
        arm = self.structure.arm(self.body, guess)
        jacobian = hand_jacobian(arm)
        grip = 1.0 / (arm.b_h * 2j * np.pi * self.frequency + arm.k_h)
        impedance = jacobian.T @ np.linalg.solve(self.admittance - grip[:, None, None] * np.eye(2), jacobian)
        basis = self.structure.impedance_gradient(arm, self.frequency, self.delay)
        linear = np.array([name not in ("b_h", "k_h") for name in self.structure.free])
        relative = 1.0 / np.linalg.norm(impedance, axis=(1, 2))[:, None, None]
        design = np.column_stack([_stack(basis[..., i] * relative) for i in np.flatnonzero(linear)])
        scale = np.linalg.norm(design, axis=0)
        lower, upper = (bound[linear] * scale for bound in self.bounds)
        solution = optimize.lsq_linear(design / scale, _stack(impedance * relative), (lower, upper))
        values = guess.copy()
        values[linear] = np.clip(solution.x, lower, upper) / scale
        return values

    def judge(
        self,
        solution: optimize.OptimizeResult,
        *,
        use_penalty: bool,
        n_starts: int,
        n_starts_agree: int,
        n_evaluations: int,
    ) -> AdmittanceFit:
        """The fit at a solution, with all that a reader must know to trust it or not."""
        values, names = solution.x, self.structure.free
        arm = self.structure.arm(self.body, values)
        pole = largest_real_pole(arm, self.environment)
        factor = penalty_factor(pole) if use_penalty else 1.0
        residual, jacobian = self.residual(values, False), self.jacobian(values, False)
        n = 4 * len(self.frequency)
        lower, upper = self.bounds
        near = np.minimum(values - lower, upper - values) <= AT_BOUND * (upper - lower)
        converged = solution.status > 0
        return AdmittanceFit(
            structure=self.structure.name,
            arm=arm,
            values=dict(zip(names, map(float, values), strict=True)),
            sem=dict(zip(names, map(float, _standard_error(jacobian, residual, n)), strict=True)),
            at_bound=tuple(name for name, hit in zip(names, near, strict=True) if hit),
            status=_WHY_STOPPED[solution.status],
            converged=converged,
            criterion=float(residual @ residual / n) * factor**2,
            penalty=factor,
            stable=pole < 0,
            largest_real_pole=pole,
            n_starts=n_starts,
            n_starts_agree=n_starts_agree,
            n_evaluations=n_evaluations,
        )


def _stack(values: NDArray[Any]) -> NDArray[np.float64]:
    return np.concatenate([values.real.ravel(), values.imag.ravel()])


def _standard_error(jacobian: NDArray[np.float64], residual: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """Eq. 2.22 with N = 4 n_f residuals; infinite where the Jacobian has no independent column."""
    scale = np.linalg.norm(jacobian, axis=0)
    if not scale.all():
        return np.full(len(scale), np.inf)
    _, singular, basis = np.linalg.svd(jacobian / scale, full_matrices=False)
    if singular[-1] < 1e-12 * singular[0]:
        return np.full(len(scale), np.inf)
    variance = np.sum((basis / singular[:, None]) ** 2, axis=0) / scale**2
    return np.sqrt(variance * (residual @ residual) / n)


def _checked(
    frequency: ArrayLike,
    admittance: ArrayLike,
    coherence: ArrayLike | None,
    body: Subject,
    structure: Structure,
    environment: Environment,
    delay: Delay,
) -> _Problem:
    f, h = np.asarray(frequency, dtype=float), np.asarray(admittance, dtype=complex)
    c = np.ones((f.size, 2)) if coherence is None else np.asarray(coherence, dtype=float)
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
    if 8 * f.size <= len(structure.free):
        raise ValueError(f"{f.size} frequencies for {len(structure.free)} parameters; expected more frequencies")
    weight = np.broadcast_to(np.sqrt(c)[:, :, None], h.shape)
    return _Problem(f, h, weight, body, structure, environment, delay)


def _published(structure: Structure) -> NDArray[np.float64]:
    return np.array([structure.start[name] for name in structure.free])


def _checked_start(structure: Structure, start: Mapping[str, float] | None) -> NDArray[np.float64]:
    values = dict(structure.start)
    for name, value in (start or {}).items():
        if name not in values:
            raise ValueError(
                f"start: unknown parameter {name!r}; model {structure.name} has {', '.join(structure.free)}"
            )
        lower, upper = structure.bounds[name]
        if not lower <= value <= upper:
            raise ValueError(f"start: {name} = {value!r}; expected {lower:g} to {upper:g} {unit(name)}")
        values[name] = float(value)
    return np.array([values[name] for name in structure.free])
