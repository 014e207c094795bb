"""The trials of several recordings in one."""

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from armperturb.recording import (
    CLOCKS,
    EXPECTED,
    LABELS,
    OPTIONAL_COORDINATES,
    SIGNALS,
    check_recording,
    muscle_actions,
    required_signals,
)
from armperturb.validation import as_list


class Joined(NamedTuple):
    """Trials of several recordings in one.

    Attributes:
      recording: of all.
      lost: name of what not all have alike, and which is left out, to the difference if that is known.
    """

    recording: xr.Dataset
    lost: dict[str, str]


def join_recordings(
    recordings: Sequence[xr.Dataset], source: str = "recordings", optional: Iterable[str] = ()
) -> Joined:
    """The trials of several recordings in one.

    Args:
      recordings: at least one; of the same rate and duration.
      source: where they come from, for the message.
      optional: signals that are kept beside `REQUIRED_SIGNALS` where all recordings have them, sampled alike.

    Raises:
      ValueError: rates, durations, axes, units or servos differ.
    """
    _require_alike(recordings, source)
    signals, unlike = [*required_signals(recordings[0].attrs.get("servo"))], dict[str, str]()
    for name in optional:
        there = [name in recording.data_vars for recording in recordings]
        unlike[name] = _difference(recordings, name) if all(there) else "not in all of them" if any(there) else ""
        signals += [name] if all(there) and not unlike[name] else []
    if "emg" in signals:
        recordings = [recording.sel(muscle=recordings[0]["muscle"].values) for recording in recordings]
    sometimes = (*OPTIONAL_COORDINATES, "muscle_joints", "muscle_sign")
    partial = [name for name in sometimes if not all(name in recording.coords for recording in recordings)]
    joined = _stacked([recording[signals].drop_vars(partial, errors="ignore") for recording in recordings])
    names = [str(name) for recording in recordings for name in (*recording.variables, *recording.attrs)]
    left = {*joined.variables, *joined.attrs, *LABELS, "muscle", *sometimes[1:], *CLOCKS, *CLOCKS.values()}
    return Joined(joined, {name: unlike.get(name, "") for name in dict.fromkeys(names) if name not in left})


def of_one_length(recordings: Sequence[xr.Dataset], conditions: Collection[str]) -> list[xr.Dataset]:
    """Recordings of which those of some conditions alone last as long as the others.

    They are cut into parts, the last of which goes on backward from its end, so that levels and spectra stay what they
    are. Those in which other conditions are, too, or at another rate, stay as they are.

    Args:
      recordings: with EMG.
      conditions: in which nothing but the level of the EMG counts.
    """
    others = [each for each in recordings if not {*each["condition"].values.tolist()} <= {*conditions}]
    if not others:
        return list(recordings)
    clocks, parts = {clock: others[0][clock] for clock in ("time", "emg_time")}, []
    for recording in recordings:
        rates = [[float(each.attrs[CLOCKS[clock]]) for clock in clocks] for each in (recording, others[0])]
        if any(recording is other for other in others) or rates[0] != rates[1]:
            parts.append(recording)
            continue
        n_parts = max(-(-recording.sizes[clock] // values.size) for clock, values in clocks.items())
        for number in range(n_parts):
            index = {
                clock: (np.arange(values.size) + number * values.size) % (2 * recording.sizes[clock])
                for clock, values in clocks.items()
            }
            turned = {clock: np.minimum(at, 2 * recording.sizes[clock] - 1 - at) for clock, at in index.items()}
            parts.append(recording.isel(turned).assign_coords(clocks))
    return parts


def _difference(recordings: Sequence[xr.Dataset], name: str) -> str:
    """What keeps a signal that all have from being one; empty if nothing does."""
    clock, parts = SIGNALS[name][0][0], [recording[name] for recording in recordings]
    facts = {
        "rates [Hz]": [f"{float(recording.attrs[CLOCKS[clock]]):.9g}" for recording in recordings],
        "numbers of samples": [str(part.sizes[clock]) for part in parts],
        **{
            attribute: [str(part.attrs.get(attribute, "none")) for part in parts]
            for attribute in dict.fromkeys(str(each) for part in parts for each in part.attrs if each != "adc_step")
        },
    }
    if name == "emg":
        facts["muscles"] = [
            ", ".join(
                sorted(f"{muscle} ({joints or 'unknown'}{sign:+d})" for muscle, (joints, sign) in actions.items())
            )
            for actions in map(muscle_actions, recordings)
        ]
    return next((f"{fact} {' and '.join(dict.fromkeys(each))}" for fact, each in facts.items() if len({*each}) > 1), "")


def _require_alike(recordings: Sequence[xr.Dataset], source: str) -> None:
    """Refuse recordings of several kinds, rates or durations."""
    kinds = {(f"{each.attrs.get('servo')}", each.sizes["axis"], each["force"].attrs["units"]) for each in recordings}
    if len(kinds) > 1:
        several = " and ".join(sorted(f"servo {servo}, axes {n}, force in {unit}" for servo, n, unit in kinds))
        raise ValueError(f"{source}: trials of {several}; expected one kind of recording")
    clocks = {(float(recording.attrs["rate"]), recording.sizes["time"]) for recording in recordings}
    if len(clocks) > 1:
        trials = " and ".join(f"{n / rate:g} s at {rate:g} Hz" for rate, n in sorted(clocks))
        raise ValueError(f"{source}: trials of {trials}; expected one rate and duration")


def stack_trials(recordings: Sequence[xr.Dataset]) -> xr.Dataset:
    """The trials of recordings with the same signals and times in one; attributes that differ are lost.

    Raises:
      TypeError: recordings are something else.
      ValueError: there is none, one is refused, or they differ in their kind, rate, duration or signals.
    """
    several = as_list("recordings", recordings, xr.Dataset, EXPECTED)
    for recording in several:
        check_recording(recording)
    _require_alike(several, "recordings")
    signals = {", ".join(f"{name} {values.shape[1:]}" for name, values in sorted(each.items())) for each in several}
    if len(signals) > 1:
        raise ValueError(f"recordings: signals {' and '.join(sorted(signals))}; expected the same signals in all")
    return _stacked(several)


def _stacked(recordings: Sequence[xr.Dataset]) -> xr.Dataset:
    return xr.concat(
        recordings,
        dim="trial",
        data_vars="minimal",
        coords="minimal",
        compat="equals",
        join="exact",
        combine_attrs="drop_conflicts",
    )
