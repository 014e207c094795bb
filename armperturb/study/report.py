"""The report of a study: tables, figures, and one HTML file that holds everything and opens offline."""

import base64
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from armperturb.analysis.export import write_csv
from armperturb.files import written_whole
from armperturb.perturbations.multisine import CLUSTERS, PERIOD
from armperturb.perturbations.pulse import PULSE_DIRECTIONS_DEG
from armperturb.study import figures
from armperturb.study.protocol import CONDITIONS, PULSE_UNIT, TAIL
from armperturb.study.runner import StudyResult
from armperturb.study.style import save_svg
from armperturb.study.tables import Row, condition_rows, fit_rows, parameter_rows, parameter_summary_rows, write_tables

PUBLISHED_TASK_EFFECT = 18.0
"""Admittance in RT7.5 over that in PT7.5, mean over the lowest two frequencies and the diagonal [-] (thesis 3.1)."""

MISSING = "–"


@dataclass(frozen=True, kw_only=True)
class Section:
    """One section of the report.

    Attributes:
      title: its heading.
      template: file in `templates/`, which is also its anchor.
      context: what the template shows beside what all sections know.
    """

    title: str
    template: str
    context: dict[str, Any]


class Picture(NamedTuple):
    """A figure inside the report.

    Attributes:
      uri: the SVG itself, as a data URI.
      width: [inch].
      height: [inch].
    """

    uri: str
    width: float
    height: float


def write_report(study: StudyResult, out: Path) -> Path:
    """Write `tables/*.csv`, `figures/*.svg` and `report.html`, which needs neither of them nor a network.

    Without a GL library, the picture of the rig is left out and the report says so.

    Args:
      study: the finished study; its recordings must still be there.
      out: folder, which is made if needed.

    Returns:
      The path of the report.

    Raises:
      OSError: the folder cannot be written to, or a recording is gone.
    """
    tables = out / "tables"
    write_tables(study, tables)
    summary = summary_rows(study)
    if summary:
        write_csv(summary, tables / "summary.csv")
    effect = task_effect(study)
    if effect is not None:
        row = {"quantity": "low-frequency admittance, RT7.5 over PT7.5", "study": effect}
        write_csv([{**row, "published": PUBLISHED_TASK_EFFECT}], tables / "task_effect.csv")

    pictures, not_drawn = _draw(study, out / "figures")
    sections = (
        Section(title="Summary", template="summary", context={"rows": summary, "task_effect": effect}),
        Section(title="Method", template="method", context={}),
        Section(title="Conditions", template="conditions", context={"rows": condition_rows(study)}),
        Section(title="Admittance", template="admittance", context={}),
        Section(title="Fits", template="fits", context={"rows": fit_rows(study)}),
        Section(title="Parameters", template="parameters", context={"rows": parameter_summary_rows(study)}),
        Section(title="What was left out", template="left_out", context={"lists": left_out(study)}),
    )
    page = _page(study, sections, pictures, not_drawn)
    report = out / "report.html"
    with written_whole(report) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return report


def task_effect(study: StudyResult) -> float | None:
    """How many times larger the admittance is in RT7.5 than in PT7.5 at low frequencies [-].

    Mean over the lowest two frequencies and the diagonal of the ratio of the gains, which are geometric means over
    subjects; None if nobody was identified in one of the conditions. Source: thesis 3.1.
    """
    if not (study.of("PT7.5") and study.of("RT7.5")):
        return None
    relax, position = (figures.mean_admittance(study, name).gain[:2] for name in ("RT7.5", "PT7.5"))
    return float(np.mean([np.diag(ratio) for ratio in relax / position]))


def summary_rows(study: StudyResult) -> list[Row]:
    """One row per condition: how many were identified and how well."""
    of_parameters, of_fits = parameter_rows(study), fit_rows(study)
    rows = []
    for condition in CONDITIONS:
        fits = [row for row in of_fits if row["condition"] == condition.name]
        if not fits:
            continue
        errors = [abs(row["error_percent"]) for row in of_parameters if row["condition"] == condition.name]
        left_out = sum(len(case.left_out) for case in study.cases if case.condition.name == condition.name)
        rows.append(
            {
                "condition": condition.name,
                "subjects": study.settings.subjects,
                "identified": len(fits),
                "trials": study.settings.subjects * condition.n_trials(),
                "trials_left_out": left_out,
                "model": condition.model,
                "median_abs_error_percent": float(np.median(errors)),
                "VAF_x_mean": _mean(row["VAF_x"] for row in fits),
                "VAF_y_mean": _mean(row["VAF_y"] for row in fits),
                "stable": sum(row["stable"] for row in fits),
                "converged": sum(row["converged"] for row in fits),
                "at_bound": sum(bool(row["at_bound"]) for row in fits),
            }
        )
    return rows


def left_out(study: StudyResult) -> dict[str, list[str]]:
    """What no table shows, or what a reader should not trust: heading to one line each."""
    fits = fit_rows(study)

    def those(says: Callable[[Row], str]) -> list[str]:
        return [f"{row['subject']} in {row['condition']}: {says(row)}" for row in fits if says(row)]

    return {
        "Trials at the limit of the workspace": [reason for case in study.cases for reason in case.left_out],
        "People without any trial left": [
            f"{case.truth.name} in {case.condition.name}" for case in study.cases if case.identification is None
        ],
        "Fits that did not converge": those(lambda row: "" if row["converged"] else row["status"]),
        "Fits with a parameter at its bound": those(lambda row: row["at_bound"]),
        "Fits whose starts ended in different minima": those(
            lambda row: (
                f"{row['n_starts_agree']} of {row['n_starts']} in the best"
                if row["n_starts_agree"] < row["n_starts"]
                else ""
            )
        ),
        "Fits that are unstable on the manipulator, and so have no VAF": those(
            lambda row: "" if row["stable"] else f"largest real part of a pole {row['largest_real_pole_per_s']:.3g} 1/s"
        ),
    }


def _mean(values: Any) -> float:
    """Mean of the values that exist; NaN if none does."""
    there = [value for value in values if value is not None]
    return float(np.mean(there)) if there else math.nan


def _draw(study: StudyResult, folder: Path) -> tuple[dict[str, Picture], dict[str, str]]:
    """Draw every figure that the study allows into a folder; pictures by name, and why another is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    drawings: dict[str, Callable[[], Figure]] = {}
    present = {condition: study.of(condition.name) for condition in CONDITIONS if study.of(condition.name)}
    if present:
        drawings["perturbation"] = partial(figures.perturbation, next(iter(present.values()))[0])
        drawings["admittance_by_task"] = partial(figures.admittance_by_task, study)
        drawings["coherence"] = partial(figures.coherence, study)
    for condition, (first, *_) in present.items():
        drawings[f"admittance_{condition.name}"] = partial(figures.admittance_of_trials, first)
        drawings[f"fit_{condition.name}"] = partial(figures.fit, first)
        drawings[f"prediction_{condition.name}"] = partial(figures.prediction, first)
        drawings[f"parameters_{condition.name}"] = partial(figures.parameters, study, condition)
    pictures, not_drawn = {name: _embed(draw(), folder / f"{name}.svg") for name, draw in drawings.items()}, {}
    try:
        pictures["rig"] = _embed(figures.rig(study), folder / "rig.svg")
    except RuntimeError as error:
        not_drawn["rig"] = str(error)
    return pictures, not_drawn


def _embed(figure: Figure, path: Path) -> Picture:
    """Write a figure to a file, and return what the report shows of it."""
    save_svg(figure, path)
    content = base64.b64encode(path.read_bytes()).decode("ascii")
    width, height = figure.get_size_inches()
    return Picture(f"data:image/svg+xml;base64,{content}", float(width), float(height))


def _page(
    study: StudyResult, sections: tuple[Section, ...], pictures: dict[str, Picture], not_drawn: dict[str, str]
) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("armperturb.study"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(digits=digits, fixed=fixed, mean_sd=mean_sd, symbol=symbol)
    environment.globals.update(
        study=study,
        conditions=CONDITIONS,
        present=[condition for condition in CONDITIONS if study.of(condition.name)],
        pictures=pictures,
        not_drawn=not_drawn,
        multisine={"period": PERIOD, "lines": CLUSTERS.size, "clusters": len(CLUSTERS)},
        pulse={"unit": PULSE_UNIT, "tail": TAIL, "directions": PULSE_DIRECTIONS_DEG},
        published_task_effect=PUBLISHED_TASK_EFFECT,
        versions={name: metadata.version(name) for name in ("armperturb", "mujoco", "numpy", "scipy")},
    )
    # Sections come out as markup, escaped already.
    bodies = [
        (section, Markup(environment.get_template(f"{section.template}.html").render(section.context)))
        for section in sections
    ]
    return environment.get_template("report.html").render(sections=bodies)


def digits(value: float | None, n: int = 3) -> str:
    """A number with n significant digits, never in powers of ten; a dash if there is none."""
    if value is None or not math.isfinite(value):
        return MISSING
    decimals = _decimals(value, n)
    return fixed(round(value, decimals), max(decimals, 0))


def fixed(value: float | None, decimals: int) -> str:
    """A number with so many decimals; a dash if there is none."""
    if value is None or not math.isfinite(value):
        return MISSING
    return f"{value:.{decimals}f}".replace("-", "−")


def mean_sd(mean: float, sd: float) -> str:
    """Mean and standard deviation, both to the second digit of the latter; the mean alone if there is no spread."""
    if not math.isfinite(sd) or sd <= 1e-9 * abs(mean):
        return digits(mean)
    decimals = max(0, _decimals(sd, 2))
    return f"{fixed(mean, decimals)} ± {fixed(sd, decimals)}"


def _decimals(value: float, n: int) -> int:
    """Decimals that show n significant digits; negative where digits before the point are to be rounded."""
    # The exponent after rounding: 99.96 has three digits before the point.
    return n - 1 - int(f"{value:.{n - 1}e}".partition("e")[2])


def symbol(parameter: str) -> Markup:
    """A parameter as its symbol, e.g. kv_se as k with the subscript v,se."""
    quantity, _, place = parameter.partition("_")
    subscript = ",".join(filter(None, (quantity[1:], place)))
    return Markup("<i>{}</i><sub>{}</sub>").format(quantity[0], subscript)
