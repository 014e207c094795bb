"""Figures of a study, after those of the thesis's chapters 2 and 3."""

import itertools
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyBboxPatch, Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, MultipleLocator, NullLocator
from numpy.typing import NDArray

from armperturb.analysis.arm_model import arm_admittance, simulate_linear
from armperturb.analysis.spectra import LineSpectra, line_spectra
from armperturb.analysis.structures import unit
from armperturb.analysis.vaf import variance_accounted_for
from armperturb.envs.camera import render
from armperturb.models import build_model
from armperturb.perturbations import MultisineThenPulse
from armperturb.perturbations.multisine import CLUSTERS, FULL_BAND, PERIOD
from armperturb.study import published
from armperturb.study.admittance import MeanAdmittance, by_task, main_conditions, mean_admittance
from armperturb.study.cases import Case
from armperturb.study.protocol import Condition
from armperturb.study.results import StudyResult
from armperturb.study.style import (
    BESIDE,
    COLOURS,
    FITTED,
    GREY,
    INK,
    PALE,
    PUBLISHED,
    RECORDED,
    TRUE,
    in_style,
    new_figure,
    shades,
)
from armperturb.study.tables import published_or_nan, true_value

Array = NDArray[np.float64]

AXES = ("x", "y")

Element = tuple[int, int]
"""Output and input axis of an admittance."""

FREQUENCY = np.geomspace(0.15, 45.0, 400)
"""Where models are drawn [Hz]."""

PHASES = (-270.0, 90.0)
"""The turn in which phases are drawn [degree]: springs, dampers and masses lie well inside, and so do negated ones."""


@in_style()
def rig(study: StudyResult) -> Figure:
    """The first person on the manipulator, from above and from the side.

    Raises:
      RuntimeError: this machine cannot draw; the message names what to install.
    """
    model = build_model(study.cohort[0].subjects[study.protocol.conditions[0].task], study.environment)
    figure = new_figure(3.95)
    for ax, camera in zip(figure.subplots(1, 2), ("top", "oblique"), strict=True):
        ax.imshow(render(model, camera=camera, width=840, height=840), interpolation="none")
        ax.set_axis_off()
        if camera == "top":
            _draw_directions(ax)
    return figure


def _draw_directions(ax: Axes) -> None:
    """The axes x and y in the lower left corner of a picture from above."""
    arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0}
    for tip, label, place in (((0.18, 0.06), "x", (0.205, 0.06)), ((0.06, 0.18), "y", (0.06, 0.205))):
        ax.annotate("", tip, (0.06, 0.06), xycoords="axes fraction", arrowprops=arrow)
        ax.text(*place, label, transform=ax.transAxes, ha="center", va="center", weight="bold")


@in_style()
def perturbation(case: Case) -> Figure:
    """A multisine, its power, and the pulse that follows it, if there is one (thesis fig. 2.5)."""
    trial = case.trials().isel(trial=[0])
    time, force = trial["time"].values, trial["perturbation"].values[0]
    onset = float(trial["pulse_onset"].values[0])

    figure = new_figure(4.4)
    grid = figure.add_gridspec(1, 2, width_ratios=(1.35, 1))
    whole = list(grid[0].subgridspec(2, 1).subplots(sharex=True, sharey=True, squeeze=False).flat)
    *zooms, density = grid[1].subgridspec(1 if np.isnan(onset) else 2, 1).subplots(squeeze=False).flat
    colours = (INK, GREY)
    for ax, axis, colour in zip(whole, range(2), colours, strict=True):
        ax.plot(time, force[:, axis], color=colour, linewidth=0.7)
        ax.set(ylabel=f"$d_{AXES[axis]}$ [N]", xlim=(0, time[-1]))
    whole[0].set_title(f"one trial of {case.condition.name}")
    whole[1].set_xlabel("time [s]")

    for zoom in zooms:
        near = (time > onset - 0.5) & (time < onset + 0.3)
        zoom.axvspan(onset, onset + MultisineThenPulse.fade, color=PALE, alpha=0.6, linewidth=0)
        for axis, colour in enumerate(colours):
            zoom.plot(time[near], force[near, axis], color=colour, label=f"$d_{AXES[axis]}$")
        zoom.set(title="fade (grey) and pulse", xlabel="time [s]", ylabel="force [N]", xlim=(onset - 0.5, onset + 0.3))
        zoom.legend(loc="upper left")
    _draw_density(density, line_spectra(trial), float(trial.attrs["rate"]))
    return figure


def _draw_density(ax: Axes, lines: LineSpectra, rate: float) -> None:
    """Autospectral density of a multisine, mean of both axes, with its bands and its extra clusters."""
    power = 2.0 * np.mean(np.abs(lines.perturbation[0]) ** 2, axis=-1) / (PERIOD * rate**2)
    floor = 10 ** np.floor(np.log10(power.min()) - 0.5)
    clusters = np.searchsorted(lines.line, CLUSTERS)
    reduced = np.flatnonzero(CLUSTERS[:, 0] / PERIOD > FULL_BAND[1])
    extra = reduced[1:8:2]  # midpoints of the first five of the logarithmic grid
    for which, colour, label in (
        (np.setdiff1d(np.arange(len(CLUSTERS)), reduced), COLOURS["PT"], "full power"),
        (np.setdiff1d(reduced, extra), INK, "reduced power"),
        (extra, GREY, "extra clusters"),
    ):
        index = clusters[which].ravel()
        ax.vlines(lines.frequency[index], floor, power[index], color=colour, linewidth=1.2)
        ax.plot(lines.frequency[index], power[index], "o", color=colour, markersize=2.2, label=label)
    ax.set(xscale="log", yscale="log", ylim=(floor, power.max() * 3), title="power of the multisine, each axis")
    ax.set(ylabel="density [N²/Hz]")
    _label_frequency(ax)
    ax.legend(loc="upper right", handletextpad=0.1)


@in_style()
def admittance_of_trials(case: Case) -> Figure:
    """Admittance of one subject, from each trial and from all, and a linear one's own (thesis fig. 3.1)."""
    spectra = case.identified.spectra
    figure, panels = _admittance_panels()
    for trial in case.single_trials:
        _plot_admittance(panels, trial.frequency, trial.arm, color=GREY, linewidth=0.7, alpha=0.6)
    _plot_admittance(panels, spectra.frequency, spectra.arm, color=INK, linewidth=1.5)
    _legend(
        figure,
        Line2D([], [], color=GREY, linewidth=0.9, alpha=0.6, label="single trials"),
        Line2D([], [], color=INK, linewidth=1.5, label="spectra averaged over trials"),
        *_plot_truth(panels, case),
    )
    return figure


@in_style()
def admittance_by_task(study: StudyResult) -> Figure:
    """Admittance of each task's main condition, mean and SD over subjects (thesis fig. 3.2)."""
    figure, panels = _admittance_panels()
    handles: list[Line2D | Patch] = []
    for task, condition in main_conditions(study).items():
        mean = mean_admittance(study, condition.name)
        look: dict[str, Any] = {"color": COLOURS[task], "marker": "o", "markersize": 3}
        band: dict[str, Any] = {"color": COLOURS[task], "alpha": 0.18, "linewidth": 0}
        for (output, input_), (gain_ax, phase_ax) in panels.items():
            gain, ratio = mean.gain[:, output, input_], mean.gain_ratio[:, output, input_]
            gain_ax.fill_between(mean.frequency, gain / ratio, gain * ratio, **band)
            frequency, phase, spread = _within_turn(
                mean.frequency, mean.phase[:, output, input_], mean.phase_sd[:, output, input_]
            )
            phase_ax.fill_between(frequency, phase - spread, phase + spread, **band)
        _plot_mean(panels, mean, look)
        handles.append(Line2D([], [], label=condition.name, **look))
    if study.n_people > 1:
        handles.append(Patch(facecolor=GREY, alpha=0.3, label="± 1 SD over people"))
    _legend(figure, *handles)
    return figure


@in_style()
def admittance_by_amplitude(study: StudyResult, task: str) -> Figure:
    """Admittance of all conditions of a task, mean over subjects (thesis figs 3.3 to 3.5)."""
    figure, panels = _admittance_panels()
    handles = []
    for condition, look in _looks(study, task):
        _plot_mean(panels, mean_admittance(study, condition.name), {**look, "markersize": 3.5})
        handles.append(Line2D([], [], label=condition.name, **look))
    _legend(figure, *handles)
    return figure


@in_style()
def coherence(study: StudyResult) -> Figure:
    """Multiple coherence of single trials, mean and SD over subjects (thesis fig. 3.6)."""
    n_columns = max(2, min(3, max(map(len, by_task(study).values()))))
    blocks = [
        conditions[first : first + n_columns]
        for conditions in by_task(study).values()
        for first in range(0, len(conditions), n_columns)
    ]
    figure = new_figure(3.3 * len(blocks) + 0.3)
    parts = figure.subfigures(len(blocks), 1, squeeze=False)
    for number, (part, block) in enumerate(zip(parts.flat, blocks, strict=True)):
        panels = part.subplots(2, n_columns, sharex=True, sharey=True, squeeze=False)
        for column, condition in zip(panels.T, block, strict=False):
            _draw_coherence(column, study.of(condition.name))
            column[0].set_title(condition.name)
            _label_frequency(column[-1])
        for column in panels.T[len(block) :]:
            for ax in column:
                ax.set_visible(False)
        for output, ax in enumerate(panels[:, 0]):
            ax.set_ylabel(rf"$\gamma^2_{{{AXES[output]}d}}$ [-]")
        if number == 0:
            panels[0, 0].text(0.2, 0.47, "expected of pure noise", color=GREY, fontsize=8, va="top")
    return figure


def _draw_coherence(column: NDArray[np.object_], cases: list[Case]) -> None:
    """The coherence of a condition's displacement along x, and along y below."""
    of_subjects = np.stack([np.mean([trial.coherence for trial in case.single_trials], axis=0) for case in cases])
    spread = of_subjects.std(axis=0, ddof=1) if len(of_subjects) > 1 else None
    for output, ax in enumerate(column):
        ax.errorbar(
            cases[0].single_trials[0].frequency,
            of_subjects.mean(axis=0)[:, output],
            None if spread is None else spread[:, output],
            fmt="o-",
            markersize=3,
            elinewidth=0.9,
            color=COLOURS[cases[0].condition.task],
        )
        ax.axhline(0.5, color=GREY, linewidth=1, linestyle=":")
        ax.set(xscale="log", ylim=(0, 1.05))


@in_style()
def fit(case: Case) -> Figure:
    """Arm model fitted to the admittance of one subject, and a linear one's own (thesis figs 3.7, 3.8)."""
    identification = case.identified
    spectra = identification.spectra
    model = arm_admittance(identification.fit.arm, FREQUENCY)
    estimated: dict[str, Any] = {**RECORDED, "marker": "o", "markersize": 4.5}
    figure, panels = _admittance_panels()
    _plot_admittance(panels, spectra.frequency, spectra.arm, **estimated)
    _plot_admittance(panels, FREQUENCY, model, **FITTED)
    _legend(
        figure,
        Line2D([], [], label="estimated", **estimated),
        Line2D([], [], label=f"fitted model {identification.fit.structure}", **FITTED),
        *_plot_truth(panels, case),
    )
    return figure


@in_style()
def prediction(case: Case, *, trial: int = 0, start: float = 20.0, span: float = 5.0) -> Figure:
    """Recorded displacement of the handle against the fitted model's (thesis figs 3.9, 3.10).

    Args:
      case: who, in which condition.
      trial: which of the trials that were analysed.
      start: of the sample that is shown [s].
      span: of the sample that is shown [s].
    """
    identification, recording = case.identified, case.trials().isel(trial=trial)
    rate, onset = float(recording.attrs["rate"]), float(recording["pulse_onset"])
    n = recording.sizes["time"] if np.isnan(onset) else round(onset * rate)
    time, recorded = recording["time"].values[:n], recording["displacement"].values[:n]
    predicted = None
    if identification.fit.stable:
        d = recording["perturbation"].values[:n]
        predicted = simulate_linear(identification.fit.arm, identification.environment, d, rate).displacement
    shown = (time >= start) & (time <= start + span)

    figure = new_figure(3.5)
    panels = figure.subplots(2, 1, sharex=True)
    for axis, ax in enumerate(panels):
        ax.plot(time[shown], 1e3 * recorded[shown, axis], label="recorded", **RECORDED)
        if predicted is None:
            ax.set_title("the fitted model is unstable: no prediction", loc="left")
        else:
            vaf = variance_accounted_for(recorded, predicted, rate)[axis]
            ax.plot(time[shown], 1e3 * predicted[shown, axis], label="fitted model", **FITTED)
            ax.set_title(f"along {AXES[axis]}: VAF {vaf:.1f} %", loc="left")
        ax.set(ylabel=f"${AXES[axis]}$ [mm]", xlim=(start, start + span))
    panels[-1].set_xlabel("time [s]")
    panels[0].legend(loc="lower right", bbox_to_anchor=(1, 0.98), ncols=2, borderaxespad=0)
    return figure


@in_style()
def parameters(study: StudyResult, task: str) -> Figure:
    """Estimated against true parameters of linear people in a task's conditions, beside the published mean and SD.

    Bars are 95 % intervals; what the thesis's estimator gives beyond a panel is drawn at its edge.
    """
    looks = _looks(study, task)
    names = tuple(study.of(looks[0][0].name)[0].identified.fit.values)
    n_columns = 5
    n_rows = -(-len(names) // n_columns)
    figure = new_figure(1.75 * n_rows + 0.6)
    panels = figure.subplots(n_rows, n_columns, squeeze=False)
    any_printed = False
    for ax, name in zip(panels.flat, names, strict=False):
        truths: list[float] = []
        reach: list[float] = []
        of_thesis: list[tuple[float, float]] = []
        printed: list[tuple[published.MeanSD, dict[str, Any]]] = []
        for condition, look in looks:
            cases = study.of(condition.name)
            truth = [true_value(case.truth, name) for case in cases]
            fits = [case.identified.fit for case in cases]
            estimate = [fit.values[name] for fit in fits]
            half = np.array([fit.interval(name).upper - fit.values[name] for fit in fits])
            truths += truth
            reach += estimate
            ax.errorbar(
                truth,
                estimate,
                np.where(np.isfinite(half), half, 0),
                fmt=look["marker"],
                color=look["color"],
                markersize=3.5,
                elinewidth=0.8,
                alpha=0.85,
            )
            of_thesis += [(true_value(case.truth, name), case.thesis.fit.values[name]) for case in cases if case.thesis]
            mean_sd = published_or_nan(published.parameter, condition.name, name)
            if np.isfinite(mean_sd.mean):
                printed.append((mean_sd, look))
                reach += [mean_sd.mean - mean_sd.sd, mean_sd.mean + mean_sd.sd]
        (left, high), (bottom, top) = _padded(truths), _padded([*truths, *reach])
        for true, found in of_thesis:
            ax.plot(true, np.clip(found, bottom, top), **BESIDE, clip_on=False, zorder=1.5)
        ax.plot((left, high), (left, high), **{**TRUE, "linewidth": 1})
        place_width = 0.11 * (high - left)
        right = high + place_width * (len(printed) + 0.6) if printed else high
        any_printed |= bool(printed)
        ax.axvspan(high, right, color=PALE, alpha=0.35, linewidth=0)
        for place, (one, look) in enumerate(printed, start=1):
            x = high + (place - 0.2) * place_width
            ax.errorbar(x, one.mean, one.sd, fmt=look["marker"], color=PUBLISHED["color"], markersize=3.5)
        ax.set(xlim=(left, right), ylim=(bottom, top), box_aspect=1)
        ax.set_title(f"{parameter_symbol(name)} [{unit(name)}]")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(MaxNLocator(3))
    for ax in panels.flat[len(names) :]:
        ax.set_visible(False)
    figure.supxlabel("true", fontsize=9)
    figure.supylabel("estimated", fontsize=9)
    handles = [Line2D([], [], linestyle="", label=condition.name, **look) for condition, look in looks]
    handles.append(Line2D([], [], label="thesis's estimator", **BESIDE))
    handles.append(Line2D([], [], label="estimated = true", **{**TRUE, "linewidth": 1}))
    if any_printed:
        handles.append(Line2D([], [], marker="o", linestyle="", label="published mean ± SD", **PUBLISHED))
    _legend(figure, *handles)
    return figure


@in_style()
def overview(study: StudyResult, *, subject: int = 0) -> Figure:
    """The rig, and the admittance of one person in both tasks with the fitted models; for the head of a page.

    `docs/overview.png` is the second person of seed 0 with linear muscles, saved with `save_png`.

    Args:
      study: of known people, in which the person was identified in PT7.5 and RT7.5.
      subject: number of the person, from 0.

    Raises:
      RuntimeError: this machine cannot draw the rig; the message names what to install.
    """
    figure = new_figure(4.6, 10.7)
    beside = 0.46
    figure.set_layout_engine("constrained", rect=(beside, 0, 1 - beside, 1))
    ax = figure.add_axes((0, 0, beside - 0.02, 1))
    ax.set_axis_off()
    model = build_model(study.cohort[subject].subjects["PT"], study.environment)
    picture = ax.imshow(render(model, camera="oblique", width=1412, height=1380), aspect="auto")
    corners = FancyBboxPatch((0.03, 0.03), 0.94, 0.94, boxstyle="round,pad=0.03", transform=ax.transAxes)
    picture.set_clip_path(corners)

    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    for condition in (study.protocol.condition(name) for name in ("PT7.5", "RT7.5")):
        identification = study.of(condition.name)[subject].identified
        spectra, colour = identification.spectra, COLOURS[condition.task]
        fitted = np.abs(arm_admittance(identification.fit.arm, FREQUENCY))
        for element, panel in enumerate(panels):
            panel.loglog(FREQUENCY, fitted[:, element, element], color=colour, linewidth=1.8)
            gain = np.abs(spectra.arm[:, element, element])
            panel.plot(spectra.frequency, gain, "o", color=colour, markersize=6, markeredgecolor="white")
        task = {"PT": "hold position", "RT": "relax"}[condition.task]
        panels[0].text(0.17, 0.6 * fitted[0, 0, 0], task, color=colour, fontsize=12, weight="bold", va="top")
    for axis, panel in zip(AXES, panels, strict=True):
        panel.set_ylabel(f"$|H_{{{2 * axis}}}|$  [m/N]", fontsize=11)
        panel.tick_params(labelsize=10)
    _label_frequency(panels[-1], fontsize=11)
    panels[0].set_title("Admittance of one arm: estimated (points), fitted (lines)", fontsize=11)
    return figure


def parameter_symbol(name: str) -> str:
    """A parameter as mathematical text, e.g. kv_se as k with the subscript v,se."""
    quantity, _, place = name.partition("_")
    letter, more = quantity[0], quantity[1:]
    return f"${letter}_{{\\mathrm{{{','.join(filter(None, (more, place)))}}}}}$"


def _padded(values: list[float]) -> tuple[float, float]:
    """Limits of an axis around values; a tenth to each side if they are all one."""
    low, high = min(values), max(values)
    margin = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin


def _looks(study: StudyResult, task: str) -> list[tuple[Condition, dict[str, Any]]]:
    """Conditions of a task with their colours and markers: shades of the task's colour, darker for larger movements."""
    conditions = by_task(study)[task]
    return [
        (condition, {"color": colour, "marker": marker})
        for condition, colour, marker in zip(
            conditions, shades(COLOURS[task], len(conditions)), itertools.cycle("osD^v"), strict=False
        )
    ]


def _admittance_panels() -> tuple[Figure, dict[Element, tuple[Axes, Axes]]]:
    """Axes for gain and phase of each element, gain over phase, two rows by two columns of such pairs."""
    figure = new_figure(7.9)
    grid = figure.add_gridspec(4, 2, height_ratios=(1.35, 1, 1.35, 1))
    panels: dict[Element, tuple[Axes, Axes]] = {}
    for output in range(2):
        for input_ in range(2):
            first = panels.get((0, 0))
            gain = figure.add_subplot(grid[2 * output, input_], sharex=first and first[0], sharey=first and first[0])
            phase = figure.add_subplot(grid[2 * output + 1, input_], sharex=gain, sharey=first and first[1])
            panels[output, input_] = gain, phase
            if first is None:
                gain.set(xscale="log", yscale="log")
                gain.yaxis.set_major_locator(LogLocator(10, numticks=10))
                gain.yaxis.set_minor_locator(NullLocator())
            gain.tick_params(labelbottom=False, labelleft=input_ == 0)
            phase.tick_params(labelbottom=output == 1, labelleft=input_ == 0)
            phase.yaxis.set_major_locator(MultipleLocator(90))
            phase.set_ylim(PHASES)
            element = AXES[output] + AXES[input_]
            gain.set_title(f"$H_{{{element}}}$: from force {AXES[input_]} to displacement {AXES[output]}")
            if input_ == 0:
                gain.set_ylabel("gain [m/N]")
                phase.set_ylabel("phase [°]")
            if output == 1:
                _label_frequency(phase)
    return figure, panels


def _plot_admittance(
    panels: dict[Element, tuple[Axes, Axes]], frequency: Array, admittance: NDArray[np.complex128], **look: Any
) -> None:
    """Draw gain and phase of each element of (frequency, output, input)."""
    for (output, input_), (gain_ax, phase_ax) in panels.items():
        element = admittance[:, output, input_]
        gain_ax.plot(frequency, np.abs(element), **look)
        phase_ax.plot(*_within_turn(frequency, np.angle(element)), **look)


def _plot_truth(panels: dict[Element, tuple[Axes, Axes]], case: Case) -> list[Line2D]:
    """Draw a linear person's own admittance, and return its entry in the legend; others have neither."""
    if case.truth is None or case.truth.muscle is not None:
        return []
    _plot_admittance(panels, FREQUENCY, arm_admittance(case.truth, FREQUENCY), **TRUE)
    return [Line2D([], [], label="true", **TRUE)]


def _plot_mean(panels: dict[Element, tuple[Axes, Axes]], mean: MeanAdmittance, look: dict[str, Any]) -> None:
    """Draw gain and phase of each element of a mean admittance."""
    _plot_admittance(panels, mean.frequency, mean.gain * np.exp(1j * mean.phase), **look)


def _within_turn(frequency: Array, phase: Array, *others: Array) -> list[Array]:
    """Phases [rad] in degrees within `PHASES`, with a gap wherever they leave it on one side and return on the other.

    Args:
      frequency: [Hz], (frequency,).
      phase: [rad], (frequency,).
      *others: further angles, to be given the same gaps [rad], (frequency,).

    Returns:
      Frequencies [Hz], phases and further angles [degree], longer by the gaps.
    """
    low = PHASES[0]
    wrapped = low + np.mod(np.degrees(phase) - low, 360.0)
    jumps = np.flatnonzero(np.abs(np.diff(wrapped)) > 180.0) + 1
    return [np.insert(values, jumps, np.nan) for values in (frequency, wrapped, *map(np.degrees, others))]


def _label_frequency(ax: Axes, **text: Any) -> None:
    """Ticks in plain numbers on a logarithmic frequency axis."""
    ax.set_xlabel("frequency [Hz]", **text)
    ax.set_xlim(FREQUENCY[0], FREQUENCY[-1])
    ax.xaxis.set_major_locator(FixedLocator([0.2, 0.5, 1, 2, 5, 10, 20, 40]))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _legend(figure: Figure, *handles: Line2D | Patch) -> None:
    """One legend for the whole figure, above its panels."""
    figure.legend(handles=list(handles), loc="outside upper center", ncols=min(len(handles), 6))
