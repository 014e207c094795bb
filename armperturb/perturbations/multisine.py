"""The continuous perturbation: a crested multisine of reduced power (thesis 2.4, fig. 2.5)."""

import math
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from scipy.fft import irfft

from armperturb.perturbations.crest import N_STARTS, reduce_crest
from armperturb.perturbations.perturbation import sample_times
from armperturb.seeds import generator_of
from armperturb.validation import require_one_of, require_ranges

DESIGN_RATE = 200.0
"""Rate of the thesis's recordings [Hz]."""

PERIOD_SAMPLES = 4096
"""Samples per period at `DESIGN_RATE`."""

PERIOD = PERIOD_SAMPLES / DESIGN_RATE
"""Period [s], 20.48 s."""

FULL_BAND = (0.2, 1.5)
"""Band of full power [Hz]."""

REDUCED_BAND = (1.8, 40.0)
"""Band of reduced power [Hz]; its four extra clusters stay below 7 Hz."""

REDUCED_RATIO = {"amplitude": 0.15, "power": math.sqrt(0.15)}
"""Amplitude of the reduced band over that of the full band [-]: "15 %" refers to the amplitude in the text of
thesis 2.4 and of the power in the caption of its fig. 2.5. Power is the default: only 15 % of power, an amplitude
ratio of 0.387, gives the published ratios of joint velocity to joint rotation."""


def _cluster_layout() -> np.ndarray:
    """Lines in units of 1 / PERIOD, (cluster, 4), rising.

    The extra clusters are the geometric midpoints of the first five logarithmic ones: the same grid at twice the
    density, which leaves at least three empty lines between any two clusters.
    """

    def first_and_last_start(band: tuple[float, float]) -> tuple[int, int]:
        return math.ceil(band[0] * PERIOD), math.floor(band[1] * PERIOD) - 3

    full = np.linspace(*first_and_last_start(FULL_BAND), 4)
    reduced = np.geomspace(*first_and_last_start(REDUCED_BAND), 10)
    extra = np.sqrt(reduced[:4] * reduced[1:5])
    starts = np.sort(np.rint(np.concatenate([full, reduced, extra])).astype(int))
    layout = starts[:, np.newaxis] + np.arange(4)
    layout.flags.writeable = False
    return layout


CLUSTERS = _cluster_layout()
"""Every multisine's lines in units of 1 / PERIOD: 18 clusters of four neighbours, (cluster, 4)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Multisine:
    """A force of 72 sinusoids on each axis, endlessly periodic in itself and applied for `duration`.

    Attributes:
      rms: RMS force of each axis over a period [N], > 0.
      phases: phases of the cosines [rad], (axis, 72); see `draw`. Stored as a read-only copy.
      reduced: what 15 % of the full band's is left in the reduced band, "amplitude" or "power"; power unless asked
        otherwise, see `REDUCED_RATIO`.
      duration: time that it is applied for [s], > 0.

    Raises:
      TypeError: a value is not a number.
      ValueError: a value is not finite or out of its range, or the phases have the wrong shape.
    """

    rms: float
    phases: np.ndarray = field(repr=False)
    reduced: str = "power"
    duration: float = 32.0

    def __post_init__(self) -> None:
        require_ranges("Multisine", self)
        require_one_of("Multisine", "reduced", self.reduced, tuple(REDUCED_RATIO))
        phases = np.array(self.phases, dtype=float)
        if phases.shape != (2, CLUSTERS.size) or not np.isfinite(phases).all():
            raise ValueError(
                f"Multisine: phases of shape {phases.shape}; expected finite numbers of shape (2, {CLUSTERS.size})"
            )
        phases.flags.writeable = False
        object.__setattr__(self, "phases", phases)

    @classmethod
    def draw(
        cls,
        *,
        seed: int | np.random.Generator,
        rms: float,
        reduced: str = "power",
        duration: float = 32.0,
        crested: bool = True,
    ) -> Self:
        """A random realisation, independent on x and y.

        Args:
          seed: what the phases are drawn from; the same seed gives the same multisine.
          rms: RMS force of each axis over a period [N], > 0.
          reduced: what 15 % of the full band's is left in the reduced band, "amplitude" or "power".
          duration: time that it is applied for [s], > 0.
          crested: whether to lower the peaks (some 0.07 s per axis); if not, the phases stay uniformly random.

        Raises:
          TypeError: a value is not a number, or seed neither a whole number nor a generator.
          ValueError: a value is not finite or out of its range.
        """
        starts = generator_of("Multisine", seed).uniform(-np.pi, np.pi, (2, N_STARTS, CLUSTERS.size))
        multisine = cls(rms=rms, phases=starts[:, 0], reduced=reduced, duration=duration)
        if not crested:
            return multisine
        amplitudes = replace(multisine, rms=1.0).amplitudes  # so that rounding lets no phase depend on rms
        return replace(multisine, phases=reduce_crest(multisine.lines, amplitudes, starts))

    @property
    def clusters(self) -> np.ndarray:
        """Lines in units of 1 / PERIOD, (cluster, 4)."""
        return CLUSTERS

    @property
    def lines(self) -> np.ndarray:
        """Lines in units of 1 / PERIOD, rising, (72,)."""
        return CLUSTERS.ravel()

    @property
    def frequencies(self) -> np.ndarray:
        """Frequencies of the lines [Hz], (72,)."""
        return self.lines / PERIOD

    @property
    def amplitudes(self) -> np.ndarray:
        """Amplitudes of the lines, the same for both axes [N], (72,)."""
        relative = np.where(self.frequencies < FULL_BAND[1], 1.0, REDUCED_RATIO[self.reduced])
        return self.rms * relative / np.sqrt(np.sum(relative**2) / 2.0)

    @property
    def highest_frequency(self) -> float:
        """Frequency of the highest line [Hz]."""
        return float(self.frequencies[-1])

    def crest_factor(self, rate: float = 4.0 * DESIGN_RATE) -> np.ndarray:
        """Peak over RMS of one period sampled at `rate` [Hz], (axis,)."""
        return np.abs(self.periodic(rate, math.ceil(rate * PERIOD))).max(axis=0) / self.rms

    def sample(self, rate: float, n_samples: int, start: float = 0.0) -> np.ndarray:
        """Force [N] at the times start + k / rate, zero outside [0, duration), (n_samples, axis)."""
        times = sample_times(rate, n_samples, start)
        force = self.periodic(rate, n_samples, start)
        force[(times < 0.0) | (times >= self.duration)] = 0.0
        return force

    def periodic(self, rate: float, n_samples: int, start: float = 0.0) -> np.ndarray:
        """Force [N] at the times start + k / rate, as if it had no start and no end, (n_samples, axis)."""
        times = sample_times(rate, n_samples, start)
        period_samples = rate * PERIOD_SAMPLES / DESIGN_RATE
        if period_samples.is_integer() and period_samples > 2 * self.lines[-1]:
            return self._tile(int(period_samples), n_samples, start)
        return self.sum_at(times)

    def _tile(self, period_samples: int, n_samples: int, start: float) -> np.ndarray:
        """`periodic` by one inverse Fourier transform, for rates with a whole number of samples per period."""
        turns = np.mod(self.frequencies * start, 1.0)
        spectrum = np.zeros((2, period_samples // 2 + 1), complex)
        spectrum[:, self.lines] = self.amplitudes * np.exp(1j * (self.phases + 2.0 * np.pi * turns))
        period = irfft(spectrum, period_samples, norm="forward").T / 2.0
        return np.resize(period, (n_samples, 2))

    def sum_at(self, times: np.ndarray) -> np.ndarray:
        """`periodic` by adding the sinusoids, for any times (time,)."""
        phasors = self.amplitudes * np.exp(1j * self.phases)
        force = np.empty((len(times), 2))
        for first in range(0, len(times), 4096):  # in pieces that stay in the cache
            chunk = slice(first, first + 4096)
            angles = 2.0 * np.pi * np.mod(np.multiply.outer(times[chunk], self.frequencies), 1.0)
            # einsum, not @: BLAS may add in another order on another number of threads.
            force[chunk] = np.einsum("tl,al->ta", np.cos(angles), phasors.real)
            force[chunk] -= np.einsum("tl,al->ta", np.sin(angles), phasors.imag)
        return force
