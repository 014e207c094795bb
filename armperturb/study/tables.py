"""Tables of a study: estimated against true against published."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from armperturb.analysis.export import fit_summary, write_csv
from armperturb.analysis.structures import unit
from armperturb.recording import load_recording
from armperturb.study import published
from armperturb.study.protocol import CONDITIONS
from armperturb.study.runner import Case, StudyResult
from armperturb.subject import Subject

Row = dict[str, Any]


def true_value(subject: Subject, parameter: str) -> float:
    """Value of a model parameter in a simulated subject, SI."""
    return subject.m_h + subject.m_f if parameter == "m_tot" else float(getattr(subject, parameter))


def parameter_rows(study: StudyResult) -> list[Row]:
    """Every estimated parameter of every subject beside its truth."""
    rows = []
    for condition in CONDITIONS:
        for case in study.of(condition.name):
            fit = _identified(case).fit
            for name, estimate in fit.values.items():
                truth = true_value(case.truth, name)
                rows.append(
                    {
                        "condition": condition.name,
                        "subject": case.truth.name,
                        "parameter": name,
                        "unit": unit(name),
                        "true": truth,
                        "estimated": estimate,
                        "sem": fit.sem[name],
                        "error_percent": 100.0 * (estimate / truth - 1.0),
                        "at_bound": str(name in fit.at_bound).lower(),
                    }
                )
    return rows


def parameter_summary_rows(study: StudyResult) -> list[Row]:
    """Published mean (SD), true and estimated mean (SD) over subjects, and the median error, per parameter."""
    rows = []
    of_subjects = parameter_rows(study)
    for condition in CONDITIONS:
        mine = [row for row in of_subjects if row["condition"] == condition.name]
        for name in dict.fromkeys(row["parameter"] for row in mine):
            values = [row for row in mine if row["parameter"] == name]
            printed = published.parameter(condition.name, name)
            rows.append(
                {
                    "condition": condition.name,
                    "parameter": name,
                    "unit": unit(name),
                    "published_mean": printed.mean,
                    "published_sd": printed.sd,
                    **_mean_sd("true", [row["true"] for row in values]),
                    **_mean_sd("estimated", [row["estimated"] for row in values]),
                    "median_abs_error_percent": float(np.median([abs(row["error_percent"]) for row in values])),
                }
            )
    return rows


def fit_rows(study: StudyResult) -> list[Row]:
    """How each fit went."""
    rows = []
    for condition in CONDITIONS:
        for case in study.of(condition.name):
            summary = fit_summary(_identified(case))
            environment = summary.pop("environment")
            summary["at_bound"] = " ".join(summary["at_bound"])
            rows.append({"condition": condition.name, "subject": case.truth.name, **summary, **environment})
    return rows


def condition_rows(study: StudyResult) -> list[Row]:
    """Force and displacement of the multisine per condition, per axis, beside table 2.1."""
    rows = []
    for condition in CONDITIONS:
        recordings = [_trials(case) for case in study.of(condition.name)]
        if not recordings:
            continue
        force, displacement = published.applied_force(condition.name), published.rms_displacement(condition.name)
        rows.append(
            {
                "condition": condition.name,
                "published_force_N_mean": force.mean,
                "published_force_N_sd": force.sd,
                **_mean_sd("force_N", [_rms(recording["perturbation"]) for recording in recordings]),
                "published_displacement_m_mean": displacement.mean,
                "published_displacement_m_sd": displacement.sd,
                **_mean_sd("displacement_m", [_rms(recording["displacement"]) for recording in recordings]),
            }
        )
    return rows


def write_tables(study: StudyResult, folder: Path) -> None:
    """Write every table as CSV.

    Raises:
      OSError: the folder cannot be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in (
        ("parameters", parameter_rows(study)),
        ("parameters_summary", parameter_summary_rows(study)),
        ("fits", fit_rows(study)),
        ("conditions", condition_rows(study)),
    ):
        if rows:
            write_csv(rows, folder / f"{name}.csv")


def _identified(case: Case) -> Any:
    assert case.identification is not None  # StudyResult.of gives no other
    return case.identification


def _trials(case: Case) -> xr.Dataset:
    recording = load_recording(case.recording)
    inside = np.isnan(recording["limit_time"].values)
    return recording.isel(trial=np.flatnonzero((recording["condition"].values == case.condition.name) & inside))


def _rms(signal: xr.DataArray) -> float:
    """RMS per axis, pooled over axes and trials, over the period that the spectra use."""
    return float(np.sqrt((signal.sel(time=slice(8.0, 8.0 + 20.48 - 1e-9)) ** 2).mean()))


def _mean_sd(name: str, values: Sequence[float]) -> Row:
    sd = float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")
    return {f"{name}_mean": float(np.mean(values)), f"{name}_sd": sd}
