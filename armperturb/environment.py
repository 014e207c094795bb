"""What the hand holds and what holds the trunk: manipulator and seat belt (thesis 2.2)."""

from dataclasses import dataclass

from armperturb.validation import require_ranges

TIMESTEP = 2.5e-3
"""Step of simulations of arm and environment [s], by default; docs/laboratory.md has the error that it makes."""


ENGINES = ("mujoco", "compiled")
"""What integrates the equations of motion of the arm: MuJoCo, or `planar_arm`, which is some ten times faster."""


@dataclass(frozen=True, kw_only=True)
class Environment:
    """The manipulator as a linear, isotropic mass-spring-damper (thesis eq. 2.11).

    The defaults are what the thesis identified on its manipulator (eqs C.1-C.3), which was set to 3 kg, 0 Ns/m, 20 N/m.

    Attributes:
      m_env: virtual mass [kg], > 0.
      b_env: virtual damping [Ns/m], >= 0.
      k_env: virtual stiffness [N/m], >= 0, against drift from the start.
      workspace: half the side of the square that the handle may move in, around its start [m], > 0.

    Raises:
      ValueError: a value is not finite or out of its range.
    """

    m_env: float = 3.27
    b_env: float = 0.55
    k_env: float = 22.03
    workspace: float = 0.35

    def __post_init__(self) -> None:
        require_ranges("Environment", self)


@dataclass(frozen=True, kw_only=True)
class Strap:
    """A belt that gives way: the shoulder moves in the horizontal plane, on a spring and damper to the seat.

    Belt, trunk and shoulder girdle are one mass, spring and damper, the same in all directions; the trunk does not
    turn. The thesis saw in its movies that the shoulder moved, more so for larger perturbations in the position task
    (chapter 4), but prints no numbers. The defaults are assumed: pulses of 54 and 108 N (levels 1 and 2) then move the
    shoulder of `POSITION` by 7 and 14 mm; the mass is half a thorax (0.216 of the body's: Winter 2009, Biomechanics and
    Motor Control of Human Movement, 4th ed., table 4.1), the damping 0.4 of critical.

    Attributes:
      stiffness: force per translation of the shoulder [N/m], > 0.
      damping: force per velocity of the shoulder [Ns/m], >= 0.
      mass: that moves with the shoulder, beside the arm [kg], > 0.

    Raises:
      TypeError: a value is not a number.
      ValueError: a value is not finite or out of its range.
    """

    stiffness: float = 5000.0
    damping: float = 160.0
    mass: float = 8.0

    def __post_init__(self) -> None:
        require_ranges("Strap", self)
