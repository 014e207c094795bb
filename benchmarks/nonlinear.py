"""Nonlinear identification against known truth: the default cohort under the thesis's protocol.

Run `python -m benchmarks.nonlinear [--people N ...] [--parts RT ...] [--seeds N ...] [--workers N] [--recordings
FOLDER] [--pairs N]`. All of it takes two hours on 4 cores; tables are printed after each fit, so that a run may be
stopped. `--people 2 5` and `--seeds 0 3 4` are those people and seeds alone. `--recordings` takes S01.nc ... of a study
that was simulated before (seed 0) instead of simulating one. Each worker simulates in one thread.

Parts:

- "RT", "PT": fits of one task from its multisines at three amplitudes alone; all pulses are left out.
- "RT+", "PT+": pulses of one direction are fitted as well; those of the other are left out.
- "linear RT", "linear PT": truly linear people, one per seed: how often is a law that yields rejected?

Models beside the nonlinear one, for pulses: "linear", the arm that fits the condition's own multisine best (estimator
"record"; without one, as in PT0 and RT0, that of the condition whose movements are nearest in size); "skeletal", the
same arm with the geometry of two segments that turn (thesis 2.8); "truth", the true person in an average trial without
noise, whom no model can beat by more than luck. PT0 has no multisine, hence no known level of co-contraction in "PT":
its pulses are predicted at that of PT7.5, which is not the person's there.

z is the error of a parameter's logarithm (of its `coordinate`, if it may be negative) over its standard error; over
people it should have a mean of 0 and an SD of 1, and 95 % of intervals should hold the truth. A parameter is told if
that standard error is at most a quarter.
"""

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from armperturb.analysis.nonlinear.choice import compare_laws
from armperturb.analysis.nonlinear.estimate import N_PAIRS
from armperturb.analysis.nonlinear.identify import identify_nonlinear
from armperturb.analysis.nonlinear.model import coordinate, true_values
from armperturb.analysis.nonlinear.prediction import PulsePrediction, median_peak, predict_pulses
from armperturb.analysis.nonlinear.result import UNCERTAIN, NonlinearEstimate
from armperturb.analysis.nonlinear.start import linear_arms
from armperturb.analysis.nonlinear.trials import fitted_conditions, training_sets
from armperturb.analysis.results import quantile
from armperturb.cohort import Person, draw_person
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.recording_files import load_recording
from armperturb.study.protocol import THESIS
from armperturb.study.recording.record import record_study
from armperturb.study.recording.settings import StudySettings

PARTS = ("RT", "RT+", "PT", "PT+", "linear RT", "linear PT")
MODELS = ("nonlinear", "linear", "skeletal", "truth")
FITTED_DIRECTION = 20.0

SUMMARY = {
    "short-range stiffness": "short_range_stiffness",
    "elastic limits": "elastic_limit_deg",
    "shear-thinning damping": "thinning_velocity",
    "loss angle": "loss_angle_deg",
    "recovery time": "recovery_time",
}
"""What the target names, to the parameters that it is about."""

RATIO = "loss_angle_deg / recovery_time"
"""Speed at which half of the bonds are worn off for good [deg/s]: told better than either."""


class Results:
    """What has been measured so far."""

    def __init__(self) -> None:
        self.pulses: dict[tuple[str, str, str], list[PulsePrediction]] = defaultdict(list)
        """Of part, condition and model."""
        self.errors: dict[tuple[str, str], list[tuple[float, float, bool]]] = defaultdict(list)
        """Of part and parameter: error of the logarithm, its standard error, and whether the interval holds truth."""
        self.seconds: dict[str, list[tuple[float, float]]] = defaultdict(list)
        """Of part: by the clock, and of the processor."""
        self.unsettled: dict[str, int] = defaultdict(int)
        self.verdicts: dict[str, list[tuple[str, float]]] = defaultdict(list)
        """Of part: the law that was chosen, and the time by the clock [s]."""

    def add(self, other: "Results") -> None:
        for name in ("pulses", "errors", "seconds", "verdicts"):
            for key, outcome in getattr(other, name).items():
                getattr(self, name)[key] += outcome
        for part, number in other.unsettled.items():
            self.unsettled[part] += number

    def print(self) -> None:
        for part in dict.fromkeys(part for part, _, _ in self.pulses):
            print(f"\n{part}: left-out pulses, median over pulses and people of peak [%] (VAF of the trajectory [%])")
            print(f"{'condition':12}{'pulses':>7}" + "".join(f"{model:>18}" for model in MODELS))
            for condition in sorted({label for own, label, _ in self.pulses if own == part}):
                line = f"{condition:12}{len(self.pulses[part, condition, MODELS[0]]):7d}"
                for model in MODELS:
                    of = self.pulses[part, condition, model]
                    line += f"{np.median([entry.peak for entry in of]):10.1f}"
                    line += f" ({np.median([entry.vaf for entry in of]):5.1f})"
                print(line)
        for part in dict.fromkeys(part for part, _ in self.errors):
            print(f"\n{part}: parameters, n people; error of the logarithm in %, 95 % intervals that hold the truth")
            print(f"{'parameter':34}{'n':>3}{'median':>8}{'mean':>8}{'claimed':>9}{'mean z':>8}{'SD z':>7}{'hold':>6}")
            of_part = {name: outcome for (own, name), outcome in self.errors.items() if own == part}
            for name, outcome in of_part.items():
                print(_line(name, outcome))
            for title, stem in SUMMARY.items():
                both = [
                    entry for name, outcome in of_part.items() if name.partition(".")[0] == stem for entry in outcome
                ]
                if both:
                    stated = np.mean([error <= UNCERTAIN for _, error, _ in both])
                    print(_line(f"all: {title}", both) + f"  told in {100.0 * stated:.0f} %")
            print(
                _line(
                    "all parameters", [entry for name, outcome in of_part.items() if name != RATIO for entry in outcome]
                )
            )
            clock, processor = np.array(self.seconds[part]).T
            print(
                f"{part}: time of a fit {np.median(clock):.0f} s by the clock (longest {clock.max():.0f} s), "
                f"{np.median(processor):.0f} s of the processor; {self.unsettled[part]} of {len(clock)} not settled"
            )
        for part, verdicts in self.verdicts.items():
            linear = [law == "linear" for law, _ in verdicts]
            print(
                f"\n{part}: yielding muscle rejected in {100.0 * np.mean(linear):.0f} % of {len(linear)} seeds "
                f"(target: at least 90 %); {np.median([took for _, took in verdicts]):.0f} s each"
            )
        print(flush=True)


def _line(name: str, outcome: Sequence[tuple[float, float, bool]]) -> str:
    error, claimed, holds = np.array(outcome, dtype=float).T
    z = error / claimed
    spread = f" {z.std(ddof=1):6.2f}" if len(z) > 1 else f"{'':7}"
    return (
        f"{name:34}{len(z):3d}{100.0 * np.median(np.abs(error)):8.1f}{100.0 * error.mean():+8.1f}"
        f"{100.0 * np.median(claimed):9.2g} {z.mean():+7.2f}{spread}{100.0 * holds.mean():6.0f}"
    )


def _ratio(estimate: NonlinearEstimate, known: Mapping[str, float]) -> tuple[float, float, bool]:
    """Error of the logarithm of `RATIO`, its standard error, and whether an interval of 95 % holds the truth."""
    names, (above, below) = list(estimate.values), RATIO.split(" / ")
    error = float(np.log(estimate.values[above] / known[above] / (estimate.values[below] / known[below])))
    first, second = estimate.coordinate_error[above], estimate.coordinate_error[below]
    shared = estimate.correlation[names.index(above), names.index(below)] * first * second
    claimed = float(np.sqrt(first**2 + second**2 - 2.0 * shared))
    return error, claimed, abs(error) < quantile(0.95) * claimed


def fit_person(part: str, path: Path, truth: Person, n_pairs: int = N_PAIRS) -> tuple[str, Results]:
    """Identify a person in one task, and compare with what is known; says how that went."""
    results, task, recording = Results(), part[:2], load_recording(path)
    # A trial whose pulse took the handle to the workspace limit is refused by the fit: it is left out.
    inside = (recording["task"].values == task) & np.isnan(recording["limit_time"].values)
    recording = recording.isel(trial=np.flatnonzero(inside))
    clock, processor = time.perf_counter(), time.process_time()
    directions = [FITTED_DIRECTION] if part.endswith("+") else []
    outcome = identify_nonlinear(recording, pulse_directions_deg=directions, n_pairs=n_pairs)
    clock, processor = time.perf_counter() - clock, time.process_time() - processor
    estimate = outcome.estimate
    results.seconds[part].append((clock, processor))
    results.unsettled[part] += not estimate.converged
    known = true_values(truth.subjects[task], truth.levels)
    for name, value in estimate.values.items():
        low, high = estimate.interval(name)
        results.errors[part, name].append(
            (
                coordinate(name, value) - coordinate(name, known[name]),
                estimate.coordinate_error[name],
                low <= known[name] <= high,
            )
        )
    results.errors[part, RATIO].append(_ratio(estimate, known))
    pulses = {model: list(of) for model, of in outcome.pulses.items()} | {"truth": []}
    for entry in training_sets(fitted_conditions(recording), directions)[1]:
        pulses["truth"] += predict_pulses(entry, THESIS.condition(entry.label).subject_of(truth))
    own = defaultdict(list)
    for model in MODELS:
        for pulse in pulses[model]:
            own[pulse.condition, model].append(pulse)
            results.pulses[part, pulse.condition, model].append(pulse)
    peaks = [f"{label} {median_peak(of):.0f}" for (label, model), of in own.items() if model == MODELS[0]]
    said = (
        f"{truth.name} {part}: {estimate.message} after {estimate.n_steps} steps, {clock:.0f} s by the clock, "
        f"{processor:.0f} s of the processor; peaks [%] {', '.join(peaks)}"
    )
    return said, results


def judge_linear_person(part: str, seed: int) -> tuple[str, Results]:
    """Compare laws on the trials of a person whose muscles are linear, in one task; says what is chosen."""
    results, task = Results(), part.removeprefix("linear ")
    person = draw_person(seed, 0, muscles="linear")
    trials = [entry for entry in THESIS.trials(person, THESIS.given_forces(), seed, 0) if entry.subject.task == task]
    recording = run_experiment(trials, instruments=Instruments(emg=None, marker_noise=None), n_threads=1)
    clock = time.perf_counter()
    # Pulses have no say in the choice: they are not predicted here.
    conditions = fitted_conditions(recording)
    choice = compare_laws(training_sets(conditions)[0], linear_arms(conditions))
    results.verdicts[part].append((choice.chosen, time.perf_counter() - clock))
    return f"{part}, seed {seed}: {choice.chosen} chosen; {'; '.join(choice.verdict())}", results


def main(arguments: Sequence[str] = ()) -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--people", type=int, nargs="+", default=list(range(1, 11)))
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(20)))
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--pairs", type=int, default=N_PAIRS, help="of noise draws in predictions; 0 leaves noise out")
    parser.add_argument("--recordings", type=Path, default=None)
    options = parser.parse_args(arguments)
    results, of_people = Results(), [part for part in options.parts if not part.startswith("linear")]
    with (
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(options.workers, get_context("spawn")) as pool,
    ):
        recordings = options.recordings or Path(folder) / "recordings"
        if of_people and options.recordings is None:
            settings = StudySettings(subjects=max(options.people), engine="compiled")
            record_study(settings, Path(folder), workers=options.workers)
        jobs = [
            pool.submit(fit_person, part, recordings / f"S{number:02d}.nc", draw_person(0, number - 1), options.pairs)
            for part in of_people
            for number in options.people
        ]
        linear = [part for part in options.parts if part not in of_people]
        jobs += [pool.submit(judge_linear_person, part, seed) for part in linear for seed in options.seeds]
        for job in as_completed(jobs):
            said, outcome = job.result()
            results.add(outcome)
            print(said)
            results.print()


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
