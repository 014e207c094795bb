"""The one-joint laboratory: a joint moved by a position servo, or perturbed against a virtual environment."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from armperturb.arrays import Array
from armperturb.controllers.lanes import control_columns, control_memory, history_of, table_of
from armperturb.controllers.remnant import HumanNoise
from armperturb.envs.lab.joint_stepping import ANGLE, DAMPING, GAIN, HELD, NEUTRAL, STIFFNESS, VELOCITY, advance_joint
from armperturb.envs.lab.setup import in_threads
from armperturb.envs.lab.simulation import silent_simulator
from armperturb.joint_person import JointPerson, Servo
from armperturb.models.joint_rig import JOINT_TIMESTEP, build_joint_model
from armperturb.recording import make_recording
from armperturb.validation import as_list_of, require_number, require_type

LARGEST_ANGLE = 3.0
"""Angle from the posture beyond which a simulation counts as diverged [rad]."""

STIFF, DAMPED = 0.25, 0.8
"""Natural frequency, and damping over inertia, of limb and device, over the rate of the steps up to which the recorded
damping is right to 0.5 % [-]: torques are held over a step, in which a faster device moves."""

WIDTH = 2
"""Steps on either side of the difference that gives the acceleration."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTrial:
    """One person's joint under one perturbation.

    Attributes:
      person: whose joint.
      perturbation: at the rate of the recording, (time,): angle that a position servo is commanded [rad], from the
        posture, or torque of the device besides its virtual environment [Nm].
      neutral: angle at which the intrinsic spring is at rest [rad], (time,), such as the slow part of an imposed
        movement; it is the recording's scheduling variable. None for the posture.
      stiffness: factor on the intrinsic stiffness over time [-], (time,); None for one.
      damping: likewise on the damping.
      gain: likewise on the gains of the reflex.
      noise: RMS of the torque that the person adds [Nm], >= 0, low-passed as the arm's remnant, see `HumanNoise`.
      noise_cutoff: of that low-pass [Hz], > 0.
      seed: of the noise.
      condition: label of the trial.
      repetition: of the condition.

    Raises:
      TypeError: person is no `JointPerson`, or noise or its cut-off no number.
      ValueError: a series is of the wrong length or not finite, or a number is out of its range.
    """

    person: JointPerson
    perturbation: ArrayLike
    neutral: ArrayLike | None = None
    stiffness: ArrayLike | None = None
    damping: ArrayLike | None = None
    gain: ArrayLike | None = None
    noise: float = 0.0
    noise_cutoff: float = 2.0
    seed: int = 0
    condition: str = "PT"
    repetition: int = 0

    def __post_init__(self) -> None:
        require_type("JointTrial: person", self.person, JointPerson, "a JointPerson")
        require_number("JointTrial", "noise", self.noise, at_least=0.0)
        require_number("JointTrial", "noise_cutoff", self.noise_cutoff, above=0.0)
        length = np.size(self.perturbation)
        for name in ("perturbation", "neutral", "stiffness", "damping", "gain"):
            if getattr(self, name) is None:
                continue
            values = np.asarray(getattr(self, name), dtype=float)
            if values.shape != (length,) or length < 2 or not np.isfinite(values).all():
                raise ValueError(
                    f"JointTrial: {name} has shape {values.shape}; expected finite values ({length},), as many as "
                    "perturbation has, and at least two"
                )
            object.__setattr__(self, name, values)


def run_joint_experiment(
    trials: Sequence[JointTrial],
    servo: Servo,
    *,
    rate: float = 1000.0,
    timestep: float = JOINT_TIMESTEP,
    n_threads: int = 0,
) -> xr.Dataset:
    """Simulate trials of one joint and return what was recorded.

    The device and the limb are fixed to each other; the recorded torque is that of the device on the limb. Limb and
    device are MuJoCo's; muscle law and reflexes are those of the arm (docs/muscle.md).

    Args:
      trials: of one joint, of equal length.
      servo: the device.
      rate: of perturbations and recording [Hz]; a whole number of steps must fit into a sample.
      timestep: of the simulation [s].
      n_threads: 0 takes all cores; the recording does not depend on it.

    Returns:
      A recording of one axis (see `armperturb.recording`) with `displacement` [rad] and `force` [Nm], `perturbation`
      [Nm] of a force servo, and `scheduling` [rad] where a trial has a `neutral` angle.

    Raises:
      TypeError: a trial is no `JointTrial`, or servo no `Servo`.
      ValueError: no trials, trials of several joints or lengths, a delay below two steps, rates that do not fit, or
        steps too long for the servo.
      RuntimeError: a joint diverged, as with too much feedback.
    """
    owner = "run_joint_experiment"
    trials = as_list_of(f"{owner}: trials", f"{owner}: a trial", trials, JointTrial, "a JointTrial, or several")
    require_type(f"{owner}: servo", servo, Servo, "a Servo")
    kinds = {(trial.person.joint, np.size(trial.perturbation)) for trial in trials}
    if len(kinds) > 1:
        several = " and ".join(f"{joint}, {length} samples" for joint, length in sorted(kinds))
        raise ValueError(f"trials of {several}; expected one joint and length")
    decimation = round(1.0 / (rate * timestep))
    if decimation < 1 or abs(decimation * rate * timestep - 1.0) > 1e-9:
        raise ValueError(f"rate = {rate:g} Hz; expected a whole number of steps of {timestep:g} s in a sample")
    for trial in trials:
        if trial.person.delay < 2.0 * timestep * (1.0 - 1e-12):
            raise ValueError(
                f"JointPerson: delay = {trial.person.delay:g} s; expected at least two steps of {timestep:g} s"
            )
        _require_short_steps(trial.person.inertia + servo.inertia, servo, rate, timestep)
    logs = list(
        in_threads(
            lambda i: _simulate(trials[i], servo, rate, timestep, decimation),
            len(trials),
            n_threads or os.cpu_count() or 1,
        )
    )
    signals = {"force": np.stack([force for _, force in logs]), "displacement": np.stack([angle for angle, _ in logs])}
    if servo.kind == "force":
        signals["perturbation"] = np.stack([np.asarray(trial.perturbation) for trial in trials])
    if any(trial.neutral is not None for trial in trials):
        signals["scheduling"] = np.stack([_series(trial, "neutral", 0.0) for trial in trials])
    nothing = np.full(len(trials), np.nan)
    labels: dict[str, Any] = {
        "subject": [trial.person.joint for trial in trials],
        "task": ["PT"] * len(trials),
        "condition": [trial.condition for trial in trials],
        "repetition": [trial.repetition for trial in trials],
        "order": range(len(trials)),
        "pulse_level": np.zeros(len(trials)),
        **dict.fromkeys(("pulse_direction", "pulse_onset", "limit_time"), nothing),
        **dict.fromkeys(("l_h", "l_f", "theta_s_deg", "theta_e_deg"), nothing),
    }
    return make_recording(
        {name: values[..., None] for name, values in signals.items()},
        labels,
        rate,
        servo=servo.kind,
        joint=trials[0].person.joint,
        angular=True,
    )


def _require_short_steps(inertia: float, servo: Servo, rate: float, timestep: float) -> None:
    """Refuse steps in which a device moves on the limb, both of this inertia [kg m^2]."""
    fastest = max((servo.stiffness / inertia) ** 0.5 / STIFF, servo.damping / inertia / DAMPED)
    if timestep * fastest > 1.0:
        longest = 1.0 / (rate * math.ceil(fastest / rate))
        raise ValueError(
            f"run_joint_experiment: timestep = {timestep:g} s; expected at most {longest:g} s with a servo of "
            f"{servo.stiffness:g} Nm/rad and {servo.damping:g} Nms/rad on {inertia:.3g} kg m^2: torques are held over "
            "a step"
        )


def at_signal_to_noise(
    trial: JointTrial, servo: Servo, decibel: float, *, rate: float = 1000.0, timestep: float = JOINT_TIMESTEP
) -> JointTrial:
    """The trial with as much noise of the person as leaves a ratio of powers of what is recorded.

    Args:
      trial: with any noise.
      servo: the device; the ratio is that of torques on a position servo, of angles on a force servo.
      decibel: power of the response to the perturbation over that of the noise [dB].
      rate: of the perturbation [Hz].
      timestep: of the simulation [s].
    """
    signal = "force" if servo.kind == "position" else "displacement"

    def recorded(noise: float) -> Array:
        changed = replace(trial, noise=noise)
        recording = run_joint_experiment([changed], servo, rate=rate, timestep=timestep, n_threads=1)
        return np.asarray(recording[signal].values)

    clean = recorded(0.0)
    response = float(clean.std())
    small = 1e-3 * response if servo.kind == "position" else 1e-3
    noise = float((recorded(small) - clean).std())
    return replace(trial, noise=small * response / noise * 10.0 ** (-decibel / 20.0))


def _series(trial: JointTrial, name: str, default: float) -> Array:
    """A series of a trial over time, (time,)."""
    values = getattr(trial, name)
    return np.full(np.size(trial.perturbation), default) if values is None else values


def _simulate(trial: JointTrial, servo: Servo, rate: float, timestep: float, decimation: int) -> tuple[Array, Array]:
    """Angle [rad] and torque of the device on the limb [Nm], (time,) each."""
    person = trial.person
    n_samples = np.size(trial.perturbation)
    n_steps = (n_samples - 1) * decimation + 1 + WIDTH
    samples, starts = np.arange(n_samples) / rate, np.arange(n_steps) * timestep
    middles = np.minimum(starts + 0.5 * timestep, samples[-1])
    command = CubicSpline(samples, trial.perturbation)
    drive = command(middles)
    if servo.kind == "position":
        drive = servo.stiffness * drive + servo.damping * command(middles, 1)
    course = np.empty((n_steps, 4))
    at = np.minimum(starts, samples[-1])
    for column, name, default, unit in (
        (NEUTRAL, "neutral", 0.0, 1.0),
        (STIFFNESS, "stiffness", 1.0, person.stiffness),
        (DAMPING, "damping", 1.0, person.damping),
        (GAIN, "gain", 1.0, 1.0),
    ):
        course[:, column] = unit * np.interp(at, samples, _series(trial, name, default))
    noise = np.zeros(n_steps)
    if trial.noise:
        remnant = HumanNoise(remnant_floor=trial.noise, remnant_cutoff=trial.noise_cutoff)
        noise = remnant.torque(np.zeros(2), timestep, n_steps, np.random.default_rng(trial.seed))[:, 0]
    model = build_joint_model(person, servo, timestep=timestep)
    data = mujoco.MjData(model)
    if servo.kind == "position":
        data.qpos[0], data.qvel[0] = command(0.0), command(0.0, 1)
    table = table_of(control_columns([person.subject], timestep))
    memory = control_memory(1, table["limit"].shape[2], history_of(table, timestep))
    with silent_simulator():
        log = advance_joint(model, data, table, memory, course, drive, noise)
    q, w, held = log[:, ANGLE], log[:, VELOCITY], log[:, HELD]
    if not np.abs(q).max() < LARGEST_ANGLE + np.abs(course[:, NEUTRAL]).max():  # NaN too
        raise RuntimeError(
            f"{person.joint}: the joint diverged (angle beyond {LARGEST_ANGLE:g} rad); expected less feedback "
            "(kv, kp), more damping, or a smaller perturbation"
        )
    acceleration = np.gradient(w, timestep, edge_order=2)
    # Of the angle that is recorded. Torques are held over steps, so that differences of the velocity, which has kinks,
    # would be off by a share of (omega step)^2 / 12 of the inertia, which other parameters would make up for.
    second = 16.0 * (q[3:-1] + q[1:-3]) - (q[4:] + q[:-4]) - 30.0 * q[2:-2]
    acceleration[2:-2] = second / (12.0 * timestep**2)
    # At the start of a step, halfway between two torques that are held.
    muscle = np.concatenate([held[:1], 0.5 * (held[1:] + held[:-1])])
    law = person.muscle.of_elements("short_range_stiffness")[0] if person.muscle else 0.0
    torque = person.inertia * acceleration - muscle + course[:, DAMPING] * w + law * q
    torque += course[:, STIFFNESS] * (q - course[:, NEUTRAL])
    sampled = slice(0, n_steps - WIDTH, decimation)
    return q[sampled], torque[sampled]
