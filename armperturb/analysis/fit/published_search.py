"""The thesis's search of one admittance's fit, compiled: lsqnonlin on the modulus, penalised from the first step on.

The derivatives are exact here, and parameters are normalised by their start (appendix C).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armperturb.analysis.arm.compiled_arm import N_PARAMETERS, N_PARTS, put_reflexes, put_response, put_slopes
from armperturb.analysis.arm.joint_matrices import laplace
from armperturb.analysis.arm.rightmost_pole import rightmost_pole
from armperturb.analysis.fit.admittance_problem import AdmittanceProblem
from armperturb.analysis.numerics.trust_region import (
    EVALUATIONS_REACHED,
    INSIDE,
    NO_GRADIENT,
    NOT_FINITE,
    first_radius,
    inside,
    judge,
    next_point,
)
from armperturb.arrays import Array, ComplexArray
from armperturb.jit import jit

FTOL, XTOL = 1e-5, 1e-6
"""Tolerances of appendix C."""

MOST_EVALUATIONS = 6000
"""MaxFunEvals of appendix C, which counts those for numerical derivatives: one per parameter and step."""

PENALISED = -1.5, 4.5
"""Largest real parts of poles [1/s] between which the penalty has a slope: one to 1e-9 below, cut off above."""


class Problem(NamedTuple):
    """What the search must know; parameters are those of `arm.parameters`.

    Attributes:
      s: j 2 pi frequency [1/s], (frequency,).
      measured: admittance [m/N], by rows, (frequency, 4).
      weight: of the error, (frequency, 4).
      jacobian: from joint angles to hand position [m/rad], (axis, joint).
      inertias: joint inertia per mass of either segment [m^2], (segment, joint, joint).
      held: mass, damping and stiffness of the environment [kg, Ns/m, N/m], (3,).
      constant: parameters where all free ones are zero, (parameter,).
      mixing: parameters of the arm from free ones, (parameter, free).
      scale: of the free ones, (free,).
      wanted: parameters that any free one acts through, (parameter,).
      links: which parameter each free one acts through, (link, 2).
      is_exact: whether delays are exact.
      is_penalised: whether unstable arms are penalised.
    """

    s: ComplexArray
    measured: ComplexArray
    weight: Array
    jacobian: Array
    inertias: Array
    held: Array
    constant: Array
    mixing: Array
    scale: Array
    wanted: NDArray[np.bool_]
    links: NDArray[np.intp]
    is_exact: bool
    is_penalised: bool


@jit
def penalty_and_slope(problem: Problem, values: Array, slope: Array) -> float:
    """Factor of eq. 2.21; its derivative by the arm's parameters is put into `slope`, (parameter,)."""
    for parameter in range(N_PARAMETERS):
        slope[parameter] = 0.0
    jacobian, inertias, held = problem.jacobian, problem.inertias, problem.held
    pole = rightmost_pole(values, jacobian, inertias, held, PENALISED[0], PENALISED[1])
    if pole.real <= PENALISED[0]:
        return 1.0
    excess = 10.0 ** (10.0 * (pole.real + 0.5) + 1.0)
    if pole.real >= PENALISED[1]:
        return excess + 1.0
    # A pole is where F = det(1 + e H) vanishes, so that its derivative is -(dF/dp) / (dF/ds).
    parts = np.zeros(N_PARTS, dtype=np.complex128)
    step = 1e-6 * max(abs(pole), 1.0)
    fell = 0j
    for side in (-1.0, 1.0, 0.0):
        s = pole + side * step
        put_reflexes(s, values, False, parts)
        put_response(s, values, jacobian, inertias, parts)
        impedance = (held[0] * s + held[1]) * s + held[2]
        fell += side * ((1 + impedance * parts[0]) * (1 + impedance * parts[3]) - impedance**2 * parts[1] * parts[2])
    weight = np.zeros(4, dtype=np.complex128)
    factor = -impedance * 2 * step / fell
    weight[0], weight[3] = factor * (1 + impedance * parts[3]), factor * (1 + impedance * parts[0])
    weight[1], weight[2] = -factor * impedance * parts[2], -factor * impedance * parts[1]
    slopes = np.zeros((4, N_PARAMETERS))
    put_slopes(pole, inertias, parts, weight, problem.wanted, slopes)
    steepness = excess * 10.0 * math.log(10.0)
    for parameter in range(N_PARAMETERS):
        for element in range(4):
            slope[parameter] += slopes[element, parameter]
        slope[parameter] *= steepness
    return excess + 1.0


@jit
def evaluate(problem: Problem, x: Array, gradient: Array, hessian: Array) -> float:
    """Half the sum of the squared residuals r, the moduli of the log error times the penalty.

    J^T r, (free,), and J^T J, (free, free), are put into `gradient` and `hessian`.
    """
    values = problem.constant + np.dot(problem.mixing, problem.scale * x)
    n_free, n_rows = x.size, problem.measured.size
    modulus, by_free = np.zeros(n_rows), np.zeros((n_free, n_rows))
    parts = np.zeros(N_PARTS, dtype=np.complex128)
    weight, slopes = np.zeros(4, dtype=np.complex128), np.zeros((4, N_PARAMETERS))
    factor, by_penalty = 1.0, np.zeros(N_PARAMETERS)
    if problem.is_penalised:
        factor = penalty_and_slope(problem, values, by_penalty)
    for k in range(problem.s.size):
        put_reflexes(problem.s[k], values, problem.is_exact, parts)
        put_response(problem.s[k], values, problem.jacobian, problem.inertias, parts)
        for element in range(4):
            # The logarithm of measured / modelled, and 1 / modelled, with real divisions, which are quick.
            share, modelled = problem.weight[k, element], parts[element]
            power = modelled.real**2 + modelled.imag**2
            ratio = problem.measured[k, element] * modelled.conjugate()
            by_size = share * 0.5 * math.log((ratio.real**2 + ratio.imag**2) / power**2)
            by_phase = share * math.atan2(ratio.imag, ratio.real)
            size = math.sqrt(by_size**2 + by_phase**2)
            modulus[4 * k + element] = size
            pull = -share / (size * power) if size > 0 else 0.0
            weight[element] = pull * complex(by_size, -by_phase) * modelled.conjugate()
        put_slopes(problem.s[k], problem.inertias, parts, weight, problem.wanted, slopes)
        for parameter, free in problem.links:
            share = problem.mixing[parameter, free]
            for element in range(4):
                by_free[free, 4 * k + element] += share * slopes[element, parameter]
    moved = np.dot(by_penalty, problem.mixing)
    for free in range(n_free):
        for row in range(n_rows):
            by_free[free, row] = (factor * by_free[free, row] + moved[free] * modulus[row]) * problem.scale[free]
    for row in range(n_rows):
        modulus[row] *= factor
    np.dot(by_free, modulus, gradient)
    np.dot(by_free, by_free.T, hessian)
    return 0.5 * np.dot(modulus, modulus)


@jit
def search(problem: Problem, start: Array, lower: Array, upper: Array, most: int) -> tuple[Array, int]:
    """Local minimum from one start.

    Args:
      problem: of one admittance.
      start: (free,), as the next two divided by the problem's scale; on or outside a bound it is moved just inside.
      lower: bounds, (free,).
      upper: likewise.
      most: evaluations at most.

    Returns:
      Where the search ended, (free,), and why, as a constant of `trust_region`.
    """
    x = inside(start, lower, upper, INSIDE)
    gradient, hessian = np.zeros(x.size), np.zeros((x.size, x.size))
    cost = evaluate(problem, x, gradient, hessian)
    if not (np.isfinite(cost) and np.isfinite(hessian).all()):
        return x, NOT_FINITE
    radius, damping = first_radius(x, gradient, lower, upper), 0.0
    new_gradient, new_hessian = np.zeros_like(gradient), np.zeros_like(hessian)
    for _ in range(1, most):
        if not gradient.any():
            return x, NO_GRADIENT
        point, step = next_point(x, gradient, hessian, lower, upper, radius, damping)
        new_cost = evaluate(problem, point, new_gradient, new_hessian)
        if not np.isfinite(new_hessian).all():
            new_cost = np.inf
        radius, damping, status = judge(step, cost, new_cost, FTOL, XTOL)
        if new_cost < cost:
            x, cost = point, new_cost
            gradient, new_gradient = new_gradient, gradient
            hessian, new_hessian = new_hessian, hessian
        if status:
            return x, status
    return x, EVALUATIONS_REACHED


def search_as_published(problem: AdmittanceProblem, start: Array, use_penalty: bool) -> tuple[Array, int]:
    """Search a local minimum as appendix C does.

    Args:
      problem: of one admittance.
      start: SI, (free,).
      use_penalty: whether to push the search away from instability (eq. 2.21).

    Returns:
      Where it ended, SI, (free,), and why, as a constant of `trust_region`.
    """
    scale = np.where(start != 0, np.abs(start), 1.0)
    arm, held = problem.model, problem.environment
    normalised = Problem(
        s=laplace(problem.frequency),
        measured=np.ascontiguousarray(problem.admittance.reshape(-1, 4)),
        weight=np.ascontiguousarray(problem.weight.reshape(-1, 4)),
        jacobian=arm.jacobian,
        inertias=arm.inertias,
        held=np.array([held.m_env, held.b_env, held.k_env]),
        constant=problem.constant,
        mixing=problem.mixing,
        scale=scale,
        wanted=(problem.mixing != 0.0).any(axis=1),
        links=np.argwhere(problem.mixing),
        is_exact=arm.delay == "exact",
        is_penalised=use_penalty,
    )
    lower, upper = problem.lower, problem.upper
    first = np.clip(start, lower, upper) / scale
    x, status = search(normalised, first, lower / scale, upper / scale, MOST_EVALUATIONS // (1 + start.size))
    return np.clip(x * scale, lower, upper), int(status)
