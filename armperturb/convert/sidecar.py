"""The sidecar: a JSON file that says what the columns of a laboratory's file mean (docs/recordings.md)."""

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Self

import numpy as np

from armperturb.arrays import Array
from armperturb.convert.fields import LONGEST_TEXT, MEANINGS, Fields
from armperturb.convert.tables import TABLES
from armperturb.convert.units import UNITS, factor_to, quantity
from armperturb.files import require_input
from armperturb.recording import (
    ACTIONS,
    JOINTS_OF_MUSCLES,
    LABELS,
    LARGEST_HIGHPASS,
    LONGEST_LEAD,
    ONE_AXIS_SIGNALS,
    SERVOS,
    SIGNALS,
    TEXT_COORDINATES,
    TRIAL_COORDINATES,
    Action,
    HighPass,
    required_signals,
    signal_unit,
)
from armperturb.subject import TASKS
from armperturb.validation import require_number

LARGEST = 2**20
"""Largest sidecar [byte]."""

OPEN = "?"
"""In the place of a value that a person has to fill in."""

DIRECTIONS: Mapping[str, Sequence[float]] = TABLES["directions"]
"""Where an axis of the laboratory can point, in ours: x = right, y = forward."""

BODIES = {"handle": 1.0, "hand": -1.0}
"""Which body exerts the force on the other: ours is the handle's on the hand."""

FIRST = "first"
"""The handle's start is where its first sample is."""

REQUIRED_LABELS = ("subject", "task")

_RANGES: Mapping[str, tuple[float, float]] = TABLES["ranges"]
"""What labels of people can be, in our units: beyond it is a slip, or another unit."""


class Dialect(NamedTuple):
    """How a text file is written.

    Attributes:
      delimiter: between the fields of a line.
      decimal: point or comma of a number.
      skip_lines: number of lines above the names of the columns.
    """

    delimiter: str = ","
    decimal: str = "."
    skip_lines: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Signal:
    """Where a signal stands in the file, and what turns it into ours.

    Attributes:
      channels: component, e.g. "x", to the channel that holds it, in the order of our components.
      unit: as the file has it.
      ours: SI unit of the recording.
      matrix: ours = (values - start) @ matrix, (component, component): units, axes and sign.
      start: handle's start in the file's unit and axes, (component,), or "first".
      rate: sampling rate of this signal, if it is not that of the others [Hz].
      file: name of the text file that holds it, if it is not that of the others: beside the sidecar or, with "*" for
        the data file's name without its ending, beside that.
      dialect: of that file; None for that of the data file.
      lead: of EMG: by how much the other signals are later than it; negative where it is later [s].
      highpass: of EMG: that of its amplifier; None if nobody knows it.
      muscles: of EMG: what each muscle does.
    """

    channels: Mapping[str, str]
    unit: str
    ours: str
    matrix: Array
    start: tuple[float, ...] | str
    rate: float | None
    file: str | None
    dialect: Dialect | None = None
    lead: float = 0.0
    highpass: HighPass | None = None
    muscles: Mapping[str, Action] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Sidecar:
    """What the columns of a file mean.

    Attributes:
      path: where it stands.
      rate: sampling rate [Hz]; None if only the times, or the file itself, tell.
      time: channel of the times, and the factor that turns them into seconds; None without.
      trial: channel that numbers the trials; None if the file holds one, or has a dimension of its own for them.
      signals: variable of a recording to where it stands.
      labels: of all trials, in our units.
      trials: name of a trial to labels of its own; empty if all are alike.
      mass: that the manipulator was set to [kg]; None if unknown.
      servo: what the device of a recording of one axis does, see `recording.SERVOS`; None with two axes.
      joint: of a recording of one axis; None if unknown.
      dialect: of a text file.
      repairs: of what was exported to the file.
      notes: that fields are guesses which nobody has confirmed, if there are any.
    """

    path: Path
    rate: float | None
    time: tuple[str, float] | None
    trial: str | None
    signals: Mapping[str, Signal]
    labels: Mapping[str, Any]
    trials: Mapping[str, Mapping[str, Any]]
    mass: float | None
    servo: str | None
    joint: str | None
    dialect: Dialect
    repairs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @classmethod
    def load(cls, path: str | Path, without: Collection[str] = ()) -> Self:
        """Read a sidecar; raises as `of`.

        Args:
          path: of the file.
          without: signals that are not wanted, whatever is said of them.

        Raises:
          OSError: it cannot be read.
        """
        content = _parsed(Path(path))
        if without and isinstance(content, dict):
            for field, prefix in (("signals", ""), ("guessed", "signals.")):
                of_field = content.get(field)
                if isinstance(of_field, dict):
                    unwanted = tuple(f"{prefix}{name}" for name in without)
                    content[field] = {
                        name: value
                        for name, value in of_field.items()
                        if not any(name == each or name.startswith(f"{each}.") for each in unwanted)
                    }
        return cls.of(content, Path(path))

    @classmethod
    def of(cls, content: object, path: Path) -> Self:
        """The sidecar that JSON stands for.

        Args:
          content: of the file.
          path: of the file, for messages.

        Raises:
          TypeError: a field has the wrong type.
          ValueError: it is no JSON, a field is unknown, missing or out of its range; the message names file, field,
            value and what was expected.
        """
        top = Fields(content, str(path), "")
        kind = "servo" if "servo" in top else "axes"  # a recording of one axis has no directions
        known = ("rate", "time", "trial", kind, "signals", "labels", "trials", "environment", "csv", "guessed")
        top.require_only((*known, "repairs"), (kind, "signals", "labels"))
        guessed = top.fields("guessed")
        _require_closed(top, {name: guessed.text(name) for name in guessed})
        rate, time, mass = top.rate("rate"), None, None
        if "time" in top:
            of_time = top.fields("time", ("channel", "unit"), ("channel", "unit"))
            time = of_time.text("channel"), factor_to("s", of_time["unit"], of_time.where("unit"))
        servo = top.choice("servo", SERVOS) if "servo" in top else None
        known_signals = SIGNALS if servo is None else ONE_AXIS_SIGNALS
        of_signals = top.fields("signals", known_signals, required_signals(servo))
        axes = _axes(top) if servo is None else None
        of_path = of_signals.fields("displacement")
        angular = servo is not None and "unit" in of_path and of_path["unit"] not in [*UNITS["m"], OPEN]
        signals = {
            name: _signal(of_signals.fields(name), name, axes, angular) for name in known_signals if name in of_signals
        }
        owners: dict[str, str] = {}
        for name, signal in signals.items():
            for channel in signal.channels.values():
                if channel in owners:
                    raise ValueError(
                        f"{of_signals.where(name)}.channels has {channel!r}, as {owners[channel]} has; expected a "
                        "channel for each"
                    )
                owners[channel] = name
        of_trials = top.fields("trials")
        if "trials" in top and not of_trials:
            raise ValueError(f"{path}: trials is empty; expected labels of each trial, or no such field")
        if "environment" in top:
            of_environment = top.fields("environment", ("m_env",), ("m_env",))
            mass = quantity(of_environment["m_env"], "kg m^2" if angular else "kg", of_environment.where("m_env"))
            require_number(str(path), "environment.m_env", mass, above=0.0, at_most=1e3)
        of_labels = top.fields("labels")
        joint = of_labels.text("joint") if servo is not None and "joint" in of_labels else None
        of_labels = of_labels.without("joint") if joint is not None else of_labels
        unconfirmed = f"{path}: guesses that nobody has confirmed: {', '.join(guessed)}"
        return cls(
            path=path,
            rate=rate,
            time=time,
            trial=top.text("trial") if "trial" in top else None,
            signals=signals,
            labels=_labels(of_labels),
            trials={name: _labels(of_trials.fields(name)) for name in of_trials},
            mass=mass,
            servo=servo,
            joint=joint,
            dialect=_dialect(top.fields("csv", Dialect._fields)),
            repairs=_repairs(top),
            notes=(f"{unconfirmed} (delete what you have checked from guessed)",) if guessed else (),
        )

    def labels_of(self, trial: str) -> dict[str, Any]:
        """Labels of a trial, those that all trials have included.

        Raises:
          ValueError: it is not among `trials`, or lacks a label.
        """
        if self.trials and trial not in self.trials:
            known = ", ".join(map(repr, list(self.trials)[:8]))
            raise ValueError(f"{self.path}: trials has no {trial!r}; expected labels of each trial, it has {known}")
        labels = {**self.labels, **self.trials.get(trial, {})}
        for name in REQUIRED_LABELS:
            if name not in labels:
                raise ValueError(
                    f"{self.path}: labels.{name} is missing for trial {trial!r}; expected {MEANINGS[name]}"
                )
        if labels.get("pulse_level", 0.0) != 0.0 and "pulse_onset" not in labels:
            raise ValueError(
                f"{self.path}: pulse_level = {labels['pulse_level']:g} without pulse_onset for trial {trial!r}; "
                "expected when the pulse begins"
            )
        return labels


def _parsed(path: Path) -> object:
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: no such file, or a folder; expected the sidecar, which says what the channels mean (`armperturb "
            "sidecar FILE` writes one)"
        )
    require_input(path, LARGEST)

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content: dict[str, Any] = {}
        for name, value in pairs:
            if name in content:
                raise ValueError(f"the field {name!r:.60} comes twice")
            content[name] = value
        return content

    def refuse(text: str) -> NoReturn:
        raise ValueError(f"{text} is no number of JSON")

    try:
        return json.loads(path.read_bytes().decode("utf-8-sig"), object_pairs_hook=once, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: no readable JSON ({error}); expected a sidecar") from None


def _require_closed(fields: Fields, checks: Mapping[str, str]) -> None:
    """Refuse a template in which something is still to be filled in."""
    left = [place for place, value in _leaves(fields) if value == OPEN]
    if left:
        more = f" (and {len(left) - 1} more fields are open: {', '.join(left[1:])})" if len(left) > 1 else ""
        expected = checks.get(left[0], "a value in its place")
        raise ValueError(f"{fields.file}: {left[0]} = {OPEN!r} is left open; expected {expected}{more:.200}")


def _leaves(content: Mapping[str, Any], place: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in content.items():
        where = f"{place}{name if name.isprintable() else ascii(name)}"
        if isinstance(value, dict) and name != "guessed" and where.count(".") < 4:  # deeper, there are no fields
            yield from _leaves(value, f"{where}.")
        else:
            yield where, value


def _axes(fields: Fields) -> Array:
    """Directions of the laboratory's x and y in our axes, (lab's axis, our axis)."""
    of_axes = fields.fields("axes", ("x", "y"), ("x", "y"))
    directions = np.array([DIRECTIONS[of_axes.choice(name, DIRECTIONS)] for name in ("x", "y")])
    if abs(np.linalg.det(directions)) < 0.5:
        raise ValueError(
            f"{of_axes.where('y')} = {of_axes['y']!r} beside x = {of_axes['x']!r}; expected a direction across it"
        )
    return directions


def _signal(fields: Fields, name: str, axes: Array | None, angular: bool) -> Signal:
    """A signal; without directions of axes it has a single component."""
    dims, ours = SIGNALS[name][0], signal_unit(name, angular=angular)
    single = axes is None and dims[1] == "axis"
    known = [field for field in TABLES["fields"][name] if axes is not None or field != "axes"]
    fields.require_only(known, [field for field in known if field in ("channels", "unit", "exerted_by")])
    if name == "emg":  # any muscles
        of_channels = fields.fields("channels")
        components = tuple(of_channels)
        if not components or not all(0 < len(each) <= LONGEST_TEXT and each.isprintable() for each in components):
            raise ValueError(f"{fields.where('channels')} = {dict(of_channels)!r:.60}; expected muscle to channel")
    else:
        components = LABELS[dims[1]][:1] if single else LABELS[dims[1]]
        of_channels = fields.fields("channels", components, components)
    channels = {component: of_channels.text(component) for component in components}
    for component, channel in channels.items():
        if list(channels.values()).count(channel) > 1:
            raise ValueError(f"{of_channels.where(component)} = {channel!r} twice; expected a channel for each")
    matrix = np.eye(len(components)) * factor_to(ours, fields["unit"], fields.where("unit"))
    if "axes" in known and axes is not None:
        matrix = matrix @ (_axes(fields) if "axes" in fields else axes)
    if name == "force":
        matrix = matrix * BODIES[fields.choice("exerted_by", BODIES)]
    return Signal(
        channels=channels,
        unit=fields["unit"],
        ours=ours,
        matrix=matrix,
        start=_start(fields, components) if "start" in fields else (0.0,) * len(components),
        rate=fields.rate("rate"),
        file=_file(fields) if "file" in fields else None,
        dialect=_dialect(fields.fields("csv", Dialect._fields)) if "csv" in fields else None,
        lead=_lead(fields),
        highpass=_highpass(fields) if "highpass" in fields else None,
        muscles=_muscles(fields, components) if name == "emg" else None,
    )


def _lead(fields: Fields) -> float:
    if "lead" not in fields:
        return 0.0
    lead = quantity(fields["lead"], "s", fields.where("lead"))
    require_number(fields.file, fields.place_of("lead"), lead, at_least=-LONGEST_LEAD, at_most=LONGEST_LEAD)
    return lead


def _highpass(of_signal: Fields) -> HighPass:
    fields = of_signal.fields("highpass", HighPass._fields, HighPass._fields)
    frequency = quantity(fields["frequency"], "Hz", fields.where("frequency"))
    largest = LARGEST_HIGHPASS
    require_number(fields.file, fields.place_of("frequency"), frequency, above=0.0, at_most=largest.frequency)
    order = fields["order"]
    require_number(fields.file, fields.place_of("order"), order, at_least=1, at_most=largest.order, whole=True)
    return HighPass(frequency, order)


def _muscles(fields: Fields, names: Sequence[str]) -> dict[str, Action]:
    """What each muscle does: as the sidecar says, or as its name does."""
    said = fields.fields("muscles")
    for name in said:
        if name not in names:
            raise ValueError(f"{said.where(name)}: unknown muscle; expected one of channels: {', '.join(names)}")
    actions = {}
    for name in names:
        if name not in said:
            actions[name] = ACTIONS.get(name, Action("", 0))
            continue
        of_muscle = said.fields(name, Action._fields, Action._fields)
        joints = of_muscle.choice("joints", JOINTS_OF_MUSCLES)
        if of_muscle["sign"] not in (-1, 0, 1):
            raise ValueError(
                f"{of_muscle.where('sign')} = {of_muscle['sign']!r:.60}; expected 1 (flexes), -1 (extends) or 0"
            )
        actions[name] = Action(joints, int(of_muscle["sign"]))
    return actions


def _file(fields: Fields) -> str:
    name = fields.text("file")
    if Path(name).name != name or "rate" not in fields:
        raise ValueError(
            f"{fields.where('file')} = {name!r}; expected the name of a file, without a folder, and a rate"
        )
    return name


def _start(fields: Fields, components: tuple[str, ...]) -> tuple[float, ...] | str:
    value = fields["start"]
    if value == FIRST:
        return FIRST
    if not isinstance(value, list) or len(value) != len(components):
        place = f"[{', '.join(components)}]"
        raise ValueError(f"{fields.where('start')} = {value!r:.60}; expected 'first', or {place} in the signal's unit")
    for coordinate in value:
        require_number(fields.file, fields.place_of("start"), coordinate, at_least=-1e6, at_most=1e6)
    return tuple(map(float, value))


def _labels(fields: Fields) -> dict[str, Any]:
    """Labels that are there; null is as good as none."""
    fields.require_only(tuple(TRIAL_COORDINATES))
    labels: dict[str, Any] = {}
    for name, value in fields.items():
        if value is None:
            continue
        if name == "task":
            labels[name] = fields.choice(name, TASKS)
        elif name in TEXT_COORDINATES:
            labels[name] = fields.text(name)
        else:
            unit = "deg" if name.endswith("_deg") else TRIAL_COORDINATES[name][0]
            number = quantity(value, unit, fields.where(name))
            lower, upper = _RANGES[name]
            if not lower <= number <= upper:
                raise ValueError(f"{fields.where(name)} = {value!r}; expected {lower:g} to {upper:g} {unit}".rstrip())
            is_whole = name in ("repetition", "order")
            if is_whole and number != int(number):
                raise ValueError(f"{fields.where(name)} = {value!r}; expected a whole number")
            labels[name] = int(number) if is_whole else number
    return labels


def _repairs(fields: Fields) -> tuple[str, ...]:
    repairs = fields.get("repairs", [])
    if not isinstance(repairs, list) or not all(isinstance(repair, str) for repair in repairs):
        raise TypeError(f"{fields.where('repairs')} = {repairs!r:.60}; expected a list of texts, as convert writes it")
    return tuple(repairs)


def _dialect(fields: Fields) -> Dialect:
    delimiter = fields.choice("delimiter", (",", ";", "\t", " "), ",")
    decimal = fields.choice("decimal", (".", ","), ".")
    if decimal == delimiter:
        raise ValueError(f"{fields.where('decimal')} = {decimal!r} as the delimiter; expected another one")
    skip = fields.get("skip_lines", 0)
    if isinstance(skip, bool) or not isinstance(skip, int) or not 0 <= skip <= 1000:
        raise ValueError(f"{fields.where('skip_lines')} = {skip!r:.60}; expected a whole number of 0 to 1000")
    return Dialect(delimiter, decimal, skip)
