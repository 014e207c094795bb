"""The tables of `tables.toml`: units, fields of the sidecar, and the words of names; and which faults have a repair."""

from typing import Literal

from armperturb.files import packaged_table

Repair = Literal["gaps", "drops", "clock", "lengths", "stretch", "trials"]
"""Faults that can be repaired, see `armperturb.convert.faults`."""

TABLES = packaged_table(__package__, "tables.toml")
