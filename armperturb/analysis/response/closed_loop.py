"""Frequency responses of arm and environment from noise, or any other disturbance (thesis 2.6, generalised).

One or several recordings are read, which may differ in length, with every sample from `window_start` to each trial's
pulse or end. What came before is leakage, which `local_polynomial` removes. It does so as long as what came before dies
away within a fraction of the record: a record that begins at rest, or later, has little of it. The record is
transformed as it is, and all lines near a frequency are used; those of multisines are in `multisines`.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from armperturb.analysis.response.frequency_response import FrequencyResponse, System, require_frequencies
from armperturb.analysis.response.joint_records import excited_frequencies
from armperturb.analysis.response.line_balance import find_balance, holds
from armperturb.analysis.response.local_polynomial import (
    DependentDisturbancesError,
    LocalFit,
    Window,
    fit_locally,
    frequency_response,
    n_unknowns,
    where_independent,
    whole_window,
)
from armperturb.analysis.trials import ConditionTrials, SeveralTrials, TrialRecord, prepared_recordings, records_of
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment
from armperturb.validation import require_number

Answer = Callable[[Array, ComplexArray, ComplexArray], ComplexArray]
"""Function mapping (frequency, D, Y) of lines to a replacement for Y = (F, X)."""

HIGH_ORDERS = (2, 3, 4, 5)
"""Orders that are tried over many lines."""

LEAKAGE_ORDER = 2
"""Order of the leakage's polynomial."""

CLEARLY = 3.0
"""Standard deviations by which a higher order has to fit better than chance to be taken [-]."""

LEAST_DOF = 8.0
"""Complex degrees of freedom that a covariance has at least: then bands are at most a third wider than with many."""

HALF_WIDTH = (0.2, 0.1)
"""Least half width of the band around a frequency from which the response is estimated: [Hz], for noise alone, and
relative to the frequency [-]."""

N_POINTS = 40
"""Frequencies at which the response to noise is estimated, unless asked otherwise."""


def fit_near(windows: Sequence[Window], centre: float, orders: Sequence[int], own_levels: bool = False) -> LocalFit:
    """Raise the order while a likelihood-ratio test favours it and 2 `LEAST_DOF` residual degrees of freedom remain.

    The answer to a single pulse is as smooth in frequency as leakage, which is not fitted where nothing leaks.

    Where it is not needed, a further complex coefficient of an output lowers the logarithm of its sum of squares, times
    the number of lines, by about a gamma variable of shape one.
    """
    leakage_order = LEAKAGE_ORDER if any(window.leaks for window in windows) else -1
    fit = partial(fit_locally, windows, centre, leakage_order=leakage_order, own_levels=own_levels)
    best = fit(order=orders[0])
    for lower, order in pairwise(orders):
        extra = windows[0].perturbation.shape[1] * (order - lower)
        if round(best.dof - extra, 6) < 2 * LEAST_DOF:  # a whole number, summed in the order of the trials
            break
        try:
            better = fit(order=order)
        except DependentDisturbancesError:
            if leakage_order >= 0:
                raise
            break  # a pulse has the same spectrum in every trial, which determines fewer terms than there are lines
        before, after = (np.log(fit.dof * np.diagonal(fit.noise).real) for fit in (best, better))
        gain = float(np.max(before - after)) * (best.dof + better.dof) / 2
        if gain < extra + CLEARLY * np.sqrt(extra):
            break
        best = better
    return best


def fit_determined(
    windows: Sequence[Window], centre: float, orders: Sequence[int], own_levels: bool = False
) -> LocalFit:
    """As `fit_near`; where the lines determine no more, with the highest order that they do.

    Raises:
      DependentDisturbancesError: they determine none.
    """
    lower = range(orders[0] - (len(orders) == 1), -1, -1)
    *first, last = orders, *((order,) for order in lower)
    for each in first:
        with suppress(DependentDisturbancesError):
            return fit_near(windows, centre, each, own_levels)
    return fit_near(windows, centre, last, own_levels)


def estimate_noise(
    recordings: SeveralTrials,
    *,
    what: System = "arm",
    window_start: float = 0.0,
    frequency: ArrayLike | None = None,
    order: int | None = None,
    balance: bool = True,
) -> FrequencyResponse:
    """Frequency response from noise, or any disturbance that has power at all frequencies of interest.

    Args:
      recordings: trials of one subject in one condition; their lengths may differ.
      what: "arm" (from f to x), "environment" (from d - f to x) or "total" (from d to x).
      window_start: start of what is used [s].
      frequency: where the response is wanted [Hz], (frequency,); None takes up to 40 of those that the disturbance
        excites.
      order: of the response's polynomial; by default 2, or up to 5 where that fits clearly better. The band around a
        frequency is as wide as `HALF_WIDTH` says, and wider where that gives fewer than `LEAST_DOF` degrees of freedom.
      balance: whether displacement and force are made better by the environment's force balance where that holds, see
        `line_balance`; not of what="environment", which then would be what was put in.

    Raises:
      ValueError: as `records_of` and `fit_locally`, or the records are too short.
    """
    require_number("estimate_noise", "order", order, at_least=0, optional=True)
    orders: tuple[int, ...] = HIGH_ORDERS if order is None else (order,)
    several = prepared_recordings(recordings)
    records = records_of(several, window_start)
    spectra = [whole_window(record) for record in records]
    wanted = excited_band(records) if frequency is None else require_frequencies(frequency, records[0].rate)

    def fit(answer: Answer) -> list[LocalFit]:
        windows = [part._replace(answer=answer(part.frequency, part.perturbation, part.answer)) for part in spectra]

        def at(centre: float) -> LocalFit:
            return fit_near(lines_around(windows, centre, orders[0]), centre, orders)

        return [*map(at, wanted.tolist())] if frequency is not None else [*where_independent(wanted, at).values()]

    fits, environment = balanced(fit, several if balance and what != "environment" else None)
    return frequency_response(fits, what, [(fit.noise, fit.dof) for fit in fits], environment)


def balanced(
    fit: Callable[[Answer], list[LocalFit]], trials: Sequence[ConditionTrials] | None
) -> tuple[list[LocalFit], Environment | None]:
    """Fits of signals made better by the force balance of these trials, and the environment; as recorded if none holds.

    Args:
      fit: the fits with what a function makes of the signals.
      trials: from which the balance is found; None to use none.
    """
    balance = None if trials is None else find_balance(trials)
    if balance is not None and holds(fit(balance.left_over)):
        return fit(balance.corrected), balance.environment
    return fit(lambda frequency, perturbation, answer: answer), None


def local_fits(recordings: SeveralTrials, window_start: float) -> tuple[list[LocalFit], ComplexArray]:
    """Responses to d of f and x as they were recorded, near frequencies that d excites, and the power of d there.

    Args:
      recordings: trials of one subject in one condition; their lengths may differ.
      window_start: start of what is used [s].

    Returns:
      The fits, and the mean of D D^H over the lines of each, (frequency, axis, axis).

    Raises:
      ValueError: as `estimate_noise`.
    """
    records = records_of(prepared_recordings(recordings), window_start)
    spectra = [whole_window(record) for record in records]

    def near(centre: float) -> list[Window]:
        return lines_around(spectra, centre, HIGH_ORDERS[0])

    fits = where_independent(excited_band(records), lambda centre: fit_near(near(centre), centre, HIGH_ORDERS))
    lines = [np.concatenate([window.perturbation for window in near(centre)]) for centre in fits]
    return [*fits.values()], np.array([d.T @ d.conj() / len(d) for d in lines])


def excited_band(records: Sequence[TrialRecord]) -> Array:
    """At most `N_POINTS` frequencies [Hz] that the disturbance excites, (frequency,).

    They share out the band that holds all but 1 % of its power evenly on a logarithmic scale, as far as there is power.
    """
    excited = excited_frequencies(records)
    most = max(len(record.perturbation) for record in records)
    longest = [whole_window(record) for record in records if len(record.perturbation) == most]
    power = np.cumsum(sum(np.sum(np.abs(each.perturbation) ** 2, axis=1) for each in longest))
    low, high = np.interp([0.005, 0.995], power / power[-1], longest[0].frequency)
    even = np.geomspace(low, high, N_POINTS)
    return np.unique(excited[np.abs(excited - even[:, None]).argmin(axis=1)])


def lines_around(spectra: Sequence[Window], centre: float, order: int) -> list[Window]:
    """The lines of all records near a frequency, as many as a polynomial of the order asks for."""
    n_inputs = spectra[0].perturbation.shape[1]
    step = min(float(window.frequency[0]) for window in spectra)
    highest = max(float(window.frequency[-1]) for window in spectra)
    half = max(HALF_WIDTH[0], HALF_WIDTH[1] * centre)
    while half < highest:
        windows = [window.within(centre - half, centre + half) for window in spectra]
        used = [window for window in windows if len(window.frequency) > LEAKAGE_ORDER + 1]
        rows = sum(len(window.frequency) for window in used)
        if used and rows >= n_unknowns(len(used), order, LEAKAGE_ORDER, n_inputs=n_inputs) + LEAST_DOF:
            return used
        half += step / 2
    raise ValueError(f"the recordings hold too few lines around {centre:.3f} Hz; expected longer or more trials")
