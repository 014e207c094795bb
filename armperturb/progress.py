"""How far long work is: a bar on a terminal, and elsewhere a line now and then, with the time that is left."""

import contextvars
import io
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

INTERVAL = 30.0
"""Time from a line to the next [s]."""


class _Whole:
    """Work of several stages.

    Attributes:
      shares: stage to its usual share of the time, in any unit.
      interval: time from a line to the next, also from one stage's last line to the first of another [s].
      due: when the next line is due, on the monotonic clock [s].
    """

    def __init__(self, shares: Mapping[str, float], interval: float) -> None:
        self.shares, self.interval = shares, interval
        self.due = time.monotonic() + interval
        self._seconds = self._done = 0.0  # spent on stages that have ended, and the shares that took them

    def left(self, stage: str, seconds: float, of_stage: float | None, part: float) -> float | None:
        """Time left of all stages [s]; None if it cannot be known yet.

        Args:
          stage: the one at work; those before it have ended, or had nothing to do.
          seconds: how long it has worked [s].
          of_stage: time left of it [s], if known.
          part: of the stage that was not done before; what was tells nothing of the pace [-].
        """
        share, names = part * self.shares.get(stage, 1.0), list(self.shares)
        later = sum(self.shares[name] for name in names[names.index(stage) + 1 :]) if stage in names else 0.0
        if of_stage is None:
            if not self._done:
                return None
            of_stage = share * self._seconds / self._done
        if not later:
            return of_stage
        spent, worked = self._seconds + (seconds + of_stage if share else 0.0), self._done + share
        return of_stage + spent / worked * later if worked else None

    def end(self, stage: str, seconds: float, part: float) -> None:
        """A stage has ended, after so many seconds; arguments as of `left`."""
        if part:
            self._seconds, self._done = self._seconds + seconds, self._done + part * self.shares.get(stage, 1.0)


_WHOLE: contextvars.ContextVar[_Whole | None] = contextvars.ContextVar("whole", default=None)


@contextmanager
def stages(shares: Mapping[str, float], interval: float = INTERVAL) -> Iterator[None]:
    """Count the stages of work in this block as one whole, so that lines tell the time left of all of them.

    Args:
      shares: label of each stage, in order, to its usual share of the time, in any unit.
      interval: time from a line to the next [s].
    """
    token = _WHOLE.set(_Whole(shares, interval))
    try:
        yield
    finally:
        _WHOLE.reset(token)


class Progress(tqdm):
    """A stage of long work; `update` counts what is done.

    Args:
      label: of the stage; see `stages`.
      total: how much there is to do.
      unit: of what is counted, in the plural.
      initial: how much was done before.
      show: whether to show it at all.
      **options: of tqdm, for the bar.
    """

    def __init__(
        self, label: str, *, total: float, unit: str, initial: float = 0, show: bool = True, **options: Any
    ) -> None:
        self._label, self._initial, self._start = label, initial, time.monotonic()
        self._first: tuple[float, float] | None = None
        self._whole = _WHOLE.get() or _Whole({label: 1.0}, INTERVAL)
        self._is_closed = threading.Event()
        in_lines = show and not sys.stderr.isatty()
        file = io.StringIO() if in_lines else None
        super().__init__(desc=label, total=total, unit=unit, initial=initial, disable=not show, file=file, **options)
        if in_lines:
            threading.Thread(target=self._report, daemon=True).start()

    def skip(self, number: float) -> None:
        """So many were done before: they count as done, and tell nothing of the pace."""
        self._initial += number
        self.update(number)

    def line(self) -> str:
        """What a log says of it."""
        left = self._whole.left(self._label, time.monotonic() - self._start, self._left(), self._part())
        share = self.n / self.total if self.total else 1.0
        return (
            f"{self._label}: {share:.0%} ({self.n:.0f} of {self.total or 0:.0f} {self.unit}), "
            f"{'time left unknown yet' if left is None else f'{in_words(left)} left of the whole'}"
        )

    def _part(self) -> float:
        """Which part of the stage was not done before [-]."""
        return 1.0 - self._initial / self.total if self.total else 0.0

    def _left(self) -> float | None:
        """Time left of the stage [s]."""
        now, done = time.monotonic(), self.n - self._initial
        if self.n >= (self.total or 0):
            return 0.0
        if done <= 0:
            return None
        # What comes before the first count, such as the practice session, does not slow down the rest.
        first, done_first = self._first = self._first or (now, done)
        if now - first > 0.2 * (now - self._start) and done > done_first:
            pace = (now - first) / (done - done_first)
        else:
            pace = (now - self._start) / done
        return max(pace * ((self.total or 0) - self.n), 0.0)

    def close(self) -> None:
        """End the stage."""
        if not self._is_closed.is_set():
            self._is_closed.set()
            self._whole.end(self._label, time.monotonic() - self._start, self._part())
        super().close()

    def _report(self) -> None:
        whole = self._whole
        while not self._is_closed.wait(max(whole.due - time.monotonic(), 0.0)):
            print(self.line(), file=sys.stderr, flush=True)
            whole.due = time.monotonic() + whole.interval


def in_words(seconds: float) -> str:
    """A duration in its two largest units."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
