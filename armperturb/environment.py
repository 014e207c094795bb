"""What the hand holds: the virtual mass, spring and damper of the manipulator (thesis 2.2)."""

from dataclasses import dataclass

from armperturb.validation import require_number


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
        for name in ("m_env", "workspace"):
            require_number("Environment", name, getattr(self, name), above=0.0)
        for name in ("b_env", "k_env"):
            require_number("Environment", name, getattr(self, name), at_least=0.0)
