"""What one perturbation tells: a multisine of given powers, or a proposed record just as it is."""

import warnings
from collections.abc import Callable, Mapping
from typing import NamedTuple, get_args

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.likelihood import MEMORY, judged_part
from armperturb.analysis.force_balance import EDGE
from armperturb.arrays import Array
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import TIMESTEP
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.extras import naming_the_extra
from armperturb.perturbations import Sampled
from armperturb.perturbations.multisine import DESIGN_RATE
from armperturb.seeds import trial_seed
from armperturb.study.planning.information import Experiment, Noise, effective_duration
from armperturb.study.planning.settings import DesignSettings, NoiseLaw, noise_levels

MOST_SIMULATED = 8
"""Trials from which it is judged, at most, whether `identify` accepts recordings of a proposed perturbation."""

LOWEST = 1e-6
"""Frequency that stands for zero [Hz], where a manipulator without stiffness has no admittance."""


class Signal(NamedTuple):
    """What a perturbation will tell.

    Attributes:
      frequency: of its lines [Hz], (line,).
      power: mean square force [N^2], (line, axis).
      standard_error: law of the noise to the least standard error of each free parameter, from all trials, SI,
        (parameter,).
      force: RMS [N], (axis,).
      displacement: RMS displacement of the handle that it causes, that of a multisine on average over phases [m],
        (axis,).
      duration: of a trial [s].
      refusal: why `identify` refuses recordings of it; empty if it does not.
    """

    frequency: Array
    power: Array
    standard_error: Mapping[NoiseLaw, Array]
    force: Array
    displacement: Array
    duration: float
    refusal: str = ""


def experiment_at(settings: DesignSettings, frequency: Array) -> Experiment:
    """The planned experiment with lines at these frequencies [Hz], (frequency,)."""
    human, instruments = HUMAN_NOISE[settings.subject.task], Instruments()
    floor, louder = (human.torque_spectrum([rms, rms], TIMESTEP, frequency)[:, 0] for rms in (0.0, 1.0))
    noise = Noise(floor, louder - floor, noise_levels(instruments), DESIGN_RATE)
    return Experiment(settings.subject, settings.structure(), settings.environment, frequency, noise)


def multisine_signal(of: Experiment, power: Array, usual_demand: Array, settings: DesignSettings) -> Signal:
    """What a multisine tells, on average over its phases.

    Args:
      of: the experiment at its lines.
      power: of the lines [N^2], (frequency, axis).
      usual_demand: with which the thesis's multisine loads each joint [Nm^2], (joint,).
      settings: duration and number of trials.

    Raises:
      ValueError: it tells nothing about some of the model's parameters; the message names them.
    """

    def error(demand: Array) -> Array:
        return of.standard_error(of.information(power, demand), settings.duration, settings.trials)

    errors = _by_law(error, of.demand(power), usual_demand)
    force, displacement = np.sqrt(power.sum(axis=0)), np.sqrt(of.displacement(power))
    return Signal(of.frequency, power, errors, force, displacement, settings.duration)


def _by_law(error: Callable[[Array], Array], demand: Array, usual_demand: Array) -> dict[NoiseLaw, Array]:
    demands: dict[NoiseLaw, Array] = {"held": np.maximum(demand, usual_demand), "follows": demand}
    return {law: error(demands[law]) for law in get_args(NoiseLaw)}


def proposed_signal(settings: DesignSettings, usual_demand: Array) -> Signal:
    """What the proposed perturbation tells: of an arm at rest before it, from the record up to its end.

    The record counts as in the likelihood of whole records, which fades out and uses the band that is excited.

    Args:
      settings: with a proposed perturbation; each trial plays it for as long as it lasts.
      usual_demand: with which the thesis's multisine loads each joint [Nm^2], (joint,).

    Raises:
      ValueError: it tells nothing about some of the model's parameters; the message names them.
      MissingExtraError: the simulator is not installed.
    """
    assert settings.perturbation is not None
    duration = settings.perturbation.duration
    force = settings.perturbation.sample(DESIGN_RATE, round(duration * DESIGN_RATE))
    top, refusal = _identified_up_to(settings, force)

    # Padded by so much that the answer has died away before it comes round.
    n_padded = next_fast_len(len(force) + round(MEMORY[1] * DESIGN_RATE), real=True)
    of = experiment_at(settings, np.maximum(rfftfreq(n_padded, 1.0 / DESIGN_RATE), LOWEST))
    path, slopes = (irfft(part, n_padded, axis=0)[: len(force)] for part in of.answer(rfft(force, n_padded, axis=0)))
    n_judged = len(force) - round(EDGE * DESIGN_RATE)
    _, window = judged_part(n_judged, DESIGN_RATE, from_rest=True)
    used = (of.frequency > 0.5 / duration) & (of.frequency < top)
    seen = rfft(slopes[:n_judged] * window[:, None, None], n_padded, axis=0)[used]

    def error(demand: Array) -> Array:
        weighted = np.linalg.solve(of.noise(demand)[used], seen)
        whole = 4.0 / (DESIGN_RATE * n_padded) * np.einsum("foi,foj->ij", seen.conj(), weighted).real
        return of.standard_error(whole / effective_duration(duration), duration, settings.trials)

    try:
        errors = _by_law(error, np.mean((force @ hand_jacobian(settings.subject)) ** 2, axis=0), usual_demand)
    except ValueError as cause:
        raise ValueError(f"perturbation: {cause}") from None
    lines = 2.0 * rfft(force, axis=0) / len(force)
    frequency = rfftfreq(len(force), 1.0 / DESIGN_RATE)
    shown = (frequency > 0.0) & (frequency < DESIGN_RATE / 2.0)
    power = np.abs(lines[shown]) ** 2 / 2.0
    pushed, moved = (np.sqrt(np.mean(values**2, axis=0)) for values in (force, path))
    return Signal(frequency[shown], power, errors, pushed, moved, duration, refusal)


def _identified_up_to(settings: DesignSettings, force: Array) -> tuple[float, str]:
    """Highest frequency that `identify` uses of recordings of a force (time, axis) [Hz], or why it refuses them."""
    with naming_the_extra("design with a proposed perturbation"):
        from armperturb.envs.lab.experiment import run_experiment  # here, as other plans need no simulator

    trials = [
        Trial(
            subject=settings.subject,
            perturbation=Sampled(force=force, rate=DESIGN_RATE),
            repetition=number,
            seed=trial_seed(settings.seed, "proposed", number),
            noise=HUMAN_NOISE[settings.subject.task],
        )
        for number in range(min(settings.trials, MOST_SIMULATED))
    ]
    instruments = Instruments(marker_noise=None, emg=None)
    try:
        recording = run_experiment(trials, settings.environment, linear=True, instruments=instruments, n_threads=1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # on a coherence that is not asked for
            return Group.prepare(recording, settings.structure()).top, ""
    except ValueError as refusal:
        return DESIGN_RATE / 2.0, str(refusal)
