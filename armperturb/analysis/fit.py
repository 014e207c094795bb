"""An arm model fitted to an admittance by the thesis's criterion (2.18-2.22, appendices C and E).

The error of eq. 2.18 is a modulus, |ln(H_estimated / H_model)|. The fit minimises the squares of the real and imaginary
part of the complex logarithm instead: the same criterion and the same minimum, but a Gauss-Newton step that is right,
which the modulus spoils. The standard errors are those of the modulus, as eq. 2.22 has them: it keeps about half of the
information, and with the sum of squares over N = 4 n_f they are twice the scatter that independent errors cause.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize

from armperturb.analysis.arm_model import Delay, LinearArm
from armperturb.analysis.linear_start import with_linear_part
from armperturb.analysis.structures import STRUCTURES, Structure, unit
from armperturb.environment import Environment
from armperturb.subject import Subject

MAX_EVALUATIONS = 1000

PUBLISHED_EVALUATIONS = 6000
"""MaxFunEvals of appendix C, which counts those for numerical derivatives: one per parameter and step."""

AT_BOUND = 1e-6
"""A parameter sits on a bound when it is closer to it than this share of the distance between its bounds."""

PERFECT = 1e-16
"""A fit whose squared error per frequency is below this cannot be improved, and needs no other start."""

SAME_MINIMUM = 1e-6
"""Starts agree when their criteria differ by less than this share (or this much, for a perfect fit)."""

NEGLIGIBLE_PENALTY = 1e-9
"""A penalty this close to one has no slope worth computing."""

UNIDENTIFIED = 1e-10
"""Directions of the parameters, each scaled by its effect, whose effect is this small beside the largest have none."""

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
      unidentified: free parameters about which the data say nothing, alone or together.
      at_bound: free parameters that sit on a bound.
      status: why the fit stopped, in words.
      converged: whether it stopped at a minimum.
      criterion: V of eq. 2.19, penalty included.
      n_errors: N of eq. 2.19: four per frequency.
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
    unidentified: tuple[str, ...]
    at_bound: tuple[str, ...]
    status: str
    converged: bool
    criterion: float
    n_errors: int
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
    as_published: bool = False,
    use_penalty: bool = True,
    delay: Delay = "exact",
) -> AdmittanceFit:
    """Fit an arm model to an admittance.

    Minimises eq. 2.19: the mean over frequencies and elements of (gamma |ln(H_estimated / H_model)| p)^2. Parameters
    are normalised by their start.

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
      as_published: optimise as appendices C to E do: from the given start only, on the modulus, penalised from the
        first step on, and with their tolerances. It mostly stops short of the minimum, where the data say little.
      use_penalty: whether to push the fit away from instability (eq. 2.21).
      delay: "exact", or the thesis's "pade".

    Raises:
      ValueError: shapes do not fit, values are not finite, an admittance is zero, a start is unknown or outside its
        bounds, or the structure has free parameters that no admittance at these frequencies can tell apart.
    """
    if isinstance(structure, str):
        if structure not in STRUCTURES:
            raise ValueError(f"model = {structure!r}; expected one of {', '.join(STRUCTURES)}")
        structure = STRUCTURES[structure]
    problem = _checked(frequency, admittance, coherence, body, structure, environment, delay)
    first = _checked_start(structure, start)
    problem.require_identifiable(first)
    if as_published:
        solution = _minimise_as_published(problem, first, with_penalty=use_penalty)
        return problem.judge(
            solution, use_penalty=use_penalty, n_starts=1, n_starts_agree=1, n_evaluations=solution.nfev
        )
    starts = [first, with_linear_part(problem.model, problem.admittance, body, structure, first)]
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


def _minimise_as_published(
    problem: "_Problem", start: NDArray[np.float64], *, with_penalty: bool
) -> optimize.OptimizeResult:
    """What lsqnonlin did with the options of appendix C, but for the derivatives, which are exact here."""
    scale = np.where(start != 0, np.abs(start), 1.0)
    lower, upper = problem.bounds

    def residual(v: NDArray[np.float64]) -> NDArray[np.float64]:
        modulus = np.abs(problem.log_error(v * scale))
        return modulus * problem.penalty(v * scale) if with_penalty else modulus

    def jacobian(v: NDArray[np.float64]) -> NDArray[np.float64]:
        values = v * scale
        modulus, slope = _modulus(*problem.log_error_and_slope(values))
        if with_penalty:
            factor, gradient = problem.penalty_and_gradient(values)
            slope = slope * factor + np.outer(modulus, gradient)
        return slope * scale

    solution = optimize.least_squares(
        residual,
        np.clip(start, lower, upper) / scale,
        jacobian,
        bounds=(lower / scale, upper / scale),
        xtol=1e-6,
        ftol=1e-5,
        gtol=None,
        max_nfev=PUBLISHED_EVALUATIONS // (1 + len(start)),
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
    model: LinearArm
    latest_pole: dict[bytes, complex] = field(default_factory=dict)

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        lower, upper = np.array(list(self.structure.bounds.values())).T
        return lower, upper

    def parameters(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.structure.parameters(self.body.task, values)

    def penalty(self, values: NDArray[np.float64]) -> float:
        return penalty_factor(self.largest_pole(values).real)

    def largest_pole(self, values: NDArray[np.float64]) -> complex:
        # An optimiser asks for the derivative where it has just asked for the residual.
        key = values.tobytes()
        if key not in self.latest_pole:
            poles = self.model.poles(self.parameters(values), self.environment)
            self.latest_pole.clear()
            self.latest_pole[key] = complex(poles[np.argmax(poles.real)])
        return self.latest_pole[key]

    def log_error(self, values: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Weighted complex log error, (4 frequency,)."""
        error = self.weight * np.log(self.admittance / self.model.admittance(self.parameters(values)))
        return np.asarray(error.ravel())

    def log_error_and_slope(self, values: NDArray[np.float64]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """`log_error` and its derivative, (4 frequency,) and (4 frequency, parameter)."""
        model, gradient = self.model.admittance_and_gradient(self.parameters(values))
        slope = (gradient @ self.structure.mixing) * (-self.weight / model)[..., None]
        error = self.weight * np.log(self.admittance / model)
        return np.asarray(error.ravel()), np.asarray(slope.reshape(-1, slope.shape[-1]))

    def residual(self, values: NDArray[np.float64], with_penalty: bool) -> NDArray[np.float64]:
        """Weighted complex log error, real then imaginary parts; with penalty and then a zero, (8 frequency [+ 1],)."""
        error = _stack(self.log_error(values))
        return np.append(error * self.penalty(values), 0.0) if with_penalty else error

    def jacobian(self, values: NDArray[np.float64], with_penalty: bool) -> NDArray[np.float64]:
        """Derivative of the residual, (8 frequency [+ 1], parameter).

        The zero that comes with the penalty changes neither criterion nor gradient, whatever its row here. The row adds
        the second derivative of the penalty, most of its curvature, to the Gauss-Newton step: without it the optimiser
        creeps along the border of stability.
        """
        error, slope = map(_stack, self.log_error_and_slope(values))
        if not with_penalty:
            return slope
        factor, gradient = self.penalty_and_gradient(values)
        if factor - 1.0 < NEGLIGIBLE_PENALTY:
            return np.vstack([slope, gradient])
        curvature = np.linalg.norm(error) * np.sqrt(factor / (factor - 1.0)) * gradient
        return np.vstack([slope * factor + np.outer(error, gradient), curvature])

    def penalty_and_gradient(self, values: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Penalty and its derivative, (parameter,), which is zero where the penalty is one or out of all bounds."""
        pole = self.largest_pole(values)
        factor = penalty_factor(pole.real)
        if factor - 1.0 < NEGLIGIBLE_PENALTY or factor >= penalty_factor(np.inf):
            return factor, np.zeros(len(values))
        slope = self.model.pole_gradient(self.parameters(values), self.environment, pole).real @ self.structure.mixing
        return factor, np.asarray((factor - 1.0) * 10.0 * np.log(10.0) * slope)

    def require_identifiable(self, start: NDArray[np.float64]) -> None:
        """Refuse a structure in which some direction of the parameters changes no response.

        What has no effect at the start may have some elsewhere, as a delay has none without gains: only what has none
        at random places within the bounds either is refused.

        Raises:
          ValueError: there is such a direction.
        """
        rng = np.random.default_rng(0)
        lower, upper = self.bounds
        places = [start, *(start + share * (rng.uniform(lower, upper) - start) for share in (0.1, 0.3))]
        slopes = [_stack(self.log_error_and_slope(values)[1]) for values in places]
        nothing = [_silent_directions(slope) for slope in slopes]
        if all(directions.size for directions in nothing):
            effect = np.linalg.norm(slopes[-1], axis=0)
            direction = nothing[-1][0] / np.where(effect > 0, effect, 1.0)
            direction[np.abs(nothing[-1][0]) < 1e-3] = 0.0
            direction /= np.abs(direction).max()
            parts = [
                f"{share:+.2g} {unit(name)} of {name}"
                for share, name in zip(direction, self.structure.free, strict=True)
                if share
            ]
            raise ValueError(
                f"model {self.structure.name} cannot be identified from {len(self.frequency)} frequencies: "
                f"{', '.join(parts)} change no response; expected fewer free parameters"
            )

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
        pole = self.largest_pole(values).real
        factor = penalty_factor(pole) if use_penalty else 1.0
        error, slope = self.log_error_and_slope(values)
        sem = _standard_error(error, slope)
        lower, upper = self.bounds
        near = np.minimum(values - lower, upper - values) <= AT_BOUND * (upper - lower)
        unidentified = tuple(name for name, value in zip(names, sem, strict=True) if not np.isfinite(value))
        status = _WHY_STOPPED[solution.status]
        if unidentified:
            status += f"; the data say nothing about {', '.join(unidentified)}"
        return AdmittanceFit(
            structure=self.structure.name,
            arm=arm,
            values=dict(zip(names, map(float, values), strict=True)),
            sem=dict(zip(names, map(float, sem), strict=True)),
            unidentified=unidentified,
            at_bound=tuple(name for name, hit in zip(names, near, strict=True) if hit),
            status=status,
            converged=solution.status > 0,
            criterion=float(np.mean(np.abs(error) ** 2)) * factor**2,
            n_errors=len(error),
            penalty=factor,
            stable=pole < 0,
            largest_real_pole=pole,
            n_starts=n_starts,
            n_starts_agree=n_starts_agree,
            n_evaluations=n_evaluations,
        )


def _stack(values: NDArray[np.complex128]) -> NDArray[np.float64]:
    return np.concatenate([values.real, values.imag])


def _silent_directions(jacobian: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions of the columns, each scaled by its norm, in which nothing changes, (direction, column)."""
    scale = np.linalg.norm(jacobian, axis=0)
    if not scale.all():
        return np.eye(len(scale))[scale == 0]
    _, singular, basis = np.linalg.svd(jacobian / scale)
    return np.asarray(basis[np.count_nonzero(singular > UNIDENTIFIED * singular[0]) :])


def _modulus(
    error: NDArray[np.complex128], slope: NDArray[np.complex128]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Modulus of a complex error, (n,), and its derivative, (n, parameter)."""
    modulus = np.abs(error)
    aligned = np.divide(error.conj(), modulus, out=np.zeros_like(error), where=modulus > 0)
    return modulus, (aligned[:, None] * slope).real


def _standard_error(error: NDArray[np.complex128], slope: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Eq. 2.22 for the modulus of the error; infinite for columns that share in a direction without effect.

    Args:
      error: complex log error, (n,).
      slope: its derivative, (n, parameter).
    """
    modulus, jacobian = _modulus(error, slope)
    silent = np.abs(_silent_directions(jacobian)).max(axis=0, initial=0.0) > 1e-6
    known = jacobian[:, ~silent]
    scale = np.linalg.norm(known, axis=0)
    _, singular, basis = np.linalg.svd(known / scale, full_matrices=False)
    variance = np.sum((basis / singular[:, None]) ** 2, axis=0) / scale**2 * np.mean(modulus**2)
    sem = np.full(len(silent), np.inf)
    sem[~silent] = np.sqrt(variance)
    return sem


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
    if delay not in get_args(Delay):
        raise ValueError(f"delay = {delay!r}; expected one of {', '.join(get_args(Delay))}")
    if 8 * f.size <= len(structure.free):
        raise ValueError(f"{f.size} frequencies for {len(structure.free)} parameters; expected more frequencies")
    weight = np.broadcast_to(np.sqrt(c)[:, :, None], h.shape)
    return _Problem(f, h, weight, body, structure, environment, LinearArm(body, f, delay))


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
