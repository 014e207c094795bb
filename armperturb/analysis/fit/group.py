"""Trials of one person in one condition together with the structure that is fitted to them, and their likelihoods."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.fit.likelihood import Likelihood, PeriodLikelihood, RecordLikelihood, Signals, whitened
from armperturb.analysis.fit.linear_start import linear_start
from armperturb.analysis.fit.structures import Structure
from armperturb.analysis.force_balance import EDGE
from armperturb.analysis.response.spectra import averaged_spectra, line_spectra
from armperturb.analysis.trials import ConditionTrials, Trials, per_trials, prepared
from armperturb.arrays import Array
from armperturb.validation import require_number

Method = Literal["frequency", "record"]
"""Whether the mean period of each trial is used, or all of it from its start."""

NOT_PERIODIC = 0.01
"""RMS of what changes from period to period over that of the perturbation from which on it is not periodic [-]."""


@per_trials
def _white(trials: ConditionTrials) -> Array:
    """Whitened displacement, (trial, time, axis)."""
    return whitened(trials.displacement, trials.rate)


@dataclass(frozen=True, kw_only=True, eq=False)
class Group:
    """Trials of one person in one condition, and the structure that is fitted to them.

    Attributes:
      trials: the trials.
      structure: what is free.
      initial: values of the free parameters by linear least squares, from which a search may start, (parameter,).
      period: likelihood of the mean periods.
      record: likelihood of the whole records.
    """

    trials: ConditionTrials
    structure: Structure
    initial: Array
    period: Likelihood
    record: Likelihood

    @classmethod
    def prepare(
        cls,
        trials: Trials,
        structure: Structure,
        *,
        window_start: float = WINDOW_START,
        period: float | None = None,
        settle: float = 0.0,
    ) -> Self:
        """Prepare trials. Of trials with pulses, what is before the earliest is used.

        Args:
          trials: of one person in one condition, or their recording.
          structure: what is to be estimated.
          window_start: start of the window of whole periods, after the transient has died away [s].
          period: of the disturbance [s]; None to find it.
          settle: time at the start of the records that "record" does not judge [s]: 0 where they start at rest, some 8
            s where they start amid the perturbation, so that the response to what is not recorded has died away.

        Raises:
          ValueError: the recording is refused, gives no spectra, is of several people, tasks or postures, its
            perturbation is not periodic, or settle leaves less than a period.
        """
        trials = prepared(trials)
        body = trials.body
        spectra = averaged_spectra(trials, window_start=window_start, period=period)
        lines = line_spectra(trials, window_start=window_start, period=period)
        rate = trials.rate
        period = trials.period(window_start) if period is None else period
        n_period, first = round(period * rate), round(window_start * rate)
        d = trials.perturbation
        _require_periodic(d, first, n_period, rate)
        environment, white = trials.environment, _white(trials)
        end = min(trials.first_onset, trials.n_samples - round(EDGE * rate))
        require_number("Group", "settle", settle, at_least=0.0, at_most=end / rate - period)
        top = min(1.1 * float(lines.frequency[-1]), 0.45 * rate)
        last = first + n_period * max(1, (end - first) // n_period)

        def signals(window: slice) -> Signals:
            return Signals(d[:, window], white[:, window], body, environment, rate)

        return cls(
            trials=trials,
            structure=structure,
            initial=linear_start(spectra.frequency, spectra.arm, body, structure),
            period=PeriodLikelihood(signals(slice(first, last)), n_period, top),
            record=RecordLikelihood(signals(slice(end)), top, settle),
        )


def require_one_person(groups: Sequence[Group]) -> None:
    """Refuse groups of several people or postures, or two of one condition.

    Raises:
      ValueError: there are such.
    """
    labels = [group.trials.label for group in groups]
    for field in ("name", "l_h", "l_f", "theta_s_deg", "theta_e_deg"):
        values = {getattr(group.trials.body, field) for group in groups}
        if len(values) > 1:
            raise ValueError(
                f"the conditions {', '.join(labels)} differ in {field} ({', '.join(map(str, sorted(values)))}); "
                "expected one person in one posture"
            )
    for label in labels:
        if labels.count(label) > 1:
            raise ValueError(f"the condition {label!r} comes twice; expected each once (its trials in one group)")


def _require_periodic(perturbation: Array, first: int, n_period: int, rate: float) -> None:
    """Refuse a perturbation that is another before and in the window than a period later."""
    n = min(n_period, first // 2)
    earlier, later = perturbation[:, first - n : first], perturbation[:, first - n + n_period : first + n_period]
    change = np.sqrt(np.mean((later - earlier) ** 2, axis=(1, 2))) if n else np.zeros(len(perturbation))
    rms = np.sqrt(np.mean(perturbation[:, first : first + n_period] ** 2, axis=(1, 2)))
    worst = int(np.argmax(change / rms))
    if change[worst] > NOT_PERIODIC * rms[worst]:
        raise ValueError(
            f"the perturbation of trial {worst} changes by {change[worst] / rms[worst]:.0%} of its RMS from one period "
            f"of {n_period / rate:g} s to the next; expected a periodic one (another period?)"
        )
