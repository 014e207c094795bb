"""Writes the live laboratory: one offline HTML file with the arm in JavaScript, and people to begin with."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from armperturb.cohort import average_person, draw_cohort
from armperturb.controllers.lanes import elastic_limit_shape
from armperturb.environment import TIMESTEP, Environment
from armperturb.files import write_whole
from armperturb.pages.page import versions
from armperturb.perturbations.multisine import Multisine
from armperturb.planar_arm.lanes import require_lane
from armperturb.subject import POSITION, RELAX, Subject, at_level

PEOPLE = 10
"""Number of people of seed 0 to begin with, those of a study."""

SEED = 0
"""Of these people, and of the multisine."""

TASK_NAMES = {"PT": "holding", "RT": "relaxing"}

NO_FEEDBACK_OF = ("ka_s", "ka_se", "ka_e", "kf_s", "kf_se", "kf_e")
"""Gains that the laboratory does not have."""


def arm_values(subject: Subject) -> dict[str, Any]:
    """What the JavaScript arm needs of a subject, by name; an infinite value is None.

    Raises:
      ValueError: the arm has acceleration or force feedback, or what no simulation has, e.g. a delay below three steps.
    """
    require_lane(subject, TIMESTEP)
    gains = [name for name in NO_FEEDBACK_OF if getattr(subject, name) != 0.0]
    if gains:
        raise ValueError(
            f"subject {subject.name!r}: {gains[0]} = {getattr(subject, gains[0]):g}; expected 0 in the live "
            "laboratory, whose reflexes have velocity and position feedback (models 1, 2, 3, 3a and 3b)"
        )
    values = {name: value for name, value in asdict(subject).items() if name not in NO_FEEDBACK_OF}
    if subject.muscle is not None:
        law = values["muscle"]
        spreads = law.pop("elastic_limit_spread")
        law["shape"] = [elastic_limit_shape(spread, law["parts"]).tolist() for spread in spreads]
        values["muscle"] = {name: _finite(value) for name, value in law.items()}
    return values


def _finite(value: Any) -> Any:
    """A number, or numbers in tuples and lists; None where it is infinite, which JSON has no word for."""
    if isinstance(value, tuple | list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and math.isinf(value) else value


def presets(arms: Mapping[str, Subject]) -> dict[str, dict[str, Any]]:
    """Name to the values of an arm: the given ones, the average person at each level, and those of a study.

    Args:
      arms: name to an arm to begin with.
    """
    average = average_person()
    known = dict(arms)
    for task in ("PT", "RT"):
        known[f"average person, {TASK_NAMES[task]}"] = average.subjects[task]
    for condition, level in average.levels.items():
        known[f"average person, holding as in {condition}"] = at_level(average.subjects["PT"], level)
    known |= {"linear muscle, holding": POSITION, "linear muscle, relaxing": RELAX}
    for task in ("PT", "RT"):
        for person in draw_cohort(PEOPLE, SEED, Environment()):
            known[f"{person.name}, {TASK_NAMES[task]}"] = person.subjects[task]
    return {name: arm_values(subject) for name, subject in known.items()}


def live_page(arms: Mapping[str, Subject]) -> str:
    """The page.

    Args:
      arms: name to an arm to begin with, beside those that are always there.

    Raises:
      ValueError: the laboratory cannot have one of the arms.
    """
    multisine = Multisine.draw(seed=SEED, rms=1.0)
    data = {
        "presets": presets(arms),
        "load": asdict(Environment()),
        "multisine": {
            "frequencies": multisine.frequencies.tolist(),
            "amplitudes": multisine.amplitudes.tolist(),
            "phases": multisine.phases.tolist(),
        },
    }
    # Inside a script element, no text may look like its end.
    content = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    folder, of_pages = (resources.files(package) / "templates" for package in (__package__, "armperturb.pages"))
    files = (
        *(of_pages / name for name in ("drawing.js", "playing.js")),
        *(folder / name for name in ("live.css", "eigenvalues.js", "model.js", "live.js")),
    )
    parts = {file.name.replace(".", "_"): Markup(file.read_text(encoding="utf-8")) for file in files}
    template = (folder / "live.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    return environment.from_string(template).render(**parts, data=Markup(content), versions=versions("armperturb"))


def write_live(path: str | Path, arms: Mapping[str, Subject] | None = None) -> None:
    """Write the page.

    Args:
      path: of the page.
      arms: as in `live_page`.

    Raises:
      ValueError: the laboratory cannot have one of the arms.
      OSError: the folder cannot be written to.
    """
    content = live_page(arms or {})
    write_whole(path, content)
