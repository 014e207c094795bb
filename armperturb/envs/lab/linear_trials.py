"""Trials of the analysis's own linear arm, on which an estimator is judged where its model is exactly right.

The response is exact for forces and torques without content above half the simulation's rate: frequency responses with
pure delays, over a time long enough for everything to die away.
"""

from collections.abc import Sequence

import numpy as np
from scipy import fft, signal

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.arm.linear_arm import arm_admittance, environment_admittance, joint_impedance
from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.envs.lab.setup import Progress, Setup, Truth, flushed, in_threads
from armperturb.envs.lab.trial import Trial, noise_torque
from armperturb.subject import Subject

DECAY = 12.0
"""Time constants of the slowest pole after which a response has died away [-]."""


def linear_signals(
    subject: Subject, environment: Environment, force: Array, torque: Array | None, timestep: float
) -> Array:
    """Response of arm and environment from rest.

    Args:
      subject: the arm.
      environment: what the hand holds.
      force: disturbance d [N], (step, axis).
      torque: of the person's noise at the joints [Nm], (step, joint), or None.
      timestep: of the samples [s].

    Returns:
      Handle displacement [m], joint angles from the posture [rad] and hand reaction force [N], (step, 6).

    Source: figure 2.6: x = H f + J Z^-1 torque + grip, f = d - E^-1 x.
    """
    settle = DECAY / abs(largest_real_pole(subject, environment))
    n_padded = fft.next_fast_len(len(force) + round(settle / timestep), real=True)
    # Not at zero frequency, where powers of it stand in denominators.
    frequency = np.maximum(fft.rfftfreq(n_padded, timestep), 1e-6)
    arm, held = arm_admittance(subject, frequency), environment_admittance(environment, frequency)
    compliance = np.linalg.inv(joint_impedance(subject, frequency))
    jacobian = hand_jacobian(subject)
    # f = (E + H)^-1 (E d - J Z^-1 torque), as x = H f + J Z^-1 torque = E (d - f).
    drive = np.einsum("fij,fj->fi", held, fft.rfft(force, n_padded, axis=0))
    voluntary = np.zeros_like(drive)
    if torque is not None:
        voluntary = np.einsum("fij,fj->fi", compliance, fft.rfft(torque, n_padded, axis=0))
    moved = voluntary @ jacobian.T
    hand = np.linalg.solve(arm + held, (drive - moved)[..., None])[..., 0]
    handle = np.einsum("fij,fj->fi", arm, hand) + moved
    joints = np.einsum("fij,fj->fi", compliance @ jacobian.T, hand) + voluntary
    signals = np.concatenate([handle, joints, hand], axis=1)
    return np.asarray(fft.irfft(signals, n_padded, axis=0)[: len(force)])


def simulate_linear_arms(
    trials: Sequence[Trial], subjects: Sequence[Subject], setup: Setup, n_threads: int, progress: Progress | None
) -> Truth:
    """What linear arms do; arguments as in `simulate_multibody`."""
    environment, timestep, decimation, lowpass = setup.environment, setup.timestep, setup.decimation, setup.lowpass
    n_steps = setup.n_samples([trial.perturbation for trial in trials]) * decimation

    def run(i: int) -> tuple[Array, Array, float]:
        force = trials[i].perturbation.sample(1.0 / timestep, n_steps, 0.0)
        torque = noise_torque(trials[i], timestep, n_steps)
        signals = linear_signals(subjects[i], environment, force, torque, timestep)
        reached = np.flatnonzero(np.abs(signals[::decimation, :2]).max(axis=1) >= environment.workspace)
        stretch = signals[:, 2:4]
        velocity, position = (subjects[i].joint_matrix(quantity) for quantity in ("kv", "kp"))
        excitation = np.gradient(stretch, timestep, axis=0) @ velocity + stretch @ position
        every = np.concatenate([force, signals], axis=1)
        if lowpass is not None:
            every = signal.sosfilt(lowpass, every, axis=0)
        if progress is not None:
            progress(n_steps * timestep)
        limit = reached[0] * decimation * timestep if len(reached) else np.nan
        return flushed(every[::decimation]), excitation[::decimation], limit

    every, excitation, limit_time = zip(*in_threads(run, len(trials), n_threads), strict=True)
    stacked = np.stack(every)
    return Truth(
        perturbation=stacked[..., 0:2],
        displacement=stacked[..., 2:4],
        joint_angle=stacked[..., 4:6] + np.array([subject.posture for subject in subjects])[:, None],
        force=stacked[..., 6:8],
        excitation=np.stack(excitation),
        limit_time=np.array(limit_time),
    )
