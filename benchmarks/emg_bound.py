"""What EMG of an unknown gain can tell of reflex gains at most.

Run `python -m benchmarks.emg_bound [--people N] [--seed N]`.
EMG without noise would tell delays and all ratios of gains of feedback, also those between joints, which the two-joint
gains tie together. It cannot tell their common size, as its own gain is unknown. That comes from the movement, whose
information I is known from a fit of PT7.5 (model 3, linear people). Standard errors with such EMG are those of I with
delays held and all feedback changed in proportion: C^T I C instead of I.
Medians of their ratio to those of I are printed, and
of what would remain if further parameters were known, which tells what the size of velocity feedback is confused with.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.joint_likelihood import JointLikelihood
from armperturb.analysis.fit.maximum_likelihood import estimate
from armperturb.analysis.fit.structures import structure_of
from armperturb.analysis.trials import trials_by_condition
from armperturb.cohort import draw_cohort
from armperturb.study.protocol import THESIS
from benchmarks.emg import PROTOCOL, recorded

FURTHER = {
    "nothing else": (),
    "cut-off": ("fact",),
    "damping": ("b_s", "b_se", "b_e"),
    "stiffness": ("k_s", "k_se", "k_e"),
    "grip": ("b_h", "k_h"),
    "damping and cut-off": ("fact", "b_s", "b_se", "b_e"),
}
"""What else is known, to the beginnings of names of parameters."""


def ratios(information: np.ndarray, names: Sequence[str], values: dict[str, float]) -> dict[tuple[str, str], float]:
    """(What else is known, gain) to its standard error over that without EMG."""
    before = np.sqrt(np.diag(np.linalg.inv(information)))
    result = {}
    for label, known in FURTHER.items():
        size = np.array([values[name] if name.startswith(("kv_", "kp_")) else 0.0 for name in names])
        others = [place for place, name in enumerate(names) if not name.startswith(("Td", "kv_", "kp_", *known))]
        columns = [size, *np.eye(len(names))[others]]
        change = np.array(columns).T
        inverse = change @ np.linalg.inv(change.T @ information @ change) @ change.T
        for place, name in enumerate(names):
            if name.startswith("kv_"):
                result[label, name] = float(np.sqrt(inverse[place, place]) / before[place])
    return result


def main(arguments: Sequence[str] = ()) -> None:
    """Print medians over people and joints."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--people", type=int, default=10)
    parser.add_argument("--seed", type=int, default=5)
    options = parser.parse_args(arguments)
    protocol = replace(PROTOCOL, conditions=(THESIS.condition("PT7.5"),), pulse_unit_condition="")
    result: dict[str, list[float]] = {label: [] for label in FURTHER}
    for number, person in enumerate(draw_cohort(options.people, options.seed, muscles="linear")):
        recording, _ = recorded(person, number, protocol, options.seed)
        group = Group.prepare([trials_by_condition(recording)["PT7.5"]], structure_of("3", wide=True))
        fitted = estimate([group])
        problem = JointLikelihood([group], "record", ())
        values = np.array([fitted.values[name] for name in problem.names])
        problem.weigh(values)
        for (label, _), ratio in ratios(problem.normal(values).information, problem.names, fitted.values).items():
            result[label].append(ratio)
        said = ", ".join(f"{label} {np.median(each):.2f}" for label, each in result.items())
        print(f"{number + 1} people, standard error of kv over that without EMG; also known: {said}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
