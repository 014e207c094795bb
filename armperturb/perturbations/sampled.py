"""A perturbation from samples, and the CSV file that holds them."""

import csv
import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from armperturb.files import require_input, written_whole
from armperturb.perturbations.perturbation import MAX_DURATION, Perturbation, sample_times
from armperturb.validation import require_number, require_type

COLUMNS = ("time_s", "d_x_N", "d_y_N")
"""Columns of a perturbation file: time from the start [s], force to the right and forward [N]."""

STEP_TOLERANCE = 1e-3
"""How far a time step may be off the others, as a share of it [-]: rounding passes, a jitter that matters does not."""

LARGEST = 2**25
"""Largest file [byte]: an hour at 200 Hz takes less."""

INSIGNIFICANT_SHARE = 0.005
"""Share of the power that may lie above the highest significant frequency [-]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled:
    """A force known at uniform times from 0, in between on a quintic spline.

    The spline goes through the samples and is off by less than 0.1 % of the amplitude for sinusoids of up to a fifth
    of the rate (40 Hz at 200 Hz, where straight lines lose up to 19 %), except in the first and last few steps, which
    have samples on one side only. After the last sample its value is held for one step.

    Attributes:
      force: force [N], (sample, axis), at least 2 samples. Stored as a read-only copy.
      rate: samples per second [Hz], > 0.

    Raises:
      TypeError: rate is not a number.
      ValueError: rate or a force is not finite, rate is not positive, or the force has the wrong shape.
    """

    force: np.ndarray = field(repr=False)
    rate: float

    def __post_init__(self) -> None:
        require_number("Sampled", "rate", self.rate, above=0.0)
        force = np.array(self.force, dtype=float)
        if force.ndim != 2 or force.shape[0] < 2 or force.shape[1] != 2:
            raise ValueError(f"Sampled: force of shape {force.shape}; expected (n, 2) with at least 2 samples")
        bad = np.argwhere(~np.isfinite(force))
        if len(bad):
            sample, axis = bad[0]
            raise ValueError(f"Sampled: force[{sample}, {axis}] = {force[sample, axis]}; expected a finite number")
        force.flags.writeable = False
        object.__setattr__(self, "force", force)

    @property
    def duration(self) -> float:
        """Time until one step after the last sample [s]."""
        return len(self.force) / self.rate

    @cached_property
    def highest_frequency(self) -> float:
        """Lowest frequency [Hz] with at most 0.5 % of the power above it, means removed; 0 for a constant force."""
        n_samples = len(self.force)
        power = np.sum(np.abs(np.fft.rfft(self.force - self.force.mean(axis=0), axis=0)) ** 2, axis=1)
        power[0] = 0.0
        power[1 : (n_samples + 1) // 2] *= 2.0  # all but the Nyquist frequency stand for two
        above = np.append(np.cumsum(power[:0:-1])[::-1], 0.0)  # above[i]: what lies above the frequency i
        lowest = np.argmax(above <= INSIGNIFICANT_SHARE * power.sum())
        return float(np.fft.rfftfreq(n_samples, 1.0 / self.rate)[lowest])

    @cached_property
    def _spline(self) -> BSpline:
        """Force [N] as a function of time in samples; of lower degree if there are fewer than 6 samples."""
        # The degree must be odd for an interpolation whose knots are the samples.
        degree = min(5, (len(self.force) - 2) // 2 * 2 + 1)
        return make_interp_spline(np.arange(len(self.force), dtype=float), self.force, k=degree)

    def sample(self, rate: float, n_samples: int, start: float = 0.0) -> np.ndarray:
        """Force [N] at the times start + k / rate, zero outside [0, duration), (n_samples, axis)."""
        position = sample_times(rate, n_samples, start) * self.rate
        nearest = np.rint(position)
        # Rounding of the times must not change a sample, least of all lose the first or double the last.
        position = np.where(np.abs(position - nearest) < 1e-9 * np.maximum(1.0, np.abs(nearest)), nearest, position)
        inside = (position >= 0.0) & (position < len(self.force))
        on_sample = inside & (position == nearest)
        between = inside & ~on_sample
        force = np.zeros((n_samples, 2))
        force[on_sample] = self.force[nearest[on_sample].astype(int)]
        if between.any():
            force[between] = self._spline(np.minimum(position[between], len(self.force) - 1))
        return force


def save_perturbation(perturbation: Perturbation, path: str | Path, rate: float) -> None:
    """Write a perturbation to a file that `load_perturbation` reads back exactly.

    Args:
      perturbation: what to write, from time 0 to the end of its duration.
      path: the file, which is overwritten.
      rate: samples per second [Hz], > 0.

    Raises:
      TypeError: perturbation is no `Perturbation`, or rate no number.
      ValueError: rate is not positive or gives fewer than 2 samples.
      OSError: the file cannot be written.
    """
    require_type("save_perturbation", perturbation, Perturbation, "a perturbation, e.g. Multisine or Pulse")
    require_number("save_perturbation", "rate", rate, above=0.0)
    n_samples = math.ceil(perturbation.duration * rate * (1.0 - 1e-12))
    if n_samples < 2:
        raise ValueError(f"save_perturbation: rate = {rate:g} Hz gives {n_samples} sample; expected at least 2")
    force = perturbation.sample(rate, n_samples)
    with written_whole(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows((k / rate, x, y) for k, (x, y) in enumerate(force.tolist()))


def load_perturbation(path: str | Path) -> Sampled:
    """Read a perturbation from a file with the columns time_s, d_x_N and d_y_N, in any order, at any uniform rate.

    Args:
      path: a comma-separated UTF-8 file, its first line the names of the columns, times from 0.

    Raises:
      ValueError: the file is not as described; the message names file, line, value and what was expected.
      OSError: the file cannot be read.
    """
    values, line_numbers = _read_numbers(path)
    return Sampled(force=values[:, 1:], rate=_uniform_rate(path, values[:, 0], line_numbers))


def _read_numbers(path: str | Path) -> tuple[np.ndarray, list[int]]:
    """The columns in the order of `COLUMNS`, (row, 3), and the line of the file that each row stands on."""
    require_input(path, LARGEST)
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            lines = [(reader.line_num, row) for row in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: no readable text ({error}); expected a CSV file in UTF-8") from None
    while lines and not any(field.strip() for field in lines[-1][1]):
        lines.pop()
    expected = ",".join(COLUMNS)
    if not lines:
        raise ValueError(f"{path}: the file is empty; expected the columns {expected}")
    header = [name.strip() for name in lines[0][1]]
    wrong = [f"unknown column {name!r}" for name in header if name not in COLUMNS]
    wrong += [f"column {name!r} twice" for name in COLUMNS if header.count(name) > 1]
    wrong += [f"missing column {name!r}" for name in COLUMNS if name not in header]
    if wrong:
        raise ValueError(f"{path}, line {lines[0][0]}: {wrong[0]}; expected the columns {expected}")
    if len(lines) < 3:
        raise ValueError(f"{path}: rows = {len(lines) - 1}; expected at least 2 below the header")

    values = np.empty((len(lines) - 1, len(COLUMNS)))
    order = [COLUMNS.index(name) for name in header]
    for row, (line, texts) in enumerate(lines[1:]):
        if len(texts) != len(COLUMNS):
            raise ValueError(f"{path}, line {line}: {len(texts)} values; expected {len(COLUMNS)}")
        for column, text in zip(order, texts, strict=True):
            values[row, column] = _finite_number(f"{path}, line {line}: {COLUMNS[column]}", text)
    return values, [line for line, _ in lines[1:]]


def _finite_number(owner: str, text: str) -> float:
    """The number that a text stands for; `owner` is its place, for the message."""
    try:
        number = float(text) if "_" not in text else math.nan  # Python reads 1_0 as 10, nobody else does
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{owner} = {text!r}; expected a finite number")
    return number


def _uniform_rate(path: str | Path, times: np.ndarray, line_numbers: list[int]) -> float:
    """Rate [Hz] of times [s] (row,) that start at 0 and are uniform; `line_numbers` is for the message."""
    steps = np.diff(times)
    if (steps <= 0.0).any():
        row = int(np.argmax(steps <= 0.0)) + 1
        raise ValueError(
            f"{path}, line {line_numbers[row]}: time_s = {times[row]:.9g} after {times[row - 1]:.9g}; "
            "expected increasing times"
        )
    if times[-1] > MAX_DURATION:
        raise ValueError(
            f"{path}, line {line_numbers[-1]}: time_s = {times[-1]:.9g}; expected seconds, at most {MAX_DURATION:g}"
        )
    # The median, not the mean: a gap would move the mean and put the blame on every other step.
    usual = float(np.median(steps))
    if abs(times[0]) > STEP_TOLERANCE * usual:
        raise ValueError(f"{path}, line {line_numbers[0]}: time_s = {times[0]:.9g}; expected the first time to be 0")
    off = np.abs(steps - usual) > STEP_TOLERANCE * usual
    if off.any():
        row = int(np.argmax(off)) + 1
        raise ValueError(
            f"{path}, line {line_numbers[row]}: time step = {steps[row - 1]:.9g} s; expected {usual:.9g} s as in the "
            f"other lines, to {STEP_TOLERANCE:.1%} (uniform times, with enough decimals)"
        )
    rate = len(steps) / float(times[-1] - times[0])
    # Times are rounded: a whole rate that explains every one of them is the one that was meant.
    whole = float(round(rate))
    meant = whole > 0.0 and np.abs(times - np.arange(len(times)) / whole).max() <= STEP_TOLERANCE * usual
    return whole if meant else rate
