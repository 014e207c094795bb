"""Synthetic people: draws around the thesis's mean arms, and cohorts of people who do both tasks."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.environment import Environment
from armperturb.files import packaged_table
from armperturb.seeds import random_stream
from armperturb.subject import HUMERUS_MASS_SHARE, POSITION, PRESETS, RELAX, TASKS, Subject, at_level
from armperturb.validation import require_name, require_number, require_one_of, require_ranges, require_whole

SPREAD = packaged_table(__package__, "spread.toml")
"""Standard deviation over the thesis's subjects of each parameter of a preset, SI."""

STABILITY_MARGIN = 0.5
"""Poles of arm and environment lie left of minus this [1/s]: the shift of the thesis's penalty (eq. 2.21), with which
the published parameters were estimated because arms closer to instability rang on."""

NONLINEAR_MARGIN = 0.4
"""The same for nonlinear people [1/s]. Their average lies near the other margin, which would reject most draws
and leave a cohort that is weaker and less reflexive than the average."""

MAX_REDRAWS = 1000

REDRAWS_OF_OWN = 100
"""How often a nonlinear person's own factors are redrawn before the one that all parameters share is."""

HEIGHT = (1.838, 0.071)
"""Mean and SD of the height of young Dutch men [m] (Schoenbeck et al. 2013, fifth national growth study)."""

BODY_MASS_INDEX = (22.5, 2.0)
"""Mean and SD of the body mass over the height squared [kg/m^2]: healthy young men; assumed, the thesis prints none."""

MAX_DEVIATION = 2.5
"""Height, body-mass index and posture stay within this many SD of their means [-]: ordinary people only."""

UPPER_ARM_LENGTH = 0.186
"""Shoulder to elbow over height [-] (Winter 2009, fig. 4.1)."""

ELBOW_TO_GRIP = 0.146 + 0.037
"""Elbow to the middle of the grip over height [-]: forearm (Winter 2009, fig. 4.1), and the part of the hand up to its
centre of mass, which lies in the palm, where the handle does: 0.506 of the way from the wrist to the second knuckle of
the middle finger (table 4.1), which itself is some 0.073 of the height away."""

UPPER_ARM_MASS = 0.028
"""Over body mass [-] (Winter 2009, table 4.1)."""

FOREARM_HAND_MASS = 0.022
"""Over body mass [-] (Winter 2009, table 4.1)."""

CUFF_AND_HANDLE_MASS = 0.25
"""Mass of the wrist cuff and of the handle on the hand's side of the strain gauge [kg]; assumed. It gives the mean
person the published ratio of m_h to m_f (table C.18)."""

SHOULDER_ANGLE_DEG = (22.5, 0.7)
"""Mean and SD over the thesis's subjects of the shoulder angle at the start [deg] (section 2.2)."""

ELBOW_ANGLE_DEG = (82.3, 0.68)
"""Mean and SD over the thesis's subjects of the elbow angle at the start [deg] (section 2.2)."""

MUSCLES = ("nonlinear", "linear")
"""What people's muscles may be: those of the calibrated law, or the linear ones of the thesis's mean arms."""

SPREAD_ALIKE = {"PT": 0.28, "RT": 0.12}
"""Task to the SD over people of the logarithm of one factor on all torques of their muscles and reflexes [-]."""

SPREAD_OWN = {"PT": 0.20, "RT": 0.15}
"""Task to the SD over people of the logarithm of a factor of its own on each muscle group's parameters [-]."""

SPREAD_LEVEL = 0.15
"""SD over people of the logarithm of a factor on each condition's level of co-contraction [-]."""

BODY = ("m_h", "m_f", "m_tot")
"""Parameters of a preset's spread that a person's body sets, instead of a draw."""


@dataclass(frozen=True, kw_only=True)
class Person:
    """One synthetic person: a body, and muscles and reflexes that depend on the task.

    Attributes:
      name: what the person is called in recordings and tables.
      height: [m].
      mass: of the whole body [kg].
      subjects: the arm in each task, "PT" and "RT"; lengths, masses and posture are the same in both.
      levels: condition of the position task to the person's level of co-contraction in it, as a multiple of the
        subject's own [-], > 0; 1 in conditions that are not named.

    Raises:
      TypeError: a value is not a number, or name no text.
      ValueError: a value is out of its range, name cannot be printed on one line, or a subject belongs to another task
        than its key.
    """

    name: str
    height: float
    mass: float
    subjects: Mapping[str, Subject] = field(hash=False)
    levels: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        require_name("Person", "name", self.name)
        require_ranges("Person", self)
        for task, subject in self.subjects.items():
            if subject.task != task:
                raise ValueError(f"Person: subjects[{task!r}] has the task {subject.task!r}; expected {task!r}")
        for condition, level in self.levels.items():
            require_number("Person", f"levels[{condition!r}]", level, above=0.0)


def draw_subject(
    preset: str, seed: int | np.random.Generator, *, name: str | None = None, environment: Environment | None = None
) -> Subject:
    """A person drawn around a preset, each parameter from a normal distribution with the published mean and SD.

    Parameters are independent, as only their means and SDs are published. The person is redrawn as a whole until every
    parameter is in its range, no feedback gain is negative (as in model 3b) and arm and environment are stable together
    with a margin; this narrows the spread a little and shifts the means of wide distributions.

    Args:
      preset: "relax" or "position".
      seed: of the draw, or a generator to draw from.
      name: of the person; the preset's if not given.
      environment: on which the person has to be stable; the thesis's manipulator if not given.

    Raises:
      ValueError: the preset is unknown.
      RuntimeError: no stable person was found, which only an odd environment can cause.
    """
    require_one_of("draw_subject", "preset", preset, tuple(PRESETS))
    mean = PRESETS[preset]
    start = replace(mean, name=name or mean.name)
    return _draw_around(start, SPREAD[preset], np.random.default_rng(seed), environment or Environment())


@functools.cache
def average_person() -> Person:
    """The person around whom cohorts of nonlinear people are drawn, as `armperturb calibrate` found it."""
    values = packaged_table(__package__, "average_person.toml")
    subjects = {task: Subject.from_dict(values[task], f"average_person.toml, {task}") for task in TASKS}
    height, mass = _average_build()
    return Person(name="average", height=height, mass=mass, subjects=subjects, levels=values["levels"])


def average_body() -> dict[str, float]:
    """Segment lengths, masses and posture of an average person, as fields of a `Subject`."""
    return _body(*_average_build(), SHOULDER_ANGLE_DEG[0], ELBOW_ANGLE_DEG[0])


def _average_build() -> tuple[float, float]:
    """Height [m] and mass [kg]."""
    return HEIGHT[0], BODY_MASS_INDEX[0] * HEIGHT[0] ** 2


def _body(height: float, mass: float, shoulder_deg: float, elbow_deg: float) -> dict[str, float]:
    return {
        "l_h": UPPER_ARM_LENGTH * height,
        "l_f": ELBOW_TO_GRIP * height,
        "m_h": UPPER_ARM_MASS * mass,
        "m_f": FOREARM_HAND_MASS * mass + CUFF_AND_HANDLE_MASS,
        "theta_s_deg": shoulder_deg,
        "theta_e_deg": elbow_deg,
    }


def draw_person(
    seed: int, number: int, environment: Environment | None = None, *, muscles: str = "nonlinear"
) -> Person:
    """A person with a body drawn from anthropometry and, per task, muscles and reflexes drawn around an average.

    Segment lengths and masses are the fractions of height and body mass in Winter (2009), posture has the published
    mean and SD. Nonlinear muscles are drawn around the calibrated average person: each parameter times a factor of its
    own and one that all share, both log-normal; so are the levels of co-contraction. Linear muscles, reflexes and grip
    are drawn as `draw_subject` does, on this body; what has no published spread (grip, delay and cut-off in PT) is the
    preset's.

    Args:
      seed: of the cohort.
      number: of the person in the cohort, from 0.
      environment: on which the person has to be stable in both tasks; the thesis's manipulator if not given.
      muscles: "nonlinear" or "linear".

    Returns:
      The person; it depends on these arguments only.

    Raises:
      TypeError: seed or number is no whole number.
      ValueError: seed or number is negative, or muscles is something else.
      RuntimeError: no stable person was found, which only an odd environment can cause.
    """
    require_whole("cohort", "seed", seed, at_least=0)
    require_whole("cohort", "number", number, at_least=0)
    require_one_of("cohort", "muscles", muscles, MUSCLES)
    environment = environment or Environment()
    # A stream of its own for each purpose: the draws of one task do not move those of the other.
    streams = (random_stream(seed, "cohort", number, stream) for stream in range(2 + len(PRESETS)))
    body_rng, *task_rngs, level_rng = map(np.random.default_rng, streams)
    height = _ordinary(body_rng, *HEIGHT)
    mass = _ordinary(body_rng, *BODY_MASS_INDEX) * height**2
    posture = _ordinary(body_rng, *SHOULDER_ANGLE_DEG), _ordinary(body_rng, *ELBOW_ANGLE_DEG)
    body: dict[str, Any] = {"name": f"S{number + 1:02d}", **_body(height, mass, *posture)}
    subjects, levels = {}, {}
    if muscles == "linear":
        for (preset, mean), rng in zip((("position", POSITION), ("relax", RELAX)), task_rngs, strict=True):
            spread = {key: sd for key, sd in SPREAD[preset].items() if key not in BODY}
            subjects[mean.task] = _draw_around(replace(mean, **body), spread, rng, environment)
    else:
        average = average_person()
        for condition, level in average.levels.items():
            levels[condition] = level * math.exp(_ordinary(level_rng, 0.0, SPREAD_LEVEL))
        for task, rng in zip(TASKS, task_rngs, strict=True):
            of_task = {name: level for name, level in levels.items() if name.startswith(task)}
            subjects[task] = _draw_nonlinear(replace(average.subjects[task], **body), of_task, rng, environment)
    return Person(name=body["name"], height=height, mass=mass, subjects=subjects, levels=levels)


def draw_cohort(
    n: int, seed: int, environment: Environment | None = None, *, muscles: str = "nonlinear"
) -> tuple[Person, ...]:
    """The first `n` people of a cohort, see `draw_person`: a larger cohort begins with the same people.

    Raises:
      TypeError: n or seed is no whole number.
      ValueError: n is not positive, seed is negative, or muscles is neither "nonlinear" nor "linear".
      RuntimeError: no stable person was found, which only an odd environment can cause.
    """
    require_whole("cohort", "n", n, at_least=1)
    return tuple(draw_person(seed, number, environment, muscles=muscles) for number in range(n))


def _draw_nonlinear(
    mean: Subject, levels: Mapping[str, float], rng: np.random.Generator, environment: Environment
) -> Subject:
    """`mean` with all muscle parameters times log-normal factors, redrawn until stable at every level."""
    for attempt in range(MAX_REDRAWS):
        # Redrawn seldom: strong people are stable less often, and a cohort without them would be weaker than average.
        if attempt % REDRAWS_OF_OWN == 0:
            alike = _ordinary(rng, 0.0, SPREAD_ALIKE[mean.task])

        def factors(shared: float, rng: np.random.Generator = rng) -> tuple[float, float, float]:
            s, se, e = (math.exp(shared + _ordinary(rng, 0.0, SPREAD_OWN[mean.task])) for _ in range(3))
            return s, se, e

        drawn: dict[str, Any] = {}
        for quantity in ("b", "k", "kv", "kp"):
            groups = zip(factors(alike), mean.muscle_groups(quantity), strict=True)
            s, se, e = (factor * group for factor, group in groups)
            drawn |= {f"{quantity}_s": s + se, f"{quantity}_se": se, f"{quantity}_e": e + se}
        law = mean.muscle
        if law is not None:
            changed: dict[str, Any] = {
                name: tuple(f * value for f, value in zip(factors(shared), law.of_elements(name), strict=True))
                for name, shared in (("short_range_stiffness", alike), ("elastic_limit_deg", 0.0))
            }
            law = replace(law, **changed)
        subject = replace(mean, muscle=law, **drawn)
        at_all = [at_level(subject, level) for level in {1.0, *levels.values()}]
        if all(largest_real_pole(a, environment) < -NONLINEAR_MARGIN for s in at_all for a in s.linear_arms):
            return subject
    raise RuntimeError(f"no stable subject around {mean.name!r} ({mean.task}) in {MAX_REDRAWS} draws on {environment}")


def _draw_around(
    mean: Subject, spread: Mapping[str, float], rng: np.random.Generator, environment: Environment
) -> Subject:
    """`mean` with the parameters of `spread` (name to SD) drawn until they are in range and the arm is stable."""
    for _ in range(MAX_REDRAWS):
        drawn: dict[str, Any] = {key: rng.normal(_mean(mean, key), sd) for key, sd in spread.items()}
        total = drawn.pop("m_tot", None)
        if total is not None:
            drawn.update(m_h=HUMERUS_MASS_SHARE * total, m_f=(1 - HUMERUS_MASS_SHARE) * total)
        if min(drawn.values()) <= 0:
            continue
        subject = replace(mean, **drawn)
        if largest_real_pole(subject, environment) < -STABILITY_MARGIN:
            return subject
    raise RuntimeError(f"no stable subject around {mean.name!r} ({mean.task}) in {MAX_REDRAWS} draws on {environment}")


def _mean(preset: Subject, parameter: str) -> float:
    return preset.m_h + preset.m_f if parameter == "m_tot" else getattr(preset, parameter)


def _ordinary(rng: np.random.Generator, mean: float, sd: float) -> float:
    """A normal deviate, redrawn until it lies within `MAX_DEVIATION`."""
    while abs(deviate := rng.normal()) > MAX_DEVIATION:
        pass
    return float(mean + sd * deviate)
