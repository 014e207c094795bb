"""Where the time of a whole study goes: recording, analysis, report, and the report once more.

Targets: the first three together under 600 s on two cores, the report again under 60 s, and under 15 MB.
"""

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from armperturb.study.recording.record import record_study
from armperturb.study.recording.settings import StudySettings
from armperturb.study.report.report import write_report
from armperturb.study.results.analyse import analyse_study


def main() -> None:
    cores = len(os.sched_getaffinity(0))
    seconds: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)

        def timed(what: str, function: Callable[[], Any]) -> Any:
            start = time.perf_counter()
            result = function()
            seconds[what] = time.perf_counter() - start
            return result

        timed("record", lambda: record_study(StudySettings(), out, workers=None, show_progress=False))
        study = timed("analyse", lambda: analyse_study(out, show_progress=False))
        report = timed("report", lambda: write_report(study, out, workers=None, show_progress=False))
        again = timed("analyse again", lambda: analyse_study(out, show_progress=False))
        timed("report again", lambda: write_report(again, out, workers=None, show_progress=False))
        size = report.stat().st_size
    for what, value in seconds.items():
        print(f"{what:14} {value:6.1f} s, {value / seconds['record']:.2f} of the recording")
    whole = sum(seconds[what] for what in ("record", "analyse", "report"))
    once_more = seconds["analyse again"] + seconds["report again"]
    print(f"whole study    {whole:6.1f} s on {cores} cores (target 600 on 2)")
    print(f"report again   {once_more:6.1f} s (target 60 on 2), {size / 1e6:.1f} MB (target 15)")


if __name__ == "__main__":
    main()
