"""Constrained layout of a figure that is being saved, in a third of its time.

Matplotlib places axes twice, as ticks may change when axes change their size, and measures all of their labels each
time and several times over. Here the first time, which only has to come close, it gets a guess; the second time each
axis measures its labels once, with what draws them, so that the drawing need not do it again. Should Matplotlib come to
ask in another way, it would measure as it did: figures would take longer, and be none the worse.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from matplotlib.axis import XAxis, YAxis
from matplotlib.backend_bases import RendererBase
from matplotlib.figure import Figure
from matplotlib.layout_engine import LayoutEngine
from matplotlib.transforms import Bbox

LINE, CHARACTERS = 1.5, 2.5
"""Height of a line of labels, and width of those at the ticks of a vertical axis, as guessed [size of the text]."""


@contextmanager
def arranged_when_drawn(figure: Figure) -> Iterator[None]:
    """Within it, the figure is laid out when it is drawn; it keeps the places, and has no layout engine any more.

    Left to itself, Matplotlib draws a figure once to lay it out and once more to save it, even with a placeholder for
    an engine.
    """
    engine = figure.get_layout_engine()
    figure.set_layout_engine(None)

    def draw(renderer: RendererBase) -> None:
        del figure.draw
        if engine is not None:
            _arrange(figure, engine, renderer)
        figure.draw(renderer)

    figure.draw = draw  # type: ignore[method-assign]
    try:
        yield
    finally:
        vars(figure).pop("draw", None)


def _arrange(figure: Figure, engine: LayoutEngine, renderer: RendererBase) -> None:
    """Find all places."""
    axes = [axis for ax in figure.axes if ax.get_visible() for axis in (ax.xaxis, ax.yaxis)]
    # Each of them would measure all ticks, which its axis does.
    spines = [spine for ax in figure.axes for spine in ax.spines.values() if spine.get_in_layout()]
    measured = [_Measured(axis) for axis in axes]
    for axis, stand_in in zip(axes, measured, strict=True):
        if not axis.get_label_text():
            # Somewhere: otherwise all ticks are measured to find a place for no label.
            axis.set_label_coords(0.5, 0.5)
        axis.get_tightbbox = stand_in  # type: ignore[method-assign]
    for spine in spines:
        spine.set_in_layout(False)
    # Where the canvas has none, Matplotlib would make one, which measures texts and formulas for itself.
    is_without = not hasattr(figure.canvas, "get_renderer")
    if is_without:
        figure.canvas.get_renderer = lambda: renderer  # type: ignore[attr-defined]
    try:
        engine.execute(figure)
        if any(each.is_outdated() for each in measured):
            engine.execute(figure)
    finally:
        if is_without:
            del figure.canvas.get_renderer  # type: ignore[attr-defined]
        for spine in spines:
            spine.set_in_layout(True)
        for axis in axes:
            del axis.get_tightbbox


class _Measured:
    """Stands for an axis's own `get_tightbbox`: a guess when it is asked first, what is measured afterwards."""

    def __init__(self, axis: XAxis | YAxis) -> None:
        self._axis, self._measure = axis, axis.get_tightbbox
        self._is_asked = False
        self._places: list[float] = []

    def is_outdated(self) -> bool:
        """Whether there are other ticks than when they were measured, as the axes have become larger or smaller."""
        return bool(self._places) and list(self._axis.get_majorticklocs()) != self._places

    def __call__(self, *args: Any, **options: Any) -> Bbox | None:
        if not self._axis.get_visible():
            return None
        if not self._is_asked:
            self._is_asked = True
            return _beside(self._axis, self._axis.get_label_position(), _guess(self._axis))
        box, ticks = self._measure(*args, **options), self._ticks()
        return ticks if box is None else Bbox.union([box, ticks])

    def _ticks(self) -> Bbox:
        """What a spine with ticks takes."""
        self._places = list(self._axis.get_majorticklocs())
        deep = self._axis.get_tick_padding() if self._places else 0.0
        side = self._axis.get_ticks_position()
        usual = "bottom" if self._axis.get_label_position() in ("bottom", "top") else "left"
        return _beside(self._axis, side if side in ("top", "right") else usual, deep)


def _guess(axis: XAxis | YAxis) -> float:
    """About how deep the labels of an axis are [point]."""
    size = float(axis.label.get_fontsize())
    deep = LINE * size if axis.get_label_text() else 0.0
    side = axis.get_label_position()
    if axis.get_tick_params().get(f"label{side}", True):
        deep += size * (LINE if side in ("bottom", "top") else CHARACTERS)
    return deep


def _beside(axis: XAxis | YAxis, side: str, deep: float) -> Bbox:
    """The box of an axis's axes, and on one side so much more [point]."""
    x0, y0, x1, y1 = axis.axes.bbox.extents
    deep *= axis.axes.figure.dpi / 72.0
    match side:
        case "left":
            return Bbox.from_extents(x0 - deep, y0, x1, y1)
        case "right":
            return Bbox.from_extents(x0, y0, x1 + deep, y1)
        case "top":
            return Bbox.from_extents(x0, y0, x1, y1 + deep)
    return Bbox.from_extents(x0, y0 - deep, x1, y1)
