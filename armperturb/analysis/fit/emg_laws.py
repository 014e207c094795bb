"""What the EMG of a muscle may follow: the reflex torque of the joints that it crosses, or its stretch.

Reflexes of an arm are those of three groups of muscles, of shoulder, elbow and both, each of which answers to its own
stretch: with K = Ka s^2 + Kv s + Kp, the shoulder's see (K_s - K_se) q_s, the elbow's (K_e - K_se) q_e, and those of
both joints K_se (q_s + q_e). The torque of a joint is the sum of two of these. Nobody knows of a person whether EMG
shows the stretch of the muscle alone, or what the joint as a whole does, as where synergists share their reflexes, so
that the trials choose: see `maximum_likelihood.estimate`.
"""

from dataclasses import dataclass

import numpy as np

from armperturb.arrays import Array

_U = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 1, 0], [0, 0, 1]]], dtype=float)
_STRETCH = np.array([[[1, -1, 0], [0, 0, 0]], [[0, 0, 0], [0, -1, 1]], [[0, 1, 0], [0, 1, 0]]], dtype=float)
_OF_STRETCH = np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]])


@dataclass(frozen=True, kw_only=True, eq=False)
class Law:
    """What amplitudes are sums of, times gains.

    Attributes:
      text: what EMG follows, in words.
      feedback: by which each component answers to rotations, as weights of the entries s, se and e of a matrix of
        feedback, (component, joint, entry).
      delays: share of each joint's delay in that of a component, (component, joint).
      gains: joints of a muscle group to the names of its gains, and the component that each is of.
    """

    text: str
    feedback: Array
    delays: Array
    gains: dict[str, dict[str, int]]


TORQUE = Law(
    text="the reflex torque of the joints that a muscle crosses",
    feedback=_U,
    delays=np.eye(2),
    gains={"s": {"g_s": 0}, "e": {"g_e": 1}, "se": {"g_bs": 0, "g_be": 1}},
)

STRETCH = Law(
    text="the stretch of each muscle alone",
    feedback=_STRETCH,
    delays=_OF_STRETCH,
    gains={"s": {"g_s": 0}, "e": {"g_e": 1}, "se": {"g_b": 2}},
)

MIXED = Law(
    text="the stretch of each muscle and, by a share of its own, that of others that cross its joints",
    feedback=_STRETCH,
    delays=_OF_STRETCH,
    gains={"s": {"g_s": 0, "g_sb": 2}, "e": {"g_e": 1, "g_eb": 2}, "se": {"g_bs": 0, "g_be": 1, "g_b": 2}},
)
"""Of equal delays it contains both others."""
