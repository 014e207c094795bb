"""Likelihood of a joint's parallel cascade, for an imposed movement and inside a closed loop.

On a position servo the movement is imposed and the derivatives of the model are those at the recorded movement. On a
force servo the noise moves the joint too. Derivatives are then those at the movement that the perturbation alone causes
in the model, which no noise reaches: at the optimum they are instruments that are not correlated with the torque's
residual, whatever the nonlinearity (Soderstrom and Stoica 1983, Instrumental Variable Methods, ch. 6).
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import fft

from armperturb.analysis.fit.whittle import ALL
from armperturb.analysis.joint.model import JointModel, JointStructure, activated, drive_of, play_operator
from armperturb.analysis.joint.signals import JointSignals
from armperturb.analysis.joint.torque_likelihood import BlockScore, TorqueLikelihood
from armperturb.arrays import Array, ComplexArray, Indices

N_BLOCKS = 8
"""Blocks of time that are left out one by one, of a single trial."""

LOOP_ROUNDS = 25
"""Most iterations for the movement of a closed loop."""

LOOP_SETTLED = 1e-4
"""RMS change of the movement below which these end, over the RMS angle [-]."""


class Loop(NamedTuple):
    """What a joint on a force servo moves: the virtual environment.

    Attributes:
      inertia: [kg m^2, or kg].
      damping: [Nms/rad, or Ns/m].
      stiffness: [Nm/rad, or N/m].
    """

    inertia: float
    damping: float
    stiffness: float


class JointLikelihood(TorqueLikelihood):
    """Likelihood of trials of a joint with one structure.

    Args:
      structure: of the joint.
      signals: of the trials.
      loop: the virtual environment of a force servo; None of a position servo.
    """

    def __init__(self, structure: JointStructure, signals: JointSignals, loop: Loop | None = None) -> None:
        self.structure, self._loop = structure, loop
        self._model = JointModel(structure, signals)
        self._moved: tuple[bytes, JointSignals] = b"", signals
        self._impedance: ComplexArray | None = None
        self._taken_out: ComplexArray | float = 0.0
        super().__init__(signals)

    def _predicted(self, values: Array, trials: slice = ALL) -> ComplexArray:
        return self._spectrum(self._model.torque(values)[trials])

    def _slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        columns = JointModel(self.structure, self.movement(values)).derivatives(values)
        yield ALL, np.einsum("ptol,pf->ftol", self._spectrum(np.stack(list(columns.values()))), mixing)

    def take_out(self, values: Array, places: Indices, changes: Array) -> None:
        """Take from the residual what changes of the parameters make in each trial, until the next call.

        Args:
          values: about which they change, (parameter,).
          places: of the parameters that change.
          changes: of these, (trial, changed parameter).
        """
        columns = np.stack(list(JointModel(self.structure, self.movement(values)).derivatives(values).values()))
        self._taken_out = self._spectrum(np.einsum("tp,ptn->tn", changes, columns[places]))

    def _residual(self, values: Array) -> ComplexArray:
        return np.asarray(super()._residual(values) - self._taken_out)

    def weigh(self, values: Array) -> None:
        """Estimate the spectrum of the noise that a model leaves; it holds until the next call."""
        super().weigh(values)
        if self._loop is not None:
            self._impedance = self._impedance_of(values, _padded(self.signals)[1])

    def _impedance_of(self, values: Array, s: ComplexArray) -> ComplexArray:
        """Impedance of environment and joint, linear as the nearest to the model is, (frequency,)."""
        assert self._loop is not None
        given = dict(zip(self.structure.parameters, values, strict=True))
        return _impedance(self.structure, given, self.movement(values).velocity, self._loop, s)

    def movement(self, values: Array) -> JointSignals:
        """Movement at which derivatives are taken: as recorded, or that of the closed loop without noise."""
        if self._loop is None:
            return self.signals
        key, movement = self._moved
        if key != values.tobytes():  # a search asks for residual, then for slopes
            movement = simulated_movement(self.structure, values, self.signals, self._loop, movement)
            self._moved = values.tobytes(), movement
        return movement

    def output_rows(self, values: Array, movement: JointSignals) -> Array:
        """White residual that a search minimises, (trial, number).

        On a position servo that of the torque; on a force servo that of the movement, as the torque that would cause it
        in the joint for which the noise was last weighed. With the impedance of the joint that is tried, it would be
        the residual of the torque at the recorded movement, which noise has moved.
        """
        if self._impedance is None:
            return self.residual(values)
        n, _ = _padded(movement)
        miss = fft.rfft(self.signals.angle - movement.angle, n, axis=1) * self._impedance
        return self.rows(fft.irfft(miss, n, axis=1)[:, : movement.angle.shape[1]])

    def derivatives(self, values: Array, movement: JointSignals) -> Array:
        """White derivatives of the torque by the parameters, (parameter, trial, number)."""
        model = self._model if movement is self.signals else JointModel(self.structure, movement)
        return np.stack([self.rows(column) for column in model.derivatives(values).values()])

    def weighed_objective(self, values: Array) -> float:
        """Minus twice the log-likelihood, but for a constant, with the noise as last weighed [-].

        On a force servo noise is what is left of the torque, and its density that of the movement which it causes.
        """
        density = np.log(self.noise)
        if self._loop is not None:
            density = density - 2.0 * np.log(np.abs(self._impedance_of(values, 2j * np.pi * self.frequency)))
        return self.cost(values) + 2.0 * self.n_trials * float(np.sum(density))

    def scores(self, values: Array) -> list[BlockScore]:
        """What each block of time says; a block is a trial where there are several."""
        columns = self.derivatives(values, self.movement(values))
        return self.block_scores(self.residual(values), columns, 1 if self.n_trials > 1 else N_BLOCKS)


def environment_of(signals: JointSignals) -> Loop:
    """The virtual environment of a force servo, by least squares of d - f on the movement.

    Raises:
      ValueError: d - f does not move a positive inertia.
    """
    used = signals.used
    assert signals.perturbation is not None
    load = (signals.perturbation - signals.torque)[:, used]
    columns = np.stack([part[:, used] for part in (signals.acceleration, signals.velocity, signals.angle)], axis=-1)
    centred = columns - columns.mean(axis=1, keepdims=True)
    weights = np.linalg.lstsq(centred.reshape(-1, 3), (load - load.mean(axis=1, keepdims=True)).ravel(), rcond=None)[0]
    if weights[0] <= 0.0:
        raise ValueError(
            f"recording: the inertia that d - f moves is {weights[0]:.3g}; expected that of a virtual environment "
            "(servo = position for an imposed movement)"
        )
    return Loop(*map(float, weights))


class _Reflex(NamedTuple):
    """Reflex path of a joint in a closed loop.

    Attributes:
      path: frequency response from the drive to the torque, (frequency,).
      drive: what the reflex answers to, (trial, time).
      gain: of the linear reflex to velocity that is nearest to the drive [-].
    """

    path: ComplexArray
    drive: Array
    gain: float


def _reflex(structure: JointStructure, given: dict[str, float], velocity: Array, s: ComplexArray) -> _Reflex:
    path = activated(s, given["reflex_delay"], given["reflex_frequency"], given["reflex_damping_ratio"])
    path = np.asarray(given["reflex_gain"] * path)
    if structure.reflex == "linear":
        return _Reflex(path, velocity, 1.0)
    drive = drive_of(velocity, structure.reflex, given["reflex_threshold"], structure.side)
    power = max(float(np.mean(velocity**2)), np.finfo(float).tiny)
    return _Reflex(path, drive, float(np.mean((drive - drive.mean()) * velocity)) / power)


def _impedance(
    structure: JointStructure, given: dict[str, float], velocity: Array, loop: Loop, s: ComplexArray
) -> ComplexArray:
    """Impedance of environment and joint together, a half-wave replaced by its nearest gain, (frequency,)."""
    total = (loop.inertia + given["inertia"]) * s**2 + (loop.damping + given["damping"]) * s
    total = total + loop.stiffness + given["stiffness"] + 0j
    if structure.reflex != "none":
        reflex = _reflex(structure, given, velocity, s)
        total = total + reflex.gain * s * reflex.path
    return np.asarray(total)


def _padded(signals: JointSignals) -> tuple[int, ComplexArray]:
    n = fft.next_fast_len(signals.angle.shape[1] + round(4.0 * signals.rate), real=True)
    return n, 2j * np.pi * fft.rfftfreq(n, 1.0 / signals.rate)


def simulated_movement(
    structure: JointStructure,
    values: Array,
    signals: JointSignals,
    loop: Loop,
    start: JointSignals | None = None,
) -> JointSignals:
    """Movement that the perturbation alone causes, of environment and joint in a closed loop.

    What is nonlinear is fed back until the movement settles.

    Args:
      structure: of the joint.
      values: of its parameters, (parameter,).
      signals: of the trials.
      loop: the virtual environment.
      start: a movement near the result; None for the recorded one.

    Raises:
      ValueError: the movement does not settle: the closed loop oscillates.
    """
    assert signals.perturbation is not None
    given = dict(zip(structure.parameters, values, strict=True))
    n, s = _padded(signals)
    d = signals.perturbation - signals.perturbation.mean(axis=1, keepdims=True)
    load = fft.rfft(d, n, axis=1) * (np.abs(s) / (2 * np.pi) <= 1.15 * signals.top)
    near = signals if start is None else start
    angle, velocity, size = near.angle, near.velocity, signals.angle_scale
    change = np.inf
    for _ in range(LOOP_ROUNDS):
        beyond = np.zeros_like(load)
        if structure.reflex == "half-wave":
            reflex = _reflex(structure, given, velocity, s)
            beyond = reflex.path * fft.rfft(reflex.drive - reflex.gain * velocity, n, axis=1)
        if structure.short_range:
            play = play_operator(angle, given["short_range_limit"])
            beyond = beyond + given["short_range_stiffness"] * fft.rfft(play, n, axis=1)
        spectrum = (load - beyond) / _impedance(structure, given, velocity, loop, s)
        before = angle
        angle, velocity = (fft.irfft(spectrum * s**power, n, axis=1)[:, : d.shape[1]] for power in (0, 1))
        change = float(np.sqrt(np.mean((angle - before) ** 2))) / size
        if not change < 1e3:
            break
        if (structure.reflex != "half-wave" and not structure.short_range) or change < LOOP_SETTLED:
            break
    if not (change < 0.02 or (structure.reflex in ("none", "linear") and not structure.short_range and change < 1e3)):
        raise ValueError("identify: the closed loop of device and joint does not settle; expected a stable joint")
    acceleration = fft.irfft(spectrum * s**2, n, axis=1)[:, : d.shape[1]]
    return replace(signals, angle=angle, velocity=velocity, acceleration=acceleration)
