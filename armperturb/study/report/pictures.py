"""Figures of the report as pictures inside it, each drawn once: it is drawn anew when what it shows changes.

A picture depends on the arguments with which its figure is drawn, on the recordings that these name, and on all code of
this package and the versions of the libraries that draw. Unlike fits, figures take little time, so that one too many
costs less than one that is out of date.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

import xarray as xr
from matplotlib.figure import Figure

import armperturb
from armperturb.archive import digest
from armperturb.pages.page import Picture
from armperturb.plots.style import in_style
from armperturb.study.recording.folder import ANALYSIS
from armperturb.study.results.cache import CachedResult, Unit
from armperturb.study.results.cases import Case
from armperturb.study.results.study_result import StudyResult

LIBRARIES = ("matplotlib", "mujoco", "numpy", "scipy")


def picture_units(
    drawings: Mapping[str, "partial[Figure]"], checksums: Mapping[str, str], out: Path
) -> list[Unit[Picture]]:
    """What draws each figure, if it is not kept; it gives the reason instead if this machine cannot draw the rig.

    Args:
      drawings: figures by name, see `figures.catalogue`.
      checksums: file name of each recording to its checksum.
      out: the study folder.
    """
    arguments = {id(argument): argument for draw in drawings.values() for argument in draw.args}
    digests = {key: digest(_shown(argument)) for key, argument in arguments.items()}
    units = []
    for name, draw in drawings.items():
        read = [argument.recording for argument in draw.args if isinstance(argument, Case)]
        cached = CachedResult(
            path=out / ANALYSIS / f"figure-{name}.json.gz",
            kind="figure",
            result=Picture,
            recordings={path.name: checksums[path.name] for path in read},
            settings={"arguments": [digests[id(argument)] for argument in draw.args], "program": program()},
        )
        units.append(Unit(cached=cached, run=partial(_picture, draw)))
    return units


@in_style()
def _picture(draw: Callable[[], Figure]) -> Picture | str:
    try:
        figure = draw()
    except RuntimeError as error:  # this machine cannot draw the rig
        return str(error)
    return Picture.of(figure)


def _shown(argument: Any) -> Any:
    """An argument as an archive can hold it, without the place of the study folder, which may be moved."""
    match argument:
        case StudyResult():
            return replace(argument, recordings={}, cases=tuple(map(_shown, argument.cases)))
        case Case():
            return replace(argument, recording=Path(argument.recording.name))
        case xr.Dataset():
            return argument.to_dict(data="array")
        case list():
            return [*map(_shown, argument)]
    return argument


@cache
def program() -> str:
    """Checksum of the files of this package, and of the versions of the libraries that draw."""
    root = Path(armperturb.__file__).parent
    files = sorted(path for path in root.rglob("*.*") if "__pycache__" not in path.parts)
    checksum = hashlib.sha256("".join(map(metadata.version, LIBRARIES)).encode())
    for path in files:
        checksum.update(f"{path.relative_to(root)} {path.stat().st_size} ".encode() + path.read_bytes())
    return checksum.hexdigest()
