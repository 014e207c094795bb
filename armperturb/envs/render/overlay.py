"""What is written and drawn over and under the pictures of a video: labels, scale, clock, strip chart."""

import functools
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from armperturb.arrays import Array
from armperturb.envs.render.camera import DISTURBANCE, PATH, REACTION, TRAIL
from armperturb.envs.render.replay import Replay
from armperturb.plots.style import INK, in_style

Picture = NDArray[np.uint8]

PAPER = (255, 255, 255, 205)
"""Behind text on a picture: nearly opaque white."""


def text_size(width: int, height: int) -> int:
    """Size of text in a picture of some width and height [pixel]."""
    return max(8, round(min(height, 0.75 * width) / 30))


def label_layer(size: tuple[int, int], title: str, force: float, axes: Array) -> Image.Image:
    """The labels of one picture that stay, on a transparent ground.

    Args:
      size: width and height of the picture [pixel].
      title: in the upper left corner, with room for the clock under it; empty for none.
      force: that the two axes in the lower right corner stand for [N].
      axes: that force along x and y as an arrow in this picture, columns and rows [pixel], (axis, 2).
    """
    layer = Image.new("RGBA", size, (255, 255, 255, 0))
    draw = ImageDraw.Draw(layer)
    unit = text_size(*size)
    font, margin = _font(unit), unit // 2
    if title:
        wide = max(font.getlength(title), font.getlength(clock_text(888.88, 888.0)))
        _paper(draw, (margin, margin, 3 * margin + wide, round(2 * margin + 2.8 * unit)))
        draw.text((2 * margin, round(1.5 * margin)), title, font=font, fill=INK)
    _draw_axes(draw, size, f"{force:g} N", axes)
    return layer


def _draw_axes(draw: ImageDraw.ImageDraw, size: tuple[int, int], text: str, axes: Array) -> None:
    """Where x and y point in the lower right corner of a picture, as long as forces of a size are."""
    unit = text_size(*size)
    font, margin = _font(unit), unit // 2
    directions = axes / np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9)
    letters = axes + 0.7 * unit * directions
    ends = np.vstack([np.zeros(2), axes, letters])
    low, high = ends.min(axis=0) - 0.6 * unit, ends.max(axis=0) + 0.6 * unit
    wide = max(high[0] - low[0], font.getlength(text) + unit)
    right, bottom = size[0] - margin, size[1] - margin
    left, top = right - wide, bottom - (high[1] - low[1]) - 1.3 * unit
    _paper(draw, (left, top, right, bottom))
    origin = np.array([left + (wide - (high[0] - low[0])) / 2, top]) - low
    for name, axis, along, letter in zip("xy", axes, directions, letters, strict=True):
        tip, across = origin + axis, 0.2 * unit * np.array([-along[1], along[0]])
        neck = tip - 0.5 * unit * along
        draw.line((*origin, *neck), fill=INK, width=max(2, unit // 7))
        draw.polygon([tuple(tip), tuple(neck + across), tuple(neck - across)], fill=INK)
        draw.text(tuple(origin + letter), name, font=font, fill=INK, anchor="mm")
    draw.text((left + wide / 2, bottom - 0.8 * unit), text, font=font, fill=INK, anchor="mm")


def _paper(draw: ImageDraw.ImageDraw, box: tuple[float, float, float, float]) -> None:
    draw.rounded_rectangle(box, radius=4, fill=PAPER)


def clock_text(time: float, slow: float) -> str:
    """What the clock says.

    Args:
      time: in the trial [s].
      slow: how many times slower than life the video runs.
    """
    pace = "" if slow == 1 else f", {slow:g} × slower" if slow > 1 else f", {1 / slow:g} × faster"
    return f"t = {time:.2f} s{pace}"


def draw_clock(picture: Image.Image, time: float, slow: float) -> None:
    """Write the clock under the title of `label_layer`.

    Args:
      picture: to write on.
      time: as for `clock_text`.
      slow: as for `clock_text`.
    """
    unit = text_size(*picture.size)
    place = (2 * (unit // 2), round(1.5 * (unit // 2)) + round(1.4 * unit))
    ImageDraw.Draw(picture).text(place, clock_text(time, slow), font=_font(unit), fill=INK)


@functools.cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


LEAST_SPAN = 1e-6
"""Of an axis of the chart [N, cm]: what is less at rest is rounding."""


class StripChart:
    """Forces and displacement against time, drawn once; `at` adds where the video is.

    Args:
      shown: what it is drawn of.
      width: of the chart [pixel].
      height: of the chart [pixel].
      unit: size of its text [pixel].
    """

    @in_style()
    def __init__(self, shown: Replay, *, width: int, height: int, unit: int) -> None:
        self._span = float(shown.time[0]), float(shown.time[-1])
        dots_per_inch = 100
        points = 72 / dots_per_inch  # per pixel
        figure = Figure(figsize=(width / dots_per_inch, height / dots_per_inch), dpi=dots_per_inch, facecolor="white")
        canvas = FigureCanvasAgg(figure)
        panels = figure.subplots(2, 1, sharex=True)
        right, bottom, top = 5.6 * unit / width, 2.9 * unit / height, 2.0 * unit / height
        figure.subplots_adjust(right=1 - right, bottom=bottom, top=1 - top, hspace=0.16)
        rows = (
            ("force [N]", ((shown.disturbance, DISTURBANCE, "d"), (shown.reaction, REACTION, "f"))),
            ("x, y [cm]", ((100 * shown.displacement, INK, ""),)),
        )
        line, size = 0.13 * unit * points, unit * points
        for ax, (units, signals) in zip(panels, rows, strict=True):
            for values, colour, name in signals:
                for axis, style in enumerate(("-", (0, (2.5, 1.2)))):
                    label = f"${name}_{'xy'[axis]}$" if name else f"${'xy'[axis]}$"
                    ax.plot(shown.time, values[:, axis], color=colour, linewidth=line, linestyle=style, label=label)
            ax.set_ylabel(units, fontsize=size, labelpad=2)
            ax.set_xlim(*self._span)
            ax.margins(y=0.08)
            middle, span = np.mean(ax.get_ylim()), np.ptp(ax.get_ylim())
            if span < LEAST_SPAN:
                ax.set_ylim(middle - LEAST_SPAN, middle + LEAST_SPAN)
            ax.locator_params(axis="y", nbins=4)
            ax.ticklabel_format(axis="x", useOffset=False)
            ax.grid(linewidth=line / 2)
            ax.tick_params(labelsize=0.85 * size, length=2, pad=2)
            narrow = {"labelspacing": 0.1, "handlelength": 1.4, "handletextpad": 0.4, "borderaxespad": 0.3}
            ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=size, **narrow)
        panels[0].tick_params(labelbottom=False)
        panels[1].set_xlabel("time [s]", fontsize=size, labelpad=1)
        figure.align_ylabels(panels)
        canvas.draw()  # now labels have their texts and widths
        for ax in panels:
            if ax.yaxis.get_offset_text().get_text():  # a power of ten for all ticks would lie on the legend
                ax.yaxis.set_major_formatter("{x:g}")
        beside = max(ax.bbox.x0 - ax.yaxis.get_tightbbox(canvas.get_renderer()).x0 for ax in panels)
        margin = max(4.6 * unit, beside + 0.5 * unit)
        figure.subplots_adjust(left=margin / width)
        canvas.draw()
        self._drawn: Picture = np.asarray(canvas.buffer_rgba())[..., :3].copy()
        self._drawn = _with_legend(self._drawn, unit, margin)
        self._pale = self._drawn.copy()
        self._boxes = []
        for ax in panels:
            left, bottom, right, top = (round(value) for value in ax.get_window_extent().extents)
            rows_of = slice(height - top, height - bottom - 1)
            inside = self._pale[rows_of, left + 2 : right + 2]
            inside[:] = 255 - (255 - inside) // 3
            self._boxes.append((rows_of, left + 2, right + 2))

    def at(self, time: float) -> Picture:
        """The chart with what is still to come paler, and a line at a time, (height, width, 3).

        Args:
          time: in the trial [s].
        """
        chart = self._drawn.copy()
        share = (time - self._span[0]) / (self._span[1] - self._span[0])
        for rows, left, right in self._boxes:
            now = min(left + round(share * (right - left)), right - 1)
            chart[rows, now:right] = self._pale[rows, now:right]
            chart[rows, max(left, now - 1) : now + 1] = [int(INK[i : i + 2], 16) for i in (1, 3, 5)]
        return chart


def _with_legend(chart: Picture, unit: int, margin: float) -> Picture:
    """A chart with what the colours in chart and pictures mean, along its upper edge from a left margin [pixel] on."""
    picture, font = Image.fromarray(chart), _font(unit)
    draw = ImageDraw.Draw(picture)
    entries = ((DISTURBANCE, "disturbance d"), (REACTION, "force f on the hand"), (PATH, f"handle, last {TRAIL:g} s"))
    column = margin
    for colour, text in entries:
        draw.line((column, 0.95 * unit, column + 1.2 * unit, 0.95 * unit), fill=colour, width=max(2, unit // 4))
        draw.text((column + 1.6 * unit, 0.95 * unit), text, font=font, fill=INK, anchor="lm")
        column += 2.8 * unit + font.getlength(text)
    return np.asarray(picture)
