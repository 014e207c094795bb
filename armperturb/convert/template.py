"""Writes the sidecar of a file as far as names and numbers allow, with every guess marked for a person to check."""

import json
import math
from collections.abc import Mapping, Sequence
from functools import reduce
from itertools import product
from operator import getitem
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from armperturb.analysis.force_balance import Balance
from armperturb.convert.checks import AWAY, LARGEST_FORCE
from armperturb.convert.columns import WORD, Column, axis_of, columns_of, dialect_of
from armperturb.convert.emg_template import add_emg, is_emg, unused
from armperturb.convert.fields import MEANINGS
from armperturb.convert.importer import import_trials
from armperturb.convert.one_axis_template import is_one_axis, one_axis_fields, pairs_of_one_axis, settled_one_axis
from armperturb.convert.raw import trial_name
from armperturb.convert.reading import ARRAYS, C3D, TEXT, read_trials
from armperturb.convert.sidecar import BODIES, FIRST, OPEN, REQUIRED_LABELS, Dialect, Sidecar
from armperturb.convert.tables import TABLES, Repair
from armperturb.convert.units import UNITS
from armperturb.environment import Environment
from armperturb.files import write_whole
from armperturb.recording import ARM_LABELS, REQUIRED_SIGNALS, SIGNALS, TEXT_COORDINATES, TRIAL_COORDINATES
from armperturb.subject import POSITION
from armperturb.validation import require_number, require_one_of

ROLES: Mapping[str, str] = TABLES["roles"]
"""Signal to words of names that stand for it, in the order in which they decide; a bare x or y is displacement."""

WORDS: Mapping[str, Sequence[str]] = TABLES["words"]
"""Field of a sidecar to words of names that stand for it."""

MOVEMENT = (0.003, 0.5)
"""Between which the handle's path usually extends [m]."""

OF_ONE_AXIS = (
    "no signal was recognised, and this sidecar is one of two axes: a recording of one axis (angle and torque of a "
    "joint) has another, with servo in place of axes and only x, which is written where columns are named angle and "
    "torque or displacement and force (docs/recordings.md)"
)
"""Said where no name shows what the signals are."""

IMPOSED = "a device that imposes movement in two axes is not supported; along one it is (servo: position, only x)"
"""Said where force and movement have two axes, and nothing is left that may perturb."""

CHECKS = {field: f"{MEANINGS[field]} ({origin})" for field, origin in TABLES["origins"].items()}
"""Field that has to be filled in to what it means, and why its value is a guess."""


class SidecarTemplate(NamedTuple):
    """A sidecar that was written.

    Attributes:
      path: of the sidecar.
      notes: what was guessed, what is left open and what was checked, a line each.
    """

    path: Path
    notes: tuple[str, ...]


def write_sidecar(file: str | Path, out: str | Path | None = None, *, rate: float | None = None) -> SidecarTemplate:
    """Write a sidecar for a file: names, units, axes and labels as far as they can be guessed.

    What no name and number shows is marked in the sidecar's field `guessed`, or left open as "?". Unit of displacement
    and sign of force are those with which perturbation, force and displacement obey physics, if there are such.

    Args:
      file: CSV (.csv, .tsv, .txt), MATLAB (.mat), NumPy (.npz) or C3D; of one axis where no signal has a second.
      out: path of the sidecar; by default beside the file, of the same name with the ending .json.
      rate: sampling rate [Hz], of a file without times.

    Returns:
      The path of the sidecar, and what is to be checked in it.

    Raises:
      FileExistsError: the sidecar exists already.
      ValueError: the file is damaged, too large, or has an unknown ending; the rate is not from 1 to 1e6 Hz.
      ModuleNotFoundError: C3D is to be read, and ezc3d is not installed.
      OSError: a file cannot be read or written.
    """
    require_number("sidecar", "rate", rate, at_least=1.0, at_most=1e6, optional=True)
    path = Path(file)
    target = path.with_suffix(".json") if out is None else Path(out)
    require_one_of(str(path), "ending", path.suffix.lower(), (*TEXT, *ARRAYS, *C3D))
    if target.exists():
        raise FileExistsError(f"{target} exists; expected a new file (sidecars are never overwritten; choose --out)")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file, or a folder; expected a recording")
    dialect = dialect_of(path) if path.suffix.lower() in TEXT else Dialect()
    columns = columns_of(path, dialect)
    others = [column for column in columns if not is_emg(column)]
    content, guessed, said = _guess(path, others, dialect, rate)
    settle = settled_one_axis if "servo" in content else _settled
    notes = settle(path, target, content, guessed, others)
    add_emg([column for column in columns if is_emg(column)], others, content, guessed)
    notes = [*unused(columns, content), *notes]
    content["guessed"] = guessed
    write_whole(target, json.dumps(content, indent=2, ensure_ascii=False) + "\n")
    marked = []
    for field, text in guessed.items():
        value: Any = reduce(getitem, field.split("."), content)
        what = "is left open" if value == OPEN else "is a guess"
        marked.append(f"{field} = {json.dumps(value, ensure_ascii=False)} {what}: {text}")
    return SidecarTemplate(target, (*marked, *said, *notes))


# What it means.


def _is_rate_of_structure(column: Column) -> bool:
    """Whether a number is the rate in a structure, and not that of EMG or of a filter."""
    others = {"filter", *WORDS["emg"]}
    field = column._replace(label=column.label.rpartition(".")[2]).words()[0]
    return len(column.values) == 1 and " ".join(field) in WORDS["rate"] and not {*column.words()[0]} & others


def _guess(
    path: Path, columns: Sequence[Column], dialect: Dialect, rate: float | None
) -> tuple[dict[str, Any], dict[str, str], list[str]]:
    """The sidecar, what to check in it: field to text, and notes for the reader."""
    content: dict[str, Any] = {} if rate is None else {"rate": rate}
    guessed: dict[str, str] = {}
    pairs: dict[str, dict[tuple[str, ...], dict[str, Column]]] = {name: {} for name in REQUIRED_SIGNALS}
    singles: list[Column] = []
    labels: dict[str, NDArray[Any]] = {}
    trial: NDArray[Any] | None = None
    for column in columns:
        words, unit = column.words()
        name = " ".join(words)
        label = TABLES["aliases"].get(name, name.replace(" ", "_"))
        label = f"{label}_{unit}" if f"{label}_{unit}" in TRIAL_COORDINATES else label
        if column.channel.lower() in TRIAL_COORDINATES or label in TRIAL_COORDINATES:
            labels[label if label in TRIAL_COORDINATES else column.channel.lower()] = column.values
        elif column.values.dtype.kind not in "fiu":
            continue
        elif name in WORDS["rate"] and len(column.values) == 1 and "rate" not in content:
            content["rate"] = float(column.values[0])
        elif words and words[-1] in WORDS["time"] and "time" not in content:
            content["time"] = {"channel": column.channel, "unit": unit}
            if unit not in UNITS["s"]:
                content["time"]["unit"] = _unit_of_times(column.values)
                guessed["time.unit"] = "from the steps of the times"
        elif name in WORDS["trial"] and trial is None:
            trial, content["trial"] = column.values, column.channel
        else:
            singles.append(column)
            stem, axis = axis_of(words)
            roles = (role for role, known in ROLES.items() if {*stem} & {*known.split()})
            role = next(roles, None if stem else "displacement")
            if axis is not None and role is not None:
                pairs[role].setdefault(stem, {}).setdefault(axis, column)
    if "time" not in content and "rate" not in content and not any(column.rate for column in columns):
        content = {"rate": OPEN, **content}
        guessed = {"rate": "the sampling rate in Hz, or instead of it the field time", **guessed}
        in_structures = [column for column in columns if _is_rate_of_structure(column)]
        if len(in_structures) == 1:
            content["rate"] = float(in_structures[0].values[0])
            guessed["rate"] = f"the sampling rate in Hz, that of {in_structures[0].channel}"
    said: list[str] = []
    has_axes = any(len(pair) == 2 for stems in pairs.values() for pair in stems.values())
    if not has_axes and (paired := pairs_of_one_axis(singles)):
        has_axes = True
        for name, (first, second) in paired.items():
            pairs[name] = {(): {"x": first, "y": second}}
            guessed[f"signals.{name}.channels"] = "two channels may hold it: which is x, which y? (by their order)"
        each = ", ".join(f"{first.channel} and {second.channel}" for first, second in paired.values())
        said.append(
            f"each signal has two channels that may hold it ({each}): they are taken for two axes; a recording of one "
            "axis has servo in place of axes and one channel of each (docs/recordings.md)"
        )
    if not has_axes and is_one_axis(singles):
        content |= one_axis_fields(path, singles, guessed)
        _add_labels(path, labels, trial, content, guessed, of_arm=False)
        if dialect != Dialect():
            content["csv"] = dialect._asdict()
        return content, guessed, said
    if not has_axes:
        said.append(OF_ONE_AXIS)
    content["axes"], guessed["axes"] = {"x": "right", "y": "forward"}, CHECKS["axes"]
    complete = {name: [pair for pair in stems.values() if len(pair) == 2] for name, stems in pairs.items()}
    taken = {each.channel for of_signal in complete.values() for pair in of_signal[:1] for each in pair.values()}
    others = ", ".join(column.channel for column in singles if column.channel not in taken)
    content["signals"] = {name: _signal(name, of_signal, others, guessed) for name, of_signal in complete.items()}
    if complete["force"] and complete["displacement"] and not complete["perturbation"]:
        said.append(f"no channels of a perturbation in x and y were recognised: {IMPOSED}, see docs/recordings.md")
    _add_labels(path, labels, trial, content, guessed)
    if dialect != Dialect():
        content["csv"] = dialect._asdict()
    return content, guessed, said


def _unit_of_times(times: NDArray[Any]) -> str:
    """Unit in which steps make 10 Hz to 100 kHz; s before ms before us."""
    step = float(np.median(np.abs(np.diff(times)))) if len(times) > 1 else 0.0
    return next((unit for unit in ("s", "ms", "us") if 1e-5 <= step * UNITS["s"][unit] <= 0.1), "s")


def _signal(name: str, pairs: Sequence[Mapping[str, Column]], others: str, guessed: dict[str, str]) -> dict[str, Any]:
    field, ours = f"signals.{name}", SIGNALS[name][1]
    signal: dict[str, Any] = {"channels": dict.fromkeys("xy", OPEN), "unit": ours}
    if name == "force":
        signal["exerted_by"] = "handle"
    if not pairs:
        for axis in "xy":
            which = f"one of: {others}" if others else "for which no column is left"
            which += f" ({IMPOSED})" if name == "perturbation" and not others else ""
            guessed[f"{field}.channels.{axis}"] = f"the channel of {SIGNALS[name][2]}, {which}"[:190]
        return signal
    pair = pairs[0]
    signal["channels"] = {axis: pair[axis].channel for axis in "xy"}
    if len(pairs) > 1:
        guessed[f"{field}.channels"] = f"or {', '.join(p[axis].channel for p in pairs[1:] for axis in 'xy')}"[:190]
    values = np.stack([pair[axis].values for axis in "xy"])
    low, high = np.nanmin(values, axis=1), np.nanmax(values, axis=1)
    unit = pair["x"].words()[1]
    if unit in UNITS[ours]:
        signal["unit"] = unit
    else:
        signal["unit"] = _movement_units(low, high)[0] if ours == "m" else "N" if high.max() < LARGEST_FORCE else "mN"
        guessed[f"{field}.unit"] = "from the size of its values"
    if ours == "m" and (np.maximum(low, -high) > np.maximum(AWAY / UNITS["m"][signal["unit"]], high - low)).any():
        signal["start"] = FIRST
        guessed[f"{field}.start"] = "the values are places, so that the path begins at the first sample of each trial"
    return signal


def _movement_units(low: NDArray[Any], high: NDArray[Any]) -> list[str]:
    """Units in which a path is as long as paths are; metres if there is none."""
    size = float((high - low).max())
    return [u for u in ("m", "mm", "cm") if MOVEMENT[0] <= size * UNITS["m"][u] <= MOVEMENT[1]] or ["m"]


def _add_labels(
    path: Path,
    labels: Mapping[str, NDArray[Any]],
    numbers: NDArray[Any] | None,
    content: dict[str, Any],
    guessed: dict[str, str],
    *,
    of_arm: bool = True,
) -> None:
    """Labels that columns hold, of all trials or of each, and guesses of those that are needed besides."""

    def plain(name: str, value: Any) -> Any:
        if name in TEXT_COORDINATES:
            return f"{value:g}" if isinstance(value, float) else str(value)
        return None if value != value else value  # NaN

    lists = {name: values.tolist() for name, values in labels.items()}
    constant = {name: plain(name, values[0]) for name, values in lists.items() if len(set(values)) == 1}
    varying = {name: values for name, values in lists.items() if name not in constant}
    is_relaxed = {word.lower() for word in WORD.findall(path.stem)} & {*WORDS["relaxed"]}
    defaults: dict[str, Any] = {"subject": "S01", "task": "RT" if is_relaxed else "PT"}
    of_body = ARM_LABELS if of_arm else ()
    defaults |= {name: getattr(POSITION, name) for name in of_body}
    for name in (*REQUIRED_LABELS, *of_body):
        if name not in labels:
            guessed[f"labels.{name}"] = CHECKS[name]
    content["labels"] = content.get("labels", {}) | {
        name: constant.get(name, value) for name, value in defaults.items() if name not in varying
    }
    content["labels"] |= constant
    if varying and numbers is not None:
        firsts = {number: int(np.argmax(numbers == number)) for number in dict.fromkeys(numbers.tolist())}
        content["trials"] = {
            trial_name(number): {name: plain(name, values[at]) for name, values in varying.items()}
            for number, at in firsts.items()
        }


# What physics says.


def _settled(
    path: Path, target: Path, content: dict[str, Any], guessed: dict[str, str], columns: Sequence[Column]
) -> list[str]:
    """Unit of displacement and sign of force with which the file obeys physics, put into the sidecar; notes on it."""
    force, displacement = content["signals"]["force"], content["signals"]["displacement"]
    try:
        raw = read_trials(path, Sidecar.of(content, target))
    except ValueError as error:
        guessed["signals.force.exerted_by"] = CHECKS["exerted_by"]
        return [f"units and signs are unchecked: {error}"]
    units = [displacement["unit"]]
    if "signals.displacement.unit" in guessed:
        of_path = [column.values for column in columns if column.channel in displacement["channels"].values()]
        units = _movement_units(*(np.array([f(values) for values in of_path]) for f in (np.nanmin, np.nanmax)))
    rates = {column.rate for column in columns if column.rate}
    rate = min(rates) if len(rates) > 1 else None
    refused, passed = [], []
    for unit, body in product(units, BODIES):
        displacement["unit"], force["exerted_by"] = unit, body
        try:
            recording, notes = import_trials([(path, Sidecar.of(content, target), raw)], get_args(Repair), rate)
        except ValueError as error:
            refused.append(f"{error}")
            continue
        if not any("unchecked" in note for note in notes):
            d, f, x = (recording[name].values for name in REQUIRED_SIGNALS)
            mass = Balance(d, f, x, recording.attrs["rate"]).fit()[0].m_env
            note = f"physics agrees: the force of the {body} and displacement in {unit} move a mass of {mass:.3g} kg"
            passed.append((abs(math.log(mass / Environment().m_env)), unit, body, note))
    if passed:
        _, displacement["unit"], force["exerted_by"], note = min(passed)
        return [note]
    displacement["unit"], force["exerted_by"] = units[0], "handle"
    guessed["signals.force.exerted_by"] = CHECKS["exerted_by"]
    return [f"units and signs are unchecked{f': as guessed, {refused[0]}' if refused else ''}"]
