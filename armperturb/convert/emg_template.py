"""Guesses for the sidecar of EMG: which columns hold it, their muscles, unit and rate; and what is not used."""

import json
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from armperturb.convert.columns import Column
from armperturb.convert.sidecar import OPEN
from armperturb.convert.tables import TABLES
from armperturb.convert.units import UNITS
from armperturb.recording import ACTIONS

BETWEEN = re.compile(r"[\s._-]+")
"""Between the parts of a name."""

SIZES = (("V", 0.02), ("mV", 20.0))
"""Unit, and the size below which nearly all values of EMG in it are; beyond, it is in uV."""


def is_emg(column: Column) -> bool:
    """Whether a column's name says EMG or a muscle, and its unit, if it has any, a voltage."""
    words, unit = column.words()
    others = {*TABLES["words"]["time"], *TABLES["words"]["rate"]}
    is_signal = column.values.dtype.kind in "fiu" and len(column.values) > 1 and not {*words} & others
    return is_signal and unit in ("", *UNITS["V"]) and bool({*words} & {*TABLES["words"]["emg"]})


def add_emg(
    columns: Sequence[Column], others: Sequence[Column], content: dict[str, Any], guessed: dict[str, str]
) -> None:
    """Put EMG into a sidecar, as far as it can be in one with the trials that this has.

    Args:
      columns: of EMG.
      others: those of the rest.
      content: of the sidecar, to which `signals.emg` is added.
      guessed: field to what to check in it, to which guesses are added.
    """
    signals = content["signals"]
    used = {channel for signal in signals.values() for channel in signal["channels"].values()}
    has_trials = any("trial" in channel.partition("(")[2] for channel in used)
    columns = [each for each in columns if not has_trials or "trial" in each.channel.partition("(")[2]]
    if not columns or "emg" in signals:
        return
    channels: dict[str, str] = {}
    for column in columns:
        name = " ".join(part for part in BETWEEN.split(column.name) if part.lower() not in ("", "emg")) or column.name
        known = name.lower().replace(" ", "_")
        channels[column.channel if name in channels else known if known in ACTIONS else name] = column.channel
    emg: dict[str, Any] = {"channels": channels, "unit": columns[0].words()[1]}
    guessed["signals.emg.channels"] = "muscle to channel, by their names; any raw EMG, no envelopes"
    if emg["unit"] not in UNITS["V"]:
        size = max(float(np.nanquantile(np.abs(each.values), 0.999)) for each in columns)
        emg["unit"] = next((unit for unit, largest in SIZES if size < largest), "uV")
        guessed["signals.emg.unit"] = "from the size of its values"
    if unknown := [name for name in channels if name not in ACTIONS]:
        guessed["signals.emg.channels"] += f"; in signals.emg.muscles belongs what these do: {', '.join(unknown)}"[:110]
    lengths = {len(each.values) for each in others if each.channel in used}
    ratio = len(columns[0].values) / max(lengths, default=1)
    if lengths and ratio != 1.0 and not columns[0].rate:  # C3D states rates itself
        rate = content.get("rate", OPEN)
        if rate == OPEN and (time := content.get("time")):
            clock = next(each.values for each in others if each.channel == time["channel"])
            rate = 1.0 / (float(np.median(np.diff(clock))) * UNITS["s"][time["unit"]])
        emg["rate"] = rate if rate == OPEN else round(float(rate) * ratio, 3)
        guessed["signals.emg.rate"] = "from the number of its samples"
    signals["emg"] = emg


def unused(columns: Sequence[Column], content: dict[str, Any]) -> list[str]:
    """A note on the columns of numbers that a sidecar does not use; none if it uses all."""
    text = json.dumps({name: value for name, value in content.items() if name != "guessed"}, ensure_ascii=False)
    labels = {*content.get("labels", {}), *(name for trial in content.get("trials", {}).values() for name in trial)}
    left = [
        each.channel
        for each in columns
        if each.values.dtype.kind in "fiu"
        and len(each.values) > 1
        and json.dumps(each.channel, ensure_ascii=False) not in text
        and not {each.channel.lower(), each.label.lower()} & labels
    ]
    return [f"channels that are not used: {', '.join(left)}"[:400]] if left else []
