"""What a plan says, for people and for other programs: text, tables, one figure, and perturbations to play."""

import importlib.metadata
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from armperturb.analysis.defaults import SETTLING, WINDOW_START
from armperturb.analysis.fit.truth import departures
from armperturb.analysis.results import Description, Table
from armperturb.arrays import Array
from armperturb.files import require_no_input, write_csv, write_whole
from armperturb.perturbations import save_perturbation
from armperturb.perturbations.multisine import PERIOD
from armperturb.plots.style import COLOURS, INK, PUBLISHED, figure_for, in_style, save_plot
from armperturb.study.planning.information import effective_duration
from armperturb.study.planning.plan import Design
from armperturb.study.planning.settings import NoiseLaw
from armperturb.study.planning.signals import Signal

LOOKS = {
    "thesis's multisine": {"color": PUBLISHED["color"]},
    "optimised": {"color": INK},
    "proposed": {"color": COLOURS["PT"]},
}
"""Colour of each signal, and what it is called."""

NOISE = {"held": "as under the thesis's multisine", "follows": "follows the load"}
"""What each law of the noise is called."""

LEAST_SHOWN = 1e-5
"""Power of a line over that of the strongest from which on the figure shows it [-]."""

PERTURBATIONS, SETTINGS = "perturbations", "settings.json"
"""Folder of the perturbations of a plan, and file of what it was made from."""

OF_A_PLAN, LARGEST_SETTINGS = b'"factor_noise_held"', 2**16
"""What settings of a plan hold, and how much of a file of this name is searched for it [byte]."""

LONGEST = 8
"""Longest duration, and most trials, of the figure, over those that are planned [-]."""


LAWS: dict[NoiseLaw, str] = {
    "held": "with the noise held at what it is under the thesis's",
    "follows": "if the noise follows the load, as that of the synthetic people does",
}
"""What a factor assumes of the noise."""


def describe(design: Design) -> Description:
    """Standard errors in percent of the value, or in its unit where that is zero, and what the signals demand."""
    settings = design.settings
    errors = {"sem_thesis": "SEM thesis", "sem_optimised": "optimised"}
    if design.proposed is not None:
        errors["sem_proposed"] = "proposed"
    rows = []
    for row in design.to_frame().to_dict("records"):
        scale, percent = (100.0 / abs(row["value"]), " %") if row["value"] else (1.0, "")
        cells = [f"{scale * row[name]:.3g}{percent}" for name in errors]
        vary = f"{scale * row['between_trials']:.2g}{percent}" if row["between_trials"] else ""
        mark = "*" if row["goal"] else ""
        value = f"{row['value']:.4g}"
        rows.append((row["parameter"] + mark, value, row["unit"], *cells, f"{row['ratio']:.2f}", vary))
    other: NoiseLaw = "follows" if settings.noise == "held" else "held"
    mass, damping, stiffness = settings.manipulator
    signals = []
    for name, signal in _signals(design):
        forces = ", ".join(f"{value:.2f}" for value in signal.force)
        moves = ", ".join(f"{1e3 * value:.1f}" for value in signal.displacement)
        lasts = "" if signal.duration == settings.duration else f"; {signal.duration:g} s"
        signals.append(f"{name}: RMS force x, y {forces} N; RMS displacement {moves} mm{lasts}")
    details = [
        "SEM: least standard error of any unbiased estimator (Cramer-Rao) of the parameters in these trials; ratio: "
        "optimised over",
        "thesis's; *: the goal; between trials: what adds, as squares, because parameters of synthetic people differ "
        "from trial to trial",
        f"manipulator: {mass:g} kg, {damping:g} Ns/m, {stiffness:g} N/m",
        *signals,
        f"largest force of the realisations: {design.signal_frame()['peak_force_N'].max():.1f} N",
    ]
    if design.excess is None:
        details.append("the limit of the largest force binds: no bound is known of how far this is from the best")
    if settings.period < PERIOD or settings.start < WINDOW_START:
        details.append(
            f"period {settings.period:g} s, for which there is time: identify with --period {settings.period:g} "
            f"--window-start {settings.start:g}"
        )
    remarks = departures(settings.structure(), settings.subject)
    worse = [LAWS[law] for law in (settings.noise, other) if design.factors[law] > 1.0]
    remarks = (*(f"the optimised multisine is worse than the thesis's {law}" for law in worse), *remarks)
    if design.proposed is not None and design.proposed.refusal:
        refused = "identify refuses recordings of the proposed perturbation alone, as far as simulated ones show"
        remarks = (f"{refused}: {design.proposed.refusal}", *remarks)
    return Description(
        title=f"Design for {settings.subject.name!r} ({settings.subject.task}), model {settings.model_name()}, goal "
        f"{settings.goal}: {settings.trials} trial{'' if settings.trials == 1 else 's'} of {settings.duration:g} s, "
        f"RMS of at most {settings.force:g} N and {1e3 * settings.displacement:g} mm per axis",
        facts=(
            f"geometric mean of the SEM of *: {design.factor:.2f} of the thesis's {LAWS[settings.noise]}, as from "
            f"{design.factor**-2:.1f} times as many trials; {design.factors[other]:.2f} {LAWS[other]}",
        ),
        table=Table(("parameter", "value", "unit", *errors.values(), "ratio", "between trials"), tuple(rows)),
        remarks=remarks,
        details=tuple(details),
    )


def _signals(design: Design) -> list[tuple[str, Signal]]:
    signals = zip(LOOKS, (design.thesis, design.optimised, design.proposed), strict=True)
    return [(name, signal) for name, signal in signals if signal is not None]


LEAST_TICKS = 4
"""On an axis, where the range has as many round numbers."""


@in_style()
def plot_design(design: Design, figure: Figure | None = None) -> Any:
    """Standard errors against duration and number of trials, and the spectra, of both signals; see `Design.plot`."""
    settings, duration = design.settings, design.settings.duration
    columns = [design.names.index(name) for name in settings.wanted()]
    known = bool(design.truth[columns].all())
    figure = figure_for(figure, 5.2)
    axes = figure.subplots(2, 2, sharey="row")
    (against_duration, against_trials), (on_x, on_y) = axes
    # A perturbation that is compared lasts as long as it lasts.
    lasting = {name: signal.duration for name, signal in _signals(design)}
    durations = np.geomspace(min(*lasting.values(), PERIOD + SETTLING), LONGEST * max(lasting.values()), 100)
    trials = np.arange(1.0, LONGEST * settings.trials + 1.0)
    lengths = np.array([effective_duration(length) for length in durations])
    for name, signal in _signals(design):
        size = np.abs(design.truth[columns]) / 100.0 if known else 1.0
        length = effective_duration(lasting[name])
        of_a_second = signal.standard_error[settings.noise][columns] / size * np.sqrt(settings.trials * length)
        for ax, steps, seconds, planned_step in (
            (against_duration, durations, settings.trials * lengths, lasting[name]),
            (against_trials, trials, trials * length, settings.trials),
        ):
            for errors in of_a_second:
                ax.plot(steps, errors / np.sqrt(seconds), linewidth=0.6, alpha=0.4, **LOOKS[name])
            mean = float(np.exp(np.mean(np.log(of_a_second))))
            ax.plot(steps, mean / np.sqrt(seconds), linewidth=2.0, label=name, **LOOKS[name])
            ax.plot(planned_step, mean / np.sqrt(settings.trials * length), "o", **LOOKS[name])
    against_duration.set_xlabel(f"duration [s], {settings.trials} trial{'' if settings.trials == 1 else 's'}")
    of_others = ", ".join(f"{name} of {value:g} s" for name, value in lasting.items() if value != duration)
    against_trials.set_xlabel(f"trials of {duration:g} s{of_others and f', {of_others}'}")
    against_duration.set_ylabel("SEM [% of the value]" if known else "SEM [SI]")
    for ax in (against_duration, against_trials):
        ax.set(xscale="log", yscale="log")
        ax.xaxis.set_minor_locator(NullLocator())
        _label_decades(ax)
    against_duration.set_xticks(*_ticks(durations))
    against_trials.set_xticks(*_ticks(trials))
    for column, (ax, axis) in enumerate(((on_x, "x"), (on_y, "y"))):
        for name, signal in _signals(design):
            _spectrum(ax, signal, column, **LOOKS[name])
        ax.set(xscale="log", yscale="log", xlabel=f"frequency [Hz], {axis}")
        _label_decades(ax)
        ax.set_xticks([0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    on_x.set_ylabel("RMS force of a line [N]")
    handles, labels = against_duration.get_legend_handles_labels()
    figure.suptitle(
        f"{settings.subject.name!r}, goal {settings.goal}: geometric mean (thick) and each SEM, "
        f"{design.factor:.2f} of the thesis's\n(noise {NOISE[settings.noise]})",
        fontsize=9,
        parse_math=False,
    )
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return axes


def _ticks(values: Array) -> tuple[list[float], list[str]]:
    for digits in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):  # more of them where few decades are shown
        steps = [step * 10.0**power for power in range(4) for step in digits]
        inside = [step for step in steps if values[0] <= step <= values[-1]]
        if len(inside) >= LEAST_TICKS:
            break
    return inside, [f"{step:g}" for step in inside]


def _label_decades(ax: Axes) -> None:
    """Plain numbers, also where an axis spans less than a decade."""
    low, high = ax.get_ylim()
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 30.0 * low else (1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_locator(NullLocator())


def _spectrum(ax: Axes, signal: Signal, column: int, color: str) -> None:
    power = signal.power[:, column]
    shown = power > LEAST_SHOWN * power.max()
    ax.plot(signal.frequency[shown], np.sqrt(power[shown]), ".", markersize=3.5, color=color)


def write_design(design: Design, folder: Path) -> None:
    """Write tables, figure, settings, and one perturbation per trial that `simulate` plays.

    Args:
      design: what was planned.
      folder: is made if it is not there; files of an earlier plan in it are replaced.

    Raises:
      ValueError: as `earlier_perturbations`.
      OSError: a file cannot be written.
    """
    old = earlier_perturbations(folder)
    tables, figures, perturbations = (folder / name for name in ("tables", "figures", PERTURBATIONS))
    for path in (tables, figures, perturbations):
        path.mkdir(parents=True, exist_ok=True)
    _write_settings(design, folder / SETTINGS)  # first: from then on, what follows is known as that of a plan
    write_csv(design.to_frame(), tables / "design.csv")
    write_csv(design.spectrum_frame(), tables / "spectrum.csv")
    write_csv(design.signal_frame(), tables / "signals.csv")
    new = [perturbations / f"trial_{number:02d}.csv" for number in range(1, len(design.perturbations) + 1)]
    for path, perturbation in zip(new, design.perturbations, strict=True):
        save_perturbation(perturbation, path, perturbation.rate)
    save_plot(design, figures / "design.svg")
    for path in set(old) - set(new):  # of a plan with more trials
        require_no_input(path)
        path.unlink()


def earlier_perturbations(folder: Path) -> list[Path]:
    """Perturbations of an earlier plan in a folder, which a new plan replaces.

    Raises:
      ValueError: there are some, and no plan that they are of.
    """
    earlier = sorted((folder / PERTURBATIONS).glob("trial_*.csv"))
    settings = folder / SETTINGS
    is_ours = settings.is_file() and OF_A_PLAN in settings.read_bytes()[:LARGEST_SETTINGS]
    if earlier and not is_ours:
        raise ValueError(f"{earlier[0]}: is of no earlier plan, as {settings} is none's; expected another folder")
    return earlier


def _write_settings(design: Design, path: Path) -> None:
    settings = design.settings
    asked = {**asdict(replace(settings, perturbation=None)), "model": settings.model_name()}
    if settings.perturbation is not None:
        asked["perturbation"] = {"duration": settings.perturbation.duration}
    made = {
        "versions": {name: importlib.metadata.version(name) for name in ("armperturb", "numpy", "scipy")},
        "settings": asked,
        "period": settings.period,
        "start": settings.start,
        "factor": design.factor,
        "factor_noise_held": design.factors["held"],
        "factor_noise_follows": design.factors["follows"],
        "excess": design.excess,
        "remarks": describe(design).remarks,
    }
    write_whole(path, json.dumps(made, indent=1, ensure_ascii=False) + "\n")
