"""The arm of one person in one condition, as an estimator gives it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armperturb.analysis.arm.geometry import force_stiffness
from armperturb.analysis.arm.linear_arm import LinearArm, arm_admittance
from armperturb.analysis.arm.parameters import parameter_vector
from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.defaults import Estimator
from armperturb.analysis.fit.ladder import Choice
from armperturb.analysis.fit.maximum_likelihood import Estimate
from armperturb.analysis.fit.structures import Structure, unit
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.measures.endpoint import EndpointImpedance, endpoint_impedance
from armperturb.analysis.measures.start_geometry import held_force
from armperturb.analysis.response.frequency_response import Bands
from armperturb.analysis.response.spectra import SpectralEstimate
from armperturb.analysis.results import Description, FitResult, parameter_table, plain, quantile
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.subject import Subject


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ArmFit(FitResult):
    """The arm of one person in one condition, as an estimator gives it.

    For the thesis's estimator, a standard error is the mean over trials of the SEM (eq. 2.22), intervals treat it as a
    standard error, parameters at a bound are those that sit there in any trial, and correlations are unknown.

    Attributes:
      estimator: which.
      structure: name of the model structure.
      condition: in which the arm was perturbed.
      arm: the estimated arm, fixed parameters included.
      force: mean force of the handle on the hand before the pulses [N], (axis,).
      mixing: derivative of the arm's parameters (`arm.parameters.PARAMETERS`) by the free ones, (arm parameter,
        parameter).
      stable: whether arm and environment are stable together.
      largest_real_pole: of arm and environment [1/s].
      criterion: V of eq. 2.19, without penalty, of the arm against the averaged spectra.
      detail: the estimator's own result.
      trials: that were fitted, as recorded or as `in_start_geometry` has them; empty if they are always as recorded.
      choice: of the structure, where the trials chose it.
    """

    estimator: Estimator
    structure: str
    condition: str
    arm: Subject
    force: Array
    mixing: Array
    stable: bool
    largest_real_pole: float
    criterion: float
    detail: Estimate | ThesisEstimate
    trials: tuple[ConditionTrials, ...] = ()
    choice: Choice | None = None

    def unit_of(self, name: str) -> str:
        """SI unit of a parameter."""
        return unit(name)

    def place_of(self, name: str) -> tuple[str, str]:
        """Name of a parameter in tables, and the condition."""
        return name, self.condition

    @property
    def labels(self) -> dict[str, str]:
        """The subject."""
        return {"subject": self.arm.name}

    def admittance_bands(self, frequency: ArrayLike, level: float = 0.95) -> Bands | None:
        """Confidence bands of the arm's admittance that follow from the intervals of its parameters, linearised.

        Args:
          frequency: [Hz], (frequency,).
          level: probability with which a band holds the true gain or phase, each by itself [-].

        Returns:
          Limits of gain and phase; None where an error or a correlation is not known.
        """
        error = self._errors()
        covariance = self.correlation * np.outer(error, error)
        if not np.isfinite(covariance).all():
            return None
        values, slope = LinearArm(self.arm, frequency).admittance_and_gradient(parameter_vector(self.arm))
        relative = slope @ self.mixing / values[..., None]

        def half(part: Array) -> Array:
            variance = np.einsum("...p,pq,...q", part, covariance, part)
            return np.asarray(quantile(level) * np.sqrt(np.maximum(variance, 0.0)))

        gain, phase = np.abs(values), np.angle(values)
        factor, angle = np.exp(half(relative.real)), np.minimum(half(relative.imag), np.pi)
        return Bands(gain / factor, gain * factor, phase - angle, phase + angle)

    def _errors(self) -> Array:
        """Standard errors whose normal 95 % intervals are as wide as those of the parameters, (parameter,)."""
        half = np.array([np.subtract(*self.interval(name)[::-1]) / 2.0 for name in self.values])
        return np.asarray(half / quantile(0.95))

    def endpoint(
        self, *, posture_deg: tuple[float, float] | None = None, force: ArrayLike | None = None
    ) -> EndpointImpedance:
        """Stiffness, damping and inertia at the hand, as matrices and ellipses with confidence intervals.

        Args:
          posture_deg: shoulder and elbow angle [deg]; None for the recorded posture.
          force: mean force on the hand in that posture [N], (axis,); None for that of the recording.

        Raises:
          ValueError: as `measures.endpoint.endpoint_impedance`.
        """
        error = self._errors()
        known = np.isfinite(error)
        error, part = error[known], self.mixing[:, known]
        covariance = part @ (self.correlation[np.ix_(known, known)] * np.outer(error, error)) @ part.T
        unknown = self.mixing[:, ~known].any(axis=1)
        covariance[unknown, unknown] = np.inf
        return endpoint_impedance(
            self.arm,
            covariance,
            recorded_force=self.force,
            posture_deg=posture_deg,
            force=self.force if force is None else force,
            condition=self.condition,
        )

    def describe(self) -> Description:
        """Estimates and how the search ended."""
        return Description(
            title=f"Arm of {self.arm.name} in {self.condition}: model {self.structure}, estimator {self.estimator!r}",
            facts=(self.message, f"largest pole of arm and environment {plain(self.largest_real_pole, 3)} 1/s"),
            table=parameter_table(self.to_frame()),
            remarks=self.remarks,
        )


def facts_of_arm(
    arm: Subject, structure: Structure, parts: Sequence[ConditionTrials], spectra: SpectralEstimate
) -> dict[str, Any]:
    """What any estimator's `ArmFit` holds of an arm.

    Args:
      arm: as estimated.
      structure: of which it is.
      parts: trials of the condition; the manipulator is that of the first part.
      spectra: of all of them.
    """
    pole = largest_real_pole(arm, parts[0].environment)
    error = np.abs(np.log(spectra.arm / arm_admittance(arm, spectra.frequency))) ** 2
    criterion = float(np.mean(spectra.coherence[:, :, None] * error)) if np.isfinite(error).all() else math.inf
    n_samples = [part.n_trials * part.first_onset for part in parts]
    return {
        "structure": structure.name,
        "condition": parts[0].label,
        "arm": arm,
        "force": np.average([held_force(part) for part in parts], axis=0, weights=n_samples),
        "mixing": structure.mixing,
        "stable": pole < 0.0,
        "largest_real_pole": pole,
        "criterion": criterion,
    }


def remark_on_force(arm: Subject, force: Array, errors: Mapping[str, float]) -> list[str]:
    """What the mean force on the hand [N], (axis,), adds to the stiffness of the joints, where it is not negligible."""
    held = -force_stiffness(arm, force)
    added = {"k_s": held[0, 0], "k_se": held[0, 1], "k_e": held[1, 1]}
    if not any(name in errors and abs(part) > errors[name] for name, part in added.items()):
        return []
    each = ", ".join(f"{plain(part, 3)} of {name}" for name, part in added.items())
    return [
        f"the mean force on the hand, x {plain(force[0], 3)} and y {plain(force[1], 3)} N, makes {each} [Nm/rad]; the "
        "rest is the muscles' own"
    ]
