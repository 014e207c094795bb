"""Runs the benchmarks: the table of simulations in some three minutes, or with `--full` all but the longest.

`distortion` and `design` take an hour each, `foreign_arms` has options: these are run by themselves.
"""

import importlib
import sys

SHORT = ("simulation", "vector_env", "study_speed")
FULL = (
    *SHORT,
    *("muscle_law", "multisine_crest", "thesis_fit", "thesis_sem", "estimators", "nonparametric", "frequency_response"),
    *("sysid", "study_report", "study_kills", "nonlinear"),
)

for name in FULL if "--full" in sys.argv[1:] else SHORT:
    print(f"== {name}", flush=True)
    importlib.import_module(f"benchmarks.{name}").main()
