"""The filter that makes the EMG of a person as informative of its amplitude as it can be; see `envelope`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, optimize, signal

from armperturb.analysis.emg.channels import NOTCH, hum_lines
from armperturb.arrays import Array, Flags
from armperturb.recording import HighPass

RESOLUTION = 12.5
"""Of the spectra that filters are made from [Hz]: they ring for less than half its inverse."""

LONGEST_PART, BESIDE = 2**19, 4.0
"""Samples of a trial that are filtered at once: longer ones are cut into equal parts, for the sake of time and memory,
and what is beside a part within such a time [s] is filtered with it, as notches ring."""

TOGETHER = 2**13
"""Intervals of which means are formed at once, so that what they are made of stays in a processor's cache."""

EDGE_ORDER = 4
"""Order of the band's edges, as of a Butterworth filter that is run forward and backward."""

WHITE = 0.1
"""Mean square deviation of a spectrum from a flat one, over its square, below which it is white [-]."""

FLAT, RISEN = 150.0, 4.0
"""Frequency below which muscles have most of their power [Hz], and factor by which the share of a quiet trial in the
mean over trials is larger where it is all noise [-]."""

FALLEN, SMOOTHED = 0.5, 5
"""Share of white noise that a low-pass leaves at the end of its band [-]; bins over which spectra are smoothed."""

STRONG = 10.0
"""Power over that of the quietest trial from which on a trial is of the muscle, whatever the noise [-]."""

REWEIGHTED = 3
"""Times that the parts of a spectrum are estimated, each with the weights of the estimate before."""

ALIKE = 0.7
"""Power of the quietest trial over the mean from which on trials are too much alike to tell the noise well [-]."""

SILENT = 0.1
"""Share of a channel's power above the noise below which its muscle counts as silent [-]."""

FADED = 1.0
"""Time at either end over which trials are faded in and out before their spectra are taken [s]: a drift has another
value at the end than at the start, and such a step has power in the whole band."""

FAINTEST = 1e-4
"""Least power of a spectrum over its largest that a filter makes white [-]: instruments hide what is fainter."""

DRIFT = 2.0
"""Highest frequency of drifts [Hz]: they harm nothing, and are no movement artefacts."""

STEADY = 1.0
"""Time over which hum has one amplitude and phase [s]."""

DEAD_SHARE = 1e-9
"""A trial with less than this share of the power of the loudest one is dead, not quiet [-]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Whitening:
    """Filter of each channel: of zero phase, together with the amplifier where that is known.

    Attributes:
      edge: samples by which a trial, and each of its parts, is extended at either end.
      n_part: samples of a part.
      n_padded: samples of a part that is so extended, with the zeros behind it.
      response: (muscle, frequency), real.
      undone: what takes the phase of the amplifier away, of modulus one, (frequency,); None where nobody knows it.
      samples_per_second: independent numbers in a second of what comes out [1/s], (trial, muscle): more where it is
        whiter, so that they differ between trials at rest and strong contractions.
      gain: power that comes out over that of the muscle in the band, (muscle,).
      noise: power that comes out of the silent channel [V^2], (muscle,).
      hum: column to the frequencies that are cut out [Hz].
      rate: of the samples [Hz].
    """

    edge: int
    n_part: int
    n_padded: int
    response: NDArray[np.float32]
    undone: NDArray[np.complex64] | None
    samples_per_second: Array
    gain: Array
    noise: Array
    hum: dict[int, list[float]]
    rate: float

    def __call__(self, volts: NDArray[np.float32], column: int) -> NDArray[np.float32]:
        """One channel of a trial within the band, white where the muscle is above the noise, (time,)."""
        n, edge = len(volts), self.edge
        volts = volts - volts.mean(dtype=float).astype(np.float32)
        for line in self.hum.get(column, ()):
            volts = _without_line(volts, line, self.rate)
        # Point reflections at the ends, as a jump there would be a burst of what whitening lets through best.
        before, after = volts[edge:0:-1], volts[-2 : -edge - 2 : -1]
        extended = np.concatenate([2.0 * volts[:1] - before, volts, 2.0 * volts[-1:] - after])
        white = np.empty(n, dtype=np.float32)
        for start in range(0, n, self.n_part):
            out = white[start : start + self.n_part]
            part = extended[start : start + len(out) + 2 * edge]
            spectrum = fft.rfft(_from_end_to_end(part), self.n_padded)  # nothing jumps where zeros follow
            spectrum *= self.response[column]
            if self.undone is not None:
                spectrum *= self.undone
            out[:] = fft.irfft(spectrum, self.n_padded, overwrite_x=True)[edge : edge + len(out)]
        return white


@dataclass(frozen=True, kw_only=True, eq=False)
class Spectra:
    """Power spectra of trials.

    Attributes:
      frequency: centres of bins [Hz], (bin,).
      power: mean within each bin, without hum, (trial, muscle, bin); below the band that at its edge.
      below: power below the band, less that of drifts, over that in it, (trial, muscle).
      drift: that of drifts over the same, (trial, muscle).
      hum: column to the frequencies of the mains in it [Hz].
    """

    frequency: Array
    power: Array
    below: Array
    drift: Array
    hum: dict[int, list[float]]

    @classmethod
    def of(cls, volts: NDArray[np.float32], rate: float, low: float, mains: Sequence[float]) -> "Spectra":
        """Spectra of trials.

        Args:
          volts: (trial, time, muscle) [V].
          rate: of the samples [Hz].
          low: lower edge of the band [Hz].
          mains: frequencies whose hum is looked for, with their multiples [Hz].
        """
        n_parts = parts_of(volts.shape[1])
        n_padded = padded_length(volts.shape[1], rate)
        n_part = volts.shape[1] // n_parts
        faded = signal.windows.tukey(n_part, min(1.0, 2.0 * FADED * rate / n_part)).astype(np.float32)
        faded /= np.sqrt(np.mean(faded**2))
        frequency = fft.rfftfreq(n_padded, 1.0 / rate)
        starts = np.unique(np.searchsorted(frequency, np.arange(0.0, rate / 2.0, RESOLUTION)))
        sizes = np.diff(np.append(starts, len(frequency)))
        power, hum = np.empty((len(volts), volts.shape[2], len(starts))), dict[int, list[float]]()
        (below, drift), is_slow = np.empty((2, *power.shape[:2])), frequency < 0.75 * low
        is_drift = frequency <= DRIFT
        total = np.zeros((volts.shape[2], len(frequency)), dtype=np.float32)
        for trial, values in enumerate(volts):
            for column in range(values.shape[1]):  # one after the other, for the sake of memory
                density = np.zeros(len(frequency), dtype=np.float32)
                for part in values[: len(values) // n_parts * n_parts, column].reshape(n_parts, -1):
                    transformed = fft.rfft(faded * _from_end_to_end(part), n_padded)
                    density += transformed.real**2 + transformed.imag**2
                density /= n_parts
                # Relative to the trial, as hum that strong contractions hide counts where the muscle is quiet.
                total[column] += density / max(density.mean(), np.finfo(np.float32).tiny)
                power[trial, column] = np.add.reduceat(density, starts) / sizes
                in_band = max(float(density[~is_slow].sum()), 1e-30)
                drift[trial, column] = density[is_drift].sum() / in_band
                below[trial, column] = density[is_slow & ~is_drift].sum() / in_band
        centre = np.add.reduceat(frequency, starts) / sizes
        for column, mean in enumerate(total / len(volts)):
            if lines := hum_lines(mean, frequency, mains):
                hum[column] = lines
                _bridge(power[:, column], centre, lines)
        # What is below the band, as a drift, says nothing of the muscle at the band's edge.
        n_below = int(np.searchsorted(centre, low))
        power[..., :n_below] = power[..., n_below : n_below + 1]
        return cls(frequency=centre, power=power, below=below, drift=drift, hum=hum)


def _bridge(power: Array, frequency: Array, lines: Sequence[float]) -> None:
    """Replace the bins about lines of hum by what is between their neighbours, in place, (trial, bin).

    The filter cuts hum out of the signal, so that spectra with it would be those of another signal.
    """
    is_near = np.any(np.abs(frequency - np.array(lines)[:, None]) < RESOLUTION, axis=0)
    for of_trial in power:
        logarithm = np.log(np.maximum(of_trial[~is_near], np.finfo(float).tiny))
        of_trial[is_near] = np.exp(np.interp(frequency[is_near], frequency[~is_near], logarithm))


def parts_of(n_samples: int) -> int:
    """Into how many parts a trial is cut."""
    return -(-n_samples // LONGEST_PART)


def padded_length(n_samples: int, rate: float) -> int:
    """Samples to which parts of a trial are padded."""
    n_part = -(-n_samples // parts_of(n_samples))
    return int(fft.next_fast_len(n_part + 2 * edge_length(n_samples, rate), real=True))


def edge_length(n_samples: int, rate: float) -> int:
    """Samples by which a trial is extended at either end: for as long as filters without notches ring, or longer."""
    length = 1.0 / RESOLUTION if parts_of(n_samples) == 1 else BESIDE
    return min(round(rate * length), n_samples - 1)


def band_power(frequency: Array, low: float, high: float) -> Array:
    """Power that passes the band, (frequency,)."""
    f = np.maximum(frequency, 1e-9)
    return np.asarray(1.0 / ((1.0 + (low / f) ** (4 * EDGE_ORDER)) * (1.0 + (f / high) ** (4 * EDGE_ORDER))))


def passed_band(spectra: Spectra, low: float, high: float) -> float:
    """Frequency up to which the amplifier passes what the channels have [Hz], at most the upper edge of the band.

    That is where the white noise of the quietest trial falls. Where the noise is more than the muscle, the trial's
    share of the mean over trials has risen; what falls before that is the muscle's own spectrum.

    Args:
      spectra: of the trials.
      low: lower edge of the band [Hz].
      high: largest upper edge [Hz].
    """
    inside = (spectra.frequency >= 2.0 * low) & (spectra.frequency <= high)
    frequency, ends = spectra.frequency[inside], []
    if not (frequency < FLAT).any():
        return high
    for power in spectra.power[:, :, inside].swapaxes(0, 1):
        loud = power.sum(axis=-1)
        alive = np.flatnonzero(loud > DEAD_SHARE * loud.max())
        if not len(alive) or not loud.max() > 0.0:
            continue
        quietest, mean = (
            ndimage.median_filter(each, SMOOTHED, mode="nearest")
            for each in (power[alive[np.argmin(loud[alive])]], power.mean(axis=0))
        )
        share = quietest / np.maximum(mean, np.finfo(float).tiny)
        is_noise = share > RISEN * np.median(share[frequency < FLAT])
        white = quietest[is_noise.argmax() :]
        fallen = white < FALLEN * np.median(white[:SMOOTHED])
        ends.append(frequency[-len(white) :][fallen.argmax()] if is_noise.any() and fallen.any() else high)
    return float(np.median(ends)) if ends else high


def noise_spectra(spectra: Spectra, band: tuple[float, float], is_rest: NDArray[np.bool_]) -> Array:
    """Power spectrum of each channel when its muscle is silent, (muscle, bin); NaN where nothing tells it.

    That of the trials at rest. Without any, nobody says that a muscle was ever silent: unless the spectrum of the
    quietest trial is white, it is taken for a sum of white noise and of the mean spectrum of all trials, which is that
    of the muscle, and the noise is what is white. Where all strong trials are white as well, whiteness tells nothing.

    Args:
      spectra: of the trials.
      band: its edges [Hz].
      is_rest: trials at rest, (trial,).
    """
    if is_rest.any():
        return np.asarray(np.mean(spectra.power[is_rest], axis=0))
    loudness = np.sum(spectra.power * band_power(spectra.frequency, *band), axis=-1)
    inside = (spectra.frequency >= band[0]) & (spectra.frequency <= band[1])
    noise = np.zeros(spectra.power.shape[1:])
    for column, loud in enumerate(loudness.T):
        alive = np.flatnonzero(loud > DEAD_SHARE * loud.max())
        if not len(alive) or not loud.max() > 0.0:
            continue
        quietest = spectra.power[alive[np.argmin(loud[alive])], column, inside]
        muscle = np.mean(spectra.power[:, column, inside], axis=0)
        level = quietest.mean()
        if _is_white(quietest):
            strong = spectra.power[loud > STRONG * loud[alive].min(), column][:, inside]
            noise[column] = np.nan if len(strong) and all(map(_is_white, strong)) else level
            continue
        parts = _of_muscle_and_white(quietest, muscle)
        # The mean has the noise as well: the share of it that is in the quietest trial takes as much of it along.
        taken = np.interp(parts[0], [0.0, ALIKE, 1.0], [0.0, ALIKE, 0.0])
        noise[column] = parts[1] / (1.0 - taken)
    return noise


def tone_at_rest(spectra: Spectra, band: tuple[float, float], is_rest: Flags) -> Array:
    """Share of the power at rest that has the spectrum of the muscle, (muscle,); zeros without trials at rest.

    Args:
      spectra: of the trials.
      band: its edges [Hz].
      is_rest: trials at rest, (trial,).
    """
    shares = np.zeros(spectra.power.shape[1])
    if not is_rest.any() or is_rest.all():
        return shares
    inside = (spectra.frequency >= band[0]) & (spectra.frequency <= band[1])
    for column, (rest, muscle) in enumerate(
        zip(*(spectra.power[part][..., inside].mean(axis=0) for part in (is_rest, ~is_rest)), strict=True)
    ):
        if rest.max() > 0.0 and not _is_white(muscle):
            of_muscle, white = _of_muscle_and_white(rest, muscle) * [muscle.mean(), 1.0]
            shares[column] = of_muscle / max(of_muscle + white, 1e-300)
    return shares


def _of_muscle_and_white(spectrum: Array, muscle: Array) -> Array:
    """How much of a muscle's spectrum, and of white noise, a spectrum is the sum of, (2,)."""
    expected = np.maximum(spectrum, 1e-12 * spectrum.max())
    for _ in range(REWEIGHTED):  # weights that are the data's own would favour what is low by chance
        design = np.stack([muscle / expected, 1.0 / expected], axis=1)
        size = np.linalg.norm(design, axis=0)
        parts = optimize.nnls(design / size, spectrum / expected)[0] / size
        expected = np.maximum(parts[0] * muscle + parts[1], 1e-12 * spectrum.max())
    return np.asarray(parts)


def _is_white(spectrum: Array) -> bool:
    return bool(np.mean((spectrum / spectrum.mean() - 1.0) ** 2) < WHITE)


def whitening(
    spectra: Spectra,
    noise: Array,
    n_samples: int,
    rate: float,
    band: tuple[float, float],
    *,
    highpass: HighPass | None = None,
    whiten: bool = True,
) -> Whitening:
    """The filter of a person's channels.

    Args:
      spectra: of all trials.
      noise: spectrum of the silent channels, (muscle, bin).
      n_samples: of a trial.
      rate: of the samples [Hz].
      band: its edges [Hz].
      highpass: that of the amplifier; None if nobody knows it.
      whiten: whether to whiten; if not, the band alone is let through.
    """
    frequency, n_muscles, n_padded = spectra.frequency, len(noise), padded_length(n_samples, rate)
    n_parts = parts_of(n_samples)
    passed, fine = band_power(frequency, *band), fft.rfftfreq(n_padded, 1.0 / rate)
    response = np.empty((n_muscles, len(fine)), dtype=np.float32)
    samples, gain, silent = np.empty((len(spectra.power), n_muscles)), np.empty(n_muscles), np.empty(n_muscles)
    for column in range(n_muscles):
        of_trials = spectra.power[:, column]
        # The geometric mean: between strong and weak contractions, rather than the strongest.
        total = np.exp(np.mean(np.log(np.maximum(of_trials, 1e-9 * of_trials.max() + 1e-30)), axis=0))
        total = np.maximum(total, FAINTEST * total.max())
        muscle = np.maximum(total - noise[column], 1e-6 * total)
        # Of a muscle that is always silent, what is above the noise is chance, and must not choose what is let through.
        is_silent = np.sum(passed * (total - noise[column])) < SILENT * np.sum(passed * total)
        power = passed * (muscle / total**2 if whiten and not is_silent else np.ones(len(total)))
        power /= power.max()
        root = np.interp(fine, frequency, np.sqrt(power))
        root[fine < 0.5 * band[0]] = 0.0
        for line in spectra.hum.get(column, ()):
            root[np.abs(fine - line) < NOTCH] = 0.0
        response[column] = root
        for trial, of_trial in enumerate(of_trials):  # a dead trial counts as all others together
            out = np.interp(fine, frequency, of_trial if of_trial.any() else total) * root**2
            samples[trial, column] = 2.0 * fine[1] * np.sum(out) ** 2 / np.sum(out**2)
        above = np.maximum(np.mean(of_trials, axis=0) - noise[column], 1e-30)
        gain[column] = np.sum(power * above) / np.sum(passed * above)
        silent[column] = 2.0 * np.sum(np.interp(fine, frequency, noise[column]) * root**2)
        silent[column] /= n_samples // n_parts * n_padded
    return Whitening(
        edge=edge_length(n_samples, rate),
        n_part=-(-n_samples // n_parts),
        n_padded=n_padded,
        response=response,
        undone=None if highpass is None else _without_phase(fine, highpass),
        samples_per_second=samples,
        gain=gain,
        noise=silent,
        hum=spectra.hum,
        rate=rate,
    )


def _from_end_to_end(volts: NDArray[np.float32]) -> NDArray[np.float32]:
    """A signal (time,) less the line from its first to its last value."""
    return volts - np.linspace(volts[0], volts[-1], len(volts), dtype=np.float32)


def _without_line(volts: NDArray[np.float32], line: float, rate: float) -> NDArray[np.float32]:
    """A signal (time,) without a sine of slowly changing amplitude and phase.

    A notch alone would ring for longer than trials are extended at their ends.
    """
    turn = np.exp(2j * np.pi * line / rate * np.arange(len(volts)))
    size = min(len(volts), round(STEADY * rate))
    weight = ndimage.uniform_filter1d(np.ones(len(volts)), size, mode="constant")
    turned = volts * turn.conj()
    real, imaginary = (
        ndimage.uniform_filter1d(part, size, mode="constant") / weight for part in (turned.real, turned.imag)
    )
    return (volts - 2.0 * ((real + 1j * imaginary) * turn).real).astype(np.float32)


def _without_phase(frequency: Array, highpass: HighPass) -> NDArray[np.complex64]:
    """What takes the phase of a Butterworth high-pass away, of modulus one, (frequency,).

    Passed forward in time only, it delays each frequency by its group delay, and what modulates the EMG by the mean of
    that over the spectrum: some tenths of a millisecond.
    """
    poles = signal.butter(highpass.order, 1.0, analog=True, output="zpk")[1]
    phase = np.full(len(frequency), 0.5 * np.pi * highpass.order)
    for pole in poles:
        phase -= np.arctan2(frequency / highpass.frequency - pole.imag, -pole.real)
    return np.exp(np.complex64(-1j) * phase.astype(np.float32))


class Intervals:
    """Parts of a signal, the ends of which need not fall on samples.

    Args:
      n: samples of the signal.
      rate: of the samples [Hz].
      start: of each interval, in ascending order [s], (interval,).
      end: likewise.
    """

    def __init__(self, n: int, rate: float, start: Array, end: Array) -> None:
        # A sample stands for the time about it.
        edges = np.clip(np.stack([start, end]) * rate + 0.5, 0.0, n)
        self._whole = np.minimum(edges.astype(int), n - 1)
        self._part = edges - self._whole
        self._size = np.maximum(edges[1] - edges[0], 1e-9)

    def mean(self, values: NDArray[Any], changed: Callable[..., NDArray[Any]]) -> Array:
        """Mean of what a function makes of a signal (time,) in each interval, (interval,)."""
        means = np.empty(len(self._size))
        for first in range(0, len(means), TOGETHER):
            block = slice(first, first + TOGETHER)
            whole, part = self._whole[:, block], self._part[:, block]
            start = whole[0, 0]
            samples = changed(values[start : whole[1, -1] + 1], dtype=float)
            summed = np.concatenate([[0.0], np.cumsum(samples)])
            at_edge = summed[whole - start] + samples[whole - start] * part
            means[block] = (at_edge[1] - at_edge[0]) / self._size[block]
        return means
