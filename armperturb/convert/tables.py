"""The tables of `tables.toml`: units, fields of the sidecar, and the words of names."""

import tomllib
from importlib import resources

TABLES = tomllib.loads(resources.files(__package__).joinpath("tables.toml").read_text(encoding="utf-8"))
