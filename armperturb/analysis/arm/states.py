"""Order of the states of arm and environment, as slices and index arrays into a state vector.

The states are q', q, x', x (two each), then three Pade states of the delay per joint, then two of activation per joint.
"""

import numpy as np

N_STATES = 18
Q_DOT, Q, X_DOT, X = slice(0, 2), slice(2, 4), slice(4, 6), slice(6, 8)

VELOCITIES, POSITIONS = [0, 1, 4, 5], [2, 3, 6, 7]
"""States of joints and handle together."""

PADE = np.array([[8, 11], [9, 12], [10, 13]])
"""Pade states, (derivative, joint)."""

ACTIVE_DOT, ACTIVE = np.array([14, 16]), np.array([15, 17])
"""Activation states, (joint,)."""

BOTH_JOINTS = np.array([0, 1])

INTEGRATORS = np.zeros((N_STATES, N_STATES))
"""The part of the system matrix that makes one state the integral of another."""

INTEGRATORS[Q, Q_DOT] = INTEGRATORS[X, X_DOT] = np.eye(2)
INTEGRATORS[PADE[0], PADE[1]] = INTEGRATORS[PADE[1], PADE[2]] = INTEGRATORS[ACTIVE, ACTIVE_DOT] = 1.0
