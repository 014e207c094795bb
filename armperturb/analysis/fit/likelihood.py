"""How likely trials are under an arm model: in the frequency domain over one period, or over the whole record.

In both, x = P(theta) d + v, where x is the displacement that encoders and gauge together tell (`displacement`), d the
known disturbance, and v what the person and the instruments add: noise of an unknown, smooth spectrum, the same in all
trials of a condition. At each frequency the residual v = x - P d is then complex normal, and trials are the more likely
the less

    sum over trials and frequencies of v^H Phi_vv^-1 v    (Whittle 1953, Ark. Mat. 2).

Phi_vv is estimated from the residual itself. It has the arm's own resonance, and what smooths it must not: so it is the
spectrum of the hand force u = P^-1 v that would move the handle like that which is smoothed.

A finite record lets the strong low frequencies leak into the weak high ones. Both likelihoods therefore filter x and
P d with the same two zeros, so that what is left is nearly white, before they are transformed.

A record that begins amid the movement answers to what was before it as well. That is as if an unknown force had acted
on the handle before the first sample. The response to such a force (`PAST`), and an offset and a drift of the
displacement, are then least-squares fitted to each trial's residual and taken out of it, and out of the derivatives:
the likelihood is that of the rest. Arms of trials may differ, so that P differs from trial to trial.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import fft, linalg, stats

from armperturb.analysis.fit.frequency_bands import EXCITED_POWER, BandOfLack, Smoother, excited_bands, real_rows
from armperturb.analysis.fit.total_admittance import LONGEST_RUN, TotalAdmittance
from armperturb.arrays import Array, ComplexArray, Indices
from armperturb.environment import Environment
from armperturb.subject import Subject

CORNER = 1.5
"""From about this frequency on the displacement falls with inertia [Hz]: corner of the whitening filter."""

TAPER = 2.0
"""Length over which a record fades out before it is transformed [s]; one that begins at rest needs no fading in."""

PAST = (0.0, 0.02, 0.05, 0.09, 0.15, 0.23, 0.35, 0.55, 0.9, 1.5, 2.5)
"""Times before a record at which the unknown force before it may have its knots, linear between them [s]."""

MEMORY = 20.0
"""Time after which responses have surely died away [s]: by as much, at least, spectra of records are padded."""

START_OF_MOVING = 0.5
"""What is left out at the start of a record that begins amid the movement [s], which its filters spoil. From then on it
fades in over half of `TAPER`."""

LONGEST_SIGNALS = 2**21
"""Samples of signals that are transformed at once, for the sake of memory."""

ROUND_OFF = 1e-12
"""Noise cannot be less: amplitude over that of the strongest disturbance, power in one direction over all [-]."""


ALL = slice(None)


class Normal(NamedTuple):
    """Least squares at one point, with the noise as last weighed.

    Attributes:
      cost: sum of squares of the white residual, twice its complex square.
      slopes: derivative of the model times the residual, (trial, parameter): minus half the cost's gradient.
      informations: Fisher information of each trial, (trial, parameter, parameter).
    """

    cost: float
    slopes: Array
    informations: Array

    @property
    def slope(self) -> Array:
        """Of all trials together, (parameter,)."""
        return np.asarray(self.slopes.sum(axis=0))

    @property
    def information(self) -> Array:
        """Of all trials together, (parameter, parameter)."""
        return np.asarray(self.informations.sum(axis=0))


class Signals(NamedTuple):
    """What trials of one condition hold, and what the hand holds in them.

    Attributes:
      perturbation: d [N], (trial, time, axis).
      displacement: whitened, of the same time, (trial, time, axis).
      body: gives segments and posture.
      environment: what the hand holds.
      rate: of the samples [Hz].
    """

    perturbation: Array
    displacement: Array
    body: Subject
    environment: Environment
    rate: float


class LackOfFit(NamedTuple):
    """What is left in the residual that the disturbance explains.

    Attributes:
      chi2: of a further, free linear response in each band of excited frequencies [-].
      dof: real numbers in those responses, or what takes their place where noise is not stationary.
    """

    chi2: float
    dof: int

    @property
    def p_value(self) -> float:
        """Chance of so large a chi2 if the arm is right [-]."""
        return float(stats.chi2.sf(self.chi2, self.dof))


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


class Likelihood:
    """Likelihood of the trials of one condition; subclasses say how an arm answers the disturbance.

    Values are the parameters of an arm in the order of `arm_model.PARAMETERS`, (parameter,), or those of each trial's
    arm, (trial, parameter).

    Args:
      signals: of the trials.
      frequency: of the residual, evenly spaced [Hz], (frequency,).
      force: DFT of d at these frequencies, (trial, axis, frequency).
      observed: DFT of the whitened displacement, (trial, axis, frequency).
      answering: indices of the frequencies at which an arm answers at all; the others hold noise alone, and tell how
        strong it is.
    """

    def __init__(
        self,
        signals: Signals,
        frequency: Array,
        force: ComplexArray,
        observed: ComplexArray,
        answering: Indices | slice,
    ) -> None:
        self._total = TotalAdmittance(signals.body, frequency, signals.environment)
        # Where an arm answers: often everywhere.
        asked = frequency[answering]
        self._answer = (
            self._total if len(asked) == len(frequency) else TotalAdmittance(signals.body, asked, signals.environment)
        )
        self._frequency, self._filter = frequency, whitening(frequency, signals.rate)
        self._answering = answering
        self._force, self._observed = force[..., answering], observed[..., answering]
        self._quiet = np.ones(len(frequency), dtype=bool)
        self._quiet[answering] = False
        noise = observed[..., self._quiet]
        self._noise_power = np.einsum("taf,tbf->abf", noise, noise.conj()) / len(noise)
        index = np.arange(len(frequency))[answering]
        # Bands as places among those that answer.
        self._bands = [
            slice(int(np.searchsorted(index, run.start)), int(np.searchsorted(index, run.stop)))
            for run in excited_bands(frequency, force)
        ]
        self._smoother = Smoother(len(frequency), len(force), index)
        self._least = float(ROUND_OFF * np.abs(force).max()) ** 2
        self._white = np.zeros((2, 2, len(index)), dtype=complex)
        self._latest: tuple[bytes, ComplexArray] = b"", self._observed
        self._unknown: ComplexArray | None = None
        self._span: Array | None = None

    @property
    def n_trials(self) -> int:
        """How many trials."""
        return len(self._observed)

    @property
    def is_long(self) -> bool:
        """Whether derivatives that are not quick take long."""
        return len(self._frequency) > LONGEST_RUN

    def _predicted(self, values: Array, trials: slice = ALL) -> ComplexArray:
        """DFT of the whitened P d of some trials where the arm answers, (trial, axis, answer)."""
        raise NotImplementedError

    def _unknowns(self, values: Array) -> ComplexArray | None:
        """DFT of whitened displacements that a trial may have in any amount, (column, axis, answer); None of none."""
        return None

    def _slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        """Some trials and the derivatives of `_predicted` there, (free parameter, trial, axis, answer)."""
        raise NotImplementedError

    def _quick_slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        driven = self._answer.driven_slopes(values, mixing, self._force, self._filter[self._answering])
        for trial, derivatives in enumerate(driven):
            yield slice(trial, trial + 1), derivatives[:, None]

    def _residual(self, values: Array) -> ComplexArray:
        # A search asks three times in a row about the same arm: cost, weights, slope.
        key, residual = self._latest
        if key != values.tobytes():
            if values.ndim == 1:
                predicted = self._predicted(values)
            else:
                each = (self._predicted(arm, slice(at, at + 1)) for at, arm in enumerate(values))
                predicted = np.concatenate(list(each))
            residual = self._observed - predicted
            self._latest = values.tobytes(), residual
        return residual

    def weigh(self, values: Array) -> None:
        """Estimate the noise that is left by arms with these parameters; it holds until the next call."""
        mean = values if values.ndim == 1 else values.mean(axis=0)
        (a, b), (c, d) = self._total(mean) * self._filter
        to_force = np.stack([np.stack([d, -b]), np.stack([-c, a])]) / (a * d - b * c)
        answers = to_force[..., self._answering]
        self._unknown = self._unknowns(mean)
        force = _applied(answers, self._without_unknowns(values))
        power = np.empty(to_force.shape, dtype=complex)
        power[..., self._answering] = np.einsum("taf,tbf->abf", force, force.conj()) / len(force)
        quiet = to_force[..., self._quiet]
        half = np.einsum("acf,cdf->adf", quiet, self._noise_power)
        power[..., self._quiet] = np.einsum("adf,bdf->abf", half, quiet.conj())
        smooth = self._smoother(power.reshape(4, -1).T).reshape(-1, 2, 2)
        floor = self._least + ROUND_OFF * np.trace(smooth, axis1=1, axis2=2).real
        root = np.linalg.cholesky(smooth + floor[:, None, None] * np.eye(2))
        # Real and imaginary part of the residual have half its power each.
        self._white = np.moveaxis(np.sqrt(2.0) * np.linalg.solve(root, np.moveaxis(answers, -1, 0)), 0, -1)
        if self._unknown is not None:
            self._span = _orthonormal(_applied(self._white, self._unknown))

    def _without_unknowns(self, values: Array) -> ComplexArray:
        """The residual without what is unknown of each trial, as far as the noise is known yet."""
        residual = self._residual(values)
        if self._unknown is None:
            return residual
        white = self._white if self._white.any() else np.eye(2, dtype=complex)[..., None] + 0 * self._white
        columns, rows = real_rows(_applied(white, self._unknown)), real_rows(_applied(white, residual))
        amounts = np.asarray(linalg.lstsq(columns.T, rows.T, cond=1e-9)[0])
        return np.asarray(residual - np.einsum("ct,caf->taf", amounts, self._unknown))

    def _left(self, rows: Array) -> Array:
        """Rows without what the unknown displacements span."""
        return rows if self._span is None else rows - (rows @ self._span.T) @ self._span

    def _white_rows(self, values: Array) -> Array:
        """The white residual of each trial, real then imaginary parts, (trial, number)."""
        return self._left(real_rows(_applied(self._white, self._residual(values))))

    def objective(self, values: Array) -> float:
        """Minus twice the log likelihood, but for a constant, the noise being that which the arm leaves [-]."""
        self.weigh(values)
        (a, b), (c, d) = self._white
        return self.cost(values) - 4.0 * len(self._force) * float(np.sum(np.log(np.abs(a * d - b * c))))

    def cost(self, values: Array) -> float:
        """`Normal.cost` of arms."""
        return float(np.sum(self._white_rows(values) ** 2))

    def normal(self, values: Array, mixing: Array, *, quick: bool = False) -> Normal:
        """Least squares with respect to free parameters; mixing is (arm parameter, free parameter).

        Where the arms of trials differ, derivatives are those at their mean. Quick ones leave out how the response to a
        record's edges depends on the parameters.
        """
        residual = self._white_rows(values)
        mean = values if values.ndim == 1 else values.mean(axis=0)
        n_trials, n = len(residual), mixing.shape[1]
        slopes, informations = np.zeros((n_trials, n)), np.zeros((n_trials, n, n))
        for trials, derivatives in (self._quick_slopes if quick else self._slopes)(mean, mixing):
            white = _applied(self._white, derivatives)
            for place, trial in enumerate(range(n_trials)[trials]):
                rows = self._left(real_rows(white[:, place]))
                slopes[trial] = rows @ residual[trial]
                informations[trial] = rows @ rows.T
        return Normal(float(np.sum(residual**2)), slopes, informations)

    def lack_of_fit(self, values: Array) -> LackOfFit:
        """Whether the arms leave something that the disturbance explains, the noise being as last weighed."""
        bands = self.lack_by_band(values)
        return LackOfFit(sum(band.chi2 for band in bands), 8 * len(bands))

    def lack_by_band(self, values: Array) -> tuple[BandOfLack, ...]:
        """What the arms leave in each band of excited frequencies, the noise being as last weighed.

        The white residual is regressed on what a change of P, the same all over the band, would add. Each regression
        has as many real parameters as P has numbers: eight.
        """
        residual = _complex(self._white_rows(values), self._observed.shape)
        changes = np.einsum("aof,tif->tafoi", self._white * self._filter[self._answering], self._force)
        frequency, left = self._frequency[self._answering], []
        for band in self._bands:
            basis, _ = np.linalg.qr(changes[:, :, band].reshape(-1, 4))
            chi2 = float(np.sum(np.abs(basis.conj().T @ residual[..., band].ravel()) ** 2))
            left.append(BandOfLack(float(frequency[band][0]), float(frequency[band][-1]), chi2))
        return tuple(left)


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
        super().__init__(signals, frequency[used], force, spectrum(signals.displacement), excited)
        self._load = force[..., excited] * self._filter[excited]

    def _predicted(self, values: Array, trials: slice = ALL) -> ComplexArray:
        return _applied(self._answer(values), self._load[trials])

    def _slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        for trial, derivatives in enumerate(self._answer.driven_slopes(values, mixing, self._load)):
            yield slice(trial, trial + 1), derivatives[:, None]


class RecordLikelihood(Likelihood):
    """Likelihood of the whole record.

    Args:
      signals: of the whole record.
      top: highest frequency that counts [Hz].
      from_rest: whether the records start at rest, the handle being at zero.
    """

    def __init__(self, signals: Signals, top: float, *, from_rest: bool = True) -> None:
        self._rate = rate = signals.rate
        force = signals.perturbation.swapaxes(1, 2)
        n_taper = round(TAPER * rate)
        self._judged = slice(0 if from_rest else round(START_OF_MOVING * rate), force.shape[-1])
        n_samples = force.shape[-1]
        self._n_padded = fft.next_fast_len(n_samples + max(n_samples, round(MEMORY * rate)), real=True)
        fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(n_taper) + 0.5) / n_taper)
        self._taper = np.ones(self._judged.stop - self._judged.start)
        self._taper[-n_taper:] = fade[::-1]
        if not from_rest:
            self._taper[: len(fade[::2])] *= fade[::2]
        frequency = fft.rfftfreq(len(self._taper), 1.0 / rate)
        self._used = slice(1, int(np.searchsorted(frequency, top)))
        observed = self._spectrum(signals.displacement.swapaxes(1, 2))
        super().__init__(signals, frequency[self._used], self._spectrum(force), observed, slice(None))
        fine = fft.rfftfreq(self._n_padded, 1.0 / rate)
        fine = fine[: np.searchsorted(fine, min(1.3 * top, 0.5 * rate))]
        # A model cannot be asked at zero frequency, where powers of it stand in denominators.
        self._model = TotalAdmittance(signals.body, np.maximum(fine, 1e-6), signals.environment)
        load = fft.rfft(force, self._n_padded, axis=-1)[..., : len(fine)]
        self._load = load * whitening(fine, rate)
        self._past: ComplexArray | None = None
        if not from_rest:
            before = np.arange(self._n_padded) - self._n_padded
            knots = -np.array(PAST[::-1]) * rate
            bumps = np.array([np.interp(before, knots, bump, left=0.0) for bump in np.eye(len(knots))[1:]])
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
            np.mean(np.abs(part) ** 2, axis=0).T for part in (self._observed, self._without_unknowns(values))
        )
        whitener = np.moveaxis(self._white, -1, 0)
        noise = 2.0 * np.diagonal(np.linalg.inv(whitener.conj().swapaxes(1, 2) @ whitener), axis1=1, axis2=2).real
        return self._frequency, scale * moved, scale * left, scale * noise

    def _spectrum(self, values: Array) -> ComplexArray:
        """DFT of what is judged of records (..., time), faded out, at the frequencies that count."""
        return np.asarray(fft.rfft(values[..., self._judged] * self._taper, axis=-1)[..., self._used])

    def _cut(self, spectrum: ComplexArray) -> ComplexArray:
        """The same of signals (..., axis) that are given by their DFT over the padded time."""
        if spectrum.ndim > 2 and spectrum[..., 0].size * self._n_padded > LONGEST_SIGNALS:
            return np.array([self._cut(part) for part in spectrum])
        return self._spectrum(fft.irfft(spectrum, self._n_padded, axis=-1))

    def _predicted(self, values: Array, trials: slice = ALL) -> ComplexArray:
        return self._cut(_applied(self._model(values), self._load[trials]))

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


def _applied(matrix: ComplexArray, values: ComplexArray) -> ComplexArray:
    """Matrices (axis, axis, frequency) times vectors (..., axis, frequency)."""
    first, second = values[..., 0, :], values[..., 1, :]
    return np.stack(
        [matrix[0, 0] * first + matrix[0, 1] * second, matrix[1, 0] * first + matrix[1, 1] * second], axis=-2
    )


def _complex(rows: Array, shape: tuple[int, ...]) -> ComplexArray:
    """What `real_rows` was made from."""
    real, imaginary = np.split(rows, 2, axis=-1)
    return np.asarray((real + 1j * imaginary).reshape(shape))


def _orthonormal(values: ComplexArray) -> Array:
    """Orthonormal rows that span the rows of what is unknown, (at most column, number)."""
    rows = real_rows(values)
    _, size, basis = np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True), full_matrices=False)
    return np.asarray(basis[size > 1e-9 * size[0]])
