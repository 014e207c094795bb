"""How likely trials are under an arm model: in the frequency domain over one period, or over the whole record.

In both, x = P(theta) d + v, where x is the displacement that encoders and gauge together tell (see
`Balance.displacement`), d the known disturbance, and v what the person and the instruments add: noise of an unknown,
smooth spectrum, the same in all trials of a condition (`whittle`). That spectrum has the arm's own resonance, and what
smooths it must not: so it is the spectrum of the hand force u = P^-1 v that would move the handle like that which is
smoothed.

A finite record lets the strong low frequencies leak into the weak high ones. Both likelihoods therefore filter x and
P d with the same two zeros, so that what is left is nearly white, before they are transformed.

A record that begins amid the movement answers to what was before it as well. A force that was always there, the mean of
the record's, only displaces the handle and is left out. The rest is as if an unknown force had acted on the handle
before the first sample. The response to such a force (`PAST`), and an offset and a drift of the displacement, are then
least-squares fitted to each trial's residual and taken out of it, and out of the derivatives: the likelihood is that of
the rest. Arms of trials may differ, so that P differs from trial to trial.
"""

from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import fft

from armperturb.analysis.fit.frequency_bands import EXCITED_POWER
from armperturb.analysis.fit.frequency_rows import applied, applied_rows, complex_values
from armperturb.analysis.fit.total_admittance import TotalAdmittance
from armperturb.analysis.fit.whittle import ALL, ROUND_OFF, Normal, Whittle
from armperturb.analysis.smoother import NoiseLevels, gauge_gain
from armperturb.arrays import Array, ComplexArray, Indices
from armperturb.environment import Environment
from armperturb.subject import Subject

CORNER = 1.5
"""From about this frequency on the displacement falls with inertia [Hz]: corner of the whitening filter."""

TAPER = 2.0
"""Length over which a record fades out before it is transformed [s]; one that begins at rest needs no fading in."""

PAST = (0.0, 0.02, 0.05, 0.09, 0.15, 0.23, 0.35, 0.55, 0.9, 1.5, 2.5)
"""Times before a record at which the unknown force before it may have its knots, linear between them [s]."""

MEMORY = 20.0, 40.0
"""By how much records are padded before they are transformed, at least and at most [s]: after as long, responses have
surely died away. Between the two, by their own length."""

START_OF_MOVING = 0.5
"""What is left out at the start of a record that begins amid the movement [s], which its filters spoil. From then on it
fades in over half of `TAPER`."""

LONGEST_SIGNALS = 2**21
"""Samples of signals that are transformed at once, for the sake of memory."""


class Signals(NamedTuple):
    """What trials of one condition hold, and what the hand holds in them.

    Attributes:
      perturbation: d [N], (trial, time, axis).
      applied: d without what depends on the person's noise [N], likewise; see `measures.start_geometry`.
      displacement: whitened, of the same time, (trial, time, axis).
      body: gives segments and posture.
      environment: what the hand holds.
      rate: of the samples [Hz].
    """

    perturbation: Array
    applied: Array
    displacement: Array
    body: Subject
    environment: Environment
    rate: float


def whitening(frequency: Array, rate: float) -> ComplexArray:
    """Frequency response of the filter that makes displacements nearly white, (frequency,)."""
    pole = _pole(rate)
    return np.asarray(((1.0 - pole * np.exp(-2j * np.pi * frequency / rate)) / (1.0 - pole)) ** 2)


def whitened(values: Array, rate: float) -> Array:
    """That filter's output, at rest before the first sample, (trial, time, axis)."""
    pole = _pole(rate)
    padded = np.concatenate([np.zeros_like(values[:, :2]), values], axis=1)
    return np.asarray((padded[:, 2:] - 2 * pole * padded[:, 1:-1] + pole**2 * padded[:, :-2]) / (1.0 - pole) ** 2)


def _pole(rate: float) -> float:
    return float(np.exp(-2 * np.pi * CORNER / rate))


def judged_part(n: int, rate: float, *, from_rest: bool) -> tuple[slice, Array]:
    """What of records of n samples is judged, and the window that it is transformed with, (time,)."""
    n_taper, start = round(TAPER * rate), 0 if from_rest else round(START_OF_MOVING * rate)
    fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(n_taper) + 0.5) / n_taper)
    taper = np.ones(n - start)
    taper[-n_taper:] = fade[::-1]
    if not from_rest:
        taper[: len(fade[::2])] *= fade[::2]
    return slice(start, n), taper


class Likelihood(Whittle):
    """Likelihood of the displacement in the trials of one condition; subclasses say how an arm answers the disturbance.

    Values are the parameters of an arm in the order of `arm.parameters.PARAMETERS`, (parameter,), or those of each
    trial's arm, (trial, parameter).

    Args:
      signals: of the trials.
      frequency: of the residual, evenly spaced [Hz], (frequency,).
      force: DFT of d at these frequencies, (trial, axis, frequency).
      applied: that of `Signals.applied`, likewise.
      observed: DFT of the whitened displacement, (trial, axis, frequency).
      answering: as in `Whittle`.
      taper: likewise.
    """

    def __init__(
        self,
        signals: Signals,
        frequency: Array,
        force: ComplexArray,
        applied: ComplexArray,
        observed: ComplexArray,
        answering: Indices | slice,
        taper: Array | None = None,
    ) -> None:
        self._total = TotalAdmittance(signals.body, frequency, signals.environment)
        # Where an arm answers: often everywhere.
        asked = frequency[answering]
        self._answer = (
            self._total if len(asked) == len(frequency) else TotalAdmittance(signals.body, asked, signals.environment)
        )
        self._filter = whitening(frequency, signals.rate)
        least = float(ROUND_OFF * np.abs(force).max()) ** 2
        super().__init__(
            frequency, force, observed, answering, scale=self._filter, least=least, cause=applied, taper=taper
        )

    def by_manipulator(self, values: Array, environment: Environment, levels: NoiseLevels) -> ComplexArray:
        """How the residual changes with the manipulator's mass, damping and stiffness, (3, trial, axis, answer).

        An error of its impedance by s^k is one of the force s^k x in the model, and of the force that the balance
        leaves in the displacement: the residual has (P - G) s^k x of it, see `force_balance`.

        Args:
          values: parameters of the arm.
          environment: the manipulator as it was identified.
          levels: of the instruments' noise.
        """
        mean = values if values.ndim == 1 else values.mean(axis=0)
        s = np.asarray(2j * np.pi * self._frequency[self._answering], dtype=complex)
        impedance = np.asarray(environment.m_env * s**2 + environment.b_env * s + environment.k_env, dtype=complex)
        share = np.subtract(self._answer(mean), gauge_gain(impedance, levels) * np.eye(2)[..., None])
        return np.stack([applied(share * s**power, self._observed) for power in (2, 1, 0)])

    @cached_property
    def _driving(self) -> ComplexArray:
        """DFT of d as the whitening filter lets it through, (trial, axis, answer)."""
        return np.asarray(self._force * self._filter[self._answering])

    @cached_property
    def _alike(self) -> ComplexArray:
        """Two loads with the same sum of d d^H as `_driving` has over all trials, (trial, axis, answer)."""
        first, second = self._driving.swapaxes(0, 1)
        size = np.sqrt(np.sum(np.abs(first) ** 2, axis=0))
        along = np.sum(second * first.conj(), axis=0) / np.where(size > 0.0, size, 1.0)
        rest = np.maximum(np.sum(np.abs(second) ** 2, axis=0) - np.abs(along) ** 2, 0.0)
        return np.array([[size, along], [np.zeros_like(along), np.sqrt(rest)]])

    def step_normal(self, values: Array, mixing: Array) -> Normal:
        """As `Whittle.step_normal`: many trials tell as much as two that have their forces' power.

        The derivative dP d is linear in the force: the sum over trials of |W dP d|^2 depends on that of d d^H alone.
        """
        if self.n_trials <= 2:
            return super().step_normal(values, mixing)
        residual = self._white_rows(values)
        white = complex_values(residual, self._observed.shape)
        errors = applied(self._white.conj().swapaxes(0, 1), white)
        gradient = self._answer.gradient(values, mixing)
        slopes = self._answer.slopes_along(values, mixing, self._driving, errors, gradient)
        information = np.zeros(2 * mixing.shape[1:])
        for derivatives in self._answer.driven_slopes(values, mixing, self._alike, gradient):
            rows = applied_rows(self._white, derivatives)
            information += rows @ rows.T
        return Normal(float(np.sum(residual**2)), slopes.sum(axis=0)[None], information[None])

    def _to_smooth(self, values: Array) -> ComplexArray:
        (a, b), (c, d) = self._total(values) * self._filter
        return np.stack([np.stack([d, -b]), np.stack([-c, a])]) / (a * d - b * c)

    def _quick_slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        for trial, derivatives in enumerate(self._answer.driven_slopes(values, mixing, self._driving)):
            yield slice(trial, trial + 1), derivatives[:, None]


class PeriodLikelihood(Likelihood):
    """Likelihood of the mean of whole periods, in which the response to the disturbance is periodic.

    Args:
      signals: of whole periods.
      n_period: samples of a period.
      top: highest frequency that counts [Hz].
    """

    def __init__(self, signals: Signals, n_period: int, top: float) -> None:
        frequency = fft.rfftfreq(n_period, 1.0 / signals.rate)
        used = slice(1, int(np.searchsorted(frequency, top)))

        def spectrum(values: Array) -> ComplexArray:
            mean = values.reshape(len(values), -1, n_period, 2).mean(axis=1)
            return np.asarray(fft.rfft(mean, axis=1)[:, used].swapaxes(1, 2))

        force = spectrum(signals.perturbation)
        power = np.sum(np.abs(force) ** 2, axis=(0, 1))
        # Lines without disturbance hold noise alone, which is why they are here.
        excited = np.flatnonzero(power > EXCITED_POWER * power.max())
        force[..., power <= EXCITED_POWER * power.max()] = 0.0
        applied = spectrum(signals.applied)
        super().__init__(signals, frequency[used], force, applied, spectrum(signals.displacement), excited)

    def _predicted(self, values: Array, trials: slice = ALL) -> ComplexArray:
        return applied(self._answer(values), self._driving[trials])

    def _slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        return self._quick_slopes(values, mixing)


class RecordLikelihood(Likelihood):
    """Likelihood of the whole record.

    Args:
      signals: of the whole record.
      top: highest frequency that counts [Hz].
      from_rest: whether the records start at rest, the handle being at zero.
    """

    def __init__(self, signals: Signals, top: float, *, from_rest: bool = True) -> None:
        self._rate = rate = signals.rate
        if not from_rest:
            d, applied = (part - part.mean(axis=1, keepdims=True) for part in (signals.perturbation, signals.applied))
            signals = signals._replace(perturbation=d, applied=applied)
        force = signals.perturbation.swapaxes(1, 2)
        self._judged, self._taper = judged_part(force.shape[-1], rate, from_rest=from_rest)
        n_samples = force.shape[-1]
        least, most = (round(each * rate) for each in MEMORY)
        self._n_padded = fft.next_fast_len(n_samples + min(max(n_samples, least), most), real=True)
        frequency = fft.rfftfreq(len(self._taper), 1.0 / rate)
        self._used = slice(1, int(np.searchsorted(frequency, top)))
        observed = self._spectrum(signals.displacement.swapaxes(1, 2))
        d, applied = self._spectrum(force), self._spectrum(signals.applied.swapaxes(1, 2))
        super().__init__(signals, frequency[self._used], d, applied, observed, slice(None), self._taper)
        fine = fft.rfftfreq(self._n_padded, 1.0 / rate)
        fine = fine[: np.searchsorted(fine, min(1.3 * top, 0.5 * rate))]
        self._model = TotalAdmittance(signals.body, fine, signals.environment)
        load = fft.rfft(force, self._n_padded, axis=-1)[..., : len(fine)]
        self._load = load * whitening(fine, rate)
        self._past: ComplexArray | None = None
        if not from_rest:
            before = np.arange(self._n_padded) - self._n_padded
            knots = -np.array(PAST[::-1]) * rate
            bumps = np.array([np.interp(before, knots, bump, left=0.0) for bump in np.eye(len(knots))[1:]])
            bumps = bumps[bumps.any(axis=1)]  # slow samples pass over the narrowest
            self._past = fft.rfft(bumps, self._n_padded, axis=-1)[:, : len(fine)] * whitening(fine, rate)
            ramp = np.linspace(-1.0, 1.0, force.shape[-1])
            self._drift = self._spectrum(np.stack([np.ones_like(ramp), ramp]))

    def densities(self, values: Array) -> tuple[Array, Array, Array, Array]:
        """One-sided spectral densities of displacement, residual and noise, the noise being as last weighed.

        Returns:
          Frequencies [Hz], (frequency,), and the densities, means over trials [m^2/Hz], (frequency, axis) each.
        """
        scale = 2.0 / (self._rate * np.sum(self._taper**2) * np.abs(self._filter) ** 2)[:, None]
        moved, left = (
            np.mean(np.abs(part) ** 2, axis=0).T for part in (self._observed, self._without_unknowns(values)[0])
        )
        whitener = np.moveaxis(self._white, -1, 0)
        noise = 2.0 * np.diagonal(np.linalg.inv(whitener.conj().swapaxes(1, 2) @ whitener), axis1=1, axis2=2).real
        return self._frequency, scale * moved, scale * left, scale * noise / self._dependence

    def _spectrum(self, values: Array) -> ComplexArray:
        """DFT of what is judged of records (..., time), faded out, at the frequencies that count."""
        # A copy, as a part of it would keep all frequencies.
        return fft.rfft(values[..., self._judged] * self._taper, axis=-1)[..., self._used].copy()

    def _cut(self, spectrum: ComplexArray) -> ComplexArray:
        """The same of signals (..., axis) that are given by their DFT over the padded time."""
        if spectrum.ndim > 2 and spectrum[..., 0].size * self._n_padded > LONGEST_SIGNALS:
            shape = (*spectrum.shape[1:-1], len(self._frequency))
            return np.fromiter(map(self._cut, spectrum), (complex, shape), len(spectrum))
        return self._spectrum(fft.irfft(spectrum, self._n_padded, axis=-1))

    def _predicted(self, values: Array, trials: slice = ALL) -> ComplexArray:
        return self._cut(applied(self._model(values), self._load[trials]))

    def _unknowns(self, values: Array) -> ComplexArray | None:
        if self._past is None:
            return None
        total = self._model(values)
        moved = [self._cut(total[:, axis] * self._past[:, None]) for axis in range(2)]
        offsets = self._drift[:, None, None] * np.eye(2)[..., None]
        return np.concatenate([*moved, offsets.reshape(-1, 2, offsets.shape[-1])])

    def _slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        for trial, driven in enumerate(self._model.driven_slopes(values, mixing, self._load)):
            yield slice(trial, trial + 1), self._cut(driven)[:, None]

    def _exact_slopes(self, values: Array, mixing: Array, residual: Array) -> Array:
        # Of <r, W C dP d>, with C for `_cut`, all but dP is the same for all parameters: C^T W^T r takes two transforms
        # of a trial, and the C dP d themselves as many of each parameter.
        white = complex_values(residual, self._observed.shape)
        errors = applied(self._white.conj().swapaxes(0, 1), white)
        return self._model.slopes_along(values, mixing, self._load, map(self._uncut, errors))

    def _uncut(self, spectrum: ComplexArray) -> ComplexArray:
        """The transpose of `_cut`, of inner products of which the real part counts, (axis, ...)."""
        n = len(self._taper)
        padded = np.zeros((*spectrum.shape[:-1], n // 2 + 1), dtype=complex)
        padded[..., self._used] = spectrum
        signals = np.zeros((*spectrum.shape[:-1], self._judged.stop))
        signals[..., self._judged] = fft.irfft(padded, n, axis=-1, overwrite_x=True) * self._taper
        whole = fft.rfft(signals, self._n_padded, axis=-1)[..., : self._load.shape[-1]] * (n / self._n_padded)
        whole[..., 0] *= 0.5
        return np.asarray(whole)
