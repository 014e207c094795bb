"""How far an arm is from people's, in standard deviations between people.

Admittance, and what it says about stiffness, damping and inertia at the hand and at the joints, are found for the arm
and for each person of a reference in the same way: the impedance Z = H^-1 is fitted by K + s B + s^2 I over low
frequencies, by least squares in which each frequency counts alike. What delayed reflexes do at these frequencies is in
all three, for the arm and for the people alike.

References are "thesis", linear arms drawn from the published means and SDs of parameters, and "people", people of our
cohort with nonlinear muscles. Each meets the force of each of the arm's trials, with a person's noise and that of the
instruments unless the arm has none: what a few trials leave unknown, and how noise softens muscle, is then in the
reference as it is in a recording of a person.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.cuts import require_two_axes
from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.measures.endpoint import EndpointMatrix
from armperturb.analysis.periods import common_period
from armperturb.analysis.response.estimate import response
from armperturb.analysis.results import Description, Result, Table
from armperturb.analysis.trials import ConditionTrials, prepared_condition
from armperturb.arrays import Array, ComplexArray
from armperturb.cohort import draw_person, draw_subject
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Sampled
from armperturb.plots.style import COLOURS, GREY, INK, PALE, figure_for, in_style
from armperturb.recording import labels_of, named
from armperturb.seeds import trial_seed
from armperturb.subject import POSITION, RELAX, TASKS, Subject
from armperturb.validation import require_one_of, require_type, require_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REFERENCES = ("thesis", "people")
"""Whom an arm can be compared with."""

N_DRAWN = {"thesis": 60, "people": 16}
"""Arms of each reference."""

HIGHEST = 20.0
"""Frequency up to which admittances are compared [Hz]."""

LOW = 6.0
"""Frequency up to which the impedance is that of one stiffness, damping and inertia [Hz]."""

FEWEST_COMPARED = 8
"""People who must bear the forces of a recording for an arm to be compared with them."""

MATRICES = {"stiffness": "N/m", "damping": "Ns/m", "inertia": "kg"}
JOINT_UNITS = {"k": "Nm/rad", "b": "Nms/rad", "i": "kg m^2"}

GEOMETRY = ("l_h", "l_f", "theta_s_deg", "theta_e_deg")
"""Labels of a recording that say where the joints are."""

Rows = list[tuple[str, str, str, float]]
"""Group, quantity, unit and value."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Likeness(Result):
    """An arm beside people.

    Attributes:
      label: of the arm.
      reference: "thesis" or "people".
      task: of the people.
      frequency: at which admittances are compared [Hz], (frequency,).
      gains: larger and smaller gain of the arm's admittance [m/N], (frequency, 2).
      reference_gains: of the people, (person, frequency, 2).
      table: group, quantity, unit, value, people's mean and SD, the distance in SDs, condition and subject.
      distance: group to the root mean square of its quantities' distances [SD].
      usual: group to the distance from the others within which 95 % of the people lie [SD].
      remarks: on what the recording's signals show, as those of `response`, and on people who are left out.
    """

    label: str
    reference: str
    task: str
    frequency: Array
    gains: Array
    reference_gains: Array
    table: pd.DataFrame
    distance: Mapping[str, float]
    usual: Mapping[str, float]
    remarks: tuple[str, ...] = ()

    def describe(self) -> Description:
        """Distances of admittance, ellipses and parameters."""
        who = {"thesis": "arms of the thesis's tables", "people": "people of the cohort"}[self.reference]
        facts = [
            f"{group}: {self.distance[group]:.1f} SD ({'as' if self.is_human(group) else 'not as'} people's; 95 % of "
            f"them are within {self.usual[group]:.1f})"
            for group in self.distance
        ]
        rows = [
            (row.quantity, f"{row.value:.3g}", f"{row.mean:.3g}", f"{row.sd:.2g}", row.unit, f"{row.distance:+.1f}")
            for row in self.table.itertuples()
            if row.group != "admittance"
        ]
        return Description(
            title=f"{self.label} beside {len(self.reference_gains)} {who} ({self.task})",
            facts=tuple(facts),
            table=Table(("quantity", "arm", "people", "SD", "unit", "distance [SD]"), tuple(rows)),
            remarks=self.remarks,
        )

    def is_human(self, group: str) -> bool:
        """Whether the arm is as near to people as 95 % of them are to the others."""
        return self.distance[group] <= self.usual[group]

    def to_frame(self) -> pd.DataFrame:
        """A row per quantity."""
        return self.table.copy()

    def to_xarray(self) -> xr.Dataset:
        """`gains` of the arm, (frequency, gain), and `reference_gains` of people, (person, frequency, gain) [m/N]."""
        units = {"units": "m/N"}
        return xr.Dataset(
            {
                "gains": (("frequency", "gain"), self.gains, units),
                "reference_gains": (("person", "frequency", "gain"), self.reference_gains, units),
            },
            {"frequency": ("frequency", self.frequency, {"units": "Hz"}), "gain": ["larger", "smaller"]},
            {name: str(self.table[name].iloc[0]) for name in ("condition", "subject")},
        )

    @in_style()
    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw both gains of the admittance, with those of people as bands of two standard deviations.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (2,): of the larger and of the smaller gain.
        """
        axes = figure_for(figure, 2.8).subplots(1, 2, sharey=True)
        for k, ax in enumerate(axes):
            logs = np.log(self.reference_gains[..., k])
            mean, sd = logs.mean(axis=0), logs.std(axis=0, ddof=1)
            ax.fill_between(self.frequency, *1e3 * np.exp([mean - 2 * sd, mean + 2 * sd]), color=PALE, label="2 SD")
            ax.loglog(self.frequency, 1e3 * np.exp(mean), color=GREY, label=self.reference)
            ax.loglog(self.frequency, 1e3 * self.gains[:, k], color=COLOURS[self.task], label=self.label)
            ax.set_title(f"{('largest', 'smallest')[k]} gain", color=INK)
            ax.set_xlabel("frequency [Hz]")
            if not k:
                ax.set_ylabel("admittance [mm/N]")
                ax.legend()
        return axes


def compare(
    recording: xr.Dataset | Sequence[xr.Dataset], reference: str = "people", *, ideal: bool = False, seed: int = 0
) -> Likeness:
    """An arm beside people: admittance, ellipses at the hand, and joint parameters where the geometry is known.

    Args:
      recording: trials of one arm in one condition under multisines or noise; its task says which people.
      reference: "thesis" or "people".
      ideal: whether people have no noise of their own and perfect instruments, beside a model that has neither.
      seed: of whom is drawn.

    Raises:
      TypeError: recording is no `Dataset`, ideal no truth value, or seed no whole number.
      ValueError: there is one axis, reference is something else, seed is negative, nobody has the arm's posture, most
        people leave the workspace under its forces, or as `response`.
    """
    require_one_of("compare", "reference", reference, REFERENCES)
    require_whole("compare", "seed", seed, at_least=0)
    require_type("compare: ideal", ideal, bool, "True or False")
    several = prepared_condition(recording)
    first = several[0].recording
    require_two_axes(first)
    task = str(first["task"].values[0])
    require_one_of("recording", "task", task, TASKS)
    method = _method_for(several)
    estimate = response(several, method, window_start=WINDOW_START)
    chosen = estimate.frequency <= HIGHEST
    frequency, admittance = estimate.frequency[chosen], estimate.response[chosen]
    geometry: dict[str, Any] = {name: float(first[name].values[0]) for name in GEOMETRY}
    known = bool(np.isfinite([*geometry.values()]).all())
    held = [_manipulator(trials) for trials in several]
    try:
        environments = {of_trials or Environment() for of_trials in held}
        people = _drawn(reference, task, seed, geometry if known else {}, environments)
    except ValueError as error:
        raise ValueError(
            f"recording: no person has its posture: {error} (--turn-deg turns the axes of a model)"
        ) from None
    said: tuple[str, ...] = ()
    if reference == "thesis" and ideal:
        of_people = np.stack([arm_admittance(person, frequency) for person in people])
    else:
        if None in held:
            said = ("the recording does not show what its hand held: people beside it hold the thesis's manipulator",)
        recordings = _under_the_same_forces(people, several, seed, linear=reference == "thesis", ideal=ideal)
        borne = [each for each in recordings if not any(np.isfinite(part["limit_time"].values).any() for part in each)]
        if len(borne) < FEWEST_COMPARED:
            raise ValueError(
                f"recording: under its forces {len(recordings) - len(borne)} of the {len(recordings)} people beside "
                f"whom the arm is to stand leave the workspace; expected forces that at least {FEWEST_COMPARED} bear"
            )
        if len(borne) < len(recordings):
            gone = len(recordings) - len(borne)
            said = (
                *said,
                f"{gone} of {len(recordings)} people leave the workspace under these forces: the arm stands beside the "
                "stiffer ones",
            )
        each_estimate = (response(each, method, frequency=frequency, window_start=WINDOW_START) for each in borne)
        of_people = np.stack([estimate.response for estimate in each_estimate])
    arm = people[0] if known else None  # of which only the geometry counts
    values = _quantities(frequency, admittance, arm)
    each = [_quantities(frequency, response_of_one, arm) for response_of_one in of_people]
    table = _table(values, each)
    return Likeness(
        label=named([trials.recording for trials in several]),
        reference=reference,
        task=task,
        frequency=frequency,
        gains=_gains(admittance),
        reference_gains=_gains(of_people),
        table=table.assign(**labels_of(first)),
        distance={str(name): value for name, value in _distances(table).items()},
        usual=_usual(each),
        remarks=(*estimate.remarks, *said),
    )


def _method_for(several: Sequence[ConditionTrials]) -> str:
    """The method of `response` that takes these perturbations: the people are under the same."""
    try:
        common_period(several, WINDOW_START)
    except ValueError:
        return "noise"
    return "multisine"


def _manipulator(trials: ConditionTrials) -> Environment | None:
    """What the hand held, as force and movement show it, to four digits; None where they do not.

    More digits depend on the order of the trials.
    """
    try:
        shown = trials.environment
    except ValueError:
        return None
    return replace(shown, **{name: float(f"{getattr(shown, name):.4g}") for name in ("m_env", "b_env", "k_env")})


def _drawn(
    reference: str, task: str, seed: int, geometry: Mapping[str, Any], held: Iterable[Environment]
) -> list[Subject]:
    """The people of a reference, in a posture in which they are stable with what hands held."""
    preset, generator = (POSITION if task == POSITION.task else RELAX).name, np.random.default_rng(seed)
    people: list[Subject] = []
    numbers = itertools.count()
    while len(people) < N_DRAWN[reference]:
        if reference == "thesis":
            drawn = draw_subject(preset, generator)
        else:
            drawn = draw_person(seed, next(numbers)).subjects[task]
        person = replace(drawn, **geometry)
        if all(largest_real_pole(person, environment) < 0.0 for environment in held):
            people.append(person)
    return people


def _under_the_same_forces(
    people: Sequence[Subject], recorded: Sequence[ConditionTrials], seed: int, *, linear: bool, ideal: bool
) -> list[list[xr.Dataset]]:
    """Recordings of each person, a trial for each recorded force, with what the recorded hand held."""
    instruments = None if ideal else Instruments(emg=None, marker_noise=None)
    forces = [
        (record.perturbation, held)
        for trials, held in zip(recorded, map(_manipulator, recorded), strict=True)
        for record in trials.records(0.0)
    ]
    forces.sort(key=lambda each: each[0].tobytes())  # so that the order of the trials has no say in people's noise
    of_force = []
    for number, (force, held) in enumerate(forces):
        trials = [
            Trial(
                subject=person,
                perturbation=Sampled(force=force, rate=recorded[0].rate),
                seed=trial_seed(seed, "compare", place, number),
                noise=None if ideal else HUMAN_NOISE[person.task],
            )
            for place, person in enumerate(people)
        ]
        of_force.append(run_experiment(trials, held, linear=linear, engine="compiled", instruments=instruments))
    return [[trials.isel(trial=[place]) for trials in of_force] for place in range(len(people))]


def _gains(admittance: ComplexArray) -> Array:
    """Larger and smaller gain [m/N], (..., frequency, 2)."""
    return np.asarray(np.linalg.svd(admittance, compute_uv=False))


def impedance_matrices(frequency: Array, admittance: ComplexArray) -> dict[str, Array]:
    """Stiffness [N/m], damping [Ns/m] and inertia [kg] that an admittance has at low frequencies, (axis, axis) each.

    Args:
      frequency: [Hz], (frequency,).
      admittance: [m/N], (frequency, axis, axis).

    Raises:
      ValueError: there are fewer than two frequencies up to `LOW`.
    """
    low = frequency <= LOW
    if np.sum(low) < 2:
        raise ValueError(f"compare: {np.sum(low)} frequencies up to {LOW:g} Hz; expected at least two")
    impedance, omega = np.linalg.inv(admittance[low]), 2.0 * np.pi * frequency[low]
    weight = 1.0 / np.linalg.norm(impedance, axis=(1, 2))
    flat = impedance.reshape(len(omega), 4)
    terms = np.column_stack([weight, -weight * omega**2])
    (stiffness, inertia), *_ = np.linalg.lstsq(terms, weight[:, None] * flat.real, rcond=None)
    damping = (weight**2 * omega) @ flat.imag / np.sum((weight * omega) ** 2)
    return {name: values.reshape(2, 2) for name, values in zip(MATRICES, (stiffness, damping, inertia), strict=True)}


def _quantities(frequency: Array, admittance: ComplexArray, body: Subject | None) -> Rows:
    """Group, quantity, unit and value of all that is compared; joints only of a body whose geometry is known."""
    rows = [
        ("admittance", f"{size} gain at {at:.3g} Hz", "log(m/N)", float(np.log(gain)))
        for at, gains in zip(frequency, _gains(admittance), strict=True)
        for size, gain in zip(("largest", "smallest"), gains, strict=True)
    ]
    matrices = impedance_matrices(frequency, admittance)
    for name, matrix in matrices.items():
        ellipse = EndpointMatrix(values=matrix, covariance=np.full((4, 4), np.nan))
        unit = MATRICES[name]
        rows += [
            ("ellipses", f"{name}: size", f"log({unit})", float(np.log(ellipse.area / np.pi) / 2.0)),
            ("ellipses", f"{name}: shape", "log", float(np.log(ellipse.shape))),
            ("ellipses", f"{name}: orientation", "deg", ellipse.orientation_deg),
        ]
    if body is not None:
        jacobian = hand_jacobian(body)
        for letter, matrix in zip(JOINT_UNITS, matrices.values(), strict=True):
            joints = jacobian.T @ matrix @ jacobian
            entries = joints[0, 0], (joints[0, 1] + joints[1, 0]) / 2.0, joints[1, 1]
            rows += [
                ("parameters", f"{letter}_{joint}", JOINT_UNITS[letter], float(value))
                for joint, value in zip(("s", "se", "e"), entries, strict=True)
            ]
    return rows


def _table(values: Rows, each: Sequence[Rows]) -> pd.DataFrame:
    """The table of `Likeness`, of an arm's quantities and those of people."""
    frame = pd.DataFrame(values, columns=["group", "quantity", "unit", "value"])
    people = np.array([[row[3] for row in rows] for rows in each])
    turning = (frame["unit"] == "deg").to_numpy()
    # An axis has no ends: directions count from the people's mean one, within a quarter turn.
    doubled = np.exp(2j * np.radians(people[:, turning])).mean(axis=0)
    centre = np.degrees(np.angle(doubled)) / 2.0 % 180.0
    people[:, turning] = centre + _quarter(people[:, turning] - centre)
    frame["mean"], frame["sd"] = people.mean(axis=0), people.std(axis=0, ddof=1)
    away = frame["value"] - frame["mean"]
    away[turning] = _quarter(away[turning].to_numpy())
    frame["distance"] = away / frame["sd"]
    return frame


def _quarter(angle: Array) -> Array:
    return (angle + 90.0) % 180.0 - 90.0


def _usual(each: Sequence[Rows]) -> dict[str, float]:
    """Distance per group within which 95 % of people are of the others, as far as so many people tell."""
    distances = [_distances(_table(rows, [*each[:i], *each[i + 1 :]])) for i, rows in enumerate(each)]
    frame = pd.DataFrame(distances)
    # One more person is as likely to lie between any two of these.
    return {str(name): float(np.quantile(frame[name], 0.95, method="weibull")) for name in frame}


def _distances(table: pd.DataFrame) -> dict[str, float]:
    """Root-mean-square distance of each group [SD]."""
    groups, away = table["group"].to_numpy(), table["distance"].to_numpy()
    return {name: float(np.sqrt(np.mean(away[groups == name] ** 2))) for name in dict.fromkeys(groups)}
