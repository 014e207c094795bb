"""What a validation found, for people and for other programs: text, tables, one figure, and how they were made."""

import importlib.metadata
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from armperturb.analysis.fit.truth import departures
from armperturb.analysis.results import Description, Table, plain
from armperturb.files import write_csv, write_whole
from armperturb.plots.style import GREY, INK, PUBLISHED, figure_for, in_style, save_plot
from armperturb.study.validation.validate import Validation

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
        f"noise x {settings.noise:g}" if settings.noise != 1.0 else "",
        f"force {settings.force:g} N" if settings.force is not None else "",
        f"wrong: {settings.wrong}" if settings.wrong != "nothing" else "",
    ]
    return ", ".join(filter(None, parts))


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def describe(validation: Validation) -> Description:
    """Errors in percent of the true value, or in its unit where that is zero, and how the fits went."""
    frame = validation.to_frame()
    header = ["parameter", "true", "bound"]
    for name in validation.judged:
        header += [f"{name}: bias", "RMS", "held"]
    rows = []
    for _, of_parameter in frame.groupby("parameter", sort=False):
        blocks = of_parameter.to_dict("records")
        first = blocks[0]
        scale, percent = (100.0 / abs(first["true"]), " %") if first["true"] else (1.0, "")
        true = f"{first['true']:.4g} {first['unit']}"
        cells = [first["parameter"], true, plain(scale * first["bound"], 3) + percent]
        for row in blocks:  # one for each estimator
            numbers = plain(scale * row["bias"], 3), plain(row["rms_error_over_bound"], 3)
            cells += [*numbers, f"{row['coverage_percent']:.0f}"]
        rows.append(tuple(cells))
    columns = [f"{share}_percent" for share in ("converged", "stable", "global", "coverage", "flagged")]
    shares = validation.estimators_frame().set_index("estimator")[columns]
    texts = shares.map(lambda share: f"{share:.1f} %" if math.isfinite(share) else "-")
    heads = ("estimator", "converged", "stable", "global", "held", "flagged")
    summary = Table(heads, tuple(texts.itertuples(name=None)))
    return Description(
        title=f"Validation: {title(validation)}",
        facts=(
            "bias in % of the true value; bound: Cramer-Rao, from the whole records; RMS error over the bound; held: "
            "share of the 95 % intervals that hold the true value [%]",
        ),
        table=Table(tuple(header), tuple(rows)),
        remarks=departures(validation.settings.structure(), validation.settings.truth()),
        details=(*summary.lines(), "flagged: the estimator itself reports a lack of fit"),
    )


@in_style()
def plot_validation(validation: Validation, figure: Figure | None = None) -> Any:
    """RMS error over the Cramer-Rao bound per parameter, with 95 % intervals; see `Validation.plot`."""
    names, estimators = validation.names, list(validation.judged)
    rows = validation.to_frame().to_dict("records")
    figure = figure_for(figure, 1.35 + ROW * len(names))
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
    figure.suptitle(title(validation), fontsize=9, parse_math=False)
    figure.legend(loc="outside lower center", ncols=len(estimators))
    ax.text(1.0, 1.005, "bound", transform=ax.get_xaxis_transform(), ha="center", va="bottom", fontsize=8, color=GREY)
    return ax


def _label(row: dict[str, Any]) -> str:
    """Parameter, true value, and the bound beside it."""
    if not row["true"]:
        return f"{row['parameter']} = 0 ± {row['bound']:.2g} {row['unit']}"
    return (
        f"{row['parameter']} = {row['true']:.4g} {row['unit']} ± {plain(100.0 * row['bound'] / abs(row['true']), 3)} %"
    )


def write_validation(validation: Validation, folder: Path) -> None:
    """Write tables, figure and settings.

    Args:
      validation: what was found.
      folder: is made if it is not there; files of an earlier validation in it are replaced.

    Raises:
      OSError: a file cannot be written.
    """
    settings, tables, figures = validation.settings, folder / "tables", folder / "figures"
    for path in (tables, figures):
        path.mkdir(parents=True, exist_ok=True)
    write_csv(validation.to_frame(), tables / "validation.csv")
    write_csv(validation.estimators_frame(), tables / "validation_summary.csv")
    save_plot(validation, figures / "validation.svg")
    made = {
        "versions": {name: importlib.metadata.version(name) for name in ("armperturb", "mujoco", "numpy", "scipy")},
        "settings": {**asdict(settings), "subject": settings.subject and str(settings.subject)},
        "truth": asdict(settings.truth()),
        "remarks": departures(settings.structure(), settings.truth()),
    }
    write_whole(folder / "settings.json", json.dumps(made, indent=1, ensure_ascii=False) + "\n")
