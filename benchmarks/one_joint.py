"""Accuracy of the joint model on simulated people of one joint.

Run `python -m benchmarks.one_joint [PEOPLE] [SERVO ...] [--seed FIRST]`; other seeds are other people. They are people
of three joints, half of them with a one-sided and half with a linear reflex, and people without one, on a position and
on a force servo, 60 s each with noise of 10 to 20 dB. Their equations are those of `tests/one_joint.py`.
Beside each median error stands the one that the standard errors let expect. `--bound` prints instead what the
Cramer-Rao bound lets expect, at the true parameters and with noise of a free spectrum, without identifying anybody.
`response` is judged on the same people.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import xarray as xr

from armperturb.analysis.joint.identify import identify_joint
from armperturb.analysis.joint.likelihood import JointLikelihood, environment_of
from armperturb.analysis.joint.model import JointStructure
from armperturb.analysis.joint.signals import joint_signals
from armperturb.analysis.response.one_axis import one_axis_response

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import one_joint

TARGETS = {
    "inertia": 3.0, "damping": 5.0, "stiffness": 3.0, "reflex_gain": 8.0, "reflex_delay": 1.0, "reflex_threshold": 15.0,
}  # fmt: skip
"""Parameter to the largest median error [%], of the delay [ms]."""

QUARTILE = 0.6745
"""Median of the modulus of a standard normal variable [-]."""


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


def print_bounds(people: int, servos: list[str], first: int) -> None:
    """Print the median error that the bound lets expect of each parameter."""
    for servo in servos:
        least: dict[str, list[float]] = {name: [] for name in TARGETS}
        for number in range(first, first + people):
            for reflex in ("half-wave", "linear", "none"):
                person, recording = made(number, reflex, servo)
                for name, error in bounds(person, recording).items():
                    if name in TARGETS:
                        least[name].append(unit_of(name, person) * QUARTILE * error)
        each = ", ".join(f"{name} {np.median(errors):.2f}" for name, errors in least.items())
        print(f"{servo} servo, {people} people of each kind: the Cramer-Rao bound lets expect {each}", flush=True)


def made(number: int, reflex: str, servo: str) -> tuple[one_joint.Joint, xr.Dataset]:
    """A person and a recording."""
    name = list(one_joint.JOINTS)[number % 3]
    person = one_joint.person(name, 100 + number, reflex)
    decibel = float(np.random.default_rng(number).uniform(10.0, 20.0))
    return person, one_joint.recording(person, number, servo, decibel=decibel, name=name)


def unit_of(parameter: str, person: one_joint.Joint) -> float:
    """What makes an error one in per cent, or in milliseconds."""
    return 1e3 if parameter == "reflex_delay" else 100.0 / getattr(person, parameter)


def main(people: int, servos: list[str], first: int) -> None:
    """Print errors, coverage and choices."""
    for servo in servos:
        errors = {name: [] for name in TARGETS}
        expected = {name: [] for name in TARGETS}
        covered, linear, one_sided, lacks = [], [], [], []
        held, right, started = [], {"half-wave": [], "linear": [], "none": []}, time.process_time()
        for number in range(first, first + people):
            name = list(one_joint.JOINTS)[number % 3]
            for reflex in right:
                person, recording = made(number, reflex, servo)
                response = one_axis_response(recording, window_start=1.0)
                (one_sided if reflex == "half-wave" else linear).append(response.p_linear)
                if reflex != "half-wave":
                    impedance = one_joint.impedance(person, response.frequency)
                    truth = impedance if servo == "position" else 1.0 / impedance
                    covered.append(np.mean(response.covers(truth[:, None, None])))
                try:
                    result = identify_joint(recording)
                except ValueError as error:
                    print(f"{servo} {name} {number} {reflex}: {error}", flush=True)
                    right[reflex].append(False)
                    continue
                chosen = result.structure
                is_side = reflex != "half-wave" or chosen.side == person.side
                right[reflex].append(chosen.reflex == reflex and is_side)
                if not right[reflex][-1]:
                    print(f"{servo} {name} {number} {reflex}: chosen {chosen.name}", flush=True)
                    continue
                lacks.append(result.lack_of_fit)
                for parameter, value in result.values.items():
                    true = getattr(person, parameter)
                    if parameter in TARGETS:
                        miss = abs(value - true)
                        unit = unit_of(parameter, person)
                        errors[parameter].append(unit * miss)
                        expected[parameter].append(unit * QUARTILE * result.standard_error[parameter])
                    lower, upper = result.interval(parameter)
                    held.append((parameter, lower <= true <= upper))
        print(f"{servo} servo, {people} people of each kind, {time.process_time() - started:.0f} s of processor time")
        for name, target in TARGETS.items():
            of_name = [inside for parameter, inside in held if parameter == name]
            unit = "ms" if name == "reflex_delay" else "%"
            print(
                f"  {name}: median error {np.median(errors[name]):.2f} {unit} (target {target:g}, "
                f"standard errors let expect {np.nanmedian(expected[name]):.2f}), "
                f"intervals hold {100 * np.mean(of_name):.1f} % of {len(of_name)}"
            )
        print(f"  all intervals hold {100 * np.mean([inside for _, inside in held]):.1f} % (target 90 to 98)")
        print(f"  lack of fit: chi2/dof {np.median([each.chi2 / each.dof for each in lacks]):.2f} (median), ", end="")
        print(f"{sum(each.p_value < 0.01 for each in lacks)} of {len(lacks)} said to lack fit (p < 0.01)")
        print(
            f"  response: circles of 95 % hold {100 * np.mean(covered):.1f} %; called nonlinear (p < 0.001): ", end=""
        )
        print(f"{np.sum(np.array(one_sided) < 1e-3)} of {people} with a half-wave reflex, ", end="")
        print(f"{np.sum(np.array(linear) < 1e-3)} of {2 * people} others")
        for reflex, choices in right.items():
            print(f"  right choice of {reflex}: {sum(choices)} of {len(choices)}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("people", type=int, nargs="?", default=30)
    parser.add_argument("servos", nargs="*", default=["position", "force"])
    parser.add_argument("--seed", type=int, default=0, help="of the first person")
    parser.add_argument("--bound", action="store_true", help="print only what the Cramer-Rao bound lets expect")
    options = parser.parse_args()
    run = print_bounds if options.bound else main
    run(options.people, options.servos, options.seed)
