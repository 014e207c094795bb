"""Where the numbers of eight arms that are simulated side by side lie: rows of one array, (row, lane)."""

from armperturb.controllers.lanes import PARTS

(Q_S, Q_E, X, Y, W_S, W_E, V_X, V_Y) = range(8)
PUSH, TORQUE = 8, 14
(UPPER, LOWER, L_H, L_F, K_H, B_H, HAND_X, HAND_Y, INERTIA_S, INERTIA_E, COUPLING) = range(20, 31)
(K_S, K_SE, K_E, B_S, B_SE, B_E, M_ENV, B_ENV, K_ENV) = range(31, 40)
V_BEFORE, LAW = 40, 42
(STRETCH, VELOCITY, INTACT, LOSS, PERSISTENCE, STIFFNESS, DAMPING, THINNING, SHORT_RANGE, LAST, TAKEN) = range(11)
BOND, LIMIT, LIMIT_SLOPE = range(11, 11 + 3 * PARTS, PARTS)
ELEMENT = 11 + 3 * PARTS
REFLEX = LAW + 3 * ELEMENT
(KV, KP, KV_GROUP, SATURATION, DIRECTION, THRESHOLD) = range(REFLEX, REFLEX + 18, 3)
(POSTURE, EXCITATION, ACTIVE, FILTER, SLOWER) = range(REFLEX + 18, REFLEX + 28, 2)
NUMERATOR, DENOMINATOR = REFLEX + 28, REFLEX + 34
(STEPS, SHARE, LATE) = range(REFLEX + 40, REFLEX + 52, 4)
BEFORE, OLDER, NEWER, AFTER = range(REFLEX + 52, REFLEX + 68, 4)
RING = REFLEX + 68
"""Rows of a group's numbers: state, force and torque at the start, middle and end of a step (x and y, or shoulder and
elbow, of each), constants, velocities of the step before. From `LAW` on those of the muscle law, for each element
`ELEMENT` rows, which are numbered from its first. From `REFLEX` on those of the reflexes: feedback of joints and
spindles; excitation, active torque, states and coefficients of its filter; of the delayed torques in the middle and at
the end of a step how many steps ago the sample after them was sent, their share of the way to it, and the four samples
about them. From `RING` on the active torques of the last steps."""
