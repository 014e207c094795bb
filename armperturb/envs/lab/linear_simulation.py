"""The linear arm of the analysis as the one that is perturbed: an estimator is judged where its model is exactly right.

The response is exact for forces and torques without content above half the simulation's rate: frequency responses with
pure delays, over a time long enough for everything to die away.
"""

import numpy as np
from scipy import fft

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.arm.linear_arm import arm_admittance, environment_admittance, joint_impedance
from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.arrays import Array
from armperturb.environment import Environment
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
    own = np.zeros_like(drive)
    if torque is not None:
        own = np.einsum("fij,fj->fi", compliance, fft.rfft(torque, n_padded, axis=0))
    moved = own @ jacobian.T
    hand = np.linalg.solve(arm + held, (drive - moved)[..., None])[..., 0]
    handle = np.einsum("fij,fj->fi", arm, hand) + moved
    joints = np.einsum("fij,fj->fi", compliance @ jacobian.T, hand) + own
    signals = np.concatenate([handle, joints, hand], axis=1)
    return np.asarray(fft.irfft(signals, n_padded, axis=0)[: len(force)])
