"""Recordings and vector environments are the same to the last bit at any number of threads and on every MuJoCo."""

import json
import os
from pathlib import Path

import pytest
from digests import digests


@pytest.mark.slow(reason="all laboratories and a vector environment, twice")
def test_digests_are_those_of_the_other_installation_or_of_one_thread():
    # `make test-latest` writes the file with the package's usual installation, and runs this in the newest.
    other = os.environ.get("ARMPERTURB_DIGESTS")
    expected = json.loads(Path(other).read_text(encoding="utf-8")) if other else digests(n_threads=1)
    assert len(expected) > 10
    assert digests(n_threads=3) == expected
