"""What a validation found, for people and for other programs: text, tables, one figure, and how they were made."""

import importlib.metadata
import json
import math
from dataclasses import asdict
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from armperturb.files import write_csv, write_durably
from armperturb.plots.style import GREY, INK, PUBLISHED, in_style, new_figure, save_svg
from armperturb.study.validation.validate import Row, Validation

LOOKS = {
    "thesis": {"color": PUBLISHED["color"], "marker": "s"},
    "frequency": {"color": "#E69F00", "marker": "o"},
    "record": {"color": INK, "marker": "D"},
}
"""Colour and marker of each estimator."""

NAMES = {
    "thesis": "thesis, trial by trial",
    "frequency": "likelihood, mean periods",
    "record": "likelihood, whole records",
}
"""What each estimator is called in the figure."""

ROW = 0.24
"""Height of a parameter in the figure [inch]."""


def title(validation: Validation) -> str:
    """What was done, in one line."""
    settings, truth = validation.settings, validation.settings.truth()
    parts = [
        f"{truth.name!r} ({truth.task})",
        f"model {settings.model}",
        f"{_counted(settings.groups, 'group')} of {_counted(settings.trials, 'trial')}",
        "MuJoCo's arm" if settings.multibody else "linear arm",
    ]
    if settings.noise != 1.0:
        parts.append(f"noise x {settings.noise:g}")
    if settings.force is not None:
        parts.append(f"force {settings.force:g} N")
    if settings.wrong != "nothing":
        parts.append(f"wrong: {settings.wrong}")
    return ", ".join(parts)


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def summary_text(validation: Validation) -> str:
    """The tables for a terminal: errors in percent of the true value, or in its unit where that is zero."""
    estimators = list(validation.judged)
    rows = validation.rows()
    blocks = {name: [row for row in rows if row["estimator"] == name] for name in estimators}
    lines = [title(validation), "", f"{'':9}{'':16}{'':>9}" + "".join(f"  | {name:^26}" for name in estimators)]
    head = f"{'bias':>7} {'RMS':>6} {'/bound':>6} {'held':>4}"
    lines.append(f"{'parameter':9}{'true':>16}{'bound':>9}" + f"  | {head}" * len(estimators))
    for of_parameter in zip(*blocks.values(), strict=True):
        first = of_parameter[0]
        scale = 100.0 / abs(first["true"]) if first["true"] else 1.0
        percent = " %" if first["true"] else ""
        line = (
            f"{first['parameter']:9}{first['true']:8.4g} {first['unit']:7}{_three(scale * first['bound']) + percent:>9}"
        )
        for row in of_parameter:
            bias, rms = (_three(scale * row[name]) for name in ("bias", "rms_error"))
            ratio, held = _three(row["rms_error_over_bound"]), row["coverage_percent"]
            line += f"  | {bias:>7} {rms:>6} {ratio:>6} {held:4.0f}"
        lines.append(line)
    lines += [
        "bias, RMS error in % of the true value; bound: Cramer-Rao, of all that the trials hold;",
        "held: share of the 95 % intervals that hold the true value [%]",
        "",
        f"{'estimator':9} {'converged':>9} {'stable':>8} {'global':>8} {'held':>8} {'flagged':>8}",
    ]
    for row in validation.summary():
        shares = [row[f"{name}_percent"] for name in ("converged", "stable", "global", "coverage", "flagged")]
        cells = [f"{'-' if math.isnan(share) else format(share, '.1f') + ' %':>8}" for share in shares]
        lines.append(f"{row['estimator']:9} {cells[0]:>9} {' '.join(cells[1:])}")
    lines.append("flagged: the estimator itself says that the structure is wrong")
    return "\n".join(lines)


def _three(value: float) -> str:
    """A number with about three digits that count, never in powers of ten below a million."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:.0f}"
    return f"{value:.{min(2, max(0, 2 - math.floor(math.log10(abs(value)))))}f}"


@in_style()
def error_figure(validation: Validation) -> Figure:
    """RMS error over the Cramer-Rao bound per parameter, estimators side by side, with 95 % intervals."""
    names, estimators = validation.names, list(validation.judged)
    rows = validation.rows()
    figure = new_figure(1.35 + ROW * len(names))
    ax = figure.subplots()
    ax.axvline(1.0, color=INK, linewidth=1.0, zorder=1.5)
    for number, estimator in enumerate(estimators):
        mine = [row for row in rows if row["estimator"] == estimator]
        ratio = [row["rms_error_over_bound"] for row in mine]
        low, high = ([row[f"rms_error_over_bound_{end}"] for row in mine] for end in ("low", "high"))
        place = [index + 0.22 * (number - (len(estimators) - 1) / 2) for index in range(len(names))]
        look = LOOKS[estimator]
        ax.hlines(place, low, high, color=look["color"], linewidth=1.1)
        ax.plot(ratio, place, linestyle="none", label=NAMES[estimator], **look)
    for index in range(len(names) - 1):
        ax.axhline(index + 0.5, color="#e6e8eb", linewidth=0.7, zorder=0.5)
    ax.set_xscale("log")
    least, most = ax.get_xlim()
    ax.set_xlim(min(least, 0.5), max(most, 2.0))
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.set_yticks(range(len(names)), [_label(row) for row in rows[: len(names)]])
    ax.tick_params(axis="y", length=0)
    ax.grid(False, axis="y")
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    if most < 10.0:
        ax.set_xticks([0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0])
        ax.set_xlim(min(least, 0.5), max(most, 2.0))
        ax.xaxis.set_minor_locator(NullLocator())
    ax.set_xlabel("RMS error over Cramér-Rao bound, with 95 % interval (names: true value ± bound)")
    figure.suptitle(title(validation), fontsize=9)
    figure.legend(loc="outside lower center", ncols=len(estimators))
    ax.text(1.0, 1.005, "bound", transform=ax.get_xaxis_transform(), ha="center", va="bottom", fontsize=8, color=GREY)
    return figure


def _label(row: Row) -> str:
    """Parameter, true value, and the bound beside it."""
    if not row["true"]:
        return f"{row['parameter']} = 0 ± {row['bound']:.2g} {row['unit']}"
    return f"{row['parameter']} = {row['true']:.4g} {row['unit']} ± {_three(100.0 * row['bound'] / abs(row['true']))} %"


def write_validation(validation: Validation, folder: Path) -> None:
    """Write tables, figure and settings.

    Args:
      validation: what was found.
      folder: is made if it is not there; files of an earlier validation in it are replaced.

    Raises:
      OSError: a file cannot be written.
    """
    tables, figures = folder / "tables", folder / "figures"
    for one in (tables, figures):
        one.mkdir(parents=True, exist_ok=True)
    settings = validation.settings
    write_csv(validation.rows(), tables / "validation.csv")
    write_csv(validation.summary(), tables / "validation_summary.csv")
    save_svg(error_figure(validation), figures / "validation.svg")
    made = {
        "versions": {name: importlib.metadata.version(name) for name in ("armperturb", "mujoco", "numpy", "scipy")},
        "settings": {**asdict(settings), "subject": settings.subject and str(settings.subject)},
        "truth": asdict(settings.truth()),
    }
    write_durably(folder / "settings.json", (json.dumps(made, indent=1, ensure_ascii=False) + "\n").encode())
