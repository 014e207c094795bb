"""From a recording of one person to the muscle law: fits, choice of the law, and left-out pulses; and its files."""

import csv
import json
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import xarray as xr

from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.nonlinear.choice import Choice, Gain, compare_laws
from armperturb.analysis.nonlinear.estimate import NonlinearEstimate, fit, nearest_arms
from armperturb.analysis.nonlinear.model import Law, Model, unit
from armperturb.analysis.nonlinear.prediction import (
    PulsePrediction,
    median_peak,
    predict_pulses,
    predict_pulses_linearly,
)
from armperturb.analysis.nonlinear.start import linear_arms
from armperturb.analysis.nonlinear.trials import training_sets, trial_sets
from armperturb.files import write_csv, written_whole
from armperturb.subject import Subject

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHECKPOINTS = "checkpoint*.npz"
"""Files of fits that are under way."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NonlinearIdentification:
    """What raw trials of one person yield.

    Attributes:
      estimate: of the law that was asked for, or chosen.
      choice: how laws compare, if one was to be chosen.
      arms: condition to its linear arm.
      pulses: "nonlinear", "linear" and "skeletal" (linear muscle on the nonlinear skeleton) to what they predict of
        the pulses that were left out, all in the same order.
    """

    estimate: NonlinearEstimate
    choice: Choice | None
    arms: Mapping[str, Subject]
    pulses: Mapping[str, tuple[PulsePrediction, ...]]

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the first left-out pulse of each condition and direction, as recorded and as the models predict it.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (pulse, axis).

        Raises:
          ValueError: no pulse was left out.
        """
        from armperturb.plots.pulses import PredictedPulse, plot_pulses

        first: dict[tuple[str, float], int] = {}
        for i, pulse in enumerate(self.pulses["nonlinear"]):
            first.setdefault((pulse.condition, pulse.direction_deg), i)
        if not first:
            raise ValueError(
                "plot: no pulse was left out of the fit; expected at least one (plot the estimate instead)"
            )
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
    pulse_directions_deg: Iterable[float] = (),
    window_start: float = WINDOW_START,
    period: float | None = None,
    folder: Path | None = None,
    progress: Callable[[str], object] | None = None,
    threads: int = 1,
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
      threads: how many simulate at a time; no effect on what they find.

    Raises:
      ValueError: the recording is refused or cannot be identified, or the law is unknown.
      OSError: a checkpoint cannot be read or written.
    """
    directions = list(pulse_directions_deg)
    sets = trial_sets(recording)
    held = {float(deg) for one in sets.values() for deg in one.direction_deg if not np.isnan(deg)}
    for wanted in directions:
        if not any(math.isclose(wanted, deg) for deg in held):
            known = ", ".join(f"{deg:g}" for deg in sorted(held)) or "none, as there are no pulses"
            raise ValueError(f"pulses: no pulse in the direction {wanted:g} deg; expected some of {known}")
    fitted, left_out = training_sets(sets, directions)
    arms = linear_arms(recording, window_start=window_start, period=period)
    choice = None
    if law == "choose":
        choice = compare_laws(
            fitted, arms, left_out, mechanisms=True, checkpoint=folder, progress=progress, threads=threads
        )
        estimate = choice.estimate
    else:
        checkpoint = folder and folder / "checkpoint.npz"
        estimate = fit(fitted, arms, Model(law=law), checkpoint=checkpoint, progress=progress, threads=threads)
    pulses: dict[str, list[PulsePrediction]] = {"nonlinear": [], "linear": [], "skeletal": []}
    everywhere = nearest_arms(list(sets.values()), arms)
    for one in left_out:
        arm = everywhere[one.label]
        pulses["nonlinear"] += predict_pulses(one, estimate.subject(one.body.task, one.label))
        pulses["linear"] += predict_pulses_linearly(one, arm)
        pulses["skeletal"] += predict_pulses(one, arm)
    return NonlinearIdentification(
        estimate=estimate,
        choice=choice,
        arms=arms,
        pulses={model: tuple(predicted) for model, predicted in pulses.items()},
    )


def parameter_rows(estimate: NonlinearEstimate) -> list[dict[str, Any]]:
    """One row per free parameter, with its 95 % confidence interval and the standard error of its logarithm."""
    return [
        {
            "name": name,
            "value": value,
            "unit": unit(name),
            "lower": estimate.interval(name)[0],
            "upper": estimate.interval(name)[1],
            "log_error": estimate.log_error[name],
        }
        for name, value in estimate.values.items()
    ]


def correlation_rows(estimate: NonlinearEstimate) -> list[dict[str, Any]]:
    """One row per free parameter: how the errors of logarithms correlate."""
    names = list(estimate.values)
    return [
        {"name": name, **dict(zip(names, map(float, row), strict=True))}
        for name, row in zip(names, estimate.correlation, strict=True)
    ]


def prediction_rows(found: NonlinearIdentification) -> list[dict[str, Any]]:
    """One row per left-out pulse and model."""
    return [
        {
            "condition": pulse.condition,
            "direction_deg": pulse.direction_deg,
            "model": model,
            "peak_percent": pulse.peak,
            "vaf_percent": pulse.vaf,
        }
        for model, pulses in found.pulses.items()
        for pulse in pulses
    ]


def summary(found: NonlinearIdentification) -> dict[str, Any]:
    """How the fit went, ready for JSON; a number that does not exist is None."""
    estimate, choice = found.estimate, found.choice

    def of_gain(gain: Gain) -> dict[str, Any]:
        error = gain.standard_error if math.isfinite(gain.standard_error) else None
        return {"log_likelihood": gain.mean, "standard_error": error, "dof": gain.dof, "shown": gain.is_shown}

    return {
        "model": "nonlinear",
        "law": estimate.model.law,
        "status": estimate.status,
        "converged": estimate.converged,
        "n_rounds": estimate.n_rounds,
        "objective": estimate.objective,
        "at_bound": list(estimate.at_bound),
        "remarks": list(estimate.remarks()),
        "spread_of_trials": {f"{quantity} [{task}]": sd for (task, quantity), sd in estimate.spread.items()},
        "lack_of_fit": {
            label: {"chi2": one.chi2, "dof": one.dof, "p_value": one.p_value}
            for label, one in estimate.lack_of_fit.items()
        },
        "choice": choice
        and {
            "chosen": choice.chosen,
            "verdict": list(choice.verdict()),
            "laws": {law: of_gain(gain) for law, gain in choice.gains.items()},
            "mechanisms": {name: of_gain(gain) for name, gain in choice.mechanisms.items()},
        },
        "left_out_pulses": {
            model: {"n": len(pulses), "median_peak_percent": median_peak(pulses)}
            for model, pulses in found.pulses.items()
            if pulses
        },
    }


def told(found: NonlinearIdentification) -> list[str]:
    """The result in lines of text."""
    estimate = found.estimate
    lines = [f"{estimate.model.law} law: {estimate.status}", *estimate.remarks()]
    lines += found.choice.verdict() if found.choice else ()
    for model, pulses in found.pulses.items():
        if pulses:
            vaf = float(np.median([pulse.vaf for pulse in pulses]))
            lines.append(
                f"{len(pulses)} left-out pulses, {model}: median peak {median_peak(pulses):.0f} %, VAF {vaf:.1f} %"
            )
    return lines


def write_nonlinear(found: NonlinearIdentification, folder: Path) -> None:
    """Write `parameters.csv`, `correlations.csv`, `predictions.csv` and `fit.json`; checkpoints there are done with.

    Raises:
      OSError: the folder cannot be made or written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = ("parameters.csv", "correlations.csv", "predictions.csv", "fit.json")
    with ExitStack() as stack:  # all take their places together, after all were written
        parameters, correlations, predictions, fitted = (
            stack.enter_context(written_whole(folder / name)) for name in names
        )
        write_csv(parameter_rows(found.estimate), parameters)
        write_csv(correlation_rows(found.estimate), correlations)
        with predictions.open("w", newline="", encoding="utf-8") as file:  # of no pulse, a header alone
            columns = ["condition", "direction_deg", "model", "peak_percent", "vaf_percent"]
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(prediction_rows(found))
        fitted.write_text(json.dumps(summary(found), indent=2) + "\n", encoding="utf-8")
    for checkpoint in folder.glob(CHECKPOINTS):
        checkpoint.unlink()
