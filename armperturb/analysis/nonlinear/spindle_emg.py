"""How likely EMG is under a nonlinear person, so that it tells of reflexes together with the movement.

What spindles make of the recorded rotations needs no simulation. Of each muscle group m, which stretches by p and at
the speed v (of shoulder, both joints, elbow: q_s, q_s + q_e, q_e), they see

    u_m = kv_m v / (1 + |v| / v_sat) + kp_m p,

and the difference between the amplitudes of extensors and flexors is, as in `fit.emg_likelihood`, the sum of that over
the groups of a joint, late by Td_j less the electromechanical delay, times an unknown gain of each joint that a muscle
crosses in each condition, plus noise. Windows are put on what they see, too, before it is late. Gains are fitted anew
wherever the likelihood is taken: the model is linear in them.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.interpolate import CubicSpline

from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.emg.outputs import ReflexOutputs, reflex_outputs
from armperturb.analysis.fit.emg_likelihood import EmgSpectra, GainsOfJoints
from armperturb.analysis.fit.whittle import ALL
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array, ComplexArray
from armperturb.subject import Subject

GROUPS_OF_JOINT = ((0, 1), (1, 2))
"""Muscle groups (shoulder, two-joint, elbow) that cross the shoulder and the elbow."""

VELOCITY, POSITION, SATURATION, DELAY = slice(0, 3), slice(3, 6), 6, slice(7, 9)
N_REFLEX = 9
"""What EMG depends on, see `reflex_values`."""

REFLEX = ("kv", "kp", "spindle_saturation", "Td", "level")
"""Stems of the parameters that EMG depends on."""


def reflex_values(subject: Subject) -> Array:
    """Velocity and position feedback of the groups, 1 / v_sat (0 of linear spindles), and the delays, (9,)."""
    saturation = subject.muscle.of_elements("spindle_saturation")[0] if subject.muscle else np.inf
    groups = *subject.muscle_groups("kv"), *subject.muscle_groups("kp")
    return np.array([*groups, 1.0 / saturation, subject.Td_s, subject.Td_e])


@dataclass(frozen=True, kw_only=True, eq=False)
class EmgInFit:
    """EMG of all trials of a condition.

    Attributes:
      outputs: EMG and rotation.
      delay: electromechanical, beyond the activation dynamics [s].
    """

    outputs: ReflexOutputs
    delay: float = 0.0

    def of(self, trials: ConditionTrials) -> ReflexOutputs:
        """Those of some trials of the condition."""
        return self.outputs.take(trials.numbers)


def digests(emg: Mapping[str, EmgInFit] | None) -> list[tuple[str, float, str]]:
    """What identifies the EMG of conditions; nothing without any."""
    return [
        (
            label,
            each.delay,
            hashlib.sha256(each.outputs.difference.tobytes() + each.outputs.rotation.tobytes()).hexdigest(),
        )
        for label, each in sorted((emg or {}).items())
    ]


def usable_emg(
    conditions: Mapping[str, ConditionTrials], arms: Iterable[str], envelopes: Envelopes, delay: float
) -> dict[str, EmgInFit]:
    """EMG of the conditions with reflexes.

    Args:
      conditions: all trials by condition.
      arms: conditions that are perturbed long enough before any pulse.
      envelopes: of the person.
      delay: electromechanical [s].

    Raises:
      ValueError: as `reflex_outputs`.
    """
    return {
        label: EmgInFit(outputs=reflex_outputs(conditions[label], envelopes), delay=delay)
        for label in arms
        if conditions[label].body.task == "PT"
    }


class SpindleEmg(GainsOfJoints):
    """Likelihood of the EMG of the trials of one condition.

    Values are those of `reflex_values`, followed by the gains, (trial, value).

    Args:
      outputs: EMG and rotation.
      arm: a linear arm near the person, whose grip tells how far the hand is from the handle.
      delay: electromechanical, beyond the activation dynamics [s].
    """

    def __init__(self, outputs: ReflexOutputs, arm: Subject, delay: float) -> None:
        self._spectra, self._delay = EmgSpectra.of(outputs), delay
        turned = _rotation(outputs, arm)
        groups = np.stack([turned[..., 0], turned.sum(axis=-1), turned[..., 1]], axis=-1)
        time = np.arange(groups.shape[1]) / outputs.rate
        self._speed = np.asarray(CubicSpline(time, groups, axis=1)(time, 1))
        self._stretch = self._windowed(groups)
        self._seen_at: tuple[float, ComplexArray] = np.nan, self._stretch
        super().__init__(outputs, self._spectra, self._stretch[0])
        self._best = np.zeros(len(self._gains))

    def _windowed(self, values: Array) -> ComplexArray:
        """DFT of signals (trial, time, group) with the window and with its derivative, (2, trial, group, frequency)."""
        return np.stack([self._spectra(values, order) for order in range(2)])

    def _velocity(self, saturation: float) -> ComplexArray:
        """What spindles make of the speed of the groups, as `_windowed` gives it."""
        if self._seen_at[0] != saturation:
            self._seen_at = saturation, self._windowed(self._speed / (1.0 + saturation * np.abs(self._speed)))
        return self._seen_at[1]

    def _delays(self, values: Array) -> Array:
        """From rotation to EMG [s], (joint, 1)."""
        return np.asarray(values[DELAY] - self._delay)[:, None]

    def _late(self, values: Array) -> ComplexArray:
        return np.asarray(np.exp(-self._s * self._delays(values)))

    def _seen(self, values: Array, trials: slice = ALL) -> ComplexArray:
        """What reflexes see, as late as EMG shows it, (trial, joint, frequency)."""
        velocity, stretch = self._velocity(values[SATURATION])[:, trials], self._stretch[:, trials]
        of_groups = values[VELOCITY][:, None] * velocity + values[POSITION][:, None] * stretch
        return self._made_late(self._of_joints(of_groups), values)

    def _made_late(self, windowed: ComplexArray, values: Array) -> ComplexArray:
        """Signals of the joints, (2, trial, joint, frequency), by their delays under a window that stays."""
        return np.asarray((windowed[0] + self._delays(values) * windowed[1]) * self._late(values))

    def _of_joints(self, of_groups: ComplexArray) -> ComplexArray:
        return np.stack([of_groups[..., list(groups), :].sum(axis=-2) for groups in GROUPS_OF_JOINT], axis=-2)

    def _predicted(self, values: Array, trials: slice = ALL) -> ComplexArray:
        return self._mixed(self._seen(values, trials), values[N_REFLEX:])

    def _slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        gains, speed = values[N_REFLEX:], self._speed
        velocity, seen = self._velocity(values[SATURATION]), self._seen(values)
        by_saturation = self._windowed(-speed * np.abs(speed) / (1.0 + values[SATURATION] * np.abs(speed)) ** 2)
        changes = np.zeros((N_REFLEX, *seen.shape), dtype=complex)
        for group in range(3):
            alone = np.eye(3)[group][:, None]
            for first, signals in ((VELOCITY.start, velocity), (POSITION.start, self._stretch)):
                changes[first + group] = self._made_late(self._of_joints(alone * signals), values)
        of_speed = self._of_joints(values[VELOCITY][:, None] * by_saturation)
        changes[SATURATION] = self._made_late(of_speed, values)
        of_groups = values[VELOCITY][:, None] * velocity[1] + values[POSITION][:, None] * self._stretch[1]
        later = self._of_joints(of_groups) * self._late(values) - self._s * seen
        for joint in range(2):
            changes[DELAY.start + joint, :, joint] = later[:, joint]
        of_gains = [self._mixed(seen, np.eye(len(gains))[k]) for k in range(len(gains))]
        derivatives = np.concatenate([self._mixed(changes, gains), of_gains])
        yield ALL, np.einsum("pk,ptof->ktof", mixing, derivatives)

    def _fitted(self, reflexes: Array) -> tuple[Array, Array]:
        """Values with the best gains, and the inverse of the gains' information."""
        values = np.hstack([reflexes, np.tile(self._best, (len(reflexes), 1))])
        normal = self.normal(values, np.eye(values.shape[1])[:, N_REFLEX:])
        inverse = np.linalg.pinv(normal.information, hermitian=True)
        values[:, N_REFLEX:] = self._best = self._best + inverse @ normal.slope
        return values, np.asarray(inverse)

    def weigh_at(self, reflexes: Array) -> None:
        """Estimate the noise that is left by trials with these `reflex_values`, (trial, value)."""
        if not self._white.any():
            self._white[...] = np.eye(self._n_outputs)[..., None]
        for _ in range(2):  # the best gains depend on the noise
            self.weigh(self._fitted(reflexes)[0])

    def cost_at(self, reflexes: Array) -> float:
        """Sum of squares of the white residual with the best gains."""
        return self.cost(self._fitted(reflexes)[0])

    def objective_at(self, reflexes: Array) -> float:
        """Minus twice the log-likelihood, but for a constant, with the best gains."""
        return self.objective(self._fitted(reflexes)[0])

    @property
    def more_variance(self) -> float:
        """Variance of the slope over the information, as the noise is estimated from the same trials [-]."""
        return float(np.mean(self.sure**-2.0))

    def normal_at(self, reflexes: Array, changes: Array) -> tuple[Array, Array]:
        """Information about unknowns with unknown gains, and minus half the cost's gradient.

        Args:
          reflexes: `reflex_values` of the trials, (trial, value).
          changes: their derivatives, (unknown, trial, value).
        """
        values, inverse = self._fitted(reflexes)
        normal = self.normal(values, np.eye(values.shape[1]))
        of_reflexes = np.einsum("tab,ktb->kta", normal.informations[:, :, :N_REFLEX], changes)
        information = np.einsum("jta,kta->jk", changes, of_reflexes[..., :N_REFLEX])
        with_gains = of_reflexes[..., N_REFLEX:].sum(axis=1)
        slope = np.einsum("kta,ta->k", changes, normal.slopes[:, :N_REFLEX])
        return np.asarray(information - with_gains @ inverse @ with_gains.T), slope


def _rotation(outputs: ReflexOutputs, arm: Subject) -> Array:
    """Of the joints [rad], (trial, time, joint): what the grip gives way is none of it."""
    if outputs.grip_load is None:
        return outputs.rotation
    n = outputs.rotation.shape[1]
    s = 2j * np.pi * fft.rfftfreq(2 * n, 1.0 / outputs.rate)
    gives_way = fft.irfft(fft.rfft(outputs.grip_load, 2 * n, axis=1) / (arm.b_h * s + arm.k_h)[:, None], 2 * n, axis=1)
    return np.asarray(outputs.rotation - gives_way[:, :n])


class EmgOfTrials:
    """EMG of all trials of a person that have some, as one term of the likelihood.

    Args:
      parts: places of a set's trials among all trials, and the likelihood of their EMG.
    """

    def __init__(self, parts: Sequence[tuple[slice, SpindleEmg]]) -> None:
        self._parts = parts

    @property
    def is_empty(self) -> bool:
        """Whether no trial has EMG."""
        return not self._parts

    def weigh(self, reflexes: Array) -> None:
        """Estimate the noise; reflexes are `reflex_values` of all trials, (trial, value)."""
        for rows, emg in self._parts:
            emg.weigh_at(reflexes[rows])

    def cost(self, reflexes: Array) -> float:
        """Sum of squares of white residuals."""
        return sum(emg.cost_at(reflexes[rows]) for rows, emg in self._parts)

    def objective(self, reflexes: Array) -> float:
        """Minus twice the log-likelihood, but for a constant."""
        return sum(emg.objective_at(reflexes[rows]) for rows, emg in self._parts)

    def normal(self, reflexes: Array, changes: Array, *, as_variance: bool = False) -> tuple[Array, Array]:
        """As `SpindleEmg.normal_at`, of all trials together; if asked for, the variance of the slope as information."""
        matrix, slope = np.zeros((len(changes), len(changes))), np.zeros(len(changes))
        for rows, emg in self._parts:
            of_part = emg.normal_at(reflexes[rows], changes[:, rows])
            matrix += of_part[0] * (emg.more_variance if as_variance else 1.0)
            slope += of_part[1]
        return matrix, slope
