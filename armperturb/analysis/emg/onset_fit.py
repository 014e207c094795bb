"""Latency from stretch to EMG by likelihood, many candidates of latency and saturation at a time; see `onset`.

Given both, the background of each trial and the size of its response, and the gains of the stretch, none of which is
negative, follow by Fisher scoring, damped as by Levenberg and Marquardt. Sizes are about one, with `SIZE_SPREAD`.
Backgrounds and sizes act in one trial each, so that they are eliminated from each step, and what is solved is no larger
than the number of gains.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import interpolate

from armperturb.arrays import Array, Flags, Indices

LATENCIES = 0.01 + 1e-3 * np.arange(71)
"""Latencies that are looked for [s]."""

SATURATIONS = (np.inf, 2.0, 1.0, 0.5)
"""Speeds at which the response to velocity may have fallen to half [rad/s]."""

UNLOADED = (0.0, 1.0)
"""By what share of its answer to stretch a muscle may fall silent as it shortens, down to silence [-]: where reflexes
excite alone it does not, where they drive a background it does so fully."""

WITHIN = (-0.5 / np.sqrt(3.0), 0.5 / np.sqrt(3.0))
"""Where the model is evaluated within the averaging time of a sample, over that time [-]: Gauss's two points."""

MARGIN = 0.05
"""Rotation about what is used of it from which splines are made [s]."""

SIZE_SPREAD = 0.3
"""Standard deviation of the size of a response over trials and conditions, about one, before anything is measured [-]:
where responses are weak, nothing else tells it."""

LEAST_POWER = 1e-4
"""Share of the mean power below which the model's power does not fall [-]."""

STEPS, MOST_DAMPED = 40, 1e6
"""Scoring steps, and damping with which nothing is left to gain [-]."""

DAMPING, EASED, HARDENED = 0.1, 0.2, 5.0
"""Damping of the first step, and factors by which it changes where the model is found right or wrong [-]."""

REGULAR = 1e-9
"""Ridge of what is solved, over its diagonal [-]: rotations of few trials may be collinear."""


N_GAINS = 5
"""Of the rotations of two joints, their velocities, and the sum of these."""


class Stretch:
    """Rotations and velocities before the samples of the power of the trials of one direction.

    Args:
      moved: rotation of each trial from its rest [rad], (time, joint) each.
      times: of the samples of the power of each trial [s], (time,) each.
      rate: of both [Hz].
      averaging: time over which a sample of the power is averaged [s].
    """

    def __init__(self, moved: Sequence[Array], times: Sequence[Array], rate: float, averaging: float) -> None:
        within = averaging * np.array(WITHIN)
        rotations, velocities = [], []
        for turned, time in zip(moved, times, strict=True):
            first = max(round((time[0] - LATENCIES[-1] - MARGIN) * rate), 0)
            last = min(round((time[-1] + MARGIN) * rate), len(turned))
            spline = interpolate.CubicSpline(np.arange(first, last) / rate, turned[first:last])
            at = time[:, None] + within - LATENCIES[:, None, None]
            rotations.append(spline(at))
            velocities.append(spline(at, 1))
        # Parts and trials before time, as what is summed over parts is then contiguous.
        self._rotation, velocity = (np.stack(each, axis=1).transpose(0, 3, 1, 2, 4) for each in (rotations, velocities))
        self._velocity = np.concatenate([velocity, velocity.sum(axis=-1, keepdims=True)], axis=-1)

    def __call__(self, latencies: Indices, sign: int) -> Array:
        """Rotations of both joints [rad], their velocities and the sum of these, v as v / (1 + |v| / v_0) [rad/s].

        Args:
          latencies: which of `LATENCIES`.
          sign: 1 for muscles that positive rotation stretches, -1 for others.

        Returns:
          (candidate, part, trial, time, input), candidates as all latencies with each of `SATURATIONS` in turn, and
          these with each of `UNLOADED`.
        """
        rotation, velocity = sign * self._rotation[latencies], sign * self._velocity[latencies]
        n_rotations = rotation.shape[-1]
        inputs = np.empty((len(SATURATIONS), *rotation.shape[:-1], n_rotations + velocity.shape[-1]))
        inputs[..., :n_rotations] = rotation
        for each, speed in zip(inputs, SATURATIONS, strict=True):
            each[..., n_rotations:] = velocity / (1.0 + np.abs(velocity) / speed)
        inputs = inputs.reshape(-1, *inputs.shape[2:])
        return np.concatenate([inputs] * len(UNLOADED))


class Fits(NamedTuple):
    """Most likely backgrounds and responses of some candidates.

    Attributes:
      deviance: per degree of freedom of a sample, (candidate,).
      levels: backgrounds, (candidate, trial).
      sizes: of the responses, (candidate, trial).
      gains: of the stretch, (candidate, input).
      unloaded: which of `UNLOADED`, (candidate,).
    """

    deviance: Array
    levels: Array
    sizes: Array
    gains: Array
    unloaded: Array

    def of(self, which: Indices | Flags) -> "Fits":
        """Some of the candidates."""
        return Fits(*(each[which] for each in self))

    def stretch(self, inputs: Array) -> Array:
        """What each candidate sees, (candidate, trial, time)."""
        return np.asarray(np.einsum("cptoh,ch->cto", inputs, self.gains) / inputs.shape[1])

    def or_other(self, which: Flags, other: "Fits") -> "Fits":
        """Some of the candidates, and the others of other fits."""
        return Fits(
            *(
                np.where(which.reshape(-1, *[1] * (mine.ndim - 1)), mine, theirs)
                for mine, theirs in zip(self, other, strict=True)
            )
        )


class MusclePower:
    """Power of a muscle in trials of one direction, and how likely a response makes it.

    Args:
      power: (trial, time), positive somewhere; NaN where it is not known.
      noise: that of the silent channel.
      weight: degrees of freedom of a sample.
    """

    def __init__(self, power: Array, noise: float, weight: float) -> None:
        self._tied = 2.0 / (SIZE_SPREAD**2 * weight)
        self.known = np.isfinite(power)
        self._power, self._noise = np.where(self.known, power, 0.0), noise
        self._floor = LEAST_POWER * float(power[self.known].mean())
        self._mean = self._power.sum(axis=1) / np.maximum(self.known.sum(axis=1), 1)
        # What of the deviance does not depend on the model.
        self._rest = float(np.sum(np.log(np.maximum(power[self.known], 1e-12 * self._floor)))) + self.known.sum()

    def still(self) -> float:
        """Deviance without any response."""
        return float(self._deviance(np.maximum(self._mean, self._floor)[None, :, None])[0])

    def fit(self, inputs: Array, starts: Sequence[Fits], converged: float) -> Fits:
        """Most likely backgrounds and responses of candidates.

        Args:
          inputs: as `Stretch` gives them.
          starts: of which the most likely one is where the search of each candidate starts; none if nothing is known.
          converged: fall of the deviance that a step has to promise.
        """
        now, *others = (each._replace(deviance=self._cost(inputs, each)) for each in starts or [self._start(inputs)])
        for other in others:
            now = other.or_other(other.deviance < now.deviance, now)
        best, places = Fits(*(each.copy() for each in now)), np.arange(len(inputs))
        damping = np.full(len(inputs), DAMPING)
        for _ in range(STEPS):
            after, promised = self._stepped(inputs, now, damping)
            gained = (now.deviance - after.deviance) / np.maximum(promised, 1e-300)
            now = after.or_other(gained >= 0.0, now)
            for each, reached in zip(best, now, strict=True):
                each[places] = reached
            damping *= np.select([gained > 0.75, gained > 0.25, gained >= 0.0], [EASED, 1.0, 2.0], HARDENED)
            going = (promised * (1.0 + damping) > converged) & (damping < MOST_DAMPED)
            if not going.any():
                break
            if going.mean() < 0.7:
                inputs, now, places, damping = inputs[going], now.of(going), places[going], damping[going]
        return best

    def _start(self, inputs: Array) -> Fits:
        """Gains from the amplitude above the mean one, by least squares."""
        level = np.sqrt(np.maximum(self._mean / 2.0 - self._noise, self._floor))
        above = (np.sqrt(np.maximum(self._power - self._noise, 0.0)) - level[:, None]) * self.known
        unloaded = np.repeat(UNLOADED, len(inputs) // len(UNLOADED))
        columns = inputs.mean(axis=1)
        columns = np.maximum(columns, unloaded[:, None, None, None] * columns) * self.known[..., None]
        columns = columns.reshape(len(inputs), -1, inputs.shape[-1])
        crossed = np.swapaxes(columns, 1, 2)
        gains = np.maximum(_solved(crossed @ columns, crossed @ above.ravel(), 1e-2), 0.0)
        levels = np.tile(level, (len(inputs), 1))
        return Fits(np.zeros(len(inputs)), levels, np.ones_like(levels), gains, unloaded)

    def _parts(self, inputs: Array, fits: Fits) -> tuple[Array, Array, Array]:
        """Amplitudes, responses of size one, and their slope by what is seen, (candidate, part, trial, time) each."""
        seen = (inputs.reshape(len(inputs), -1, inputs.shape[-1]) @ fits.gains[..., None]).reshape(inputs.shape[:-1])
        slope = np.where(seen > 0.0, 1.0, fits.unloaded[:, None, None, None])
        driven = slope * seen
        amplitude = fits.levels[:, None, :, None] + fits.sizes[:, None, :, None] * driven
        return np.maximum(amplitude, 0.0), driven, slope

    def _power_of(self, amplitude: Array) -> Array:
        """Power of amplitudes, (candidate, trial, time)."""
        power = np.sum(amplitude**2, axis=1) / amplitude.shape[1]
        return np.maximum(power + self._noise, self._floor)

    def _deviance(self, model: Array) -> Array:
        return np.asarray(np.sum((self._power / model + np.log(model)) * self.known, axis=(1, 2)) - self._rest)

    def _cost(self, inputs: Array, fits: Fits) -> Array:
        """Deviance, and what sizes add that differ from one."""
        unlike = np.sum((fits.sizes - 1.0) ** 2, axis=1)
        return np.asarray(self._deviance(self._power_of(self._parts(inputs, fits)[0])) + 0.5 * self._tied * unlike)

    def _stepped(self, inputs: Array, now: Fits, damping: Array) -> tuple[Fits, Array]:
        """Candidates after a damped step of scoring, and by how much it promises to lower their deviance."""
        amplitude, driven, rise = self._parts(inputs, now)
        model = self._power_of(amplitude)
        weight = self.known / model
        residual = (self._power - model) * weight
        sizes = now.sizes[:, None, :, None]
        amplitude *= (2.0 / inputs.shape[1]) * weight[:, None]
        by_trial = np.stack([np.sum(amplitude, axis=1), np.sum(amplitude * driven, axis=1)], axis=2)
        by_gain = np.sum((amplitude * rise * sizes)[..., None] * inputs, axis=1)
        n, n_gains = now.gains.shape
        flat = by_gain.reshape(n, -1, n_gains)
        crossed = np.swapaxes(flat, 1, 2)
        gram, slope = crossed @ flat, (crossed @ residual.reshape(n, -1, 1))[..., 0]
        # Of each trial: its background and size.
        own_gram, own_slope = by_trial @ np.swapaxes(by_trial, 2, 3), (by_trial @ residual[..., None])[..., 0]
        own_gram[..., 1, 1] += self._tied
        own_slope[..., 1] += self._tied * (1.0 - now.sizes)
        mixed = by_trial @ by_gain
        growth = 1.0 + damping + REGULAR
        for matrix, times in ((gram, growth[:, None]), (own_gram, growth[:, None, None])):
            diagonal = np.einsum("...ii->...i", matrix)
            diagonal[...] = diagonal * times + 1e-300
        solved = np.linalg.solve(own_gram, np.concatenate([mixed, own_slope[..., None]], axis=-1))
        gram -= np.sum(np.swapaxes(mixed, 2, 3) @ solved[..., :-1], axis=1)
        along = slope - np.sum(np.swapaxes(mixed, 2, 3) @ solved[..., -1:], axis=1)[..., 0]
        # Gains that are zero and would fall stay where they are.
        free = (now.gains > 0.0) | (slope > 0.0)
        change = _solved(gram, along, REGULAR, free)
        own_change = solved[..., -1] - np.einsum("ctoh,ch->cto", solved[..., :-1], change)
        after = Fits(
            now.deviance,
            np.maximum(now.levels + own_change[..., 0], 0.0),
            np.maximum(now.sizes + own_change[..., 1], 0.0),
            np.maximum(now.gains + change, 0.0),
            now.unloaded,
        )
        promised = (
            np.sum(own_slope[..., 0] * (after.levels - now.levels), axis=1)
            + np.sum(own_slope[..., 1] * (after.sizes - now.sizes), axis=1)
            + np.sum(slope * (after.gains - now.gains), axis=1)
        )
        return after._replace(deviance=self._cost(inputs, after)), promised / 2.0


def _solved(gram: Array, along: Array, ridge: float, free: Flags | None = None) -> Array:
    """Solutions of systems, (system, n, n), of the free ones among the unknowns; the others are zero."""
    size = np.sqrt(np.maximum(np.einsum("chh->ch", gram), 1e-300))
    scaled = gram / (size[:, :, None] * size[:, None, :]) + ridge * np.eye(gram.shape[1])
    right = along / size
    if free is not None:
        scaled = np.where(free[:, :, None] & free[:, None, :], scaled, np.eye(gram.shape[1]))
        right = np.where(free, right, 0.0)
    return np.asarray(np.linalg.solve(scaled, right[..., None])[..., 0] / size)
