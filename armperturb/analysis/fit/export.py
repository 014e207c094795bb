"""Results of an identification as files that any other program reads."""

import json
import math
from pathlib import Path
from typing import Any

from armperturb.analysis.arm.geometry import with_rigid_segments
from armperturb.analysis.fit.identification import Identification, Identifications
from armperturb.analysis.fit.maximum_likelihood import Estimate
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.measures.endpoint import is_straight, plot_endpoints
from armperturb.files import finite_or_none, write_csv, written_together
from armperturb.subject import Subject


def fit_summary(identification: Identification) -> dict[str, Any]:
    """How the fit went, ready for JSON; a number that does not exist is None."""
    fit, environment = identification.fit, identification.environment
    vaf_x, vaf_y, criterion = (float(v) if math.isfinite(v) else None for v in (*identification.vaf, fit.criterion))
    return {
        "model": fit.structure,
        **fit.labels,
        "estimator": fit.estimator,
        "status": fit.message,
        "converged": fit.converged,
        "criterion": criterion,
        "VAF_x": vaf_x,
        "VAF_y": vaf_y,
        "stable": fit.stable,
        "largest_real_pole_per_s": fit.largest_real_pole,
        "at_bound": list(fit.at_bound),
        "remarks": list(fit.remarks),
        **_estimator_summary(fit.detail),
        "structures_tried": [
            {"structure": rung.name, "score": rung.score, "chi2": rung.sketch.chi2, "dof": rung.sketch.dof}
            for rung in (fit.choice.rungs if fit.choice else ())
        ],
        "environment": {
            "m_env_kg": environment.m_env,
            "b_env_Ns_per_m": environment.b_env,
            "k_env_N_per_m": environment.k_env,
        },
    }


def _estimator_summary(detail: Estimate | ThesisEstimate) -> dict[str, Any]:
    """What only one of the estimators gives."""
    if isinstance(detail, ThesisEstimate):
        return {
            "n_trials": len(detail.fits),
            "n_stable": detail.n_stable,
            "n_positive_VAF": detail.n_positive,
            "criterion_sum_mean": float(detail.criterion.mean()),
            "penalty_largest": max(fit.penalty for fit in detail.fits),
        }
    return {
        "chi2": detail.chi2,
        "dof": detail.dof,
        "p_value": detail.p_value,
        "dispersion": detail.dispersion,
        "n_rounds": detail.n_rounds,
        "trial_spread": dict(detail.trial_spread),
        "correlation": {"parameters": list(detail.values), "matrix": detail.correlation.tolist()},
    }


def write_identification(results: Identifications, folder: str | Path) -> list[Path]:
    """Write `admittance.csv`, `parameters.csv`, `fit.json`, `endpoint.csv` and `endpoint.svg` into a folder.

    The folder is made if needed. Impedance at the hand is that in the recorded postures; of a straight arm there is
    none, and without any there are no such files.

    Args:
      results: of `identify_conditions`. The last columns of each table are condition and subject; `fit.json`
        holds one summary, or with several conditions one for each.
      folder: where.

    Returns:
      The paths written.

    Raises:
      OSError: the folder cannot be made or written to.
    """
    import pandas as pd

    from armperturb.plots.style import new_figure, svg

    folder = Path(folder)
    summaries = {label: fit_summary(result) for label, result in results.items()}
    content = finite_or_none(next(iter(summaries.values())) if len(summaries) == 1 else summaries)
    summary = json.dumps(content, indent=2, allow_nan=False)
    bent = {label: result for label, result in results.items() if not is_straight(result.fit.arm.theta_e_deg)}
    endpoints = {label: result.endpoint() for label, result in bent.items()}

    folder.mkdir(parents=True, exist_ok=True)
    names = ("admittance.csv", "parameters.csv", "fit.json", *(("endpoint.csv", "endpoint.svg") if endpoints else ()))
    paths = [folder / name for name in names]
    with written_together(paths) as (admittance, parameters, fit, *of_hand):
        write_csv(pd.concat([result.spectra.to_frame() for result in results.values()]), admittance)
        write_csv(results.to_frame(), parameters)
        fit.write_text(summary + "\n", encoding="utf-8")
        if endpoints:
            figure = new_figure(1.0)
            plot_endpoints(endpoints, figure)
            write_csv(pd.concat([endpoint.to_frame() for endpoint in endpoints.values()]), of_hand[0])
            of_hand[1].write_bytes(svg(figure))
    return paths


def write_arm(arm: Subject, path: str | Path) -> str:
    """Write a fitted arm as the file of a person, with rigid segments where some have its joint inertia.

    Returns:
      Why no simulation has this arm; empty where one has.

    Raises:
      OSError: the file cannot be written.
    """
    refusal = ""
    try:
        arm = with_rigid_segments(arm)
        arm.require_simulable()
    except ValueError as error:
        refusal = str(error)
    arm.save(path)
    return refusal
