"""Frequency responses without a model of the arm, by one call: spectral, ARX and subspace estimates.

A method is a function from a recording to a `FrequencyResponse`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from armperturb.analysis.arx import HIGHEST_ORDER, fit_arx
from armperturb.analysis.frequency_response import FrequencyResponse
from armperturb.analysis.joint_records import (
    JointRecords,
    What,
    admittance_of,
    joint_records,
    require_what,
    variance_of,
)
from armperturb.analysis.spectra import estimate_spectra, line_spectra
from armperturb.analysis.subspace import PAST, fit_subspace
from armperturb.recording import join_recordings

Array = NDArray[np.float64]
Recordings = xr.Dataset | Sequence[xr.Dataset]

SAME_FREQUENCY = 1e-6
"""Difference of frequencies that are the same, over their size [-]."""


def spectral_response(
    recording: Recordings,
    *,
    frequency: ArrayLike | None = None,
    what: What = "arm",
    start: float = 8.0,
    period: float = 20.48,
    lines_per_average: int = 4,
) -> FrequencyResponse:
    """Response by averaged spectra of a periodic disturbance, see `spectra.estimate_spectra`; without covariance.

    Args:
      recording: trials of one person in one condition, of one duration.
      frequency: some of those at which there are estimates [Hz], (frequency,); None gives all.
      what: "arm" (x over f), "environment" (x over d - f) or "total" (x over d) [m/N].
      start: of the window, after the transient has gone [s].
      period: of the disturbance [s].
      lines_per_average: adjacent lines that are averaged.

    Raises:
      ValueError: as `line_spectra`, `estimate_spectra` and `join_recordings`; or there is no estimate at a frequency.
    """
    require_what(what)
    if not isinstance(recording, xr.Dataset):
        recording = join_recordings(recording)
    lines = line_spectra(recording, start=start, period=period)
    spectra = estimate_spectra(lines, lines_per_average=lines_per_average)
    response = {"arm": spectra.arm, "environment": spectra.environment, "total": spectra.total}[what]
    if frequency is None:
        return FrequencyResponse(frequency=spectra.frequency, response=response, covariance=None, what=what)
    wanted = _checked(frequency, float(recording.attrs["rate"]))
    nearest = np.abs(spectra.frequency - wanted[:, None]).argmin(axis=1)
    off = np.abs(spectra.frequency[nearest] - wanted) > SAME_FREQUENCY * wanted
    if off.any():
        raise ValueError(
            f"frequency = {wanted[off][0]:g} Hz; expected one of the averaged lines, of which "
            f"{spectra.frequency[nearest[off][0]]:.6g} Hz is nearest (or another method)"
        )
    return FrequencyResponse(frequency=wanted, response=response[nearest], covariance=None, what=what)


def arx_response(
    recording: Recordings,
    *,
    frequency: ArrayLike | None = None,
    what: What = "arm",
    order: int | None = None,
    highest_order: int = HIGHEST_ORDER,
) -> FrequencyResponse:
    """Response by a multivariable ARX model from d to (f, x), with covariance, see `arx`.

    Args:
      recording: trials of one person in one condition; several recordings may have several durations. Whatever is
        before the pulse is used, transients included.
      frequency: where the response is wanted [Hz], (frequency,); None takes those that the disturbance excites.
      what: "arm" (x over f), "environment" (x over d - f) or "total" (x over d) [m/N].
      order: number of lags; None chooses the one with the least estimated error at these frequencies.
      highest_order: among which is chosen.

    Raises:
      TypeError: an order is not a whole number.
      ValueError: as `joint_records` and `fit_arx`, or a frequency is out of range.
    """
    records = joint_records(recording)
    wanted = _wanted(frequency, records)
    model = fit_arx(records, wanted, what=what, order=order, highest_order=highest_order)
    joint, noise, spread = model.response(wanted)
    return FrequencyResponse(
        frequency=wanted,
        response=admittance_of(what, joint),
        covariance=variance_of(what, joint, noise, spread),
        what=what,
    )


def subspace_response(
    recording: Recordings,
    *,
    frequency: ArrayLike | None = None,
    what: What = "arm",
    order: int | None = None,
    past: int = PAST,
) -> FrequencyResponse:
    """Response by a state-space model from d to (f, x), without covariance, see `subspace`.

    Args:
      recording: as for `arx_response`.
      frequency: as for `arx_response`.
      what: as for `arx_response`.
      order: number of states; None chooses the stable model with the least estimated error at these frequencies.
      past: lags of the past window.

    Warns:
      RuntimeWarning: the model is unstable.

    Raises:
      TypeError: an order is not a whole number.
      ValueError: as `joint_records` and `fit_subspace`, or a frequency is out of range.
    """
    records = joint_records(recording)
    wanted = _wanted(frequency, records)
    model = fit_subspace(records, wanted, what=what, order=order, past=past)
    return FrequencyResponse(
        frequency=wanted, response=admittance_of(what, model.response(wanted)), covariance=None, what=what
    )


METHODS: dict[str, Callable[..., FrequencyResponse]] = {
    "spectral": spectral_response,
    "arx": arx_response,
    "subspace": subspace_response,
}
"""Name of a method to what estimates by it."""


def estimate_response(
    recording: Recordings, method: str = "spectral", frequency: ArrayLike | None = None, **options: Any
) -> FrequencyResponse:
    """Frequency response of the arm, the environment or both, without a model of the arm.

    Args:
      recording: trials of one person in one condition.
      method: one of `METHODS`.
      frequency: where the response is wanted [Hz], (frequency,); None leaves it to the method.
      **options: of the method, see its function.

    Raises:
      TypeError: the method lacks an option.
      ValueError: the method is unknown, or as its function.
    """
    if method not in METHODS:
        raise ValueError(f"method = {method!r}; expected one of {', '.join(METHODS)}")
    return METHODS[method](recording, frequency=frequency, **options)


def _wanted(frequency: ArrayLike | None, records: JointRecords) -> Array:
    return records.excited_frequencies() if frequency is None else _checked(frequency, records.rate)


def _checked(frequency: ArrayLike, rate: float) -> Array:
    wanted = np.array(frequency, dtype=float)
    if wanted.ndim != 1 or not len(wanted):
        raise ValueError(f"frequency has shape {wanted.shape}; expected (frequency,), at least one")
    wrong = ~((wanted > 0.0) & (wanted < 0.5 * rate))
    if wrong.any():
        raise ValueError(f"frequency = {wanted[wrong][0]:g} Hz; expected above 0 and below {0.5 * rate:g} Hz")
    return wanted
