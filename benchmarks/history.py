"""Ratios of earlier runs on this machine, in `results/benchmarks.jsonl`, so that a regression shows."""

import json
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

FILE = Path("results") / "benchmarks.jsonl"
WORSE = 1.2
"""Over the best of the last runs, from which on a ratio is called a regression."""


def remembered(ratios: Mapping[str, float], file: Path = FILE, last: int = 5) -> None:
    """Add ratios to the history, and print those that are worse than before; smaller is better.

    Args:
      ratios: name to value.
      file: the history.
      last: runs to compare with.
    """
    earlier = []
    if file.exists():
        lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
        earlier = [line["ratios"] for line in lines if line["machine"] == platform.node()][-last:]
    for name, value in ratios.items():
        before = [run[name] for run in earlier if name in run]
        if before and value > WORSE * min(before):
            print(f"regression: {name} = {value:.2f}; {min(before):.2f} in one of the last {len(before)} runs")
    file.parent.mkdir(exist_ok=True)
    entry = {"time": datetime.now(UTC).isoformat(), "machine": platform.node(), "ratios": dict(ratios)}
    with file.open("a", encoding="utf-8") as lines_out:
        lines_out.write(json.dumps(entry) + "\n")
