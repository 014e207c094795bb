"""Accuracy of the joint model on simulated people of one joint.

Run `python -m benchmarks.one_joint [PEOPLE] [SERVO ...] [--seed FIRST] [--given] [--kept FILE]`; other seeds are other
people. They are people of three joints, half of them with a one-sided and half with a linear reflex, and people without
one, on a position and on a force servo, 60 s each with noise of 10 to 20 dB. Their equations are those of
`tests/one_joint.py`. Beside each median error stands the one that the standard errors let expect. With `--given` the
structure is that of the person, and intervals are those of standard errors, which takes a fifth of the time. `--bound`
prints instead what the Cramer-Rao bound lets expect, at the true parameters and with noise of a free spectrum, without
identifying anybody; `--bandwidth` asks what a narrower or wider movement would let expect. `response` is judged on the
same people.
"""

import argparse
import sys
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from scipy import optimize, stats

from armperturb.analysis.joint.estimate import estimate_joint
from armperturb.analysis.joint.identify import identify_joint
from armperturb.analysis.joint.likelihood import JointLikelihood, environment_of
from armperturb.analysis.joint.model import JointStructure
from armperturb.analysis.joint.signals import joint_signals
from armperturb.analysis.response.one_axis import one_axis_response
from benchmarks.kept_rows import Row, with_kept_rows

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import one_joint

TARGETS = {
    "inertia": 3.0, "damping": 5.0, "stiffness": 3.0, "reflex_gain": 8.0, "reflex_delay": 1.0, "reflex_threshold": 15.0,
}  # fmt: skip
"""Parameter to the largest median error [%], of the delay [ms]."""

REFLEXES = ("half-wave", "linear", "none")


def expected(standard_errors: Iterable[float]) -> float:
    """Median error that normal errors with these standard errors let expect; `nan` of none."""
    each = np.array([error for error in standard_errors if np.isfinite(error)])
    if not len(each):
        return float("nan")
    return float(optimize.brentq(lambda at: np.mean(2.0 * stats.norm.cdf(at / each) - 1.0) - 0.5, 0.0, each.max()))


def bounds(person: one_joint.Joint, recording: xr.Dataset) -> dict[str, float]:
    """Parameter of the true structure to the least standard error that an estimate from this recording can have.

    Noise reaches the joint on a force servo, but with a free spectrum it tells nothing of the parameters: what counts
    is the torque at the movement that the perturbation causes (Forssell & Ljung 1999, Automatica 35, 1215-1241).
    """
    structure = JointStructure(reflex=person.reflex, side=person.side)
    signals = joint_signals(recording)
    loop = environment_of(signals) if signals.servo == "force" else None
    likelihood = JointLikelihood(structure, signals, loop)
    true = np.array([getattr(person, name) for name in structure.parameters])
    likelihood.weigh(true)
    columns = likelihood.derivatives(true, likelihood.movement(true)).reshape(len(true), -1)
    size = np.linalg.norm(columns, axis=1)
    inverse = np.linalg.inv((columns / size[:, None]) @ (columns / size[:, None]).T)
    return dict(zip(structure.parameters, np.sqrt(np.diag(inverse)) / size, strict=True))


def print_bounds(people: int, servos: list[str], first: int, bandwidth: float) -> None:
    """Print the median error that the bound lets expect of each parameter."""
    for servo in servos:
        least: dict[str, list[float]] = {name: [] for name in TARGETS}
        for number in range(first, first + people):
            for reflex in REFLEXES:
                person, recording = made(number, reflex, servo, bandwidth)
                for name, error in bounds(person, recording).items():
                    if name in TARGETS:
                        least[name].append(unit_of(name, person) * error)
        each = ", ".join(f"{name} {expected(errors):.2f}" for name, errors in least.items())
        print(f"{servo} servo, {people} people of each kind: the Cramer-Rao bound lets expect {each}", flush=True)


def made(
    number: int, reflex: str, servo: str, bandwidth: float = one_joint.BANDWIDTH
) -> tuple[one_joint.Joint, xr.Dataset]:
    """A person and a recording, with movement and noise of their own."""
    name = list(one_joint.JOINTS)[number % 3]
    seed = len(REFLEXES) * number + REFLEXES.index(reflex)
    person = one_joint.person(name, 100 + seed, reflex)
    decibel = float(np.random.default_rng(seed).uniform(10.0, 20.0))
    return person, one_joint.recording(person, seed, servo, decibel=decibel, name=name, bandwidth=bandwidth)


def unit_of(parameter: str, person: one_joint.Joint) -> float:
    """What makes an error one in per cent, or in milliseconds."""
    return 1e3 if parameter == "reflex_delay" else 100.0 / getattr(person, parameter)


def judged(number: int, reflex: str, servo: str, *, is_given: bool) -> Row:
    """One person: what was chosen, errors, intervals, and what `response` says."""
    person, recording = made(number, reflex, servo)
    row: Row = {"seed": f"{number} {reflex} {servo}", "kind": reflex, "is_right": True, "values": {}}
    if is_given:
        structure = JointStructure(reflex=person.reflex, side=person.side)
        signals = joint_signals(recording)
        fit = estimate_joint(structure, signals, environment_of(signals) if servo == "force" else None)
        both = fit.values, np.sqrt(np.diag(fit.covariance))
        values, errors = (dict(zip(structure.parameters, of, strict=True)) for of in both)
        intervals = {name: (value - 1.96 * errors[name], value + 1.96 * errors[name]) for name, value in values.items()}
        lack = fit.lack
    else:
        response = one_axis_response(recording, window_start=1.0)
        row["p_linear"] = response.p_linear
        if reflex != "half-wave":
            impedance = one_joint.impedance(person, response.frequency)
            truth = impedance if servo == "position" else 1.0 / impedance
            row["covered"] = float(np.mean(response.covers(truth[:, None, None])))
        try:
            result = identify_joint(recording)
        except ValueError as error:
            return row | {"is_right": False, "said": str(error)}
        chosen = result.structure
        if chosen.reflex != reflex or (reflex == "half-wave" and chosen.side != person.side):
            return row | {"is_right": False, "said": f"chosen {chosen.name}"}
        values, errors, lack = result.values, result.standard_error, result.lack_of_fit
        intervals = {name: result.interval(name) for name in values}
    row |= {"chi2_over_dof": lack.chi2 / lack.dof, "p_of_lack": lack.p_value}
    for name, value in values.items():
        true, unit = getattr(person, name), unit_of(name, person) if name in TARGETS else 1.0
        lower, upper = intervals[name]
        row["values"][name] = [unit * (value - true), unit * errors[name], bool(lower <= true <= upper)]
    return row


def rows_of(wanted: Iterable[str], *, is_given: bool) -> Iterable[Row]:
    """Rows as they come."""
    for seed in wanted:
        number, reflex, servo = seed.split()
        row = judged(int(number), reflex, servo, is_given=is_given)
        if not row["is_right"]:
            print(f"{seed}: {row['said']}", flush=True)
        yield row


def main(options: argparse.Namespace) -> None:
    """Print errors, coverage and choices."""
    numbers = range(options.seed, options.seed + options.people)
    for servo in options.servos:
        started = time.process_time()
        wanted = {f"{number} {reflex} {servo}" for number in numbers for reflex in REFLEXES}
        of_all = {"is_given": options.given}
        rows = with_kept_rows(options.kept, wanted, partial(rows_of, **of_all), **of_all)
        spent = time.process_time() - started
        print(f"{servo} servo, {options.people} people of each kind, {spent:.0f} s of processor time")
        for name, target in TARGETS.items():
            of_name = np.array([row["values"][name] for row in rows if name in row["values"]], dtype=float)
            unit = "ms" if name == "reflex_delay" else "%"
            error, standard_error, is_inside = of_name.T
            print(
                f"  {name}: median error {np.median(np.abs(error)):.2f} {unit} (target {target:g}, standard errors let "
                f"expect {expected(standard_error):.2f}), mean {error.mean():+.2f} {unit}, RMS of error over "
                f"standard error {np.sqrt(np.nanmean((error / standard_error) ** 2)):.2f}, "
                f"intervals hold {100 * is_inside.mean():.1f} % of {len(error)}"
            )
        held = [inside for row in rows for _, _, inside in row["values"].values()]
        print(f"  all intervals hold {100 * np.mean(held):.1f} % (target 90 to 98)")
        lacks = np.array([(row["chi2_over_dof"], row["p_of_lack"]) for row in rows if row["values"]])
        print(f"  lack of fit: chi2/dof {np.median(lacks[:, 0]):.2f} (median), ", end="")
        print(f"{np.sum(lacks[:, 1] < 0.01)} of {len(lacks)} said to lack fit (p < 0.01)", flush=True)
        if options.given:
            continue
        covered = [row["covered"] for row in rows if "covered" in row]
        print(
            f"  response: circles of 95 % hold {100 * np.mean(covered):.1f} %; called nonlinear (p < 0.001): ", end=""
        )
        called = {kind: sum(row["p_linear"] < 1e-3 for row in rows if row["kind"] == kind) for kind in REFLEXES}
        print(f"{called['half-wave']} of {options.people} with a half-wave reflex, ", end="")
        print(f"{called['linear'] + called['none']} of {2 * options.people} others")
        for kind in REFLEXES:
            choices = [row["is_right"] for row in rows if row["kind"] == kind]
            print(f"  right choice of {kind}: {sum(choices)} of {len(choices)}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("people", type=int, nargs="?", default=30)
    parser.add_argument("servos", nargs="*", default=["position", "force"])
    parser.add_argument("--seed", type=int, default=0, help="of the first person")
    parser.add_argument("--bound", action="store_true", help="print only what the Cramer-Rao bound lets expect")
    parser.add_argument(
        "--bandwidth",
        type=float,
        default=one_joint.BANDWIDTH,
        help="with --bound: of the imposed movement, over the natural frequency",
    )
    parser.add_argument("--given", action="store_true", help="give the structure; intervals are of standard errors")
    parser.add_argument("--kept", type=Path, default=None, help="file of rows; a run that was stopped goes on")
    options = parser.parse_args()
    if options.bound:
        print_bounds(options.people, options.servos, options.seed, options.bandwidth)
    else:
        main(options)
