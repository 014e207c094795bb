"""All that muscles and reflexes add to the springs and dampers of the model, once per step, for many arms at once."""

from collections.abc import Sequence

import numpy as np

from armperturb.arrays import Array, Indices
from armperturb.controllers.layout import trials_adjacent
from armperturb.controllers.muscle import NonlinearMuscles
from armperturb.controllers.reflex import (
    MemoryReflexes,
    NonlinearSpindles,
    activate,
    initial_activation,
    reflex_gains,
    spindle_excitation,
)
from armperturb.subject import Subject

Strength = dict[str, Array]
"""How much muscle and reflex there is in some trials, (trial, 3) each.

Stiffness `k` [Nm/rad], damping `b` [Nms/rad], and feedback of velocity `kv` [Nms/rad] and of position `kp` [Nm/rad] are
the entries (s, se, e) of a joint matrix (eq. 2.9). Names ending in `_groups` have the values of the muscle groups
(single-joint shoulder, two-joint, single-joint elbow, eq. 2.10) that make these, and `short_range_groups` has their
short-range stiffness [Nm/rad].
"""


class ArmControl:
    """Reflexes, muscle law and their memory, of one arm per trial: `torque` once per step, from its start's state.

    Everything is elementwise: a trial has the same bits alone and beside others.

    Attributes:
      gains: feedback gains and activation filters as they are now.
      excitation: reflexive excitation of the joints at the last step [Nm], (trial, joint); zero before the first.
    """

    def __init__(self, subjects: Sequence[Subject], timestep: float, n_history: int = 0) -> None:
        """Begin at rest.

        Args:
          subjects: the person in each trial.
          timestep: of the simulation [s].
          n_history: steps that force feedback remembers, if more than these people need.
        """
        self.excitation = trials_adjacent(np.zeros((len(subjects), 2)), 0)
        self._timestep = timestep
        self.gains = reflex_gains(subjects, timestep)
        self._activation = initial_activation(len(subjects))
        self._spindles = NonlinearSpindles(subjects)
        self._muscles = NonlinearMuscles(subjects, timestep)
        self._memory = MemoryReflexes(subjects, timestep, n_history)

    def torque(self, angle: Array, velocity: Array, noise: Array | float = 0.0) -> tuple[Array | float, Array]:
        """What acts on the joints over a step.

        Args:
          angle: of the joints at its start [rad], (trial, joint).
          velocity: of the joints [rad/s], (trial, joint).
          noise: torque beside that of muscles and reflexes [Nm], (trial, joint), or the same for all.

        Returns:
          The torque to apply [Nm], shaped as `noise` where no subject has a muscle law, and the controls of the reflex
          motors [Nm], (trial, joint), which the model delays.
        """
        excitation = self.excitation = spindle_excitation(self.gains, angle, velocity)
        if self._spindles.needed:
            self._spindles.correct_excitation(excitation, velocity)
        applied = noise
        if self._muscles.needed:
            applied = noise - self._muscles.torque(angle, velocity)
        if self._memory.needed:
            nonlinear = self._muscles.at_start if self._muscles.needed else None
            self._memory.add_excitation(excitation, angle, velocity, nonlinear)
        active, self._activation = activate(self.gains, self._activation, excitation)
        if self._memory.needed:
            self._memory.remember(active)
        return applied, -active

    def set_strength(self, trials: Indices, strength: Strength) -> None:
        """Change muscles and reflexes of some trials; their springs and dampers are the model's, see `envs.simulation`.

        Args:
          trials: indices of those trials.
          strength: of as many.
        """
        self._muscles.set_strength(trials, strength["short_range_groups"], strength["b_groups"])
        self._spindles.set_gains(trials, strength["kv_groups"])
        self._memory.set_muscle(trials, _matrices(strength["k"]), _matrices(strength["b"]))
        self.gains.velocity[trials], self.gains.position[trials] = _matrices(strength["kv"]), _matrices(strength["kp"])

    def replace(self, trials: Indices, subjects: Sequence[Subject]) -> None:
        """Put other people, at rest, in the place of some trials.

        Args:
          trials: indices of those trials.
          subjects: as many people, with delays that are no longer than `n_history` steps.
        """
        fresh = ArmControl(subjects, self._timestep)
        self._spindles.replace(trials, fresh._spindles)
        self._muscles.replace(trials, fresh._muscles)
        self._memory.replace(trials, fresh._memory)
        self._activation[:, trials] = 0.0
        self.excitation[trials] = 0.0
        for name in ("posture", "velocity", "position"):
            getattr(self.gains, name)[trials] = getattr(fresh.gains, name)
        for name in ("numerator", "denominator"):
            getattr(self.gains, name)[:, trials] = getattr(fresh.gains, name)


def _matrices(triples: Array) -> Array:
    """Symmetric joint matrices of triples (s, se, e), (trial, joint, joint)."""
    return triples[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
