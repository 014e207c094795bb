"""A person of one joint, moved by a servo: what the one-joint laboratory simulates.

The presets are round numbers of the expected size, and nobody's: what follows from them holds for simulated people.

- Inertia of the elbow and of the wrist: forearm with hand, and hand, of a man of 1.74 to 1.80 m by the tables of
  de Leva (1996, J. Biomech. 29), see `armperturb.anthropometry`.
- Inertia, damping and stiffness of the ankle: within those of the recorded ankles of docs/real_people.md.
- All else (damping and stiffness of elbow and wrist, reflexes, posture and held torque) is an assumption of the
  expected size that no source is named for. How such numbers are measured: ankle, Weiss, Hunter & Kearney (1988,
  J. Biomech. 21) and Mirbagheri, Barbeau & Kearney (2000, Exp. Brain Res. 135); wrist, De Serres & Milner (1991, Exp.
  Brain Res. 86); elbow, Bennett, Hollerbach, Xu & Hunter (1992, Exp. Brain Res. 88).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from armperturb.files import packaged_table
from armperturb.muscle_law import MuscleLaw
from armperturb.person_files import PersonInFile
from armperturb.subject import Subject
from armperturb.validation import require_name, require_one_of, require_ranges

SERVO_KINDS = ("position", "force")
"""What a device does: impose the movement, or be a virtual environment that is perturbed."""


@dataclass(frozen=True, kw_only=True)
class JointPerson(PersonInFile):
    """One joint of a synthetic person: intrinsic path, reflex path, and a muscle law as in the arm.

    The joint is the single-joint shoulder element of the arm's muscle law and reflexes (docs/muscle.md).

    Attributes:
      joint: its name, e.g. "ankle".
      inertia: of the limb and what is fixed to it [kg m^2], > 0.
      damping: intrinsic [Nms/rad], >= 0.
      stiffness: intrinsic, at the posture [Nm/rad], >= 0.
      kv: gain of the velocity feedback [Nms/rad].
      kp: gain of the position feedback [Nm/rad].
      delay: of the reflex [s], at least two steps of the simulation.
      cutoff: of the second-order activation [Hz].
      zeta: relative damping of the activation [-].
      posture_deg: angle of the joint about which it is perturbed [deg]; says where, and changes nothing.
      held_torque: mean torque that the person holds against the device [Nm]; likewise.
      muscle: departures from linear muscle and reflexes; None is linear.

    Raises:
      TypeError: a parameter is not a number, or muscle no `MuscleLaw`.
      ValueError: a parameter is not finite or out of its range.
    """

    OPTIONAL: ClassVar = ("kv", "kp", "delay", "cutoff", "zeta", "posture_deg", "held_torque", "muscle")
    EXAMPLE: ClassVar = "inertia = 0.016"

    joint: str
    inertia: float
    damping: float
    stiffness: float
    kv: float = 0.0
    kp: float = 0.0
    delay: float = 0.04
    cutoff: float = 5.0
    zeta: float = 0.75
    posture_deg: float = 0.0
    held_torque: float = 0.0
    muscle: MuscleLaw | None = None

    def __post_init__(self) -> None:
        require_name("JointPerson", "joint", self.joint)
        require_ranges("JointPerson", self)
        if self.muscle is not None and not isinstance(self.muscle, MuscleLaw):
            raise TypeError(f"JointPerson: muscle = {self.muscle!r}; expected MuscleLaw or None")

    @property
    def subject(self) -> Subject:
        """The arm whose single-joint shoulder muscles are those of this joint; its elbow is meant to be held."""
        muscle = self.muscle
        if muscle is not None:
            stiffness, _, _ = muscle.of_elements("short_range_stiffness")
            muscle = replace(muscle, short_range_stiffness=(stiffness, 0.0, 0.0))
        values: dict[str, float] = {"k_s": self.stiffness, "b_s": self.damping, "kv_s": self.kv, "kp_s": self.kp}
        others = dict.fromkeys(("k_se", "k_e", "b_se", "b_e"), 0.0)
        timing = {"Td_s": self.delay, "Td_e": self.delay, "fact_s": self.cutoff, "fact_e": self.cutoff}
        body = {"m_h": 1.0, "m_f": 1.0, "b_h": 1.0, "k_h": 1.0, "theta_s_deg": 0.0, "zeta_act": self.zeta}
        return Subject(task="PT", name=self.joint, muscle=muscle, **values, **others, **timing, **body)

    @property
    def natural_frequency(self) -> float:
        """At which intrinsic stiffness and inertia need the same torque [Hz]."""
        return math.sqrt(self.stiffness / self.inertia) / math.tau

    def at_level(self, level: float) -> Self:
        """The person at another level of contraction: torques in proportion, thresholds of spindles moved.

        Args:
          level: of contraction, as a multiple of the person's own [-], >= 0.
        """
        changes = {name: level * getattr(self, name) for name in ("damping", "stiffness", "kv", "kp", "held_torque")}
        return replace(self, muscle=self.muscle and self.muscle.at_level(level), **changes)


@dataclass(frozen=True, kw_only=True)
class Servo:
    """The device, fixed to the limb: an inertia, damper and spring about the joint.

    A position servo is a stiff one whose neutral angle follows the command; a force servo is a virtual environment that
    a torque perturbs.

    Attributes:
      kind: of `SERVO_KINDS`.
      inertia: [kg m^2], > 0.
      damping: [Nms/rad], >= 0.
      stiffness: [Nm/rad], >= 0.

    Raises:
      ValueError: the kind is unknown, or a value is out of its range.
    """

    kind: str
    inertia: float
    damping: float
    stiffness: float

    def __post_init__(self) -> None:
        require_one_of("Servo", "kind", self.kind, SERVO_KINDS)
        require_ranges("Servo", self)


_TABLES = packaged_table(__package__, "joint_people.toml")

JOINT_PEOPLE: Mapping[str, JointPerson] = {
    name: JointPerson.from_dict(values) for name, values in _TABLES["people"].items()
}
"""Presets by joint; their reflex is linear, see `half_wave`."""


def half_wave(person: JointPerson, threshold: float, slope: float = 0.0) -> JointPerson:
    """The person with spindles that respond to stretch alone (Kearney, Stein & Parameswaran 1997).

    Args:
      person: with a reflex.
      threshold: speed of stretch above which they respond [rad/s]; below zero they fire at rest.
      slope: change of the threshold per unit of contraction [rad/s], see `JointPerson.at_level`.
    """
    law = person.muscle or MuscleLaw()
    one_sided = replace(law, spindle_direction=1.0, spindle_threshold=threshold, spindle_threshold_slope=slope)
    return replace(person, muscle=one_sided)


def servo_of(joint: str, kind: str) -> Servo:
    """The preset device of a joint; that of the ankle for a joint that has none.

    Raises:
      ValueError: the kind is unknown.
    """
    require_one_of("servo", "kind", kind, SERVO_KINDS)
    return Servo(kind=kind, **_TABLES["servos"].get(joint, _TABLES["servos"]["ankle"])[kind])
