"""Tables of a study: estimated against true against published."""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armperturb.analysis.fit.export import fit_summary
from armperturb.analysis.fit.structures import unit
from armperturb.files import write_csv
from armperturb.study.published import tables as published
from armperturb.study.results.study_result import StudyResult
from armperturb.subject import Subject

Row = dict[str, Any]


def true_value(subject: Subject | None, parameter: str) -> float:
    """Value of a model parameter in a simulated subject, SI; NaN if it is unknown, or its muscles are not linear.

    What is fitted to such a person is an arm that is linear around the person's movement, and no part of the person.
    """
    if subject is None or subject.muscle is not None:
        return math.nan
    return subject.m_h + subject.m_f if parameter == "m_tot" else float(getattr(subject, parameter))


def parameter_rows(study: StudyResult) -> list[Row]:
    """Every estimated parameter of every subject beside its truth (if any), and what the thesis's estimator gives."""
    rows = []
    for condition in study.conditions:
        for case in study.of(condition.name):
            fit, thesis = case.identified.fit, case.thesis.fit if case.thesis else None
            for name, estimate in fit.values.items():
                truth = true_value(case.truth, name)
                interval = fit.interval(name)
                of_thesis = thesis.values[name] if thesis else math.nan
                rows.append(
                    {
                        "condition": condition.name,
                        "subject": case.name,
                        "parameter": name,
                        "unit": unit(name),
                        "true": truth,
                        "estimated": estimate,
                        "standard_error": fit.standard_error[name],
                        "lower_95": interval.lower,
                        "upper_95": interval.upper,
                        "error_percent": 100.0 * (estimate / truth - 1.0),
                        "at_bound": str(name in fit.at_bound).lower(),
                        "thesis_estimated": of_thesis,
                        "thesis_sem": thesis.standard_error[name] if thesis else math.nan,
                        "thesis_error_percent": 100.0 * (of_thesis / truth - 1.0),
                    }
                )
    return rows


def parameter_summary_rows(of_subjects: list[Row]) -> list[Row]:
    """Published mean (SD), true and estimated mean (SD) over subjects, and how well they agree, per parameter."""
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
                    **mean_sd_of("true", [row["true"] for row in values]),
                    **mean_sd_of("estimated", [row["estimated"] for row in values]),
                    **mean_sd_of("thesis", _existing(row["thesis_estimated"] for row in values)),
                    **_judgement(values),
                }
            )
    return rows


def correlation_rows(study: StudyResult) -> list[Row]:
    """How the errors of each pair of parameters of every subject correlate, as the likelihood has it."""
    rows = []
    for condition in study.conditions:
        for case in study.of(condition.name):
            estimate = case.estimate
            names = tuple(estimate.values)
            rows += [
                {
                    "condition": condition.name,
                    "subject": case.name,
                    "parameter": names[i],
                    "other": names[j],
                    "correlation": float(estimate.correlation[i, j]),
                }
                for i, j in zip(*np.triu_indices(len(names), 1), strict=True)
            ]
    return rows


def fit_rows(study: StudyResult) -> list[Row]:
    """How each fit went, and in the columns that begin with thesis_ how that of the thesis's estimator did."""
    rows = []
    for condition in study.conditions:
        for case in study.of(condition.name):
            summary = _flat(fit_summary(case.identified))
            del summary["correlation"]
            environment = summary.pop("environment")
            beside = _flat(fit_summary(case.thesis)) if case.thesis else {}
            rows.append(
                {
                    "condition": condition.name,
                    "subject": case.name,
                    **summary,
                    **{f"thesis_{name}": beside.get(name) for name in _BESIDE},
                    **environment,
                }
            )
    return rows


_BESIDE = (
    *("status", "converged", "criterion", "VAF_x", "VAF_y", "stable", "largest_real_pole_per_s", "at_bound", "remarks"),
    *("n_trials", "n_stable", "n_positive_VAF"),
)
"""What is told of a fit of the thesis's estimator."""


def _flat(summary: Row) -> Row:
    """A summary in which lists are text."""
    return {**summary, "at_bound": " ".join(summary["at_bound"]), "remarks": "; ".join(summary["remarks"])}


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
                **mean_sd_of("force_N", [case.force for case in cases]),
                "intended_displacement_m": condition.rms_displacement if condition.has_multisine else math.nan,
                "published_displacement_m_mean": displacement.mean,
                "published_displacement_m_sd": displacement.sd,
                **mean_sd_of("displacement_m", [case.displacement for case in cases]),
            }
        )
    return rows


def summary_rows(study: StudyResult, of_parameters: list[Row], of_fits: list[Row]) -> list[Row]:
    """One row per condition: how many were identified and how well."""
    rows = []
    for condition in study.conditions:
        fits = [row for row in of_fits if row["condition"] == condition.name]
        used = sum(len(case.single_trials) for case in study.of(condition.name))
        rows.append(
            {
                "condition": condition.name,
                "subjects": study.n_people,
                "identified": len(fits),
                "trials": study.n_trials(condition.name),
                "trials_used": used,
                "model": study.of(condition.name)[0].model,
                **_judgement([row for row in of_parameters if row["condition"] == condition.name]),
                **{
                    f"{name}_mean": _mean(row[name] for row in fits)
                    for name in ("VAF_x", "VAF_y", "thesis_VAF_x", "thesis_VAF_y", "criterion", "thesis_criterion")
                },
                **{
                    name: sum(bool(row[name]) for row in fits)
                    for name in ("stable", "thesis_stable", "converged", "at_bound", "thesis_at_bound")
                },
                "suspicious": sum(case.estimate.is_suspicious for case in study.of(condition.name)),
            }
        )
    return rows


def write_tables(study: StudyResult, folder: Path) -> dict[str, list[Row]]:
    """Write every table that has rows as CSV, and `parameters.csv`; return the tables by name.

    Raises:
      OSError: the folder cannot be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if study.conditions:
        write_csv(study.to_frame(), folder / "parameters.csv")
    of_parameters, of_fits = parameter_rows(study), fit_rows(study)
    tables = {
        "estimates": of_parameters,
        "parameters_summary": parameter_summary_rows(of_parameters),
        "correlations": correlation_rows(study),
        "fits": of_fits,
        "conditions": condition_rows(study),
        "summary": summary_rows(study, of_parameters, of_fits),
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


def _judgement(values: list[Row]) -> Row:
    """How rows of parameters agree with the truth; NaN where there is none."""
    held = [float(row["lower_95"] <= row["true"] <= row["upper_95"]) for row in values if not math.isnan(row["true"])]
    return {
        "median_abs_error_percent": _median(abs(row["error_percent"]) for row in values),
        "thesis_median_abs_error_percent": _median(abs(row["thesis_error_percent"]) for row in values),
        "coverage_95_percent": 100.0 * _mean(held),
    }


def mean_sd_of(name: str, values: Sequence[float]) -> Row:
    """Two columns of a table, mean and SD of values; NaN where there are too few."""
    sd = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
    return {f"{name}_mean": _mean(values), f"{name}_sd": sd}


def _existing(values: Iterable[float | None]) -> list[float]:
    """The values that are numbers."""
    return [value for value in values if value is not None and not math.isnan(value)]


def _mean(values: Iterable[float | None]) -> float:
    """Mean of the values that exist; NaN if none does."""
    there = _existing(values)
    return float(np.mean(there)) if there else math.nan


def _median(values: Iterable[float | None]) -> float:
    """Median of the values that exist; NaN if none does."""
    there = _existing(values)
    return float(np.median(there)) if there else math.nan
