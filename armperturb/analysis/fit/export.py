"""Results of an identification as files that any other program reads."""

import json
import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from armperturb.analysis.fit.identify import Identification
from armperturb.analysis.fit.maximum_likelihood import Estimate
from armperturb.analysis.fit.structures import unit
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.response.spectra import SpectralEstimate
from armperturb.files import write_csv, written_whole
from armperturb.recording import LABELS

AXES = LABELS["axis"]


def admittance_rows(spectra: SpectralEstimate) -> list[dict[str, Any]]:
    """One row per frequency, output and input of the arm's admittance, with the coherence of the output."""
    return [
        {
            "frequency_hz": float(frequency),
            "output": AXES[output],
            "input": AXES[input_],
            "real": float(value.real),
            "imag": float(value.imag),
            "gain_m_per_N": float(abs(value)),
            "phase_deg": float(np.degrees(np.angle(value))),
            "coherence": float(spectra.coherence[k, output]),
        }
        for k, frequency in enumerate(spectra.frequency)
        for output in range(2)
        for input_ in range(2)
        for value in (spectra.arm[k, output, input_],)
    ]


def parameter_rows(identification: Identification) -> list[dict[str, Any]]:
    """One row per estimated parameter, SI, with its standard error and 95 % confidence interval."""
    fit = identification.fit
    return [
        {
            "parameter": name,
            "value": value,
            "standard_error": fit.standard_error[name],
            "lower_95": fit.interval(name).lower,
            "upper_95": fit.interval(name).upper,
            "unit": unit(name),
            "at_bound": str(name in fit.at_bound).lower(),
        }
        for name, value in fit.values.items()
    ]


def fit_summary(identification: Identification) -> dict[str, Any]:
    """How the fit went, ready for JSON; a number that does not exist is None."""
    fit = identification.fit
    vaf_x, vaf_y = (float(v) if math.isfinite(v) else None for v in identification.vaf)
    return {
        "model": fit.structure,
        "estimator": fit.estimator,
        "status": fit.status,
        "converged": fit.converged,
        "criterion": fit.criterion if math.isfinite(fit.criterion) else None,
        "VAF_x": vaf_x,
        "VAF_y": vaf_y,
        "stable": fit.stable,
        "largest_real_pole_per_s": fit.largest_real_pole,
        "at_bound": list(fit.at_bound),
        "remarks": list(fit.remarks),
        **_estimator_summary(fit.detail),
        "environment": {
            "m_env_kg": identification.environment.m_env,
            "b_env_Ns_per_m": identification.environment.b_env,
            "k_env_N_per_m": identification.environment.k_env,
        },
    }


def _estimator_summary(detail: Estimate | ThesisEstimate) -> dict[str, Any]:
    """What one estimator tells and the other does not."""
    if isinstance(detail, ThesisEstimate):
        return {
            "n_trials": len(detail.fits),
            "n_stable": detail.n_stable,
            "n_positive_VAF": detail.n_positive,
            "criterion_sum_mean": float(detail.criterion.mean()),
            "penalty_largest": max(one.penalty for one in detail.fits),
        }
    return {
        "chi2": detail.chi2,
        "dof": detail.dof,
        "p_value": detail.p_value,
        "dispersion": detail.dispersion,
        "n_rounds": detail.n_rounds,
        "correlation": {"parameters": list(detail.values), "matrix": detail.correlation.tolist()},
    }


def write_identification(found: Mapping[str, Identification], folder: str | Path) -> list[Path]:
    """Write `admittance.csv`, `parameters.csv` and `fit.json` into a folder, which is made if needed.

    Args:
      found: condition to what it yielded, see `identify_conditions`. Rows tell the condition in their last column;
        `fit.json` holds one summary, or with several conditions one for each.
      folder: where.

    Returns:
      The paths written.

    Raises:
      OSError: the folder cannot be made or written to.
    """
    folder = Path(folder)
    summaries = {label: fit_summary(one) for label, one in found.items()}
    summary = json.dumps(next(iter(summaries.values())) if len(summaries) == 1 else summaries, indent=2)

    def rows(of_one: Callable[[Identification], list[dict[str, Any]]]) -> list[dict[str, Any]]:
        return [{**row, "condition": label} for label, one in found.items() for row in of_one(one)]

    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in ("admittance.csv", "parameters.csv", "fit.json")]
    with ExitStack() as stack:  # all three take their places together, after all were written
        admittance, parameters, fit = (stack.enter_context(written_whole(path)) for path in paths)
        write_csv(rows(lambda one: admittance_rows(one.spectra)), admittance)
        write_csv(rows(parameter_rows), parameters)
        fit.write_text(summary + "\n", encoding="utf-8")
    return paths
