"""Saved figures are laid out as Matplotlib's own constrained layout would, and nothing runs into anything else."""

import itertools
from functools import cache

import numpy as np
import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from armperturb.plots.ellipses import Posture, plot_ellipses
from armperturb.plots.panels import admittance_panels, legend
from armperturb.plots.style import in_style, new_figure, save_png, svg

X = np.geomspace(0.15, 45.0, 50)


def an_admittance():
    figure, panels = admittance_panels()
    for gain, phase in panels.values():
        gain.plot(X, 1e-3 / X)
        phase.plot(X, -90.0 + X)
    legend(figure, Line2D([], [], label="first"), Line2D([], [], label="second"))
    return figure


def subfigures():
    figure = new_figure(6.0)
    for part in figure.subfigures(2, 1):
        for ax in part.subplots(2, 2, sharex=True, sharey=True).flat:
            ax.plot(X, 1000.0 * X)
            ax.set(title="title", xlabel="frequency [Hz]", ylabel=r"$\gamma^2_{xd}$ [-]", xscale="log")
            ax.label_outer()
    return figure


def nested_grids():
    figure = new_figure(4.0)
    grid = figure.add_gridspec(1, 2, width_ratios=(1.35, 1))
    for column, rows in enumerate((2, 3)):
        for ax in grid[column].subgridspec(rows, 1).subplots():
            ax.plot(X, 1e4 * X)
            ax.set(xlabel="time [s]", ylabel="force [N]")
    return figure


def legends_and_a_title_beside():
    figure = new_figure(4.0)
    figure.suptitle("above all")
    for ax in figure.subplots(2, 1, sharex=True):
        ax.plot(X, X, label="a muscle with a long name")
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.legend(handles=[Line2D([], [], label="below")], loc="outside lower center")
    return figure


def pictures():
    figure = new_figure(4.0)
    first, second, third = figure.subplots(1, 3)
    first.imshow(np.zeros((4, 4)))
    first.set_axis_off()
    second.imshow(np.zeros((9, 4)))
    second.yaxis.set_ticks_position("right")
    second.set(xticks=(), title="upright")
    third.set_visible(False)
    return figure


def ticks_that_change():
    """Panels that become taller than they first seem, and then have ticks with longer labels."""
    figure = new_figure(6.4)
    for part in figure.subfigures(2, 1):
        for ax in part.subplots(2, 1, sharex=True, sharey=True).flat:
            ax.plot(X, np.linspace(0.5, 1.0, len(X)))
            ax.set(ylabel="[-]", ylim=(0, 1.05), title="title", xlabel="frequency [Hz]")
            ax.label_outer()
    return figure


def ellipses_of_many_conditions():
    """As many as the legend needs three rows for."""
    figure, joints = new_figure(1.0), np.array([[0.0, 0.0], [0.27, 0.155], [0.146, 0.493]])
    units = {"stiffness": "N/m", "damping": "Ns/m", "inertia": "kg"}
    posture = Posture(joints=joints, outlines=dict.fromkeys(units, lambda angle: np.ones((3, len(angle)))))
    plot_ellipses({f"PT{number}": posture for number in range(9)}, units, figure)
    return figure


FIGURES = (
    an_admittance, ticks_that_change, subfigures, nested_grids, legends_and_a_title_beside, pictures,
    ellipses_of_many_conditions,
)  # fmt: skip


def places(figure):
    return np.array([ax.get_position().extents * np.tile(ax.get_figure().bbox.size, 2) for ax in figure.axes])


@in_style()
def constrained(draw):
    """A figure as Matplotlib lays it out, at the resolution of an SVG."""
    figure = draw()
    figure.dpi = 72.0
    FigureCanvasSVG(figure)
    figure.get_layout_engine().execute(figure)
    return figure


@cache
@in_style()
def saved(draw):
    """A figure after it was saved, at the resolution of an SVG."""
    figure = draw()
    svg(figure)
    figure.dpi = 72.0
    FigureCanvasSVG(figure)
    return figure


@pytest.mark.slow(reason="draws figures")
@pytest.mark.parametrize("draw", FIGURES, ids=lambda draw: draw.__name__)
def test_places_are_those_of_constrained_layout(draw):
    np.testing.assert_allclose(places(saved(draw)), places(constrained(draw)), atol=1.0)  # a point


@pytest.mark.slow(reason="draws figures")
@pytest.mark.parametrize("draw", FIGURES, ids=lambda draw: draw.__name__)
def test_nothing_overlaps_or_is_cut_off(draw):
    figure = saved(draw)
    with in_style():
        boxes = [box for ax in figure.axes if (box := ax.get_tightbbox()) is not None]
        boxes += [each.get_window_extent() for each in figure.legends]
    for box in boxes:
        assert min(box.x0, box.y0, figure.bbox.x1 - box.x1, figure.bbox.y1 - box.y1) >= 0
    for one, other in itertools.combinations(boxes, 2):
        shared = np.minimum(one.max, other.max) - np.maximum(one.min, other.min)
        assert shared.min() < 0.5


@pytest.mark.slow(reason="draws figures")
def test_saving_leaves_a_figure_as_it_was_but_for_its_places(tmp_path):
    figure = legends_and_a_title_beside()
    first = svg(figure)
    assert svg(figure) == first
    assert figure.get_layout_engine() is None
    assert "draw" not in vars(figure)
    assert "get_tightbbox" not in vars(figure.axes[0].xaxis)
    assert all(spine.get_in_layout() for spine in figure.axes[0].spines.values())
    save_png(figure, tmp_path / "again.png")
    bare = Figure()
    bare.add_axes((0.2, 0.2, 0.6, 0.6))
    svg(bare)
    np.testing.assert_allclose(bare.axes[0].get_position().bounds, (0.2, 0.2, 0.6, 0.6))


def test_a_layout_that_fails_leaves_nothing_behind(monkeypatch):
    figure = nested_grids()
    engine = figure.get_layout_engine()
    monkeypatch.setattr(type(engine), "execute", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        svg(figure)
    assert "draw" not in vars(figure)
    assert "get_tightbbox" not in vars(figure.axes[0].xaxis)


@pytest.mark.parametrize(("label", "n_columns"), [("PT", 6), ("PT7.5 with the eyes open", 3), ("a long name " * 20, 1)])
@pytest.mark.parametrize("side", ["upper", "lower"])
def test_legends_of_long_names_have_fewer_columns(label, n_columns, side):
    figure = new_figure(3.0)
    figure.subplots()
    legend(figure, *(Line2D([], [], label=label) for _ in range(8)), loc=f"outside {side} center")
    (drawn,) = figure.legends
    assert drawn._ncols == n_columns
    assert n_columns == 1 or drawn.get_window_extent().width <= figure.bbox.width
