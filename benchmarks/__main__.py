"""Runs the benchmarks: the table of simulations in some three minutes, with `--full` every target in one table.

The others are run by themselves, `python -m benchmarks.NAME`.
"""

import importlib
import sys

SHORT = ("simulation", "vector_env", "study_speed")

for name in ("targets",) if "--full" in sys.argv[1:] else SHORT:
    print(f"== {name}", flush=True)
    importlib.import_module(f"benchmarks.{name}").main()
