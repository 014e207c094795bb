"""What the report of a study calls things."""

from typing import Any

from armperturb.files import packaged_table

WORDS: dict[str, dict[str, Any]] = packaged_table(__package__, "words.toml")
"""Kind and name to words."""
