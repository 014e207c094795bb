"""The format of recordings: the signals of a set of trials, as an `xarray.Dataset`.

| variable | dims | unit | |
|---|---|---|---|
| `perturbation` | trial, time, axis | N | disturbance force d on the manipulator; absent if movement is imposed |
| `force` | trial, time, axis | N | reaction force f that the handle exerts on the hand |
| `displacement` | trial, time, axis | m | of the handle, from its start |
| `joint_angle` | trial, time, joint | rad | shoulder from the x axis, elbow from the humerus; may be absent |
| `shoulder_marker` | trial, time, axis | m | of the marker on the shoulder, from its start; may be absent |
| `scheduling` | trial, time, axis | m | slow movement on which stiffness depends, of one axis; may be absent |
| `emg` | trial, emg_time, muscle | V | of `MUSCLES` or any others; may be absent |

Axes are x = right, y = forward; the environment sees d - f, and admittance is displacement per f. A recording of one
axis, of a joint or a single direction, has the axis x alone; its signals are forces and displacements [N, m] or torques
and angles [Nm, rad], as their `units` and `quantity` say. Its attribute `servo` says what the device does: "force" is a
virtual environment that d perturbs, "position" imposes the movement, whoever holds it; its attribute `joint`, where
there is one, which joint moves. Along `trial` lie the coordinates of `TRIAL_COORDINATES`. `rate` [Hz] is an attribute
of the dataset, and `emg_rate` [Hz] where there is EMG; every variable has its `units`. Muscles that are not among
`MUSCLES` may say what they move in the coordinates `muscle_joints` ("s", "e" or "se") and `muscle_sign` (1 flexes, -1
extends, 0 unknown). If the other signals pass a filter that the EMG does not, its attribute `lead` [s] is the delay of
that filter; it is negative of EMG that is late. If they are known, its attributes `highpass` [Hz] and `highpass_order`
are those of its amplifier. On disk it is netCDF4. EMG is in single precision in memory; if its attribute `adc_step` [V]
says so, it holds whole numbers of that step, and the file holds the 16-bit counts with the step as `scale_factor` (CF
packing, which readers of netCDF undo).
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from armperturb.files import packaged_table
from armperturb.validation import require_name, require_one_of, require_type

_TABLES = packaged_table(__package__, "recording.toml")


class Action(NamedTuple):
    """What a muscle does in the horizontal plane.

    Attributes:
      joints: that it moves: "s" shoulder, "e" elbow, "se" both; "" if nobody knows.
      sign: 1 flexes, -1 extends; 0 if nobody knows.
    """

    joints: str
    sign: int


class HighPass(NamedTuple):
    """The high-pass of an EMG amplifier, which delays what it lets through.

    Attributes:
      frequency: its cut-off [Hz].
      order: of the Butterworth filter that it is or resembles; each adds 6 dB per octave.
    """

    frequency: float
    order: int


ACTIONS: Mapping[str, Action] = {name: Action(row["joints"], row["sign"]) for name, row in _TABLES["muscles"].items()}
"""Muscles whose EMG the thesis recorded (2.3), and what they do."""

MUSCLES: tuple[str, ...] = tuple(ACTIONS)

JOINTS_OF_MUSCLES = ("s", "e", "se", "")

LONGEST_LEAD = 0.1
"""Largest delay that the other signals may have against the EMG, or the EMG against these [s]."""

LARGEST_HIGHPASS = HighPass(500.0, 8)
"""Largest cut-off and order of an EMG amplifier's high-pass."""

SIGNALS: Mapping[str, tuple[tuple[str, str], str, str]] = {
    name: (tuple(dims), unit, description) for name, (dims, unit, description) in _TABLES["signals"].items()
}
"""Variable name to dimensions after trial, unit and description."""

REQUIRED_SIGNALS = ("perturbation", "force", "displacement")
OPTIONAL_SIGNALS = ("joint_angle", "shoulder_marker", "scheduling", "emg")
ONE_AXIS_SIGNALS = (*REQUIRED_SIGNALS, "scheduling", "emg")
"""Those that a recording of one axis can hold."""

ANGULAR: Mapping[str, str] = _TABLES["angular"]
"""Unit of a signal to that in a recording of torques and angles."""

QUANTITIES: Mapping[str, str] = _TABLES["quantities"]
"""Unit of a signal of one axis to its quantity."""

SERVOS = ("force", "position")
"""What the device of a recording of one axis does."""

LABELS = {"axis": ("x", "y"), "joint": ("shoulder", "elbow")}
"""Dimension to its labels; those of `muscle` are names of any muscles."""

CLOCK_PIECE = 2**18
"""Samples whose times are checked together."""

CLOCKS = {"time": "rate", "emg_time": "emg_rate"}
"""Dimension to the attribute that holds its sampling rate [Hz]."""

TRIAL_COORDINATES: Mapping[str, tuple[str, str]] = {name: tuple(row) for name, row in _TABLES["coordinates"].items()}
"""Coordinate along `trial` to unit and description."""

ARM_LABELS = ("l_h", "l_f", "theta_s_deg", "theta_e_deg")
"""Coordinates that only models of the arm need; NaN where they are unknown."""

OPTIONAL_COORDINATES = ("order",)
"""Those of `TRIAL_COORDINATES` that a recording may lack."""

EXPECTED = "a Dataset as load_recording or import_recording(...).recording give it"
"""What a recording is, for messages."""

TEXT_COORDINATES = ("subject", "task", "condition")


def is_one_axis(recording: xr.Dataset) -> bool:
    """Whether a recording is of one axis: of a joint, or of a single direction."""
    return recording.sizes.get("axis") == 1


def required_signals(servo: str | None) -> tuple[str, ...]:
    """What a recording must hold: without a perturbation where a position servo imposes the movement."""
    return REQUIRED_SIGNALS[1:] if servo == "position" else REQUIRED_SIGNALS


def signal_unit(name: str, *, angular: bool = False) -> str:
    """SI unit of a signal, in a recording of forces and displacements or of torques and angles."""
    unit = SIGNALS[name][1]
    return ANGULAR.get(unit, unit) if angular else unit


def make_recording(
    signals: Mapping[str, ArrayLike],
    trials: Mapping[str, ArrayLike],
    rate: float,
    *,
    emg_rate: float | None = None,
    adc_step: float | None = None,
    emg_lead: float = 0.0,
    emg_highpass: HighPass | None = None,
    muscles: Mapping[str, Action] | None = None,
    servo: str | None = None,
    joint: str | None = None,
    angular: bool | None = None,
    **attributes: Any,
) -> xr.Dataset:
    """A checked recording.

    Args:
      signals: variable name to values, (trial, time, axis), (trial, time, joint) or (trial, emg_time, muscle).
      trials: coordinate name to one value per trial. Of one axis, those of the arm (`ARM_LABELS`) may be absent.
      rate: sampling rate [Hz].
      emg_rate: sampling rate of the EMG [Hz], if there is any.
      adc_step: voltage of which the EMG holds whole numbers [V]; None if it holds any number.
      emg_lead: by how much the other signals are later than the EMG, as by the delay of a filter; negative where the
        EMG is later, as if sent by radio [s].
      emg_highpass: of the EMG's amplifier; None if nobody knows it.
      muscles: names of the EMG's columns, and what each does; those of `ACTIONS` if None.
      servo: what the device of a recording of one axis does, of `SERVOS`; None with two axes.
      joint: which joint a recording of one axis is of, e.g. "ankle"; None if unknown.
      angular: whether a recording of one axis holds torques and angles; None if it does where a joint is named.
      **attributes: further attributes of the dataset.

    Raises:
      TypeError: signals or trials are no mapping.
      ValueError: as `check_recording`.
    """
    for what, given in (("signals", signals), ("trials", trials)):
        require_type(f"recording: {what}", given, Mapping, "names with their values, as a dictionary")
    variables = {}
    angular = joint is not None if angular is None else angular
    for name, values in signals.items():
        dims, _, description = SIGNALS[name]
        units = signal_unit(name, angular=angular)
        # Half the memory for EMG, which is long and 16 bits deep; in the order of its file, as sums round otherwise.
        array = np.asarray(values, dtype=np.float32 if name == "emg" else float, order="C")
        quantity = {} if servo is None or "axis" not in dims else {"quantity": QUANTITIES[units]}
        variables[name] = (("trial", *dims), array, _describe(units, description) | quantity)
    if "emg" in variables:
        known = {"adc_step": adc_step, "lead": emg_lead or None}
        variables["emg"][2].update({name: float(value) for name, value in known.items() if value is not None})
        if emg_highpass is not None:
            frequency, order = emg_highpass
            variables["emg"][2].update(highpass=float(frequency), highpass_order=int(order))
    rates = {dim: clock for dim, clock in (("time", rate), ("emg_time", emg_rate)) if clock is not None}
    sizes = xr.Dataset(variables).sizes
    if "emg" in variables and emg_rate is None:
        raise ValueError("recording: emg_rate = None; expected the sampling rate of the EMG in Hz")
    coords: dict[str, Any] = {
        dim: (dim, np.arange(sizes[dim]) / clock, {"units": "s"}) for dim, clock in rates.items() if dim in sizes
    }
    coords |= {
        dim: (dim, list(labels[:1] if dim == "axis" and sizes[dim] == 1 else labels))
        for dim, labels in LABELS.items()
        if dim in sizes
    }
    if "muscle" in sizes:
        actions = ACTIONS if muscles is None else muscles
        coords["muscle"] = "muscle", list(actions)
        if any(action != ACTIONS.get(name) for name, action in actions.items()):
            coords["muscle_joints"] = "muscle", [action.joints for action in actions.values()]
            coords["muscle_sign"] = "muscle", [action.sign for action in actions.values()]
    absent = [name for name in ARM_LABELS if name not in trials] if sizes.get("axis") == 1 else []
    for name, values in {**trials, **dict.fromkeys(absent, np.full(sizes["trial"], np.nan))}.items():
        coords[name] = "trial", np.asarray(values), _describe(*TRIAL_COORDINATES[name])
    clocks = {CLOCKS[dim]: float(clock) for dim, clock in rates.items()}
    device = {name: value for name, value in (("servo", servo), ("joint", joint)) if value is not None}
    dataset = xr.Dataset(variables, coords=coords, attrs=clocks | device | attributes)
    check_recording(dataset)
    return dataset


def _describe(units: str, description: str) -> dict[str, Any]:
    return {"units": units, "long_name": description} if units else {"long_name": description}


def _check_kind(recording: xr.Dataset, source: str) -> None:
    """Refuse a recording of one axis that does not say what its device does, or mixes torques with displacements."""
    servo = recording.attrs.get("servo")
    if not is_one_axis(recording):
        for name in ("servo", "joint"):
            if name in recording.attrs:
                said = f"{name} = {recording.attrs[name]!r}"
                raise ValueError(f"{source}: {said} with two axes; expected it with one axis alone")
        return
    require_one_of(source, "servo", servo, SERVOS)
    if "joint" in recording.attrs:
        require_name(source, "joint", recording.attrs["joint"])
    for name in map(str, recording.data_vars):
        if name in SIGNALS and name not in ONE_AXIS_SIGNALS:
            raise ValueError(f"{source}: {name} with one axis; expected only {', '.join(ONE_AXIS_SIGNALS)}")


def check_recording(recording: xr.Dataset, signals: Iterable[str] | None = None, source: str = "recording") -> None:
    """Refuse a recording that does not hold what an analysis needs.

    Args:
      recording: the dataset to check.
      signals: variables that must be there; None for `required_signals`.
      source: where the recording comes from, for the message.

    Raises:
      TypeError: it is no `Dataset`.
      ValueError: a variable, coordinate or attribute is missing, has the wrong dims or unit, holds NaN, or the time
        axis does not run evenly at the stated rate.
    """
    require_type(source, recording, xr.Dataset, EXPECTED)
    if not recording.sizes.get("trial"):
        hint = " (recording.isel(trial=[0]) keeps it)" * ("trial" not in recording.dims)
        raise ValueError(f"{source}: there are no trials; expected at least one along the dimension 'trial'{hint}")
    signals = required_signals(recording.attrs.get("servo")) if signals is None else tuple(signals)
    for name in signals:
        if name not in recording.data_vars:
            raise ValueError(f"{source}: variable {name!r} is missing; expected {', '.join(signals)}")
    _check_kind(recording, source)
    single = is_one_axis(recording)
    angular = single and "displacement" in recording and recording["displacement"].attrs.get("units") == "rad"
    for name, (dims, _, _) in SIGNALS.items():
        if name not in recording.data_vars:
            continue
        variable, last, units = recording[name], dims[-1], signal_unit(name, angular=angular)
        labels = LABELS["axis"][:1] if single and last == "axis" else LABELS.get(last, ())
        if variable.dims != ("trial", *dims):
            raise ValueError(f"{source}: {name} has dims {variable.dims}; expected {('trial', *dims)}")
        if not isinstance(variable.attrs.get("units"), str) or variable.attrs["units"] != units:
            raise ValueError(f"{source}: {name} has units {variable.attrs.get('units')!r}; expected {units!r}")
        if name == "emg":
            _check_muscles(recording, source)
        elif last not in recording.coords or tuple(map(str, recording[last].values)) != labels:
            raise ValueError(f"{source}: dimension {last!r} is not labelled; expected {', '.join(labels)}")
        _require_numbers(variable, source)
        for trial, values in enumerate(variable.values):  # one at a time, as caches hold
            finite = np.isfinite(values)
            if not finite.all():
                sample, column = np.argwhere(~finite)[0]
                there = f"{values[sample, column]} at sample {sample}"
                raise ValueError(f"{source}: {name} of trial {trial} is {there}; expected finite values")
    for name in TEXT_COORDINATES:
        for text in map(str, recording[name].values.flat if name in recording.coords else ()):
            require_name(source, name, text)
    for name in TRIAL_COORDINATES:
        if name in OPTIONAL_COORDINATES and name not in recording.coords:
            continue
        if name not in recording.coords or recording[name].dims != ("trial",):
            raise ValueError(f"{source}: coordinate {name!r} along trial is missing; expected one value per trial")
        if name not in TEXT_COORDINATES:
            _require_numbers(recording[name], source)
            if np.isinf(recording[name].values).any():
                raise ValueError(f"{source}: {name} is infinite in a trial; expected finite values, or NaN for none")
    _check_clock(recording, "time", source)
    if "emg" in recording.data_vars:
        _check_clock(recording, "emg_time", source)


def named(recordings: xr.Dataset | Sequence[xr.Dataset]) -> str:
    """Who, in which conditions, and how many trials, for people to read."""
    parts = [recordings] if isinstance(recordings, xr.Dataset) else recordings
    who, where = (
        ", ".join(dict.fromkeys(str(label) for part in parts for label in part[name].values))
        for name in ("subject", "condition")
    )
    n = sum(part.sizes["trial"] for part in parts)
    return f"{who}, {where}, {n} trial{'' if n == 1 else 's'}"


def labels_of(recording: xr.Dataset) -> dict[str, str]:
    """Condition and subject of trials that have the same, and of one axis the joint; "" where it is not known."""
    joint = {"joint": str(recording.attrs.get("joint", ""))} if is_one_axis(recording) else {}
    return {name: str(recording[name].values[0]) for name in ("condition", "subject")} | joint


def muscle_actions(recording: xr.Dataset) -> dict[str, Action]:
    """Name of each muscle of the EMG to what it does, in the order of the columns."""
    names = list(map(str, recording["muscle"].values))
    if "muscle_joints" not in recording.coords or "muscle_sign" not in recording.coords:
        return {name: ACTIONS.get(name, Action("", 0)) for name in names}
    rows = zip(recording["muscle_joints"].values, recording["muscle_sign"].values, strict=True)
    return {name: Action(str(joints), int(sign)) for name, (joints, sign) in zip(names, rows, strict=True)}


def _check_muscles(recording: xr.Dataset, source: str) -> None:
    """Refuse EMG whose muscles have no names, or do what no muscle does."""
    if "muscle" not in recording.coords or recording["muscle"].dims != ("muscle",):
        raise ValueError(f"{source}: dimension 'muscle' is not labelled; expected the names of the muscles")
    names = list(map(str, recording["muscle"].values))
    for name in names:
        require_name(source, "muscle", name)
        if names.count(name) > 1:
            raise ValueError(f"{source}: muscle {name!r} comes twice; expected each once")
    if "muscle_sign" in recording.coords:
        _require_numbers(recording["muscle_sign"], source)
    for name, action in muscle_actions(recording).items():
        if action.joints not in JOINTS_OF_MUSCLES or action.sign not in (-1, 0, 1):
            raise ValueError(
                f"{source}: muscle {name!r} has joints {action.joints!r} and sign {action.sign}; expected joints s, e, "
                "se or none, and sign 1 (flexes), -1 (extends) or 0"
            )
    lead = recording["emg"].attrs.get("lead", 0.0)
    if not isinstance(lead, (int, float, np.number)) or not -LONGEST_LEAD <= lead <= LONGEST_LEAD:
        raise ValueError(f"{source}: lead of emg = {lead!r}; expected {-LONGEST_LEAD:g} to {LONGEST_LEAD:g} s")
    emg_highpass(recording, source)


def emg_highpass(recording: xr.Dataset, source: str = "recording") -> HighPass | None:
    """The high-pass of the EMG's amplifier; None if the recording does not say it.

    Raises:
      ValueError: it is no cut-off and order within `LARGEST_HIGHPASS`.
    """
    attributes, largest = recording["emg"].attrs, LARGEST_HIGHPASS
    if "highpass" not in attributes:
        return None
    frequency, order = attributes["highpass"], attributes.get("highpass_order", 2)
    if not isinstance(frequency, (int, float, np.number)) or not 0.0 < frequency <= largest.frequency:
        raise ValueError(f"{source}: highpass of emg = {frequency!r:.60}; expected above 0 to {largest.frequency:g} Hz")
    if not isinstance(order, (int, float, np.number)) or order not in range(1, largest.order + 1):
        raise ValueError(f"{source}: highpass_order of emg = {order!r:.60}; expected 1 to {largest.order}")
    return HighPass(float(frequency), int(order))


def _require_numbers(variable: xr.DataArray, source: str) -> None:
    if variable.dtype.kind not in "fiu":
        raise ValueError(f"{source}: {variable.name} holds values of type {variable.dtype}; expected numbers")


def _check_clock(recording: xr.Dataset, dim: str, source: str) -> None:
    attribute = CLOCKS[dim]
    rate = recording.attrs.get(attribute)
    if not isinstance(rate, (int, float, np.number)) or not (np.isfinite(rate) and rate > 0):
        raise ValueError(f"{source}: {attribute} = {rate!r}; expected the sampling rate in Hz as an attribute, above 0")
    if dim in recording.coords:
        _require_numbers(recording[dim], source)
    time = recording[dim].values if dim in recording.coords else np.empty(0)
    if len(time) < 2:
        raise ValueError(f"{source}: {dim} has {len(time)} samples; expected at least 2")
    for start in range(0, len(time), CLOCK_PIECE):  # not all at once, for the sake of memory
        piece = time[start : start + CLOCK_PIECE]
        is_even = np.abs(piece - np.arange(start, start + len(piece)) / rate) <= 0.01 / rate
        if is_even.all():
            continue
        at = start + int(np.argmin(is_even))
        raise ValueError(
            f"{source}: {dim} runs at {1.0 / np.median(np.diff(time)):.6g} Hz, or not evenly (sample {at} is at "
            f"{time[at]:.6g} s); expected even steps from 0 s at {attribute} = {float(rate):.6g} Hz"
        )
