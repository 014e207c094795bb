"""What a recording says of itself: the manipulator that it shows, its instruments, and samples that cannot be right."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armperturb.analysis.force_balance import Skew
from armperturb.analysis.imbalance import Imbalance
from armperturb.analysis.periods import common_period
from armperturb.analysis.plateaus import LEAST_RUN, clipped_stretches, held_stretches, runs
from armperturb.analysis.smoother import NoiseLevels
from armperturb.analysis.trials import ConditionTrials
from armperturb.environment import Environment

SIGNALS = ("perturbation", "force", "displacement")


class DataCheck(NamedTuple):
    """The trials of one condition.

    Attributes:
      n_trials: how many.
      durations: shortest and longest trial [s].
      rate: of the samples [Hz].
      period: of the perturbation [s]; None of one that is not periodic.
      from_rest: whether all trials start with the handle at rest.
      n_pulses: trials with a pulse.
      environment: mass, damping and stiffness that the manipulator showed.
      unexplained: share of its load that these leave [-].
      noise: of the instruments.
      skew: of the clocks of force and displacement.
      imbalance: what is wrong with a signal or the manipulator; None where nothing is known to be.
      clipped: signal and axis to the number of samples that are clipped, where there are any.
      held: longest stretch in which neither force nor displacement changes, or a sensor alone stands still [s].
    """

    n_trials: int
    durations: tuple[float, float]
    rate: float
    period: float | None
    from_rest: bool
    n_pulses: int
    environment: Environment
    unexplained: float
    noise: NoiseLevels
    skew: Skew
    imbalance: Imbalance | None
    clipped: dict[str, int]
    held: float


def check_data(parts: Sequence[ConditionTrials], window_start: float, period: float | None = None) -> DataCheck:
    """Look at the trials of one condition.

    Args:
      parts: the trials, those of one length together; manipulator, noise and skew are those of the first.
      window_start: from when on the analysis uses the trials [s].
      period: of the perturbation [s]; None to find it, if there is one.

    Raises:
      ValueError: as `ConditionTrials.instruments`.
    """
    first = parts[0]
    durations = [part.n_samples / part.rate for part in parts]
    return DataCheck(
        n_trials=sum(part.n_trials for part in parts),
        durations=(min(durations), max(durations)),
        rate=first.rate,
        period=_period(parts, window_start) if period is None else period,
        from_rest=all(part.from_rest for part in parts),
        n_pulses=sum(int(np.isfinite(part.direction_deg).sum()) for part in parts),
        environment=first.environment,
        unexplained=first.balance.unexplained(first.environment),
        noise=first.noise,
        skew=first.skew,
        imbalance=first.balance.imbalance,
        clipped=_clipped(parts),
        held=max(_held(part) for part in parts),
    )


def _period(parts: Sequence[ConditionTrials], window_start: float) -> float | None:
    try:
        return common_period(parts, window_start)
    except ValueError:
        return None


def _clipped(parts: Sequence[ConditionTrials]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for part in parts:
        for name, values in zip(SIGNALS, part.signals, strict=True):
            for trial in values:
                for axis, channel in zip("xy", trial.T, strict=True):
                    if not np.ptp(channel):
                        continue
                    stretches = clipped_stretches(channel, is_command=name == "perturbation")
                    if n := sum(end - start for start, end in stretches):
                        counts[f"{name} {axis}"] = counts.get(f"{name} {axis}", 0) + n
    return counts


def _held(trials: ConditionTrials) -> float:
    """Longest stretch without change of force and displacement together, or of a channel alone that is stuck [s]."""
    longest = 0
    for drive, values in zip(trials.signals[0], np.concatenate(trials.signals[1:], axis=2), strict=True):
        together = runs((np.diff(values, axis=0) == 0.0).all(axis=1))
        alone = [held for channel in values.T for held in held_stretches(channel, drive, trials.rate)]
        longest = max([longest, *(end - start + 1 for start, end in together), *(end - start for start, end in alone)])
    return longest / trials.rate if longest >= LEAST_RUN else 0.0
