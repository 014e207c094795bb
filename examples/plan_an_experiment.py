"""Will my experiment tell what I want to know of this person, and which perturbation would tell it better?

Run `python examples/plan_an_experiment.py [--pilot FILE] [--sidecar FILE.json] [--out FOLDER] [--fast]`. A pilot
recording says who the person is, as far as it can; by default it is the position task of examples/data. The thesis's
perturbation stands beside one that is made for the goal, within the same limits. What is promised holds for noise like
that of synthetic people (docs/design.md). It writes perturbations that `armperturb simulate` plays, and a figure.
"""

import argparse
import math
import sys
from pathlib import Path

from armperturb import identify
from armperturb.convert import import_recording
from armperturb.plots.style import save_png
from armperturb.study.planning.plan import DesignSettings, design
from armperturb.study.planning.report import write_design

DATA = Path(__file__).resolve().parent / "data"

MODEL = {"PT": "3b", "RT": "1"}
GOAL = {"PT": "reflex", "RT": "intrinsic"}
LIMITS = {
    "PT": {"force": 5.4, "displacement": 0.0075, "duration": 32.0},
    "RT": {"force": 0.9, "displacement": 0.010, "duration": 32.0},
}
"""RMS force per axis [N], RMS displacement per axis [m] and duration [s] of a trial, as in the thesis's conditions."""

GOOD = 0.10
"""Standard error that is good enough, over the value [-]."""


def trials_needed(trials: int, standard_error: float, value: float) -> int:
    """Trials after which a parameter is known as well as `GOOD`: errors fall with the root of their number."""
    return math.ceil(trials * (standard_error / (GOOD * value)) ** 2)


def main(pilot: Path, sidecar: Path | None, folder: Path, trials: int) -> None:
    recording = import_recording([pilot], sidecar=sidecar).recording
    task = str(recording["task"].values[0])
    person = identify(recording, model=MODEL[task]).fit.arm
    plan = design(
        DesignSettings(subject=person, goal=GOAL[task], **LIMITS[task], model=MODEL[task], trials=trials, seed=1)
    )
    print(plan.summary())
    print(f"\ntrials of {LIMITS[task]['duration']:g} s until the standard error is {GOOD:.0%} of the value:")
    for row in plan.to_frame().to_dict("records"):
        if row["goal"] and row["value"]:
            usual, better = (trials_needed(trials, row[sem], row["value"]) for sem in ("sem_thesis", "sem_optimised"))
            print(f"  {row['parameter']:6} {usual:4d} of the thesis's, {better:4d} optimised")
    print("That is of one who is the same in every trial, and as the pilot says: what it does not know, no plan does.")

    write_design(plan, folder / "plan")
    save_png(plan.plot().flat[0].figure, folder / "plan_an_experiment.png", 110)
    print(f"wrote {folder / 'plan_an_experiment.png'}, and tables and {trials} perturbations to {folder / 'plan'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pilot", type=Path, default=DATA / "position.csv", metavar="FILE")
    parser.add_argument("--sidecar", type=Path)
    parser.add_argument("--out", type=Path, default=Path("example"), metavar="FOLDER")
    parser.add_argument("--fast", action="store_true", help="one trial instead of four")
    given = parser.parse_args()
    try:
        main(given.pilot, given.sidecar, given.out, 1 if given.fast else 4)
    except (TypeError, ValueError, OSError) as error:
        sys.exit(f"{error}")
