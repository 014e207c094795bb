"""The linear arm and its slopes at one complex frequency, compiled: what a search of many thousand evaluations needs.

Equations and order of parameters are those of `linear_arm.LinearArm`, to which tests hold it within rounding.
"""

import cmath
import math

import numpy as np
from numpy.typing import NDArray

from armperturb.analysis.arm.parameters import PARAMETERS
from armperturb.arrays import Array, ComplexArray
from armperturb.jit import jit

H, LEFT, RIGHT, LOOP, MUSCLE, REFLEX = 0, 4, 8, 12, 16, 20
REFLEX_FILTER, DELAY_SLOPE, CUTOFF_SLOPE, DAMPING_SLOPE, GRIP = 24, 26, 28, 30, 32
N_PARTS = 33
"""Where the parts of an arm's response stand: matrices by rows, what belongs to a joint, and the grip."""

N_PARAMETERS = len(PARAMETERS)


@jit
def reciprocal(z: complex) -> complex:
    """1 / z with one real division, for numbers whose squares are within range."""
    return z.conjugate() * (1.0 / (z.real**2 + z.imag**2))


@jit
def put_reflexes(s: complex, values: Array, is_exact: bool, parts: ComplexArray) -> None:
    """Put what belongs to the reflexes of a joint at s into `parts`: delay and activation, and slopes of these.

    Args:
      s: [1/s].
      values: of the arm, in the order of `PARAMETERS`.
      is_exact: whether delays are exact, or third-order Pade approximations.
      parts: (N_PARTS,).
    """
    s2, zeta = s * s, values[29]
    for joint in range(2):
        delay, omega = values[20 + joint], 2 * math.pi * values[22 + joint]
        u = s * delay
        if is_exact:
            delayed = cmath.exp(-u)
            delay_slope = -s * delayed
        else:
            over = reciprocal(120 + u * (60 + u * (12 + u)))
            delayed = (120 + u * (-60 + u * (12 - u))) * over
            delay_slope = s * (-60 + u * (24 - 3 * u) - delayed * (60 + u * (24 + 3 * u))) * over
        over = reciprocal(s2 + 2 * zeta * omega * s + omega * omega)
        active = omega * omega * over
        parts[REFLEX_FILTER + joint] = delayed * active
        parts[DELAY_SLOPE + joint] = delay_slope * active
        parts[CUTOFF_SLOPE + joint] = delayed * (4 * math.pi * (omega - active * (zeta * s + omega)) * over)
        parts[DAMPING_SLOPE + joint] = delayed * (-2.0 * s * omega * active * over)


@jit
def put_response(s: complex, values: Array, jacobian: Array, inertias: Array, parts: ComplexArray) -> None:
    """Put the endpoint admittance at s into `parts`, and what its slopes are made of.

    Args:
      s: [1/s].
      values: of the arm, in the order of `PARAMETERS`.
      jacobian: from joint angles to hand position [m/rad], (axis, joint).
      inertias: joint inertia per mass of either segment [m^2], (segment, joint, joint).
      parts: (N_PARTS,), with what `put_reflexes` has put at s.
    """
    s2 = s * s
    r_s, r_e = parts[REFLEX_FILTER], parts[REFLEX_FILTER + 1]

    # (1 - R Kf)^-1
    a, b = 1 - r_s * values[17], -r_s * values[18]
    c, d = -r_e * values[18], 1 - r_e * values[19]
    over = reciprocal(a * d - b * c)
    l_ss, l_se, l_es, l_ee = d * over, -b * over, -c * over, a * over
    parts[LOOP], parts[LOOP + 1], parts[LOOP + 2], parts[LOOP + 3] = l_ss, l_se, l_es, l_ee

    # Feedback G = Ka s^2 + Kv s + Kp, and muscle W = (1 - R Kf)^-1 (B s + K + R G)
    g_s = values[14] * s2 + values[8] * s + values[11]
    g_se = values[15] * s2 + values[9] * s + values[12]
    g_e = values[16] * s2 + values[10] * s + values[13]
    v_s, v_se, v_e = values[2] * s + values[5], values[3] * s + values[6], values[4] * s + values[7]
    q_ss, q_se, q_es, q_ee = v_s + r_s * g_s, v_se + r_s * g_se, v_se + r_e * g_se, v_e + r_e * g_e
    w_ss, w_se = l_ss * q_ss + l_se * q_es, l_ss * q_se + l_se * q_ee
    w_es, w_ee = l_es * q_ss + l_ee * q_es, l_es * q_se + l_ee * q_ee
    parts[MUSCLE], parts[MUSCLE + 1], parts[MUSCLE + 2], parts[MUSCLE + 3] = w_ss, w_se, w_es, w_ee
    parts[REFLEX] = g_s + values[17] * w_ss + values[18] * w_es
    parts[REFLEX + 1] = g_se + values[17] * w_se + values[18] * w_ee
    parts[REFLEX + 2] = g_se + values[18] * w_ss + values[19] * w_es
    parts[REFLEX + 3] = g_e + values[18] * w_se + values[19] * w_ee

    # Z = I s^2 + W, and J Z^-1, Z^-1 J^T
    mass_h, mass_f = values[0], values[1]
    a = (mass_h * inertias[0, 0, 0] + mass_f * inertias[1, 0, 0] + values[26]) * s2 + w_ss
    b = (mass_h * inertias[0, 0, 1] + mass_f * inertias[1, 0, 1] + values[27]) * s2 + w_se
    c = (mass_h * inertias[0, 1, 0] + mass_f * inertias[1, 1, 0] + values[27]) * s2 + w_es
    d = (mass_h * inertias[0, 1, 1] + mass_f * inertias[1, 1, 1] + values[28]) * s2 + w_ee
    over = reciprocal(a * d - b * c)
    a, b, c, d = d * over, -b * over, -c * over, a * over
    for axis in range(2):
        j_s, j_e = jacobian[axis, 0], jacobian[axis, 1]
        parts[LEFT + 2 * axis] = j_s * a + j_e * c
        parts[LEFT + 2 * axis + 1] = j_s * b + j_e * d
        parts[RIGHT + axis] = a * j_s + b * j_e
        parts[RIGHT + 2 + axis] = c * j_s + d * j_e
    grip = 1.0 / (values[24] * s + values[25])  # zero where the grip is rigid
    parts[GRIP] = grip
    for axis in range(2):
        for pushed in range(2):
            parts[H + 2 * axis + pushed] = (
                parts[LEFT + 2 * axis] * jacobian[pushed, 0] + parts[LEFT + 2 * axis + 1] * jacobian[pushed, 1]
            )
        parts[H + 3 * axis] += grip


@jit
def put_slopes(
    s: complex, inertias: Array, parts: ComplexArray, weight: ComplexArray, wanted: NDArray[np.bool_], slope: Array
) -> None:
    """Put the real part of weight x derivative of the admittance by the wanted parameters.

    Args:
      s: [1/s].
      inertias: as `put_response` has them.
      parts: what it has put.
      weight: of each element of the admittance, by rows, (4,).
      wanted: whether each parameter's slope is wanted, (parameter,); those of a group come together.
      slope: (4, parameter); what is not wanted keeps its value.
    """
    s2 = s * s
    for out in range(2):
        x_s, x_e = -parts[LEFT + 2 * out], -parts[LEFT + 2 * out + 1]
        y_s = x_s * parts[LOOP] + x_e * parts[LOOP + 2]
        y_e = x_s * parts[LOOP + 1] + x_e * parts[LOOP + 3]
        u_s, u_e = y_s * parts[REFLEX_FILTER], y_e * parts[REFLEX_FILTER + 1]
        for pushed in range(2):
            element = 2 * out + pushed
            r_s, r_e = parts[RIGHT + pushed] * weight[element], parts[RIGHT + 2 + pushed] * weight[element]
            row = slope[element]
            if wanted[0] or wanted[1]:
                for n in range(2):
                    by_s = inertias[n, 0, 0] * r_s + inertias[n, 0, 1] * r_e
                    by_e = inertias[n, 1, 0] * r_s + inertias[n, 1, 1] * r_e
                    row[n] = (s2 * (x_s * by_s + x_e * by_e)).real
            if wanted[26] or wanted[27] or wanted[28]:
                row[26], row[27], row[28] = (
                    (s2 * x_s * r_s).real,
                    (s2 * (x_s * r_e + x_e * r_s)).real,
                    (s2 * x_e * r_e).real,
                )
            t_s, t_se, t_e = y_s * r_s, y_s * r_e + y_e * r_s, y_e * r_e
            row[2], row[3], row[4] = (s * t_s).real, (s * t_se).real, (s * t_e).real
            row[5], row[6], row[7] = t_s.real, t_se.real, t_e.real
            t_s, t_se, t_e = u_s * r_s, u_s * r_e + u_e * r_s, u_e * r_e
            row[8], row[9], row[10] = (s * t_s).real, (s * t_se).real, (s * t_e).real
            row[11], row[12], row[13] = t_s.real, t_se.real, t_e.real
            if wanted[14] or wanted[15] or wanted[16]:
                row[14], row[15], row[16] = (s2 * t_s).real, (s2 * t_se).real, (s2 * t_e).real
            if wanted[17] or wanted[18] or wanted[19]:
                q_s = parts[MUSCLE] * r_s + parts[MUSCLE + 1] * r_e
                q_e = parts[MUSCLE + 2] * r_s + parts[MUSCLE + 3] * r_e
                row[17], row[18], row[19] = (u_s * q_s).real, (u_s * q_e + u_e * q_s).real, (u_e * q_e).real
            f_s = y_s * (parts[REFLEX] * r_s + parts[REFLEX + 1] * r_e)
            f_e = y_e * (parts[REFLEX + 2] * r_s + parts[REFLEX + 3] * r_e)
            row[20], row[21] = (f_s * parts[DELAY_SLOPE]).real, (f_e * parts[DELAY_SLOPE + 1]).real
            row[22], row[23] = (f_s * parts[CUTOFF_SLOPE]).real, (f_e * parts[CUTOFF_SLOPE + 1]).real
            row[29] = (f_s * parts[DAMPING_SLOPE] + f_e * parts[DAMPING_SLOPE + 1]).real
            softer = -parts[GRIP] * parts[GRIP] * weight[element] if out == pushed else 0j
            row[24], row[25] = (s * softer).real, softer.real
