"""The rightmost pole of arm and environment without eigenvalues, compiled.

With R = diag(n_j / d_j) the delayed activation of each joint, n_j and d_j polynomials, V = diag(d) - diag(n) Kf,
P = V I s^2 + diag(d) (B s + K) + diag(n) (Ka s^2 + Kv s + Kp), the environment e = m s^2 + b s + k, and the grip
g = b_h s + k_h, joints that move freely fulfil ((e + g) P + g e V J^T J) q = 0: the poles are the roots of the
determinant, a polynomial of 18th degree (thesis appendix B, equations as in `linear_arm`). Routh's scheme tells whether
all of them lie to the left of a line, from where halving leads to the rightmost.
"""

import math

import numpy as np

from armperturb.analysis.arm.linear_arm import RIGID_GRIP
from armperturb.arrays import Array
from armperturb.jit import jit

DEGREE = 18

UNIT = 30.0
"""Complex frequency that is one in the polynomials [1/s], amid those of arms."""

HALVINGS = 5
"""Before the first attempt to find the pole from what is left of the range, and between attempts."""

MOST_HALVINGS = 56
"""After which the range is as good as a point."""

POLISHING = 12
"""Newton steps to the pole, at most."""

CONVERGED = 1e-9
"""Newton step that is as good as none [UNIT]."""

NEAR = 1e-7
"""A root this close to where halving has left the rightmost pole is that pole, relative to the range searched."""


@jit
def _add(a: Array, factor: float, out: Array) -> None:
    for i in range(a.size):
        out[i] += factor * a[i]


@jit
def _add_product(a: Array, b: Array, factor: float, out: Array) -> None:
    for i in range(a.size):
        scaled = factor * a[i]
        for j in range(b.size):
            out[i + j] += scaled * b[j]


@jit
def characteristic_polynomial(values: Array, jacobian: Array, inertias: Array, held: Array, shift: float) -> Array:
    """Coefficients of the polynomial whose roots are (pole - shift) / UNIT, constant first, (19,).

    Args:
      values: of the arm, in the order of `PARAMETERS`.
      jacobian: from joint angles to hand position [m/rad], (axis, joint).
      inertias: joint inertia per mass of either segment [m^2], (segment, joint, joint).
      held: mass, damping and stiffness of the environment [kg, Ns/m, N/m], (3,).
      shift: [1/s].
    """
    s, s2, s3 = np.zeros(2), np.zeros(3), np.zeros(4)
    s[0], s[1] = shift, UNIT
    _add_product(s, s, 1.0, s2)
    _add_product(s2, s, 1.0, s3)

    d, n = np.zeros((2, 6)), np.zeros((2, 4))
    for joint in range(2):
        delay, omega = values[20 + joint], 2 * math.pi * values[22 + joint]
        late, filtered = np.zeros(4), np.zeros(3)
        late[0] = 120.0
        _add(s2, 12 * delay**2, late)
        _add(late, 1.0, n[joint])
        for sign, of in ((1.0, late), (-1.0, n[joint])):
            _add(s, sign * 60 * delay, of)
            _add(s3, sign * delay**3, of)
        for i in range(4):
            n[joint, i] *= omega**2
        filtered[0] = omega**2
        _add(s, 2 * values[29] * omega, filtered)
        _add(s2, 1.0, filtered)
        _add_product(late, filtered, 1.0, d[joint])

    v = np.zeros((2, 2, 6))
    for row in range(2):
        _add(d[row], 1.0, v[row, row])
        for column in range(2):
            _add(n[row], -values[17 + row + column], v[row, column])

    grip, environment, both, between = np.zeros(2), np.zeros(3), np.zeros(3), np.zeros(4)
    is_rigid = math.isinf(values[25])
    grip[0], environment[0] = RIGID_GRIP[1] if is_rigid else values[25], held[2]
    _add(s, RIGID_GRIP[0] if is_rigid else values[24], grip)
    _add(s, held[1], environment)
    _add(s2, held[0], environment)
    _add(environment, 1.0, both)
    _add(grip, 1.0, both)
    _add_product(grip, environment, 1.0, between)

    q = np.zeros((2, 2, 10))
    for row in range(2):
        for column in range(2):
            carried, moved, pulled = np.zeros(8), np.zeros(6), np.zeros(6)
            intrinsic, feedback = np.zeros(2), np.zeros(3)
            for k in range(2):
                inertia = values[0] * inertias[0, k, column] + values[1] * inertias[1, k, column]
                _add(v[row, k], inertia + values[26 + k + column], moved)
                _add(v[row, k], jacobian[0, k] * jacobian[0, column] + jacobian[1, k] * jacobian[1, column], pulled)
            entry = row + column
            intrinsic[0], feedback[0] = values[5 + entry], values[11 + entry]
            _add(s, values[2 + entry], intrinsic)
            _add(s, values[8 + entry], feedback)
            _add(s2, values[14 + entry], feedback)
            _add_product(moved, s2, 1.0, carried)
            _add_product(d[row], intrinsic, 1.0, carried)
            _add_product(n[row], feedback, 1.0, carried)
            _add_product(carried, both, 1.0, q[row, column])
            _add_product(pulled, between, 1.0, q[row, column])
    polynomial = np.zeros(DEGREE + 1)
    _add_product(q[0, 0], q[1, 1], 1.0, polynomial)
    _add_product(q[0, 1], q[1, 0], -1.0, polynomial)
    return polynomial


@jit
def _shifted(polynomial: Array, shift: float) -> Array:
    """The same polynomial about a point so far to the right [1/s]."""
    coefficients, share = polynomial.copy(), shift / UNIT
    for i in range(coefficients.size):
        for k in range(coefficients.size - 2, i - 1, -1):
            coefficients[k] += share * coefficients[k + 1]
    return coefficients


@jit
def all_roots_left(polynomial: Array) -> tuple[bool, float]:
    """Whether all roots have negative real parts, by Routh's scheme.

    Args:
      polynomial: coefficients, constant first, not all zero.

    Returns:
      The answer, and where it is yes the square of the frequency at which roots are nearest to the axis, if a pair is.
    """
    degree = polynomial.size - 1
    while polynomial[degree] == 0.0:
        degree -= 1
    length = polynomial.size // 2 + 1
    upper, lower = np.zeros(length + 1), np.zeros(length + 1)
    for i in range(degree + 1):
        (lower if i % 2 else upper)[i // 2] = polynomial[degree - i]
    frequency = 0.0
    for step in range(degree):
        # Signs of the first column are those of the highest coefficient; rows may be scaled by any positive number.
        if not lower[0] * upper[0] > 0.0:
            return False, 0.0
        if step == degree - 2:
            frequency = upper[1] / upper[0]
        ratio, scale = upper[0] / lower[0], 1.0 / abs(lower[0])
        for i in range(length):
            below = (upper[i + 1] - ratio * lower[i + 1]) * scale
            upper[i] = lower[i] * scale
            lower[i] = below
    return True, frequency


@jit
def _root_near(polynomial: Array, start: complex) -> complex:
    """Where Newton's iteration from a start ends; not a number if it does not."""
    root = start
    for _ in range(POLISHING):
        value, slope = 0j, 0j
        for i in range(polynomial.size - 1, -1, -1):
            slope = slope * root + value
            value = value * root + polynomial[i]
        if slope == 0:
            break
        step = value / slope
        root -= step
        if abs(step.real) + abs(step.imag) < CONVERGED:
            return root
    return complex(math.nan, 0.0)


@jit
def rightmost_pole(
    values: Array, jacobian: Array, inertias: Array, held: Array, lowest: float, highest: float
) -> complex:
    """Rightmost pole of arm and environment [1/s] if its real part lies in a range, and the end of the range otherwise.

    Args:
      values: as `characteristic_polynomial` has them, and the next three.
      jacobian: from joint angles to hand position [m/rad], (axis, joint).
      inertias: joint inertia per mass of either segment [m^2], (segment, joint, joint).
      held: mass, damping and stiffness of the environment [kg, Ns/m, N/m], (3,).
      lowest: start of the range [1/s].
      highest: end of the range [1/s].
    """
    first = characteristic_polynomial(values, jacobian, inertias, held, lowest)
    if all_roots_left(first)[0]:
        return complex(lowest, 0.0)
    is_left, frequency = all_roots_left(_shifted(first, highest - lowest))
    if not is_left:
        return complex(highest, 0.0)
    left, right = lowest, highest
    near = NEAR * (highest - lowest)
    for halving in range(1, MOST_HALVINGS + 1):
        middle = 0.5 * (left + right)
        polynomial = _shifted(first, middle - lowest)
        is_left, nearest = all_roots_left(polynomial)
        if is_left:
            right, frequency = middle, nearest
        else:
            left = middle
        if halving % HALVINGS == 0:
            # The root may be one of a pair, or real; it is the rightmost if none is to the right of it.
            for imaginary in (math.sqrt(max(frequency, 0.0)), 0.0):
                root = middle + UNIT * _root_near(polynomial, complex(0.0, imaginary))
                if left - near <= root.real <= right + near:
                    beyond = min(root.real + near, right)
                    if beyond == right or all_roots_left(_shifted(first, beyond - lowest))[0]:
                        return complex(root.real, abs(root.imag))
    return complex(right, UNIT * math.sqrt(max(frequency, 0.0)))
