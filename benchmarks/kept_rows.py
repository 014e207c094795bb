"""Results of arms, one JSON line each, that a benchmark keeps so that it may be stopped and go on."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

Row = dict[str, Any]


def with_kept_rows(
    path: Path | None, seeds: Iterable[Any], judged: Callable[[list[Any]], Iterable[Row]], **options: Any
) -> list[Row]:
    """What a file has, and what is judged now; each new row is kept as soon as it is there.

    Args:
      path: of the file; None to keep nothing.
      seeds: that are wanted, numbers or texts; each row has its own as `seed`.
      judged: seeds that the file lacks to their rows, in any order.
      options: what else rows depend on, ready for JSON; those of other options stay in the file and do not count.
    """
    rows, seeds = [], set(seeds)
    if path and path.exists():
        retained = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        rows = [row for row in retained if row["seed"] in seeds and row.pop("options", {}) == options]
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
    for row in judged(sorted(seeds - {row["seed"] for row in rows})):
        rows.append(row)
        if path:
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row | {"options": options}) + "\n")
    return rows
