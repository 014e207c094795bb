"""A person in one task: the parameters of the linear arm model (thesis 2.7, appendix B)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from armperturb.files import packaged_table
from armperturb.muscle_law import MuscleLaw
from armperturb.person_files import PersonInFile
from armperturb.validation import require_number, require_one_of, require_ranges

TASKS = ("PT", "RT")
"""Position task (keep the handle in place) and relax task (do not react); thesis 2.5."""

HUMERUS_MASS_SHARE = 0.49
"""Share of the arm's mass in the humerus, the rest in forearm, hand, cuff and handle (thesis eqs 2.14, 2.15)."""

_OF_RIGID_BODIES = {"c_h": 0.5, "c_f": 0.5, "r_h": 0.0, "r_f": 0.0, "i_s": 0.0, "i_se": 0.0, "i_e": 0.0}
"""What segments that are points in the middle have; files leave it out."""

_OPTIONAL = ("ka_s", "ka_se", "ka_e", "kf_s", "kf_se", "kf_e", "zeta_act", "muscle", "name", *_OF_RIGID_BODIES)


@dataclass(frozen=True, kw_only=True)
class Subject(PersonInFile):
    """One synthetic person in one task.

    Joint quantities come in triples (s, se, e): shoulder, two-joint, elbow. They are entries of symmetric matrices,
    [[k_s, k_se], [k_se, k_e]] (thesis eq. 2.9), not muscle groups (eq. 2.10; see `muscle_groups`).

    Attributes:
      task: "PT" (position task) or "RT" (relax task).
      m_h: mass of the humerus [kg]; 0 where i_s, i_se and i_e hold the whole inertia.
      m_f: mass of forearm, hand, cuff and handle [kg]; 0 likewise.
      b_s: intrinsic damping, shoulder [Nms/rad].
      b_se: intrinsic damping, two-joint [Nms/rad].
      b_e: intrinsic damping, elbow [Nms/rad].
      k_s: intrinsic stiffness, shoulder [Nm/rad].
      k_se: intrinsic stiffness, two-joint [Nm/rad].
      k_e: intrinsic stiffness, elbow [Nm/rad].
      b_h: grip damping [Ns/m].
      k_h: grip stiffness [N/m]; infinite for a rigid grip, which the linear arm has and simulators refuse.
      kv_s: velocity feedback gain, shoulder [Nms/rad].
      kv_se: velocity feedback gain, two-joint [Nms/rad].
      kv_e: velocity feedback gain, elbow [Nms/rad].
      kp_s: position feedback gain, shoulder [Nm/rad].
      kp_se: position feedback gain, two-joint [Nm/rad].
      kp_e: position feedback gain, elbow [Nm/rad].
      ka_s: acceleration feedback gain, shoulder [Nms^2/rad].
      ka_se: acceleration feedback gain, two-joint [Nms^2/rad].
      ka_e: acceleration feedback gain, elbow [Nms^2/rad].
      kf_s: force feedback gain, shoulder [-]; negative inhibits, as tendon organs do (see `analysis.arm`).
      kf_se: force feedback gain, two-joint [-].
      kf_e: force feedback gain, elbow [-].
      Td_s: neural delay of the torque at the shoulder [s].
      Td_e: neural delay of the torque at the elbow [s].
      fact_s: cut-off frequency of the muscle activation at the shoulder [Hz].
      fact_e: cut-off frequency of the muscle activation at the elbow [Hz].
      l_h: length of the humerus, shoulder to elbow [m].
      l_f: length of the forearm, elbow to the middle of the grip [m].
      theta_s_deg: shoulder angle of the start posture, from the x axis [deg].
      theta_e_deg: elbow angle of the start posture, relative to the humerus [deg].
      zeta_act: relative damping of the activation filter [-]. The thesis calls the filter both "critically damped" (1)
        and "Butterworth" (1 / sqrt 2, the default).
      c_h: distance of the humerus's centre of mass from the shoulder, over l_h [-]. The default is the thesis's point
        in the middle; `anthropometry` has values of people.
      c_f: distance of the centre of mass of forearm and hand from the elbow, over l_f [-].
      r_h: radius of gyration of the humerus about its centre of mass, over l_h [-]; 0 for a point.
      r_f: radius of gyration of forearm and hand about their centre of mass, over l_f [-].
      i_s: inertia at the start posture beyond that of the segments, shoulder [kg m^2]. The linear arm has it;
        simulators want rigid segments instead (`analysis.arm.geometry.with_rigid_segments`).
      i_se: the same, between the joints [kg m^2].
      i_e: the same, elbow [kg m^2].
      muscle: how the muscles depart from linear ones; None is linear.
      name: what the person is called in recordings and tables.

    Raises:
      TypeError: a parameter is not a number, muscle no `MuscleLaw`, or name is not text.
      ValueError: a parameter is not finite or out of its range, the task is unknown, the joint inertia is not positive
        definite, or the damping of a muscle group would give energy.
    """

    OPTIONAL: ClassVar = _OPTIONAL
    LEFT_OUT: ClassVar = {**_OF_RIGID_BODIES, "muscle": None}
    EXAMPLE: ClassVar = "m_h = 2.06"

    task: str
    m_h: float
    m_f: float
    b_s: float
    b_se: float
    b_e: float
    k_s: float
    k_se: float
    k_e: float
    b_h: float
    k_h: float
    kv_s: float = 0.0
    kv_se: float = 0.0
    kv_e: float = 0.0
    kp_s: float = 0.0
    kp_se: float = 0.0
    kp_e: float = 0.0
    ka_s: float = 0.0
    ka_se: float = 0.0
    ka_e: float = 0.0
    kf_s: float = 0.0
    kf_se: float = 0.0
    kf_e: float = 0.0
    Td_s: float = 0.030
    Td_e: float = 0.030
    fact_s: float = 3.5
    fact_e: float = 3.5
    l_h: float = 0.33
    l_f: float = 0.34
    theta_s_deg: float = 22.5
    theta_e_deg: float = 82.3
    zeta_act: float = 1.0 / math.sqrt(2.0)
    c_h: float = 0.5
    c_f: float = 0.5
    r_h: float = 0.0
    r_f: float = 0.0
    i_s: float = 0.0
    i_se: float = 0.0
    i_e: float = 0.0
    muscle: MuscleLaw | None = None
    name: str = "subject"

    def __post_init__(self) -> None:
        require_one_of("Subject", "task", self.task, TASKS)
        if not isinstance(self.name, str) or not self.name or not self.name.isprintable():
            raise TypeError(f"Subject: name = {self.name!r}; expected a printable text that is not empty")
        if not self.has_extra_inertia:
            for field in ("m_h", "m_f"):
                require_number("Subject", field, getattr(self, field), above=0.0)
        require_ranges("Subject", self)
        if self.has_extra_inertia:
            self._require_positive_inertia()
        if self.muscle is None:
            return
        if not isinstance(self.muscle, MuscleLaw):
            raise TypeError(f"Subject: muscle = {self.muscle!r}; expected MuscleLaw or None")
        if min(self.muscle.of_elements("thinning_velocity")) == math.inf:
            return
        for field in ("b_s", "b_e"):
            # With a negative damper among them, linear dampers may be passive together; shear-thinning ones are not.
            if getattr(self, field) < self.b_se:
                raise ValueError(
                    f"Subject: {field} = {getattr(self, field)!r}; expected at least b_se = {self.b_se!r} with "
                    "shear-thinning damping: below it the single-joint group's own damping is negative and gives energy"
                )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], source: str | None = None) -> Self:
        """As `PersonInFile.from_dict`, which says nothing of a person per task.

        Raises:
          ValueError: the values are a table per task, a key is unknown or missing, or a value is refused.
          TypeError: a value has the wrong type.
        """
        of_tasks = [task for task in TASKS if task in values]
        if of_tasks:
            raise ValueError(
                f"{cls.__name__.lower() if source is None else source}: has a table for {' and '.join(of_tasks)}, as "
                "calibrate writes them; expected the parameters of one task (in Python "
                f"Subject.from_dict(tomllib.load(open(FILE, 'rb'))[{of_tasks[0]!r}]).save('person.toml'))"
            )
        return super().from_dict(values, source)

    @property
    def has_extra_inertia(self) -> bool:
        """Whether there is joint inertia beyond that of the segments."""
        return bool(self.i_s or self.i_se or self.i_e)

    @property
    def has_rigid_grip(self) -> bool:
        """Whether the hand cannot move on the handle."""
        return self.k_h == math.inf

    @property
    def segment_inertia(self) -> tuple[float, float, float]:
        """Inertia of the segments in any posture [kg m^2], as three constants a, b and c.

        The joint mass matrix is a + 2 c cos(theta_e) at the shoulder, b at the elbow and b + c cos(theta_e) between.
        """
        square_h, arm_f, l_h = self.l_h * self.l_h, self.c_f * self.l_f, self.l_h
        of_humerus = self.m_h * ((self.c_h * l_h) * (self.c_h * l_h) + self.r_h * self.r_h * square_h)
        about_elbow = arm_f * arm_f + self.r_f * self.r_f * (self.l_f * self.l_f)
        return of_humerus + self.m_f * (square_h + about_elbow), self.m_f * about_elbow, self.m_f * l_h * arm_f

    def require_simulable(self) -> None:
        """Refuse an arm that only the linear model can have.

        Raises:
          ValueError: there is joint inertia beyond that of the segments, or the grip is rigid.
        """
        if self.has_extra_inertia:
            raise ValueError(
                f"subject {self.name!r}: i_s, i_se, i_e = {self.i_s:g}, {self.i_se:g}, {self.i_e:g}; expected 0 in a "
                "simulation, whose segments are rigid (a model with segment masses, as identify --model 3b; in Python "
                "armperturb.analysis.arm.geometry.with_rigid_segments)"
            )
        if self.has_rigid_grip:
            raise ValueError(
                f"subject {self.name!r}: k_h = inf; expected a finite grip stiffness in a simulation (1e6 N/m moves "
                "the hand as a rigid grip does)"
            )

    def _require_positive_inertia(self) -> None:
        a, b, c = self.segment_inertia
        bend = c * math.cos(math.radians(self.theta_e_deg))
        s, se, e = a + 2.0 * bend + self.i_s, b + bend + self.i_se, b + self.i_e
        if not (s > 0.0 and s * e > se * se):
            raise ValueError(
                f"Subject: i_s, i_se, i_e = {self.i_s!r}, {self.i_se!r}, {self.i_e!r} give the joint inertia "
                f"[[{s:.4g}, {se:.4g}], [{se:.4g}, {e:.4g}]] kg m^2; expected a positive definite one"
            )

    @property
    def posture(self) -> np.ndarray:
        """Start angles of shoulder (from the x axis) and elbow (from the humerus) [rad], (joint,)."""
        return np.radians([self.theta_s_deg, self.theta_e_deg])

    def joint_triple(self, quantity: str) -> tuple[float, float, float]:
        """Entries (s, se, e) of one joint matrix; quantity is "b", "k", "kv", "kp", "ka", "kf" or "i" (eq. 2.9)."""
        return tuple(getattr(self, f"{quantity}_{joint}") for joint in ("s", "se", "e"))

    def joint_matrix(self, quantity: str) -> np.ndarray:
        """Symmetric joint matrix [[s, se], [se, e]] of a quantity of `joint_triple`, (joint, joint) (eq. 2.9)."""
        s, se, e = self.joint_triple(quantity)
        return np.array([[s, se], [se, e]])

    def muscle_groups(self, quantity: str) -> tuple[float, float, float]:
        """Own values of the muscle groups: single-joint shoulder, two-joint, single-joint elbow (eq. 2.10)."""
        s, se, e = self.joint_triple(quantity)
        return s - se, se, e - se

    @property
    def linear_arms(self) -> tuple[Self, ...]:
        """The linear arms between which a nonlinear one works: large movements, and small ones if they are stiffer.

        Large movements have yielded, and leave the subject's own parameters; in small ones all short-range stiffness is
        intact. A linear arm is the only one of itself.
        """
        if self.muscle is None:
            return (self,)
        large = replace(self, muscle=None)
        s, se, e = self.muscle.of_elements("short_range_stiffness")
        if not s + se + e:
            return (large,)
        return large, replace(large, k_s=self.k_s + s + se, k_se=self.k_se + se, k_e=self.k_e + e + se)


def at_level(subject: Subject, level: float) -> Subject:
    """The subject at another level of co-contraction: all muscle torques in proportion to it.

    Intrinsic damping, stiffness and short-range stiffness and the gains of velocity, position and acceleration feedback
    are multiplied. Force feedback is a share of the muscles' torque, and stays. Thresholds of spindles move as
    `MuscleLaw.spindle_threshold_slope` says.

    Args:
      subject: the person at level 1.
      level: of activation, as a multiple of the subject's own [-], >= 0.

    Raises:
      TypeError: level is no number.
      ValueError: level is negative or not finite.
    """
    require_number("at_level", "level", level, at_least=0.0)
    changes: dict[str, Any] = {
        f"{quantity}_{joint}": level * value
        for quantity in ("b", "k", "kv", "kp", "ka")
        for joint, value in zip(("s", "se", "e"), subject.joint_triple(quantity), strict=True)
    }
    return replace(subject, muscle=subject.muscle and subject.muscle.at_level(level), **changes)


_PRESETS = packaged_table(__package__, "presets.toml")

RELAX = Subject(**_PRESETS["relax"])
"""The mean relaxed arm of the thesis: intrinsic and grip parameters only (table C.18, model 1)."""

POSITION = Subject(**_PRESETS["position"])
"""The mean position-task arm of the thesis, reflexes included (table E.3, start vartheta_i5)."""

PRESETS = {"relax": RELAX, "position": POSITION}
"""The thesis's mean arms by name; `armperturb.cohort.draw_subject` draws people around them."""
