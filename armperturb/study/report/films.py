"""Films of recorded pulses inside the report, where this machine can draw and encode them."""

import base64
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import xarray as xr

from armperturb.envs.render.clip import Clip
from armperturb.envs.render.replay import Replay
from armperturb.envs.render.video import write_video
from armperturb.study.recording.folder import ANALYSIS
from armperturb.study.report.pictures import program
from armperturb.study.results.cache import CachedResult, Unit

SIZE = (320, 240)
"""Width and height of the picture from above [pixel]; the strip chart below adds half the height."""

MOST_BYTES = 300_000
"""Of a film: larger ones are left out."""

LEAD = 0.1
"""Time before the pulse at which a film starts [s]."""


class Shown(NamedTuple):
    """How the film of a task goes.

    Attributes:
      slow: how many times slower than real time.
      after: time after the onset at which it ends [s].
    """

    slow: float
    after: float


SHOWN = {"PT": Shown(3.0, 0.4), "RT": Shown(2.0, 1.1)}
"""Task to how its film goes."""


class Film(NamedTuple):
    """A film of a trial.

    Attributes:
      task: of the person.
      condition: of the protocol.
      subject: whose arm moves.
      direction_deg: of the pulse, from the x axis.
      slow: how many times slower than real time.
      content: MP4 (H.264), base64.
    """

    task: str
    condition: str
    subject: str
    direction_deg: float
    slow: float
    content: str

    @property
    def uri(self) -> str:
        """The film itself, as a data URI."""
        return f"data:video/mp4;base64,{self.content}"


class Films(NamedTuple):
    """Those of a report."""

    films: tuple[Film, ...]


def film_units(pulses: Sequence[xr.Dataset], checksums: Mapping[str, str], out: Path) -> list[Unit[Films]]:
    """What makes the films, if they are not kept; it gives the reason instead if this machine cannot.

    Args:
      pulses: single trials with a pulse and with joint angles; no unit without any.
      checksums: name of the file that they come from to its checksum.
      out: the study folder.
    """
    if not pulses:
        return []
    cached = CachedResult(
        path=out / ANALYSIS / "films.json.gz",
        kind="films",
        result=Films,
        recordings=checksums,
        settings={"conditions": [str(trial["condition"].values[0]) for trial in pulses], "program": program()},
    )
    return [Unit(cached=cached, run=partial(_films, pulses))]


def _films(pulses: Sequence[xr.Dataset]) -> Films | str:
    try:
        made = tuple(map(film, pulses))
    except (ModuleNotFoundError, RuntimeError, OSError) as error:  # no encoder, or no OpenGL
        return str(error)
    return Films(tuple(each for each in made if len(base64.b64decode(each.content)) < MOST_BYTES))


def film(pulse: xr.Dataset) -> Film:
    """The film of a pulse from above, slower than it was.

    Args:
      pulse: a single trial with a pulse.

    Raises:
      ModuleNotFoundError: the encoder is not installed; the message names the extra.
      ValueError: the trial does not say what the arm looks like.
      RuntimeError: this machine cannot draw; the message names what to install.
      OSError: the encoder failed.
    """
    names = {name: str(pulse[name].values[0]) for name in ("task", "condition", "subject")}
    onset, shown = float(pulse["pulse_onset"].values[0]), SHOWN[names["task"]]
    replay = Replay.of_trial(pulse, 0)
    stop = min(onset + shown.after, replay.end)
    clip = Clip(view="top", size=SIZE, slow=shown.slow, start=max(0.0, onset - LEAD), stop=stop)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        write_video(replay, path, clip)
        content = base64.b64encode(path.read_bytes()).decode("ascii")
    return Film(**names, direction_deg=float(pulse["pulse_direction"].values[0]), slow=shown.slow, content=content)
