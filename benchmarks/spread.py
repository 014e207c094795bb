"""How far people differ from each other, over how far the published people do.

Run by `python -m benchmarks.spread`; some 25 s of one core for 40 people. People are drawn, practise, are simulated and
measured as in a study of seed 1000, which no other figure of the documentation uses. Printed are, by task, the median
over a table's cells of the SD over people over the published one, and the root mean square of the logarithm of these
ratios over the tables on which the spreads were set (2.1, F.2 to F.4). `--alike PT RT`, `--own PT RT` and `--level`
try other SDs of the logarithms of the factors of `armperturb.cohort`.
"""

import argparse

import numpy as np

from armperturb import cohort
from armperturb.study.experiments.cohort_cells import measure_cohort
from armperturb.study.recording.settings import StudySettings
from armperturb.study.results.quantities import published_cells
from armperturb.study.results.uses import CALIBRATED, HELD_OUT
from armperturb.subject import TASKS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--alike", type=float, nargs=2, default=[cohort.SPREAD_ALIKE[task] for task in TASKS])
    parser.add_argument("--own", type=float, nargs=2, default=[cohort.SPREAD_OWN[task] for task in TASKS])
    parser.add_argument("--level", type=float, default=cohort.SPREAD_LEVEL)
    options = parser.parse_args()
    cohort.SPREAD_ALIKE.update(zip(TASKS, options.alike, strict=True))
    cohort.SPREAD_OWN.update(zip(TASKS, options.own, strict=True))
    cohort.SPREAD_LEVEL = options.level
    # In this process alone, as others would draw people with the spreads that are set.
    settings = StudySettings(subjects=options.people, seed=options.seed, engine="compiled")
    measured = measure_cohort(settings, workers=1, show_progress=False)
    print(options)
    ratio = {cell: measured[tuple(cell)].std(ddof=1) / value.sd for cell, value in published_cells().items()}
    for task in TASKS:
        of_task = {cell: value for cell, value in ratio.items() if cell.condition.startswith(task)}
        for table in CALIBRATED + HELD_OUT:
            values = [value for cell, value in of_task.items() if cell.table == table]
            print(f"{task} {table}: median {np.median(values):.2f}, {min(values):.2f} to {max(values):.2f}")
        seen = np.log([value for cell, value in of_task.items() if cell.table in CALIBRATED])
        print(f"{task}: geometric mean {np.exp(seen.mean()):.2f}, RMS of the logarithm {np.sqrt(np.mean(seen**2)):.2f}")


if __name__ == "__main__":
    main()
