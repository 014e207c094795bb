"""The sections of the report, in order: title, template, and the values that the template shows."""

import itertools
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from armperturb.analysis.fit.maximum_likelihood import SUSPICIOUS
from armperturb.analysis.measures.statistics import FEWEST
from armperturb.pages.formats import digits, fixed
from armperturb.study.comparison.ceiling import OF_PRINTED_ARMS, causes, replicate_share
from armperturb.study.comparison.effects import Effects
from armperturb.study.comparison.elastic_limits import NAMES, elastic_rows
from armperturb.study.comparison.headlines import Headline
from armperturb.study.comparison.score import ANOTHER, Score, Share, missing_cells, shares
from armperturb.study.experiments.mechanisms import PULSES, Yielding
from armperturb.study.experiments.moving_shoulder import MovingShoulder
from armperturb.study.protocol import Condition
from armperturb.study.published import tables as published
from armperturb.study.report import findings as of_study
from armperturb.study.report.emg import emg_section, relaxation
from armperturb.study.report.explorer import panels
from armperturb.study.report.figures.pulses import ratio_is_published
from armperturb.study.report.films import Films
from armperturb.study.report.nonlinear_tables import SHOWN_MODELS, nonlinear_tables, words_of
from armperturb.study.report.published_tables import published_tables
from armperturb.study.report.tables import Row, mean_sd_of
from armperturb.study.report.words import WORDS
from armperturb.study.results.mean_admittance import (
    at_usual_frequencies,
    by_task,
    differ_in_amplitude,
    main_conditions,
    perturbed_conditions,
)
from armperturb.study.results.quantities import Cell, published_cells
from armperturb.study.results.study_result import StudyResult
from armperturb.subject import TASKS

NEAR = 0.15
"""A headline number this close to the published one is near [-]."""

MOST_NAMED = 5
"""How many cells or tables the list of differences names."""

PULSES_DRAWN = {"peak_displacement", "pulse_admittance", "pulse_prediction", "trajectories_PT", "trajectories_RT"}
"""Figures of pulse responses."""


def sections(
    study: StudyResult,
    score: Score | None,
    effects: Effects,
    rows: Mapping[str, list[Row]],
    *,
    yielding: Yielding | None,
    shoulder: MovingShoulder | None,
    drawn: Collection[str],
    played: Sequence[Mapping[str, Any]] = (),
    films: Films | str = "",
    stills: Sequence[str] = (),
) -> dict[str, dict[str, Any]]:
    """All sections that a study has content for, in order: template to what it shows beside what all sections know.

    Args:
      study: analysed.
      score: beside the published tables; None if nothing of them was recorded.
      effects: tests within people.
      rows: tables by name.
      yielding: what the first person's muscles do; None if they are linear.
      shoulder: what it does if the first person's shoulder moves; None of people who were not simulated.
      drawn: names of the figures that are there.
      played: people whose trials are played, see `played.played_data`.
      films: of pulses; the reason if this machine cannot make any.
      stills: tasks of the trials that films and stills are of.
    """
    conditions = study.protocol.conditions
    # In which people shall move further, or less far, in the experiment than in practice.
    drifting = [c for c in conditions if c.has_multisine and (c.reached != 1.0 or c.reached_spread)]
    ratios = of_study.findings(study)
    flagged = {"flagged": of_study.n_flagged(rows["fits"]), "reasons": of_study.flags(rows["fits"])}
    alone = of_study.law_alone(yielding)
    contexts: dict[str, dict[str, Any]] = {
        "summary": {
            "rows": rows["summary"],
            "findings": ratios,
            "lost_pulses": lost_pulses(study),
            "alone": alone,
            "given": of_study.fall_is_given(study, ratios.get("amplitude_PT")),
            "set_levels": of_study.set_levels(study, ratios.get("amplitude_PT") or ratios.get("condition_PT")),
            "relaxation": relaxation(study),
            "fits": rows["fits"],
            **flagged,
            "differ": of_study.estimators_differ(rows["estimates"]),
        },
        "method": {},
        "conditions": {
            "rows": rows["conditions"],
            "drifting": drifting,
            "named_by_displacement": named_by_displacement(study),
            "holding": _force_of_holding(rows["conditions"]),
        },
        "left_out": {"lists": left_out(study, rows["fits"], study.remarks if score is None else score.remarks)},
    }
    if study.conditions:
        contexts["summary"]["averaged"] = _averaged(study, main_conditions(study).values())
        contexts |= _of_identified(study, effects, rows, ratios, flagged)
    if study.conditions or played:
        contexts["explorer"] = {"panels": panels(study), "played": played}
    if PULSES_DRAWN & set(drawn):
        contexts["pulses"] = _of_pulses(study, score, ratios)
    if study.emg:
        contexts["emg"] = emg_section(study)
    if study.nonlinear:
        contexts["nonlinear"] = _nonlinear(study)
    if effects.rows or effects.admittance or (effects.remarks and len(study.names) >= FEWEST):
        contexts["statistics"] = {"effects": effects, "of_amplitude": _of_amplitude(study)}
    if (joints := joint_rows(study)) or score is not None or "joint_rotations" in drawn:
        contexts["kinematics"] = {
            "joints": joints,
            "has_truth": any(person.true_cells for person in study.people),
            "limits": elastic_rows(_means(study)),
            "printed_limits": elastic_rows({cell: printed.mean for cell, printed in published_cells().items()}),
            "shoulder": shoulder,
            "names": NAMES,
        }
    if "stills" in drawn:
        contexts["stills"] = {
            "tasks": stills,
            "films": films.films if isinstance(films, Films) else (),
            "reason": "" if isinstance(films, Films) else films,
        }
    if yielding is not None:
        contexts["yielding"] = {"yielding": yielding, "pulses": PULSES, "alone": alone}
    if score is not None:
        contexts["published"] = {
            "tables": published_tables(score),
            "score": score,
            "missing": missing_cells(score),
            "another": ANOTHER,
            **_agreement(score),
        }
    return {template: contexts[template] for template in WORDS["sections"] if template in contexts}


def _of_identified(
    study: StudyResult,
    effects: Effects,
    rows: Mapping[str, list[Row]],
    ratios: Mapping[str, Any],
    flagged: Mapping[str, Any],
) -> dict[str, dict[str, Any]]:
    """What the sections of spectra, fits and parameters show of people who were identified."""
    of_tasks, main = by_task(study), main_conditions(study).values()
    return {
        "admittance": {
            "effects": effects,
            "findings": ratios,
            "amplitudes": {task: differ_in_amplitude(of_task) for task, of_task in of_tasks.items()},
            "averaged": _averaged(study, main),
            "in_all": {task: _averaged(study, of_task) for task, of_task in of_tasks.items()},
        },
        "fits": {
            **{"summary": rows["summary"], "rows": rows["fits"], "remarks": remarks(study), **flagged},
            "rejected": _mostly(rows["fits"], lambda row: row["p_value"] < SUSPICIOUS),
        },
        "parameters": {
            "rows": rows["parameters_summary"],
            "main": [condition.name for condition in main],
            "flagged": _flagged(rows["fits"]),
            "stuck": _mostly(rows["fits"], lambda row: "k_s" in row["at_bound"].split()),
            "of_amplitude": _of_amplitude(study),
        },
    }


def _of_pulses(study: StudyResult, score: Score | None, ratios: Mapping[str, Any]) -> dict[str, Any]:
    """What the section of pulses shows."""
    trials = [trial for person in study.people for trial in person.trials]
    conditions = study.protocol.conditions
    return {
        "findings": ratios,
        "of_amplitude": _of_amplitude(study),
        "excess": of_study.excess_rows(study),
        "measured": _with_pulses(study, "displacement"),
        "predicted": _with_pulses(study, "prediction"),
        "lost": sum(trial.pulse_level != 0.0 and math.isnan(trial.displacement) for trial in trials),
        "ratio_is_published": any(ratio_is_published(each.name, each.pulse_levels) for each in conditions),
        # But for p values, which the statistics have.
        "headlines": score
        and [line for line in score.headlines if "pulse" in line.name and not line.name.startswith("p_")],
    }


ALIKE = 0.15
"""Difference of two movements, of their logarithms, up to which they count as equal [-]."""


def _of_amplitude(study: StudyResult) -> bool:
    """Whether conditions that are compared differ in the amplitude of their movement."""
    of_tasks = [perturbed_conditions(study, task) for task in TASKS]
    compared = [conditions for conditions in of_tasks if sum(each.has_multisine for each in conditions) > 1]
    return bool(compared) and all(differ_in_amplitude(conditions) for conditions in compared)


def _force_of_holding(rows: Sequence[Row]) -> float:
    """RMS force in the position task over that in the relax task where both move people alike, geometric mean [-]."""
    of_task = {task: [row for row in rows if row["task"] == task and row["force_N_mean"] > 0.0] for task in TASKS}
    ratios = [
        position["force_N_mean"] / relax["force_N_mean"]
        for position, relax in itertools.product(of_task["PT"], of_task["RT"])
        if abs(math.log(position["displacement_m_mean"] / relax["displacement_m_mean"])) < ALIKE
    ]
    return float(np.exp(np.mean(np.log(ratios)))) if ratios else math.nan


def _by_condition(fits: Sequence[Row]) -> dict[str, list[Row]]:
    of_condition: dict[str, list[Row]] = {}
    for row in fits:
        of_condition.setdefault(row["condition"], []).append(row)
    return of_condition


def _flagged(fits: Sequence[Row]) -> dict[str, tuple[int, int]]:
    """Condition to how many of its maximum likelihood fits are flagged, and of how many; without those of none."""
    counts = {condition: (of_study.n_flagged(rows), len(rows)) for condition, rows in _by_condition(fits).items()}
    return {condition: count for condition, count in counts.items() if count[0]}


def _mostly(fits: Sequence[Row], is_so: Callable[[Row], bool]) -> dict[str, tuple[int, int]]:
    """Conditions of which most maximum likelihood fits are so, to how many, and of how many."""
    counts = {condition: (sum(map(is_so, rows)), len(rows)) for condition, rows in _by_condition(fits).items()}
    return {condition: count for condition, count in counts.items() if 2 * count[0] > count[1]}


def _at_other_frequencies(study: StudyResult) -> list[str]:
    """Who is in no mean curve of the admittance, since most people have it at other frequencies."""
    said = []
    for condition in itertools.chain.from_iterable(by_task(study).values()):
        cases = study.of(condition.name)
        usual = {case.name for case in at_usual_frequencies(cases)}
        others = [case.name for case in cases if case.name not in usual]
        said += [f"{name} in {condition.name}: admittance at other frequencies than most people's" for name in others]
    return said


def of_people(study: StudyResult, counts: Mapping[str, int]) -> str:
    """Whose something is: "4 people"; with how many of them in each condition, where some lack it.

    Args:
      study: analysed.
      counts: name of a condition to the number of people there.
    """
    n_people = len(study.names)
    whole = f"{n_people} {'person' if n_people == 1 else 'people'}"
    if all(count == n_people for count in counts.values()):
        return whole
    if len(counts) == 1:
        return f"{next(iter(counts.values()))} of {whole}"
    return f"{whole} ({', '.join(f'{count} in {name}' for name, count in counts.items())})"


def _with_pulses(study: StudyResult, of: str) -> str:
    """Whose pulses have a value of `PulseMeans`, see `of_people`."""
    there = [
        {name for (name, _), means in person.pulses.items() if math.isfinite(getattr(means, of))}
        for person in study.people
    ]
    names = dict.fromkeys(name for name, _ in study.pulses)
    return of_people(study, {name: count for name in names if (count := sum(name in each for each in there))})


def _averaged(study: StudyResult, conditions: Iterable[Condition]) -> str:
    """Whose mean admittances are drawn in conditions, see `of_people`."""
    return of_people(study, {each.name: len(at_usual_frequencies(study.of(each.name))) for each in conditions})


def lost_pulses(study: StudyResult) -> int:
    """How many trials have pulses, if not even one response could be measured; else 0."""
    return 0 if study.pulses else sum(study.n_trials(c.name) for c in study.protocol.conditions if c.pulse_levels)


def named_by_displacement(study: StudyResult) -> bool:
    """Whether perturbed conditions are named by task and intended displacement [mm], as those of the thesis are."""
    perturbed = [c for c in study.protocol.conditions if c.contraction is None]
    named = all(c.name == f"{c.task}{1e3 * c.rms_displacement:g}" for c in perturbed)
    return named and any(c.has_multisine for c in perturbed)


def _nonlinear(study: StudyResult) -> dict[str, Any]:
    """What each table of nonlinear fits shows, and what the fits say of themselves."""
    tables = nonlinear_tables(study)
    pulses: dict[tuple[str, float], dict[str, Row]] = {}
    for row in tables["nonlinear_pulses"]:
        pulses.setdefault((row["condition"], row["level"]), {})[row["model"]] = row
    summaries: dict[str, dict[str, dict[str, Row]]] = {}
    for row in tables["nonlinear_summary"]:
        summaries.setdefault(row["task"], {}).setdefault(row["parameter"], {})[row["fitted_pulses"]] = row
    people: dict[tuple[str, str], dict[str, dict[str, Row]]] = {}
    for row in tables["nonlinear_parameters"]:
        of_person = people.setdefault((row["task"], row["subject"]), {})
        of_person.setdefault(row["parameter"], {})[row["fitted_pulses_deg"]] = row
    there = {case.condition.task for case in study.cases if case.identification is not None}
    return {
        "pulses": pulses,
        "models": SHOWN_MODELS,
        "summaries": summaries,
        "people": people,
        "remarks": {
            (task, name): {fit.label: fit.remarks for fit in study.nonlinear if (fit.task, fit.name) == (task, name)}
            for task, name in people
        },
        "words_of": words_of,
        "digits": digits,
        "two_digits": partial(digits, n=2),
        "whole": partial(fixed, decimals=0),
        "failed": [fit for fit in study.nonlinear if fit.failed],
        "unasked": sorted(there - {fit.task for fit in study.nonlinear}),
    }


def joint_rows(study: StudyResult) -> list[Row]:
    """Joint rotations and velocities from the handle's path, and as simulated, beside the printed ones, SI."""
    rows = []
    recorded = [cell for person in study.people for cell in person.cells]
    unprinted = [cell for cell in dict.fromkeys(recorded) if cell not in published_cells()]
    others = [cell for each in study.protocol.conditions for cell in unprinted if cell.condition == each.name]
    for cell in sorted((*published_cells(), *others), key=lambda cell: cell.table):
        if not cell.table.startswith("F"):
            continue
        printed = published_cells().get(cell, published.MeanSD(math.nan, math.nan))
        path, true = (
            [of_person[cell] for of_person in of_people if cell in of_person]
            for of_people in ([p.cells for p in study.people], [p.true_cells for p in study.people])
        )
        if path:
            row: Row = {"table": cell.table, "condition": cell.condition, "quantity": cell.quantity}
            row |= {"published_mean": printed.mean, "published_sd": printed.sd}
            rows.append(row | mean_sd_of("path", path) | mean_sd_of("simulated", true))
    return rows


def _means(study: StudyResult) -> dict[Cell, float]:
    """Means over people of the cells that somebody fills."""
    values_of = {cell: [p.cells[cell] for p in study.people if cell in p.cells] for cell in published_cells()}
    return {cell: float(np.mean(values)) for cell, values in values_of.items() if values}


def _agreement(score: Score) -> dict[str, Any]:
    """Score, headline numbers and what differs."""
    by_name = {line.name: line for line in score.headlines}
    factors = [
        {"label": label, "mark": _mark(line), **vars(line)}
        for name, label in WORDS["headlines"].items()
        if (line := by_name.get(name))
    ]
    every = shares(score)
    of_group = {label: every[name] for name, label in WORDS["groups"].items()}
    reach = {name: f"{low} to {high} %" for name, (low, high) in OF_PRINTED_ARMS.items()}
    reachable = {label: reach.get(name, "") for name, label in WORDS["groups"].items()}
    return {
        "factors": factors,
        "shares": of_group,
        "differs": _differs(score, factors, every),
        "reachable": reachable,
        "replicate": replicate_share(1.0, score.people),
    }


def _mark(line: Headline) -> str:
    """ "beyond-1" where ours is not within `NEAR` of the printed one, or "missing"."""
    if not math.isfinite(line.ours):
        return "missing"
    return "" if abs(line.ours / float(line.published) - 1.0) <= NEAR else "beyond-1"


def _differs(score: Score, factors: list[Row], every: Mapping[str, Share]) -> list[str]:
    """The largest differences, in words.

    Args:
      score: of the study.
      factors: the headline numbers, marked.
      every: the shares of the score.
    """
    off = [factor for factor in factors if factor["mark"] == "beyond-1"]
    lines = [f"{len(off)} of {len(factors)} headline numbers are off by more than {100.0 * NEAR:.0f} %"] if off else []
    if against := [factor for factor in off if factor["contradiction"]]:
        lines.append(f"no people can have {len(against)} of these, which other printed numbers contradict")
    measured = [scored for scored in score.cells if scored.cell.table[0] in "2F"]
    beyond = [scored for scored in measured if abs(scored.z) > 2.0]
    if beyond:
        named = ", ".join(f"{scored.cell.quantity} in {scored.cell.condition}" for scored in beyond[:MOST_NAMED])
        more = f" and {len(beyond) - MOST_NAMED} more" if len(beyond) > MOST_NAMED else ""
        lines.append(f"movements beyond 2 SD: {named.replace('_', ' ')}{more}")
    within = {name: scored.parts_of_computed[1] for name, scored in every.items() if scored.computed}
    of_tables = {name: part for name, part in within.items() if "." in name and " " not in name}
    far = sorted((part, name) for name, part in of_tables.items() if part < 0.5)
    if far:
        worst = ", ".join(f"{name} ({100.0 * part:.0f}\u00a0%)" for part, name in far[:MOST_NAMED])
        lines.append(f"less than half of the cells within 1 SD: {len(far)} of {len(of_tables)} tables, least {worst}")
    if not score.differences:  # else neither people nor print are the cause
        lines += causes({name: within[name] for name in WORDS["groups"] if name in within}, score.people)
    lacking = sum(missing_cells(score).values())
    if lacking:
        lines.append(
            f"{lacking} of {len(score.cells)} cells could not be computed and count as not reproduced in the tables"
        )
    return lines


def left_out(study: StudyResult, fits: list[Row], remarks: Sequence[str]) -> dict[str, list[str]]:
    """What is missing and which results are doubtful: heading to one line each."""

    def those(says: Callable[[Row], str]) -> list[str]:
        return [f"{row['subject']} in {row['condition']}: {says(row)}" for row in fits if says(row)]

    return {
        "Missing, or made with other settings or versions": list(study.missing),
        "Left out of single results": [line for line in remarks if line not in study.missing],
        "Left out of mean curves of the admittance": _at_other_frequencies(study),
        "Trials and people left out": [reason for case in study.cases for reason in case.left_out],
        "Maximum likelihood fits that did not converge": those(lambda row: "" if row["converged"] else row["status"]),
        "Maximum likelihood fits with a parameter at its bound": those(lambda row: row["at_bound"]),
        "Fits with residuals larger than the noise explains": those(
            lambda row: (
                f"chi2 / dof {row['chi2'] / row['dof']:.2f}, p = {row['p_value']:.1g}"
                if row["p_value"] < SUSPICIOUS
                else ""
            )
        ),
        "Maximum likelihood fits that are unstable on the manipulator": those(
            lambda row: "" if row["stable"] else f"largest real part of a pole {row['largest_real_pole_per_s']:.3g} 1/s"
        ),
    }


def remarks(study: StudyResult) -> dict[str, dict[str, list[str]]]:
    """Condition to person to the remarks on their estimates, those of the thesis's estimator last."""
    said: dict[str, dict[str, list[str]]] = {}
    for case in study.cases:
        if case.identification is not None:
            lines = list(case.identified.fit.remarks)
            lines += [f"thesis's estimator: {line}" for line in (case.thesis.fit.remarks if case.thesis else ())]
            if lines:
                said.setdefault(case.condition.name, {})[case.name] = lines
    return {condition.name: said[condition.name] for condition in study.conditions if condition.name in said}
