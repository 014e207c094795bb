"""The section EMG of the report: what is shown and written of it."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from armperturb.analysis.emg.activity import relaxation_sentence
from armperturb.analysis.emg.reference import mean_known
from armperturb.analysis.emg.reflex import CLEAR, DELAYS
from armperturb.study.comparison.cocontraction import cocontraction_tests, left_out_of_tests
from armperturb.study.report.figures import emg as emg_figures
from armperturb.study.results.emg import of_one_unit
from armperturb.study.results.mean_admittance import compared_conditions
from armperturb.study.results.study_result import StudyResult


def emg_drawings(study: StudyResult) -> "dict[str, partial[Any]]":
    """Figures of the section, by name."""
    there = of_one_unit(study.emg)
    drawn: dict[str, partial[Any]] = {}
    if any(person.cocontraction for person in there):
        drawn["emg_cocontraction"] = partial(emg_figures.cocontraction, there, compared_conditions(study))
    if (shown := next((person.shown for person in study.emg if person.shown), None)) is not None:
        drawn["emg_envelopes"] = partial(emg_figures.envelopes, shown.envelopes)
        drawn["emg_reflexes"] = partial(emg_figures.reflexes, shown.reflexes)
        if shown.onsets is not None:
            drawn["emg_pulses"] = partial(emg_figures.pulses, shown.onsets)
    return drawn


def relaxation(study: StudyResult) -> str:
    """Whether people relaxed, in one sentence; empty without EMG."""
    there = [person.activity for person in study.emg if person.levels]
    conditions = [condition.name for condition in study.protocol.conditions if condition.task == "RT"]
    return relaxation_sentence(there, conditions) if there and conditions else ""


def emg_rows(study: StudyResult) -> dict[str, list[dict[str, Any]]]:
    """Tables of EMG, by name: amplitudes and indices in percent, as units say; without rows where nobody has any."""
    levels = [
        {
            "subject": person.name,
            "unit": person.unit,
            **row._asdict(),
            "amplitude": 100.0 * row.amplitude,
            "lower_95": 100.0 * row.lower_95,
        }
        for person in study.emg
        for row in person.levels
    ]
    index = [
        {
            "subject": person.name,
            "unit": person.unit,
            **dict(zip(("condition", "part", "joint"), row[:3], strict=True)),
            "index": 100.0 * row.lesser,
            "ratio": row.ratio,
        }
        for person in study.emg
        for row in person.cocontraction
    ]
    delays = [{"subject": person.name, **row._asdict()} for person in study.emg for row in person.reflexes]
    tests = [test._asdict() for test in cocontraction_tests(of_one_unit(study.emg), compared_conditions(study))]
    return {"emg_levels": levels, "emg_cocontraction": index, "emg_reflexes": delays, "emg_tests": tests}


def emg_section(study: StudyResult) -> dict[str, Any]:
    """What the template shows."""
    rows = emg_rows(study)
    there = of_one_unit(study.emg)
    unit = there[0].unit if there else ""
    others = [f"{person.name} ({person.unit})" for person in study.emg if person.levels and person.unit != unit]

    def of_unit(name: str) -> list[dict[str, Any]]:
        return [row for row in rows[name] if row["unit"] == unit]

    return {
        "relaxation": relaxation(study),
        "unit": unit,
        "n": len(there),
        "shown_person": next((person.name for person in study.emg if person.shown), ""),
        "others": others,
        "index": _indices(of_unit("emg_cocontraction")),
        "tests": rows["emg_tests"],
        "delays": _delays(rows["emg_reflexes"]),
        "remarks": [
            *left_out_of_tests(there, compared_conditions(study)),
            *(line for person in study.emg for line in person.remarks),
        ],
        "levels": _levels(of_unit("emg_levels")),
    }


def _grouped(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> dict[tuple[str, ...], list[Mapping[str, Any]]]:
    groups: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def _indices(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Mean and SD over people of the index in each condition and part [%]."""
    return [
        {
            "condition": condition,
            "part": part,
            "joint": joint,
            "n": len(members),
            "mean": float(np.mean([row["index"] for row in members])),
            "sd": float(np.std([row["index"] for row in members], ddof=1)) if len(members) > 1 else np.nan,
        }
        for (condition, part, joint), members in _grouped(rows, ("condition", "part", "joint")).items()
    ]


def _levels(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """In how many people each muscle is active in each condition, of those of whom that is known."""
    return [
        {
            "condition": condition,
            "part": part,
            "muscle": muscle.replace("_", " "),
            "active": sum(row["is_active"] for row in members),
            "n": int(np.isfinite([row["p"] for row in members]).sum()),
            "mean": float(mean_known(np.array([row["amplitude"] for row in members]))),
        }
        for (condition, part, muscle), members in _grouped(rows, ("condition", "part", "muscle")).items()
    ]


def _delays(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Median delay over people of muscles that clearly respond and whose interval is within what is looked for [ms]."""
    said = []
    for (condition, muscle), members in _grouped(rows, ("condition", "muscle")).items():
        clear = (row for row in members if row["p"] < CLEAR)
        bounded = (row for row in clear if DELAYS[0] < row["lower_95_s"] and row["upper_95_s"] < DELAYS[1])
        delays = [1e3 * row["delay_s"] for row in bounded]
        if delays:
            said.append(
                {
                    "condition": condition,
                    "muscle": muscle.replace("_", " "),
                    "n": len(delays),
                    "of": len(members),
                    "median": float(np.median(delays)),
                    "least": min(delays),
                    "greatest": max(delays),
                    "coherence": float(np.median([row["coherence"] for row in members])),
                }
            )
    return said
