"""An arm model fitted to an admittance by the thesis's criterion (2.18-2.22, appendices C and E).

The error of eq. 2.18 is a modulus, |ln(H_estimated / H_model)|. The fit minimises the squares of the real and imaginary
part of the complex logarithm instead: the same criterion and the same minimum, but a Gauss-Newton step that is right,
which the modulus spoils. The standard errors are those of the modulus, as eq. 2.22 has them: it keeps about half of the
information, and with the sum of squares over N = 4 n_f they are twice the scatter that independent errors cause.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armperturb.analysis.arm.joint_matrices import Environments
from armperturb.analysis.arm.linear_arm import Delay, LinearArm
from armperturb.analysis.fit import admittance_problem
from armperturb.analysis.fit.linear_start import with_linear_part
from armperturb.analysis.fit.structures import Structure, start_in, structure_of, unit
from armperturb.analysis.numerics.trust_region import NOT_FINITE, minimise
from armperturb.analysis.results import Description, Result, Table, plain
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.subject import Subject

PUBLISHED_EVALUATIONS = 6000
"""MaxFunEvals of appendix C, which counts those for numerical derivatives: one per parameter and step."""

AT_BOUND = 1e-6
"""A parameter sits on a bound when it is closer to it than this share of the distance between its bounds."""

PERFECT = 1e-16
"""A fit whose squared error per frequency is below this cannot be improved, and needs no other start."""

_WHY_STOPPED = {
    NOT_FINITE: "not converged: the criterion is not finite at the start",
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
    if as_published:
        return fit_admittances([target], [structure], initials=[initial], use_penalty=use_penalty, delay=delay)[0]
    structure = structure_of(structure)
    batch = _Batch.of([target], [structure], delay)
    problem = admittance_problem.checked_problem(target, structure, delay)
    first = _checked_initial(structure, body.task, initial)
    batch.require_identifiable(first[None])
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
    return batch.judge(best.x[None], [best.status], np.array([use_penalty]))[0]


def fit_admittances(
    targets: Sequence[admittance_problem.Target],
    structures: Sequence[Structure | str],
    *,
    initials: Sequence[Mapping[str, float] | None],
    use_penalty: bool | Sequence[bool] = True,
    delay: Delay = "exact",
) -> list[AdmittanceFit]:
    """Fit an arm model to each of many admittances as published, see `fit_admittance`.

    All are fitted together, which is many times faster than one by one.

    Args:
      targets: what to fit to, with the same number of frequencies; of any people and tasks. One that several starts
        share stands here once for each.
      structures: model structure of each fit, or its name in `STRUCTURES`.
      initials: where each fit starts, (target,): values of free parameters, SI; where not given, those of
        `structures.start_in`.
      use_penalty: whether to push fits away from instability (eq. 2.21); of all, or each.
      delay: "exact", or the thesis's "pade".

    Returns:
      A fit for each target.

    Raises:
      ValueError: as `fit_admittance`, or numbers of frequencies differ.
    """
    if not targets:
        return []
    with_penalty = np.broadcast_to(use_penalty, len(targets))
    order = np.argsort(~with_penalty, kind="stable")
    with_penalty = with_penalty[order]
    batch = _Batch.of([targets[i] for i in order], [structure_of(structures[i]) for i in order], delay)
    problem, sizes = batch.problem, batch.sizes
    first = np.zeros_like(problem.lower)
    for row, structure, i in zip(first, batch.structures, order, strict=True):
        row[: len(structure.free)] = _checked_initial(structure, targets[i].body.task, initials[i])
    batch.require_identifiable(first)
    scale = np.where(first != 0, np.abs(first), 1.0)
    search = minimise(
        _Published(batch, scale, with_penalty),
        np.clip(first, problem.lower, problem.upper) / scale,
        problem.lower / scale,
        problem.upper / scale,
        ftol=1e-5,
        xtol=1e-6,
        max_nfev=PUBLISHED_EVALUATIONS // (1 + sizes),
        sizes=sizes,
    )
    values = np.clip(search.x * scale, problem.lower, problem.upper)
    fits = batch.judge(values, search.status, with_penalty)
    return [fits[place] for place in np.argsort(order)]


@dataclass(frozen=True, eq=False)
class _Batch:
    """Problems with the same number of frequencies, in one.

    Parameters are those of the largest structure: what others have less is zero, and has no effect.
    """

    bodies: tuple[Subject, ...]
    structures: tuple[Structure, ...]
    problem: admittance_problem.AdmittanceProblem

    @classmethod
    def of(cls, targets: Sequence[admittance_problem.Target], structures: Sequence[Structure], delay: Delay) -> Self:
        """The problems of targets.

        Raises:
          ValueError: as `fit_admittances`.
        """
        pairs = zip(targets, structures, strict=True)
        problems = [admittance_problem.checked_problem(target, structure, delay) for target, structure in pairs]
        if len(counts := {len(each.frequency) for each in problems}) > 1:
            raise ValueError(
                f"targets have {', '.join(map(str, sorted(counts)))} frequencies; expected the same number"
            )
        n = max(each.mixing.shape[1] for each in problems)

        def filled(values: Array, missing: float) -> Array:
            width = [(0, 0)] * (values.ndim - 1) + [(0, n - values.shape[-1])]
            return np.pad(values, width, constant_values=missing)

        bodies = tuple(target.body for target in targets)
        frequency = np.array([each.frequency for each in problems])
        problem = admittance_problem.AdmittanceProblem(
            frequency,
            admittance_problem.frequency_last(np.array([each.admittance for each in problems])),
            admittance_problem.frequency_last(np.array([each.weight for each in problems])),
            Environments.of([target.environment for target in targets]),
            LinearArm(bodies, frequency, delay),
            np.array([filled(each.mixing, 0.0) for each in problems]),
            np.array([each.constant for each in problems]),
            np.array([filled(each.lower, -1.0) for each in problems]),
            np.array([filled(each.upper, 1.0) for each in problems]),
        )
        return cls(bodies, tuple(structures), problem)

    @property
    def sizes(self) -> NDArray[np.int64]:
        """How many parameters each has."""
        return np.array([len(structure.free) for structure in self.structures])

    def take(self, index: NDArray[np.int64]) -> Self:
        """Some of the problems, in this order."""
        bodies, structures = (tuple(all_[i] for i in index) for all_ in (self.bodies, self.structures))
        return type(self)(bodies, structures, self.problem.take(index))

    def require_identifiable(self, starts: Array) -> None:
        """Refuse a structure in which some direction of the parameters changes no response of a batch.

        What has no effect at the start may have some elsewhere, as a delay has none without gains: only what has none
        at random places within the bounds either is refused.

        Args:
          starts: (batch, parameter).

        Raises:
          ValueError: there is such a direction.
        """
        rng = np.random.default_rng(0)
        batch, places = self, starts
        for share in (0.1, 0.3, None):
            slopes = admittance_problem.stack(batch.problem.log_error_and_slope(places)[1], axis=1)
            nothing = [
                admittance_problem.silent_directions(slope[:, : len(structure.free)])
                for slope, structure in zip(slopes, batch.structures, strict=True)
            ]
            silent = np.flatnonzero([directions.size > 0 for directions in nothing])
            if not len(silent):
                return
            if share is not None:
                batch, starts = batch.take(silent), starts[silent]
                lower, upper = batch.problem.lower, batch.problem.upper
                places = starts + share * (rng.uniform(lower, upper) - starts)
        structure = batch.structures[silent[0]]
        effect = np.linalg.norm(slopes[silent[0], :, : len(structure.free)], axis=0)
        direction = nothing[silent[0]][0] / np.where(effect > 0, effect, 1.0)
        direction[np.abs(nothing[silent[0]][0]) < 1e-3] = 0.0
        direction /= np.abs(direction).max()
        parts = [
            f"{share:+.2g} {unit(name)} of {name}"
            for share, name in zip(direction, structure.free, strict=True)
            if share
        ]
        raise ValueError(
            f"model {structure.name} cannot be identified from {self.problem.frequency.shape[-1]} frequencies: "
            f"{', '.join(parts)} change no response; expected fewer free parameters"
        )

    def judge(
        self, values: Array, status: Sequence[int] | NDArray[np.int64], with_penalty: NDArray[np.bool_]
    ) -> list[AdmittanceFit]:
        """The fits of a batch at its solutions, with all that a reader must know to trust them or not.

        Args:
          values: solutions, (batch, parameter).
          status: why each search stopped, see `trust_region`.
          with_penalty: whether the criterion has one, (batch,).
        """
        lower, upper = self.problem.lower, self.problem.upper
        modulus, slope = self.problem.modulus_and_slope(values)
        poles = self.problem.largest_pole(values).real
        factors = np.where(with_penalty, admittance_problem.penalty_factor(poles), 1.0)
        criteria = np.mean(modulus**2, axis=-1) * factors**2
        near = np.minimum(values - lower, upper - values) <= AT_BOUND * (upper - lower)
        fits = []
        for i, (body, structure) in enumerate(zip(self.bodies, self.structures, strict=True)):
            names, estimates = structure.free, values[i, : len(structure.free)]
            sem = admittance_problem.standard_error(modulus[i], slope[i, :, : len(names)])
            unidentified = tuple(name for name, value in zip(names, sem, strict=True) if not np.isfinite(value))
            why = _WHY_STOPPED[int(status[i])]
            if unidentified:
                why += f"; the data say nothing about {', '.join(unidentified)}"
            fits.append(
                AdmittanceFit(
                    structure=structure.name,
                    arm=structure.arm(body, estimates),
                    values=dict(zip(names, estimates.tolist(), strict=True)),
                    sem=dict(zip(names, sem.tolist(), strict=True)),
                    unidentified=unidentified,
                    at_bound=tuple(name for name, hit in zip(names, near[i, : len(names)], strict=True) if hit),
                    status=why,
                    converged=int(status[i]) > 0,
                    criterion=float(criteria[i]),
                    n_errors=modulus.shape[-1],
                    penalty=float(factors[i]),
                    stable=bool(poles[i] < 0),
                    largest_real_pole=float(poles[i]),
                )
            )
        return fits


@dataclass(frozen=True, eq=False)
class _Published:
    """A batch of problems as lsqnonlin had them in appendix C, but for the derivatives, which are exact here.

    Residuals are moduli, and parameters are normalised by their start. Problems with a penalty come first.
    """

    batch: _Batch
    scale: Array
    with_penalty: NDArray[np.bool_]

    def take(self, index: NDArray[np.int64]) -> Self:
        """Some of the problems, in this order."""
        return type(self)(self.batch.take(index), self.scale[index], self.with_penalty[index])

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Residuals and their derivatives, see `trust_region.Problems`."""
        values = x * self.scale
        modulus, slope = self.batch.problem.modulus_and_slope(values)
        n, problem = self._penalised
        slope[n:] *= self.scale[n:, None]
        if n:
            factor, gradient = problem.penalty_and_gradient(values[:n])
            slope[:n] *= (factor[:, None] * self.scale[:n])[:, None]
            slope[:n] += modulus[:n, :, None] * (gradient * self.scale[:n])[:, None]
            modulus[:n] *= factor[:, None]
        return modulus, slope

    @cached_property
    def _penalised(self) -> tuple[int, admittance_problem.AdmittanceProblem]:
        """How many problems have a penalty, and they alone."""
        n = int(np.count_nonzero(self.with_penalty))
        whole = self.batch.problem
        return n, whole if n == len(self.scale) else whole.take(np.arange(n))


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
