"""Results of a nonlinear identification as files that any other program reads."""

import json
from pathlib import Path
from typing import Any

from armperturb.analysis.nonlinear.choice import Gain
from armperturb.analysis.nonlinear.identify import NonlinearIdentification
from armperturb.analysis.nonlinear.prediction import median_peak, predicted_at_all
from armperturb.files import finite_or_none, write_csv, written_together

CHECKPOINTS = "checkpoint*.json.gz"
"""Files of searches that have not ended."""


def fit_summary(result: NonlinearIdentification) -> dict[str, Any]:
    """How the fit went, ready for JSON; a number that does not exist is None."""
    estimate, choice = result.estimate, result.choice

    def of_gain(gain: Gain) -> dict[str, Any]:
        return {
            "log_likelihood": gain.mean,
            "standard_error": gain.standard_error,
            "dof": gain.dof,
            "shown": gain.is_shown,
        }

    summary = {
        "model": "nonlinear",
        **estimate.labels,
        "law": estimate.model.law,
        "emg": list(result.emg),
        "status": estimate.message,
        "converged": estimate.converged,
        "n_steps": estimate.n_steps,
        "objective": estimate.objective,
        "at_bound": list(estimate.at_bound),
        "remarks": list(estimate.remarks),
        "coordinate_standard_error": dict(estimate.coordinate_error),
        "spread_of_trials": {f"{quantity} [{task}]": sd for (task, quantity), sd in estimate.spread.items()},
        "lack_of_fit": {
            label: {"chi2": test.chi2, "dof": test.dof, "p_value": test.p_value}
            for label, test in estimate.lack_of_fit.items()
        },
        "choice": choice
        and {
            "chosen": choice.chosen,
            "verdict": list(choice.verdict()),
            "laws": {law: of_gain(gain) for law, gain in choice.gains.items()},
            "mechanisms": {name: of_gain(gain) for name, gain in choice.mechanisms.items()},
        },
        "left_out_pulses": {
            model: {
                "n": len(pulses),
                "n_predicted": len(predicted_at_all(pulses)),
                "median_peak_percent": median_peak(pulses),
            }
            for model, pulses in result.pulses.items()
            if pulses
        },
    }
    return finite_or_none(summary)


def write_nonlinear(result: NonlinearIdentification, folder: Path) -> None:
    """Write `parameters.csv`, `correlations.csv`, `predictions.csv` and `fit.json`, and delete checkpoints there.

    Raises:
      OSError: the folder cannot be made or written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = ("parameters.csv", "correlations.csv", "predictions.csv", "fit.json")
    with written_together([folder / name for name in names]) as (parameters, correlations, predictions, fitted):
        write_csv(result.to_frame(), parameters)
        write_csv(result.estimate.correlation_frame().reset_index(names="parameter"), correlations)
        write_csv(result.pulse_frame().assign(**result.estimate.labels), predictions)
        fitted.write_text(json.dumps(fit_summary(result), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    for checkpoint in folder.glob(CHECKPOINTS):
        checkpoint.unlink()
