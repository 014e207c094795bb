"""Refuses what no arm and manipulator do, as a wrong unit or start makes them do."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from armperturb.analysis.joint_balance import DEGREES, LARGEST_ANGLE
from armperturb.arrays import Array
from armperturb.convert.angles import require_path_of_angles
from armperturb.convert.faults import Timed
from armperturb.convert.raw import RawTrial
from armperturb.convert.sidecar import Sidecar
from armperturb.convert.tables import TABLES
from armperturb.convert.units import UNITS
from armperturb.copied_trials import copies_of
from armperturb.recording import CLOCKS, SIGNALS
from armperturb.validation import RANGES, require_number

LARGEST_NUMBER = 1e16
"""In a file, whatever its unit: microseconds since 1970 are less [-]."""

LARGEST_FORCE = 2000.0
"""That people and manipulators bear [N]; refuses millinewtons."""

LARGEST_TORQUE = 500.0
"""That a joint bears [Nm]; refuses millinewton metres."""

LONGEST_SEGMENT: float = TABLES["ranges"]["l_h"][1]
"""Of any person [m], where the person's own are unknown."""

REACH = 1.0
"""Largest distance of the handle from its start, in arm lengths [-]; refuses millimetres."""

AWAY = 0.01
"""Distance from its start at which no path stays throughout, unless it moves by more [m]; refuses places in a room."""

COMPARED_EMG = 1000
"""Samples at the beginning of a trial that tell its EMG from any other: noise never repeats."""

_POSTURE = ("l_h", "l_f", "theta_s_deg", "theta_e_deg")


def require_signal(where: str, name: str, values: Array) -> None:
    """Refuse numbers that are beyond any unit, and would overflow.

    Args:
      where: file and trial, for the message.
      name: of the signal or channel.
      values: in the file's unit, (time, component).

    Raises:
      ValueError: there are such numbers.
    """
    beyond = (np.abs(values) > LARGEST_NUMBER).any(axis=1)
    if beyond.any():
        at = int(np.argmax(beyond))
        raise ValueError(f"{where}: {name} is {values[at].max():.6g} at sample {at}; expected numbers of a signal")


def other_units(trials: Iterable[RawTrial], meaning: Sidecar) -> list[str]:
    """One line per channel whose file states another unit than the sidecar, which is believed.

    Args:
      trials: of a file.
      meaning: its sidecar.
    """
    lines = []
    for trial in trials:
        for name, of_signal in meaning.signals.items():
            known = UNITS[of_signal.ours]
            for channel in of_signal.channels.values():
                of_file = trial.units.get(channel)
                if of_file is not None and known.get(of_file) != known[of_signal.unit]:
                    lines.append(
                        f"{channel} is in {of_file!r} by the file; taken as {of_signal.unit!r}, as signals.{name}.unit "
                        f"of {meaning.path} says"
                    )
    return list(dict.fromkeys(lines))


def check_different(recordings: Sequence[xr.Dataset], names: Sequence[str], files: Sequence[str]) -> tuple[str, ...]:
    """Refuse trials that are in two files, and different trials with the same EMG.

    Args:
      recordings: to compare; their trials follow one another in `names` and `files`.
      names: of each trial, for messages.
      files: that hold them.

    Returns:
      A note for each trial that repeats another of its file.

    Raises:
      ValueError: a trial is in two files, or has the EMG of another.
    """
    copies = copies_of(recordings, alike=False)
    left_out = copies_of(recordings) if copies else {}
    for place, before in copies.items():
        if files[before] != files[place]:
            raise ValueError(f"{names[place]} has the signals of {names[before]}; expected each trial in one file only")
    _require_own_emg(recordings, names, copies)
    others = {place: before for place, before in copies.items() if place not in left_out}
    return (
        *(f"{names[place]} repeats {names[before]}: analyses leave it out" for place, before in left_out.items()),
        *(f"{names[place]} repeats {names[before]}, which has other labels" for place, before in others.items()),
    )


def _require_own_emg(recordings: Sequence[xr.Dataset], names: Sequence[str], copies: Collection[int]) -> None:
    """Refuse trials that are no copies and have the EMG of another."""
    beginnings = [
        beginning
        for each in recordings
        for beginning in (
            each["emg"].values[:, :COMPARED_EMG] if "emg" in each.data_vars else [None] * each.sizes["trial"]
        )
    ]
    first: dict[bytes, int] = {}
    for place, beginning in enumerate(beginnings):
        if beginning is None or place in copies:
            continue
        before = first.setdefault(beginning.tobytes(), place)
        if before != place and np.ptp(beginning, axis=0).any():
            raise ValueError(
                f"{names[place]} has the EMG of {names[before]}; expected EMG that was recorded with it (in signals."
                "emg.file of a sidecar, * stands for the name of each file without its ending)"
            )


def check_recordings(recordings: Sequence[xr.Dataset], files: Sequence[str]) -> tuple[str, ...]:
    """The same for whole recordings, a file each."""
    trials = [
        (file, trial) for file, each in zip(files, recordings, strict=True) for trial in range(each.sizes["trial"])
    ]
    return check_different(
        recordings, [f"{file}: trial {trial}" for file, trial in trials], [file for file, _ in trials]
    )


def require_plausible(trial: Timed) -> None:
    """Refuse forces and paths that are out of range, or a path that is not that of the angles.

    Args:
      trial: in SI and our axes.

    Raises:
      ValueError: a signal is too large, displacement is not from its start, or as `require_path_of_angles`.
    """
    where, signals, rates, labels = trial.where, trial.signals, trial.rates, trial.labels
    reach = REACH * (labels.get("l_h", LONGEST_SEGMENT) + labels.get("l_f", LONGEST_SEGMENT))
    limits = {"N": LARGEST_FORCE, "Nm": LARGEST_TORQUE, "m": reach, "rad": LARGEST_ANGLE, "V": 100.0}
    if trial.servo is not None:  # `check_joint` names an angle in degrees by the inertia
        limits["rad"] *= DEGREES
    for name, values in signals.items():
        unit = trial.units[name]
        if max(values.max(), -values.min()) > limits[unit]:
            size = np.abs(values).max(axis=1)
            at = int(np.argmax(size > limits[unit]))
            raise ValueError(
                f"{where}: {name} is {size[at]:.4g} {unit} at {at / rates[name]:.6g} s; expected at most "
                f"{limits[unit]:.4g} (a wrong signals.{name}.unit, or displacement not from its start?)"
            )
    path = signals["displacement"]
    # The place of a joint, or of a device of one axis, has no start of its own.
    of_path = () if trial.servo is not None else zip("xy", path.min(axis=0), path.max(axis=0), strict=True)
    for axis, low, high in of_path:
        away = max(low, -high)
        if away > max(AWAY, high - low):
            raise ValueError(
                f"{where}: displacement {axis} is {low:.4g} to {high:.4g} m throughout; expected the path from the "
                'start of the trial (for places in a room "start": "first" or the place of the start)'
            )
    require_path_of_angles(trial)


def require_instants(where: str, labels: Mapping[str, Any], duration: float) -> None:
    """Refuse instants that lie outside their trial.

    Args:
      where: file and trial, for the message.
      labels: coordinate along `trial` to value.
      duration: of the trial [s].

    Raises:
      ValueError: the pulse begins, or the handle reached the limit of the workspace, before the trial or after it.
    """
    for name in ("pulse_onset", "limit_time"):
        instant = float(labels.get(name, math.nan))
        if instant < 0.0 or instant > duration + 1e-9:
            raise ValueError(
                f"{where}: {name} = {instant:g} s; expected within the trial, which lasts {duration:g} s, or none"
            )


def require_plausible_recording(recording: xr.Dataset, source: str) -> None:
    """Refuse a recording with a trial that is out of range; raises as `require_plausible` and `require_instants`."""
    signals = {name: recording[name] for name in SIGNALS if name in recording.data_vars}
    rates = {name: float(recording.attrs[CLOCKS[SIGNALS[name][0][0]]]) for name in signals}
    for trial in range(recording.sizes["trial"]):
        where, labels = f"{source}: trial {trial}", {name: float(recording[name].values[trial]) for name in _POSTURE}
        for name in _POSTURE:
            if not np.isnan(labels[name]):
                require_number(where, name, labels[name], **RANGES["Subject"][name])
        # What comes after the end, as where a user has cut a recording, did not happen in the trial.
        duration = recording.sizes["time"] / float(recording.attrs["rate"])
        instants = {name: np.fmin(recording[name].values[trial], duration) for name in ("pulse_onset", "limit_time")}
        require_instants(where, instants, duration)
        require_plausible(
            Timed(
                where=where,
                labels=labels,
                signals={name: of_all.values[trial] for name, of_all in signals.items()},
                rates=rates,
                components={},
                units={name: recording[name].attrs["units"] for name in signals},
                servo=recording.attrs.get("servo"),
            )
        )
