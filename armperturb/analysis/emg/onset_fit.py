"""Latency from stretch to EMG by likelihood, many latencies at a time; see `onset`.

Given the latency T and the speed v_0 at which responses have fallen to half, the backgrounds of the trials and the
gains of the stretch, which are not negative, follow by Fisher scoring. A background acts in one trial, so that all of
them are eliminated from each step, and what is solved is no larger than the number of gains.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import interpolate

from armperturb.arrays import Array, Flags, Indices

SATURATIONS = (np.inf, 2.0, 1.0, 0.5)
"""Speeds at which the response to velocity may have fallen to half [rad/s]."""

WITHIN = (-0.5 / np.sqrt(3.0), 0.5 / np.sqrt(3.0))
"""Where the model is evaluated within the averaging time of a sample, over that time [-]: Gauss's two points."""

STEPS, CONVERGED, DAMPED = 30, 1e-2, 1e6
"""Scoring steps, fall of the deviance that ends them [-], and damping with which nothing is left to gain [-]."""

MARGIN = 0.05
"""Rotation about what is used of it from which splines are made [s]."""


def stretch_inputs(
    moved: Sequence[Array], times: Sequence[Array], latencies: Array, rate: float, averaging: float
) -> Array:
    """Rotations [rad] and velocities of both joints, and the sum of these [rad/s], before samples of the power.

    Args:
      moved: rotation of each trial from its rest [rad], (time, joint) each.
      times: of the samples of the power of each trial [s], (time,) each.
      latencies: [s], (latency,).
      rate: of both [Hz].
      averaging: time over which a sample of the power is averaged [s].

    Returns:
      (saturation, latency, part, trial, time, input), velocities v as v / (1 + |v| / v_0) with `SATURATIONS`.
    """
    within = averaging * np.array(WITHIN)
    rotations, velocities = [], []
    for turned, time in zip(moved, times, strict=True):
        first = max(round((time[0] - latencies[-1] - MARGIN) * rate), 0)
        last = min(round((time[-1] + MARGIN) * rate), len(turned))
        spline = interpolate.CubicSpline(np.arange(first, last) / rate, turned[first:last])
        at = time[:, None] + within - latencies[:, None, None]
        rotations.append(spline(at))
        velocities.append(spline(at, 1))
    # Parts and trials before time, as what is summed over parts is then contiguous.
    rotation, velocity = (np.stack(each, axis=1).transpose(0, 3, 1, 2, 4) for each in (rotations, velocities))
    velocity = np.concatenate([velocity, velocity.sum(axis=-1, keepdims=True)], axis=-1)
    return np.stack([np.concatenate([rotation, velocity / (1.0 + np.abs(velocity) / v)], axis=-1) for v in SATURATIONS])


class Fits(NamedTuple):
    """Most likely backgrounds and responses of some candidates.

    Attributes:
      deviance: per degree of freedom of a sample, (candidate,).
      levels: backgrounds, (candidate, trial).
      sizes: of the responses, one on average, (candidate, trial).
      gains: (candidate, input).
    """

    deviance: Array
    levels: Array
    sizes: Array
    gains: Array

    def of(self, which: Indices) -> "Fits":
        """Some of the candidates."""
        return Fits(*(each[which] for each in self))


COUNT = []


class Trials:
    """Power of a muscle in trials.

    Args:
      power: (trial, time); NaN where it is not known.
      noise: that of the silent channel.
      floor: below which that of the model does not fall.
    """

    def __init__(self, power: Array, noise: float, floor: float) -> None:
        self.known = np.isfinite(power)
        self._power, self._noise, self._floor = np.where(self.known, power, 0.0), noise, floor
        with np.errstate(all="ignore"):
            level = np.sqrt(np.maximum(np.nanmedian(power, axis=1) - noise, floor))
        self._level = np.where(np.isfinite(level), level, np.sqrt(floor))
        # What does not depend on the model: minus the logarithm of the power, and one, of each sample.
        self._rest = float(np.sum(np.log(np.maximum(power[self.known], 1e-12 * floor))) + self.known.sum())

    def still(self) -> float:
        """Deviance without any response."""
        mean = self._power.sum(axis=1) / np.maximum(self.known.sum(axis=1), 1)
        return float(self._deviance(np.maximum(mean, self._floor)[None, :, None])[0])

    def model(self, inputs: Array, fits: Fits) -> tuple[Array, Array]:
        """Power, (candidate, trial, time), and amplitude of responses of size one, (candidate, part, trial, time)."""
        n = len(inputs)
        driven = np.maximum(inputs.reshape(n, -1, inputs.shape[-1]) @ fits.gains[..., None], 0.0)
        driven = driven.reshape(inputs.shape[:-1])
        amplitude = fits.levels[:, None, :, None] + fits.sizes[:, None, :, None] * driven
        power = np.sum(amplitude**2, axis=1) / inputs.shape[1]
        return np.maximum(power + self._noise, self._floor), driven

    def _deviance(self, model: Array) -> Array:
        return np.asarray(np.sum((self._power / model + np.log(model)) * self.known, axis=(1, 2)) - self._rest)

    def start(self, inputs: Array) -> Fits:
        """Gains from the amplitude above the background, by least squares."""
        levels = np.tile(self._level, (len(inputs), 1))
        above = np.sqrt(np.maximum(self._power - self._noise, 0.0)) - self._level[:, None]
        columns = np.maximum(inputs.mean(axis=1), 0.0) * self.known[..., None]
        columns = columns.reshape(len(inputs), -1, inputs.shape[-1])
        gram = np.swapaxes(columns, 1, 2) @ columns
        along = np.einsum("cnh,n->ch", columns, above.ravel())
        gains = np.maximum(_solved(gram, along, 1e-2), 0.0)
        return Fits(np.zeros(len(inputs)), levels, np.ones_like(levels), gains)

    def fit(self, inputs: Array, start: Fits | None = None) -> Fits:
        """Most likely backgrounds and responses of candidates, by Fisher scoring.

        Args:
          inputs: (candidate, part, trial, time, input).
          start: where the search of each candidate starts; None for `start`.
        """
        now = self.start(inputs) if start is None else start
        now = now._replace(deviance=self._deviance(self.model(inputs, now)[0]))
        best = Fits(*(each.copy() for each in now))
        places, damping = np.arange(len(inputs)), np.full(len(inputs), 1e-2)
        for _ in range(STEPS):
            after, expected = self._stepped(inputs, now, damping)
            better = after.deviance <= now.deviance
            now = Fits(
                *(
                    np.where(better if each.ndim == 1 else better[:, None], then, each)
                    for each, then in zip(now, after, strict=True)
                )
            )
            damping = np.where(better, damping / 10.0, damping * 10.0)
            for each, found in zip(best, now, strict=True):
                each[places] = found
            going = (expected > CONVERGED) & (damping < DAMPED)
            COUNT.append((len(going), going.sum()))
            if not going.any():
                break
            if going.sum() < 0.7 * len(going):
                inputs, now, places, damping = inputs[going], now.of(going), places[going], damping[going]
        return best

    def _stepped(self, inputs: Array, now: Fits, damping: Array) -> tuple[Fits, Array]:
        """Candidates after a damped step of scoring, and by how much it should lower their deviance."""
        model, driven = self.model(inputs, now)
        weight = self.known / model
        sizes = now.sizes[:, None, :, None]
        amplitude = (now.levels[:, None, :, None] + sizes * driven) * (2.0 / inputs.shape[1]) * weight[:, None]
        # Slopes by what acts in one trial: background and size.
        own = np.stack([np.sum(amplitude, axis=1), np.sum(amplitude * driven, axis=1)], axis=-1)
        acts = np.where(driven > 0.0, amplitude * sizes, 0.0)
        by_gain = np.sum(acts[..., None] * inputs, axis=1)
        residual = (self._power - model) * weight
        n, n_inputs = now.gains.shape
        own_gram = np.swapaxes(own, 2, 3) @ own
        own_slope = (np.swapaxes(own, 2, 3) @ residual[..., None])[..., 0]
        flat = by_gain.reshape(n, -1, n_inputs)
        gram = np.swapaxes(flat, 1, 2) @ flat
        slope = (np.swapaxes(flat, 1, 2) @ residual.reshape(n, -1, 1))[..., 0]
        cross = np.swapaxes(own, 2, 3) @ by_gain
        # Gains that are zero and would fall stay where they are.
        free = (now.gains > 0.0) | (slope > 0.0)
        grow = 1.0 + damping + 1e-9
        own_gram[..., 0, 0] = own_gram[..., 0, 0] * grow[:, None] + 1e-300
        own_gram[..., 1, 1] = own_gram[..., 1, 1] * grow[:, None] + 1e-300
        determinant = own_gram[..., 0, 0] * own_gram[..., 1, 1] - own_gram[..., 0, 1] ** 2
        inverse = (
            np.stack(
                [own_gram[..., 1, 1], -own_gram[..., 0, 1], -own_gram[..., 0, 1], own_gram[..., 0, 0]], axis=-1
            ).reshape(own_gram.shape)
            / determinant[..., None, None]
        )
        solved = inverse @ cross
        diagonal = np.einsum("chh->ch", gram)
        diagonal[...] *= grow[:, None]
        gram -= np.einsum("ctoh,ctok->chk", cross, solved)
        along = slope - np.einsum("ctoh,cto->ch", solved, own_slope)
        change = _solved(gram, along, 1e-9, free)
        gains = np.maximum(now.gains + change, 0.0)
        own_change = (inverse @ own_slope[..., None])[..., 0] - np.einsum("ctoh,ch->cto", solved, change)
        levels = np.maximum(now.levels + own_change[..., 0], 0.0)
        sizes = np.maximum(now.sizes + own_change[..., 1], 0.0)
        after = Fits(now.deviance, levels, sizes, gains)
        expected = (
            np.sum(slope * (gains - now.gains), axis=1)
            + np.sum(own_slope[..., 0] * (levels - now.levels), axis=1)
            + np.sum(own_slope[..., 1] * (sizes - now.sizes), axis=1)
        )
        return after._replace(deviance=self._deviance(self.model(inputs, after)[0])), expected


def _solved(gram: Array, along: Array, ridge: float, free: Flags | None = None) -> Array:
    """Solutions of systems, (system, n, n), of the free ones among the unknowns; the others are zero."""
    size = np.sqrt(np.maximum(np.einsum("chh->ch", gram), 1e-300))
    scaled = gram / (size[:, :, None] * size[:, None, :]) + ridge * np.eye(gram.shape[1])
    right = along / size
    if free is not None:
        scaled = np.where(free[:, :, None] & free[:, None, :], scaled, np.eye(gram.shape[1]))
        right = np.where(free, right, 0.0)
    return np.asarray(np.linalg.solve(scaled, right[..., None])[..., 0] / size)
