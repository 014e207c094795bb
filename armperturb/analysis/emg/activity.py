"""How active muscles are apart from their reflexes: whether a person relaxed, and how much antagonists co-contract."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy import stats

from armperturb.analysis.emg.cocontraction import cocontraction
from armperturb.analysis.emg.envelope import NO_NOISE, Envelopes
from armperturb.analysis.emg.reference import mean_known
from armperturb.analysis.results import Description, Result, Table, plain
from armperturb.arrays import Array
from armperturb.validation import require_type

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RELAXED = 0.02
"""Amplitude up to which a muscle counts as relaxed, over that of a maximal contraction [-]."""

RELAXED_OF_LOUDEST = 0.1
"""The same over the amplitude of the most active condition, where no maximal contraction was recorded [-]."""

SIGNIFICANT = 0.05
"""Level of the tests, of all muscles of a condition together [-]."""

SHORTEST = 1.0
"""Shortest part of a trial that tells a level [s]."""

FEWEST_TRIALS = 3
"""Trials from which on their scatter is that of a level."""

PARTS = ("before", "during")
"""Before anything perturbs the arm, and from then on to the pulse."""

ABOVE_NOISE = 5.0
"""Standard errors by which the power of a trial has to be above the noise for a muscle to co-contract at all [-]."""

NONE_ACTIVE = "no condition was recorded in which muscles were active, such as maximal contractions (MVC)"
"""Why nothing is known of relaxation."""

JOINTS = {"s": "shoulder", "e": "elbow"}


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Activity(Result):
    """Whether muscles are active in each condition, and how much antagonists co-contract.

    Attributes:
      subject: the person.
      unit: of amplitudes.
      limit: amplitude up to which a muscle counts as relaxed [-].
      levels: one row per condition, part of the trials ("before" or "during" the perturbation) and muscle: mean
        `amplitude` over the reference's, one-sided `lower_95` limit, number of trials in which the channel is not dead,
        `p` of the hypothesis that the muscle is relaxed, adjusted for the number of muscles (Holm), and `is_active`.
        NaN, and not active, where nothing is known; p alone where `Envelopes.tells_activity` is False, or where it
        may be the unknown noise of the channel that is above the limit.
      cocontraction: one row per condition, part and joint: `index`, the mean over time of the lesser of the amplitudes
        of its flexors and extensors, and `ratio`, the same over the mean of both (Falconer & Winter 1985, Electromyogr.
        Clin. Neurophysiol. 25). None where `Envelopes.tells_activity` is False of all muscles.
      remarks: of the channels, and muscles of which that is not known.
    """

    subject: str
    unit: str
    limit: float
    levels: pd.DataFrame
    cocontraction: pd.DataFrame
    remarks: tuple[str, ...]

    def active_muscles(self, condition: str, part: str | None = None) -> tuple[str, ...]:
        """Muscles that are active in a condition, in one part of the trials or in any."""
        rows = self.levels[(self.levels["condition"] == condition) & self.levels["is_active"]]
        return tuple(dict.fromkeys(rows[rows["part"] == part]["muscle"] if part else rows["muscle"]))

    def describe(self) -> Description:
        """Which muscles are active in each condition, and the index of co-contraction of each joint."""
        rows = []
        for (condition, part), of_part in self.levels.groupby(["condition", "part"], sort=False):
            index = self.cocontraction.set_index(["condition", "part", "joint"])["index"]
            rows.append(
                (
                    str(condition),
                    str(part),
                    _active_words(of_part),
                    *(
                        plain(100.0 * index[condition, part, joint], 3) if (condition, part, joint) in index else "–"
                        for joint in JOINTS.values()
                    ),
                )
            )
        return Description(
            title=f"Activity of the muscles of {self.subject}",
            facts=(
                f"active: above {100.0 * self.limit:g} {self.unit}, p < {SIGNIFICANT:g}; co-contraction in {self.unit}",
            ),
            table=Table(("condition", "part", "active muscles", *JOINTS.values()), tuple(rows)),
            remarks=self.remarks,
        )

    def to_frame(self) -> pd.DataFrame:
        """`levels`, with condition and subject as the last columns."""
        others = self.levels.drop(columns="condition")
        return others.assign(condition=self.levels["condition"], subject=self.subject)

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the index of co-contraction by condition, and the amplitude of each muscle.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (panel,); one panel without an index.
        """
        from armperturb.plots.muscles import plot_activity

        return plot_activity(self.levels, self.cocontraction, self.unit, figure)


def activity(envelopes: Envelopes, limit: float | None = None) -> Activity:
    """Levels of muscles and of co-contraction, without the responses to pulses.

    The level of a trial is the power above that of the silent channel. That of a condition is tested against `limit`
    with Student's t over its trials, whose scatter is at least what the finite time gives.

    Args:
      envelopes: of a person.
      limit: amplitude up to which a muscle counts as relaxed, over the reference's [-]; None for `RELAXED`, or
        `RELAXED_OF_LOUDEST` without a maximal contraction.

    Raises:
      TypeError: envelopes are no `Envelopes`.
    """
    require_type("activity: envelopes", envelopes, Envelopes, "those of armperturb.envelopes")
    if limit is None:
        limit = RELAXED if envelopes.is_normalised else RELAXED_OF_LOUDEST
    rate, labels, names = envelopes.rate, envelopes.labels, list(envelopes.muscles)
    levels, indices = [], []
    tells = envelopes.tells_activity
    for condition in _in_order(labels):
        trials = np.flatnonzero(labels["condition"] == condition).tolist()
        for part in PARTS:
            spans = [_span(labels.iloc[trial], part) for trial in trials]
            used = [
                (trial, *span)
                for trial, span in zip(trials, spans, strict=True)
                if span[1] - span[0] >= SHORTEST * rate
            ]
            if not used:
                continue
            power = np.array([mean_known(envelopes.power[trial, a:b]) for trial, a, b in used])
            known = np.array([np.isfinite(envelopes.power[trial, a:b]).sum(axis=0) for trial, a, b in used])
            relative = 4.0 * envelopes.relative_variance(1.0)[[trial for trial, _, _ in used]]
            scatter = power**2 * relative / np.maximum(known / rate, 1e-300)
            levels += _tested(envelopes, str(condition), part, power, scatter, limit)
            is_there = power - envelopes.noise > ABOVE_NOISE * np.sqrt(scatter)
            for joint, word in JOINTS.items():
                groups = [
                    [
                        column
                        for column, name in enumerate(names)
                        if joint in envelopes.muscles[name].joints and envelopes.muscles[name].sign == sign
                    ]
                    for sign in (1, -1)
                ]
                if all(groups) and tells.any():
                    of_trials = [
                        cocontraction(envelopes, trial, slice(a, b), there, *groups)
                        for (trial, a, b), there in zip(used, is_there, strict=True)
                    ]
                    index, ratio = mean_known(np.array(of_trials))
                    indices.append((condition, part, word, index, ratio))
    return Activity(
        subject=str(labels["subject"].iloc[0]),
        unit=envelopes.unit,
        limit=limit,
        levels=pd.DataFrame(
            levels, columns=["condition", "part", "muscle", "amplitude", "lower_95", "trials", "p", "is_active"]
        ),
        cocontraction=pd.DataFrame(indices, columns=["condition", "part", "joint", "index", "ratio"]),
        remarks=(*envelopes.remarks, *_unknown(envelopes)),
    )


def _active_words(levels: pd.DataFrame) -> str:
    """Which muscles are active, of the rows of `Activity.levels` of one part of a condition."""
    active = list(levels[levels["is_active"]]["muscle"])
    if levels["p"].isna().all():
        return "unknown"
    if not active:
        return "none"
    return "all" if len(active) == len(levels) else ", ".join(active)


def _unknown(envelopes: Envelopes) -> tuple[str, ...]:
    """Of which muscles it is not known what their amplitudes are relative to, in a line; none if it is of all."""
    is_unknown = ~envelopes.tells_activity
    names = [name for name, unknown in zip(envelopes.muscles, is_unknown, strict=True) if unknown]
    whom = "all muscles" if is_unknown.all() else ", ".join(names)
    return (f"EMG of {whom}: nothing is known of relaxation; {NONE_ACTIVE}",) if names else ()


def _in_order(labels: pd.DataFrame) -> list[str]:
    """Conditions by task, and then by the number in their names."""
    tasks = dict(zip(labels["condition"], labels["task"], strict=True))
    number = re.compile(r"\d+(\.\d+)?")

    def key(name: str) -> tuple[str, str, float]:
        first = number.search(name)
        return tasks[name], number.sub("", name), float(first.group()) if first else 0.0

    return sorted(tasks, key=key)


def _span(row: "pd.Series", part: str) -> tuple[int, int]:
    start, onset = int(min(row["start"], row["onset"])), int(row["onset"])
    return (0, start) if part == "before" else (start, onset)


def _tested(
    envelopes: Envelopes, condition: str, part: str, power: Array, scatter: Array, limit: float
) -> list[tuple[Any, ...]]:
    """Rows of `Activity.levels`.

    Args:
      envelopes: of the person.
      condition: of the trials.
      part: of the trials, one of `PARTS`.
      power: its mean over that part, (trial, muscle).
      scatter: variance of that which the finite time gives, (trial, muscle).
      limit: as in `activity`.
    """
    above = power - envelopes.noise
    n, mean = np.isfinite(above).sum(axis=0), mean_known(above)
    variance = mean_known(scatter)
    between = mean_known((above - mean) ** 2) * n / np.maximum(n - 1, 1)
    scatters = n >= FEWEST_TRIALS
    variance = np.where(scatters, np.maximum(variance, between), variance)
    dof = np.where(scatters, n - 1.0, math.inf)
    error = np.sqrt(variance / np.maximum(n, 1))
    p = stats.t.sf((mean - limit**2) / np.maximum(error, 1e-300), dof)
    adjusted = np.full(len(p), math.nan)
    # An amplitude that contains the noise tells only that a muscle is relaxed.
    is_tested = (n > 0) & envelopes.tells_activity & (envelopes.knows_noise | (mean <= limit**2))
    adjusted[is_tested] = holm(p[is_tested])
    lower = mean - stats.t.ppf(0.95, dof) * error
    amplitude, least = (np.sqrt(np.maximum(each, 0.0)) for each in (mean, lower))
    return [
        (condition, part, name, amplitude[i], least[i], int(n[i]), adjusted[i], bool(adjusted[i] < SIGNIFICANT))
        for i, name in enumerate(envelopes.muscles)
    ]


def holm(p: Array) -> Array:
    """p values adjusted for their number (Holm 1979, Scand. J. Stat. 6), (test,)."""
    order = np.argsort(p)
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted


def relaxation_sentence(people: Iterable[Activity], conditions: Iterable[str], task: str = "relax task") -> str:
    """One sentence on whether people were found active where they were to relax, with its figures.

    That nobody was does not tell that everybody relaxed: it tells what the test did not find.

    Args:
      people: activity of each person.
      conditions: in which they were to relax.
      task: what these are called.
    """
    wanted = list(conditions)
    of_wanted = [(person, person.levels[person.levels["condition"].isin(wanted)]) for person in people]
    there = [(person, levels) for person, levels in of_wanted if len(levels)]
    if not there:
        return f"Nothing is known of relaxation: no EMG in the {task}."
    known = [person for person, levels in there if levels["p"].notna().any()]
    if not known:
        return f"Nothing is known of relaxation: {_why([person for person, _ in there])}."
    active = {
        person.subject: [name for name in wanted if person.active_muscles(name)]
        for person in known
        if any(person.active_muscles(name) for name in wanted)
    }
    limits: dict[str, list[str]] = {}
    for person in known:
        limits.setdefault(f"{100.0 * person.limit:g} {person.unit}", []).append(person.subject)
    of_whom = [f"{limit} in {', '.join(names)}" if len(limits) > 1 else limit for limit, names in limits.items()]
    tested = f"above {' or '.join(of_whom)}, p < {SIGNIFICANT:g}"
    unknown = [person for person, levels in there if levels["p"].isna().all()]
    rest = f" Nothing is known of {', '.join(each.subject for each in unknown)}: {_why(unknown)}." if unknown else ""
    if not active:
        whom = known[0].subject if len(known) == 1 else f"any of the {len(known)} people"
        return f"In the {task}, no muscle of {whom} was found active ({tested}).{rest}"
    named = "; ".join(f"{name} in {', '.join(where)}" for name, where in active.items())
    return f"In the {task}, {len(active)} of {len(known)} people did not relax (a muscle {tested}): {named}.{rest}"


def _why(unknown: Iterable[Activity]) -> str:
    """Why nothing is known of the relaxation of people."""
    of_noise = (any(NO_NOISE in remark for remark in person.remarks) for person in unknown)
    return "; ".join(dict.fromkeys(NO_NOISE if noisy else NONE_ACTIVE for noisy in of_noise))
