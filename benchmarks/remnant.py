"""Which spectrum of the remnant gives the published VAF and criterion, and what the person is who then fits the tables.

Run by `python -m benchmarks.remnant --cutoff 20 --share 0.9 --fast-share 0`, or `--share 0.35 --fast-share 0.7` for
a remnant in two parts; some 10 s of one core, with `--calibrate` half a minute more. The average person goes through
four trials per condition under the published mean forces. One model is fitted to their admittances as in step 2 of
appendix C, from the published means of step 1: model 3 in PT, model 1 in RT. Printed are criterion and VAF, in brackets
the published ones (tables C.12, C.22), the multiple coherence up to 1.5 Hz, to 10 Hz and above, and the RMS
displacement. Trials that leave the workspace are not counted. With `--calibrate`, the person is calibrated anew under
this noise before (tables 2.1, F.2 to F.4), and the shares of calibrated and held-out cells (F.5, F.6) are printed. With
`--fits N`, the shares of the task's cells of appendices C to E within 0.5, 1 and 2 SD are printed that N replicates of
the person have, from neutral starts; but for the criterion and VAF above, none is sought.
"""

import argparse
from dataclasses import replace

import numpy as np

from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.fit.thesis import fit_trials
from armperturb.analysis.response.spectra import single_trial_spectra
from armperturb.analysis.trials import trials_by_condition
from armperturb.cohort import Person, average_person
from armperturb.controllers.remnant import HumanNoise
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.perturbations.multisine import PERIOD
from armperturb.study.comparison.score import fitted_cells, share
from armperturb.study.experiments.calibration import calibrate, schedules
from armperturb.study.published import tables as published
from armperturb.study.results.appendix_fits import first_start
from benchmarks.noise_options import add_noise_options, noise_of
from benchmarks.print_ceiling import arms_of, fits_of

JUDGED = {"PT": ("3", "C.12"), "RT": ("1", "C.22")}
"""Task to the model by which the noise is set, and the table of its criterion and VAF."""

BANDS = (0.0, 1.5, 10.0, 100.0)
"""Edges of the bands of the coherence [Hz]."""


def rows(person: Person, task: str, noise: HumanNoise, seed: int) -> list[str]:
    """A line per condition."""
    protocol, _ = schedules(task)
    trials = [replace(trial, noise=noise) for trial in protocol.trials(person, protocol.given_forces(), seed, 0)]
    recording = run_experiment(trials, engine="compiled", instruments=Instruments(marker_noise=None, emg=None))
    inside = recording.isel(trial=np.flatnonzero(np.isnan(recording["limit_time"].values)))
    multisines = {name: trials.multisine for name, trials in trials_by_condition(inside).items()}
    model, table = JUDGED[task]
    start = first_start(model, task, "published")
    estimates = [fit_trials(trials, model, initial=start) for trials in multisines.values()]
    rate = float(recording.attrs["rate"])
    window = slice(round(WINDOW_START * rate), round((WINDOW_START + PERIOD) * rate))
    lines = []
    for (name, of_condition), estimate in sorted(zip(multisines.items(), estimates, strict=True), key=_amplitude):
        spectra = single_trial_spectra(of_condition)
        coherence = np.mean([each.coherence.mean(axis=1) for each in spectra], axis=0)
        band = np.digitize(spectra[0].frequency, BANDS)
        means = " / ".join(f"{coherence[band == number].mean():.2f}" for number in range(1, len(BANDS)))
        vaf = estimate.mean_vaf()[0]
        printed = [
            published.goodness_of_fit(quantity, table, model=model, condition=name)
            for quantity in ("criterion", "VAF_x", "VAF_y")
        ]
        moved = inside["displacement"].values[inside["condition"].values == name]
        rms = 1e3 * np.sqrt(np.mean(moved[:, window] ** 2))
        lines.append(
            f"{name:6} {len(spectra)} of {np.sum(recording['condition'].values == name)} trials: "
            f"criterion {estimate.criterion.mean():.0f} ({printed[0]:.0f}), VAF {vaf[0]:.0f} {vaf[1]:.0f} "
            f"({printed[1]:.0f} {printed[2]:.0f}), coherence {means}, {rms:.1f} mm"
        )
    return lines


def _amplitude(item: tuple) -> float:
    return float(item[0][0][2:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="PT", choices=list(JUDGED))
    add_noise_options(parser)
    parser.add_argument("--seed", type=int, default=700)
    parser.add_argument("--calibrate", action="store_true")
    parser.add_argument("--multisines", type=int, default=1, help="sets of multisines that the calibration sees")
    parser.add_argument("--iterations", type=int, default=6, help="of the calibration")
    parser.add_argument("--fits", type=int, default=0, help="replicates of 20 trials each, of which C to E are fitted")
    options = parser.parse_args()
    noise = noise_of(options, options.task)
    person = average_person()
    if options.calibrate:
        search = {"n_multisines": options.multisines, "max_iterations": options.iterations}
        calibration = calibrate(options.task, noise=noise, n_threads=1, **search)
        print(calibration.summary())
        person = calibration.candidate.person
    print(noise)
    print("\n".join(rows(person, options.task, noise, options.seed)))
    if options.fits:
        arms = arms_of(replace(person, subjects={options.task: person.subjects[options.task]}))
        cells = fitted_cells(fits_of(arms, {options.task: noise}, 11, options.fits, "neutral"))
        own = [each for each in cells if each.cell.condition.startswith(options.task)]
        for appendix in "CDE":
            parts = share(each for each in own if each.cell.table[0] == appendix).parts
            print(appendix, *(f"{100.0 * part:.0f} %" for part in parts))


if __name__ == "__main__":
    main()
