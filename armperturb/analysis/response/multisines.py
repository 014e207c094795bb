"""Frequency responses from multisines of a known period, whose lines the disturbance tells (thesis 2.6, generalised).

Samples of equal phase are averaged, so that 24 s of a period of 20.48 s hold one period of which a part is less noisy.
The disturbance then sits on the excited lines alone, and the quiet lines beside them show leakage and noise. A period
whose every line is excited has no quiet ones. Where trials hold several of it, some of them together are taken for one,
which has quiet lines between the excited ones.

Lines near each other share one polynomial, as far as the response is smooth over their distance.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from armperturb.analysis.defaults import LINES_PER_AVERAGE, SETTLED
from armperturb.analysis.numerics.periodicity import samples_of_period
from armperturb.analysis.periods import APERIODIC, common_period, settled_start, without_fade
from armperturb.analysis.response.closed_loop import (
    HALF_WIDTH,
    HIGH_ORDERS,
    LEAKAGE_ORDER,
    LEAST_DOF,
    Answer,
    balanced,
    fit_determined,
    fit_near,
)
from armperturb.analysis.response.frequency_response import FrequencyResponse, System
from armperturb.analysis.response.local_polynomial import (
    N_INPUTS,
    DependentDisturbancesError,
    LocalFit,
    Window,
    frequency_response,
    n_unknowns,
)
from armperturb.analysis.response.spectra import excited_lines
from armperturb.analysis.trials import SeveralTrials, TrialRecord, prepared_recordings, records_of
from armperturb.arrays import Array, ComplexArray
from armperturb.validation import require_number

HIGHEST_ORDER = 2
"""Of the response's polynomial over a cluster, unless asked otherwise."""

APART = 4
"""Lines of the transform from one excited line to the next, where trials hold as many periods as that takes."""

INDEPENDENT, DEPENDENT = 0.2, 0.01
"""Smallest over largest singular value of disturbances that tell two responses from each other, and that do not [-]."""

MOST_SAMPLES = 0.75
"""Share of the samples that must be in trials of so many periods for these to be taken together [-]."""

WIDEST = 1.25
"""Band of lines up to which polynomials follow the response of most arms [Hz]."""

FEWEST = 0.25
"""Share of the groups of lines that have to tell of both directions [-]."""

FOR_SECOND_ORDER = 12
"""Excited lines of all trials together from which on a group has a polynomial of second order."""

N_QUIET = 12
"""Quiet lines beside a cluster that tell its leakage and noise, on both sides together."""

NARROW, WIDE = 0.03, 0.15
"""Width of a group over its frequency: below the first the response does not bend, above the second it may [-]."""


FADE = 2.0
"""Time over which the weights of samples of equal phase change [s]; less if a record is hardly longer than a period."""


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
      remarks: on trials and lines that are left out.
    """

    trials: tuple[Periods, ...]
    excited: NDArray[np.int64]
    groups: tuple[NDArray[np.int64], ...]
    period: float
    rate: float
    remarks: tuple[str, ...] = ()

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
        lines, or wide ones, more if those fit clearly better. Lines that excite one direction each determine fewer.
        """
        fits, fit = [], fit_determined if order is None else fit_near
        for group in self.groups:
            chosen = self._orders(len(group), float(np.ptp(group) / group.mean())) if order is None else (order,)
            orders = sorted({min(choice, len(group) - 1) for choice in chosen})
            fits.append(fit(self.windows(group), float(group.mean()) / self.period, orders, own_levels))
        return fits

    def _orders(self, n_lines: int, width: float) -> tuple[int, ...]:
        """Orders to try of the polynomial over a group of that relative width, in rising order."""
        equations = n_lines * len(self.trials) // N_INPUTS
        terms = equations - 1 if width > WIDE else equations // 2
        if n_lines > N_QUIET or (width > WIDE and terms > HIGHEST_ORDER + 1):
            return HIGH_ORDERS
        return (min(max(1, terms - 1), HIGHEST_ORDER if width > NARROW else 1),)


def periodic_trials(
    recordings: SeveralTrials,
    *,
    period: float | None,
    window_start: float,
    lines_per_average: int,
    apart: int = 1,
    shortest: float = 0.0,
) -> Periodic:
    """Mean periods and what differs between them.

    Args:
      recordings: trials of one subject in one condition.
      period: of the disturbance [s]; None finds it, see `periodicity`.
      window_start: start of what is used [s]; of trials that nothing perturbs yet, see `settled_start`.
      lines_per_average: excited lines in a group, where there are as many without a wider gap than between the closest
        two; more where quiet lines are too few to tell leakage and noise, or the band is wide; fewer where they are far
        apart, each tells the responses along x and y, and `apart` is above 1.
      apart: several periods count as one, until excited lines are so many lines apart or most trials hold no more;
        shorter trials are left out.
      shortest: several periods count as one likewise, until they last so long [s].

    Raises:
      ValueError: as `records_of`; or a trial is shorter than a period, the disturbance is not periodic, or the period
        is not a whole number of samples.
      DependentDisturbancesError: hardly any group of lines tells of the response along both directions.
    """
    require_number("periodic_trials", "lines_per_average", lines_per_average, at_least=1)
    several = prepared_recordings(recordings)
    rate = several[0].rate
    if period is None:
        period = common_period(several, window_start)
    start = settled_start(several, window_start)
    n = samples_of_period(period, rate)
    records = [without_fade(record, n) for record in records_of(several, start)]
    for number, record in enumerate(records):
        d = record.perturbation
        if len(d) < n:
            raise ValueError(
                f"trial {number} holds {len(d) / rate:g} s from {start:g} s on; expected a whole period of "
                f"{period:g} s (an earlier --window-start)"
            )
        if np.mean((d[n:] - d[:-n]) ** 2 if len(d) > n else 0.0) > APERIODIC * np.mean(d**2):
            raise ValueError(
                f"the perturbation of trial {number} does not repeat after {period:g} s from {start:g} s on; expected "
                "its own period (without --period it is found; a later --window-start leaves out what comes before; "
                "for noise there is --method noise)"
            )
    trials, excited = _mean_periods(records, n)
    wanted = max(-(-apart // _closest(excited)), int(np.ceil(shortest / period)))
    n_held, n_samples = np.array([[len(record.perturbation) // n, len(record.perturbation)] for record in records]).T
    enough = [
        k
        for k in range(1, wanted + 1)
        if n_samples[n_held >= k].sum() > MOST_SAMPLES * n_samples.sum()
        and np.sum(n_held >= k) > min(N_INPUTS, len(records) - 1)  # which tell x from y at each line
    ]
    together = max(enough, default=1)
    remarks: tuple[str, ...] = ()
    if start > window_start:
        remarks += (f"nothing perturbs all trials before {start - SETTLED:.3g} s: they are used from {start:.3g} s on",)
    if together > 1:
        if n_short := int(np.sum(n_held < together)):
            remarks += (
                f"{n_short} of {len(records)} trials hold fewer than {together} periods of {period:g} s, and are left "
                "out: so many are taken together",
            )
        trials, excited = _mean_periods([records[k] for k in np.flatnonzero(n_held >= together)], together * n)
        period *= together
    groups = _groups(excited, trials, lines_per_average, period, is_fine=apart > 1)
    telling = [_independence(trials, group) > DEPENDENT for group in groups]
    if telling.count(True) < FEWEST * len(groups):
        are_proportional = not _independence(trials, excited) > DEPENDENT
        raise DependentDisturbancesError(
            float(groups[telling.index(False)].mean()) / period,
            are_proportional,
            has_more_lines=max(map(len, groups)) > 1,
        )
    if n_silent := telling.count(False):
        remarks += (
            f"{n_silent} of {len(groups)} groups of lines are left out, in which the perturbation has one direction "
            "alone (the method arx needs no lines)",
        )
    groups = tuple(group for group, tells in zip(groups, telling, strict=True) if tells)
    return Periodic(trials, excited, groups, period, rate, remarks)


def _independence(trials: Sequence[Periods], lines: NDArray[np.int64]) -> float:
    """Smallest over largest singular value of what is pushed along x and y at these lines [-]."""
    large = np.linalg.svd(np.concatenate([trial.perturbation[lines] for trial in trials]), compute_uv=False)
    return float(large[-1] / large[0]) if len(large) == N_INPUTS else 0.0


def _mean_periods(records: Sequence[TrialRecord], n: int) -> tuple[tuple[Periods, ...], NDArray[np.int64]]:
    """Mean periods of n samples, and the numbers of the excited lines."""
    trials = tuple(_mean_period(record, n) for record in records)
    power = np.sum([np.abs(trial.perturbation) ** 2 for trial in trials], axis=0)
    power[[0, -1]] = 0.0
    return trials, excited_lines(power)


def _closest(excited: NDArray[np.int64]) -> int:
    """Lines from an excited one to the next, where these are closest."""
    return int(np.diff(excited).min(initial=excited[-1]))


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


def _groups(
    excited: NDArray[np.int64], trials: Sequence[Periods], size: int, period: float, *, is_fine: bool
) -> tuple[NDArray[np.int64], ...]:
    """Excited lines that share a polynomial.

    Long runs have no quiet lines around, or many lines that single ones would be too noisy for: groups are as large as
    the leakage asks for, and grow with frequency. Lines that are far apart are finely divided, if that is asked for and
    each tells what x and y do: they share a polynomial only within half the band that noise has, as the response bends
    over more, and only where it may be of second order.
    """
    closest = _closest(excited)
    runs = np.split(excited, np.flatnonzero(np.diff(excited) > 2 * closest) + 1)
    equations = n_unknowns(len(trials), HIGHEST_ORDER, LEAKAGE_ORDER) + LEAST_DOF
    groups: list[NDArray[np.int64]] = []
    for run in runs:
        is_wide = np.ptp(run) / period > 2.0 * HALF_WIDTH[0]
        if is_fine and closest > 1 and is_wide and _tell_both(trials, run):
            groups += _fine_groups(run, len(trials), size, period)
            continue
        if len(run) <= N_QUIET:
            groups += np.array_split(run, max(1, len(run) // size))
            continue
        least = max(size, int(np.ceil(equations / len(trials)))) if closest == 1 else size
        while len(run):
            count = max(least, round(2 * HALF_WIDTH[1] * run[0] / closest))
            if len(run) < 2 * count:
                count = len(run)
            groups.append(run[:count])
            run = run[count:]
    return tuple(groups)


def _fine_groups(run: NDArray[np.int64], n_trials: int, size: int, period: float) -> list[NDArray[np.int64]]:
    """Lines within bands over which the response hardly bends."""
    groups = []
    while len(run):
        within, half = (run - run[0]) / period, max(HALF_WIDTH[0], HALF_WIDTH[1] * run[0] / period)
        count = max(
            min(size, int(np.sum(within <= half))), int(np.sum(within < 2 * HALF_WIDTH[1] * run[0] / period)), 1
        )
        is_bent = count <= HIGHEST_ORDER or count * n_trials < FOR_SECOND_ORDER  # more than its polynomial can be
        if within[count - 1] > HALF_WIDTH[0] and is_bent:
            # Of two trials, a line alone is as uncertain as the response that it has.
            count = 1 if n_trials > N_INPUTS else max(1, int(np.sum(within <= half)))
        groups.append(run[:count])
        run = run[count:]
    return groups


def _tell_both(trials: Sequence[Periods], lines: NDArray[np.int64]) -> bool:
    """Whether most lines, each by itself, tell what a push along x does from what a push along y does."""
    return bool(np.median([_independence(trials, line) for line in lines[:, None]]) > INDEPENDENT)


def estimate_multisine(
    recordings: SeveralTrials,
    *,
    frequency: ArrayLike | None = None,
    what: System = "arm",
    period: float | None = None,
    window_start: float = 2.0,
    lines_per_average: int = LINES_PER_AVERAGE,
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
      lines_per_average: neighbouring lines that share a polynomial: the clusters of the thesis's multisine have 4. They
        are fewer where lines are far apart, and more in a wide band with many lines.
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
    trials = periodic_trials(
        several, period=period, window_start=window_start, lines_per_average=lines_per_average, apart=APART
    )

    def fit(answer: Answer) -> list[LocalFit]:
        return trials.replaced(answer).fit(order)

    fits, environment = balanced(fit, several if balance and what != "environment" else None)
    noises = [
        (fit.excited_noise, fit.excited_dof) if fit.excited_dof >= LEAST_DOF else (fit.noise, fit.dof) for fit in fits
    ]
    estimate = frequency_response(fits, what, noises, environment).at(frequency)
    return replace(estimate, remarks=(*trials.remarks, *_on_distance(trials)))


def _on_distance(trials: Periodic) -> tuple[str, ...]:
    """A remark where the response is taken for smooth over lines that are far apart, and need not be."""
    widths = [(float(group.mean()) / trials.period, float(np.ptp(group)) / trials.period) for group in trials.groups]
    wide = [
        group
        for group, (middle, width) in zip(trials.groups, widths, strict=True)
        if len(group) <= N_QUIET
        and width > 2.0 * max(HALF_WIDTH[0], HALF_WIDTH[1] * middle)
        and not _tell_both(trials.trials, group)
    ]
    closest = _closest(trials.excited)
    if not wide and closest == 1 and (middle_of := [f for f, width in widths if width > max(WIDEST, f / 2.0)]):
        return (
            f"every line of a period of {trials.period:g} s is excited, of which trials hold hardly two: at "
            f"{', '.join(f'{f:.3g}' for f in middle_of)} Hz lines over more than {WIDEST:g} Hz share a point, and "
            "circles may hold too little (record longer trials; response --method arx needs no lines)",
        )
    if not wide:
        return ()
    gap, low, high = (value / trials.period for value in (closest, wide[0][0], wide[-1][-1]))
    return (
        f"lines of the perturbation are {gap:.3g} Hz apart, and single ones do not tell what x and y do: from "
        f"{low:.3g} to {high:.3g} Hz neighbours share a point, over which the response may bend by tens of percent, "
        "and circles hold too little (record trials with other phases along x and y; "
        "response --method arx needs no lines)",
    )
