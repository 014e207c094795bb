"""Where the published search starts, and how much of the score that makes.

Run by `python -m benchmarks.starts FOLDER`, a recorded study; some 2 min of one core per person. Appendix C is fitted
to everybody's trials from three starts (`AnalysisSettings.start`): neutral, published, and the published ones times
log-normal factors of SD 0.4. A cell that is within 1 SD from the published start and not from the scattered one was
made by the start: the search stopped where it began.
"""

import argparse
from pathlib import Path

from armperturb.analysis.trials import trials_by_condition
from armperturb.recording_files import load_recording
from armperturb.study.comparison.score import ScoredCell, fitted_cells
from armperturb.study.recording.folder import find_recordings
from armperturb.study.results.appendix_fits import Appendices, fit_person, fit_second_step, joined, means_of
from armperturb.study.results.settings import AnalysisSettings, Start
from armperturb.subject import TASKS

STARTS: tuple[Start, ...] = ("neutral", "published", "scattered")


def fits_from(start: Start, paths: list[Path]) -> Appendices:
    """Appendix C of everybody, from one start."""
    settings = AnalysisSettings(start=start, starts_of=None)
    first = joined(fit_person(trials_by_condition(load_recording(path, [])), settings).first for path in paths)
    means = means_of(first)
    seconds = (fit_second_step(trials_by_condition(load_recording(path, [])), means) for path in paths)
    return Appendices(first=first, second=joined(step.estimates for step in seconds))


def near(cell: ScoredCell) -> bool:
    """Whether the cell is within 1 SD."""
    return abs(cell.z) <= 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--people", type=int, help="only the first so many")
    options = parser.parse_args()
    paths = list(find_recordings(options.folder)[0])[: options.people]
    fits = {start: fits_from(start, paths) for start in STARTS}
    cells = {start: fitted_cells(of_start) for start, of_start in fits.items()}
    kinds = {"C, PT": "PT", "C, RT": "RT", "C": ""}
    print(f"{len(paths)} people; cells of appendix C within 1 published SD")
    for name, task in kinds.items():
        some = {
            start: [
                each
                for each in of_start
                if each.cell.table[0] == "C" and each.cell.condition.startswith(task) and each.published.sd > 0.0
            ]
            for start, of_start in cells.items()
        }
        n = len(some["neutral"])
        each = ", ".join(f"{start} {sum(map(near, some[start]))}" for start in STARTS)
        pairs = zip(some["published"], some["scattered"], strict=True)
        made = sum(near(published) and not near(scattered) for published, scattered in pairs)
        print(f"{name:6} of {n}: {each}; made by the start: {made}")
    for start, of_start in fits.items():
        for task in TASKS:
            of_6 = [fit for (condition, model), fit in of_start.second.items() if (condition[:2], model) == (task, "6")]
            n, stable = sum(len(fit.fits) for fit in of_6), sum(fit.n_stable for fit in of_6)
            print(f"{start}, {task}: {n - stable} of {n} fits of model 6 end unstable")


if __name__ == "__main__":
    main()
