"""Trials of MuJoCo's arms, each prepared, simulated and filtered by itself, in threads."""

from collections.abc import Sequence

import numpy as np
from scipy import signal

from armperturb.arrays import Array
from armperturb.envs.lab.setup import Progress, Setup, Truth, in_threads
from armperturb.envs.lab.simulation import Simulation, silent_simulator
from armperturb.envs.lab.stepping import ANGLE, EXCITATION, FORCE, HANDLE, SHOULDER
from armperturb.envs.lab.trial import Trial, known_ahead
from armperturb.subject import Subject

LEAP = 10.0
"""Displacement over the workspace limit [-] to which only an arm that diverges gets within a sample."""


def simulate_multibody(
    trials: Sequence[Trial], subjects: Sequence[Subject], setup: Setup, n_threads: int, progress: Progress | None
) -> Truth:
    """What MuJoCo's arms do.

    Args:
      trials: perturbation, noise and seed of each.
      subjects: the person as it is in each trial.
      setup: what the trials share.
      n_threads: of the simulation.
      progress: see `Progress`.

    Raises:
      RuntimeError: MuJoCo could not integrate a trial that stayed inside the workspace.
    """
    n_samples, decimation, timestep, lowpass = setup.n_samples(trials), setup.decimation, setup.timestep, setup.lowpass
    n_steps = n_samples * decimation

    def run(i: int) -> tuple[Array, Array, float]:
        known = known_ahead(trials[i], timestep, n_steps)
        simulation = Simulation([subjects[i]], setup.environment, timestep=timestep, rope=setup.rope, strap=setup.strap)
        simulation.start(np.zeros(1, dtype=int), known[None, :4])
        simulation.advance(known[None, 4:])
        [log] = simulation.log
        reached = np.flatnonzero(np.abs(log[::decimation, HANDLE]).max(axis=1) >= setup.environment.workspace)
        limit_time = reached[0] * decimation * timestep if len(reached) else np.nan
        # MuJoCo resets a state that it cannot integrate; beyond the workspace limit nothing counts any more, but no arm
        # gets far beyond it within a sample.
        far = LEAP * setup.environment.workspace
        if simulation.diverged[0] and not (len(reached) and np.abs(log[reached[0] * decimation, HANDLE]).max() < far):
            raise RuntimeError(
                f"trial {i} of subject {trials[i].subject.name!r} could not be integrated; expected finite motion (a "
                "weaker perturbation or a smaller step)"
            )
        push, signals = known[1 : n_steps + 1, 2:], log[:, HANDLE.start :]
        if lowpass is not None:
            rest = np.zeros(log.shape[1])
            rest[ANGLE] = subjects[i].posture  # a filter starts at rest
            push = signal.sosfilt(lowpass, push, axis=0)
            signals = signal.sosfilt(lowpass, signals - rest[HANDLE.start :], axis=0) + rest[HANDLE.start :]
        if progress is not None:
            progress(n_steps * timestep)
        every = np.concatenate([log[:, : HANDLE.start], signals], axis=1)[::decimation]
        return push[::decimation], every, limit_time

    with silent_simulator():
        push, every, limit_time = zip(*in_threads(run, len(trials), n_threads), strict=True)
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
