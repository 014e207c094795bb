"""Trials of arms that move as they do, each prepared, simulated and filtered by itself, in threads."""

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from armperturb.analysis.arm.state_space import fastest_pole
from armperturb.arrays import Array
from armperturb.envs.lab.compiled_simulation import CompiledSimulation
from armperturb.envs.lab.setup import Progress, Setup, Truth, flushed, in_threads
from armperturb.envs.lab.simulation import Simulation, silent_simulator
from armperturb.envs.lab.stepping import ANGLE, EXCITATION, FORCE, HANDLE, SHOULDER
from armperturb.envs.lab.trial import RK4_LIMIT, Trial, known_ahead
from armperturb.models.rig import AHEAD
from armperturb.planar_arm.lanes import GROUP
from armperturb.subject import Subject

REFINEMENTS = (1, 2, 4)
"""Parts into which the step of a trial is cut, one number after the other, until it can be integrated. An arm that its
reflexes swing may stretch its elbow, whose snap through the singular posture is too fast for one step; and a person
who is slow enough for the step on average may be too fast in one trial."""

LEAP = 10.0
"""Displacement over the workspace limit [-] to which only an arm that diverges gets within a sample."""


def simulate_multibody(
    trials: Sequence[Trial], subjects: Sequence[Subject], setup: Setup, n_threads: int, progress: Progress | None
) -> Truth:
    """What arms do, by the engine of the setup.

    Args:
      trials: perturbation, noise and seed of each.
      subjects: the person as it is in each trial.
      setup: what the trials share.
      n_threads: of the simulation.
      progress: see `Progress`.

    Raises:
      RuntimeError: a trial that stayed inside the workspace could not be integrated, at a quarter of the step either.
    """
    n_samples, decimation, timestep = (
        setup.n_samples([trial.perturbation for trial in trials]),
        setup.decimation,
        setup.timestep,
    )
    n_steps, compiled = n_samples * decimation, setup.engine == "compiled"

    def simulate(i: int, j: int, parts: int) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Push, log and whether it diverged of these trials, all at the setup's step."""
        step, n = timestep / parts, n_steps * parts
        known = np.stack([known_ahead(trial, timestep, n, parts) for trial in trials[i:j]])
        simulation = (
            CompiledSimulation(subjects[i:j], setup.environment, timestep=step)
            if compiled
            else Simulation(subjects[i:j], setup.environment, timestep=step, rope=setup.rope, strap=setup.strap)
        )
        simulation.start(np.arange(j - i), known[:, : AHEAD + 1])
        simulation.advance(known[:, AHEAD + 1 :])
        return known[:, 1 : n + 1 : parts, 2:], simulation.log[:, :-1:parts], simulation.diverged

    def limit(log: Array, diverged: bool) -> int | None:
        """Sample from which the handle is beyond the workspace; minus one for an arm that never was, but diverged."""
        farthest = np.abs(log[::decimation, HANDLE]).max(axis=1)
        reached = np.flatnonzero(~(farthest < setup.environment.workspace))
        # Beyond the workspace limit nothing counts any more, but no arm gets far beyond it within a sample.
        if diverged and not (len(reached) and farthest[reached[0]] < LEAP * setup.environment.workspace):
            return -1
        return int(reached[0]) if len(reached) else None

    def read(i: int, push: Array, log: Array, diverged: bool) -> tuple[Array, Array, float]:
        parts, finer = REFINEMENTS[0], iter(REFINEMENTS[1:])
        needed = fastest_pole(subjects[i], setup.environment, setup.strap) * timestep / RK4_LIMIT
        while (end := limit(log, diverged)) == -1 or parts < needed:
            if not (parts := next(finer, 0)):
                raise RuntimeError(
                    f"trial {i} of subject {trials[i].subject.name!r} could not be integrated; expected finite motion "
                    "(a weaker perturbation or a smaller step)"
                )
            (push,), (log,), (diverged,) = simulate(i, i + 1, parts)
        rest = np.zeros(log.shape[1])
        rest[ANGLE] = subjects[i].posture
        log = np.nan_to_num(log) if diverged else log
        signals = setup.sampled(log[:, HANDLE.start :], rest[HANDLE.start :])
        every = np.concatenate([flushed(log[::decimation, : HANDLE.start]), signals], axis=1)
        limit_time = np.nan if end is None else end * decimation * timestep
        return setup.sampled(push), every, limit_time

    def run(block: int) -> list[tuple[Array, Array, float]]:
        i, j = block * size, min((block + 1) * size, len(trials))
        results = [read(i + k, *of_trial) for k, of_trial in enumerate(zip(*simulate(i, j, 1), strict=True))]
        if progress is not None:
            progress((j - i) * n_steps * timestep)
        return results

    size = GROUP if compiled else 1
    with silent_simulator():
        blocks = in_threads(run, -(-len(trials) // size), n_threads)
        push, every, limit_time = zip(*itertools.chain.from_iterable(blocks), strict=True)
    log = np.stack(every)
    return Truth(
        perturbation=np.stack(push),
        displacement=log[..., HANDLE],
        joint_angle=log[..., ANGLE],
        force=log[..., FORCE],
        shoulder=log[..., SHOULDER] if setup.strap is not None else None,
        excitation=log[..., EXCITATION] if setup.emg is not None else log[:, :0, EXCITATION],
        limit_time=np.array(limit_time),
    )
