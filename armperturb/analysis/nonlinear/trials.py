"""Raw recordings of one person, ready for time-domain fits."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import xarray as xr

from armperturb.analysis.force_balance import EDGE, Balance, NoiseLevels
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array, Indices
from armperturb.environment import Environment
from armperturb.subject import Subject

LEAST = 5.0
"""Shortest time that is worth fitting [s]."""

NEGLIGIBLE = 1e-9
"""Disturbances below this are none [N]; computing with denormal numbers is slow."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialSet:
    """Trials of one person in one condition, each from rest at its first sample.

    Attributes:
      label: the condition.
      body: task, segment lengths and posture.
      environment: what the hand held.
      noise: of the instruments.
      rate: of the samples [Hz].
      perturbation: d [N], (trial, time, axis).
      displacement: of the handle, from encoders and gauge together [m], (trial, time, axis).
      onset: sample at which each trial's pulse begins, or the number of samples, (trial,).
      direction_deg: of the pulses [deg], (trial,); NaN without a pulse.
      end: how many samples are judged.
    """

    label: str
    body: Subject
    environment: Environment
    noise: NoiseLevels
    rate: float
    perturbation: Array
    displacement: Array
    onset: Indices
    direction_deg: Array
    end: int

    @classmethod
    def prepare(cls, recording: xr.Dataset, instruments: tuple[Environment, NoiseLevels] | None = None) -> Self:
        """Prepare trials.

        Args:
          recording: trials of one person in one condition.
          instruments: manipulator and noise of the instruments; identified from these trials if not given.

        Raises:
          ValueError: the recording is of several people, conditions or postures, or too short, or its force does not
            balance (see `Balance`).
        """
        body = ConditionTrials.prepare(recording, is_checked=True).body
        d, f, x = (
            np.asarray(recording[name].values, dtype=float) for name in ("perturbation", "force", "displacement")
        )
        rate = float(recording.attrs["rate"])
        balance = Balance(d, f, x, rate)
        environment, noise = instruments or balance.fit()
        n = d.shape[1]
        limit = float(np.nanmin([*recording["limit_time"].values, np.inf]))
        onset = np.where(np.isnan(recording["pulse_onset"].values), n / rate, recording["pulse_onset"].values)
        return cls(
            label=str(recording["condition"].values[0]),
            body=body,
            environment=environment,
            noise=noise,
            rate=rate,
            perturbation=np.where(np.abs(d) < NEGLIGIBLE, 0.0, d),
            displacement=balance.displacement(environment, noise),
            onset=np.minimum(np.round(onset * rate), n).astype(np.intp),
            direction_deg=np.asarray(recording["pulse_direction"].values, dtype=float),
            end=min(n - round(EDGE * rate), round(min(limit, n / rate) * rate)),
        )

    @property
    def n_trials(self) -> int:
        """How many trials."""
        return len(self.onset)

    def take(self, trials: Iterable[int]) -> Self:
        """Some of the trials."""
        index = np.asarray(list(trials), dtype=np.intp)
        chosen = {
            name: getattr(self, name)[index] for name in ("perturbation", "displacement", "onset", "direction_deg")
        }
        return replace(self, **chosen)

    def before_pulses(self) -> Self | None:
        """What comes before the earliest pulse; None if that is too little, or nothing perturbs the person there."""
        end = min(self.end, int(self.onset.min()))
        if end < LEAST * self.rate or not self.perturbation[:, :end].any(axis=(1, 2)).all():
            return None
        return replace(self, end=end)


def trial_sets(recording: xr.Dataset) -> dict[str, TrialSet]:
    """All trials of one person, by condition.

    Conditions with pulses alone hold too little movement to tell the manipulator: there it is that of the others.

    Raises:
      ValueError: as `TrialSet.prepare`, the recording is of several people or rates, or nothing but pulses perturbs.
    """
    people = list(dict.fromkeys(recording["subject"].values.tolist()))
    if len(people) > 1:
        raise ValueError(f"the recording holds trials of {' and '.join(map(str, people))}; expected one person")
    labels = recording["condition"].values
    parts = {
        str(label): recording.isel(trial=np.flatnonzero(labels == label)) for label in dict.fromkeys(labels.tolist())
    }
    found: dict[str, TrialSet] = {}
    pulses = {}
    for label, part in parts.items():
        onset = float(np.nanmin([*part["pulse_onset"].values, np.inf]))
        perturbed = part["perturbation"].sel(time=slice(None, onset - 1.0 / float(part.attrs["rate"])))
        if np.abs(perturbed.values).max(initial=0.0) > NEGLIGIBLE:
            found[label] = TrialSet.prepare(part)
        else:
            pulses[label] = part
    if not found:
        raise ValueError("no trial has a perturbation before its pulse; expected some with a multisine or noise")
    for label, part in pulses.items():
        same = [one for one in found.values() if one.body.task == part["task"].values[0]] or list(found.values())
        found[label] = TrialSet.prepare(part, (same[0].environment, same[0].noise))
    return {label: found[label] for label in parts}


def training_sets(
    sets: Mapping[str, TrialSet], pulse_directions_deg: Iterable[float] = ()
) -> tuple[list[TrialSet], list[TrialSet]]:
    """Trials to fit, and trials whose pulses are left out.

    Args:
      sets: all trials by condition.
      pulse_directions_deg: directions of the pulses that are fitted; of other trials, what comes before the pulse is.

    Returns:
      What to fit, and the whole trials whose pulses are left out.
    """
    wanted = list(pulse_directions_deg)
    fitted: list[TrialSet] = []
    left_out: list[TrialSet] = []
    for one in sets.values():
        with_pulse = np.array(
            [np.isnan(deg) or any(np.isclose(deg, other) for other in wanted) for deg in one.direction_deg]
        )
        if with_pulse.any():
            fitted.append(one.take(np.flatnonzero(with_pulse)))
        if not with_pulse.all():
            others = one.take(np.flatnonzero(~with_pulse))
            left_out.append(others)
            before = others.before_pulses()
            if before is not None:
                fitted.append(before)
    return fitted, left_out
