"""A joint whose stiffness changes over time: ensembles with known courses, and the moving ankle.

Run `python -m benchmarks.varying_joint [--joint NAME] [--reflex KIND] [--ensembles N] [--first NUMBER] [--real
FOLDER]`. The laboratory's ankle, with a half-wave reflex and 15 dB of noise, has a stiffness that follows a square
wave, a ramp and a sine of 0.5 Hz. Left-out repetitions choose the structure of the reflex path. Each ensemble of
repetitions has perturbations and noise of its own; means over ensembles are printed.
Targets: error of the mean at most 5 % RMS, rise time at most 30 ms, 95 % bands that hold the truth at 90 to 98 % of the
points; held-out VAF of the moving ankle above 82.1 %.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armperturb.analysis.joint.model import REFLEXES
from armperturb.analysis.varying.estimate import identify_varying
from armperturb.envs.lab.joint_experiment import JointTrial, at_signal_to_noise, run_joint_experiment
from armperturb.joint_person import JOINT_PEOPLE, JointPerson, half_wave, servo_of
from armperturb.perturbations.one_axis import random_steps
from armperturb.recording import make_recording

RATE, DURATION, LEAD, TAIL, SWING = 1000.0, 2.0, 0.4, 0.2, 0.4

TIMESTEP = 2.5e-4
"""Of the simulation [s]. With the laboratory's usual step a stiffness is 0.1 % off, which bands of a sine tell."""


def courses() -> dict[str, np.ndarray]:
    """Factors on the stiffness over one period of 0.5 Hz, what leads to it and what follows."""
    phase = np.mod(0.5 * (np.arange(round((LEAD + DURATION + TAIL) * RATE)) / RATE - LEAD), 1.0)
    return {
        "square wave": 1.0 + SWING * np.where(phase < 0.5, 1.0, -1.0),
        "ramp": 1.0 + SWING * (2.0 * phase - 1.0),
        "sine": 1.0 + SWING * np.sin(2.0 * np.pi * phase),
    }


def fall_time(value: np.ndarray) -> float:
    """Time in which the square wave's estimate falls from 90 to 10 % of its step [ms]."""
    half = len(value) // 2
    high, low = np.median(value[half // 4 : 3 * half // 4]), np.median(value[half + half // 4 : half + 3 * half // 4])
    share = (value - low) / (high - low)
    last = half // 2 + int(np.max(np.flatnonzero(share[half // 2 : half + half // 2] > 0.9)))
    return 1e3 / RATE * int(np.argmax(share[last:] < 0.1))


class Outcome(NamedTuple):
    """What one ensemble says.

    Attributes:
      error: of the mean, RMS [%].
      held: quantity to the points of its curve whose band holds the truth [%].
      bias: mean error [%].
      fall: of a square wave from 90 to 10 % [ms].
      n_splines: of stiffness, damping and gain.
      reflex: that was chosen.
    """

    error: float
    held: dict[str, float]
    bias: float
    fall: float
    n_splines: tuple[int, ...]
    reflex: str


def person_with(joint: str, reflex: str) -> JointPerson:
    """The laboratory's person, whose reflex is linear, with another reflex path or without one."""
    person = JOINT_PEOPLE[joint]
    return {"none": replace(person, kv=0.0), "linear": person, "half-wave": half_wave(person, 0.1)}[reflex]


def ensemble(joint: str, factor: np.ndarray, options: argparse.Namespace, number: int) -> Outcome:
    """Estimate one course from one ensemble, and compare with the truth."""
    person, servo = person_with(joint, options.reflex), servo_of(joint, "position")
    seeds = range(number * options.repetitions, (number + 1) * options.repetitions)
    trials = [
        JointTrial(
            person=person,
            perturbation=random_steps(seed=seed, duration=LEAD + DURATION + TAIL, rate=RATE, size=0.06, hold=0.1),
            stiffness=factor,
            seed=seed,
            repetition=repetition,
        )
        for repetition, seed in enumerate(seeds)
    ]
    noise = at_signal_to_noise(trials[0], servo, options.decibel).noise
    recording = run_joint_experiment([replace(trial, noise=noise) for trial in trials], servo, timestep=TIMESTEP)
    estimate = identify_varying(recording, n_points=len(factor))
    clock = np.arange(round(DURATION * RATE)) / RATE + LEAD
    value = np.interp(clock, estimate.grid, estimate.curves["stiffness"].value)
    true = {"stiffness": person.stiffness * factor[round(LEAD * RATE) :][: len(clock)]}
    true |= {"damping": np.full(len(clock), person.damping), "gain": np.full(len(clock), person.kv)}
    held = {}
    for name in estimate.curves:
        lower, upper = (np.interp(clock, estimate.grid, each) for each in estimate.interval(name))
        held[name] = float(100.0 * np.mean((lower < true[name]) & (true[name] < upper)))
    miss = 100.0 * (value - true["stiffness"]) / true["stiffness"].mean()
    return Outcome(
        error=float(np.sqrt(np.mean(miss**2))),
        held=held,
        bias=float(miss.mean()),
        fall=fall_time(value),
        n_splines=tuple(curve.n_basis for curve in estimate.curves.values()),
        reflex=estimate.structure.reflex,
    )


def measure(name: str, options: argparse.Namespace) -> str:
    """Outcomes of all ensembles of a course."""
    made = [
        ensemble(options.joint, courses()[name], options, number)
        for number in range(options.first, options.first + options.ensembles)
    ]
    errors, held = [each.error for each in made], [each.held["stiffness"] for each in made]
    fall = f", falls within {np.median([each.fall for each in made]):.0f} ms" if name == "square wave" else ""
    each_held = ", ".join(f"{share:.0f}" for share in held)
    others = [
        f"{quantity} {np.mean([each.held[quantity] for each in made if quantity in each.held]):.1f} %"
        for quantity in ("damping", "gain")
        if any(quantity in each.held for each in made)
    ]
    right = sum(each.reflex == options.reflex for each in made)
    return (
        f"{options.joint}, {name}: structure right in {right} of {len(made)}; error {np.mean(errors):.2f} % RMS (at "
        f"most {max(errors):.2f}), mean error {np.mean([each.bias for each in made]):+.2f} %, bands hold "
        f"{np.mean(held):.1f} % ({each_held}), of {', of '.join(others)}{fall}; splines of stiffness, damping, gain "
        f"{', '.join(str(each.n_splines) for each in made)}"
    )


def moving_ankle(path: Path) -> str:
    """Held-out VAF of the moving ankle, fitted on its first half."""
    with np.load(path) as arrays:
        signals = {
            "force": -arrays["torque_Nm"],
            "displacement": arrays["angle_rad"],
            "scheduling": arrays["scheduling_rad"],
        }
        rate = float(arrays["rate_hz"])
    nothing = ("pulse_direction", "pulse_onset", "limit_time", "l_h", "l_f", "theta_s_deg", "theta_e_deg")
    labels = {"subject": ["A"], "task": ["PT"], "condition": ["PT"], "repetition": [0], "pulse_level": [0.0]}
    recording = make_recording(
        {name: values.astype(float)[None, :, None] for name, values in signals.items()},
        labels | {name: [np.nan] for name in nothing},
        rate,
        servo="position",
        joint="ankle",
        angular=True,
    )
    half = 0.5 * len(signals["force"]) / rate
    return f"moving ankle:\n{identify_varying(recording, 'scheduling', fit_until=half)}"


def main(arguments: Sequence[str] = ()) -> None:
    """Print each course, and the moving ankle where its file is given."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--ensembles", type=int, default=5)
    parser.add_argument(
        "--first", type=int, default=0, help="number of the first ensemble, from which its seeds follow"
    )
    parser.add_argument("--joint", choices=list(JOINT_PEOPLE), default="ankle")
    parser.add_argument("--reflex", choices=REFLEXES, default="half-wave", help="of the person")
    parser.add_argument("--decibel", type=float, default=15.0)
    parser.add_argument("--courses", nargs="*", choices=list(courses()), default=list(courses()))
    parser.add_argument("--real", type=Path, default=None, help="folder with ankle_moving_2022.npz")
    options = parser.parse_args(arguments)
    if options.real is not None:
        print(moving_ankle(options.real / "ankle_moving_2022.npz"), flush=True)
    for name in options.courses:
        print(measure(name, options), flush=True)


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
