"""What EMG alone would tell of the reflexes of nonlinear people, were it an output of the nonlinear model.

Run `python -m benchmarks.emg_nonlinear [--people N] [--seed N]`; some 10 s of a core per person.
The excitation of each joint follows from the recorded rotations by the true law of the spindles, and the difference
between antagonists is that, delayed, times an unknown gain of each group of muscles in each condition, plus noise. No
arm is simulated. Printed are the gains (their truth is 0.02, and 0.01 of muscles that cross both joints), what the law
explains of the differences with and without saturating spindles, and the standard errors of logarithms (coordinates of
`nonlinear.model`) that the information of the EMG gives: were all trials alike, and one gain of velocity feedback known
beside EMG, as EMG does not tell their common size.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import fft

from armperturb.analysis.emg.envelope import envelopes
from armperturb.analysis.emg.outputs import ReflexOutputs, reflex_outputs
from armperturb.analysis.fit.emg_likelihood import BAND
from armperturb.analysis.fit.frequency_bands import Smoother
from armperturb.analysis.fit.likelihood import judged_part
from armperturb.analysis.nonlinear.model import Model, Parameters, coordinate, true_values
from armperturb.analysis.trials import trials_by_condition
from armperturb.cohort import draw_cohort
from armperturb.subject import Subject
from benchmarks.emg import MOVED, MOVING, recorded

HELD = "kv.elbow"
"""Of which EMG would not tell the size."""

STEP = 1e-3
"""Change of a coordinate in finite differences [-]."""


def spindle_velocity(velocity: np.ndarray, saturation: float) -> np.ndarray:
    """Velocity that linear spindles would have to see to fire as saturating ones do [rad/s]."""
    return velocity / (1.0 + np.abs(velocity) / saturation)


def excitation(person: Subject, rotation: np.ndarray, rate: float) -> np.ndarray:
    """Of the reflexes of both joints [Nm], of rotations [rad], (trial, time, joint) (eq. 2.8)."""
    speed = np.gradient(rotation, 1.0 / rate, axis=1)
    kv, kp = (
        np.array([[getattr(person, f"{k}_{j}") for j in row] for row in (("s", "se"), ("se", "e"))])
        for k in ("kv", "kp")
    )
    seen = speed @ kv + rotation @ kp
    of_elements = speed[..., 0], speed.sum(axis=-1), speed[..., 1]
    limits = person.muscle.of_elements("spindle_saturation") if person.muscle else (np.inf,) * 3
    for joints, velocity, gain, limit in zip(
        ([0], [0, 1], [1]), of_elements, person.muscle_groups("kv"), limits, strict=True
    ):
        seen[..., joints] += (gain * (spindle_velocity(velocity, limit) - velocity))[..., None]
    return seen


class Differences:
    """Differences between antagonists in the trials of a condition, as spectra."""

    def __init__(self, outputs: ReflexOutputs) -> None:
        self._outputs = outputs
        self._judged, self._taper = judged_part(outputs.rotation.shape[1], outputs.rate, from_rest=outputs.from_rest)
        frequency = fft.rfftfreq(len(self._taper), 1.0 / outputs.rate)
        self._used = slice(*np.searchsorted(frequency, BAND))
        self._frequency = frequency[self._used]
        self.observed = self._spectrum(outputs.difference) / np.sinc(self._frequency * outputs.averaging)[:, None]
        self._smoother = Smoother(len(self._frequency), len(self.observed))

    def _spectrum(self, values: np.ndarray) -> np.ndarray:
        part = (values - values.mean(axis=1, keepdims=True))[:, self._judged] * self._taper[:, None]
        return fft.rfft(part, axis=1)[:, self._used]

    def by_gain(self, person: Subject) -> np.ndarray:
        """What unit gains (g_s, g_e, g_bs, g_be) would add, (gain, trial, frequency, group)."""
        late = np.exp(-2j * np.pi * self._frequency[:, None] * [person.Td_s, person.Td_e])
        seen = self._spectrum(excitation(person, self._outputs.rotation, self._outputs.rate)) * late
        columns = np.zeros((4, *self.observed.shape), complex)
        for gain, (joint, group) in enumerate(((0, 0), (1, 1), (0, 2), (1, 2))):
            columns[gain, ..., group] = seen[..., joint]
        return columns

    def fitted(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gains by least squares, and the residual, (trial, frequency, group)."""
        rows = columns.reshape(4, -1)
        gains = np.linalg.solve((rows @ rows.conj().T).real, (rows.conj() @ self.observed.ravel()).real)
        return gains, self.observed - np.tensordot(gains, columns, axes=1)

    def noise(self, residual: np.ndarray) -> np.ndarray:
        """Its smooth spectrum, (frequency, group, group)."""
        power = np.einsum("tfa,tfb->fab", residual, residual.conj()) / len(residual)
        return np.asarray(self._smoother(power.reshape(len(power), -1))).reshape(power.shape)

    def information(self, people: Sequence[Subject]) -> tuple[np.ndarray, str]:
        """Of the coordinates in which all but the first of some people differ from it; gains are unknown."""
        columns = self.by_gain(people[0])
        gains, left = self.fitted(columns)
        white = np.sqrt(2.0) * np.linalg.inv(np.linalg.cholesky(self.noise(left)))
        changes = [np.tensordot(gains, self.by_gain(other) - columns, axes=1) / STEP for other in people[1:]]
        rows = np.einsum("fab,ntfb->ntfa", white, np.array([*changes, *columns])).reshape(len(changes) + 4, -1)
        every, n = (rows @ rows.conj().T).real, len(changes)
        information = every[:n, :n] - every[:n, n:] @ np.linalg.solve(every[n:, n:], every[n:, :n])
        linear = people[0].muscle and replace(people[0].muscle, spindle_saturation=np.inf)
        of_linear = self.fitted(self.by_gain(replace(people[0], muscle=linear)))[1]
        explained = (1.0 - np.sum(np.abs(each) ** 2) / np.sum(np.abs(self.observed) ** 2) for each in (left, of_linear))
        said = ", ".join(f"{gain:.4f}" for gain in gains)
        return information, f"gains {said}; explained, and without saturation: " + ", ".join(
            f"{each:.1%}" for each in explained
        )


def main(arguments: Sequence[str] = ()) -> None:
    """Print what each condition holds and what EMG alone tells, person by person."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--people", type=int, default=3)
    parser.add_argument("--seed", type=int, default=812)
    options = parser.parse_args(arguments)
    for number, person in enumerate(draw_cohort(options.people, options.seed)):
        recording, _ = recorded(person, number, MOVING, options.seed)
        amplitudes, conditions = envelopes(recording), trials_by_condition(recording, is_checked=True)
        subjects = {each.condition: each.subject for each in MOVING.trials(person, MOVING.given_forces(), 0, number)}
        total = 0.0
        for name in MOVED:
            body, level = subjects[name], subjects[name].kv_s / person.subjects["PT"].kv_s
            true = {**true_values(person.subjects["PT"], {}), f"level.{name}": level}
            parameters = Parameters(Model(free=("Td",)), {"PT": body}, {"PT": ("", name)})
            asked = [each for each in parameters.names if each.startswith(("kv", "kp", "Td", "spindle"))]
            point = np.array([coordinate(each, true[each]) for each in parameters.names])
            moved = [point + STEP * (np.array(parameters.names) == each) for each in asked if each != HELD]
            people = [parameters.person("PT", each, name) for each in (point, *moved)]
            information, said = Differences(reflex_outputs(conditions[name], amplitudes)).information(people)
            total = total + information
            print(f"{person.subjects['PT'].name}, {name}: {said}", flush=True)
        errors = np.sqrt(np.diag(np.linalg.inv(total)))
        names = [each for each in asked if each != HELD]
        print("    " + ", ".join(f"{each} {error:.3f}" for each, error in zip(names, errors, strict=True)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
