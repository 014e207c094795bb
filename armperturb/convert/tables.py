"""The tables of `tables.toml`: units, fields of the sidecar, and the words of names."""

from armperturb.files import packaged_table

TABLES = packaged_table(__package__, "tables.toml")
