"""What a video shows of a trial."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from armperturb.validation import require_number, require_one_of, require_ranges

if TYPE_CHECKING:
    from armperturb.envs.render.replay import Replay

VIEWS = {"both": ("top", "oblique"), "top": ("top",), "oblique": ("oblique",)}
"""Value of `Clip.view` to the views that a video then shows side by side."""

SMALLEST, LARGEST = (320, 240), (1920, 1440)
"""Width and height of a view [pixel]: smaller ones cannot be read."""

BEFORE_PULSE, AFTER_PULSE = 0.2, 1.0
"""What a slow video shows before and after a pulse's onset [s]."""


@dataclass(frozen=True, kw_only=True)
class Clip:
    """What a video shows of a trial, and how.

    Raises:
      TypeError: a value has the wrong type.
      ValueError: a value is out of its range.
    """

    view: Literal["both", "top", "oblique"] = "both"
    """From above, obliquely from the side, or both side by side."""
    size: tuple[int, int] = (640, 480)
    """Width and height of each view [pixel], 320 240 to 1920 1440, the width even and the height a multiple of 4; the
    strip chart below adds half the height."""
    slow: float = 1.0
    """How many times slower than real time, e.g. 10 for a pulse; below 1 it is faster."""
    start: float | None = None
    """Where in the trial to start [s]; by default at its start."""
    stop: float | None = None
    """Where in the trial to stop [s]; by default at its end, or where the handle met the limit of the workspace, after
    which the signals mean nothing. A pulse in slow motion is shown from 0.2 s before its onset to 1 s after it, unless
    start or stop is given."""

    def __post_init__(self) -> None:
        require_one_of("video", "view", self.view, tuple(VIEWS))
        for name, value, least, most, multiple in zip(
            ("width", "height"), self.size, SMALLEST, LARGEST, (2, 4), strict=True
        ):
            require_number("video", name, value, at_least=least, at_most=most, whole=True)
            if value % multiple:
                raise ValueError(f"video: {name} = {value!r}; expected a multiple of {multiple} pixels")
        require_ranges("video", self)

    def window(self, replay: "Replay") -> tuple[float, float]:
        """Start and stop in a trial [s].

        Raises:
          ValueError: they are outside the trial, after the limit of the workspace, or in the wrong order.
        """
        end = replay.end
        first = 0.0 if self.start is None else self.start
        last = end if self.stop is None else self.stop
        onset = replay.pulse_onset
        if self.slow > 1.0 and onset is not None and onset < end and self.start is None and self.stop is None:
            first, last = max(first, onset - BEFORE_PULSE), min(last, onset + AFTER_PULSE)
        if not first < last <= end:
            met = "" if replay.limit_time is None else f", before the limit of the workspace at {end:g} s"
            raise ValueError(
                f"video: from {first:g} s to {last:g} s; expected a start before the stop, and both in the trial of "
                f"{replay.duration:g} s{met}"
            )
        return first, last
