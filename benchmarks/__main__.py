"""Runs the benchmarks: the table of simulations in some three minutes, with `--full` every target in one table.

The others are run by themselves, `python -m benchmarks.NAME`.
"""

import importlib
import os
import sys

from armperturb.cli import BLAS_THREADS

for name in BLAS_THREADS:
    os.environ.setdefault(name, "1")  # as commands do, before NumPy is loaded

SHORT = ("simulation", "vector_env", "study_speed")

for name in ("targets",) if "--full" in sys.argv[1:] else SHORT:
    print(f"== {name}", flush=True)
    importlib.import_module(f"benchmarks.{name}").main()
