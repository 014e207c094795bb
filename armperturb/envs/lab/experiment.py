"""The batched experiment: many trials side by side, each a person under a perturbation, as instruments read them."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from armperturb.analysis.arm.state_space import require_stable
from armperturb.arrays import Array
from armperturb.environment import TIMESTEP, Environment, Strap
from armperturb.envs.lab.emg import HIGHPASS_ORDER, Emg, effort_excitation
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.linear_trials import simulate_linear_arms
from armperturb.envs.lab.multibody_trials import REFINEMENTS, simulate_multibody
from armperturb.envs.lab.setup import Progress, Setup, Truth, in_threads
from armperturb.envs.lab.trial import (
    EMG,
    MARKER,
    Trial,
    noise_torque,
    pulse_of,
    require_integrable,
    subject_in,
)
from armperturb.perturbations import Perturbation, check_bandwidth
from armperturb.perturbations.perturbation import MAX_DURATION
from armperturb.recording import MUSCLES, HighPass, make_recording
from armperturb.subject import Subject
from armperturb.validation import as_list_of, require_number, require_whole


def run_experiment(
    trials: Iterable[Trial],
    environment: Environment | None = None,
    *,
    timestep: float = TIMESTEP,
    rate: float = 200.0,
    rope: str = "ideal",
    strap: Strap | None = None,
    engine: str = "mujoco",
    linear: bool = False,
    instruments: Instruments | None = None,
    n_threads: int = 0,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Run trials side by side and return what was recorded.

    All trials last as long as the longest; a perturbation is zero after its end. A trial whose handle reaches the
    workspace limit continues, and its `limit_time` says when it did: its signals are meaningless from then on.
    Whatever is random in a trial comes from its own seed, and a trial is the same to the last bit alone and beside any
    others, at any number of threads.

    Args:
      trials: people, each with a perturbation.
      environment: what the hand holds; by default the thesis's manipulator.
      timestep: of the simulation [s].
      rate: of the recording [Hz]; a whole number of simulation steps must fit into a sample.
      rope: "ideal" or "pendulum", see `build_model`.
      strap: what lets everyone's shoulder move; None holds it in place.
      engine: "mujoco", or "compiled": the same arm and laws by equations of motion that are compiled, within 2e-4 of
        MuJoCo's movements at the same step and some ten times as fast, with an ideal rope and without a strap.
      linear: whether the arm is the linear one of `analysis.arm`, at its posture wherever it moves and without its
        muscle law, instead of MuJoCo's; for judging an analysis whose model it is. Its rope is ideal, and its shoulder
        fixed.
      instruments: what the signals pass on their way into the recording; None records the truth.
      n_threads: 0 takes all cores; the recording does not depend on it.
      progress: called with the simulated seconds, of all trials together, since the last call.

    Returns:
      A recording (see `armperturb.recording`) with signals `perturbation`, `force`, `displacement`, `joint_angle`, and
      `shoulder_marker` and `emg` if the instruments have them. Joint angles are true, but as late as the others; the
      truth about a shoulder that a strap lets move is `shoulder_marker` without instruments.

    Raises:
      TypeError: an argument is of another type.
      ValueError: no trials, a number of threads below 0, a subject that is unstable on the environment, too fast for a
        quarter of the step or, but for the linear arm, refused by `Subject.require_simulable`, a perturbation with
        content above 45 % of the simulation rate, too short or too long, or rates that do not fit.
      RuntimeError: MuJoCo could not integrate a trial that stayed inside the workspace.
    """
    trials = as_list_of("trials", "run_experiment: a trial", trials, Trial, "Trials")
    require_whole("run_experiment", "n_threads", n_threads, at_least=0)
    setup = Setup(
        environment=Environment() if environment is None else environment,
        timestep=timestep,
        rate=rate,
        rope=rope,
        strap=strap,
        engine=engine,
        linear=linear,
        instruments=instruments,
    )
    _require_sound(trials, setup)
    n_threads = n_threads or os.cpu_count() or 1
    subjects = [subject_in(trial, setup.environment, strap) for trial in trials]
    for subject in dict.fromkeys(subjects):  # as varied: the person on average may be slow enough where this is not
        require_integrable(subject, setup.environment, strap, timestep / REFINEMENTS[-1])
    simulate = simulate_linear_arms if linear else simulate_multibody
    return recorded(trials, subjects, setup, simulate(trials, subjects, setup, n_threads, progress), n_threads)


def recorded(
    trials: Sequence[Trial], subjects: Sequence[Subject], setup: Setup, truth: Truth, n_threads: int = 0
) -> xr.Dataset:
    """What instruments make of what happened in trials.

    Args:
      trials: that were simulated.
      subjects: the person as it was in each.
      setup: of the laboratory.
      truth: what happened.
      n_threads: 0 takes all cores.
    """
    signals = {name: getattr(truth, name) for name in ("perturbation", "force", "displacement", "joint_angle")}
    clock: dict[str, Any] = {}
    if setup.instruments is not None:
        signals |= read_instruments([trial.seed for trial in trials], setup.instruments, truth)
    elif truth.shoulder is not None:
        signals["shoulder_marker"] = truth.shoulder
    if setup.emg is not None:
        clock = {
            "emg_rate": setup.emg.rate,
            "adc_step": setup.emg.adc_step,
            "emg_lead": setup.emg_lead,
            "emg_highpass": HighPass(setup.emg.highpass, HIGHPASS_ORDER),
        }
        n_threads = n_threads or os.cpu_count() or 1
        signals["emg"] = _voltages(setup.emg, trials, subjects, setup, truth.excitation, n_threads)
    return make_recording(signals, {**_labels(trials), "limit_time": truth.limit_time}, setup.rate, **clock)


def _require_sound(trials: Sequence[Trial], setup: Setup) -> None:
    """Refuse what cannot be simulated, before anything is drawn.

    Raises:
      ValueError: as `run_experiment`.
    """
    _ = setup.lowpass  # whose cut-off may be too high
    for subject in dict.fromkeys(trial.subject for trial in trials):
        if not setup.linear:
            subject.require_simulable()
        require_stable(subject, setup.environment, setup.strap)
    for perturbation in {id(trial.perturbation): trial.perturbation for trial in trials}.values():
        check_bandwidth(perturbation, 1.0 / setup.timestep)
        name = f"duration of a {type(perturbation).__name__}"
        least = 2.0 / setup.rate
        require_number("run_experiment", name, perturbation.duration, at_least=least, at_most=MAX_DURATION)


def read_instruments(seeds: Sequence[int], instruments: Instruments, truth: Truth) -> dict[str, NDArray]:
    """What encoders, strain gauge and camera make of the truth; seeds are those of the trials."""
    streams = [np.random.default_rng(seed) for seed in seeds]
    readings = {
        "displacement": instruments.read_displacement(truth.displacement),
        "force": np.stack([*map(instruments.read_force, truth.force, streams)]),
    }
    if instruments.marker_noise is not None:
        # Where the belt holds the shoulder, what the movies show is the camera's noise.
        shoulder = np.zeros_like(truth.displacement) if truth.shoulder is None else truth.shoulder
        streams = [np.random.default_rng([seed, MARKER]) for seed in seeds]
        readings["shoulder_marker"] = np.stack([*map(instruments.read_marker, shoulder, streams)])
    return readings


def _voltages(
    emg: Emg, trials: Sequence[Trial], subjects: Sequence[Subject], setup: Setup, excitation: Array, n_threads: int
) -> NDArray[np.float32]:
    """What the converter reads of the muscles [V], (trial, emg_time, muscle); never all of it twice in memory."""
    rate, n = setup.rate, excitation.shape[1]
    volts = np.empty((len(trials), emg.n_samples(n, rate), len(MUSCLES)), dtype=np.float32)

    def read(i: int) -> None:
        seen, every = excitation[i], round(1.0 / (rate * setup.timestep))
        noise = trials[i].noise
        if emg.effort and noise is not None:
            # The fast part is no torque of muscles: their activation is too slow to make it.
            slow = replace(trials[i], noise=noise.without_fast_part())
            torque = noise_torque(slow, setup.timestep, n * every)
        else:
            torque = None
        if torque is not None:
            seen = seen + emg.effort * effort_excitation(subjects[i], torque[::every], rate)
        emg.read(subjects[i], seen, rate, trials[i].generator(EMG), trials[i].contraction, volts[i])

    list(in_threads(read, len(trials), n_threads))
    return volts


def _labels(trials: Sequence[Trial]) -> dict[str, list]:
    return {
        "subject": [trial.subject.name for trial in trials],
        "task": [trial.subject.task for trial in trials],
        "condition": [trial.condition or trial.subject.task for trial in trials],
        **{name: [getattr(trial, name) for trial in trials] for name in ("repetition", "order", "pulse_level")},
        **perturbation_labels([trial.perturbation for trial in trials]),
        **{name: [getattr(t.subject, name) for t in trials] for name in ("l_h", "l_f", "theta_s_deg", "theta_e_deg")},
    }


def perturbation_labels(perturbations: Sequence[Perturbation]) -> dict[str, list[float]]:
    """Direction and onset of the pulses in perturbations, one value each; nan where there is none."""
    pulses = [*map(pulse_of, perturbations)]
    return {
        "pulse_direction": [pulse.direction_deg if pulse else np.nan for pulse in pulses],
        "pulse_onset": [pulse.onset if pulse else np.nan for pulse in pulses],
    }
