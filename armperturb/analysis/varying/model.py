"""Parallel cascade of one joint whose parameters change.

The torque of the device on the limb is

    f = I q'' + B(z) q' + K(z) q + T(z) + h * [g(z) phi(q')](t - T_d),

where z is time in an ensemble of repetitions or a scheduling variable such as a slow imposed angle; phi is linear or
half-wave rectified, h the second-order activation with a gain of one, as in `analysis.joint.model`. B, K, g and the
static torque T (of a scheduling variable) are sums of B-splines of z. A product of a spline and a signal is made first
and filtered afterwards, as the torque is, so that jumps of a parameter are not blurred by the filters.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline

from armperturb.analysis.joint.model import DYNAMICS, THRESHOLD, JointStructure, ReflexPath, closing_of, drive_of
from armperturb.analysis.joint.signals import JointSignals
from armperturb.arrays import Array

DEGREE = 3
"""Of B-splines; a single one is a constant."""

ROUNDING = 1e-12
"""Value below which a spline counts as zero [-]."""


def splines(variable: Array, n_basis: int, low: float, high: float) -> Array:
    """B-splines with evenly spaced knots that sum to one, (basis, ...); constant beyond the ends.

    Args:
      variable: where, any shape.
      n_basis: how many; one is a constant, others are at least four.
      low: where the first knot is.
      high: where the last one is.
    """
    if n_basis == 1:
        return np.ones((1, *np.shape(variable)))
    # In an ensemble all trials are at the same times, one row in memory.
    n_alike = len(variable) if variable.ndim == 2 and variable.strides[0] == 0 else 1
    inner = np.linspace(low, high, n_basis - DEGREE + 1)
    knots = np.concatenate([np.full(DEGREE, low), inner, np.full(DEGREE, high)])
    different = np.clip(variable[:1] if n_alike > 1 else variable, low, high).ravel()
    values = BSpline.design_matrix(different, knots, DEGREE).toarray()
    # Rounding must not pass for data of a spline that no sample reaches.
    values[values < ROUNDING] = 0.0
    if n_alike > 1:
        values = np.tile(values, (n_alike, 1))
    return np.moveaxis(values.reshape(*np.shape(variable), n_basis), -1, 0)


def finer(n_basis: int) -> int:
    """Splines with half the distance of knots, of whose sums those of `n_basis` splines are a special case."""
    return DEGREE + 1 if n_basis == 1 else 2 * n_basis - DEGREE


@dataclass(frozen=True, kw_only=True, eq=False)
class VaryingModel:
    """Torque of a joint whose parameters change, for the recorded movement.

    Its parameters are the inertia, the weights of the splines of each quantity, and those of the reflex path that do
    not change: delay, frequency, damping ratio and, of a half-wave, threshold.

    Attributes:
      structure: of the joint.
      signals: of the trials.
      variable: what parameters depend on, (trial, time).
      orders: quantity to its number of splines: "stiffness", "damping", "gain" with a reflex, "static" or not.
      low: `variable` at the first knot.
      high: at the last one.
    """

    structure: JointStructure
    signals: JointSignals
    variable: Array
    orders: Mapping[str, int]
    low: float
    high: float

    @cached_property
    def _path(self) -> ReflexPath:
        return ReflexPath(self.variable.shape[1], self.signals.rate)

    @property
    def dynamics(self) -> tuple[str, ...]:
        """Names of the parameters that enter nonlinearly; they are the last ones."""
        return tuple(name for name in self.structure.parameters if name in (*DYNAMICS, THRESHOLD))

    @property
    def n_linear(self) -> int:
        """Parameters that enter linearly."""
        return 1 + sum(self.orders.values())

    def with_orders(self, orders: Mapping[str, int]) -> "VaryingModel":
        """The same with other numbers of splines."""
        return replace(self, orders=orders)

    def part(self, quantity: str) -> slice:
        """Weights of a quantity's splines among the parameters."""
        names = list(self.orders)
        first = 1 + sum(self.orders[name] for name in names[: names.index(quantity)])
        return slice(first, first + self.orders[quantity])

    def basis(self, quantity: str, variable: Array) -> Array:
        """Splines of a quantity, (basis, ...)."""
        return splines(variable, self.orders[quantity], self.low, self.high)

    def _course(self, quantity: str, values: Array) -> Array:
        """A quantity in each sample, (trial, time)."""
        return np.tensordot(values[self.part(quantity)], self.basis(quantity, self.variable), 1)

    def _drive(self, dynamics: Mapping[str, float]) -> Array:
        """What the reflex answers to, but for what a threshold below zero lets through at rest, (trial, time)."""
        threshold = dynamics.get(THRESHOLD, 0.0)
        drive = drive_of(self.signals.velocity, self.structure.reflex, threshold, self.structure.side)
        return drive + self.structure.side * min(threshold, 0.0)

    def columns(self, quantity: str, values: Array) -> Iterator[Array]:
        """Torque of each spline of a quantity, (trial, time), one at a time; only the last parameters matter."""
        given = dict(zip(self.dynamics, values[self.n_linear :], strict=True))
        factor: Array | float = 1.0
        if quantity != "static":
            factor = {"stiffness": self.signals.angle, "damping": self.signals.velocity}.get(quantity, 0.0)
        if quantity == "gain":
            factor = self._drive(given)
        for basis in self.basis(quantity, self.variable):
            product = basis * factor
            yield self._path.torque(product, *(given[name] for name in DYNAMICS)) if quantity == "gain" else product

    def torque(self, values: Array) -> Array:
        """Torque without its offset, (trial, time)."""
        torque = values[0] * self.signals.acceleration
        courses = {name: self._course(name, values) for name in self.orders}
        torque = torque + courses["stiffness"] * self.signals.angle + courses["damping"] * self.signals.velocity
        if "gain" in courses:
            given = dict(zip(self.dynamics, values[self.n_linear :], strict=True))
            dynamics = [given[name] for name in DYNAMICS]
            torque += self._path.torque(courses["gain"] * self._drive(given), *dynamics)
        return np.asarray(torque + courses.get("static", 0.0))

    def slopes(self, values: Array) -> list[Array]:
        """Derivatives of the torque by `dynamics`, (trial, time) each."""
        if not self.dynamics:
            return []
        given = dict(zip(self.dynamics, values[self.n_linear :], strict=True))
        dynamics = [given[name] for name in DYNAMICS]
        gain, drive = self._course("gain", values), self._drive(given)
        slopes = self._path.derivatives(gain * drive, *dynamics)[1]
        if THRESHOLD in given:
            at_rest, side = min(given[THRESHOLD], 0.0), self.structure.side
            closing = closing_of(drive - side * at_rest, side) + side * (at_rest < 0.0)
            slopes[THRESHOLD] = self._path.torque(gain * closing, *dynamics)
        return [slopes[name] for name in self.dynamics]
