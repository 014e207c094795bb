"""The report of a study: tables, figures, and one HTML file that holds everything and opens offline."""

import base64
import hashlib
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import jinja2
from markupsafe import Markup
from matplotlib.figure import Figure
from tqdm import tqdm

from armperturb.analysis.export import write_csv
from armperturb.files import written_whole
from armperturb.perturbations.multisine import CLUSTERS, PERIOD
from armperturb.study import formats
from armperturb.study.admittance import by_task, main_conditions
from armperturb.study.archive import code_digest, recalled
from armperturb.study.drawings import drawings
from armperturb.study.effects import effects
from armperturb.study.results import ANALYSIS, StudyResult
from armperturb.study.score import Score, score, write_score
from armperturb.study.sections import Section, joint_rows, sections
from armperturb.study.shoulder import MovingShoulder, moving_shoulder
from armperturb.study.style import save_svg
from armperturb.study.tables import write_tables
from armperturb.study.yielding import Yielding, first_person, why_people_yield

SCORE = "score"


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


def write_report(study: StudyResult, out: Path, *, show_progress: bool = True) -> Path:
    """Write `tables/*.csv`, `score/`, `figures/*.svg` and `report.html`, which needs none of them nor a network.

    Some more trials of the first person are simulated, to show what the muscle law does, and what a shoulder that
    moves; they are kept in the folder, as results are. Without a GL library, pictures of the rig are left out and the
    report says so.

    Args:
      study: the analysed study; its recordings must still be there.
      out: folder, which is made if needed.
      show_progress: whether to draw a progress bar on the terminal.

    Returns:
      The path of the report.

    Raises:
      OSError: the folder cannot be written to, or a recording is gone.
    """
    rows = write_tables(study, out / "tables")
    tested = effects(study)
    for name, lines in (("statistics", tested.rows), ("statistics_pairs", tested.pairs)):
        if lines:
            write_csv(list(lines), out / "tables" / f"{name}.csv")
    scored = _score(study, out)
    yielding = _yielding(study, out)
    if yielding is not None:
        write_csv(yielding.rows(), out / "tables" / "yielding.csv")
    shoulder = _shoulder(study, out)
    if shoulder is not None:
        write_csv(shoulder.table(), out / "tables" / "moving_shoulder.csv")
    if scored is not None:
        write_csv(joint_rows(study), out / "tables" / "joints.csv")
    pictures, not_drawn = _draw(drawings(study, tested, yielding), out / "figures", show_progress)
    page = _page(study, sections(study, scored, tested, rows, yielding, shoulder), pictures, not_drawn)
    report = out / "report.html"
    with written_whole(report) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return report


def _score(study: StudyResult, out: Path) -> Score | None:
    """Beside the published tables, written; None if no condition of theirs was recorded."""
    if not any(person.cells for person in study.people):
        return None
    scored = score(study)
    write_score(scored, out / SCORE)
    return scored


def _yielding(study: StudyResult, out: Path) -> Yielding | None:
    """What the muscle law of the first person does; None if there is none."""
    person = first_person(study)
    if person is None:
        return None
    return recalled(
        out / ANALYSIS / "yielding.json.gz",
        _key(study),
        lambda: why_people_yield(person, study.environment, seed=study.seed),
    )


def _shoulder(study: StudyResult, out: Path) -> MovingShoulder | None:
    """What it does to the kinematics if the first person's shoulder moves; None if nobody was simulated."""
    if not study.cohort:
        return None
    return recalled(
        out / ANALYSIS / "moving-shoulder.json.gz",
        _key(study),
        lambda: moving_shoulder(study.cohort[0], environment=study.environment, seed=study.seed),
    )


def _key(study: StudyResult) -> str:
    """What simulations of the first person depend on."""
    what = f"{study.cohort[0]!r} {study.environment!r} {study.seed} {code_digest()}"
    return hashlib.sha256(what.encode()).hexdigest()


def _draw(
    figures: Mapping[str, Callable[[], Figure]], folder: Path, show_progress: bool
) -> tuple[dict[str, Picture], dict[str, str]]:
    """Draw figures into a folder; pictures by name, and why another is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures, not_drawn = {}, {}
    for name, draw in tqdm(figures.items(), desc="draw", unit="figure", disable=None if show_progress else True):
        try:
            pictures[name] = _embed(draw(), folder / f"{name}.svg")
        except RuntimeError as error:  # this machine cannot draw the rig
            not_drawn[name] = str(error)
    return pictures, not_drawn


def _embed(figure: Figure, path: Path) -> Picture:
    """Write a figure to a file, and return what the report shows of it."""
    save_svg(figure, path)
    content = base64.b64encode(path.read_bytes()).decode("ascii")
    width, height = figure.get_size_inches()
    return Picture(f"data:image/svg+xml;base64,{content}", float(width), float(height))


def _page(study: StudyResult, parts: Sequence[Section], pictures: dict[str, Picture], not_drawn: dict[str, str]) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("armperturb.study"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for name in ("chance", "digits", "fixed", "mean_sd", "signed", "symbol"):
        environment.filters[name] = getattr(formats, name)
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
        for section in parts
    ]
    return environment.get_template("report.html").render(sections=bodies)
