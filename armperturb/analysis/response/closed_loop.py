"""Frequency responses of arm and environment from any disturbance: multisines, or noise (thesis 2.6, generalised).

Both read one or several recordings, which may differ in length, and use every sample from `window_start` to each
trial's pulse or end. What came before is leakage, which `local_polynomial` removes. It does so as long as what came
before dies away within a fraction of the record: a record that begins at rest, or later, has little of it.

**Multisines** of a known period and unknown lines, which the disturbance tells. Samples of equal phase are averaged,
so that 24 s of a period of 20.48 s hold one period of which a part is less noisy. The disturbance then sits on the
excited lines alone, and the quiet lines beside them show leakage and noise. Lines of a cluster share one polynomial.

**Noise**, or any other disturbance: the record is transformed as it is, and all lines near a frequency are used.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from armperturb.analysis.numerics.periodicity import samples_of_period
from armperturb.analysis.response.frequency_response import FrequencyResponse, System, require_frequencies
from armperturb.analysis.response.joint_records import excited_frequencies
from armperturb.analysis.response.line_balance import find_balance, holds
from armperturb.analysis.response.local_polynomial import (
    N_INPUTS,
    DependentDisturbancesError,
    LocalFit,
    Window,
    fit_locally,
    frequency_response,
    n_unknowns,
    where_independent,
    whole_window,
)
from armperturb.analysis.response.spectra import EXCITED_LINE
from armperturb.analysis.trials import (
    APERIODIC,
    ConditionTrials,
    SeveralTrials,
    TrialRecord,
    common_period,
    prepared_recordings,
    records_of,
)
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment
from armperturb.validation import require_number

Answer = Callable[[Array, ComplexArray, ComplexArray], ComplexArray]
"""Function mapping (frequency, D, Y) of lines to a replacement for Y = (F, X)."""

HIGHEST_ORDER = 2
"""Of the response's polynomial over a cluster, unless asked otherwise."""

HIGH_ORDERS = (2, 3, 4, 5)
"""Orders that are tried over many lines."""

LEAKAGE_ORDER = 2
"""Order of the leakage's polynomial."""

N_QUIET = 12
"""Quiet lines beside a cluster that tell its leakage and noise, on both sides together."""

NARROW, WIDE = 0.03, 0.15
"""Width of a group over its frequency: below the first the response does not bend, above the second it may [-]."""

CLEARLY = 3.0
"""Standard deviations by which a higher order has to fit better than chance to be taken [-]."""

LEAST_DOF = 8.0
"""Complex degrees of freedom that a covariance has at least: then bands are at most a third wider than with many."""

FADE = 2.0
"""Time over which the weights of samples of equal phase change [s]; less if a record is hardly longer than a period."""

HALF_WIDTH = (0.2, 0.1)
"""Least half width of the band around a frequency from which the response is estimated: [Hz], for noise alone, and
relative to the frequency [-]."""

N_POINTS = 40
"""Frequencies at which the response to noise is estimated, unless asked otherwise."""


class Periods(NamedTuple):
    """One trial of a periodic disturbance.

    Attributes:
      perturbation: FFT of the period-averaged d, divided by sqrt(1 / n_periods) so that noise has the same variance in
        all trials, (line, axis).
      answer: the same of F and X, (line, 4).
      share: of the noise power that is left in the mean period, one over the number of periods [-].
      contrasts: f and x less the mean of the periods before, weighted so that they hold the noise as it is and nothing
        that is periodic; one of each further period, of which the last may be short; each (time, 4).
    """

    perturbation: ComplexArray
    answer: ComplexArray
    share: float
    contrasts: tuple[Array, ...]


class Periodic(NamedTuple):
    """All trials of a periodic disturbance.

    Attributes:
      trials: one or more.
      excited: numbers of the excited lines, cycles per period, (line,).
      groups: excited lines that share a polynomial, numbers.
      period: [s].
      rate: of the samples [Hz].
    """

    trials: tuple[Periods, ...]
    excited: NDArray[np.int64]
    groups: tuple[NDArray[np.int64], ...]
    period: float
    rate: float

    def replaced(self, answer: Answer) -> "Periodic":
        """The same with what a function makes of frequency, D and (F, X) of each trial in place of the latter."""
        frequency = np.arange(len(self.trials[0].answer)) / self.period
        trials = [trial._replace(answer=answer(frequency, trial.perturbation, trial.answer)) for trial in self.trials]
        return self._replace(trials=tuple(trials))

    def windows(self, group: NDArray[np.int64]) -> list[Window]:
        """The lines of a group and the quiet ones nearest to it, of each trial."""
        quiet = np.setdiff1d(np.arange(1, len(self.trials[0].perturbation) - 1), self.excited)
        distance = np.maximum(group[0] - quiet, quiet - group[-1])
        beside = quiet[np.argsort(distance, kind="stable")[:N_QUIET]]
        beside = beside[np.maximum(group[0] - beside, beside - group[-1]) <= 2 * N_QUIET]
        lines = np.sort(np.concatenate([group, beside]))
        excited = np.isin(lines, group)
        return [
            Window(lines / self.period, trial.perturbation[lines] * excited[:, None], trial.answer[lines], excited)
            for trial in self.trials
        ]

    def fit(self, order: int | None, *, own_levels: bool = False) -> list[LocalFit]:
        """The response near the middle of each group.

        Polynomials have at most one term per excited line; by default at most `HIGHEST_ORDER`, beyond the first order
        only half as many terms as equations, or one less than equations where the group is `WIDE`; of groups of many
        lines, or wide ones, more if those fit clearly better.
        """
        fits = []
        for group in self.groups:
            chosen = self._orders(len(group), float(np.ptp(group) / group.mean())) if order is None else (order,)
            orders = sorted({min(choice, len(group) - 1) for choice in chosen})
            fits.append(fit_near(self.windows(group), float(group.mean()) / self.period, orders, own_levels))
        return fits

    def _orders(self, n_lines: int, width: float) -> tuple[int, ...]:
        """Orders to try of the polynomial over a group of that relative width, in rising order."""
        equations = n_lines * len(self.trials) // N_INPUTS
        terms = equations - 1 if width > WIDE else equations // 2
        if n_lines > N_QUIET or (width > WIDE and terms > HIGHEST_ORDER + 1):
            return HIGH_ORDERS
        return (min(max(1, terms - 1), HIGHEST_ORDER if width > NARROW else 1),)


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


def periodic_trials(
    recordings: SeveralTrials, *, period: float | None, window_start: float, lines_per_average: int
) -> Periodic:
    """Mean periods and what differs between them.

    Args:
      recordings: trials of one subject in one condition.
      period: of the disturbance [s]; None finds it, see `periodicity`.
      window_start: start of what is used [s].
      lines_per_average: excited lines in a group, where there are as many without a wider gap than between the closest
        two; more where quiet lines are too few to tell leakage and noise.

    Raises:
      ValueError: as `records_of`; or a trial is shorter than a period, the disturbance is not periodic, or the period
        is not a whole number of samples.
    """
    require_number("periodic_trials", "lines_per_average", lines_per_average, at_least=1)
    several = prepared_recordings(recordings)
    rate = several[0].rate
    if period is None:
        period = common_period(several, window_start)
    records = records_of(several, window_start)
    n = samples_of_period(period, rate)
    trials = []
    for number, record in enumerate(records):
        d = record.perturbation
        if len(d) < n:
            raise ValueError(
                f"trial {number} holds {len(d) / rate:g} s from {window_start:g} s on; expected a whole period of "
                f"{period:g} s (an earlier --window-start)"
            )
        if np.mean((d[n:] - d[:-n]) ** 2 if len(d) > n else 0.0) > APERIODIC * np.mean(d**2):
            raise ValueError(
                f"the perturbation of trial {number} does not repeat after {period:g} s; expected its own period "
                "(without --period it is found; for noise there is --method noise)"
            )
        trials.append(_mean_period(record, n))
    power = np.sum([np.abs(trial.perturbation) ** 2 for trial in trials], axis=(0, 2))
    power[[0, -1]] = 0.0
    excited = np.flatnonzero(power > EXCITED_LINE * power.max())
    return Periodic(tuple(trials), excited, _groups(excited, len(trials), lines_per_average), period, rate)


def _mean_period(record: TrialRecord, n: int) -> Periods:
    """Mean over periods by weights that sum to one at each phase and fade in and out.

    A jump in the weights would spread slow noise over all lines.
    """
    signals = np.concatenate([record.perturbation, record.response], axis=1)
    n_all = len(signals)
    n_fade = min(round(FADE * record.rate), n_all - n)
    inner = np.zeros(-(-n_all // n) * n)
    inner[n_fade // 2 : n_all - (n_fade + 1) // 2] = 1.0
    count = inner.reshape(-1, n).sum(axis=0)
    weights = (inner.reshape(-1, n) / count).ravel()
    if n_fade > 1:
        # A fade keeps the sum over periods, as it averages over neighbouring phases.
        fade = signal.windows.hann(n_fade + 1)
        weights = signal.fftconvolve(weights, fade / fade.sum(), mode="same")
    padded = np.zeros((len(weights), signals.shape[1]))
    padded[:n_all] = signals
    mean = (weights[:, None] * padded).reshape(-1, n, signals.shape[1]).sum(axis=0)
    share = float(np.sum(weights[:n_all] ** 2) / n)
    spectrum = np.fft.rfft(mean, axis=0) / np.sqrt(n * share)
    contrasts, total = [], record.response[:n].copy()
    for first in range(n, n_all, n):
        part = record.response[first : first + n]
        m, k = first // n, len(part)
        contrasts.append(np.sqrt(m / (m + 1)) * (part - total[:k] / m))
        total[:k] += part
    return Periods(spectrum[:, :2], spectrum[:, 2:], share, tuple(contrasts))


def _groups(excited: NDArray[np.int64], n_trials: int, size: int) -> tuple[NDArray[np.int64], ...]:
    """Excited lines that share a polynomial.

    Long runs have no quiet lines around, or many lines that single ones would be too noisy for: groups are as large as
    the leakage asks for, and grow with frequency.
    """
    gaps = np.diff(excited)
    closest = int(gaps.min(initial=excited[-1]))
    runs = np.split(excited, np.flatnonzero(gaps > 2 * closest) + 1)
    equations = n_unknowns(n_trials, HIGHEST_ORDER, LEAKAGE_ORDER) + LEAST_DOF
    groups: list[NDArray[np.int64]] = []
    for run in runs:
        if len(run) <= N_QUIET:
            groups += np.array_split(run, max(1, len(run) // size))
            continue
        least = max(size, int(np.ceil(equations / n_trials))) if closest == 1 else size
        while len(run):
            count = max(least, round(2 * HALF_WIDTH[1] * run[0] / closest))
            if len(run) < 2 * count:
                count = len(run)
            groups.append(run[:count])
            run = run[count:]
    return tuple(groups)


def estimate_multisine(
    recordings: SeveralTrials,
    *,
    frequency: ArrayLike | None = None,
    what: System = "arm",
    period: float | None = None,
    window_start: float = 2.0,
    lines_per_average: int = 4,
    order: int | None = None,
    balance: bool = True,
) -> FrequencyResponse:
    """Frequency response from periodic multisines.

    The covariance is that of the excited lines, with whatever else differs between lines and trials (distortion by a
    nonlinear arm, a person who changes); of too few trials for that, it comes from the quiet lines as well, and holds
    noise alone.

    Args:
      recordings: trials of one subject in one condition; the same or different multisines of one period.
      frequency: some of those at which there are estimates [Hz], (frequency,); None gives all.
      what: "arm" (from f to x), "environment" (from d - f to x) or "total" (from d to x).
      period: of the disturbance [s]; None finds it in what was recorded, for at least 1.1 periods.
      window_start: start of what is used [s].
      lines_per_average: neighbouring lines that share a polynomial: the clusters of the thesis's multisine have 4.
      order: of that polynomial; by default 2 if there are at least twice as many equations as it has terms, or lines
        are far apart, and else 1.
      balance: whether displacement and force are made better by the environment's force balance where that holds, see
        `line_balance`; not of what="environment", which then would be what was put in.

    Raises:
      ValueError: as `periodic_trials` and `fit_locally`, `what` is something else, or there is no estimate at a
        frequency.
    """
    require_number("estimate_multisine", "order", order, at_least=0, optional=True)
    several = prepared_recordings(recordings)
    trials = periodic_trials(several, period=period, window_start=window_start, lines_per_average=lines_per_average)

    def fit(answer: Answer) -> list[LocalFit]:
        return trials.replaced(answer).fit(order)

    fits, environment = _balanced(fit, several if balance and what != "environment" else None)
    noises = [
        (fit.excited_noise, fit.excited_dof) if fit.excited_dof >= LEAST_DOF else (fit.noise, fit.dof) for fit in fits
    ]
    return frequency_response(fits, what, noises, environment).at(frequency)


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
      what: as in `estimate_multisine`.
      window_start: start of what is used [s].
      frequency: where the response is wanted [Hz], (frequency,); None takes up to 40 of those that the disturbance
        excites.
      order: of the response's polynomial; by default 2, or up to 5 where that fits clearly better. The band around a
        frequency is as wide as `HALF_WIDTH` says, and wider where that gives fewer than `LEAST_DOF` degrees of freedom.
      balance: as in `estimate_multisine`.

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

    fits, environment = _balanced(fit, several if balance and what != "environment" else None)
    return frequency_response(fits, what, [(fit.noise, fit.dof) for fit in fits], environment)


def _balanced(
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
