"""The batched experiment: many trials stepped in lockstep, each a person under a perturbation."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import signal

from armperturb.analysis.arm.state_space import require_stable
from armperturb.arrays import Array
from armperturb.controllers.arm_control import ArmControl
from armperturb.controllers.layout import trials_adjacent
from armperturb.environment import Environment, Strap
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.linear_simulation import linear_signals
from armperturb.envs.lab.simulation import Simulation, silent_simulator
from armperturb.envs.lab.trial import (
    EMG,
    MARKER,
    Trial,
    held_force,
    noise_torque,
    pulse_of,
    require_integrable,
    subject_in,
)
from armperturb.perturbations import check_bandwidth
from armperturb.recording import make_recording
from armperturb.subject import Subject
from armperturb.validation import require_number

T = TypeVar("T")

CHUNK = 100
"""Samples of the recording between two runs of the anti-alias filter: what is kept at the simulation's rate."""

MAX_DURATION = 3600.0
"""Longest trial [s]: anything longer is a slip in a file, and would not fit into memory."""


def run_experiment(
    trials: Sequence[Trial],
    environment: Environment | None = None,
    *,
    timestep: float = 1e-3,
    rate: float = 200.0,
    rope: str = "ideal",
    strap: Strap | None = None,
    linear: bool = False,
    instruments: Instruments | None = None,
    n_threads: int = 0,
    progress: Callable[[float], object] | None = None,
) -> xr.Dataset:
    """Run trials side by side and return what was recorded.

    All trials last as long as the longest; a perturbation is zero after its end. A trial whose handle reaches the
    workspace limit goes on like the others, and its `limit_time` tells when: its signals mean nothing from then on.
    Whatever is random in a trial comes from its own seed, and a trial is the same to the last bit alone and beside any
    others, at any number of threads.

    Args:
      trials: who is perturbed by what.
      environment: what the hand holds; by default the thesis's manipulator.
      timestep: of the simulation [s].
      rate: of the recording [Hz]; a whole number of simulation steps must fit into a sample.
      rope: "ideal" or "pendulum", see `build_model`.
      strap: what lets everyone's shoulder move; None holds it in place.
      linear: whether the arm is the linear one of `analysis.arm_model`, at its posture wherever it moves and without
        its muscle law, instead of MuJoCo's; for judging an analysis whose model it is. Its rope is ideal, and its
        shoulder fixed.
      instruments: what the signals pass on their way into the recording; None records the truth.
      n_threads: 0 takes all cores; the recording does not depend on it.
      progress: called with the simulated seconds (all trials together) since the last call.

    Returns:
      A recording (see `armperturb.recording`) with signals `perturbation`, `force`, `displacement`, `joint_angle`, and
      `shoulder_marker` and `emg` if the instruments have them. Joint angles are true, but as late as the others; the
      truth about a shoulder that a strap lets move is `shoulder_marker` without instruments.

    Raises:
      TypeError: strap is something else.
      ValueError: no trials, a subject that is unstable on the environment or too fast for the step, a perturbation with
        content above 45 % of the simulation rate, too short or too long, or rates that do not fit.
      RuntimeError: MuJoCo could not integrate a trial that stayed inside the workspace.
    """
    if not trials:
        raise ValueError("trials is empty; expected at least one trial")
    environment = environment or Environment()
    require_number("run_experiment", "timestep", timestep, above=0.0)
    require_number("run_experiment", "rate", rate, above=0.0)
    decimation = round(1.0 / (rate * timestep))
    if decimation < 1 or abs(decimation * rate * timestep - 1.0) > 1e-9:
        raise ValueError(
            f"run_experiment: rate = {rate!r} Hz; expected the simulation's {1 / timestep:g} Hz over a whole number"
        )
    if linear and rope != "ideal":
        raise ValueError(f"run_experiment: rope = {rope!r}; expected 'ideal', the only one that the linear arm has")
    if strap is not None and not isinstance(strap, Strap):
        raise TypeError(f"run_experiment: strap = {strap!r}; expected Strap or None")
    if linear and strap is not None:
        raise ValueError(f"run_experiment: strap = {strap!r}; expected None, as the linear arm's shoulder is fixed")
    lowpass = instruments.lowpass(timestep, rate) if instruments else None
    for subject in dict.fromkeys(trial.subject for trial in trials):
        require_stable(subject, environment, strap)
    for perturbation in {id(trial.perturbation): trial.perturbation for trial in trials}.values():
        check_bandwidth(perturbation, 1.0 / timestep)
        name = f"duration of a {type(perturbation).__name__}"
        require_number("run_experiment", name, perturbation.duration, at_least=2.0 / rate, at_most=MAX_DURATION)

    n_threads = n_threads or os.cpu_count() or 1
    subjects = [subject_in(trial, environment, strap) for trial in trials]
    for subject in dict.fromkeys(subjects):  # as varied: the person on average may be slow enough where this is not
        require_integrable(subject, environment, strap, timestep)
    emg = instruments.emg if instruments else None
    if linear:
        truth = _simulate_linear(trials, subjects, environment, timestep, decimation, lowpass, n_threads, progress)
    else:
        truth = _simulate(
            trials,
            subjects,
            environment,
            timestep,
            decimation,
            rope,
            strap,
            lowpass,
            emg is not None,
            n_threads,
            progress,
        )
    excitation = truth.pop("excitation")
    limit_time = truth.pop("limit_time")
    signals: dict[str, NDArray] = dict(truth)
    clock: dict[str, float] = {}
    if instruments is not None:
        signals["displacement"] = instruments.read_displacement(signals["displacement"])
        for trial, force in zip(trials, signals["force"], strict=True):
            force[:] = instruments.read_force(force, np.random.default_rng(trial.seed))
        if instruments.marker_noise is not None:
            # Where the belt holds the shoulder, what the movies show is the camera's noise.
            shoulder = signals.get("shoulder_marker", np.zeros_like(signals["displacement"]))
            signals["shoulder_marker"] = np.stack(
                [
                    instruments.read_marker(position, trial.generator(MARKER))
                    for position, trial in zip(shoulder, trials, strict=True)
                ]
            )
        else:
            signals.pop("shoulder_marker", None)
    if emg is not None:
        clock = {"emg_rate": emg.rate, "adc_step": emg.adc_step}
        readings = _in_threads(
            lambda i: emg.read(subjects[i], excitation[i], rate, trials[i].generator(EMG)),
            range(len(trials)),
            n_threads,
        )
        first = next(readings)
        signals["emg"] = np.empty((len(trials), *first.shape), dtype=first.dtype)
        signals["emg"][0] = first
        for i, reading in enumerate(readings, start=1):
            signals["emg"][i] = reading
    return make_recording(signals, {**_labels(trials), "limit_time": limit_time}, rate, **clock)


def _in_threads(function: Callable[[int], T], indices: Sequence[int], n_threads: int) -> Iterator[T]:
    """Results in order, of calls that spend their time in NumPy and SciPy."""
    with ThreadPoolExecutor(n_threads) as pool:
        yield from pool.map(function, indices)


def _labels(trials: Sequence[Trial]) -> dict[str, list]:
    pulses = [pulse_of(trial.perturbation) for trial in trials]
    return {
        "subject": [trial.subject.name for trial in trials],
        "task": [trial.subject.task for trial in trials],
        "condition": [trial.condition or trial.subject.task for trial in trials],
        "repetition": [trial.repetition for trial in trials],
        "order": [trial.order for trial in trials],
        "pulse_level": [trial.pulse_level for trial in trials],
        "pulse_direction": [pulse.direction_deg if pulse else np.nan for pulse in pulses],
        "pulse_onset": [pulse.onset if pulse else np.nan for pulse in pulses],
        **{name: [getattr(t.subject, name) for t in trials] for name in ("l_h", "l_f", "theta_s_deg", "theta_e_deg")},
    }


def _simulate_linear(
    trials: Sequence[Trial],
    subjects: Sequence[Subject],
    environment: Environment,
    timestep: float,
    decimation: int,
    lowpass: Array | None,
    n_threads: int,
    progress: Callable[[float], object] | None,
) -> dict[str, Array]:
    """The same as `_simulate` gives, of linear arms."""
    n_samples = max(round(trial.perturbation.duration / (timestep * decimation)) for trial in trials)
    n_steps = n_samples * decimation

    def run(i: int) -> tuple[Array, Array, float]:
        force = trials[i].perturbation.sample(1.0 / timestep, n_steps, 0.0)
        torque = noise_torque(trials[i], timestep, n_steps)
        signals = linear_signals(subjects[i], environment, force, torque, timestep)
        reached = np.flatnonzero(np.abs(signals[::decimation, :2]).max(axis=1) >= environment.workspace)
        # The spindles see what no instrument does.
        matrices = [subjects[i].joint_matrix(quantity) for quantity in ("kv", "kp")]
        stretch = signals[:, 2:4]
        excitation = np.gradient(stretch, timestep, axis=0) @ matrices[0] + stretch @ matrices[1]
        every = np.concatenate([force, signals], axis=1)
        if lowpass is not None:
            every = signal.sosfilt(lowpass, every, axis=0)
        if progress is not None:
            progress(n_steps * timestep)
        limit = reached[0] * decimation * timestep if len(reached) else np.nan
        return every[::decimation], excitation[::decimation], limit

    every, excitation, limit_time = zip(*_in_threads(run, range(len(trials)), n_threads), strict=True)
    stacked = np.stack(every)
    return {
        "perturbation": stacked[..., 0:2],
        "displacement": stacked[..., 2:4],
        "joint_angle": stacked[..., 4:6] + np.array([subject.posture for subject in subjects])[:, None],
        "force": stacked[..., 6:8],
        "limit_time": np.array(limit_time),
        "excitation": np.stack(excitation),
    }


def _simulate(
    trials: Sequence[Trial],
    subjects: Sequence[Subject],
    environment: Environment,
    timestep: float,
    decimation: int,
    rope: str,
    strap: Strap | None,
    lowpass: Array | None,
    log_excitation: bool,
    n_threads: int,
    progress: Callable[[float], object] | None,
) -> dict[str, Array]:
    """Signals at every `decimation`-th step, (trial, time, axis), and the first instant at a limit, (trial,).

    With a low-pass (second-order sections at the simulation's rate) all signals have passed it, but not `excitation`,
    which no instrument sees.
    """
    n_trials = len(trials)
    n_samples = max(round(trial.perturbation.duration / (timestep * decimation)) for trial in trials)
    n_steps = n_samples * decimation
    held = trials_adjacent(np.empty((n_steps, n_trials, 2)), 1)
    recorded = np.empty((n_trials, n_samples, 2))
    noisy = any(trial.noise is not None for trial in trials)
    torque = trials_adjacent(np.zeros((n_steps, n_trials, 2)), 1) if noisy else None

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

    list(_in_threads(prepare, range(n_trials), n_threads))

    simulation = Simulation(subjects, environment, timestep=timestep, rope=rope, strap=strap, n_threads=n_threads)
    control = ArmControl(subjects, timestep)
    angle, velocity, handle, shoulder = (
        simulation.angle,
        simulation.velocity,
        simulation.handle,
        simulation.shoulder,
    )
    # Handle, joint angles, force, shoulder. A filter starts at rest and gets angles as deviations from the posture.
    width = 6 + shoulder.shape[1]
    log = np.empty((n_samples, n_trials, width))
    posture = np.array([subject.posture for subject in subjects])
    chunk = np.empty((CHUNK * decimation if lowpass is not None else 0, n_trials, width))
    state = None if lowpass is None else np.zeros((len(lowpass), 2, n_trials, width))
    excitation_log = np.empty((n_samples if log_excitation else 0, n_trials, 2))
    limit_time = np.full(n_trials, np.nan)
    with silent_simulator():
        for step in range(n_steps):
            applied, delayed = control.torque(angle, velocity, 0.0 if torque is None else torque[step])
            sample, rest = divmod(step, decimation)
            if not rest:
                reached = np.abs(handle).max(axis=1) >= environment.workspace
                if reached.any():
                    limit_time[reached & np.isnan(limit_time)] = step * timestep
                if log_excitation:
                    excitation_log[sample] = control.excitation
            row = None
            if lowpass is not None:
                row = chunk[step % len(chunk)]
                row[:, 0:2] = handle
                np.subtract(angle, posture, out=row[:, 2:4])
            elif not rest:
                row = log[sample]
                row[:, 0:2], row[:, 2:4] = handle, angle
            if row is not None:
                row[:, 6:] = shoulder
            simulation.step(held[step], applied, delayed)
            # The sensors describe the state before the step, at which the other signals were taken.
            if row is not None:
                row[:, 4:6] = simulation.force
            if lowpass is not None and ((step + 1) % len(chunk) == 0 or step + 1 == n_steps):
                n_rows = step % len(chunk) + 1
                filtered, state = signal.sosfilt(lowpass, chunk[:n_rows], axis=0, zi=state)
                log[sample + 1 - n_rows // decimation : sample + 1] = filtered[::decimation]
            if not rest and progress is not None:
                progress(n_trials * decimation * timestep)
    # MuJoCo resets a state that it cannot integrate; beyond the workspace limit nothing counts any more.
    diverged = np.flatnonzero(simulation.diverged & np.isnan(limit_time))
    if len(diverged):
        name = trials[diverged[0]].subject.name
        raise RuntimeError(
            f"trial {diverged[0]} of subject {name!r} could not be integrated; expected finite motion (a weaker "
            "perturbation or a smaller step)"
        )
    if lowpass is not None:
        log[:, :, 2:4] += posture

    def trial_first(values: Array) -> Array:
        return np.ascontiguousarray(values.swapaxes(0, 1))

    truth = {
        "perturbation": recorded,
        "force": trial_first(log[:, :, 4:6]),
        "displacement": trial_first(log[:, :, 0:2]),
        "joint_angle": trial_first(log[:, :, 2:4]),
        "limit_time": limit_time,
        "excitation": trial_first(excitation_log),
    }
    if shoulder.shape[1]:
        truth["shoulder_marker"] = trial_first(log[:, :, 6:8])
    return truth
