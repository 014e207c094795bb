"""The practice session: forces that move each person's handle as far as intended (thesis 2.5)."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from armperturb.analysis.arm.linear_arm import total_admittance
from armperturb.analysis.defaults import WINDOW_START
from armperturb.arrays import Array
from armperturb.cohort import Person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import TIMESTEP, Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine
from armperturb.perturbations.multisine import DESIGN_RATE, PERIOD
from armperturb.seeds import random_stream, trial_seed
from armperturb.study.protocol import PULSE_UNIT, Condition, Protocol
from armperturb.subject import Subject

Measure = Callable[[NDArray[np.int_], Array], Array]
"""Numbers of goals and the RMS force to try for each [N], to the RMS displacement [m] that each results in."""

TOLERANCE = 0.02
"""Largest accepted relative error of an RMS displacement [-]."""

AIM = 0.01
"""Rounds continue until every displacement is this close to the intended one [-], with a margin to `TOLERANCE`."""

MAX_ROUNDS = 6
"""Rounds that a practice session may take."""

TRIALS_PER_BATCH = 240
"""Number of practice trials that are simulated side by side; limits the memory, no effect on the result."""

N_CANDIDATES = 500
"""Number of sets of phases among which the practice multisine is chosen; its crest factor on y is some 2.8."""

_NONLINEAR_EXPONENT = 1.3
"""Exponent of displacement over force [-] in the first correction for nonlinear muscles: it is 1.0 to 1.8."""

_LARGEST_STEP = math.log(4.0)
"""Largest change of the logarithm of the force from one round to the next."""

_EXPONENTS = (0.1, 8.0)
"""Bounds of the exponent of displacement over force [-]: 1 is a linear arm."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Adjustment:
    """Result of `adjust`, one entry per goal.

    Attributes:
      force: RMS force [N], (goal,).
      displacement: RMS displacement that resulted [m], (goal,).
      rounds: number of rounds that it took, (goal,).
    """

    force: Array
    displacement: Array
    rounds: NDArray[np.int_]


def practise(
    people: Sequence[Person],
    protocol: Protocol,
    seed: int,
    n_threads: int = 0,
    *,
    noisy: bool = False,
    timestep: float = TIMESTEP,
) -> tuple[dict[str, float], ...]:
    """Forces for every person: each condition's force is adjusted until the handle moves as far as intended.

    That is the protocol's displacement times what people reach of it (`Condition.reached`). All people and conditions
    are simulated together, round after round, each until its displacement is reached. With `forces = "published"`
    nobody practises. A person's forces depend on the person, the protocol, the seed and the time
    step, not on who else is there.

    Args:
      people: who practises.
      protocol: whose conditions.
      seed: of the study.
      n_threads: of the simulation; 0 takes all cores.
      noisy: whether people are noisy while they practise, in the same way in every round.
      timestep: of the simulation [s].

    Returns:
      Per person: name of each condition with a multisine to its RMS force per axis [N], and "pulse_unit" to the peak
      force of pulse level 1 [N].

    Raises:
      KeyError: a person lacks a task of the protocol.
      RuntimeError: a displacement was not reached in six rounds; the message names person, condition and values.
    """
    if protocol.forces == "published":
        return tuple(protocol.given_forces() for _ in people)
    # The same subject who is to move as far needs the same force: such goals are measured once.
    conditions = [condition for condition in protocol.conditions if condition.has_multisine]
    goals_of = [{each.name: _Goal.of(person, each, seed) for each in conditions} for person in people]
    goals = list(dict.fromkeys(goal for of_person in goals_of for goal in of_person.values()))
    force_of: dict[_Goal, float] = {}
    if goals:
        simulate = partial(
            measured_displacement,
            environment=Environment(),
            strap=protocol.strap,
            engine="mujoco" if protocol.strap else "compiled",
            timestep=timestep,
            n_threads=n_threads,
        )
        adjusted = _reach(goals, seed, noisy, simulate)
        force_of = dict(zip(goals, adjusted.force.tolist(), strict=True))
    forces = []
    for goal_of in goals_of:
        of_person = {name: force_of[goal] for name, goal in goal_of.items()}
        unit = protocol.pulse_unit
        if protocol.pulse_unit_condition:
            unit = protocol.pulse_unit_factor * of_person[protocol.pulse_unit_condition]
        forces.append({**of_person, PULSE_UNIT: float(unit)})
    return tuple(forces)


@dataclass(frozen=True)
class _Goal:
    """How far a person is to move the handle; `condition` names one in which that is so, and makes no difference."""

    subject: Subject
    displacement: float
    condition: str = field(compare=False)

    @classmethod
    def of(cls, person: Person, condition: Condition, seed: int) -> Self:
        share = condition.reached
        if condition.reached_spread:
            rng = np.random.default_rng(random_stream(seed, f"reached {person.name} {condition.name}"))
            share *= math.exp(condition.reached_spread * float(np.clip(rng.normal(), -2.0, 2.0)))
        return cls(condition.subject_of(person), share * condition.rms_displacement, condition.name)


def _reach(goals: Sequence[_Goal], seed: int, noisy: bool, simulate: Callable[[list[Trial]], Array]) -> Adjustment:
    """The force of each goal.

    Raises:
      RuntimeError: a goal was not reached.
    """
    multisine = practice_multisine(seed)
    per_newton = [linear_displacement(goal.subject, Environment(), multisine) for goal in goals]
    targets = np.array([goal.displacement for goal in goals])

    def measure(numbers: NDArray[np.int_], force: Array) -> Array:
        trials = [
            Trial(
                subject=goal.subject,
                perturbation=replace(multisine, rms=newton),
                condition=goal.condition,
                # The same noise in every round, or the session would chase it.
                seed=trial_seed(seed, f"practice {goal.subject.name} {goal.condition}"),
                noise=HUMAN_NOISE[goal.subject.task] if noisy else None,
            )
            for goal, newton in zip([goals[number] for number in numbers.tolist()], force.tolist(), strict=True)
        ]
        return np.concatenate(
            [simulate(trials[first : first + TRIALS_PER_BATCH]) for first in range(0, len(trials), TRIALS_PER_BATCH)]
        )

    exponents = np.array([1.0 if goal.subject.muscle is None else _NONLINEAR_EXPONENT for goal in goals])
    adjusted = adjust(targets, targets / np.array(per_newton), measure, exponents)
    off = np.abs(adjusted.displacement / targets - 1.0)
    worst = int(np.argmax(np.where(np.isnan(off), np.inf, off)))
    if not off[worst] <= TOLERANCE:
        raise RuntimeError(
            f"practice of {goals[worst].subject.name!r} in {goals[worst].condition}: RMS displacement = "
            f"{1e3 * adjusted.displacement[worst]:.4g} mm at an RMS force of {adjusted.force[worst]:.4g} N after "
            f"{adjusted.rounds[worst]} rounds; expected {1e3 * targets[worst]:g} mm within {TOLERANCE:.0%}"
        )
    return adjusted


@functools.lru_cache(maxsize=64)
def practice_multisine(seed: int) -> Multisine:
    """The disturbance that people practise with, 1 N RMS: one that moves them as realisations do on average.

    How far one realisation moves an arm depends, through the cross terms of the admittance, on the phases between x and
    y: they differ by 8 % (SD over realisations, PT), in single cases by 30 %. Here the phase between x and y makes half
    a turn within each cluster, + - - +, so that what the cross terms give in two lines they take in the other two:
    1 % is left (SD over people). The phase of each cluster is free, and chosen for a low peak.
    """
    rng = np.random.default_rng(random_stream(seed, "practice"))
    multisine = Multisine.draw(seed=rng, rms=1.0, duration=WINDOW_START + PERIOD)
    n_clusters, n_lines = multisine.clusters.shape
    turned = multisine.phases[0].reshape(n_clusters, n_lines) + np.pi * np.array([0.0, 1.0, 1.0, 0.0])
    free = rng.uniform(-np.pi, np.pi, (N_CANDIDATES, n_clusters, 1))
    candidates = (turned + free).reshape(N_CANDIDATES // 2, 2, -1)
    # Two candidates at a time, as the axes of one multisine.
    peaks = [replace(multisine, phases=pair).crest_factor(DESIGN_RATE) for pair in candidates]
    best = candidates.reshape(N_CANDIDATES, -1)[np.argmin(peaks)]
    return replace(multisine, phases=np.stack([multisine.phases[0], best]))


def linear_displacement(subject: Subject, environment: Environment, multisine: Multisine) -> float:
    """RMS displacement per axis of the linear arm under a multisine, in the steady state [m]."""
    force = (multisine.amplitudes * np.exp(1j * multisine.phases)).T
    response = np.einsum("foi,fi->fo", total_admittance(subject, environment, multisine.frequencies), force)
    # A line has half its squared amplitude in power; pooled over both axes.
    return float(np.sqrt(np.sum(np.abs(response) ** 2) / 4.0))


def measured_displacement(trials: Sequence[Trial], environment: Environment, **options: Any) -> Array:
    """RMS displacement from the start, pooled over both axes, from 8 s to 28.48 s [m], (trial,).

    Infinite where the handle reached the workspace limit before the end, or the simulation diverged.

    Args:
      trials: of the practice multisine.
      environment: what the hand holds.
      **options: further ones of `run_experiment`.
    """
    recording = run_experiment(trials, environment, **options)
    first, last = (round(time * recording.attrs["rate"]) for time in (WINDOW_START, WINDOW_START + PERIOD))
    inside = recording["displacement"].values[:, first:last]
    rms = np.sqrt(np.mean(inside**2, axis=(1, 2)))
    return np.where((recording["limit_time"].values < WINDOW_START + PERIOD) | ~np.isfinite(rms), np.inf, rms)


def adjust(
    target: Array,
    guess: Array,
    measure: Measure,
    exponent: Array | None = None,
    *,
    aim: float = AIM,
    max_rounds: int = MAX_ROUNDS,
) -> Adjustment:
    """Find the force that moves the handle as far as intended, for several goals at once.

    Assumes that more force moves the handle further. The first correction takes the displacement to be a power of the
    force. Later ones fit such a power law, from three rounds on with a noise floor, to the last rounds
    (`_model_solution`). If its solution lies outside the bracket of forces known to be too small and too large, the
    bracket is halved.

    Args:
      target: intended RMS displacement [m], > 0, (goal,).
      guess: RMS force of the first round [N], > 0, (goal,).
      measure: numbers of goals and their forces to displacements; infinite where the force was far too large.
      exponent: of the first correction [-], > 0, (goal,); that of linear arms, 1, if not given.
      aim: relative error at which a goal is reached [-].
      max_rounds: most rounds.

    Returns:
      For each goal the best of its rounds, reached or not.
    """
    n_goals = len(target)
    tried: list[list[tuple[float, float]]] = [[] for _ in range(n_goals)]
    force = np.array(guess, dtype=float)
    exponents = np.ones(n_goals) if exponent is None else exponent
    open_goals = np.arange(n_goals)
    for _ in range(max_rounds):
        answer = measure(open_goals, force[open_goals])
        for goal, displacement in zip(open_goals.tolist(), answer.tolist(), strict=True):
            error = math.log(displacement / target[goal]) if displacement > 0.0 else -math.inf
            tried[goal].append((math.log(force[goal]), error))
        open_goals = np.array(
            [i for i in open_goals.tolist() if not abs(math.expm1(tried[i][-1][1])) <= aim], dtype=int
        )
        if not len(open_goals):
            break
        for goal in open_goals.tolist():
            force[goal] = math.exp(_next_try(tried[goal], exponents[goal]))
    best = [min(of_goal, key=lambda point: abs(point[1])) for of_goal in tried]
    return Adjustment(
        force=np.exp([point[0] for point in best]),
        displacement=np.exp([point[1] for point in best]) * target,
        rounds=np.array([len(of_goal) for of_goal in tried]),
    )


def _next_try(tried: Sequence[tuple[float, float]], exponent: float) -> float:
    """Logarithm of the force to try next, from pairs of it and the logarithm of displacement over target."""
    (last, error) = tried[-1]
    below = max((point for point in tried if point[1] < 0.0), default=None)
    above = min((point for point in tried if point[1] > 0.0), default=None)
    if math.isinf(error):
        return 0.5 * (below[0] + last) if below else last - math.log(2.0)
    guess = _model_solution([point for point in dict.fromkeys(tried) if math.isfinite(point[1])])
    correction = -error / exponent if guess is None else guess - last
    guess = last + min(max(correction, -_LARGEST_STEP), _LARGEST_STEP)
    if below is None or above is None or below[0] < guess < above[0]:
        return guess
    return 0.5 * (below[0] + above[0])


def _model_solution(points: Sequence[tuple[float, float]]) -> float | None:
    """Where y^2 = n^2 + (c F)^2p, the power of a noise and of a response to the force F, meets the target.

    The last three points tell n, c and p; two tell c and p without noise.

    Returns:
      Logarithm of the force; None if no such law runs through the points.
    """
    if len(points) < 2:
        return None
    force, level = np.array(points[-3:]).T
    force, power = force - force[-1], np.exp(2.0 * level)
    if len(points) == 2:
        exponent = (level[0] - level[1]) / force[0]
        return float(points[-1][0] - level[1] / exponent) if _EXPONENTS[0] < exponent < _EXPONENTS[1] else None
    exponent = 1.0
    rise = (power[0] - power[2]) / (power[1] - power[2]) if power[1] != power[2] else math.nan

    def excess(p: float) -> float:
        return float(np.expm1(2.0 * p * force[0]) / np.expm1(2.0 * p * force[1]) - rise)

    if math.isfinite(rise) and excess(_EXPONENTS[0]) * excess(_EXPONENTS[1]) < 0.0:
        exponent = float(optimize.brentq(excess, *_EXPONENTS))
    response = (power[-2] - power[-1]) / np.expm1(2.0 * exponent * force[-2])
    noise = power[-1] - response
    if not (response > 0.0 and noise < 1.0):
        return None
    return float(points[-1][0] + math.log((1.0 - noise) / response) / (2.0 * exponent))
