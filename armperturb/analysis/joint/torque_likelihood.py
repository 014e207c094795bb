"""Likelihood of a joint's torque with coloured noise, offset and drift of each trial taken out: what models share.

The residual u = torque - model is complex normal at each frequency with a smooth, unknown spectrum (Whittle 1953). That
is estimated from the residual as in `analysis.fit.whittle`, or it is taken to be white.
"""

from typing import NamedTuple

import numpy as np
from scipy import fft, signal

from armperturb.analysis.fit.frequency_rows import applied_rows, orthonormal
from armperturb.analysis.fit.whittle import Whittle
from armperturb.analysis.joint.signals import TOP, JointSignals, time_blocks
from armperturb.arrays import Array, ComplexArray

LOWEST = 0.05
"""Lowest frequency that counts [Hz]: below, people drift."""

SHARE = 0.85
"""Highest frequency that counts, over that of the signals, or over `TOP` where they hold more [-]."""

ROUNDING = 1e-9
"""Length of the DFT of an offset below which it is rounding [-]: without a taper it is at no frequency that counts."""


def band_of(signals: JointSignals) -> tuple[float, float]:
    """Lowest and highest frequency of signals that count [Hz]."""
    return LOWEST, SHARE * min(signals.top, TOP)


class BlockScore(NamedTuple):
    """What a block of time says of the parameters.

    Attributes:
      score: derivative of the model times the white residual, (parameter,).
      information: Fisher information, (parameter, parameter).
    """

    score: Array
    information: Array


class TorqueLikelihood(Whittle):
    """Likelihood of one output, the torque at the recorded movement; subclasses say what a model makes of that.

    Args:
      signals: of the trials.
      tapered: length over which the ends of each trial are tapered, both together [s].
      centred: whether trials share the torque of each instant in any amount.
      white: whether the noise is taken to be white.
    """

    def __init__(
        self, signals: JointSignals, *, tapered: float = 1.0, centred: bool = False, white: bool = False
    ) -> None:
        self.signals, self._centred, self._is_white = signals, centred, white
        used = signals.used
        n = used.stop - used.start
        self._taper = signal.windows.tukey(n, min(1.0, tapered * signals.rate / n), sym=False)
        frequency = fft.rfftfreq(n, 1.0 / signals.rate)
        lowest, highest = band_of(signals)
        self._lines = (frequency >= lowest) & (frequency <= highest)
        self.frequency = frequency[self._lines]
        ones = np.ones(len(self.frequency), dtype=complex)
        super().__init__(
            self.frequency,
            self._spectrum(signals.angle if signals.perturbation is None else signals.perturbation),
            self._spectrum(signals.torque),
            slice(None),
            scale=ones,
            least=np.finfo(float).tiny,
            taper=self._taper,
        )
        time = np.linspace(-1.0, 1.0, signals.angle.shape[1])
        drift = self._of_trials(np.stack([np.ones_like(time), time]))
        self._drift = drift[np.linalg.norm(drift, axis=(1, 2)) > ROUNDING]
        self._white = ones[None, None]  # until the noise is weighed
        self._span = orthonormal(applied_rows(self._white, self._drift))

    @property
    def noise(self) -> Array:
        """Power of the noise as last weighed, (line,)."""
        return np.asarray(2.0 / np.abs(self._white[0, 0]) ** 2)

    def _of_trials(self, values: Array) -> ComplexArray:
        """DFT of signals where they count, (..., 1, line)."""
        part = values[..., self.signals.used] * self._taper
        return np.asarray(fft.rfft(part, axis=-1)[..., None, self._lines] / np.sqrt(np.sum(self._taper**2)))

    def _spectrum(self, values: Array) -> ComplexArray:
        """DFT of signals of all trials, what they share taken out, (..., trial, 1, line)."""
        spectrum = self._of_trials(values)
        return np.asarray(spectrum - spectrum.mean(axis=-3, keepdims=True)) if self._centred else spectrum

    def _unknowns(self, values: Array) -> ComplexArray:
        """Offset and drift."""
        return self._drift

    def _to_smooth(self, values: Array) -> ComplexArray:
        return np.ones((1, 1, len(self.frequency)), dtype=complex)

    def rows(self, values: Array) -> Array:
        """White signal without offset and drift, real then imaginary parts, (trial, number)."""
        return self._left(applied_rows(self._white, self._spectrum(values)))

    def residual(self, values: Array) -> Array:
        """White residual of the torque at the recorded movement, (trial, number)."""
        return self._white_rows(values)

    def weigh(self, values: Array) -> None:
        """Estimate the spectrum of the noise that a model leaves; it holds until the next call."""
        super().weigh(values)
        if self._is_white:
            residual, leverage = self._without_unknowns(values)
            assert leverage is not None  # offset and drift are unknown
            power = self._dependence * np.mean(np.abs(residual) ** 2) / np.mean(1.0 - leverage)
            self._white = np.full_like(self._white, np.sqrt(2.0 / power))
            self._span = orthonormal(applied_rows(self._white, self._drift))

    def block_scores(self, residual: Array, slopes: Array, n_blocks: int) -> list[BlockScore]:
        """What each block of time says of the parameters; without blocks, each trial.

        Args:
          residual: white, (trial, number).
          slopes: white derivatives of the model, (parameter, trial, number).
          n_blocks: of each trial.
        """
        if n_blocks > 1:
            residual, slopes = self._in_time(residual), self._in_time(slopes)
        cuts = time_blocks(residual.shape[1], n_blocks)
        scores = []
        for trial in range(self.n_trials):
            for cut in cuts:
                part = slopes[:, trial, cut[0] : cut[-1] + 1]
                scores.append(BlockScore(part @ residual[trial, cut[0] : cut[-1] + 1], part @ part.T))
        return scores

    def _in_time(self, rows: Array) -> Array:
        """White rows as white signals over time, with the same sums of products."""
        half = rows.shape[-1] // 2
        spectrum = np.zeros((*rows.shape[:-1], len(self._lines)), dtype=complex)
        spectrum[..., self._lines] = (rows[..., :half] + 1j * rows[..., half:]) / np.sqrt(2.0)
        return np.asarray(fft.irfft(spectrum, len(self._taper), axis=-1, norm="ortho"))
