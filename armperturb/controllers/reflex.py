"""Reflexes: spindle feedback through activation dynamics, as torque on the joints (thesis 2.7, appendix B).

The neural delay is MuJoCo's own (DESIGN: the actuators of `rig.xml` hold it): being linear, delay and activation
commute, so the filter comes first here and the delay last there. Only elementwise arithmetic is used: it gives the
same bits for one trial as for many.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import signal

from armperturb.arrays import Array, Indices
from armperturb.controllers.layout import trials_adjacent
from armperturb.controllers.muscle import element_motion, joint_torque
from armperturb.muscle_law import MuscleLaw
from armperturb.subject import Subject


@dataclass(frozen=True, kw_only=True, eq=False)
class ReflexGains:
    """What differs between trials, as arrays; made by `reflex_gains`.

    Attributes:
      posture: angles at which the spindles are silent [rad], (trial, joint).
      velocity: Kv, (trial, joint, joint) [Nms/rad].
      position: Kp, (trial, joint, joint) [Nm/rad].
      numerator: of the activation filter, (3, trial, joint).
      denominator: of the activation filter, first coefficient one, (3, trial, joint).
    """

    posture: Array
    velocity: Array
    position: Array
    numerator: Array
    denominator: Array


def reflex_gains(subjects: Sequence[Subject], timestep: float) -> ReflexGains:
    """Feedback gains and activation filters of one subject per trial.

    The filter (eq. B.19) is discretised exactly for inputs that run straight between steps (first-order hold): its
    output at a step is then second-order accurate without the half step of delay that a held input would add.

    Args:
      subjects: the person in each trial.
      timestep: of the simulation [s].
    """
    filters: dict[tuple[float, float], tuple[Array, Array]] = {}
    numerator, denominator = trials_adjacent(np.zeros((2, 3, len(subjects), 2)), 2)
    for trial, subject in enumerate(subjects):
        for joint, cutoff in enumerate((subject.fact_s, subject.fact_e)):
            key = (cutoff, subject.zeta_act)
            if key not in filters:
                omega = 2 * np.pi * cutoff
                continuous = ([omega**2], [1.0, 2 * subject.zeta_act * omega, omega**2])
                num, den, _ = signal.cont2discrete(continuous, timestep, method="foh")
                filters[key] = np.ravel(num), np.ravel(den)
            numerator[:, trial, joint], denominator[:, trial, joint] = filters[key]
    return ReflexGains(
        posture=trials_adjacent([subject.posture for subject in subjects], 0),
        velocity=trials_adjacent([subject.joint_matrix("kv") for subject in subjects], 0),
        position=trials_adjacent([subject.joint_matrix("kp") for subject in subjects], 0),
        numerator=numerator,
        denominator=denominator,
    )


def initial_activation(n_trials: int) -> Array:
    """State of the activation filters of an arm at rest in its posture, (2, trial, joint)."""
    return trials_adjacent(np.zeros((2, n_trials, 2)), 1)


def spindle_excitation(gains: ReflexGains, angle: Array, velocity: Array) -> Array:
    """Reflexive excitation u_r of the joints [Nm], (trial, joint).

    Args:
      gains: of each trial.
      angle: of the joints [rad], (trial, joint).
      velocity: of the joints [rad/s], (trial, joint).

    Source: eq. 2.8.
    """
    stretch = angle - gains.posture
    excitation = gains.velocity[:, :, 0] * velocity[:, :1]
    excitation += gains.velocity[:, :, 1] * velocity[:, 1:]
    excitation += gains.position[:, :, 0] * stretch[:, :1]
    excitation += gains.position[:, :, 1] * stretch[:, 1:]
    return excitation


class NonlinearSpindles:
    """Spindles whose velocity response saturates or favours one direction; linear ones where a subject has none such.

    Each muscle element answers its own velocity, with the velocity feedback of its muscle group (eq. 2.10).
    """

    def __init__(self, subjects: Sequence[Subject]) -> None:
        """Begin with the subjects' own gains.

        Args:
          subjects: the person in each trial.
        """
        laws = [subject.muscle or MuscleLaw() for subject in subjects]
        self._gains = trials_adjacent([subject.muscle_groups("kv") for subject in subjects], 0)
        self._saturation = trials_adjacent([law.of_elements("spindle_saturation") for law in laws], 0)
        self._direction = trials_adjacent([law.of_elements("spindle_direction") for law in laws], 0)
        self._directed = bool(self._direction.any())
        self.needed = bool((self._saturation < np.inf).any()) or self._directed

    def correct_excitation(self, excitation: Array, velocity: Array) -> None:
        """Take from the excitation what these spindles do not answer.

        Args:
          excitation: of linear spindles [Nm], (trial, joint); changed in place.
          velocity: of the joints [rad/s], (trial, joint).
        """
        speed = element_motion(velocity)
        answered = velocity_response(speed, self._saturation, self._direction if self._directed else None)
        excitation += joint_torque(self._gains * (answered - speed))

    def set_gains(self, trials: Indices, groups: Array) -> None:
        """Change the velocity feedback of the muscle groups [Nms/rad], (trial, element), of some trials."""
        self._gains[trials] = groups

    def replace(self, trials: Indices, fresh: Self) -> None:
        """Put other people in the place of some trials.

        Args:
          trials: indices of those trials.
          fresh: as many trials.
        """
        self.needed |= fresh.needed
        self._directed |= fresh._directed
        for name in ("_gains", "_saturation", "_direction"):
            getattr(self, name)[trials] = getattr(fresh, name)


def velocity_response(velocity: Array, saturation: Array, direction: Array | None) -> Array:
    """Velocity that linear spindles would have to see to fire as these do [rad/s], same shape as the arguments.

    Args:
      velocity: of the element [rad/s].
      saturation: speed at which the response is half of the linear one [rad/s]; inf is linear.
      direction: -1 to 1; movement against its sign is answered by 1 - |direction| of the response; None is 0.
    """
    response = velocity / (1.0 + np.abs(velocity) / saturation)
    if direction is not None:
        response *= 1.0 - np.abs(direction) * (velocity * direction < 0.0)
    return response


class MemoryReflexes:
    """Acceleration and force feedback: what needs to know of past steps (the law of `analysis.arm.linear_arm`).

    Each step, `add_excitation` comes first and `remember` with that step's active torque last. The acceleration is the
    backward difference of the velocities, drawn on over the half step that it lags. The torque that acts now left the
    activation filter one neural delay ago; between steps it runs straight, as in MuJoCo's delayed motors.
    """

    def __init__(self, subjects: Sequence[Subject], timestep: float, n_history: int = 0) -> None:
        """Begin at rest.

        Args:
          subjects: the person in each trial.
          timestep: of the simulation [s]; no delay is shorter.
          n_history: steps to remember, if more than these people need.
        """
        self.needed = any(any(s.joint_triple("ka") + s.joint_triple("kf")) for s in subjects)
        self._posture = np.array([subject.posture for subject in subjects])
        self._gains = {
            quantity: np.array([subject.joint_matrix(quantity) for subject in subjects])
            for quantity in ("b", "k", "ka", "kf")
        }
        delay = np.array([[subject.Td_s, subject.Td_e] for subject in subjects]) / timestep
        self._steps = np.floor(delay).astype(int)
        self._share = delay - self._steps
        self._active = np.zeros((max(self._steps.max() + 2, n_history), len(subjects), 2))
        self._row, self._joint = np.ogrid[: len(subjects), :2]
        self._step, self._timestep = 0, timestep
        self._velocity, self._slope = np.zeros((2, len(subjects), 2))

    def add_excitation(self, excitation: Array, angle: Array, velocity: Array, nonlinear: Array | None = None) -> None:
        """Add Ka q'' + Kf tau to the reflexive excitation.

        Args:
          excitation: of the spindles [Nm], (trial, joint).
          angle: of the joints [rad], (trial, joint).
          velocity: of the joints [rad/s], (trial, joint).
          nonlinear: torque of the intrinsic muscles beside spring and damper [Nm], (trial, joint); None is none.
        """
        stretch = angle - self._posture
        slope = (velocity - self._velocity) / self._timestep
        acceleration = 1.5 * slope - 0.5 * self._slope
        self._velocity, self._slope = np.copy(velocity), slope
        newer = self._active[(self._step - self._steps) % len(self._active), self._row, self._joint]
        older = self._active[(self._step - self._steps - 1) % len(self._active), self._row, self._joint]
        muscle = (1.0 - self._share) * newer + self._share * older
        muscle += _times(self._gains["b"], velocity) + _times(self._gains["k"], stretch)
        if nonlinear is not None:
            muscle += nonlinear
        excitation += _times(self._gains["ka"], acceleration) + _times(self._gains["kf"], muscle)

    def remember(self, active: Array) -> None:
        """Keep the active torque of this step [Nm], (trial, joint), for when its delay is over."""
        self._active[self._step % len(self._active)] = active
        self._step += 1

    def set_muscle(self, trials: Indices, stiffness: Array, damping: Array) -> None:
        """Change the linear muscle of some trials [Nm/rad] and [Nms/rad], (trial, joint, joint) both."""
        self._gains["k"][trials], self._gains["b"][trials] = stiffness, damping

    def replace(self, trials: Indices, fresh: Self) -> None:
        """Put other people, at rest, in the place of some trials.

        Args:
          trials: indices of those trials.
          fresh: as many trials, which remember no more steps.
        """
        self.needed |= fresh.needed
        for name in ("_posture", "_steps", "_share", "_velocity", "_slope"):
            getattr(self, name)[trials] = getattr(fresh, name)
        for quantity, values in fresh._gains.items():
            self._gains[quantity][trials] = values
        self._active[:, trials] = 0.0


def _times(matrix: Array, vector: Array) -> Array:
    """Product per trial, (trial, joint); not @, as BLAS may add in another order."""
    return matrix[:, :, 0] * vector[:, :1] + matrix[:, :, 1] * vector[:, 1:]


def activate(gains: ReflexGains, state: Array, excitation: Array) -> tuple[Array, Array]:
    """One step of the activation filters.

    Args:
      gains: of each trial.
      state: of the filters, (2, trial, joint).
      excitation: at this step [Nm], (trial, joint).

    Returns:
      The active torque at this step [Nm], (trial, joint), and the state for the next.

    Source: eq. B.19 as a transposed direct form II filter.
    """
    (b0, b1, b2), (_, a1, a2) = gains.numerator, gains.denominator
    active = b0 * excitation + state[0]
    following = np.empty_like(state)
    following[0] = b1 * excitation - a1 * active + state[1]
    following[1] = b2 * excitation - a2 * active
    return active, following
