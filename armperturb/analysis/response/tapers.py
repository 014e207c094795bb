"""Frequency responses by averaged tapered spectra: Welch's overlapping segments, and Thomson's multitapers.

Both make many spectra of each record, of D and of Z = (F, X), and take all of them at a frequency for repetitions of
Z = T D + noise: least squares give T, and what is left the noise. All is referred to d (joint input-output approach,
see `local_polynomial`), so that feedback does no harm. Records may differ in length. Within the bandwidth of the tapers
responses are taken to be constant, which blurs resonances, and what came before a record counts as noise: these are the
usual methods, simpler than `closed_loop.estimate_noise` and less exact.

Multitapers (Thomson 1982, Proc. IEEE 70) are orthogonal, and so their spectra are independent in white noise. Segments
overlap by half; under Hann's window neighbours correlate by 1/6, which costs degrees of freedom.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import signal

from armperturb.analysis.response.closed_loop import LEAST_DOF, excited_band
from armperturb.analysis.response.frequency_response import FrequencyResponse, System, require_frequencies
from armperturb.analysis.response.local_polynomial import N_INPUTS, Window, fit_locally, frequency_response
from armperturb.analysis.trials import SeveralTrials, TrialRecord, prepared_recordings, records_of
from armperturb.arrays import Array, ComplexArray
from armperturb.validation import require_number

SEGMENT = 5.12
"""Length of Welch's segments unless asked otherwise [s]."""

NEIGHBOURS = 1.0 / 6.0
"""Correlation of white noise in segments that overlap by half, under Hann's window [-]."""

HALF_BANDWIDTH = 0.25
"""Of multitapers unless asked otherwise [Hz]."""

LEAST_OUTSIDE = 1e-7
"""Share of a taper's power beyond its band from which on it is left out: displacements at 20 Hz have some 1e-7 of the
power of those below 1 Hz, which would leak into them [-]."""


def estimate_welch(recordings: SeveralTrials, *, segment: float = SEGMENT, **options: Any) -> FrequencyResponse:
    """Frequency response by Welch's method: segments under Hann's window that overlap by half.

    Args:
      recordings: trials of one subject in one condition; their lengths may differ.
      segment: length of the segments [s]. Trials that are shorter are left out.
      **options: `what`: "arm" (from f to x), "environment" (from d - f to x) or "total" (from d to x); `window_start`
        of what is used [s]; `frequency` where the response is wanted [Hz], (frequency,), which by default are up to 40
        of those that the disturbance excites.

    Raises:
      ValueError: as `records_of` and `fit_locally`, the records hold too few segments, or a frequency is out of range.
    """
    require_number("estimate_welch", "segment", segment, above=0.0)

    def pieces(record: TrialRecord) -> tuple[list[slice], Array, float]:
        n = round(segment * record.rate)
        firsts = range(0, len(record.perturbation) - n + 1, n // 2)
        count = max(len(firsts), 1)
        independent = count / (1 + 2 * NEIGHBOURS**2 * (1 - 1 / count))
        tapers = signal.windows.hann(n, sym=False)[None]
        return [slice(first, first + n) for first in firsts], tapers, independent * bool(firsts)

    return _estimate(recordings, pieces, f"{segment:g} s of Welch's segments", **options)


def estimate_multitaper(
    recordings: SeveralTrials, *, half_bandwidth: float = HALF_BANDWIDTH, **options: Any
) -> FrequencyResponse:
    """Frequency response by multitapers: the discrete prolate spheroidal sequences of each whole record.

    Args:
      recordings: as in `estimate_welch`.
      half_bandwidth: half of the band that the tapers average over [Hz]: W. A record of length T has 2 T W tapers,
        of which the last few are left out, see `LEAST_OUTSIDE`.
      **options: as in `estimate_welch`.

    Raises:
      ValueError: as `records_of` and `fit_locally`, the records are too short for tapers of that bandwidth, or a
        frequency is out of range.
    """
    require_number("estimate_multitaper", "half_bandwidth", half_bandwidth, above=0.0)
    tapers: dict[int, Array] = {}

    def pieces(record: TrialRecord) -> tuple[list[slice], Array, float]:
        n = len(record.perturbation)
        product = half_bandwidth * n / record.rate
        if not 1.0 <= product < n / 2:
            return [], np.empty((0, n)), 0.0
        if n not in tapers:
            sequences, inside = signal.windows.dpss(n, product, int(2 * product), return_ratios=True)
            tapers[n] = np.asarray(sequences[1.0 - inside < LEAST_OUTSIDE], dtype=float)
        return [slice(0, n)], tapers[n], float(len(tapers[n]))

    return _estimate(recordings, pieces, f"a half bandwidth of {half_bandwidth:g} Hz", **options)


def _estimate(
    recordings: SeveralTrials,
    pieces: Callable[[TrialRecord], tuple[list[slice], Array, float]],
    asked: str,
    *,
    what: System = "arm",
    window_start: float = 0.0,
    frequency: ArrayLike | None = None,
) -> FrequencyResponse:
    """Response from pieces of records, tapers of each piece, and how many independent spectra that is worth."""
    records = records_of(prepared_recordings(recordings), window_start)
    rate = records[0].rate
    wanted = excited_band(records) if frequency is None else require_frequencies(frequency, rate)
    spectra: list[ComplexArray] = []
    n_spectra: list[int] = []
    independent = 0.0
    waves: dict[int, ComplexArray] = {}
    for record in records:
        slices, tapers, count = pieces(record)
        independent += count
        n = tapers.shape[1]
        if slices and n not in waves:
            waves[n] = np.exp(-2j * np.pi * np.outer(wanted / rate, np.arange(n)))
        n_spectra.append(len(slices) * len(tapers))
        for piece in slices:
            both = np.concatenate([record.perturbation[piece], record.response[piece]], axis=1)
            both = both - both.mean(axis=0)
            spectra += [waves[n] @ (taper[:, None] * both) for taper in tapers]
    dof = independent - N_INPUTS
    if dof < LEAST_DOF:
        raise ValueError(
            f"the recordings hold {independent:.3g} independent spectra with {asked}; expected at least "
            f"{LEAST_DOF + N_INPUTS:g} (longer or more trials, shorter segments or a wider band)"
        )
    of_records = np.split(np.array(spectra), np.cumsum(n_spectra)[:-1])
    fits = []
    for k, centre in enumerate(wanted):
        windows = [
            Window(np.full(len(each), centre), each[:, k, :N_INPUTS], each[:, k, N_INPUTS:], np.full(len(each), True))
            for each in of_records
            if len(each)
        ]
        fit = fit_locally(windows, float(centre), order=0, leakage_order=-1)
        fits.append(fit._replace(factor=fit.factor * len(spectra) / independent))
    return frequency_response(fits, what, [(fit.noise, dof) for fit in fits])
