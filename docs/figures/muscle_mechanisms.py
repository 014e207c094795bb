"""What does each mechanism of the muscle law do to the average person's movements?

Run `python docs/figures/muscle_mechanisms.py FOLDER`. It writes the pictures of docs/muscle.md and
prints their numbers.
"""

import sys
from pathlib import Path

from armperturb.cohort import average_person
from armperturb.plots.style import save_png
from armperturb.study.experiments import mechanisms as yielding
from armperturb.study.report.figures import mechanisms as yielding_figures


def main(folder: Path) -> None:
    result = yielding.why_people_yield(average_person())
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("loops", "admittance", "pulses"):
        save_png(getattr(yielding_figures, name)(result), folder / f"yielding_{name}.png", 110.0)
    print(f"{'':38}{'RT22.5 / RT2.5':>16}{'PT2.5 / PT22.5':>16}{'pulse, RT22.5 / RT0':>21}")
    for row in result.rows():
        print(
            f"{row['arm']:38}{row['RT_rise']:16.2f}{row['PT_fall']:16.2f}{row['pulse_admittance_RT22.5_over_RT0']:21.2f}"
        )
    for (arm, condition), reason in result.unstable.items():
        print(f"{arm}, {condition}: {reason}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "yielding"))
