"""From a recording of one person to the muscle law: fits, choice of the law, and predictions of left-out pulses."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
import xarray as xr

from armperturb.analysis.cuts import require_two_axes
from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.manipulator import copies_left_out
from armperturb.analysis.measures.start_geometry import held_force
from armperturb.analysis.nonlinear.choice import Choice, compare_laws
from armperturb.analysis.nonlinear.estimate import (
    N_PAIRS,
    N_PAIRS_OF_ERRORS,
    fit,
    free_parameters,
    nearest_arms,
    require_draws,
)
from armperturb.analysis.nonlinear.model import FIXED, Law, Model
from armperturb.analysis.nonlinear.prediction import (
    PulsePrediction,
    facts_of,
    predict_pulses,
    predict_pulses_linearly,
    remarks_on_peaks,
    remarks_on_windows,
)
from armperturb.analysis.nonlinear.result import NonlinearEstimate
from armperturb.analysis.nonlinear.spindle_emg import usable_emg
from armperturb.analysis.nonlinear.start import linear_arms
from armperturb.analysis.nonlinear.trials import cut_remarks, fitted_conditions, training_sets
from armperturb.analysis.pulses_alone import PULSES_ALONE
from armperturb.analysis.results import Description, Result, plain
from armperturb.analysis.trials import OTHERS, ConditionTrials
from armperturb.muscle_law import MuscleLaw
from armperturb.planar_arm.simulation import load_compiled_arm
from armperturb.recording import check_recording
from armperturb.subject import Subject
from armperturb.validation import as_list, require_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class NonlinearIdentification(Result):
    """What raw trials of one person yield.

    Attributes:
      estimate: of the law that was asked for, or chosen.
      choice: how laws compare, if one was to be chosen.
      arms: condition to its linear arm.
      pulses: "nonlinear", "linear" and "skeletal" (linear muscle on the nonlinear skeleton) to their predictions of
        the pulses that were left out, all in the same order.
      emg: conditions whose EMG was used beside the movement.
    """

    estimate: NonlinearEstimate
    choice: Choice | None
    arms: Mapping[str, Subject]
    pulses: Mapping[str, tuple[PulsePrediction, ...]]
    emg: tuple[str, ...] = ()

    def describe(self) -> Description:
        """The estimate, why its law was chosen, and how well the models predict the left-out pulses."""
        estimate = self.estimate.describe()
        pulses = facts_of({f"{model} model": pulses for model, pulses in self.pulses.items()})
        return replace(estimate, facts=(*estimate.facts, *self.model_facts(), *pulses))

    def model_facts(self) -> tuple[str, ...]:
        """Which EMG was used beside the movement, and why the law was chosen, if there is anything to say."""
        used = (f"EMG of {', '.join(self.emg)} used beside the movement",) if self.emg else ()
        return *used, *(self.choice.verdict() if self.choice else ())

    def to_frame(self) -> pd.DataFrame:
        """One row per free parameter, with the columns of `results.PARAMETER_COLUMNS`."""
        return self.estimate.to_frame()

    def to_xarray(self) -> xr.Dataset:
        """The estimate (see `FitResult.to_xarray`) and the left-out pulses, if there are any.

        Of these, `recorded` and `predicted` are displacements of the handle [m], (pulse, time, axis) and (model, pulse,
        time, axis); after the end of a shorter one they are NaN.
        """
        data, pulses = self.estimate.to_xarray(), self.pulses["nonlinear"]
        if not pulses:
            return data
        labels = ["condition", "direction_deg"]
        each = {
            model: xr.concat([pulse.to_xarray().drop_vars(labels) for pulse in of_model], "pulse", join="outer")
            for model, of_model in self.pulses.items()
        }
        predicted = xr.concat([of_model["predicted"] for of_model in each.values()], pd.Index(list(each), name="model"))
        coords = {label: ("pulse", [getattr(pulse, label) for pulse in pulses]) for label in labels}
        return data.merge(each["nonlinear"].assign(predicted=predicted).assign_coords(coords))

    def pulse_frame(self) -> pd.DataFrame:
        """One row per left-out pulse and model: predicted over recorded peak, and variance accounted for [%]."""
        rows = [
            (pulse.condition, pulse.direction_deg, model, pulse.peak, pulse.vaf)
            for model, pulses in self.pulses.items()
            for pulse in pulses
        ]
        return pd.DataFrame(rows, columns=["condition", "direction_deg", "model", "peak_percent", "vaf_percent"])

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the first left-out pulse of each condition and direction, as recorded and as the models predict it.

        Without left-out pulses, the estimates are drawn, see `FitResult.plot`.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (pulse, axis); of estimates (unit,).
        """
        from armperturb.plots.pulses import PredictedPulse, plot_pulses

        first: dict[tuple[str, float], int] = {}
        for i, pulse in enumerate(self.pulses["nonlinear"]):
            first.setdefault((pulse.condition, pulse.direction_deg), i)
        if not first:
            return self.estimate.plot(figure)
        shown = []
        for (condition, direction), i in first.items():
            of_models = {model: pulses[i] for model, pulses in self.pulses.items()}
            recorded = of_models["nonlinear"]
            predicted = {model: pulse.predicted for model, pulse in of_models.items()}
            title = f"{condition}, pulse at {direction:g} deg"
            shown.append(PredictedPulse(title, recorded.time, recorded.recorded, predicted))
        return plot_pulses(shown, figure)


def identify_nonlinear(
    recording: xr.Dataset,
    law: Law | Literal["choose"] = "full",
    *,
    pulse_directions_deg: float | Iterable[float] = (),
    window_start: float = WINDOW_START,
    period: float | None = None,
    folder: Path | None = None,
    progress: Callable[[str], object] | None = None,
    threads: int = 1,
    emg: Envelopes | None = None,
    emg_delay: float = 0.0,
    n_pairs: int = N_PAIRS,
    n_pairs_of_errors: int = N_PAIRS_OF_ERRORS,
    parts: int = MuscleLaw.parts,
    free: str | Sequence[str] = (),
) -> NonlinearIdentification:
    """Fit a muscle law to all trials of one person, started from linear arms, and predict the pulses left out.

    Args:
      recording: trials of one person, of one or both tasks.
      law: which, or "choose": see `compare_laws`.
      pulse_directions_deg: pulses in these directions are fitted too.
      window_start: start of the window that linear arms are identified from, see `identify_conditions` [s].
      period: of the disturbance [s]; None to find it.
      folder: for checkpoints; fits that were stopped there go on.
      progress: called with a line after each step.
      threads: how many simulate at a time; no effect on the result.
      emg: of all trials, to be used beside the movement; delays of reflexes are then estimated too.
      emg_delay: time by which muscles answer later than their EMG, beyond the activation dynamics [s].
      n_pairs: pairs of draws of the noise, see `fit`.
      n_pairs_of_errors: pairs of draws from which errors are estimated.
      parts: elasto-plastic parts of each muscle group, see `Model`; another number cannot be used with "choose".
      free: "Td", "fact" or both, of trials of the position task: delay of reflexes [s] and cut-off of the activation
        [Hz], which otherwise have the values of `FIXED`; cannot be used with "choose".

    Raises:
      TypeError: recording is no `Dataset`, or a number of threads, draws or parts no whole number.
      ValueError: the recording is refused or cannot be identified, the law is unknown, EMG cannot be used with it, a
        number is too small, or what is to be free has other names or is no parameter of these trials.
      OSError: a checkpoint cannot be written.
      ModuleNotFoundError: numba is not installed.
    """
    load_compiled_arm()  # what is wrong is refused before anything that takes time
    check_recording(recording)
    require_two_axes(recording)
    require_whole("identify_nonlinear", "threads", threads, at_least=1)
    require_draws("identify_nonlinear", n_pairs, n_pairs_of_errors)
    free = as_list("identify_nonlinear: free", free, str, "names", or_none=True)
    directions = as_list("pulse_directions_deg", pulse_directions_deg, Real, "angles [deg]", or_none=True)
    if law != "choose":
        Model(law=law, parts=parts, free=tuple(free))
    if law == "half-wave" and "PT" not in recording["task"].values:
        raise ValueError(
            "law = 'half-wave' of trials without reflexes (task RT); expected trials of the task PT (or --law full)"
        )
    if emg is not None and law in ("half-wave", "choose"):
        raise ValueError(f"law = {law!r} with EMG; expected full, short-range or linear (or the movement alone)")
    if law == "choose" and parts != MuscleLaw.parts:
        raise ValueError(f"law = 'choose' with parts = {parts!r}; expected a law (or {MuscleLaw.parts} parts)")
    if law == "choose" and free:
        raise ValueError(
            f"law = 'choose' with free = {tuple(free)!r}; expected a law (e.g. --law full), or nothing free"
        )
    sets = fitted_conditions(recording)
    are_alone = bool(np.isfinite(recording["pulse_onset"]).any()) and not any(
        (trials.onset < trials.n_samples).any() for trials in sets.values()
    )
    if are_alone and directions:
        raise ValueError(
            "pulses: nothing but pulses perturbs these trials, and all of them are fitted; expected no directions "
            f"({OTHERS})"
        )
    recorded = {float(deg) for trials in sets.values() for deg in trials.direction_deg if not np.isnan(deg)}
    for wanted in directions:
        if not any(math.isclose(wanted, deg) for deg in recorded):
            known = ", ".join(f"{deg:g}" for deg in sorted(recorded)) or "none, as there are no pulses"
            raise ValueError(f"pulses: no pulse in the direction {wanted:g} deg; expected some of {known}")
    fitted, left_out = training_sets(sets, directions)
    if law != "choose":
        free_parameters(fitted, Model(law=law, free=tuple(free)))
    arms = linear_arms(sets, window_start=window_start, period=period)
    options: dict[str, Any] = dict(
        n_pairs=n_pairs, n_pairs_of_errors=n_pairs_of_errors, progress=progress, threads=threads
    )
    choice = None
    used = usable_emg(sets, arms, emg, emg_delay) if emg else {}
    freed = tuple(name for name in FIXED if name in free or (used and name == "Td"))
    if law == "choose":
        choice = compare_laws(fitted, arms, left_out, mechanisms=True, checkpoint=folder, **options)
        estimate = choice.estimate
    else:
        model = Model(law=law, free=freed, parts=parts)
        estimate = fit(fitted, arms, model, emg=used, checkpoint=folder and folder / "checkpoint.json.gz", **options)
    remarks = [
        *copies_left_out(sets.values()),
        *_of_trials(sets, fitted, arms, freed),
        *([PULSES_ALONE] if are_alone else []),
    ]
    if emg and not used:
        remarks.append(
            "EMG is not used: the relaxed arm has no reflexes, of which it tells; the movement alone is used"
        )
    pulses: dict[str, list[PulsePrediction]] = {"nonlinear": [], "linear": [], "skeletal": []}
    everywhere = nearest_arms(list(sets.values()), arms)
    for trials in left_out:
        arm = everywhere[trials.label]
        pulses["nonlinear"] += predict_pulses(trials, estimate.subject(trials.body.task, trials.label))
        pulses["linear"] += predict_pulses_linearly(trials, arm)
        pulses["skeletal"] += predict_pulses(trials, arm)
    remarks += [*remarks_on_windows(left_out), *remarks_on_peaks(pulses["nonlinear"])]
    return NonlinearIdentification(
        estimate=replace(estimate, remarks=(*remarks, *estimate.remarks)),
        choice=choice,
        arms=arms,
        pulses={model: tuple(predicted) for model, predicted in pulses.items()},
        emg=tuple(used),
    )


def _of_trials(
    sets: Mapping[str, ConditionTrials],
    fitted: Sequence[ConditionTrials],
    identified: Iterable[str],
    freed: Collection[str],
) -> list[str]:
    """What trials violate or leave out of what a fit assumes, a line each.

    Args:
      sets: condition to its trials.
      fitted: what is fitted of them.
      identified: conditions that have a linear arm.
      freed: what is free of `FIXED`.
    """
    balances = {label: sets[label].balance.imbalance for label in identified}
    said = [f"{label}: {imbalance.text}" for label, imbalance in balances.items() if imbalance is not None]
    said += cut_remarks(sets, fitted)
    if amid := dict.fromkeys(trials.label for trials in fitted if not trials.from_rest):
        said.append(
            f"{', '.join(amid)}: trials start amid the movement, though the law has them start from rest with all "
            "bonds unstrained: what went before counts as noise, and intervals are wider (record each trial from rest)"
        )
    for trials in fitted:
        if (held := held_force(trials)).any() and not trials.from_rest:
            said.append(
                f"{trials.label}: a constant force on the hand, x {plain(held[0], 3)} and y {plain(held[1], 3)} N, is "
                "left out: the law has an arm that is at rest without it, and stiffness has what its turning adds"
            )
    values = {"Td": f"a delay of {1e3 * FIXED['Td']:g} ms", "fact": f"a cut-off of {FIXED['fact']:g} Hz"}
    assumed = [name for name in values if name not in freed]
    if assumed and any(trials.body.task == "PT" for trials in fitted):
        said.append(
            f"reflexes are assumed to have {' and '.join(values[name] for name in assumed)}; where the person's "
            "differ, gains and stiffness are off by more than their intervals say "
            f"(--free {' '.join(assumed)} estimates {'it' if len(assumed) == 1 else 'them'})"
        )
    return said
