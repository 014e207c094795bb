"""How likely trials are under an arm model: in the frequency domain over one period, or over the whole record.

In both, x = P(theta) d + v, where x is the displacement that encoders and gauge together tell (`displacement`), d the known
disturbance, and v what the person and the instruments add: noise of an unknown, smooth spectrum, the same in all trials of
a condition. At each frequency the residual v = x - P d is then complex normal, and trials are the more likely the less

    sum over trials and frequencies of v^H Phi_vv^-1 v    (Whittle).

Phi_vv is estimated from the residual itself. It has the arm's own resonance, and what smooths it must not: so it is the
spectrum of the hand force u = P^-1 v that would move the handle like that which is smoothed.

A finite record lets the strong low frequencies leak into the weak high ones. Both likelihoods therefore filter x and P d
with the same two poles less, so that what is left is nearly white, before they are transformed.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft, stats

from armperturb.analysis.arm_model import LinearArm
from armperturb.environment import Environment
from armperturb.subject import Subject

Array = NDArray[np.float64]
Response = NDArray[np.complex128]

CORNER = 1.5
"""From about this frequency on the displacement falls with inertia [Hz]: corner of the whitening filter."""

N_SMOOTH = 40
"""Trials times frequencies over which the spectrum of the noise is averaged at least."""

RELATIVE_WIDTH = 0.05
"""Half the band over which the spectrum of the noise is averaged at least, over its frequency [-]."""

TAPER = 2.0
"""Length over which a record fades out before it is transformed [s]; it begins at rest and needs no fading in."""

EXCITED = 1e-3
"""Share of the strongest frequency's power from which on a frequency counts as excited."""


class Normal(NamedTuple):
    """Least squares at one point, with the noise as last weighed.

    Attributes:
      cost: sum of squares of the white residual, twice its complex square.
      slope: derivative of the model times the residual, (parameter,): minus half the cost's gradient.
      information: Fisher information, (parameter, parameter).
    """

    cost: float
    slope: Array
    information: Array


class LackOfFit(NamedTuple):
    """What is left in the residual that the disturbance explains.

    Attributes:
      chi2: of a further, free linear response in each band of excited frequencies [-].
      dof: real numbers in those responses.
    """

    chi2: float
    dof: int

    @property
    def p_value(self) -> float:
        """Chance of so large a chi2 if the arm is right [-]."""
        return float(stats.chi2.sf(self.chi2, self.dof))


class Likelihood(Protocol):
    """Likelihood of the trials of one condition. Parameters of an arm are in the order of `arm_model.PARAMETERS`."""

    def weigh(self, values: Array) -> None:
        """Estimate the noise that is left by an arm with these parameters; it holds until the next call."""

    def objective(self, values: Array) -> float:
        """Minus twice the logarithm of the likelihood, but for a constant, the noise being that which the arm leaves."""

    def cost(self, values: Array) -> float:
        """`Normal.cost` of an arm."""

    def normal(self, values: Array, mixing: Array) -> Normal:
        """Least squares with respect to free parameters; mixing is (arm parameter, free parameter)."""

    def lack_of_fit(self, values: Array) -> LackOfFit:
        """Whether the arm leaves something that the disturbance explains."""


def whitening(frequency: Array, rate: float) -> Response:
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


class _Whittle:
    """What both likelihoods share: residuals at evenly spaced frequencies, their noise, and what follows.

    Args:
      body: gives segment lengths, posture and damping of the activation filter.
      environment: what the hand holds.
      frequency: of the residual [Hz], (frequency,).
      rate: of the samples [Hz].
      force: DFT of d at these frequencies, (trial, axis, frequency).
      observed: DFT of the whitened displacement, (trial, axis, frequency).
    """

    def __init__(
        self,
        body: Subject,
        environment: Environment,
        frequency: Array,
        rate: float,
        force: Response,
        observed: Response,
    ) -> None:
        self._arm, self._environment = LinearArm(body, frequency), environment
        self._filter = whitening(frequency, rate)
        self._force, self._observed = force, observed
        self._white = np.zeros((2, 2, len(frequency)), dtype=complex)

    def _predicted(self, values: Array) -> Response:
        """DFT of the whitened P d, (trial, axis, frequency)."""
        raise NotImplementedError

    def _slopes(self, values: Array, mixing: Array) -> Iterator[Response]:
        """Per trial the derivatives of `_predicted` by free parameters, (parameter, axis, frequency)."""
        raise NotImplementedError

    def weigh(self, values: Array) -> None:
        """Estimate the noise that is left by an arm with these parameters; it holds until the next call."""
        total = self._arm.total_admittance(values, self._environment) * self._filter[:, None, None]
        to_force = np.moveaxis(np.linalg.inv(total), 0, -1)
        force = _applied(to_force, self._observed - self._predicted(values))
        root = np.linalg.inv(np.linalg.cholesky(np.moveaxis(_smoothed_power(force), -1, 0)))
        # Real and imaginary part of the residual have half its power each.
        self._white = np.sqrt(2.0) * np.einsum("fab,bcf->acf", root, to_force)

    def objective(self, values: Array) -> float:
        """Minus twice the logarithm of the likelihood, but for a constant, the noise being that which the arm leaves."""
        self.weigh(values)
        _, logarithm = np.linalg.slogdet(np.moveaxis(self._white, -1, 0))
        return self.cost(values) - 4.0 * len(self._force) * float(np.sum(logarithm))

    def cost(self, values: Array) -> float:
        """`Normal.cost` of an arm."""
        return float(np.sum(np.abs(_applied(self._white, self._observed - self._predicted(values))) ** 2))

    def normal(self, values: Array, mixing: Array) -> Normal:
        """Least squares with respect to free parameters; mixing is (arm parameter, free parameter)."""
        residual = _applied(self._white, self._observed - self._predicted(values))
        n = mixing.shape[1]
        slope, information = np.zeros(n), np.zeros((n, n))
        for left, of_trial in zip(residual, self._slopes(values, mixing), strict=True):
            white = _real(_applied(self._white, of_trial).reshape(n, -1))
            slope += white @ _real(left.ravel())
            information += white @ white.T
        return Normal(float(np.sum(np.abs(residual) ** 2)), slope, information)

    def lack_of_fit(self, values: Array) -> LackOfFit:
        """Whether the arm leaves something that the disturbance explains.

        In each band of excited frequencies the white residual is regressed on what a change of P, the same all over the
        band, would add. Each regression has as many real parameters as P has numbers: eight.
        """
        residual = _applied(self._white, self._observed - self._predicted(values))
        chi2, bands = 0.0, _bands(self._arm.frequency, self._force)
        for band in bands:
            columns = []
            for output, input_ in np.ndindex(2, 2):
                change = np.zeros_like(self._force[..., band])
                change[:, output] = self._force[:, input_, band] * self._filter[band]
                columns.append(_applied(self._white[..., band], change).ravel())
            basis, _ = np.linalg.qr(np.stack(columns, axis=1))
            chi2 += float(np.sum(np.abs(basis.conj().T @ residual[..., band].ravel()) ** 2))
        return LackOfFit(chi2, 8 * len(bands))


class PeriodLikelihood(_Whittle):
    """Likelihood of the mean of whole periods, in which the response to the disturbance is periodic.

    Args:
      perturbation: d over whole periods [N], (trial, time, axis).
      displacement: whitened, of the same time, (trial, time, axis).
      body: gives segment lengths, posture and damping of the activation filter.
      environment: what the hand holds.
      rate: of the samples [Hz].
      n_period: samples of a period.
      top: highest frequency that counts [Hz].
    """

    def __init__(
        self,
        perturbation: Array,
        displacement: Array,
        body: Subject,
        environment: Environment,
        rate: float,
        n_period: int,
        top: float,
    ) -> None:
        frequency = fft.rfftfreq(n_period, 1.0 / rate)
        used = slice(1, int(np.searchsorted(frequency, top)))

        def spectrum(values: Array) -> Response:
            mean = values.reshape(len(values), -1, n_period, 2).mean(axis=1)
            return np.asarray(fft.rfft(mean, axis=1)[:, used].swapaxes(1, 2))

        force = spectrum(perturbation)
        power = np.sum(np.abs(force) ** 2, axis=(0, 1))
        # Lines without disturbance hold noise alone, which is why they are here.
        self._excited = np.flatnonzero(power > EXCITED * power.max())
        force[..., power <= EXCITED * power.max()] = 0.0
        super().__init__(body, environment, frequency[used], rate, force, spectrum(displacement))
        self._model = LinearArm(body, frequency[used][self._excited])
        self._load = force[..., self._excited] * self._filter[self._excited]

    def _predicted(self, values: Array) -> Response:
        total = np.moveaxis(self._model.total_admittance(values, self._environment), 0, -1)
        predicted = np.zeros_like(self._observed)
        predicted[..., self._excited] = _applied(total, self._load)
        return predicted

    def _slopes(self, values: Array, mixing: Array) -> Iterator[Response]:
        gradient = _mixed(self._model.total_and_gradient(values, self._environment)[1], mixing)
        for load in self._load:
            slopes = np.zeros((*gradient.shape[:2], self._observed.shape[-1]), dtype=complex)
            slopes[..., self._excited] = gradient[:, :, 0] * load[0] + gradient[:, :, 1] * load[1]
            yield slopes


class RecordLikelihood(_Whittle):
    """Likelihood of the whole record, from rest at its first sample.

    Args:
      perturbation: d [N], (trial, time, axis).
      displacement: whitened, (trial, time, axis).
      body: gives segment lengths, posture and damping of the activation filter.
      environment: what the hand holds.
      rate: of the samples [Hz].
      top: highest frequency that counts [Hz].
      settle: time within which the arm's response dies away [s].
    """

    def __init__(
        self,
        perturbation: Array,
        displacement: Array,
        body: Subject,
        environment: Environment,
        rate: float,
        top: float,
        settle: float,
    ) -> None:
        n_samples, n_taper = perturbation.shape[1], round(TAPER * rate)
        self._n_samples = n_samples
        self._n_padded = fft.next_fast_len(n_samples + round(settle * rate), real=True)
        self._taper = np.ones(n_samples)
        self._taper[-n_taper:] = 0.5 + 0.5 * np.cos(np.pi * (np.arange(n_taper) + 0.5) / n_taper)
        frequency = fft.rfftfreq(n_samples, 1.0 / rate)
        self._used = slice(1, int(np.searchsorted(frequency, top)))
        super().__init__(
            body,
            environment,
            frequency[self._used],
            rate,
            self._spectrum(perturbation.swapaxes(1, 2)),
            self._spectrum(displacement.swapaxes(1, 2)),
        )
        fine = fft.rfftfreq(self._n_padded, 1.0 / rate)
        fine = fine[: np.searchsorted(fine, min(1.3 * top, 0.5 * rate))]
        # A model cannot be asked at zero frequency, where powers of it stand in denominators.
        self._model = LinearArm(body, np.maximum(fine, 1e-6))
        load = fft.rfft(perturbation.swapaxes(1, 2), self._n_padded, axis=-1)[..., : len(fine)]
        self._load = load * whitening(fine, rate)

    def _spectrum(self, values: Array) -> Response:
        """DFT of records (..., time), faded out, at the frequencies that count."""
        return np.asarray(fft.rfft(values * self._taper, axis=-1)[..., self._used])

    def _cut(self, spectrum: Response) -> Response:
        """The same of signals that are given by their DFT over the padded time."""
        return self._spectrum(fft.irfft(spectrum, self._n_padded, axis=-1)[..., : self._n_samples])

    def _predicted(self, values: Array) -> Response:
        total = np.moveaxis(self._model.total_admittance(values, self._environment), 0, -1)
        return self._cut(_applied(total, self._load))

    def _slopes(self, values: Array, mixing: Array) -> Iterator[Response]:
        gradient = _mixed(self._model.total_and_gradient(values, self._environment)[1], mixing)
        for load in self._load:
            yield self._cut(gradient[:, :, 0] * load[0] + gradient[:, :, 1] * load[1])


def _applied(matrix: Response, values: Response) -> Response:
    """Matrices (axis, axis, frequency) times vectors (..., axis, frequency)."""
    first, second = values[..., 0, :], values[..., 1, :]
    return np.stack(
        [matrix[0, 0] * first + matrix[0, 1] * second, matrix[1, 0] * first + matrix[1, 1] * second], axis=-2
    )


def _mixed(gradient: Response, mixing: Array) -> Response:
    """Derivatives by the free parameters, (parameter, output, input, frequency)."""
    return np.tensordot(mixing.T, gradient.transpose(3, 1, 2, 0), 1)


def _real(values: Response) -> Array:
    return np.concatenate([values.real, values.imag], axis=-1)


def _smoothed_power(values: Response) -> Response:
    """Mean over trials and neighbouring frequencies of v v^H for v (trial, axis, frequency), (axis, axis, frequency)."""
    n_trials, _, n = values.shape
    power = np.einsum("taf,tbf->abf", values, values.conj()) / n_trials
    total = np.concatenate([np.zeros((2, 2, 1)), np.cumsum(power, axis=-1)], axis=-1)
    index = np.arange(n)
    half = np.maximum(int(np.ceil(N_SMOOTH / n_trials / 2)), (RELATIVE_WIDTH * index).astype(int))
    first, last = np.maximum(index - half, 0), np.minimum(index + half + 1, n)
    return np.asarray((total[..., last] - total[..., first]) / (last - first))


def _bands(frequency: Array, force: Response) -> list[slice]:
    """Runs of excited frequencies, split where they are wider than a third of an octave."""
    power = np.mean(np.abs(force) ** 2, axis=(0, 1))
    excited = np.flatnonzero(power > EXCITED * power.max())
    runs, first = [], excited[0]
    for before, now in itertools.pairwise(excited):
        if now - before > 2 or frequency[now] > 2 ** (1 / 3) * frequency[first] + 4 * frequency[0]:
            runs.append(slice(int(first), int(before) + 1))
            first = now
    runs.append(slice(int(first), int(excited[-1]) + 1))
    # Four complex numbers are estimated in each.
    return [run for run in runs if 2 * len(force) * (run.stop - run.start) >= 8]
