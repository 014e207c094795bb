"""The report of a study: tables, figures, and one HTML file that holds everything and opens offline."""

import base64
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
from markupsafe import Markup
from matplotlib.figure import Figure

from armperturb.analysis.export import write_csv
from armperturb.analysis.maximum_likelihood import SUSPICIOUS
from armperturb.files import written_whole
from armperturb.perturbations.multisine import CLUSTERS, PERIOD
from armperturb.study import figures, yielding_figures
from armperturb.study.admittance import by_task, main_conditions
from armperturb.study.protocol import Condition
from armperturb.study.results import StudyResult
from armperturb.study.style import save_svg
from armperturb.study.tables import Row, write_tables
from armperturb.study.yielding import PULSES, Yielding, first_person, why_people_yield

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

    If the first person has a muscle law, some more trials are simulated to show what it does.

    Without a GL library, the picture of the rig is left out and the report says so.

    Args:
      study: the finished study; its recordings must still be there.
      out: folder, which is made if needed.

    Returns:
      The path of the report.

    Raises:
      OSError: the folder cannot be written to, or a recording is gone.
    """
    rows = write_tables(study, out / "tables")
    pictures, not_drawn = _draw(study, out / "figures")
    sections = [
        Section(
            title="Summary", template="summary", context={"rows": rows["summary"], "task_effect": rows["task_effect"]}
        ),
        Section(title="Method", template="method", context={}),
        Section(
            title="Conditions", template="conditions", context={"rows": rows["conditions"], "drifting": drifting(study)}
        ),
        Section(title="Admittance", template="admittance", context={}),
        Section(title="Fits", template="fits", context={"rows": rows["fits"], "remarks": remarks(study)}),
        Section(title="Parameters", template="parameters", context={"rows": rows["parameters_summary"]}),
        Section(title="What was left out", template="left_out", context={"lists": left_out(study, rows["fits"])}),
    ]
    if person := first_person(study):
        yielding = why_people_yield(person, study.environment, seed=study.seed)
        pictures |= _draw_yielding(yielding, out / "figures")
        write_csv(yielding.rows(), out / "tables" / "yielding.csv")
        sections.insert(-1, _yielding_section(yielding))
    page = _page(study, sections, pictures, not_drawn)
    report = out / "report.html"
    with written_whole(report) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return report


def drifting(study: StudyResult) -> list[Condition]:
    """Conditions in which people shall move further, or less far, in the experiment than in practice."""
    return [c for c in study.protocol.conditions if c.has_multisine and (c.reached != 1.0 or c.reached_spread)]


def left_out(study: StudyResult, fits: list[Row]) -> dict[str, list[str]]:
    """What no table shows, or what a reader should not trust: heading to one line each."""

    def those(says: Callable[[Row], str]) -> list[str]:
        return [f"{row['subject']} in {row['condition']}: {says(row)}" for row in fits if says(row)]

    return {
        "Trials and people that were left out": [reason for case in study.cases for reason in case.left_out],
        "Fits that did not converge": those(lambda row: "" if row["converged"] else row["status"]),
        "Fits with a parameter at its bound": those(lambda row: row["at_bound"]),
        "Fits whose trials say that the model is wrong, or the person not linear": those(
            lambda row: (
                f"chi2 / dof {row['chi2'] / row['dof']:.2f}, p = {row['p_value']:.1g}"
                if row["p_value"] < SUSPICIOUS
                else ""
            )
        ),
        "Fits that are unstable on the manipulator, and so have no VAF": those(
            lambda row: "" if row["stable"] else f"largest real part of a pole {row['largest_real_pole_per_s']:.3g} 1/s"
        ),
    }


def remarks(study: StudyResult) -> dict[str, dict[str, list[str]]]:
    """Condition to person to what to know before trusting their estimates, the thesis's estimator's last."""
    said: dict[str, dict[str, list[str]]] = {}
    for case in study.cases:
        if case.identification is not None:
            lines = list(case.identified.fit.remarks)
            lines += [f"thesis's estimator: {line}" for line in (case.thesis.fit.remarks if case.thesis else ())]
            if lines:
                said.setdefault(case.condition.name, {})[case.name] = lines
    return {condition.name: said[condition.name] for condition in study.conditions if condition.name in said}


def _draw(study: StudyResult, folder: Path) -> tuple[dict[str, Picture], dict[str, str]]:
    """Draw every figure that the study allows into a folder; pictures by name, and why another is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    drawings: dict[str, Callable[[], Figure]] = {}
    main = {task: study.of(condition.name)[0] for task, condition in main_conditions(study).items()}
    if main:
        drawings["perturbation"] = partial(figures.perturbation, next(iter(main.values())))
        drawings["admittance_by_task"] = partial(figures.admittance_by_task, study)
        drawings["coherence"] = partial(figures.coherence, study)
    for task, first in main.items():
        if len(by_task(study)[task]) > 1:
            drawings[f"admittance_by_amplitude_{task}"] = partial(figures.admittance_by_amplitude, study, task)
        drawings[f"admittance_{task}"] = partial(figures.admittance_of_trials, first)
        drawings[f"fit_{task}"] = partial(figures.fit, first)
        drawings[f"prediction_{task}"] = partial(figures.prediction, first)
        if study.has_truth:
            drawings[f"parameters_{task}"] = partial(figures.parameters, study, task)
    pictures, not_drawn = {name: _embed(draw(), folder / f"{name}.svg") for name, draw in drawings.items()}, {}
    try:
        pictures["rig"] = _embed(figures.rig(study), folder / "rig.svg")
    except RuntimeError as error:
        not_drawn["rig"] = str(error)
    return pictures, not_drawn


def _draw_yielding(yielding: Yielding, folder: Path) -> dict[str, Picture]:
    drawings = {
        "yielding_loops": yielding_figures.loops,
        "yielding_admittance": yielding_figures.admittance,
        "yielding_pulses": yielding_figures.pulses,
    }
    return {name: _embed(draw(yielding), folder / f"{name}.svg") for name, draw in drawings.items()}


def _yielding_section(yielding: Yielding) -> Section:
    return Section(
        title="Why people yield",
        template="yielding",
        context={"person": yielding.person, "rows": yielding.rows(), "pulses": PULSES, "unstable": yielding.unstable},
    )


def _embed(figure: Figure, path: Path) -> Picture:
    """Write a figure to a file, and return what the report shows of it."""
    save_svg(figure, path)
    content = base64.b64encode(path.read_bytes()).decode("ascii")
    width, height = figure.get_size_inches()
    return Picture(f"data:image/svg+xml;base64,{content}", float(width), float(height))


def _page(
    study: StudyResult, sections: Sequence[Section], pictures: dict[str, Picture], not_drawn: dict[str, str]
) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("armperturb.study"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(chance=chance, digits=digits, fixed=fixed, mean_sd=mean_sd, symbol=symbol)
    environment.globals.update(
        study=study,
        main={task: study.of(condition.name)[0] for task, condition in main_conditions(study).items()},
        tasks=by_task(study),
        pictures=pictures,
        not_drawn=not_drawn,
        multisine={"period": PERIOD, "lines": CLUSTERS.size, "clusters": len(CLUSTERS)},
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


def chance(p_value: float) -> str:
    """A p value; what is small is said to be."""
    return "< 0.001" if p_value < 1e-3 else fixed(p_value, 3)


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
