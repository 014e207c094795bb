"""Standard errors of the thesis's estimator on synthetic people against the published ones, and why it fails.

Run by `python -m benchmarks.thesis_sem`; about 3 min. Linear people with noise, true instruments and practised
forces do PT7.5; every trial is fitted as appendix E does, and by the same criterion carried to its minimum.

Published SEMs exceed the values, and published estimates depend on their start. Both come back. SEMs are those of
eq. 2.22 with the modulus of the error; they grow with the root of the criterion, of which real arms leave nearly four
times as much as linear arms with noise do. And along the directions that a single trial says little about, the
published optimisation stops on its way: the minimum is elsewhere, and in most trials the same from every start. The
SEM over value of kp_s is not reproduced, because its published value is hardly more than its start.
"""

from dataclasses import replace

import numpy as np
import xarray as xr

from armperturb.analysis.fit.thesis import VARTHETA, ThesisEstimate, fit_starts, fit_trials
from armperturb.cohort import draw_cohort
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.study.protocol import THESIS
from armperturb.study.published import tables as published
from armperturb.study.recording.practice import practise
from armperturb.study.results.appendix_fits import joined

N_PEOPLE = 4
SEED = 3
FACTOR = 2.5
"""How far from the published SEM over value is a reproduction."""


def recordings() -> xr.Dataset:
    """All trials of PT7.5 of all people."""
    condition = THESIS.condition("PT7.5")
    protocol = replace(THESIS, conditions=(condition,))
    people = draw_cohort(N_PEOPLE, SEED, muscles="linear")
    forces = practise(people, protocol, SEED)
    trials = [
        trial for number, person in enumerate(people) for trial in protocol.trials(person, forces[number], SEED, number)
    ]
    return run_experiment(trials, instruments=Instruments(emg=None))


def spread_over_starts(estimates: dict[str, ThesisEstimate]) -> np.ndarray:
    """SD over the starts of model 3b of each estimate, over their mean, (trial, parameter)."""
    values = np.array([estimate.values for name, estimate in estimates.items() if name != "vartheta_i1"])
    return values.std(axis=0) / np.maximum(values.mean(axis=0), 1e-3)


def goodness(quantity: str, start: str) -> float:
    """Entry of table E.5."""
    return published.goodness_of_fit(quantity, "E.5", model="3a" if start == "vartheta_i1" else "3b", start=start)


def main() -> None:
    recording = recordings()
    people = [recording.isel(trial=recording["subject"].values == name) for name in np.unique(recording["subject"])]
    as_published = joined(fit_starts(person, VARTHETA) for person in people)
    starts = {name: initial for name, initial in VARTHETA.items() if name != "vartheta_i1"}
    to_the_end = joined(
        {name: fit_trials(person, "3b", initial=initial, as_published=False) for name, initial in starts.items()}
        for person in people
    )
    print(
        f"{'start':12} {'criterion':>10} {'published':>10} {'VAF x, y':>13} {'published':>11} "
        f"{'N_pos':>5} {'N_stab':>6}"
    )
    for name, estimate in as_published.items():
        printed = {what: goodness(what, name) for what in ("criterion", "VAF_x", "VAF_y")}
        vaf = estimate.mean_vaf()[0]
        print(
            f"{name:12} {estimate.criterion.mean():10.1f} {printed['criterion']:10.1f} {vaf[0]:5.0f} {vaf[1]:5.0f} % "
            f"{printed['VAF_x']:4.0f} {printed['VAF_y']:3.0f} % {estimate.n_positive:5} {estimate.n_stable:6}"
        )

    root = np.sqrt(
        np.mean([goodness("criterion", name) for name in as_published])
        / np.mean([estimate.criterion.mean() for estimate in as_published.values()])
    )
    print(f"\nmodel 3b, means over vartheta_i2 to vartheta_i6; root of the criterions' ratio = {root:.2f}")
    print(
        f"{'parameter':9} {'SEM/value':>10} {'published':>10} {'ratio':>6} {'SEM ratio':>10} {'x root':>7} "
        f"{'starts differ by':>17} {'at the minimum':>15}"
    )
    spread, left = (spread_over_starts(estimates) for estimates in (as_published, to_the_end))
    within = []
    names = as_published["vartheta_i2"].parameters
    for i, name in enumerate(names):
        mine, printed, plain = [], [], []
        for start in list(VARTHETA)[1:]:
            row = as_published[start].to_frame().iloc[i]
            value, sem = (
                published.estimate(name, table, model="3b", start=start, quantity=quantity).mean
                for table, quantity in (("E.3", "parameter"), ("E.4", "SEM"))
            )
            mine.append(row["sem_over_value"])
            printed.append(sem / value)
            plain.append(row["sem"] / sem)
        ratio = np.mean(mine) / np.mean(printed)
        within.append(1 / FACTOR <= ratio <= FACTOR)
        print(
            f"{name:9} {np.mean(mine):10.2f} {np.mean(printed):10.2f} {ratio:6.2f} {np.mean(plain):10.2f} "
            f"{np.mean(plain) * root:7.2f} {100 * np.median(spread[:, i]):15.0f} % "
            f"{100 * np.median(left[:, i]):13.1f} %"
        )
    print(f"SEM over value within a factor {FACTOR:g} of the published: {sum(within)} of {len(within)} parameters")
    for words, values in (("as published", spread), ("at the minimum", left)):
        agree = (values.max(axis=1) < 0.01).sum()
        print(f"all starts within 1 % of each other, {words}: {agree} of {len(values)} trials")


if __name__ == "__main__":
    main()
