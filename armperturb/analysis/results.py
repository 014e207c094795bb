"""What every result of an analysis can do: describe itself in a terminal and in a notebook, and become a table.

A result derives from `Result` and says what it is in `describe`; from that come `repr` (at most 25 lines), `summary()`
and the HTML of notebooks. Results of parametric fits derive from `FitResult`, which adds confidence intervals, one
schema of parameter tables (`PARAMETER_COLUMNS`) and a plot.

Numbers that do not exist are NaN in tables and "nan" in files. Where the data say nothing about a parameter, its
standard error is infinite and its interval reaches from minus to plus infinity ("inf" and "-inf" in files).
"""

import functools
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats
from scipy.sparse.csgraph import connected_components

from armperturb.arrays import Array, ComplexArray
from armperturb.recording import LABELS
from armperturb.validation import require_one_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

LINES, WIDTH = 25, 110
"""Most lines of a result's `repr`, and characters in a line."""

MOST_FACTS = 11
"""How many of these are above its table."""

PARAMETER_COLUMNS = (
    "parameter", "value", "standard_error", "lower_95", "upper_95", "unit", "at_bound", "condition",
    "subject",
)  # fmt: skip
"""Columns of every table of estimated parameters; that of a single joint has `joint` after them."""


class Interval(NamedTuple):
    """A confidence interval, in the unit of the parameter."""

    lower: float
    upper: float


class Table(NamedTuple):
    """A table as text: the first column is aligned to the left, the others to the right."""

    columns: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()

    def lines(self, most: int | None = None) -> list[str]:
        """The table for a terminal, header first; none of a table without rows.

        Args:
          most: characters in a line, beyond which the last columns are left out.
        """
        if not self.rows:
            return []
        widths = [max(map(len, column)) for column in zip(self.columns, *self.rows, strict=True)]
        ends = np.cumsum(widths) + 2 * np.arange(len(widths))
        if most is not None and len(widths) > 1 and ends[-1] > most:
            n = max(int(np.sum(ends <= most - len("  ..."))), 1)
            part = Table((*self.columns[:n], "..."), tuple((*row[:n], "...") for row in self.rows))
            return part.lines()
        padded = [str.ljust, *[str.rjust] * (len(widths) - 1)]
        return [
            "  ".join(pad(cell, width) for pad, cell, width in zip(padded, row, widths, strict=True))
            for row in (self.columns, *self.rows)
        ]


NO_TABLE = Table()


@dataclass(frozen=True, kw_only=True)
class Description:
    """What there is to say of a result.

    Attributes:
      title: what it is, of whom, in which condition and from how many trials.
      facts: further lines: how it was found, how well it fits.
      table: its numbers.
      remarks: what a reader must know before trusting them, a sentence each.
      details: further lines that only `Result.summary` prints.
    """

    title: str
    facts: tuple[str, ...] = ()
    table: Table = NO_TABLE
    remarks: tuple[str, ...] = ()
    details: tuple[str, ...] = ()


class Result:
    """A result that a person can read: subclasses say what they are in `describe`.

    Dataclasses must be declared with `repr=False`, or they would print all their fields.
    """

    def describe(self) -> Description:
        """What there is to say of the result."""
        raise NotImplementedError

    def summary(self) -> str:
        """The whole result as text for a terminal."""
        said = self.describe()
        blocks = ([said.title, *said.facts], said.table.lines(), _remarks(said.remarks), list(said.details))
        return "\n\n".join("\n".join(block) for block in blocks if block)

    def __repr__(self) -> str:
        said = self.describe()
        head, remarks = _wrapped([said.title, *said.facts]), _wrapped(_remarks(said.remarks))
        if len(head) > MOST_FACTS:
            head = [*head[: MOST_FACTS - 1], f"... {len(head) - MOST_FACTS + 1} more lines in summary()"]
        table = _shortened(said.table.lines(WIDTH), max(LINES - len(head) - min(len(remarks), 5), 3))
        left = LINES - len(head) - len(table)
        if len(remarks) > left:
            remarks = [*remarks[: max(left - 1, 0)], "  ... summary() has the rest"]
        return "\n".join([*head, *table, *remarks])

    def _repr_html_(self) -> str:
        said = self.describe()
        parts = [f"<p><strong>{escape(said.title)}</strong>{''.join(f'<br>{escape(fact)}' for fact in said.facts)}</p>"]
        if said.table.rows:
            head = _row("th", said.table.columns)
            rows = "".join(_row("td", row) for row in said.table.rows)
            parts.append(f"<table><thead>{head}</thead><tbody>{rows}</tbody></table>")
        if said.remarks:
            parts.append(f"<ul>{''.join(f'<li>{escape(remark)}</li>' for remark in said.remarks)}</ul>")
        return f"<div>{''.join(parts)}</div>"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FitResult(Result):
    """Parameters that were estimated from recordings.

    Attributes:
      values: name to the estimate of each free parameter, in its unit.
      standard_error: of each estimate, in its unit; infinite where the data say nothing.
      correlation: of the estimates' errors, (parameter, parameter), in the order of `values`; NaN where unknown.
      at_bound: free parameters that sit on a bound; their errors are not normal.
      converged: whether the search ended at an optimum.
      message: how the search ended, in words.
      remarks: what a reader must know before trusting the values, a sentence each.
      degrees_of_freedom: of Student's t for the interval of a parameter; those not named have normal ones.
    """

    values: Mapping[str, float]
    standard_error: Mapping[str, float]
    correlation: Array
    at_bound: tuple[str, ...]
    converged: bool
    message: str
    remarks: tuple[str, ...]
    degrees_of_freedom: Mapping[str, float] = field(default_factory=dict)

    def interval(self, name: str, level: float = 0.95) -> Interval:
        """Confidence interval of a free parameter, from its standard error.

        Args:
          name: of the parameter, as in `values`.
          level: probability with which such intervals hold the true value [-].

        Raises:
          ValueError: there is no such parameter, or level is no probability.
        """
        require_one_of("interval", "name", name, list(self.values))
        half = quantile(level, self.degrees_of_freedom.get(name, math.inf)) * self.standard_error[name]
        return Interval(self.values[name] - half, self.values[name] + half)

    def unit_of(self, name: str) -> str:
        """Unit of a parameter; "-" if it has none."""
        raise NotImplementedError

    def place_of(self, name: str) -> tuple[str, str]:
        """Name of a parameter in tables, and the condition in which it holds; "" where it is not known."""
        return name, ""

    @property
    def labels(self) -> Mapping[str, str]:
        """Last columns of `to_frame`: the subject, "" where it is not known, and further names that there are."""
        return {"subject": ""}

    def to_frame(self) -> pd.DataFrame:
        """One row per free parameter, with its 95 % confidence interval; the columns are `PARAMETER_COLUMNS`."""
        rows = []
        for name, value in self.values.items():
            parameter, condition = self.place_of(name)
            limits, is_at_bound = self.interval(name), name in self.at_bound
            rows.append(
                (parameter, value, self.standard_error[name], *limits, self.unit_of(name), is_at_bound, condition)
            )
        return pd.DataFrame(rows, columns=list(PARAMETER_COLUMNS[:-1])).assign(**self.labels)

    def correlation_frame(self) -> pd.DataFrame:
        """Correlation of the estimates' errors, one row and one column per parameter."""
        return pd.DataFrame(self.correlation, index=list(self.values), columns=list(self.values))

    def to_xarray(self) -> "xr.Dataset":
        """Estimate, standard error and 95 % interval, (parameter,), and `correlation` of errors, (parameter, other).

        Units differ between parameters: `unit` holds each one's, (parameter,).
        """
        import xarray as xr

        names, frame = list(self.values), self.to_frame()
        columns = ("value", "standard_error", "lower_95", "upper_95", "at_bound")
        variables: dict[str, Any] = {name: ("parameter", frame[name]) for name in columns}
        variables["correlation"] = ("parameter", "other"), self.correlation, {"units": "1"}
        coords = {"parameter": names, "other": names, "unit": ("parameter", frame["unit"])}
        return xr.Dataset(variables, coords, dict(self.labels))

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the estimates with their 95 % intervals, one panel per unit, conditions side by side.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (unit,).
        """
        from armperturb.plots.parameters import plot_parameters

        by_condition = self.to_frame().groupby("condition", sort=False)
        return plot_parameters({str(label) or "all conditions": frame for label, frame in by_condition}, figure)


@functools.lru_cache(maxsize=1024)
def quantile(level: float, dof: float = math.inf) -> float:
    """Half a confidence interval over the standard error of a variable that has Student's t distribution [-].

    Args:
      level: probability with which such intervals hold the truth [-].
      dof: degrees of freedom; with infinitely many, the variable is normal.

    Raises:
      ValueError: the level is no probability.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"interval: level = {level!r}; expected a probability between 0 and 1, e.g. 0.95")
    return float(stats.norm.ppf(0.5 + level / 2.0) if math.isinf(dof) else stats.t.ppf(0.5 + level / 2.0, dof))


def parameter_table(frame: pd.DataFrame, *keys: str) -> Table:
    """Table as text of parameters and their 95 % intervals.

    Args:
      frame: with the columns of `PARAMETER_COLUMNS`.
      *keys: further columns to show, such as the condition.
    """
    rows = []
    for row in frame.to_dict("records"):
        limits = row["lower_95"], row["upper_95"]
        unknown = "not known" if np.isnan(limits).any() else "not identifiable"
        interval = plain_limits(*limits) if np.isfinite(limits).all() else unknown
        mark = " (bound)" if row["at_bound"] else ""
        keyed = tuple(str(row[key]) for key in keys)
        rows.append((row["parameter"], plain(row["value"]), interval + mark, row["unit"], *keyed))
    return Table(("parameter", "estimate", "95 % interval", "unit", *keys), tuple(rows))


def response_frame(frequency: Array, response: ComplexArray) -> pd.DataFrame:
    """One row per frequency, output and input of a frequency response.

    Args:
      frequency: [Hz], (frequency,).
      response: [m/N], (frequency, output, input).
    """
    keys = pd.MultiIndex.from_product([frequency, *2 * [LABELS["axis"]]], names=["frequency_hz", "output", "input"])
    flat = np.asarray(response).ravel()
    gain, phase = np.hypot(flat.real, flat.imag), np.degrees(np.angle(flat))
    return keys.to_frame(index=False).assign(real=flat.real, imag=flat.imag, gain_m_per_N=gain, phase_deg=phase)


def response_coordinates(frequency: Array) -> dict[str, Any]:
    """Coordinates of what lies along frequency, output and input."""
    axes = list(LABELS["axis"])
    return {"frequency": ("frequency", frequency, {"units": "Hz"}), "output": axes, "input": axes}


def plain(value: float, digits: int = 4) -> str:
    """A number with about so many significant digits, and without an exponent from a ten thousandth to a million."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    power = math.floor(math.log10(abs(value)))
    return f"{value:.{max(0, digits - 1 - power)}f}" if -5 < power < 6 else f"{value:.{digits - 1}e}"


def plain_limits(lower: float, upper: float, digits: int = 4) -> str:
    """Both limits of an interval with about so many significant digits, or more if its width shows only then."""
    digits = digits_within(lower, upper, digits)
    return f"{plain(lower, digits)} to {plain(upper, digits)}"


def digits_within(lower: float, upper: float, digits: int = 4) -> int:
    """So many significant digits, or as many as show the width of an interval."""
    if not (lower < upper and math.isfinite(upper - lower)):
        return digits
    power, of_width = (math.floor(math.log10(each)) for each in (max(abs(lower), abs(upper)), upper - lower))
    return max(digits, power - of_width + 2)


def _wrapped(lines: Iterable[str]) -> list[str]:
    return [part for line in lines for part in textwrap.wrap(line, WIDTH, subsequent_indent="  ") or [""]]


def _remarks(remarks: Sequence[str]) -> list[str]:
    return ["Remarks:", *(f"- {remark}" for remark in remarks)] if remarks else []


def _shortened(lines: list[str], most: int) -> list[str]:
    """A table in two columns of rows if it is too long, and without its last rows if that does not suffice."""
    if len(lines) <= most:
        return lines
    half = len(lines) // 2  # of the rows, rounded up
    if 2 * len(lines[0]) + 3 <= WIDTH:
        header, rows = lines[0], lines[1:]
        right = [*rows[half:], ""][:half]
        lines = [f"{header} | {header}", *(f"{a} | {b}".rstrip() for a, b in zip(rows[:half], right, strict=True))]
    if len(lines) <= most:
        return lines
    return [*lines[: most - 1], f"... {len(lines) - most + 1} more lines in summary()"]


def _row(tag: str, cells: Sequence[str]) -> str:
    """A row of an HTML table."""
    sides = ["left", *["right"] * (len(cells) - 1)]
    styled = (
        f'<{tag} style="text-align:{side};padding:0 0.6em">{escape(cell)}</{tag}>'
        for side, cell in zip(sides, cells, strict=True)
    )
    return f"<tr>{''.join(styled)}</tr>"


UNCERTAIN, ALIKE = 0.5, 0.95
"""Limits beyond which a remark is made: relative standard error, error correlation [-]."""


def limits_of(fit: FitResult) -> tuple[str, ...]:
    """What the trials do not tell of the parameters: a sentence for each limit, of all parameters that share it.

    Parameters of a fit of several conditions, "k_s [PT2.5]", are named condition by condition.
    """
    unknown, poor = [], []
    for name, error in fit.standard_error.items():
        value = fit.values[name]
        if error == np.inf:
            unknown.append((name, ""))
        elif error > UNCERTAIN * abs(value):
            # At a bound of 0 rounding can leave 1e-17, of which a relative error says nothing.
            shown = value if abs(value) > 1e-9 * error else 0.0
            relative = f", relative s.e. {error / abs(shown):.0%}" if shown else ""
            poor.append((name, f"{shown:.3g} +/- {error:.2g}{relative}"))
    return (
        *_of_each_condition([(name, "") for name in fit.at_bound], "sits on a bound", "sit on a bound"),
        *_of_each_condition(unknown, "is not identifiable from these trials", "are not identifiable from these trials"),
        *_of_each_condition(poor, "is poorly determined", "are poorly determined"),
        *inseparable(list(fit.values), fit.correlation),
    )


def _of_each_condition(names: Sequence[tuple[str, str]], of_one: str, of_several: str) -> list[str]:
    """What holds for parameters, which come with a detail or "": a sentence for those of each condition."""
    by_condition: dict[str, list[tuple[str, str]]] = {}
    for name, detail in names:
        by_condition.setdefault(name.partition(" [")[2], []).append((name, detail))
    said = []
    for together in by_condition.values():
        if len(together) == 1:
            ((name, detail),) = together
            said.append(f"{name} {of_one}{f' ({detail})' if detail else ''}")
        elif together[0][1]:
            listed = ", ".join(f"{name} ({detail})" for name, detail in together)
            said.append(f"{len(together)} parameters {of_several}: {listed}")
        else:
            said.append(f"{_enumerated([name for name, _ in together])} {of_several}")
    return said


def _enumerated(names: Sequence[str]) -> str:
    """Two or more names as a sentence has them."""
    return f"{', '.join(names[:-1])} and {names[-1]}"


def inseparable(names: Sequence[str], correlation: Array) -> list[str]:
    """Which parameters are not separately identifiable: a sentence for each group that correlations connect."""
    connected = np.abs(correlation) > ALIKE
    n_groups, group_of = connected_components(connected, directed=False)
    said = []
    for group in range(n_groups):
        of_group = np.flatnonzero(group_of == group)
        if len(of_group) < 2:
            continue
        r = correlation[np.ix_(of_group, of_group)][np.triu_indices(len(of_group), 1)]
        largest = float(r[np.nanargmax(np.abs(r))])
        how = f"error correlation r = {largest:.2f}" if len(r) == 1 else f"largest error correlation r = {largest:.2f}"
        together = _enumerated([names[index] for index in of_group.tolist()])
        said.append(f"{together} are not separately identifiable ({how})")
    return said
