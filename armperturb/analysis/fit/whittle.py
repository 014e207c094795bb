"""How likely signals are under a model that leaves noise of an unknown, smooth spectrum (Whittle 1953, Ark. Mat. 2).

At each frequency the residual v of several outputs is complex normal, and trials are the more likely the less

    sum over trials and frequencies of v^H Phi_vv^-1 v.

Phi_vv is estimated from the residual itself, smoothed over frequency. What is smoothed is F v, where the filters F take
out what the model knows of the shape of the noise. What a trial may hold in any amount is least-squares fitted to its
residual and taken out of it, and out of the derivatives.

Three things make noise seem weaker, or trials tell more, than is so. A taper of weights w over N samples makes nearby
frequencies dependent: they tell as much as independent ones with N sum(w^4) / sum(w^2)^2 times the noise. What is
fitted to each trial takes part of the noise with it: the share that its leverage says. And an average over m numbers of
each of n outputs fits the noise of the very trials that it weighs: estimates then vary by (m / (m - n))^2 more than the
inverse of the information, one factor for that inverse's mean and one for what errors of the weights add.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import stats

from armperturb.analysis.fit.frequency_bands import BandOfLack, Smoother, excited_bands
from armperturb.analysis.fit.frequency_rows import (
    applied,
    applied_rows,
    complex_values,
    least_squares_rows,
    orthonormal,
    whitened,
)
from armperturb.analysis.fit.total_admittance import LONGEST_RUN, SHORTER_RUN
from armperturb.arrays import Array, ComplexArray, Indices

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


class LackOfFit(NamedTuple):
    """What is left in the residual that the input explains.

    Attributes:
      chi2: of a further, free linear response in each band of excited frequencies [-].
      dof: real numbers in those responses, or what takes their place where noise is not stationary.
    """

    chi2: float
    dof: int

    @property
    def p_value(self) -> float:
        """Chance of so large a chi2 if the model is right [-]."""
        return float(stats.chi2.sf(self.chi2, self.dof))


class Whittle:
    """Likelihood of the trials of one condition; subclasses say how a model answers the input.

    Values are the model's parameters, (parameter,), or those of each trial, (trial, parameter).

    Args:
      frequency: of the residual, evenly spaced [Hz], (frequency,).
      force: DFT of the input at these frequencies, (trial, input, frequency).
      observed: DFT of what the model is to explain, (trial, output, frequency).
      answering: indices of the frequencies at which a model answers at all; the others hold noise alone, and tell how
        strong it is.
      scale: of the model's response where a lack of it is looked for, (frequency,).
      least: power that smoothed noise has at least.
      cause: DFT of what a lack of fit is looked for with, like force; None for the force. It must not depend on the
        noise.
      taper: window of what is transformed, (time,); None of one without. It makes neighbouring frequencies tell less
        than independent ones would.
    """

    def __init__(
        self,
        frequency: Array,
        force: ComplexArray,
        observed: ComplexArray,
        answering: Indices | slice,
        *,
        scale: ComplexArray,
        least: float,
        cause: ComplexArray | None = None,
        taper: Array | None = None,
    ) -> None:
        self._frequency, self._scale = frequency, scale[answering]
        self._answering = answering
        self._force, self._observed = force[..., answering], observed[..., answering]
        self._cause = self._force if cause is None else cause[..., answering]
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
        self._least = least
        self._dependence = 1.0 if taper is None else len(taper) * float(np.sum(taper**4) / np.sum(taper**2) ** 2)
        self._n_outputs = observed.shape[1]
        self._white = np.zeros((self._n_outputs, self._n_outputs, len(index)), dtype=complex)
        self._latest: tuple[bytes, ComplexArray] = b"", self._observed
        self._weighed_at: tuple[tuple[int, ...], bytes] | None = None
        self._unknown: ComplexArray | None = None
        self._unknown_at: bytes | None = None
        self._span: Array | None = None

    @property
    def n_trials(self) -> int:
        """How many trials."""
        return len(self._observed)

    @property
    def is_long(self) -> bool:
        """Whether derivatives that are not quick take long."""
        return len(self._frequency) > LONGEST_RUN

    @property
    def sure(self) -> Array:
        """By how much each number of a white row tells less, as the noise is estimated [-], (number,)."""
        averaged = self._smoother.count * len(self._force)
        return np.tile(np.maximum(1.0 - self._n_outputs / averaged, 0.0), 2 * self._n_outputs)

    def _predicted(self, values: Array, trials: slice = ALL) -> ComplexArray:
        """DFT of what the model says of some trials where it answers, (trial, output, answer)."""
        raise NotImplementedError

    def _unknowns(self, values: Array) -> ComplexArray | None:
        """DFT of outputs that a trial may have in any amount, (column, output, answer); None of none."""
        return None

    def _slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        """Some trials and the derivatives of `_predicted` there, (free parameter, trial, output, answer)."""
        raise NotImplementedError

    def _quick_slopes(self, values: Array, mixing: Array) -> Iterator[tuple[slice, ComplexArray]]:
        """Derivatives that may leave out what takes long; see `normal`."""
        return self._slopes(values, mixing)

    def _exact_slopes(self, values: Array, mixing: Array, residual: Array) -> Array | None:
        """`Normal.slopes` of long records, from which the derivatives need not be known; None where they are quick.

        Args:
          values: of the model, (parameter,).
          mixing: (parameter, free parameter).
          residual: `_white_rows`, (trial, number).
        """
        return None

    def _to_smooth(self, values: Array) -> ComplexArray:
        """Filters that make the residual of a model nearly white, (output, output, frequency)."""
        raise NotImplementedError

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
        """Estimate the noise that is left by models with these parameters; it holds until the next call."""
        # A search weighs where another one began or ended: without unknowns that says nothing new.
        if self._unknown is None and self._weighed_at == (values.shape, values.tobytes()):
            return
        mean = values if values.ndim == 1 else values.mean(axis=0)
        to_force, n = self._to_smooth(mean), self._n_outputs
        answers = to_force[..., self._answering]
        if self._unknown_at != mean.tobytes():
            self._unknown, self._unknown_at = self._unknowns(mean), mean.tobytes()
        residual, leverage = self._without_unknowns(values)
        force = applied(answers, residual)
        power = np.empty(to_force.shape, dtype=complex)
        power[..., self._answering] = np.einsum("taf,tbf->abf", force, force.conj()) / len(force)
        quiet = to_force[..., self._quiet]
        half = np.einsum("acf,cdf->adf", quiet, self._noise_power)
        power[..., self._quiet] = np.einsum("adf,bdf->abf", half, quiet.conj())
        # Real numbers in place of Hermitian matrices: half of these say nothing new.
        diagonal, below = np.diag_indices(n), np.tril_indices(n, -1)
        numbers = np.concatenate([power[diagonal].real, power[below].real, power[below].imag])
        smoothed = self._dependence * self._smoother(numbers.T).T
        if leverage is not None:
            left = np.ones(len(self._frequency))
            left[self._answering] -= leverage
            smoothed /= self._smoother(left)
        smoothed[:n] += self._least + ROUND_OFF * smoothed[:n].sum(axis=0)
        covariance = np.zeros((n, n, smoothed.shape[1]), dtype=complex)
        real, imaginary = np.split(smoothed[n:], 2)
        covariance[diagonal], covariance[below] = smoothed[:n], real + 1j * imaginary
        # Real and imaginary part of the residual have half its power each.
        self._white = np.sqrt(2.0) * whitened(covariance, answers)
        if self._unknown is not None:
            self._span = orthonormal(applied_rows(self._white, self._unknown))
        self._weighed_at = values.shape, values.tobytes()

    def _without_unknowns(self, values: Array) -> tuple[ComplexArray, Array | None]:
        """The residual without what is unknown of each trial, as far as the noise is known yet, and its share in that.

        The share is of the noise at each frequency where the model answers [-]; None if nothing is unknown.
        """
        residual = self._residual(values)
        if self._unknown is None:
            return residual, None
        eye = np.eye(self._n_outputs, dtype=complex)
        white = self._white if self._white.any() else eye[..., None] + 0 * self._white
        columns, rows = applied_rows(white, self._unknown), applied_rows(white, residual)
        amounts, basis = least_squares_rows(columns, rows)
        share = np.mean(np.sum(basis**2, axis=0).reshape(2 * self._n_outputs, -1), axis=0)
        return residual - np.tensordot(amounts, self._unknown, 1), np.asarray(share)

    def _left(self, rows: Array) -> Array:
        """Rows without what the unknown outputs span."""
        return rows if self._span is None else rows - (rows @ self._span.T) @ self._span

    def _runs_of_rows(self, derivatives: ComplexArray) -> Iterator[tuple[Array, slice]]:
        """White rows of derivatives (..., output, answer), and of which answers; of long records part by part.

        Inner products of the parts add up to those of the whole, which would take much memory.
        """
        n = derivatives.shape[-1]
        if self._span is not None or n <= LONGEST_RUN:
            yield self._left(applied_rows(self._white, derivatives)), ALL
            return
        for start in range(0, n, SHORTER_RUN):
            run = slice(start, start + SHORTER_RUN)
            yield applied_rows(self._white[..., run], derivatives[..., run]), run

    def _in_run(self, row: Array, run: slice) -> Array:
        """What a row, (number,), has in a run of answers."""
        return row.reshape(2 * self._n_outputs, -1)[:, run].ravel()

    def _white_rows(self, values: Array) -> Array:
        """The white residual of each trial, real then imaginary parts, (trial, number)."""
        return self._left(applied_rows(self._white, self._residual(values)))

    def objective(self, values: Array) -> float:
        """Minus twice the log likelihood, but for a constant, the noise being that which the model leaves [-]."""
        self.weigh(values)
        size = float(np.sum(np.log(np.abs(_determinant(self._white)))))
        return self.cost(values) - 4.0 * len(self._force) * size

    def cost(self, values: Array) -> float:
        """`Normal.cost` of models."""
        return float(np.sum(self._white_rows(values) ** 2))

    def normal(self, values: Array, mixing: Array, *, quick: bool = False) -> Normal:
        """Least squares with respect to free parameters; mixing is (parameter, free parameter).

        Where the parameters of trials differ, derivatives are those at their mean. Quick ones leave out how the
        response to a record's edges depends on the parameters; of long records the information does in any case.
        """
        residual = self._white_rows(values)
        mean = values if values.ndim == 1 else values.mean(axis=0)
        n_trials, n = len(residual), mixing.shape[1]
        slopes, informations = np.zeros((n_trials, n)), np.zeros((n_trials, n, n))
        exact = None if quick or not self.is_long else self._exact_slopes(mean, mixing, residual)
        for trials, derivatives in (self._slopes if not quick and exact is None else self._quick_slopes)(mean, mixing):
            for place, trial in enumerate(range(n_trials)[trials]):
                for rows, run in self._runs_of_rows(derivatives[:, place]):
                    slopes[trial] += rows @ self._in_run(residual[trial], run)
                    informations[trial] += rows @ rows.T
        return Normal(float(np.sum(residual**2)), slopes if exact is None else exact, informations)

    def step_normal(self, values: Array, mixing: Array) -> Normal:
        """As a quick `normal` of all trials together, (1, parameter), for a step of a search.

        The information may be that of a residual from which nothing is taken out.
        """
        normal = self.normal(values, mixing, quick=True)
        return Normal(normal.cost, normal.slope[None], normal.information[None])

    def informations(self, values: Array, mixing: Array) -> tuple[Array, Array]:
        """Fisher information of all trials, and what of it is left as the noise is estimated, (parameter, parameter).

        The latter is the inverse covariance of estimates, the former what `normal` says. Arguments are as there, and
        derivatives are quick.
        """
        mean = values if values.ndim == 1 else values.mean(axis=0)
        known, left, sure = *np.zeros((2, mixing.shape[1], mixing.shape[1])), self.sure
        for _, derivatives in self._quick_slopes(mean, mixing):
            for each in np.moveaxis(derivatives, 1, 0):
                for rows, run in self._runs_of_rows(each):
                    known += rows @ rows.T
                    rows *= self._in_run(sure, run)
                    left += rows @ rows.T
        return known, left

    def errors_by(self, values: Array, mixing: Array, changes: ComplexArray) -> Array:
        """What changes of the outputs do to `Normal.slope`, (free parameter, change).

        Args:
          values: of the model.
          mixing: (parameter, free parameter).
          changes: of what is observed, less of what is predicted, (change, trial, output, answer).
        """
        mean = values if values.ndim == 1 else values.mean(axis=0)
        slopes = np.zeros((mixing.shape[1], len(changes)))
        rows = self._left(applied_rows(self._white, changes))
        for trials, derivatives in self._quick_slopes(mean, mixing):
            for place, trial in enumerate(range(self.n_trials)[trials]):
                for of_run, run in self._runs_of_rows(derivatives[:, place]):
                    slopes += of_run @ np.array([self._in_run(each, run) for each in rows[:, trial]]).T
        return slopes

    def lack_of_fit(self, values: Array) -> LackOfFit:
        """Whether models leave something that the input explains, the noise being as last weighed."""
        bands = self.lack_by_band(values)
        return LackOfFit(sum(band.chi2 for band in bands), 2 * self._n_outputs * self._force.shape[1] * len(bands))

    def lack_by_band(self, values: Array) -> tuple[BandOfLack, ...]:
        """What models leave in each band of excited frequencies, the noise being as last weighed.

        The white residual is regressed on what a change of the response, the same all over the band, would add. Each
        regression has as many real parameters as the response has numbers: eight of two inputs and outputs.
        """
        residual = complex_values(self._white_rows(values), self._observed.shape)
        changes = np.einsum("aof,tif->tafoi", self._white * self._scale, self._cause)
        frequency, left = self._frequency[self._answering], []
        for band in self._bands:
            change = changes[:, :, band]
            basis, _ = np.linalg.qr(change.reshape(-1, change.shape[-2] * change.shape[-1]))
            chi2 = float(np.sum(np.abs(basis.conj().T @ residual[..., band].ravel()) ** 2))
            left.append(BandOfLack(float(frequency[band][0]), float(frequency[band][-1]), chi2))
        return tuple(left)


def _determinant(matrix: ComplexArray) -> ComplexArray:
    """Of matrices (row, row, frequency)."""
    if len(matrix) == 2:
        (a, b), (c, d) = matrix
        return np.asarray(a * d - b * c)
    return np.asarray(np.linalg.det(np.moveaxis(matrix, -1, 0)))
