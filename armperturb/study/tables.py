"""Tables of a study: estimated against true against published."""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armperturb.analysis.export import fit_summary, write_csv
from armperturb.analysis.structures import unit
from armperturb.study import published
from armperturb.study.admittance import task_effect
from armperturb.study.runner import StudyResult
from armperturb.subject import Subject

Row = dict[str, Any]


def true_value(subject: Subject, parameter: str) -> float:
    """Value of a model parameter in a simulated subject, SI."""
    return subject.m_h + subject.m_f if parameter == "m_tot" else float(getattr(subject, parameter))


def parameter_rows(study: StudyResult) -> list[Row]:
    """Every estimated parameter of every subject beside its truth."""
    rows = []
    for condition in study.conditions:
        for case in study.of(condition.name):
            fit = case.identified.fit
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


def parameter_summary_rows(of_subjects: list[Row]) -> list[Row]:
    """Published mean (SD), true and estimated mean (SD) over subjects, and the median error, per parameter."""
    rows = []
    for condition in dict.fromkeys(row["condition"] for row in of_subjects):
        mine = [row for row in of_subjects if row["condition"] == condition]
        for name in dict.fromkeys(row["parameter"] for row in mine):
            values = [row for row in mine if row["parameter"] == name]
            printed = published_or_nan(published.parameter, condition, name)
            rows.append(
                {
                    "condition": condition,
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
    for condition in study.conditions:
        for case in study.of(condition.name):
            summary = fit_summary(case.identified)
            environment = summary.pop("environment")
            summary["at_bound"] = " ".join(summary["at_bound"])
            rows.append({"condition": condition.name, "subject": case.truth.name, **summary, **environment})
    return rows


def condition_rows(study: StudyResult) -> list[Row]:
    """What was run, and force and displacement of the multisine, per axis, beside table 2.1."""
    rows = []
    for condition in study.protocol.conditions:
        cases = study.of(condition.name)
        force, displacement = (
            published_or_nan(source, condition.name) for source in (published.applied_force, published.rms_displacement)
        )
        rows.append(
            {
                "condition": condition.name,
                "task": condition.task,
                "trials": study.n_trials(condition.name),
                "pulse_levels": " ".join(f"{level:g}" for level in condition.pulse_levels),
                "published_force_N_mean": force.mean,
                "published_force_N_sd": force.sd,
                **_mean_sd("force_N", [case.force for case in cases]),
                "intended_displacement_m": condition.rms_displacement if condition.has_multisine else math.nan,
                "published_displacement_m_mean": displacement.mean,
                "published_displacement_m_sd": displacement.sd,
                **_mean_sd("displacement_m", [case.displacement for case in cases]),
            }
        )
    return rows


def summary_rows(study: StudyResult, of_parameters: list[Row], of_fits: list[Row]) -> list[Row]:
    """One row per condition: how many were identified and how well."""
    rows = []
    for condition in study.conditions:
        fits = [row for row in of_fits if row["condition"] == condition.name]
        errors = [abs(row["error_percent"]) for row in of_parameters if row["condition"] == condition.name]
        used = sum(len(case.single_trials) for case in study.of(condition.name))
        rows.append(
            {
                "condition": condition.name,
                "subjects": study.settings.subjects,
                "identified": len(fits),
                "trials": study.n_trials(condition.name),
                "trials_used": used,
                "model": study.of(condition.name)[0].model,
                "median_abs_error_percent": float(np.median(errors)),
                "VAF_x_mean": _mean(row["VAF_x"] for row in fits),
                "VAF_y_mean": _mean(row["VAF_y"] for row in fits),
                "stable": sum(row["stable"] for row in fits),
                "converged": sum(row["converged"] for row in fits),
                "at_bound": sum(bool(row["at_bound"]) for row in fits),
            }
        )
    return rows


def task_effect_rows(study: StudyResult) -> list[Row]:
    """Admittance when relaxing over that when keeping position, beside the published factor; empty without either."""
    effect = task_effect(study)
    if effect is None:
        return []
    name = "admittance_ratio_rt7.5_pt7.5"
    return [{"quantity": name, "study": effect, "published": published.headline(name)}]


def write_tables(study: StudyResult, folder: Path) -> dict[str, list[Row]]:
    """Write every table that has rows as CSV, and return all by name.

    Raises:
      OSError: the folder cannot be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    of_parameters, of_fits = parameter_rows(study), fit_rows(study)
    tables = {
        "parameters": of_parameters,
        "parameters_summary": parameter_summary_rows(of_parameters),
        "fits": of_fits,
        "conditions": condition_rows(study),
        "summary": summary_rows(study, of_parameters, of_fits),
        "task_effect": task_effect_rows(study),
    }
    for name, rows in tables.items():
        if rows:
            write_csv(rows, folder / f"{name}.csv")
    return tables


def published_or_nan(source: Callable[..., published.MeanSD], *names: str) -> published.MeanSD:
    """A published mean (SD); NaN where the thesis prints none."""
    try:
        return source(*names)
    except KeyError:
        return published.MeanSD(math.nan, math.nan)


def _mean_sd(name: str, values: Sequence[float]) -> Row:
    sd = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
    return {f"{name}_mean": _mean(values), f"{name}_sd": sd}


def _mean(values: Iterable[float | None]) -> float:
    """Mean of the values that exist; NaN if none does."""
    there = [value for value in values if value is not None]
    return float(np.mean(there)) if there else math.nan
