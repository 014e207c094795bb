"""Half-wave or linear spindles of the arm, with all noise: which does `identify --law choose` take?

Run `python -m benchmarks.half_wave_choice [--people N] [--seed N] [--trials N] [--all] [--kept FILE]`. People are
drawn as in a study, in the position task. Half of them have half-wave rectified spindles (direction 0.7, threshold 0.15
rad/s), the other half respond both ways. Each does trials of 14 s with the person's noise, in one condition. The full
and the half-wave law are fitted to one half of the trials and judged by the other, and the other way round, as `choose`
does; the half-wave law is taken if its gain is significant. Masses and the mechanics of muscles are held at the truth:
gains, direction and threshold of the reflexes are fitted (5 s of a core per person with four trials). With `--all`
everything is fitted, as `choose` does (minutes).
"""

import argparse
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from armperturb.analysis.nonlinear.choice import N_PAIRS_OF_FOLDS, Judged, left_out_likelihood
from armperturb.analysis.nonlinear.estimate import fit
from armperturb.analysis.nonlinear.model import Law, Model, true_values
from armperturb.cohort import draw_person
from benchmarks.kept_rows import Row, with_kept_rows

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import nonlinear_trials as made

FREE = ("kv.shoulder", "kv.two-joint", "kv.elbow", "spindle_direction", "spindle_threshold")
HALF_WAVE = {"spindle_direction": 0.7, "spindle_threshold": 0.15}
LAWS: tuple[Law, ...] = ("full", "half-wave")


def judged(seed: int, n_trials: int, *, everything: bool) -> Row:
    """One person, of even number with half-wave spindles."""
    drawn = draw_person(seed, 0).subjects["PT"]
    is_half_wave = seed % 2 == 0
    person = replace(drawn, muscle=replace(drawn.muscle, **HALF_WAVE)) if is_half_wave else drawn
    started = time.process_time()
    forces = [made.push(100 * seed + number, 5.0) for number in range(n_trials)]
    trials = made.trial_set(made.record(person, forces, noisy=True, condition="PT7.5"))
    arms = {"PT7.5": replace(person, muscle=None)}
    fixed = {name: value for name, value in true_values(person, {}).items() if name not in FREE and not everything}
    halves = [range(first, n_trials, 2) for first in (0, 1)]
    results = {}
    for law in LAWS:
        known = fixed if law == "half-wave" else {n: v for n, v in fixed.items() if not n.startswith("spindle_t")}
        likelihood = []
        for train, test in (halves, halves[::-1]):
            result = fit([trials.take(train)], arms, Model(law=law, fixed=known), n_pairs=N_PAIRS_OF_FOLDS)
            likelihood.append(left_out_likelihood(result, [trials.take(test)], arms))
        results[law] = Judged(
            model=Model(law=law),
            estimate=None,
            log_likelihood=np.concatenate(likelihood),
            conditions=("PT7.5",) * n_trials,
            pulses=(),
        )
    gain = results["half-wave"].gain(results["full"])
    return {
        "seed": seed,
        "half_wave": is_half_wave,
        "chosen": gain.is_shown,
        "gain": gain.mean,
        "error": gain.standard_error,
        "seconds": time.process_time() - started,
    }


def rows_of(seeds: Iterable[int], options: argparse.Namespace) -> Iterable[Row]:
    """Rows as they come."""
    for seed in seeds:
        row = judged(seed, options.trials, everything=options.all)
        print(row, flush=True)
        yield row


def main(arguments: Sequence[str] = ()) -> None:
    """Print each person and how many choices were right."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--people", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="of the first person")
    parser.add_argument("--trials", type=int, default=6)
    parser.add_argument("--all", action="store_true", help="fit masses and the mechanics of muscles as well")
    parser.add_argument("--kept", type=Path, default=None, help="file of rows; a run that was stopped goes on")
    options = parser.parse_args(arguments)
    seeds = range(options.seed, options.seed + options.people)
    of_all = {"trials": options.trials, "all": options.all}
    rows = with_kept_rows(options.kept, seeds, lambda wanted: rows_of(wanted, options), **of_all)
    for kind, name in ((True, "half-wave"), (False, "linear")):
        of_kind = [row for row in rows if row["half_wave"] is kind]
        right = sum(row["chosen"] is kind for row in of_kind)
        print(f"{name} spindles: {right} of {len(of_kind)} chosen right")


if __name__ == "__main__":
    main(sys.argv[1:])
