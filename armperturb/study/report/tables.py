"""Tables of a study: estimated against true against published."""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from armperturb.analysis.fit.export import fit_summary
from armperturb.analysis.fit.structures import unit
from armperturb.files import write_csv
from armperturb.study.published import tables as published
from armperturb.study.results.cases import Case
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
    for case in _identified(study):
        fit, thesis = case.identified.fit, case.thesis.fit if case.thesis else None
        for name, estimate in fit.values.items():
            truth = true_value(case.truth, name)
            interval = fit.interval(name)
            of_thesis = thesis.values[name] if thesis else math.nan
            rows.append(
                {
                    "condition": case.condition.name,
                    "subject": case.name,
                    "parameter": name,
                    "unit": unit(name),
                    "true": truth,
                    "estimated": estimate,
                    "standard_error": fit.standard_error[name],
                    "lower_95": interval.lower,
                    "upper_95": interval.upper,
                    "error_percent": 100.0 * (estimate / truth - 1.0),
                    "at_bound": name in fit.at_bound,
                    "thesis_estimated": of_thesis,
                    "thesis_sem": thesis.standard_error[name] if thesis else math.nan,
                    "thesis_error_percent": 100.0 * (of_thesis / truth - 1.0),
                }
            )
    return rows


def parameter_summary_rows(of_subjects: list[Row]) -> list[Row]:
    """Published mean (SD), true and estimated mean (SD) over subjects, and how well they agree, per parameter."""
    rows = []
    for (condition, name), values in groups_of(of_subjects, "condition", "parameter"):
        printed = published_or_nan(published.parameter, condition, name)
        rows.append(
            {
                "condition": condition,
                "parameter": name,
                "unit": unit(name),
                "published_mean": printed.mean,
                "published_sd": printed.sd,
                **mean_sd_of("true", values["true"]),
                **mean_sd_of("estimated", values["estimated"]),
                **mean_sd_of("thesis", values["thesis_estimated"]),
                **_judgement(values),
            }
        )
    return rows


def correlation_rows(study: StudyResult) -> list[Row]:
    """How the errors of each pair of parameters of every subject correlate, as the likelihood has it."""
    return [
        {
            "condition": case.condition.name,
            "subject": case.name,
            "parameter": parameter,
            "other": other,
            "correlation": float(case.estimate.correlation[i, j]),
        }
        for case in _identified(study)
        for (i, parameter), (j, other) in itertools.combinations(enumerate(case.estimate.values), 2)
    ]


def fit_rows(study: StudyResult) -> list[Row]:
    """How each fit went, and in the columns that begin with thesis_ how that of the thesis's estimator did."""
    rows = []
    for case in _identified(study):
        summary = _flat(fit_summary(case.identified))
        del summary["correlation"]
        environment = summary.pop("environment")
        thesis = _flat(fit_summary(case.thesis)) if case.thesis else {}
        beside = {f"thesis_{name}": thesis.get(name) for name in _BESIDE}
        rows.append({"condition": case.condition.name, "subject": case.name, **summary, **beside, **environment})
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
    """What was run, force and displacement of the multisine, per axis, beside table 2.1, and the unit of pulses."""
    rows = []
    for condition in study.protocol.conditions:
        cases = [case for case in study.cases if case.condition.name == condition.name]
        is_intended = condition.has_multisine and study.made is not None
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
                "intended_displacement_m": condition.rms_displacement if is_intended else math.nan,
                "published_displacement_m_mean": displacement.mean,
                "published_displacement_m_sd": displacement.sd,
                **mean_sd_of("displacement_m", [case.displacement for case in cases]),
                **mean_sd_of("pulse_unit_N", pulse_units(study) if condition.pulse_levels else []),
            }
        )
    return rows


def pulse_units(study: StudyResult) -> list[float]:
    """Peak force of a pulse of level 1 [N]: each person's, if it follows from practice; none if nobody knows it."""
    protocol = study.protocol
    if study.made is None:
        return []
    if protocol.forces == "practice" and protocol.pulse_unit_condition:
        return [protocol.pulse_unit_factor * case.force for case in study.of(protocol.pulse_unit_condition)]
    return [protocol.pulse_unit]


def summary_rows(study: StudyResult, of_parameters: list[Row], of_fits: list[Row]) -> list[Row]:
    """One row per condition: how many were identified and how well."""
    rows = []
    for condition in study.conditions:
        fits = [row for row in of_fits if row["condition"] == condition.name]
        used = sum(case.identified.n_trials for case in study.of(condition.name))
        rows.append(
            {
                "condition": condition.name,
                "subjects": study.n_people,
                "identified": len(fits),
                "trials": study.n_trials(condition.name),
                "trials_used": used,
                "model": study.of(condition.name)[0].model,
                **_judgement(pd.DataFrame([row for row in of_parameters if row["condition"] == condition.name])),
                **{
                    f"{name}_mean": pd.Series([row[name] for row in fits], dtype=float).mean()
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

    A table of an earlier report that has no rows any more is removed.

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
        write_or_remove(rows, folder / f"{name}.csv")
    return tables


def write_or_remove(rows: list[Row], path: Path) -> None:
    """Write a table as CSV; without rows remove that of an earlier report, which would be taken for this one's.

    Raises:
      OSError: the file cannot be written or removed.
    """
    if rows:
        write_csv(rows, path)
    else:
        path.unlink(missing_ok=True)


def published_or_nan(source: Callable[..., published.MeanSD], *names: str) -> published.MeanSD:
    """A published mean (SD); NaN where the thesis prints none."""
    try:
        return source(*names)
    except KeyError:
        return published.MeanSD(math.nan, math.nan)


def groups_of(rows: list[Row], *columns: str) -> Iterable[tuple[Any, pd.DataFrame]]:
    """Values of these columns, and the rows that have them; in the order in which they first appear."""
    return pd.DataFrame(rows).groupby(list(columns), sort=False) if rows else ()


def mean_sd_of(name: str, values: Sequence[float] | pd.Series) -> Row:
    """Two columns of a table, mean and SD of the values that are numbers; NaN where there are too few."""
    series = pd.Series(values, dtype=float)
    return {f"{name}_mean": series.mean(), f"{name}_sd": series.std()}


def coverage_percent(values: pd.DataFrame) -> float:
    """In how many of the rows with a truth the 95 % interval holds it [%]; NaN if none has one."""
    known = values[values["true"].notna()]
    return 100.0 * float(known["true"].between(known["lower_95"], known["upper_95"]).mean())


def _judgement(values: pd.DataFrame) -> Row:
    """How rows of parameters agree with the truth; NaN where there is none."""
    return {
        "median_abs_error_percent": values["error_percent"].abs().median(),
        "thesis_median_abs_error_percent": values["thesis_error_percent"].abs().median(),
        "coverage_95_percent": coverage_percent(values),
    }


def _identified(study: StudyResult) -> list[Case]:
    """Cases with a fit, by condition."""
    return [case for condition in study.conditions for case in study.of(condition.name)]
