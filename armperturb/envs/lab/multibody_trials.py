"""Trials of MuJoCo's arms: prepared in threads, stepped in lockstep, logged behind the recorder's filter."""

from collections.abc import Sequence

import numpy as np
from scipy import signal

from armperturb.arrays import Array
from armperturb.controllers.arm_control import ArmControl
from armperturb.controllers.layout import trials_adjacent
from armperturb.envs.lab.setup import Progress, Setup, Truth, in_threads
from armperturb.envs.lab.simulation import Simulation, silent_simulator
from armperturb.envs.lab.trial import Trial, held_force, noise_torque
from armperturb.subject import Subject

CHUNK = 100
"""Samples of the recording between two runs of the anti-alias filter, for which signals are held at full rate."""

HANDLE, ANGLE, FORCE, SHOULDER = slice(0, 2), slice(2, 4), slice(4, 6), slice(6, 8)
"""Columns of a `SignalLog`; the last ones where a strap lets the shoulder move."""


class SignalLog:
    """Signals of all trials, every one at the recording's rate; a low-pass sees them at the simulation's rate."""

    def __init__(self, shape: tuple[int, int, int], decimation: int, lowpass: Array | None) -> None:
        """Begin at rest.

        Args:
          shape: samples of the recording, trials, and columns.
          decimation: simulation steps in a sample.
          lowpass: second-order sections at the simulation's rate; None for no filter.
        """
        n_samples, *widths = shape
        self.samples = np.empty(shape)
        self._decimation, self._lowpass, self._n_steps = decimation, lowpass, n_samples * decimation
        self._chunk = np.empty((CHUNK * decimation if lowpass is not None else 0, *widths))
        self._state = None if lowpass is None else np.zeros((len(lowpass), 2, *widths))

    def row(self, step: int) -> Array | None:
        """Where the signals at the start of a step are to be written, (trial, column); None if nothing records them."""
        if self._lowpass is not None:
            return self._chunk[step % len(self._chunk)]
        sample, rest = divmod(step, self._decimation)
        return None if rest else self.samples[sample]

    def end_step(self, step: int) -> None:
        """Filter what has been written, once that is enough or the last."""
        if self._lowpass is None or ((step + 1) % len(self._chunk) and step + 1 < self._n_steps):
            return
        n_rows, sample = step % len(self._chunk) + 1, step // self._decimation
        filtered, self._state = signal.sosfilt(self._lowpass, self._chunk[:n_rows], axis=0, zi=self._state)
        self.samples[sample + 1 - n_rows // self._decimation : sample + 1] = filtered[:: self._decimation]


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
    n_trials, n_samples, decimation, lowpass = len(trials), setup.n_samples(trials), setup.decimation, setup.lowpass
    held, recorded, torque = _prepared(trials, setup, n_threads)
    simulation = Simulation(
        subjects,
        setup.environment,
        timestep=setup.timestep,
        rope=setup.rope,
        strap=setup.strap,
        n_threads=n_threads,
    )
    control = ArmControl(subjects, setup.timestep)
    angle, handle, shoulder = simulation.angle, simulation.handle, simulation.shoulder
    posture = np.array([subject.posture for subject in subjects])
    log = SignalLog((n_samples, n_trials, FORCE.stop + shoulder.shape[1]), decimation, lowpass)
    excitation = np.empty((n_samples if setup.emg else 0, n_trials, 2))
    limit_time = np.full(n_trials, np.nan)
    with silent_simulator():
        for step in range(len(held)):
            applied, delayed = control.torque(angle, simulation.velocity, 0.0 if torque is None else torque[step])
            sample, rest = divmod(step, decimation)
            if not rest:
                if len(excitation):
                    excitation[sample] = control.excitation
                reached = np.abs(handle).max(axis=1) >= setup.environment.workspace
                if reached.any():
                    limit_time[reached & np.isnan(limit_time)] = step * setup.timestep
            row = log.row(step)
            if row is not None:
                row[:, HANDLE], row[:, ANGLE], row[:, SHOULDER] = handle, angle, shoulder
            simulation.step(held[step], applied, delayed)
            if row is not None:
                # The sensors describe the state before the step, at which the other signals were taken.
                row[:, FORCE] = simulation.force
                if lowpass is not None:
                    row[:, ANGLE] -= posture  # a filter starts at rest
            log.end_step(step)
            if not rest and progress is not None:
                progress(n_trials * decimation * setup.timestep)
    # MuJoCo resets a state that it cannot integrate; beyond the workspace limit nothing counts any more.
    diverged = np.flatnonzero(simulation.diverged & np.isnan(limit_time))
    if len(diverged):
        name = trials[diverged[0]].subject.name
        raise RuntimeError(
            f"trial {diverged[0]} of subject {name!r} could not be integrated; expected finite motion (a weaker "
            "perturbation or a smaller step)"
        )
    if lowpass is not None:
        log.samples[:, :, ANGLE] += posture

    def trial_first(values: Array) -> Array:
        return np.ascontiguousarray(values.swapaxes(0, 1))

    return Truth(
        perturbation=recorded,
        force=trial_first(log.samples[:, :, FORCE]),
        displacement=trial_first(log.samples[:, :, HANDLE]),
        joint_angle=trial_first(log.samples[:, :, ANGLE]),
        shoulder=trial_first(log.samples[:, :, SHOULDER]) if shoulder.shape[1] else None,
        excitation=trial_first(excitation),
        limit_time=limit_time,
    )


def _prepared(trials: Sequence[Trial], setup: Setup, n_threads: int) -> tuple[Array, Array, Array | None]:
    """What is known ahead of the simulation.

    Returns:
      Force to hold over each step [N], (step, trial, axis); the disturbance as the recorder has it [N], (trial, time,
      axis); and the torque of the people's noise [Nm], (step, trial, joint), None without noise.
    """
    timestep, lowpass, decimation = setup.timestep, setup.lowpass, setup.decimation
    n_samples = setup.n_samples(trials)
    n_steps = n_samples * decimation
    held = trials_adjacent(np.empty((n_steps, len(trials), 2)), 1)
    recorded = np.empty((len(trials), n_samples, 2))
    noisy = any(trial.noise is not None for trial in trials)
    torque = trials_adjacent(np.zeros((n_steps, len(trials), 2)), 1) if noisy else None

    def prepare(i: int) -> None:
        perturbation = trials[i].perturbation
        held[:, i] = held_force(perturbation, timestep, n_steps)
        if lowpass is None:
            recorded[i] = perturbation.sample(1.0 / (timestep * decimation), n_samples, 0.0)
        else:
            force = perturbation.sample(1.0 / timestep, n_steps, 0.0)
            recorded[i] = signal.sosfilt(lowpass, force, axis=0)[::decimation]
        noise = noise_torque(trials[i], timestep, n_steps)
        if torque is not None and noise is not None:
            torque[:, i] = noise

    list(in_threads(prepare, len(trials), n_threads))
    return held, recorded, torque
