"""Stiffness, damping and inertia at the hand, as matrices and ellipses with confidence intervals.

Symbols: q = joint angles [rad], J = Jacobian from q to the hand [m/rad], f = force of the handle on the hand [N], K, B,
I = stiffness, damping and inertia of the joints. The arm is at rest where J(q)^T f equals the torque of its muscles.
From one such posture to the next, d(J^T f) = K dq; as dx = J dq, the force that holds the hand there changes with x by

    K_hand = J^-T (K - d(J^T f)/dq) J^-1,      B_hand = J^-T B J^-1,      I_hand = J^-T I J^-1

(McIntyre, Mussa-Ivaldi & Bizzi 1996, Exp. Brain Res. 110: 248-264). A fit at a mean force f_0 estimates what is in the
brackets there, K_fit = K - d(J^T f_0)/dq at the recorded posture, so that K is K_fit plus that derivative. At another
posture, K and B are those of the fit, and the segments turn as rigid bodies. The grip is not part of the hand.

The ellipse of a matrix M is what M makes of all unit vectors (Mussa-Ivaldi, Hogan & Bizzi 1985, J. Neurosci. 5): of
stiffness, the forces that resist a displacement of 1 m. Its area is pi |det M|, its shape the ratio of its axes, its
orientation the direction of the longer one. Errors are those of the parameters, linearised, of the logarithm of area
and shape, and of the angle.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from armperturb.analysis.arm.geometry import RIGHT_DEG, force_stiffness, hand_jacobian, segment_inertias
from armperturb.analysis.arm.parameters import GROUPS, MATRIX, PARAMETERS, parameter_vector
from armperturb.analysis.results import (
    Description,
    Interval,
    Result,
    Table,
    digits_within,
    plain,
    plain_limits,
    quantile,
)
from armperturb.arrays import Array
from armperturb.subject import Subject

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

STRAIGHT_DEG = 1.0
"""An elbow that is closer than this to straight or folded leaves the hand a direction in which it cannot move [deg]."""

LARGEST_HALF = 14.0
"""Half width of the interval of a logarithm from which on there are no limits: a factor of a million tells nothing."""

CIRCULAR = 5.99
"""Squared length of the longer axis's excess over its error below which an ellipse may be a circle: the 95 % quantile
of chi-squared with two degrees of freedom [-]."""

ROUNDING = 1e-12
"""Of the power of errors, relative to the largest [-]; what varies by no more is not estimated at all."""

QUANTITIES = {"stiffness": "N/m", "static stiffness": "N/m", "damping": "Ns/m", "inertia": "kg"}
"""Quantity to the unit of its matrix: intrinsic stiffness, and that with position and force feedback at rest."""

ENTRIES = ("xx", "xy", "yx", "yy")


@dataclass(frozen=True, kw_only=True, eq=False)
class EndpointMatrix:
    """A matrix at the hand and its ellipse.

    Attributes:
      values: (axis, axis).
      covariance: of the errors of xx, xy, yx and yy, (4, 4); all NaN where unknown, all infinite where the data do not
        identify the matrix. Limits of what has no error, as the structure fixes it, are NaN.
    """

    values: Array
    covariance: Array

    def _error(self, slope: Array) -> Array:
        """Standard errors from derivatives by the entries, (..., 4); NaN of what the structure fixes."""
        if not np.isfinite(self.covariance).all():
            return np.full(slope.shape[:-1], float(self.covariance[0, 0]))
        variance = np.einsum("...i,ij,...j", slope, self.covariance, slope)
        is_fixed = variance <= ROUNDING * np.square(slope).sum(axis=-1) * np.trace(self.covariance)
        return np.asarray(np.sqrt(np.where(is_fixed, math.nan, variance)), dtype=float)

    @property
    def fixed(self) -> tuple[str, ...]:
        """Measures of the ellipse that the structure fixes, as a shape that two masses in one proportion have."""
        limits = {
            "area": self.area_interval(),
            "shape": self.shape_interval(),
            "orientation": self.orientation_interval(),
        }
        is_known = bool(np.isfinite(self.covariance).all()) and self.area > 0.0
        return tuple(name for name, (lower, _) in limits.items() if is_known and math.isnan(lower))

    def _parts(self) -> tuple[Array, Array]:
        """Mean m, and u and v, of the square M M^T = [[m + u, v], [v, m - u]]; and their derivatives, (3, 4)."""
        a, b, c, d = self.values.ravel()
        parts = np.array([a * a + b * b + c * c + d * d, a * a + b * b - c * c - d * d, 2 * (a * c + b * d)]) / 2
        return parts, np.array([[a, b, c, d], [a, b, -c, -d], [c, d, a, b]])

    @property
    def area(self) -> float:
        """Of the ellipse, in the square of the matrix's unit."""
        return math.pi * abs(float(np.linalg.det(self.values)))

    @property
    def shape(self) -> float:
        """Longer over shorter axis [-]."""
        longer, shorter = np.linalg.svd(self.values, compute_uv=False)
        return float(longer / shorter) if shorter else math.inf

    @property
    def orientation_deg(self) -> float:
        """Direction of the longer axis, from the x axis, 0 to 180 [deg]."""
        (_, u, v), _ = self._parts()
        return math.degrees(0.5 * math.atan2(v, u)) % 180.0

    @property
    def is_circular(self) -> bool:
        """Whether the ellipse cannot be distinguished from a circle, so that it has no orientation."""
        parts, slope = self._parts()
        if not np.isfinite(self.covariance).all():
            return False
        power, directions = np.linalg.eigh(slope[1:] @ self.covariance @ slope[1:].T)
        if not power[-1] > 0.0:
            return not parts[1:].any()
        # Where one number is estimated, as the mass, u and v vary together, and the power across is rounding.
        across = np.maximum(power, ROUNDING * power[-1])
        return bool(np.sum((parts[1:] @ directions) ** 2 / across) < CIRCULAR)

    def entry_interval(self, level: float = 0.95) -> tuple[Array, Array]:
        """Limits of the matrix's entries, (axis, axis) each."""
        half = quantile(level) * self._error(np.eye(4)).reshape(2, 2)
        return self.values - half, self.values + half

    def area_interval(self, level: float = 0.95) -> Interval:
        """Confidence interval of the area; NaN of a matrix without an inverse, as of the shape."""
        if not self.area:
            return Interval(math.nan, math.nan)
        slope = np.asarray(np.linalg.inv(self.values).T.ravel(), dtype=float)
        return Interval(*map(float, _limits(self.area, quantile(level) * self._error(slope))))

    def shape_interval(self, level: float = 0.95) -> Interval:
        """Confidence interval of the shape, from 1 on where the ellipse may be a circle."""
        if not self.area:
            return Interval(math.nan, math.nan)
        (m, u, v), slope = self._parts()
        r = math.hypot(u, v)
        difference = (u * slope[1] + v * slope[2]) / r if r else np.hypot(slope[1], slope[2])
        half = quantile(level) * self._error((m * difference - r * slope[0]) / (m * m - r * r))
        lower, upper = map(float, _limits(self.shape, half))
        if math.isnan(lower):
            return Interval(math.nan, math.nan)
        return Interval(1.0 if self.is_circular else max(lower, 1.0), upper)

    def orientation_interval(self, level: float = 0.95) -> Interval:
        """Confidence interval of the orientation [deg], 180 deg wide at most, and where the ellipse may be a circle."""
        (_, u, v), slope = self._parts()
        angle, half = self.orientation_deg, math.inf
        if not self.is_circular:
            half = math.degrees(quantile(level) * float(self._error(0.5 * (u * slope[2] - v * slope[1]))))
            half /= u * u + v * v
        half = half if math.isnan(half) else min(half, 90.0)
        return Interval(angle - half, angle + half)

    def outline(self, direction: Array, level: float = 0.95) -> tuple[Array, Array, Array]:
        """Distance from the centre to the ellipse, and its confidence limits; NaN of a matrix without an inverse.

        Args:
          direction: [rad], (n,).
          level: probability with which the limits hold the true distance in each direction [-].
        """
        if not self.area:
            nothing = np.full(len(direction), math.nan)
            return nothing, nothing, nothing
        away = np.linalg.solve(self.values, np.array([np.cos(direction), np.sin(direction)]))
        radius = 1.0 / np.hypot(*away)
        turned = np.linalg.solve(self.values.T, away)
        slope = (turned[:, None] * away).reshape(4, -1).T * radius[:, None] ** 2
        return radius, *_limits(radius, quantile(level) * self._error(slope))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class EndpointImpedance(Result):
    """What the hand of an identified arm feels like in one posture.

    Attributes:
      arm: in this posture.
      condition: in which it was identified.
      force: that holds the hand there, of the handle on the hand [N], (axis,).
      matrices: quantity to its matrix, in the order of `QUANTITIES`; "static stiffness" of arms with position or force
        feedback alone.
    """

    arm: Subject
    condition: str
    force: Array
    matrices: Mapping[str, EndpointMatrix]

    def __getitem__(self, quantity: str) -> EndpointMatrix:
        return self.matrices[quantity]

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader must know before trusting the ellipses."""
        said = []
        for name, matrix in self.matrices.items():
            if matrix.is_circular:
                said.append(f"the ellipse of {name} cannot be distinguished from a circle: it has no orientation")
            if matrix.fixed:
                part = "" if len(matrix.fixed) > 2 else f"{' and '.join(matrix.fixed)} of "
                said.append(f"the structure fixes {part}{name}: the trials do not tell")
            if np.linalg.eigvalsh(matrix.values + matrix.values.T)[0] < 0.0:
                said.append(f"{name} is negative in some directions: an ellipse does not describe it")
        return tuple(said)

    def describe(self) -> Description:
        """Posture, and size, shape and orientation of each ellipse."""
        rows = []
        for name, matrix in self.matrices.items():
            cells = (
                _with_limits(matrix.area, matrix.area_interval()),
                _with_limits(matrix.shape, matrix.shape_interval()),
                _with_limits(matrix.orientation_deg, matrix.orientation_interval()),
            )
            entries = " ".join(plain(matrix.values[row, column], 3) for row, column in ((0, 0), (0, 1), (1, 1)))
            rows.append((f"{name} [{QUANTITIES[name]}]", entries, *cells))
        arm = self.arm
        return Description(
            title=f"Impedance at the hand of {arm.name} in {self.condition}",
            facts=(
                f"shoulder {arm.theta_s_deg:g} deg, elbow {arm.theta_e_deg:g} deg, "
                f"mean force {self.force[0]:.2g}, {self.force[1]:.2g} N; 95 % intervals",
            ),
            table=Table(("", "xx xy yy", "area [unit^2]", "shape", "orientation [deg]"), tuple(rows)),
            remarks=self.remarks,
        )

    def to_frame(self) -> "pd.DataFrame":
        """One row per quantity and entry, area, shape or orientation, with its 95 % confidence interval and posture."""
        import pandas as pd

        rows: list[tuple[Any, ...]] = []
        for name, matrix in self.matrices.items():
            unit = QUANTITIES[name]
            entries = (part.ravel().tolist() for part in (matrix.values, *matrix.entry_interval()))
            rows += [(name, entry, *limits, unit) for entry, *limits in zip(ENTRIES, *entries, strict=True)]
            rows += [
                (name, "area", matrix.area, *matrix.area_interval(), f"({unit})^2"),
                (name, "shape", matrix.shape, *matrix.shape_interval(), "-"),
                (name, "orientation", matrix.orientation_deg, *matrix.orientation_interval(), "deg"),
            ]
        frame = pd.DataFrame(rows, columns=["quantity", "measure", "value", "lower_95", "upper_95", "unit"])
        posture = {"theta_s_deg": self.arm.theta_s_deg, "theta_e_deg": self.arm.theta_e_deg}
        return frame.assign(**posture, condition=self.condition, subject=self.arm.name)

    def to_xarray(self) -> xr.Dataset:
        """The columns `value`, `lower_95` and `upper_95` of `to_frame` along quantity and measure."""
        columns = ["value", "lower_95", "upper_95"]
        dataset = self.to_frame().set_index(["quantity", "measure"])[columns].to_xarray()
        arm, condition = self.arm, self.condition
        return dataset.assign_attrs(
            theta_s_deg=arm.theta_s_deg, theta_e_deg=arm.theta_e_deg, condition=condition, subject=arm.name
        )

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the arm and its ellipses with their 95 % bands.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (panel,): stiffness, damping, inertia.
        """
        return plot_endpoints({self.condition: self}, figure)


def plot_endpoints(endpoints: Mapping[str, EndpointImpedance], figure: "Figure | None" = None) -> Any:
    """Draw arms and ellipses of several conditions over one another.

    Args:
      endpoints: condition, for the legend, to what is drawn.
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Matplotlib axes, (panel,): stiffness, damping, inertia.
    """
    from armperturb.plots.ellipses import Posture, plot_ellipses

    postures = {
        label: Posture(_joint_positions(each.arm), {name: matrix.outline for name, matrix in each.matrices.items()})
        for label, each in endpoints.items()
    }
    return plot_ellipses(postures, QUANTITIES, figure)


def _joint_positions(arm: Subject) -> Array:
    """Shoulder, elbow and hand [m], (3, axis)."""
    angles = np.cumsum(arm.posture)
    lengths = np.array([[arm.l_h], [arm.l_f]])
    return np.vstack([np.zeros(2), np.cumsum(lengths * np.column_stack([np.cos(angles), np.sin(angles)]), axis=0)])


def endpoint_impedance(
    arm: Subject,
    covariance: ArrayLike,
    *,
    recorded_force: ArrayLike = (0.0, 0.0),
    posture_deg: tuple[float, float] | None = None,
    force: ArrayLike | None = None,
    condition: str = "",
) -> EndpointImpedance:
    """Stiffness, damping and inertia at the hand of an identified arm.

    Args:
      arm: as identified, in the recorded posture.
      covariance: of the errors of its parameters (`arm.parameters.PARAMETERS`), (parameter, parameter): zero for those
        that are not estimated, infinite on the diagonal for those that the data do not identify, NaN where unknown.
      recorded_force: mean force of the handle on the hand in the recording [N], (axis,).
      posture_deg: shoulder and elbow angle [deg]; None for the recorded posture.
      force: mean force on the hand in that posture [N], (axis,); None for the recorded one.
      condition: in which the arm was identified.

    Raises:
      ValueError: the elbow is straight or folded, the posture is out of range, a force is not two finite numbers, or
        the elbow is another one than the recorded right angle of an arm whose inertia is beyond that of its segments.
    """
    shoulder, elbow = posture_deg or (arm.theta_s_deg, arm.theta_e_deg)
    if is_straight(elbow):
        raise ValueError(
            f"endpoint: theta_e_deg = {elbow!r}; expected an elbow at least {STRAIGHT_DEG:g} deg from straight or "
            "folded, where the hand cannot move along the arm (posture_deg chooses another posture)"
        )
    if elbow != arm.theta_e_deg and any((arm.i_s, arm.i_se, arm.i_e)) and abs(abs(arm.theta_e_deg) - 90.0) < RIGHT_DEG:
        raise ValueError(
            f"endpoint: theta_e_deg = {elbow!r}; expected the recorded {arm.theta_e_deg:g} deg, as at a right angle "
            "the inertia of the joints does not show how it changes with the elbow (an arm of segment masses has it in "
            "any posture)"
        )
    recorded, held = (_force(each) for each in (recorded_force, recorded_force if force is None else force))
    there = replace(arm, theta_s_deg=shoulder, theta_e_deg=elbow)
    inverse = np.linalg.inv(hand_jacobian(there))
    covariance = np.asarray(covariance, dtype=float)
    joints, slopes = _joint_matrices(arm, there)
    turned = force_stiffness(arm, recorded) - force_stiffness(there, held)
    matrices = {}
    for name, joint in joints.items():
        at_hand = inverse.T @ (joint + turned if "stiffness" in name else joint) @ inverse
        slope = np.einsum("ki,pkl,lj->ijp", inverse, slopes[name], inverse).reshape(4, -1)
        matrices[name] = EndpointMatrix(values=at_hand, covariance=_propagated(slope, covariance))
    return EndpointImpedance(arm=there, condition=condition, force=held, matrices=matrices)


def is_straight(theta_e_deg: float) -> bool:
    """Whether an elbow [deg] is straight or folded, so that the hand has no impedance along the arm."""
    return min(abs(theta_e_deg), abs(180.0 - abs(theta_e_deg))) < STRAIGHT_DEG


def _joint_matrices(arm: Subject, there: Subject) -> tuple[dict[str, Array], dict[str, Array]]:
    """Quantity to joint matrix in another posture, and to its derivatives by the parameters, (parameter, 2, 2)."""
    values = parameter_vector(arm)
    values[GROUPS["grip"]] = 0.0  # may be infinite
    slopes = {name: np.zeros((len(PARAMETERS), 2, 2)) for name in QUANTITIES}
    for quantity, name in (("k", "stiffness"), ("b", "damping"), ("i", "inertia")):
        for (row, column), index in np.ndenumerate(MATRIX[quantity]):
            slopes[name][index, row, column] = 1.0
    slopes["inertia"][GROUPS["m"]] = segment_inertias(there)
    cosine, changed = np.cos(arm.posture[1]), np.cos(there.posture[1])
    if changed != cosine:  # of rigid segments, as i = [[a + 2 c cos, b + c cos], [b + c cos, b]]
        bend = (changed / cosine - 1.0) * np.array([[2.0, 1.0], [1.0, 0.0]])
        slopes["inertia"][MATRIX["i"][0, 1]] += bend
        slopes["inertia"][MATRIX["i"][1, 1]] -= bend
    joints = {name: np.tensordot(values, slopes[name], 1) for name in ("stiffness", "damping", "inertia")}
    position, feedback = (values[MATRIX[quantity]] for quantity in ("kp", "kf"))
    if position.any() or feedback.any():
        loop = np.linalg.inv(np.eye(2) - feedback)
        joints["static stiffness"] = loop @ (joints["stiffness"] + position)
        for quantity, after in (("k", np.eye(2)), ("kp", np.eye(2)), ("kf", joints["static stiffness"])):
            for (row, column), index in np.ndenumerate(MATRIX[quantity]):
                slopes["static stiffness"][index] += np.outer(loop[:, row], after[column])
    return {name: joints[name] for name in QUANTITIES if name in joints}, slopes


def _propagated(slope: Array, covariance: Array) -> Array:
    """Covariance of linear functions of the parameters, (4, 4); see `EndpointMatrix.covariance`."""
    used = slope.any(axis=0)
    part = covariance[np.ix_(used, used)]
    if np.isnan(part).any():
        return np.full((4, 4), math.nan)
    if np.isinf(part).any():
        return np.full((4, 4), math.inf)
    return slope[:, used] @ part @ slope[:, used].T


def _with_limits(value: float, limits: Interval) -> str:
    known = "" if math.isnan(limits.lower) else f" ({plain_limits(*limits, 3)})"
    return f"{plain(value, digits_within(*limits, 3))}{known}"


def _limits(value: Array | float, half: Array) -> tuple[Array, Array]:
    """Limits of a positive quantity from half the interval of its logarithm; zero and infinity where there are none."""
    factor = np.where(half > LARGEST_HALF, math.inf, np.exp(np.minimum(half, LARGEST_HALF)))
    return value / factor, value * factor


def _force(force: ArrayLike) -> Array:
    values = np.asarray(force, dtype=float)
    if values.shape != (2,) or not np.isfinite(values).all():
        raise ValueError(f"endpoint: force = {force!r}; expected two finite numbers, x and y in N")
    return values
