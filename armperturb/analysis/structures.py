"""Arm model structures: which parameters are estimated, within which bounds, and what the others are (table C.1)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armperturb.analysis.arm_model import Delay, arm_admittance_gradient, joint_impedance_gradient
from armperturb.subject import HUMERUS_MASS_SHARE, Subject

Gradient = Callable[[Subject, ArrayLike, Sequence[str], Delay], NDArray[np.complex128]]

UNITS = {"m": "kg", "b": "Nms/rad", "k": "Nm/rad", "kv": "Nms/rad", "kp": "Nm/rad", "Td": "s", "fact": "Hz"}
GRIP_UNITS = {"b_h": "Ns/m", "k_h": "N/m"}


def unit(parameter: str) -> str:
    """SI unit of a parameter."""
    return GRIP_UNITS.get(parameter) or UNITS[parameter.partition("_")[0]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Structure:
    """One arm model structure.

    Attributes:
      name: as the thesis numbers it.
      start: published value of each free parameter, SI; the default start of a fit.
      bounds: lower and upper bound of each free parameter, SI.
      fixed: value of parameters that are not estimated, SI; by task where it depends on the task.
    """

    name: str
    start: Mapping[str, float]
    bounds: Mapping[str, tuple[float, float]]
    fixed: Mapping[str, Mapping[str, float]]

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the estimated parameters; `m_tot` stands for both masses (eqs 2.14, 2.15)."""
        return tuple(self.bounds)

    def arm(self, body: Subject, values: ArrayLike) -> Subject:
        """The arm with these free parameters.

        Args:
          body: gives task, segment lengths and posture.
          values: of the free parameters, (parameter,).
        """
        parameters: dict[str, Any] = dict(zip(self.free, map(float, np.asarray(values)), strict=True))
        parameters.update(self.fixed[body.task])
        total = parameters.pop("m_tot", None)
        if total is not None:
            parameters.update(m_h=HUMERUS_MASS_SHARE * total, m_f=(1 - HUMERUS_MASS_SHARE) * total)
        return replace(body, **parameters)

    def admittance_gradient(self, arm: Subject, frequency: ArrayLike, delay: Delay) -> NDArray[np.complex128]:
        """Derivative of the admittance with respect to the free parameters, (frequency, output, input, parameter)."""
        return self._tied(arm_admittance_gradient, arm, frequency, delay)

    def impedance_gradient(self, arm: Subject, frequency: ArrayLike, delay: Delay) -> NDArray[np.complex128]:
        """Derivative of the joint impedance by the free parameters, (frequency, joint, joint, parameter)."""
        return self._tied(joint_impedance_gradient, arm, frequency, delay)

    def _tied(self, gradient_of: Gradient, arm: Subject, frequency: ArrayLike, delay: Delay) -> NDArray[np.complex128]:
        if "m_tot" not in self.free:
            return gradient_of(arm, frequency, self.free, delay)
        names = ("m_h", *("m_f" if name == "m_tot" else name for name in self.free))
        gradient = gradient_of(arm, frequency, names, delay)
        humerus, gradient = gradient[..., 0], gradient[..., 1:]
        total = self.free.index("m_tot")
        gradient[..., total] = HUMERUS_MASS_SHARE * humerus + (1 - HUMERUS_MASS_SHARE) * gradient[..., total]
        return gradient


_NO_REFLEX = {f"{quantity}_{joint}": 0.0 for quantity in ("kv", "kp") for joint in ("s", "se", "e")}
_DAMPING, _STIFFNESS = (0.0, 1e2), (0.0, 1e3)

_MODEL_1 = Structure(
    name="1",
    # Table C.13, model 1 (RT7.5, without penalty).
    start=MappingProxyType(
        dict(m_h=2.04, m_f=1.92, b_s=1.91, b_se=1.25, b_e=1.47, k_s=7.7, k_se=1.8, k_e=5.5, b_h=32.8, k_h=8.4e3)
    ),
    # Table C.2.
    bounds=MappingProxyType(
        {
            "m_h": (1.0, 3.0),
            "m_f": (0.5, 4.0),
            **{name: _DAMPING for name in ("b_s", "b_se", "b_e")},
            **{name: _STIFFNESS for name in ("k_s", "k_se", "k_e")},
            "b_h": (0.0, 5e3),
            "k_h": (2e3, 3e4),
        }
    ),
    fixed=MappingProxyType({"PT": _NO_REFLEX, "RT": _NO_REFLEX}),
)

_DELAY_AND_CUTOFF = {"Td_s": 0.030, "Td_e": 0.030, "fact_s": 3.5, "fact_e": 3.5}

_MODEL_3B = Structure(
    name="3b",
    # Table E.3, start vartheta_i5.
    start=MappingProxyType(
        dict(
            m_tot=2.96,
            b_s=2.98,
            b_se=4.78,
            b_e=13.41,
            k_s=148.2,
            k_se=82.1,
            k_e=131.5,
            kv_s=9.7,
            kv_se=10.2,
            kv_e=14.8,
            kp_s=7.5,
            kp_se=8.1,
            kp_e=28.3,
        )
    ),
    # Table E.2.
    bounds=MappingProxyType(
        {
            "m_tot": (0.5, 8.0),
            **{name: _DAMPING for name in ("b_s", "b_se", "b_e")},
            **{name: _STIFFNESS for name in ("k_s", "k_se", "k_e")},
            **{name: _DAMPING for name in ("kv_s", "kv_se", "kv_e")},
            **{name: _STIFFNESS for name in ("kp_s", "kp_se", "kp_e")},
        }
    ),
    # Section 2.7.
    fixed=MappingProxyType(
        {
            "PT": {"b_h": 57.0, "k_h": 22.4e3, **_DELAY_AND_CUTOFF},
            "RT": {"b_h": 32.8, "k_h": 8.4e3, **_DELAY_AND_CUTOFF},
        }
    ),
)

STRUCTURES = MappingProxyType({structure.name: structure for structure in (_MODEL_1, _MODEL_3B)})
"""Structures by name: 1 (intrinsic and grip) and 3b (total mass, velocity and position feedback without negative gains;
grip, delay and cut-off fixed)."""
