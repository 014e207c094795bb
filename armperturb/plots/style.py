"""One look for all figures: settings, colours, and how they are saved."""

import gc
import io
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure

from armperturb.files import write_whole
from armperturb.plots.layout import arranged_when_drawn

WIDTH = 7.6
"""Of every figure of the report [inch], so that text has one size."""

COLOURS = {"PT": "#0072B2", "RT": "#D55E00"}
"""Colour of each task, from Okabe and Ito's colour-blind-safe palette (blue, vermillion)."""

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours of things side by side, from the same palette."""

INK, GREY, PALE = "#262a30", "#8b929c", "#c9cdd3"

FITTED: dict[str, Any] = {"color": INK, "linewidth": 1.3}
"""Line of a fitted model."""

SKELETAL: dict[str, Any] = {"color": "#E69F00", "linewidth": 1.3, "linestyle": (0, (4, 2))}
"""Line of the nonlinear skeletal model (orange, dashed)."""

RECORDED: dict[str, Any] = {"color": GREY, "linewidth": 2.2}
"""Line of what was recorded or estimated from it, under a model's line."""

TRUE: dict[str, Any] = {"color": "#009E73", "linewidth": 1.3, "linestyle": (0, (4, 2.2))}
"""Line of the simulated person's own admittance (bluish green, dashed)."""

BESIDE: dict[str, Any] = {"color": GREY, "marker": "x", "linestyle": "", "markersize": 3.5, "alpha": 0.55}
"""What the thesis's estimator makes of the same trials."""

PUBLISHED: dict[str, Any] = {"color": "#CC79A7"}
"""What the thesis printed (reddish purple)."""

_LOCK = threading.RLock()


@contextmanager
def in_style() -> Iterator[None]:
    """Draw in this style, whatever the user's own; also a decorator.

    Matplotlib's settings belong to the whole process: they are put back afterwards, and threads take turns.
    """
    with _LOCK, _uncollected(), matplotlib.style.context(["default", "armperturb.plots.armperturb"]):
        yield


@contextmanager
def _uncollected() -> Iterator[None]:
    """Look for garbage afterwards: a figure is some 100,000 objects in cycles, and no garbage until it is drawn.

    To look at them over and over would take a third of the time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def shades(colour: str, n: int) -> list[str]:
    """n shades of a colour from light to dark; the colour itself in the middle."""
    base = np.array(to_rgb(colour))
    towards = np.linspace(-0.55, 0.5, n) if n > 1 else np.zeros(1)
    return [to_hex(base * (1 - abs(share)) + (abs(share) if share < 0 else 0.0)) for share in towards]


def colours_for(n: int) -> list[str]:
    """Colours of n things in one figure, no two alike: ink for a single one, else `PALETTE`, or a longer scale."""
    if n > len(PALETTE):
        # Of Matplotlib's colour maps the one in which so many lie farthest apart.
        return [to_hex(colour) for colour in colormaps["turbo"](np.linspace(0.02, 0.98, n))]
    return [INK] if n == 1 else list(PALETTE[:n])


def round_number_below(value: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above a positive value, but for rounding."""
    power = 10.0 ** np.floor(np.log10(value * (1.0 + 1e-9)))
    return float(power * max(step for step in (1, 2, 5) if step * power <= value * (1.0 + 1e-9)))


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """An empty figure [inch] that belongs to no window and to no list of open figures."""
    return Figure(figsize=(width, height), layout="constrained")


def figure_for(figure: Figure | None, height: float) -> Figure:
    """A figure to draw on: the given one, which gets this height [inch], or a new one of pyplot, which windows show."""
    if figure is None:
        from matplotlib import pyplot

        return pyplot.figure(figsize=(WIDTH, height), layout="constrained")
    if isinstance(figure, Figure):
        figure.set_figheight(height)
    return figure


def save_plot(result: Any, path: Path) -> None:
    """Write the plot of a result as SVG.

    Raises:
      OSError: the folder cannot be written to.
    """
    figure = new_figure(1.0)
    result.plot(figure=figure)
    save_svg(figure, path)


def save_svg(figure: Figure, path: Path) -> None:
    """Write a figure as `svg` gives it, whole or not at all.

    Raises:
      OSError: the folder cannot be written to.
    """
    write_whole(path, svg(figure))


def save_png(figure: Figure, path: Path, dots_per_inch: float = 150.0) -> None:
    """Write a figure as PNG, whole or not at all.

    Raises:
      OSError: the folder cannot be written to.
    """
    write_whole(path, _saved(figure, format="png", dpi=dots_per_inch))


_PATH, _SPACE, _FINER = re.compile(rb' d="[^"]*"'), re.compile(rb"\s+"), re.compile(rb"(\.\d\d)\d+")
_PLACE = re.compile(rb'( [xy]=")(-?\d+\.\d\d)\d+(?=")')


def svg(figure: Figure) -> bytes:
    """A figure as SVG that needs nothing else; the same bytes whenever it is drawn.

    Paths and places are cut to hundredths of a point, which nobody sees.
    """
    content = _saved(figure, format="svg", metadata={"Date": None})
    return _PLACE.sub(rb"\1\2", _PATH.sub(lambda path: _SPACE.sub(b" ", _FINER.sub(rb"\1", path[0])), content))


@in_style()
def _saved(figure: Figure, **options: Any) -> bytes:
    content = io.BytesIO()
    with arranged_when_drawn(figure):
        figure.savefig(content, **options)
    return content.getvalue()
