"""A start for a fit that needs no guess: bounded linear least squares on the joint impedance.

With H the admittance of arm and grip, G that of the grip and J the Jacobian, J^T (H - G)^-1 J is the joint impedance,
which is linear in masses, damping, stiffness and feedback gains once grip, force feedback, delay and cut-off are set. A
few delays and cut-offs are tried where they are free; grip and force feedback have their default start.
"""

import itertools

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize

from armperturb.analysis.arm.linear_arm import Delay, LinearArm
from armperturb.analysis.arm.parameters import PARAMETERS
from armperturb.analysis.fit.structures import Structure
from armperturb.arrays import Array, ComplexArray
from armperturb.subject import Subject

N_TRIED = 3
"""Delays, and cut-offs, that are tried between their bounds."""

WIDE = 4.0
"""Upper over lower bound from which on those that are tried are spread by their ratio [-]."""

_NONLINEAR = [
    PARAMETERS.index(name)
    for name in ("b_h", "k_h", "kf_s", "kf_se", "kf_e", "Td_s", "Td_e", "fact_s", "fact_e", "zeta_act")
]


def linear_start(
    frequency: ArrayLike, admittance: ArrayLike, body: Subject, structure: Structure, delay: Delay = "exact"
) -> Array:
    """Values of the free parameters near the best fit, within their bounds, SI, (parameter,).

    Args:
      frequency: [Hz], (frequency,).
      admittance: estimated H_xf [m/N], (frequency, output, input).
      body: gives task, segments and posture.
      structure: what is free.
      delay: "exact" or "pade".
    """
    starts = linear_starts(frequency, admittance, body, structure, delay)
    return min(starts, key=lambda start: start[1])[0]


def linear_starts(
    frequency: ArrayLike, admittance: ArrayLike, body: Subject, structure: Structure, delay: Delay = "exact"
) -> list[tuple[Array, float]]:
    """Such values for every delay and cut-off that is tried, and the sum of squares of the logarithmic error of each.

    Args:
      frequency: [Hz], (frequency,).
      admittance: estimated H_xf [m/N], (frequency, output, input).
      body: as `linear_start` has it.
      structure: what is free.
      delay: "exact" or "pade".
    """
    arm, measured = LinearArm(body, frequency, delay), np.asarray(admittance, dtype=complex)
    starts = []
    for guess in _guesses(structure):
        values = with_linear_part(arm, measured, body, structure, guess)
        error = np.log(measured / arm.admittance(structure.parameters(body.task, values)))
        starts.append((values, float(np.sum(np.abs(error) ** 2))))
    return starts


def _guesses(structure: Structure) -> list[Array]:
    """Starts that differ in delay and cut-off, those of both joints changing together."""
    start = np.array([structure.initial[name] for name in structure.free])
    shares = (np.arange(N_TRIED) + 0.5) / N_TRIED
    groups = []
    for quantity in ("Td", "fact"):
        columns = [index for index, name in enumerate(structure.free) if name.startswith(quantity)]
        groups.append([(columns, share) for share in shares] if columns else [([], 0.0)])
    guesses = []
    for chosen in itertools.product(*groups):
        guess = start.copy()
        for columns, share in chosen:
            for column in columns:
                lower, upper = structure.bounds[structure.free[column]]
                by_ratio = upper > WIDE * lower > 0.0
                guess[column] = lower * (upper / lower) ** share if by_ratio else lower + share * (upper - lower)
        guesses.append(guess)
    return guesses


def with_linear_part(
    arm: LinearArm, measured: ComplexArray, body: Subject, structure: Structure, guess: Array
) -> Array:
    """A guess with its linear parameters put to their bounded least squares, (parameter,), SI.

    Args:
      arm: responses at the frequencies of the admittance.
      measured: estimated H_xf [m/N], (frequency, output, input).
      body: gives the task.
      structure: what is free.
      guess: values of the free parameters, (parameter,); it is the answer where H - G has no inverse, or nothing is
        linear.
    """
    linear = np.asarray(~structure.mixing[_NONLINEAR].any(axis=0))
    if not linear.any():
        return guess
    values = np.where(linear, 0.0, guess)
    others = structure.parameters(body.task, values)
    b_h, k_h = (others[PARAMETERS.index(name)] for name in ("b_h", "k_h"))
    grip = 1.0 / (2j * np.pi * arm.frequency * b_h + k_h)
    muscle = measured - grip[:, None, None] * np.eye(2)
    try:
        impedance = arm.jacobian.T @ np.linalg.inv(muscle) @ arm.jacobian
    except np.linalg.LinAlgError:
        return guess
    rest = impedance - arm.joint_impedance(others)
    basis = arm.joint_impedance_gradient(others) @ structure.mixing[:, linear]
    # Where the grip yields more than the arm, an error of either admittance is a large one of the impedance.
    share = np.linalg.norm(muscle, axis=(1, 2)) / (np.linalg.norm(measured, axis=(1, 2)) + np.abs(grip))
    relative = share / np.linalg.norm(impedance, axis=(1, 2))
    design, target = basis * relative[:, None, None, None], rest * relative[:, None, None]
    rows = np.concatenate([design.real, design.imag]).reshape(-1, int(linear.sum()))
    scale = np.linalg.norm(rows, axis=0)
    scale[scale == 0.0] = 1.0
    orthogonal, factor = np.linalg.qr(rows / scale)
    projection = orthogonal.T @ np.concatenate([target.real, target.imag]).ravel()
    bounds = np.array([structure.bounds[name] for name in structure.free])[linear].T * scale
    solution = optimize.lsq_linear(factor, projection, bounds, method="bvls")
    values[linear] = np.clip(solution.x, *bounds) / scale
    return values
