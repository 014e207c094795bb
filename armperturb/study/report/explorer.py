"""Numbers of every person in every condition, for the panels of the report that answer the mouse."""

import math
from typing import Any

from armperturb.analysis.fit.structures import unit
from armperturb.study.report.findings import excesses, low_gain
from armperturb.study.results.mean_admittance import by_task
from armperturb.study.results.study_result import StudyResult

DIGITS = 5
"""Significant digits of the numbers, more than a panel can show."""


class _Panels:
    """Panels of one quantity each, which grow point by point."""

    def __init__(self) -> None:
        self.made: dict[str, dict[str, Any]] = {}

    def add(
        self,
        quantity: tuple[str, str, bool],
        person: str,
        column: tuple[str, str, str],
        *numbers: float | None,
    ) -> None:
        """Add a person's value.

        Args:
          quantity: name, unit, and whether its axis is logarithmic.
          person: whose.
          column: condition, task, and what else its label says.
          *numbers: value and the ends of its interval, None where there is none.
        """
        name, of, logarithmic = quantity
        empty: dict[str, Any] = {"name": name, "unit": of, "logarithmic": logarithmic, "columns": [], "points": []}
        panel = self.made.setdefault(name, empty)
        if column not in panel["columns"]:
            panel["columns"].append(column)
        panel["points"].append([person, panel["columns"].index(column), *map(_short, numbers)])


def panels(study: StudyResult) -> list[dict[str, Any]]:
    """A panel per quantity, as JSON may hold it.

    Each has `name`, `unit`, `logarithmic`, `columns`: (condition, task, level of the pulse or empty), and `points`:
    [person, number of the column, value, lower and upper end of the 95 % interval or None].
    """
    made = _Panels()
    cases = [case for those in by_task(study).values() for condition in those for case in study.of(condition.name)]
    for case in cases:
        column = case.condition.name, case.condition.task, ""
        made.add(("gain at low frequencies", "mm/N", True), case.name, column, 1e3 * low_gain(case), None, None)
    for condition, level, values in excesses(study):
        for name, excess in values.items():
            column = condition.name, condition.task, level
            made.add(("recorded over predicted peak", "", False), name, column, excess, None, None)
    for case in cases:
        fit, column = case.identified.fit, (case.condition.name, case.condition.task, "")
        for name, value in fit.values.items():
            interval = fit.interval(name)
            made.add((name, unit(name), False), case.name, column, value, interval.lower, interval.upper)
    return list(made.made.values())


def _short(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(f"{value:.{DIGITS}g}")
