"""An arm model fitted to an admittance by the thesis's criterion (2.18-2.22, appendices C and E).

The error of eq. 2.18 is a modulus, |ln(H_estimated / H_model)|. The fit minimises the squares of the real and imaginary
part of the complex logarithm instead: the same criterion and the same minimum, but a Gauss-Newton step that is right,
which the modulus spoils. The standard errors are those of the modulus, as eq. 2.22 has them: it keeps about half of the
information, and with the sum of squares over N = 4 n_f they are twice the scatter that independent errors cause.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from armperturb.analysis.arm.linear_arm import Delay
from armperturb.analysis.fit import admittance_problem
from armperturb.analysis.fit.linear_start import with_linear_part
from armperturb.analysis.fit.structures import Structure, start_in, structure_of, unit
from armperturb.analysis.numerics.bounds import names_at_bound
from armperturb.analysis.results import Description, Result, Table, plain
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.subject import Subject

PERFECT = 1e-16
"""A fit whose squared error per frequency is below this cannot be improved, and needs no other start."""

_WHY_STOPPED = {
    -1: "not converged: the criterion is not finite at the start",
    0: "not converged: limit of evaluations reached",
    1: "converged: gradient vanished",
    2: "converged: criterion settled",
    3: "converged: parameters settled",
    4: "converged: criterion and parameters settled",
}


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class AdmittanceFit(Result):
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

    def describe(self) -> Description:
        """Estimates with the SEM of eq. 2.22, and how the search ended."""
        return Description(
            title=f"Admittance of {self.arm.name} fitted by the thesis's criterion: model {self.structure}",
            facts=(f"{self.status}; criterion {plain(self.criterion)}, {'' if self.stable else 'not '}stable",),
            table=Table(
                ("parameter", "estimate", "SEM", "unit"),
                tuple(
                    (name, plain(value), plain(self.sem[name], 3), unit(name)) for name, value in self.values.items()
                ),
            ),
            remarks=tuple(f"{name} sits on a bound" for name in self.at_bound),
        )


def fit_admittance(
    frequency: ArrayLike,
    admittance: ArrayLike,
    body: Subject,
    structure: Structure | str,
    environment: Environment,
    *,
    coherence: ArrayLike | None = None,
    initial: Mapping[str, float] | None = None,
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
      body: gives task, segments and posture; its other parameters do not matter.
      structure: model structure, or its name in `STRUCTURES`.
      environment: what the hand held, for the stability of the whole.
      coherence: multiple coherence [-], (frequency, output); one if not given.
      initial: values of free parameters to start from, SI; where not given, those of `structures.start_in`.
      as_published: optimise as appendices C to E do: from the given start only, on the modulus, penalised from the
        first step on, and with their tolerances. It mostly stops short of the minimum, where the data say little.
      use_penalty: whether to push the fit away from instability (eq. 2.21).
      delay: "exact", or the thesis's "pade".

    Raises:
      ValueError: shapes do not fit, values are not finite, an admittance is zero, an initial value is unknown or not
        within its bounds, or free parameters are not separately identifiable from any admittance at these frequencies.
    """
    target = admittance_problem.Target(
        frequency=frequency, admittance=admittance, body=body, environment=environment, coherence=coherence
    )
    structure = structure_of(structure)
    problem = admittance_problem.checked_problem(target, structure, delay)
    first = _checked_initial(structure, body.task, initial)
    _require_identifiable(target, structure, delay, problem.weight, first)
    if as_published:
        # Loads slowly, and few analyses need it.
        from armperturb.analysis.fit.published_search import search_as_published

        values, status = search_as_published(problem, first, use_penalty)
        return _judged(problem, body, structure, values, status, use_penalty)
    starts = [first, with_linear_part(problem.model, problem.admittance, body, structure, first)]
    solutions = [admittance_problem.least_squares(problem, values, with_penalty=False) for values in starts]
    best = min(solutions, key=lambda solution: solution.cost)
    if use_penalty and problem.penalty(best.x) > 1.0 + 1e-6:
        # An unstable start has no use for a criterion that its penalty dwarfs; a stable optimum competes, whatever its
        # penalty: without noise it is the minimum all the same.
        stable = [values for values in starts if problem.penalty(values) < 1e3]
        stable = stable or [_checked_initial(structure, body.task, None)]
        if problem.penalty(best.x) < admittance_problem.penalty_factor(0.0):
            stable.insert(0, best.x)
        solutions = [admittance_problem.least_squares(problem, stable[0], with_penalty=True)]
        if solutions[0].cost > PERFECT * len(problem.frequency):
            solutions += [admittance_problem.least_squares(problem, values, with_penalty=True) for values in stable[1:]]
        best = min(solutions, key=lambda solution: solution.cost)
    return _judged(problem, body, structure, best.x, best.status, use_penalty)


def _require_identifiable(
    target: admittance_problem.Target, structure: Structure, delay: Delay, weight: Array, start: Array
) -> None:
    """Refuse a structure in which some direction of the parameters changes no response.

    Raises:
      ValueError: there is such a direction.
    """
    frequency = np.asarray(target.frequency, dtype=float)
    silent = _silent_direction(
        structure, target.body, delay, frequency.tobytes(), (weight > 0.0).tobytes(), start.tobytes()
    )
    if silent is None:
        return
    parts = [
        f"{share:+.2g} {unit(name)} of {name}" for share, name in zip(silent, structure.free, strict=True) if share
    ]
    raise ValueError(
        f"model {structure.name} cannot be identified from {frequency.size} frequencies: "
        f"{', '.join(parts)} change no response; expected fewer free parameters"
    )


@lru_cache(maxsize=256)
def _silent_direction(
    structure: Structure, body: Subject, delay: Delay, frequency: bytes, is_used: bytes, start: bytes
) -> tuple[float, ...] | None:
    """A direction of the free parameters that changes no response, whatever the admittance; None if there is none.

    What has no effect at the start may have some elsewhere, as a delay has none without gains: only what has none at
    random places within the bounds either counts. Remembered, as all trials of a condition ask the same.

    Args:
      structure: what is free.
      body: gives task, segments and posture.
      delay: "exact" or "pade".
      frequency: [Hz], (frequency,), the bytes of it, as of the next two.
      is_used: whether each element of the admittance counts, (frequency, output, input).
      start: values of the free parameters, SI, (parameter,).
    """
    of = np.frombuffer(frequency)
    used = np.frombuffer(is_used, dtype=bool).reshape(-1, 2, 2)
    target = admittance_problem.Target(
        frequency=of, admittance=np.ones(used.shape), body=body, environment=Environment()
    )
    problem = replace(admittance_problem.checked_problem(target, structure, delay), weight=used.astype(float))
    first = np.frombuffer(start)
    rng, place = np.random.default_rng(0), first
    for share in (0.1, 0.3, None):
        slope = admittance_problem.stack(problem.log_error_and_slope(place)[1])
        silent = admittance_problem.silent_directions(slope)
        if not silent.size:
            return None
        if share is not None:
            place = first + share * (rng.uniform(problem.lower, problem.upper) - first)
    effect = np.linalg.norm(slope, axis=0)
    direction = silent[0] / np.where(effect > 0, effect, 1.0)
    direction[np.abs(silent[0]) < 1e-3] = 0.0
    direction /= np.abs(direction).max()
    return tuple(direction.tolist())


def _judged(
    problem: admittance_problem.AdmittanceProblem,
    body: Subject,
    structure: Structure,
    values: Array,
    status: int,
    use_penalty: bool,
) -> AdmittanceFit:
    """The fit at its solution, with all that a reader must know to trust it or not.

    Args:
      problem: what was solved.
      body: as `fit_admittance` has it.
      structure: what was free.
      values: the solution, (parameter,).
      status: why the search stopped, see `trust_region`.
      use_penalty: whether the criterion has a penalty.
    """
    lower, upper, names = problem.lower, problem.upper, structure.free
    modulus, slope = problem.modulus_and_slope(values)
    pole = problem.largest_pole(values).real
    factor = float(admittance_problem.penalty_factor(pole)) if use_penalty else 1.0
    sem = admittance_problem.standard_error(modulus, slope)
    unidentified = tuple(name for name, value in zip(names, sem, strict=True) if not np.isfinite(value))
    why = _WHY_STOPPED[status]
    if unidentified:
        why += f"; the data say nothing about {', '.join(unidentified)}"
    return AdmittanceFit(
        structure=structure.name,
        arm=structure.arm(body, values),
        values=dict(zip(names, values.tolist(), strict=True)),
        sem=dict(zip(names, sem.tolist(), strict=True)),
        unidentified=unidentified,
        at_bound=names_at_bound(names, values, lower, upper),
        status=why,
        converged=status > 0,
        criterion=float(np.mean(modulus**2) * factor**2),
        n_errors=modulus.size,
        penalty=factor,
        stable=pole < 0,
        largest_real_pole=pole,
    )


def _checked_initial(structure: Structure, task: str, initial: Mapping[str, float] | None) -> Array:
    values = dict(start_in(structure, task))
    for name, value in (initial or {}).items():
        if name not in values:
            raise ValueError(
                f"initial: unknown parameter {name!r}; model {structure.name} has {', '.join(structure.free)}"
            )
        lower, upper = structure.bounds[name]
        if not lower <= value <= upper:
            raise ValueError(f"initial: {name} = {value!r}; expected {lower:g} to {upper:g} {unit(name)}")
        values[name] = float(value)
    return np.array([values[name] for name in structure.free])
