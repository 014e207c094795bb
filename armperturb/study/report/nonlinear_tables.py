"""Tables of nonlinear fits: beside the truth and the linear arms, and what all models predict of left-out pulses."""

import math

import numpy as np

from armperturb.analysis.nonlinear.model import BODY, GRIP, QUANTITIES, true_values, unit
from armperturb.muscle_law import ELEMENTS
from armperturb.study.report.tables import Row, coverage_percent, groups_of, mean_sd_of
from armperturb.study.report.words import WORDS
from armperturb.study.results.nonlinear_fits import NonlinearFit
from armperturb.study.results.study_result import StudyResult

SEES_NONE, SEES_OTHERS = "nonlinear", "nonlinear, other pulses"
SHOWN_MODELS = ("linear", "skeletal", SEES_NONE, SEES_OTHERS)
"""What predicts pulses; the nonlinear model was fitted without pulses, or with those of the other directions too."""


def words_of(parameter: str) -> str:
    """A parameter in words."""
    what, _, of = parameter.partition(".")
    return ", ".join(filter(None, (WORDS["nonlinear"][what], of)))


def degrees(pulses: str) -> str:
    """Directions of pulses, as tables have them, in words."""
    return " and ".join(f"{deg}\u00b0" for deg in pulses.split())


def fitted(study: StudyResult, task: str, *, pulses: bool) -> list[NonlinearFit]:
    """Fits in a task that did not fail, to what comes before pulses alone, or to some pulses too."""
    return [fit for fit in study.nonlinear if fit.task == task and not fit.failed and bool(fit.fitted_deg) == pulses]


def tasks_fitted(study: StudyResult) -> list[str]:
    """Tasks in which somebody was identified nonlinearly."""
    return list(dict.fromkeys(fit.task for fit in study.nonlinear if not fit.failed))


def true_parameters(study: StudyResult, fit: NonlinearFit) -> dict[str, float]:
    """Parameter to its true value; empty of people who are not known, or whose shoulder a strap lets move."""
    person = next((person for person in study.cohort if person.name == fit.name), None)
    conditions = {condition.name: condition for condition in study.protocol.conditions}
    if person is None or study.protocol.strap or fit.reference not in conditions:
        return {}

    def level(name: str) -> float:
        return conditions[name].co_contraction * person.levels.get(name, 1.0)

    levels = {name: level(name) / level(fit.reference) for name in conditions if name != fit.reference}
    return true_values(conditions[fit.reference].subject_of(person), levels)


def linear_parameters(study: StudyResult, name: str, task: str) -> dict[str, list[float]]:
    """Parameter to what the linear arm of each condition of a person has for it."""
    arms = [
        case.identified.fit.arm
        for condition in study.conditions
        for case in study.of(condition.name)
        if case.name == name and condition.task == task
    ]
    values = {name: [float(getattr(arm, name)) for arm in arms] for name in (*BODY, *GRIP)}
    for group in QUANTITIES:
        for place, element in enumerate(ELEMENTS):
            values[f"{group}.{element}"] = [float(arm.muscle_groups(group)[place]) for arm in arms]
    return values


def nonlinear_parameter_rows(study: StudyResult) -> list[Row]:
    """Every parameter of every fit beside its truth, if it is known, and the linear arms' least and most."""
    rows = []
    for fit in study.nonlinear:
        truth, linear = true_parameters(study, fit), linear_parameters(study, fit.name, fit.task)
        for name, value in fit.values.items():
            true = truth.get(name, math.nan)
            arms = linear.get(name) or [math.nan]
            rows.append(
                {
                    "task": fit.task,
                    "subject": fit.name,
                    "fitted_pulses_deg": " ".join(f"{deg:g}" for deg in fit.fitted_deg),
                    "parameter": name,
                    "unit": unit(name),
                    "true": true,
                    "linear_least": min(arms),
                    "linear_most": max(arms),
                    "estimated": value,
                    "lower_95": fit.lower[name],
                    "upper_95": fit.upper[name],
                    "ratio": value / true,
                    "at_bound": name in fit.at_bound,
                }
            )
    return rows


def nonlinear_summary_rows(of_parameters: list[Row]) -> list[Row]:
    """Means over people, and how fits agree with the truth, per task, parameter and whether pulses were fitted."""
    rows = []
    marked = [{**row, "pulses": bool(row["fitted_pulses_deg"])} for row in of_parameters]
    for (task, pulses, name), mine in groups_of(marked, "task", "pulses", "parameter"):
        known = mine["ratio"][np.isfinite(mine["ratio"])]
        width = (mine["upper_95"] - mine["lower_95"]) / mine["estimated"].abs()
        rows.append(
            {
                "task": task,
                "fitted_pulses": "others" if pulses else "none",
                "parameter": name,
                "unit": mine["unit"].iloc[0],
                "fits": len(mine),
                **mean_sd_of("true", mine["true"]),
                **mean_sd_of("estimated", mine["estimated"]),
                "linear_least_mean": mine["linear_least"].mean(skipna=False),
                "linear_most_mean": mine["linear_most"].mean(skipna=False),
                "median_ratio": known.median(),
                "median_abs_error_percent": 100.0 * (known - 1.0).abs().median(),
                "coverage_95_percent": coverage_percent(mine),
                "median_width_percent": 50.0 * width.median(),
                "at_bound": int(mine["at_bound"].sum()),
            }
        )
    return rows


LeftOut = tuple[str, float, float]
"""Person, predicted over recorded peak, and VAF of a pulse [%]."""


def left_out_pulses(study: StudyResult, task: str) -> dict[tuple[str, float], dict[str, list[LeftOut]]]:
    """Condition and level to each of `SHOWN_MODELS` to the pulses that it had not seen.

    The linear and the skeletal model predict each trial by its own fit, and so need a multisine before the pulse.
    """
    of_pulse: dict[tuple[str, float], dict[str, list[LeftOut]]] = {}
    for fit in (*fitted(study, task, pulses=False), *fitted(study, task, pulses=True)):
        for pulse in fit.pulses:
            of_model = of_pulse.setdefault((pulse.condition, pulse.level), {model: [] for model in SHOWN_MODELS})
            for model, peak in pulse.peak.items():
                if model == "nonlinear" or not fit.fitted_deg:
                    name = SEES_OTHERS if fit.fitted_deg else model
                    of_model[name].append((fit.name, peak, pulse.vaf[model]))
    order = [condition.name for condition in study.protocol.conditions]
    order += [condition for condition, _ in of_pulse if condition not in order]
    return {key: of_pulse[key] for key in sorted(of_pulse, key=lambda key: (order.index(key[0]), key[1]))}


def nonlinear_pulse_rows(study: StudyResult) -> list[Row]:
    """Predicted shares of peaks (2.25), and of trajectories, of left-out pulses per condition, level and model."""
    rows = []
    for task in tasks_fitted(study):
        for (condition, level), of_model in left_out_pulses(study, task).items():
            for model, shares in of_model.items():
                if shares:
                    peak, vaf = np.array([numbers for _, *numbers in shares]).T
                    rows.append(
                        {
                            "task": task,
                            "condition": condition,
                            "level": level,
                            "model": model,
                            "pulses": len(shares),
                            "median_peak_percent": float(np.median(peak)),
                            **mean_sd_of("peak_percent", peak.tolist()),
                            "median_vaf_percent": float(np.median(vaf)),
                            "least_vaf_percent": float(vaf.min()),
                        }
                    )
    return rows


def nonlinear_fit_rows(study: StudyResult) -> list[Row]:
    """How each fit went."""
    return [
        {
            "task": fit.task,
            "subject": fit.name,
            "fitted_pulses_deg": " ".join(f"{deg:g}" for deg in fit.fitted_deg),
            "converged": fit.converged,
            "status": fit.status or fit.failed,
            "parameters": len(fit.values),
            "at_bound": " ".join(fit.at_bound),
            "remarks": "; ".join(fit.remarks),
        }
        for fit in study.nonlinear
    ]


def nonlinear_tables(study: StudyResult) -> dict[str, list[Row]]:
    """All of them by name; without rows where nobody was identified nonlinearly."""
    of_parameters = nonlinear_parameter_rows(study)
    return {
        "nonlinear_fits": nonlinear_fit_rows(study),
        "nonlinear_parameters": of_parameters,
        "nonlinear_summary": nonlinear_summary_rows(of_parameters),
        "nonlinear_pulses": nonlinear_pulse_rows(study),
    }
