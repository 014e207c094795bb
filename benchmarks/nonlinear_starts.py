"""How far apart do nonlinear fits of one person end that start at different places?

Run `python -m benchmarks.nonlinear_starts [--person N] [--task PT] [--starts N] [--parts N] [--pairs N]`: person N of
the default cohort (seed 0, compiled engine, all noise), fitted from multisines alone, first from the usual start and
then from that start with every parameter changed by 20 % (SD of the coordinate, seeds 1, 2, ...). Each later end is
compared with the first one, in standard errors of the first fit. `--parts` are the elasto-plastic parts of each muscle
group in the fit; the person has 8. `--pairs 0` leaves the person's noise out of the predictions, so that a fit ends
where the likelihood without noise is largest. A fit of the position task takes half a minute of a core, with 32 parts
more than a minute.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from armperturb.analysis.nonlinear.estimate import N_PAIRS, fit, free_parameters, nearest_arms
from armperturb.analysis.nonlinear.model import Model, value_at
from armperturb.analysis.nonlinear.problem import Problem
from armperturb.analysis.nonlinear.start import best_start, linear_arms, start_values
from armperturb.analysis.nonlinear.trials import fitted_conditions, training_sets
from armperturb.muscle_law import MuscleLaw
from armperturb.recording_files import load_recording
from armperturb.study.recording.record import record_study
from armperturb.study.recording.settings import StudySettings

CHANGE = 0.2
"""SD by which coordinates of a start are changed [-]."""


def main(arguments: Sequence[str] = ()) -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--person", type=int, default=1)
    parser.add_argument("--task", choices=("PT", "RT"), default="PT")
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument("--parts", type=int, default=MuscleLaw.parts)
    parser.add_argument("--pairs", type=int, default=N_PAIRS)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        record_study(StudySettings(subjects=options.person, engine="compiled"), Path(folder), workers=1)
        recording = load_recording(Path(folder) / "recordings" / f"S{options.person:02d}.nc")
    # A trial whose pulse took the handle to the workspace limit is refused by the fit: it is left out.
    inside = (recording["task"].values == options.task) & np.isnan(recording["limit_time"].values)
    conditions = fitted_conditions(recording.isel(trial=np.flatnonzero(inside)))
    sets, arms, model = training_sets(conditions)[0], linear_arms(conditions), Model(parts=options.parts)
    parameters, everywhere = free_parameters(sets, model), nearest_arms(sets, arms)
    point = start_values(parameters, sets, everywhere, {})
    usual = best_start(Problem(parameters, sets, everywhere), point, {}).point
    first = None
    for number in range(options.starts + 1):
        change = CHANGE * np.random.default_rng(number).standard_normal(len(usual)) if number else 0.0
        changed = np.clip(usual + change, parameters.lower, parameters.upper)
        started = time.process_time()
        initial = {name: value_at(name, at) for name, at in zip(parameters.names, changed, strict=True)}
        try:
            result = fit(sets, arms, model, initial=initial, n_pairs=options.pairs)
        except ValueError as error:
            print(f"start {number}: {error}", flush=True)
            continue
        took = f"{time.process_time() - started:.0f} s of the processor, {result.message}"
        if first is None:
            first = result
            print(f"usual start: {took}", flush=True)
            continue
        errors = np.array([first.coordinate_error[name] for name in parameters.names])
        apart = np.abs(result.state.point - first.state.point) / errors
        furthest = parameters.names[int(np.argmax(apart))]
        print(
            f"start {number}: {np.sqrt(np.mean(apart**2)):.2f} standard errors from the first (RMS), at most "
            f"{apart.max():.2f} ({furthest}); {took}",
            flush=True,
        )


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
