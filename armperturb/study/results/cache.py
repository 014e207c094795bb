"""Results that are kept in the study folder, each with the recordings, settings and algorithm that it was made from.

| file | |
|---|---|
| `analysis/NAME.json.gz` | what a person's recording tells |
| `analysis/NAME-step-2.json.gz` | step 2 of appendix C, which depends on everybody's recordings |
| `analysis/NAME-nonlinear-TASK.json.gz` | a nonlinear fit, if one was asked for; `-20`: also to pulses at 20° |
| `analysis/NAME-nonlinear-TASK.checkpoint.gz` | a nonlinear fit under way, from which an interrupted search continues |
| `analysis/mechanisms.json.gz`, `analysis/moving-shoulder.json.gz` | further simulations of the first person |
| `analysis/NAME-emg.json.gz` | what a person's EMG tells |
| `analysis/figure-NAME.json.gz` | a figure of the report |
| `analysis/films.json.gz` | films of pulses in the report |
| `analysis/played-NAME.json.gz` | trials of a person that the report plays |

A result is used again as long as its source agrees: the checksums of the recordings, the settings, and the version of
the algorithm; and the file is the user's own, unchanged (see `armperturb.archive`). Other changes of the code have no
effect on it.
"""

import json
import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from armperturb.archive import read_archive, write_archive
from armperturb.progress import Progress
from armperturb.study.protocol.differences import differences
from armperturb.study.recording.folder import ANALYSIS, require_own_results
from armperturb.workers import Workers, completed

LOG = logging.getLogger(__name__)

Result = TypeVar("Result")

VERSIONS = {
    "person": 11,
    "step-2": 9,
    "nonlinear": 8,
    "mechanisms": 1,
    "moving-shoulder": 2,
    "figure": 2,
    "played": 2,
    "films": 1,
    "emg": 14,
}
"""Kind of result to the version of its algorithm.

Raise a number in the commit that makes earlier results of that kind wrong or unreadable: when their values change by
more than rounding, when a field changes its meaning, or when a class that they hold gains, loses or renames a field or
moves to another module. "step-2" follows from "person": raise both. Do not raise a number for faster code, texts or
figures: everybody's results would be computed anew, which takes minutes per person for "nonlinear". Figures, which are
quick to draw, depend on the whole code of the package besides (`report.pictures`).
"""


_RECALLED: ContextVar[list[Path] | None] = ContextVar("recalled", default=None)


@contextmanager
def recalled_results() -> Iterator[list[Path]]:
    """Within the block, the list that is given grows by each kept result that is used again."""
    recalled: list[Path] = []
    token = _RECALLED.set(recalled)
    try:
        yield recalled
    finally:
        _RECALLED.reset(token)


def recalled_numbers() -> list[str]:
    """Names of the kept results that were used again so far within `recalled_results`, without figures and films."""
    names = (path.name.removesuffix(".json.gz") for path in _RECALLED.get() or ())
    return sorted(name for name in names if not name.startswith(("figure-", "films")))


def forget_results(root: Path, nonlinear: Collection[str] = ()) -> None:
    """Remove what a study folder has kept, so that it is computed anew; nonlinear fits only of the tasks named.

    Raises:
      ValueError: as `require_own_results`.
      OSError: a file cannot be removed.
    """
    require_own_results(root)
    for path in (root / ANALYSIS).glob("*.json.gz"):
        if "-nonlinear-" not in path.name or any(f"-nonlinear-{task}" in path.name for task in nonlinear):
            path.unlink()


class StaleResult(Exception):
    """A kept result that must not be used; the message says why."""


@dataclass(frozen=True, kw_only=True)
class CachedResult(Generic[Result]):
    """A result in the study folder, which may be there or not.

    Attributes:
      path: of the file.
      kind: key of `VERSIONS`.
      result: class of the value.
      recordings: name of each recording that it depends on to its checksum.
      settings: everything else that it depends on, as JSON has it.
    """

    path: Path
    kind: str
    result: type[Result]
    recordings: Mapping[str, str] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def source(self) -> dict[str, Any]:
        """What the result is made from, as JSON has it."""
        source = {
            "kind": self.kind,
            "version": VERSIONS[self.kind],
            "recordings": dict(self.recordings),
            "settings": dict(self.settings),
        }
        return json.loads(json.dumps(source))

    def read(self) -> Result | None:
        """The value; None if the file is not there.

        Raises:
          StaleResult: it was made from something else, or cannot be read.
        """
        try:
            archive = read_archive(self.path)
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise StaleResult(f"it cannot be read ({str(error).removeprefix(f'{self.path}: ')})") from None
        if archive.source != self.source:
            raise StaleResult(self._difference(archive.source))
        if not isinstance(archive.value, self.result):
            raise StaleResult(f"it holds a {type(archive.value).__name__}, not a {self.result.__name__}")
        return archive.value

    def write(self, value: Result) -> None:
        """Keep a value; a folder that cannot be written to is only warned of."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_archive(self.path, self.source, value)
        except OSError as error:
            reason = error.strerror or error
            LOG.warning("%s cannot be written (%s): it will be computed again next time", self.path, reason)

    def _difference(self, source: Any) -> str:
        now = self.source
        if not isinstance(source, dict) or source.keys() != now.keys() or source["kind"] != now["kind"]:
            return "it does not say what it was made from"
        if source["version"] != now["version"]:
            return f"it was made by version {source['version']} of the algorithm, which is now at {now['version']}"
        if source["recordings"] != now["recordings"]:
            then = source["recordings"] if isinstance(source["recordings"], dict) else {}
            names = [name for name in now["recordings"] if then.get(name) != now["recordings"][name]]
            return f"the recording has changed since ({', '.join(names or then)})"
        different = map(str, differences(source["settings"], now["settings"]))
        return f"it was made with other settings: {'; '.join(different)}"


@dataclass(frozen=True, kw_only=True)
class Unit(Generic[Result]):
    """A result that is computed if none is kept.

    Attributes:
      cached: where it is kept.
      run: computes the result, here or in a worker; or something else, which is not kept.
    """

    cached: CachedResult[Result]
    run: Callable[[], Any]


def kept_or_computed(units: Sequence[Unit[Any]], pool: Workers | None, bar: Progress, *, steps: int = 1) -> list[Any]:
    """The result of each unit, in their order: as it was kept, or computed now.

    Args:
      units: of any kinds.
      pool: who computes; None for this process.
      bar: counts the units.
      steps: of the bar that each takes.

    Raises:
      RuntimeError: workers die again and again.
    """
    results, _ = reusable([unit.cached for unit in units])
    bar.skip(steps * len(results))
    missing = [unit for unit in units if unit.cached.path not in results]
    for number, result in computed(missing, pool, bar, steps=steps):
        results[missing[number].cached.path] = result
    return [results[unit.cached.path] for unit in units]


def reusable(files: Iterable[CachedResult[Any]]) -> tuple[dict[Path, Any], dict[Path, str]]:
    """File to value of the results that can be used again, and file to why not of those that are stale."""
    values, stale = dict[Path, Any](), dict[Path, str]()
    for cached in files:
        try:
            value = cached.read()
            if value is not None:
                values[cached.path] = value
                if (recalled := _RECALLED.get()) is not None:
                    recalled.append(cached.path)
        except StaleResult as error:
            stale[cached.path] = str(error)
    return values, stale


def computed(units: Sequence[Any], pool: Workers | None, bar: Progress, *, steps: int = 1) -> Iterator[tuple[int, Any]]:
    """Number and result of each unit, as they are finished and kept; arguments as of `kept_or_computed`."""
    work = list(enumerate(units))
    for number, result in map(_run, work) if pool is None else completed(_run, work, pool, bar.refresh):
        cached = units[number].cached
        if isinstance(result, cached.result):
            cached.write(result)
        bar.update(steps)
        yield number, result


def _run(work: tuple[int, Any]) -> tuple[int, Any]:
    number, unit = work
    return number, unit.run()
