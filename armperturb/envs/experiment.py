"""The batched experiment: many trials stepped in lockstep, each a person under a perturbation."""

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import xarray as xr
from mujoco.batch import Batch
from numpy.typing import NDArray

from armperturb.analysis.arm_model import fastest_pole, require_stable
from armperturb.controllers.reflex import activate, initial_activation, reflex_gains, spindle_excitation
from armperturb.environment import Environment
from armperturb.envs.instruments import Instruments
from armperturb.models import JOINTS, REFLEXES, SLIDES, STRAIN_GAUGE, build_model, history_length
from armperturb.perturbations import Perturbation, Pulse, check_bandwidth
from armperturb.recording import make_recording
from armperturb.subject import Subject
from armperturb.validation import require_number

Array = NDArray[np.float64]

MAX_DURATION = 3600.0
"""Longest trial [s]: anything longer is a slip in a file, and would not fit into memory."""

RK4_LIMIT = 2.5
"""Largest product of a pole's modulus and the step [-]: Runge-Kutta 4 is stable up to 2.79 on the real axis."""

_DIVERGED = [int(getattr(mujoco.mjtWarning, f"mjWARN_{name}")) for name in ("BADQPOS", "BADQVEL", "BADQACC")]


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One person under one perturbation, with the labels that the recording carries.

    Attributes:
      subject: who is perturbed.
      perturbation: what is applied.
      condition: name in the protocol, e.g. "PT7.5"; the subject's task if empty.
      repetition: of the condition, from 0.
      pulse_level: multiple of the unit pulse; 0 without pulse.
      seed: of the instruments' noise.
    """

    subject: Subject
    perturbation: Perturbation
    condition: str = ""
    repetition: int = 0
    pulse_level: float = 0.0
    seed: int = 0


def run_experiment(
    trials: Sequence[Trial],
    environment: Environment | None = None,
    *,
    timestep: float = 1e-3,
    rate: float = 200.0,
    rope: str = "ideal",
    instruments: Instruments | None = None,
    n_threads: int = 0,
    progress: Callable[[float], object] | None = None,
) -> xr.Dataset:
    """Run trials side by side and return what was recorded.

    All trials last as long as the longest; a perturbation is zero after its end. A trial whose handle reaches the
    workspace limit goes on like the others, and its `limit_time` tells when: its signals mean nothing from then on.

    Args:
      trials: who is perturbed by what.
      environment: what the hand holds; by default the thesis's manipulator.
      timestep: of the simulation [s].
      rate: of the recording [Hz]; a whole number of simulation steps must fit into a sample.
      rope: "ideal" or "pendulum", see `build_model`.
      instruments: what the signals pass on their way into the recording; None records the truth.
      n_threads: 0 takes all cores; the recording does not depend on it.
      progress: called with the simulated seconds (all trials together) since the last call.

    Returns:
      A recording (see `armperturb.recording`) with signals `perturbation`, `force`, `displacement`, `joint_angle`.

    Raises:
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
    for subject in {trial.subject for trial in trials}:
        require_stable(subject, environment)
        _require_integrable(subject, environment, timestep)
    for trial in trials:
        require_number("Trial", "seed", trial.seed, at_least=0)
    for perturbation in {id(trial.perturbation): trial.perturbation for trial in trials}.values():
        check_bandwidth(perturbation, 1.0 / timestep)
        name = f"duration of a {type(perturbation).__name__}"
        require_number("run_experiment", name, perturbation.duration, at_least=2.0 / rate, at_most=MAX_DURATION)

    truth = _simulate(trials, environment, timestep, decimation, rope, n_threads, progress)
    signals = {
        "perturbation": truth["perturbation"],
        "force": truth["force"],
        "displacement": truth["displacement"],
        "joint_angle": truth["joint_angle"],
    }
    if instruments is not None:
        signals["displacement"] = instruments.read_displacement(signals["displacement"])
        signals["force"] = np.stack(
            [
                instruments.read_force(force, np.random.default_rng(trial.seed))
                for trial, force in zip(trials, signals["force"], strict=True)
            ]
        )
    return make_recording(signals, {**_labels(trials), "limit_time": truth["limit_time"]}, rate)


def _require_integrable(subject: Subject, environment: Environment, timestep: float) -> None:
    pole = fastest_pole(subject, environment)
    if pole * timestep > RK4_LIMIT:
        raise ValueError(
            f"subject {subject.name!r}: fastest pole of arm and environment = {pole:.4g} 1/s; expected at most "
            f"{RK4_LIMIT / timestep:.4g} 1/s at a step of {timestep:g} s (grip or damping too large for the masses)"
        )


@contextmanager
def _silent_simulator() -> Iterator[None]:
    """Keep MuJoCo from writing its warnings to the terminal and to MUJOCO_LOG.TXT; `Batch.warning` counts them anyway.

    The batch calls its threads' handler without Python, so it must be a C function: any that takes a text and does
    nothing with it.
    """
    library = next(Path(mujoco.__file__).parent.glob("libmujoco.*"))
    handler = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), "mju_user_warning")
    before = handler.value
    handler.value = ctypes.cast(ctypes.CDLL(None).strlen, ctypes.c_void_p).value
    try:
        yield
    finally:
        handler.value = before


def _labels(trials: Sequence[Trial]) -> dict[str, list]:
    pulses = [
        trial.perturbation if isinstance(trial.perturbation, Pulse) else getattr(trial.perturbation, "pulse", None)
        for trial in trials
    ]
    return {
        "subject": [trial.subject.name for trial in trials],
        "task": [trial.subject.task for trial in trials],
        "condition": [trial.condition or trial.subject.task for trial in trials],
        "repetition": [trial.repetition for trial in trials],
        "pulse_level": [trial.pulse_level for trial in trials],
        "pulse_direction": [pulse.direction_deg if pulse else np.nan for pulse in pulses],
        "pulse_onset": [pulse.onset if pulse else np.nan for pulse in pulses],
        **{name: [getattr(t.subject, name) for t in trials] for name in ("l_h", "l_f", "theta_s_deg", "theta_e_deg")},
    }


def _held(perturbation: Perturbation, timestep: float, n_steps: int) -> Array:
    """Force to hold over each step so that the handle feels the perturbation [N], (step, axis).

    A held force acts on average at the middle of its step, and holding weakens it by sinc(f timestep); the second
    difference restores that to fourth order.
    """
    middle = perturbation.sample(1.0 / timestep, n_steps + 2, -timestep / 2)
    return middle[1:-1] - np.diff(middle, n=2, axis=0) / 24.0


def _simulate(
    trials: Sequence[Trial],
    environment: Environment,
    timestep: float,
    decimation: int,
    rope: str,
    n_threads: int,
    progress: Callable[[float], object] | None,
) -> dict[str, Array]:
    """True signals at every `decimation`-th step, (trial, time, axis), and the first instant at a limit, (trial,)."""
    subjects = [trial.subject for trial in trials]
    n_history = max(history_length(subject, timestep) for subject in subjects)
    models = {
        subject: build_model(subject, environment, timestep=timestep, rope=rope, n_history=n_history, visual=False)
        for subject in dict.fromkeys(subjects)
    }
    model = models[subjects[0]]
    hinges = [model.joint(name).qposadr[0] for name in JOINTS]
    slides = [model.joint(name).qposadr[0] for name in SLIDES]
    motors = [model.actuator(name).id for name in REFLEXES]
    gauge = model.sensor(STRAIN_GAUGE).adr[0]
    hinge, slide, motor = (slice(ids[0], ids[-1] + 1) for ids in (hinges, slides, motors))

    n_trials = len(trials)
    n_samples = max(round(trial.perturbation.duration / (timestep * decimation)) for trial in trials)
    n_steps = n_samples * decimation
    held = np.empty((n_steps, n_trials, 2))
    recorded = np.empty((n_trials, n_samples, 2))
    for i, trial in enumerate(trials):
        held[:, i] = _held(trial.perturbation, timestep, n_steps)
        recorded[i] = trial.perturbation.sample(1.0 / (timestep * decimation), n_samples, 0.0)

    log = {name: np.empty((n_samples, n_trials, 2)) for name in ("force", "displacement", "joint_angle")}
    limit_time = np.full(n_trials, np.nan)
    gains = reflex_gains(subjects, timestep)
    activation = initial_activation(n_trials)

    batch = Batch(model, n_trials, n_threads)
    batch.set_models([models[subject] for subject in subjects])
    batch.reset()
    qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
    applied, sensors = batch.bind("qfrc_applied"), batch.bind("sensordata")
    angle, velocity, handle = qpos[:, hinge], qvel[:, hinge], qpos[:, slide]
    with _silent_simulator():
        for step in range(n_steps):
            active, activation = activate(gains, activation, spindle_excitation(gains, angle, velocity))
            np.negative(active, out=ctrl[:, motor])
            applied[:, slide] = held[step]
            sample, rest = divmod(step, decimation)
            if not rest:
                log["displacement"][sample], log["joint_angle"][sample] = handle, angle
                reached = np.abs(handle).max(axis=1) >= environment.workspace
                if reached.any():
                    limit_time[reached & np.isnan(limit_time)] = step * timestep
            batch.step()
            if not rest:
                # The sensors describe the state before the step, at which the other signals were taken.
                log["force"][sample] = sensors[:, gauge : gauge + 2]
                if progress is not None:
                    progress(n_trials * decimation * timestep)
    # MuJoCo resets a state that it cannot integrate; beyond the workspace limit nothing counts any more.
    diverged = np.flatnonzero((batch.warning[:, _DIVERGED, 1] > 0).any(axis=1) & np.isnan(limit_time))
    if len(diverged):
        name = trials[diverged[0]].subject.name
        raise RuntimeError(
            f"trial {diverged[0]} of subject {name!r} could not be integrated; expected finite motion (a weaker "
            "perturbation or a smaller step)"
        )
    return {
        "perturbation": recorded,
        **{name: np.ascontiguousarray(values.swapaxes(0, 1)) for name, values in log.items()},
        "limit_time": limit_time,
    }
