"""Whether reflexes with a fast part, and the admittance that is printed, give a better average person in PT.

Run by `python -m benchmarks.fast_reflexes --law acceleration --cutoff 20 --share 0.9 --fast-share 0`; some 2 min of
one core. The average person of the position task is sought as `armperturb calibrate` does (tables 2.1, F.2 to F.4),
and so that the best linear approximation in PT7.5 is the arm of the mean parameters of model 5 (table C.8): a band of
frequencies counts as one standard deviation where it is `OFF` of the printed admittance off. Grip and delays are those
of C.8, with `--grip usual` those of all people. `--voluntary` sets the share of slow corrections, which add to the
peaks of pulses.

Laws: `slow` is the law of the position task; `cutoff` has the cut-off of the activation as an unknown; `acceleration`
has feedback of acceleration, from gains near those of model 5, with the cut-off of C.8. `--start yielding` begins at
strong short-range stiffness and levels far apart, `--start intact` at weak ones and levels near one. Printed are the
parts of the objective, cells within 0.5, 1 and 2 SD on multisines that the search did not see (F.5 and F.6 held out),
how far the admittance is off, and with `--fits N` the share of the cells of appendices C to E that N replicates of the
person have within 0.5, 1 and 2 SD, from neutral starts. None of these cells but C.8's is sought.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import optimize

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.response.spectra import averaged_spectra
from armperturb.analysis.trials import trials_by_condition
from armperturb.arrays import Array
from armperturb.cohort import Person
from armperturb.controllers.remnant import HumanNoise
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.muscle_law import ELEMENTS
from armperturb.study.comparison.score import fitted_cells, share
from armperturb.study.experiments import calibration
from armperturb.study.experiments.candidates import Candidate, Unknown, unknowns
from armperturb.study.protocol import THESIS
from armperturb.study.results.quantities import LIMITS, Cell, published_cells
from armperturb.study.results.uses import CALIBRATED, HELD_OUT
from benchmarks.noise_options import add_noise_options, noise_of
from benchmarks.print_ceiling import arms_of_tables, fits_of

EDGES = np.geomspace(0.28, 16.0, 17)
"""Of the bands in which admittances are compared [Hz]: beyond them there is mass and grip alone."""

OFF = 0.35
"""Error of the admittance, over its norm, that counts as one standard deviation [-]. Assumed: the printed parameters
have SDs over people of 10 to 60 %."""

OF_C8 = {"Td_s": 0.0322, "Td_e": 0.0328, "b_h": 70.1, "k_h": 27800.0}
"""Delays [s] and grip [Ns/m, N/m] of model 5 in table C.8."""

CUTOFF = 2.8
"""Cut-off of the activation in table C.8, model 5 [Hz]."""

FAST = (
    Unknown("ka.shoulder", 0.2, 2.7, 0.15),
    Unknown("ka.two-joint", 0.3, 2.7, 0.3),
    Unknown("ka.elbow", 0.5, 2.7, 0.4),
)
"""Gains of acceleration feedback of each group [Nms^2/rad]."""

KP = {"kp.shoulder": (15.0, 3.0), "kp.two-joint": (60.0, 3.0), "kp.elbow": (120.0, 3.0)}
"""Typical values and factors of position feedback beside acceleration feedback [Nm/rad]: those of C.8, model 5."""

NEAR_C8 = {
    **{f"{name}.shoulder": value for name, value in (("k", 25.0), ("kv", 6.0))},
    **{f"{name}.two-joint": value for name, value in (("k", 25.0), ("kv", 10.0), ("b", 3.0))},
    **{f"{name}.elbow": value for name, value in (("k", 15.0), ("kv", 8.0), ("b", 6.0))},
    "thinning_velocity": 3.0,
    "spindle_saturation": 2.5,
}
"""Where the search for acceleration feedback starts: near the groups of C.8, model 5, with little departure from linear
damping and spindles. The single-joint stiffness of the elbow is negative there, which a muscle's cannot be."""

STARTS: dict[str, dict[str, float]] = {
    "yielding": {},
    "intact": {
        **{f"short_range_stiffness.{element}": 8.0 for element in ELEMENTS},
        "level.PT0": 0.6,
        "level.PT2.5": 0.85,
        "level.PT22.5": 1.25,
    },
}
"""Where the search starts, beside the usual."""


def sought(law: str) -> tuple[Unknown, ...]:
    """The unknowns of a law."""
    usual = unknowns("PT", "full")
    if law == "slow":
        return usual
    if law == "cutoff":
        return *usual, Unknown("cutoff", 3.5, 2.0, 3.5)
    changed = [
        each._replace(typical=KP[each.name][0], factor=KP[each.name][1], start=KP[each.name][0])
        if each.name in KP
        else each
        for each in usual
    ]
    return *changed, *FAST


def candidate_of(law: str, grip: str, values: Mapping[str, float]) -> Candidate:
    """The person with these values of the unknowns."""
    candidate = Candidate.of("PT", values)
    changes: dict[str, Any] = dict(OF_C8) if grip == "printed" else {}
    if law == "acceleration":
        s, se, e = (values[unknown.name] for unknown in FAST)
        changes |= {"ka_s": s + se, "ka_se": se, "ka_e": e + se, "fact_s": CUTOFF, "fact_e": CUTOFF}
    if law == "cutoff":
        changes |= {"fact_s": values["cutoff"], "fact_e": values["cutoff"]}
    return replace(candidate, subject=replace(candidate.subject, **changes))


def wanted(tables: Sequence[str]) -> dict[Cell, tuple[float, float]]:
    """Means and SDs of cells of PT; force is given."""
    return {
        cell: (value.mean, value.sd)
        for cell, value in published_cells().items()
        if cell.table in tables and cell.condition.startswith("PT") and cell.quantity != "rms_force"
    }


def admittance_errors(candidates: Sequence[Candidate], seeds: Sequence[int], noise: HumanNoise) -> list[Array | None]:
    """Of each candidate in PT7.5, over the norm of what is printed, (band, 2, 2), complex; None outside the workspace.

    Args:
      candidates: who is perturbed.
      seeds: of the multisines.
      noise: of the people.
    """
    protocol, _ = calibration.schedules("PT")
    only = replace(protocol, conditions=tuple(each for each in protocol.conditions if each.name == "PT7.5"))
    printed = arms_of_tables({"PT": "5", "RT": "1"})["PT7.5"]
    trials = [
        replace(trial, noise=calibration.steady(noise))
        for candidate in candidates
        for seed in seeds
        for trial in only.trials(candidate.person, protocol.given_forces(), seed, 0)
    ]
    recording = run_experiment(trials, engine="compiled", n_threads=1)
    size, errors = len(trials) // len(candidates), list[Array | None]()
    for first in range(0, len(trials), size):
        own = recording.isel(trial=slice(first, first + size))
        if np.isfinite(own["limit_time"].values).any():
            errors.append(None)
            continue
        spectra = averaged_spectra(trials_by_condition(own)["PT7.5"])
        expected = arm_admittance(printed, spectra.frequency)
        off = (spectra.arm - expected) / np.linalg.norm(expected, axis=(1, 2))[:, None, None]
        band = np.digitize(spectra.frequency, EDGES)
        errors.append(np.array([off[band == number].mean(axis=0) for number in sorted({*band} - {0, len(EDGES)})]))
    return errors


class Search:
    """Residuals over points: logarithms of the unknowns relative to what is typical, over their factors'."""

    def __init__(self, law: str, grip: str, noise: HumanNoise, seeds: Sequence[int]) -> None:
        self.law, self.grip, self.noise, self.seeds, self.unknowns = law, grip, noise, seeds, sought(law)
        self.environment = Environment()

    def candidate(self, point: Array) -> Candidate:
        values = {u.name: float(u.typical * u.factor**step) for u, step in zip(self.unknowns, point, strict=True)}
        return candidate_of(self.law, self.grip, values)

    def parts(self, points: Sequence[Array]) -> list[tuple[Array, ...] | None]:
        """Residuals of cells, unknowns, poles and admittance at points; None where nothing can be simulated."""
        candidates = [self.candidate(point) for point in points]
        cells = calibration.simulated_cells(candidates, self.seeds, noise=self.noise, n_threads=1)
        able = [number for number, each in enumerate(cells) if each is not None]
        if not able:
            return [None] * len(points)
        errors = dict(
            zip(able, admittance_errors([candidates[number] for number in able], self.seeds, self.noise), strict=True)
        )
        goal, answers = wanted(CALIBRATED), list[tuple[Array, ...] | None]()
        for number, (candidate, point, of_one) in enumerate(zip(candidates, points, cells, strict=True)):
            if of_one is None or (off := errors[number]) is None:
                answers.append(None)
                continue
            pole = calibration.poles(candidate, self.environment)
            answers.append(
                (
                    np.array([(of_one[cell] - mean) / sd for cell, (mean, sd) in goal.items()]),
                    point,
                    np.maximum(pole + calibration.MARGIN, 0.0) / calibration.MARGIN_SD,
                    np.concatenate([off.real.ravel(), off.imag.ravel()]) / OFF,
                )
            )
        return answers

    def residuals(self, point: Array) -> Array:
        parts = self.parts([point])[0]
        residuals = np.full(self.size, np.inf) if parts is None else np.concatenate(parts)
        print(f"objective {np.sum(residuals**2):.2f}", flush=True)
        return residuals

    def slopes(self, point: Array) -> Array:
        steps = np.array(
            [(-1.0 if u.slope_down else 1.0) * calibration.SLOPE_STEP / np.log(u.factor) for u in self.unknowns]
        )
        here, *there = self.parts([point, *(point + np.diag(steps))])
        assert here is not None
        at = np.concatenate(here)
        columns = [
            np.zeros(len(at)) if each is None else (np.concatenate(each) - at) / step
            for each, step in zip(there, steps, strict=True)
        ]
        return np.transpose(columns)

    def minimise(self, start: Mapping[str, float], iterations: int) -> Array:
        """The point where the objective is least.

        Raises:
          RuntimeError: the start cannot be simulated.
        """
        first = np.array([np.log(start.get(u.name, u.start) / u.typical) / np.log(u.factor) for u in self.unknowns])
        parts = self.parts([first])[0]
        if parts is None:
            raise RuntimeError("fast_reflexes: the start is unstable or leaves the workspace")
        self.size = sum(map(len, parts))
        limits = (-calibration.WIDEST, calibration.WIDEST)
        ends = {"ftol": calibration.TOLERANCE, "xtol": 1e-3, "gtol": None, "max_nfev": iterations}
        return optimize.least_squares(self.residuals, first, jac=self.slopes, bounds=limits, **ends).x


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--law", default="acceleration", choices=["slow", "cutoff", "acceleration"])
    add_noise_options(parser)
    parser.add_argument("--grip", default="printed", choices=["printed", "usual"])
    parser.add_argument("--start", default="yielding", choices=list(STARTS))
    parser.add_argument("--iterations", type=int, default=12)
    parser.add_argument("--fits", type=int, default=0, help="replicates of 20 trials each, of which C to E are fitted")
    options = parser.parse_args()
    noise = noise_of(options, "PT")
    search = Search(options.law, options.grip, noise, [calibration.SEEN, calibration.SEEN + 1])
    first = NEAR_C8 if options.law == "acceleration" else {}
    point = search.minimise({**first, **STARTS[options.start]}, options.iterations)
    names = ("cells", "unknowns", "poles", "admittance")
    (parts,) = search.parts([point])
    print(f"{options}", {name: round(float(np.sum(part**2)), 1) for name, part in zip(names, parts or (), strict=True)})
    candidate = search.candidate(point)
    print({u.name: float(f"{u.typical * u.factor**step:.4g}") for u, step in zip(search.unknowns, point, strict=True)})
    unseen = [calibration.UNSEEN + number for number in range(calibration.N_UNSEEN)]
    (cells,) = calibration.simulated_cells([candidate], unseen, noise=noise, n_threads=1)
    if cells is None:
        print("leaves the workspace on multisines that the search did not see")
        return
    for kind, tables in (("calibrated", CALIBRATED), ("held out", HELD_OUT)):
        off = {cell: (cells[cell] - mean) / sd for cell, (mean, sd) in wanted(tables).items()}
        size = np.abs(list(off.values()))
        within = " / ".join(f"{100.0 * np.mean(size <= limit):.0f}" for limit in LIMITS)
        worst = max(off, key=lambda cell: abs(off[cell]))
        print(f"{kind}: {within} %, RMS {np.sqrt(np.mean(size**2)):.2f} SD; worst {tuple(worst)}: {off[worst]:.1f}")
    (error,) = admittance_errors([candidate], unseen, noise)
    if error is not None:
        print("admittance off by", np.round(np.linalg.norm(error, axis=(1, 2)), 2))
    if options.fits:
        person: Person = candidate.person
        arms = {name: THESIS.condition(name).subject_of(person) for name in ("PT2.5", "PT7.5", "PT22.5")}
        fitted = fitted_cells(fits_of(arms, {"PT": noise}, 11, options.fits, "neutral"))
        for appendix in "CDE":
            own = [each for each in fitted if each.cell.table[0] == appendix and each.cell.condition[:2] == "PT"]
            print(appendix, *(f"{100.0 * part:.0f} %" for part in share(own).parts))


if __name__ == "__main__":
    main()
