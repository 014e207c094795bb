"""A study that was recorded, and all that the analysis makes of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from armperturb.analysis import results
from armperturb.cohort import Person
from armperturb.environment import Environment
from armperturb.study.protocol import THESIS, Condition, Protocol
from armperturb.study.protocol.differences import Difference, differences
from armperturb.study.recording.manifest import Manifest
from armperturb.study.results.appendix_fits import Appendices
from armperturb.study.results.cases import Case
from armperturb.study.results.emg import PersonEmg
from armperturb.study.results.nonlinear_fits import NonlinearFit
from armperturb.study.results.quantities import level_name
from armperturb.study.results.trial_measures import PersonMeasures

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class StudyResult(results.Result):
    """An analysed study.

    Attributes:
      made: how its recordings were made; None if nobody says, as of a laboratory's.
      protocol: what everyone went through, or was to.
      environment: what the hands held.
      cohort: the people who were simulated; empty if nobody knows.
      cases: one per person who was recorded and condition that has a multisine, people in order.
      recorded: condition to the number of trials that were recorded; empty if `made` says how many there are to be.
      recordings: everyone who was recorded, in order, to the path of the recording.
      people: what the thesis reports of each person.
      appendices: fits of appendices C to E.
      emg: what everybody's EMG tells, people in order; empty if nobody has any.
      nonlinear: nonlinear fits, those that failed too; empty if nobody asked for any.
      missing: what the folder lacks, or how it was made otherwise; one line each.
      remarks: why parts of what is there were left out, likewise.
    """

    made: Manifest | None
    protocol: Protocol
    environment: Environment
    cohort: tuple[Person, ...]
    cases: tuple[Case, ...]
    recorded: Mapping[str, int] = field(default_factory=dict)
    recordings: Mapping[str, Path] = field(default_factory=dict)
    people: tuple[PersonMeasures, ...] = ()
    appendices: Appendices = field(default_factory=Appendices)
    emg: tuple[PersonEmg, ...] = ()
    nonlinear: tuple[NonlinearFit, ...] = ()
    missing: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    def describe(self) -> results.Description:
        """Who was recorded, and in each condition who was identified and how well the arms predict."""
        rows = []
        for condition in self.conditions:
            cases = self.of(condition.name)
            vaf = np.mean([case.identified.vaf for case in cases], axis=0)
            trials = sum(case.identified.n_trials for case in cases)
            model = "/".join(dict.fromkeys(case.identified.fit.structure for case in cases))
            rows.append((condition.name, str(len(cases)), str(trials), model, f"{vaf[0]:.1f}", f"{vaf[1]:.1f}"))
        n, nonlinear = len(self.names), sum(not fit.failed for fit in self.nonlinear)
        return results.Description(
            title=f"Study of {n} {'person' if n == 1 else 'people'} in {len(self.conditions)} conditions",
            facts=(f"{nonlinear} nonlinear fits",) if self.nonlinear else (),
            table=results.Table(("condition", "people", "trials", "model", "VAF x [%]", "VAF y [%]"), tuple(rows)),
            remarks=(*self.missing, *self.remarks),
        )

    def to_frame(self) -> pd.DataFrame:
        """One row per person, condition and parameter, with the columns of `results.PARAMETER_COLUMNS`."""
        parts = [case.identified.to_frame().assign(subject=case.name) for case in self._identified()]
        if not parts:
            return pd.DataFrame(columns=list(results.PARAMETER_COLUMNS))
        return pd.concat(parts, ignore_index=True)

    def to_xarray(self) -> xr.Dataset:
        """`Identification.to_xarray` of every case along a dimension `case`, with its `subject` and `condition`.

        Raises:
          ValueError: nobody was identified, as in a study of pulses alone.
        """
        self._require_identified()
        cases = self._identified()
        labels = {"subject": [case.name for case in cases], "condition": [case.condition.name for case in cases]}
        joined = xr.concat([case.identified.to_xarray().drop_attrs(deep=False) for case in cases], "case", join="outer")
        return joined.assign_coords({name: ("case", label) for name, label in labels.items()})

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the mean admittance over people in each condition, with one SD over people to either side.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (output, input, 2): gain and phase of each element.

        Raises:
          ValueError: as `to_xarray`.
        """
        from armperturb.plots.bands import plot_responses
        from armperturb.study.results.mean_admittance import mean_curves

        self._require_identified()
        return plot_responses(mean_curves(self), "SD over people", figure)

    @property
    def n_people(self) -> int:
        """How many people were to be recorded; who was, if nobody says."""
        return self.made.subjects if self.made else len(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Everyone who was recorded."""
        return tuple(dict.fromkeys([*(person.name for person in self.people), *(case.name for case in self.cases)]))

    @property
    def is_linear(self) -> bool:
        """Whether the people were simulated with linear muscles."""
        return self.made is not None and self.made.muscles == "linear"

    @property
    def has_truth(self) -> bool:
        """Whether the people are known, linear and have a fixed shoulder, so that what is fitted has true values."""
        truths = [case.truth for case in self.cases]
        return bool(truths) and all(truth is not None and truth.muscle is None for truth in truths)

    @property
    def seed(self) -> int:
        """Of everything random that is drawn for the report."""
        return self.made.seed if self.made else 0

    @property
    def is_ideal(self) -> bool:
        """Whether people and instruments are free of noise."""
        return self.made is not None and self.made.ideal

    @cached_property
    def unlike_thesis(self) -> tuple[Difference, ...]:
        """What the protocol does otherwise than the thesis's (there), in conditions of both; empty if unknown."""
        if self.made is None:
            return ()
        there, now = THESIS.to_dict(), self.protocol.to_dict()
        recorded = {condition["name"]: condition for condition in now["conditions"]}
        there["conditions"] = [each for each in there["conditions"] if each["name"] in recorded]
        now["conditions"] = [recorded[each["name"]] for each in there["conditions"]]
        return tuple(differences(there, now))

    @cached_property
    def conditions(self) -> tuple[Condition, ...]:
        """Conditions in which somebody was identified, in the protocol's order."""
        return tuple(condition for condition in self.protocol.conditions if self.of(condition.name))

    @cached_property
    def pulses(self) -> tuple[tuple[str, str], ...]:
        """Condition and `level_name` of pulses that somebody responded to, in the protocol's order, small ones first.

        Recordings of other conditions and levels are not among them.
        """
        return tuple(
            pulse
            for condition in self.protocol.conditions
            for level in sorted(condition.pulse_levels)
            if any(
                (pulse := (condition.name, level_name(condition.name, level))) in person.pulses
                for person in self.people
            )
        )

    def n_trials(self, condition: str) -> int:
        """Trials of everyone in a condition."""
        if self.recorded:
            return self.recorded.get(condition, 0)
        return self.n_people * sum(trial.condition.name == condition for trial in self.protocol.planned_trials())

    def of(self, condition: str) -> list[Case]:
        """The identified cases of one condition."""
        return [case for case in self.cases if case.condition.name == condition and case.identification is not None]

    def _identified(self) -> list[Case]:
        """Those of all conditions, in the protocol's order."""
        return [case for condition in self.conditions for case in self.of(condition.name)]

    def _require_identified(self) -> None:
        if not self.conditions:
            raise ValueError(
                "nobody was identified in any condition, so that there are no spectra; expected one with a multisine "
                "(what pulses tell is in people)"
            )
