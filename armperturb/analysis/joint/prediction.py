"""Free model of a joint's torque, for prediction: what a parallel cascade leaves to a few functions without structure.

Torque is a sum of given responses with free weights, found by regularised least squares: acceleration to snap of the
angle, short-range stiffness of several widths, slow relaxation, polynomials of angle and velocity, and the half-waves
of velocity through Laguerre filters (a Hammerstein system with any dynamics), of which the first scale stiffness too:
stiffness follows the activation that reflexes cause. Several directions, thresholds and memories of the half-waves are
tried, and the prediction is the mean of those that predict blocks of time which are left out nearly as well as the
best.

Source of the Laguerre filters: Wahlberg (1991), IEEE Trans. Autom. Control 36, 551-562.
"""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import signal

from armperturb.analysis.joint.model import play_operator
from armperturb.analysis.joint.signals import JointSignals, time_blocks
from armperturb.arrays import Array

WIDTHS = (0.05, 0.2, 0.8)
"""Widths of short-range stiffness, over the RMS angle [-]."""

RELAXATION = (0.3, 2.0)
"""Time constants of slow relaxation [s]."""

DELAY = 0.03
"""Least delay of a reflex [s]."""

FILTERS = ((8, 18.0), (12, 12.0))
"""Numbers and poles [1/s] of Laguerre filters that are tried."""

THRESHOLDS = (0.0, 0.3)
"""Thresholds of half-waves that are tried, over the RMS velocity [-]."""

SIDES = ((), (1,), (-1,), (1, -1))
"""Directions of stretch that are tried."""

FOLLOWING = 4
"""Laguerre filters whose output scales stiffness."""

RIDGE = 1e-6
"""Regularisation, over the mean square of a column [-]."""

BLOCKS = 4
"""Blocks of time that are left out one by one."""

NEARLY = 1.0
"""Left-out VAF by which a model may be behind the best and still counts [%]."""


class Scales(NamedTuple):
    """Sizes in which movements are measured: those of the fitted trials.

    Attributes:
      angle: RMS [rad, or m].
      velocity: RMS [rad/s, or m/s].
      scheduling: mean and RMS deviation of the scheduling movement; None without.
    """

    angle: float
    velocity: float
    scheduling: tuple[float, float] | None


class Recipe(NamedTuple):
    """Which half-waves a free model has.

    Attributes:
      sides: directions of stretch.
      threshold: over the RMS velocity [-].
      n_filters: number of Laguerre filters.
      pole: of these [1/s].
    """

    sides: tuple[int, ...]
    threshold: float
    n_filters: int
    pole: float


@dataclass(frozen=True, kw_only=True, eq=False)
class FreeModel:
    """A free model that was fitted.

    Attributes:
      parts: half-waves and weights of the responses, (column,), of each model whose mean this is.
      scales: of the trials that it was fitted to.
      left_out_vaf: of blocks that were left out of the fits [%].
    """

    parts: tuple[tuple[Recipe, Array], ...]
    scales: Scales
    left_out_vaf: float

    def torque(self, signals: JointSignals) -> Array:
        """Predicted torque without offset and drift, from the movement alone, (trial, time)."""
        return np.mean([responses(recipe, signals, self.scales) @ weights for recipe, weights in self.parts], axis=0)


def fit_free_model(signals: JointSignals) -> FreeModel:
    """The free model of trials."""
    scheduling = signals.scheduling
    spread = None if scheduling is None else (float(scheduling.mean()), float(max(scheduling.std(), 1e-12)))
    scales = Scales(signals.angle_scale, signals.velocity_scale, spread)
    recipes = [Recipe((), 0.0, 0, 1.0)]
    recipes += [Recipe(sides, c, *each) for sides, c, each in itertools.product(SIDES[1:], THRESHOLDS, FILTERS)]
    used, fits = signals.used, []
    torque = without_drift(signals.torque[:, used])
    for recipe in recipes:
        columns = without_drift(responses(recipe, signals, scales)[:, used])
        flat = columns.reshape(-1, columns.shape[2])
        weights = _ridge(flat.T @ flat, flat.T @ torque.ravel(), len(flat))
        fits.append((recipe, weights, left_out_predictions(columns, torque)))
    vaf = [left_out_share(torque, predicted) for _, _, predicted in fits]
    chosen = [fit for fit, each in zip(fits, vaf, strict=True) if each >= max(vaf) - NEARLY]
    mean = np.mean([predicted for _, _, predicted in chosen], axis=0)
    parts = tuple((recipe, weights) for recipe, weights, _ in chosen)
    return FreeModel(parts=parts, scales=scales, left_out_vaf=left_out_share(torque, mean))


def responses(recipe: Recipe, signals: JointSignals, scales: Scales) -> Array:
    """Columns of the regression, (trial, time, column)."""
    rate, x, v = signals.rate, signals.angle, signals.velocity
    jerk = np.gradient(signals.acceleration, 1.0 / rate, axis=1)
    snap = np.gradient(jerk, 1.0 / rate, axis=1)
    columns = [x, v, signals.acceleration, jerk, snap]
    columns += [play_operator(x, width * scales.angle) for width in WIDTHS]
    for time_constant in RELAXATION:
        pole = np.exp(-1.0 / rate / time_constant)
        columns.append(signal.lfilter([1.0 - pole], [1.0, -pole], x, axis=1))
    columns += [x**2, x**3, np.abs(v) * x, v * np.abs(v), v * x]
    waves = []
    for side in recipe.sides:
        wave = np.maximum(side * v / scales.velocity - recipe.threshold, 0.0)
        filtered = laguerre(wave, recipe.n_filters, recipe.pole, DELAY, rate)
        waves += filtered
        columns += [part * x for part in filtered[:FOLLOWING]]
    columns += waves
    if signals.scheduling is not None and scales.scheduling is not None:
        mean, spread = scales.scheduling
        place = (signals.scheduling - mean) / spread
        speed = np.gradient(place, 1.0 / rate, axis=1)
        columns += [place, place**2, place**3, speed, speed * np.abs(speed)]
        columns += [part * place**power for part in (x, v, *waves[:FOLLOWING]) for power in (1, 2)]
    return np.stack(columns, axis=-1)


def laguerre(values: Array, n: int, pole: float, delay: float, rate: float) -> list[Array]:
    """Outputs of Laguerre filters, (trial, time) each.

    Args:
      values: their input, (trial, time).
      n: number of filters.
      pole: of all [1/s].
      delay: before them [s].
      rate: of the samples [Hz].
    """
    shift, q = round(delay * rate), float(np.exp(-pole / rate))
    late = np.concatenate([np.zeros((len(values), shift)), values[:, : values.shape[1] - shift]], axis=1)
    outputs = [signal.lfilter([np.sqrt(1.0 - q * q)], [1.0, -q], late, axis=1)]
    for _ in range(n - 1):
        outputs.append(signal.lfilter([-q, 1.0], [1.0, -q], outputs[-1], axis=1))
    return outputs


def left_out_predictions(columns: Array, torque: Array) -> Array:
    """Blocks of time, each predicted from the others, (trial, time).

    Args:
      columns: (trial, time, column).
      torque: (trial, time).
    """
    blocks, predicted = time_blocks(torque.shape[1], BLOCKS), np.empty_like(torque)
    grams = np.stack([np.einsum("tsi,tsj->ij", columns[:, b], columns[:, b], optimize=True) for b in blocks])
    sides = np.stack([np.einsum("tsi,ts->i", columns[:, b], torque[:, b], optimize=True) for b in blocks])
    for at, block in enumerate(blocks):
        n = torque.size - len(torque) * len(block)
        weights = _ridge(grams.sum(axis=0) - grams[at], sides.sum(axis=0) - sides[at], n)
        predicted[:, block] = columns[:, block] @ weights
    return predicted


def left_out_share(torque: Array, predicted: Array) -> float:
    """VAF of blocks of time that were left out [%]; the offset of a block is its own."""
    left = 0.0
    for block in time_blocks(torque.shape[1], BLOCKS):
        miss = torque[:, block] - predicted[:, block]
        left += float(np.sum((miss - miss.mean(axis=1, keepdims=True)) ** 2))
    return 100.0 * (1.0 - left / float(np.sum((torque - torque.mean(axis=1, keepdims=True)) ** 2)))


def _ridge(gram: Array, side: Array, n: int) -> Array:
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny) / n)
    scaled = gram / np.outer(scale, scale) + RIDGE * n * np.eye(len(gram))
    return np.asarray(np.linalg.solve(scaled, side / scale) / scale)


def without_drift(values: Array) -> Array:
    """What is left of signals without offset and line of each trial, as the likelihood has it.

    Args:
      values: (trial, time, ...).
    """
    return np.asarray(signal.detrend(values, axis=1))


def explained(recorded: Array, predicted: Array) -> float:
    """Variance accounted for, without offset and drift of each trial [%].

    Args:
      recorded: (trial, time).
      predicted: (trial, time).
    """
    left, whole = without_drift(recorded - predicted), without_drift(recorded)
    return float(100.0 * (1.0 - np.sum(left**2) / np.sum(whole**2)))
