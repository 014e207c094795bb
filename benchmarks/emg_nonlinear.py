"""What EMG adds to a nonlinear fit: errors of reflexes and of the muscle law with and without it.

Run `python -m benchmarks.emg_nonlinear [--people N] [--first N] [--seed N] [--alone]`; some two minutes of a core per
person, three with `--alone`. Nonlinear people of the position task go through the trials of PT2.5, PT7.5 and PT22.5 and
a maximal contraction. The full law is fitted with free delays to movement and EMG, with `--alone` to the movement as
well. Printed are, person by person, each reflex parameter with its truth, the standard error of its coordinate
(`nonlinear.model`) and the error over it; in the end how many errors are within 1.96 standard errors, and the median
ratio of standard errors with EMG over those without.
"""

import argparse
import sys
import time
from collections.abc import Sequence

import numpy as np

from armperturb.analysis.emg.envelope import envelopes
from armperturb.analysis.nonlinear.estimate import fit
from armperturb.analysis.nonlinear.model import Model, coordinate, stem, true_values
from armperturb.analysis.nonlinear.result import NonlinearEstimate
from armperturb.analysis.nonlinear.spindle_emg import REFLEX, usable_emg
from armperturb.analysis.nonlinear.start import linear_arms
from armperturb.analysis.nonlinear.trials import fitted_conditions, training_sets
from armperturb.cohort import Person, draw_cohort
from benchmarks.emg import MOVED, MOVING, recorded


def fits_of(person: Person, number: int, seed: int, *, alone: bool) -> dict[str, NonlinearEstimate]:
    """Fits with EMG and, if asked for, without, by name."""
    recording, _ = recorded(person, number, MOVING, seed)
    is_used = np.isin(recording["condition"].values, MOVED) & np.isnan(recording["limit_time"].values)
    recording = recording.isel(trial=np.flatnonzero(is_used))
    conditions = fitted_conditions(recording)
    sets, _ = training_sets(conditions)
    arms = linear_arms(conditions)
    emg = usable_emg(conditions, arms, envelopes(recording), 0.0)
    uses = {"EMG": emg, **({"alone": None} if alone else {})}
    return {name: fit(sets, arms, Model(free=("Td",)), emg=used) for name, used in uses.items()}


def main(arguments: Sequence[str] = ()) -> None:
    """Print what each person's fits give, and how right they are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=6)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=812)
    parser.add_argument("--alone", action="store_true")
    options = parser.parse_args(arguments)
    errors: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for number, person in list(enumerate(draw_cohort(options.first + options.people, options.seed)))[options.first :]:
        levels = {name: level for name, level in person.levels.items() if name in MOVED}
        true = true_values(person.subjects["PT"], levels)
        before = time.process_time()
        for use, outcome in fits_of(person, number, options.seed, alone=options.alone).items():
            print(f"{person.name}, {use}: {outcome.message}, {time.process_time() - before:.0f} CPU s")
            for name in outcome.parameters.names:
                size = outcome.coordinate_error[name]
                off = (coordinate(name, outcome.values[name]) - coordinate(name, true[name])) / size
                errors.setdefault((use, name), []).append((size, off))
                if stem(name) in REFLEX:
                    said = f"{outcome.values[name]:8.3f} ({true[name]:.3f})"
                    print(f"    {name:20} {said}, standard error {size:.3f}, off by {off:+.1f}", flush=True)
    for use in dict.fromkeys(use for use, _ in errors):
        for what, of_reflexes in (("reflexes and levels", True), ("all others", False)):
            off = [
                each
                for (its, name), pairs in errors.items()
                if its == use and (stem(name) in REFLEX) == of_reflexes
                for _, each in pairs
            ]
            held, rms = 100.0 * np.mean(np.abs(off) < 1.96), np.sqrt(np.mean(np.square(off)))
            print(
                f"{use}, {what}: {held:.1f} % of {len(off)} errors within 1.96 standard errors, RMS of them {rms:.2f}"
            )
    if options.alone:
        for name in dict.fromkeys(name for _, name in errors):
            ratios = [a / b for (a, _), (b, _) in zip(errors["EMG", name], errors["alone", name], strict=True)]
            print(f"{name:32} standard error with EMG over that without: {np.median(ratios):.2f}")


if __name__ == "__main__":
    main(sys.argv[1:])
