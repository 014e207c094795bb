"""What identification of parameters that change yields."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr

from armperturb.analysis.joint.choice import ScoredStructure, sentence_of
from armperturb.analysis.joint.model import UNITS, JointStructure
from armperturb.analysis.results import Description, Result, Table, quantile
from armperturb.arrays import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KNOWN = 5.0
"""Standard error, over the median of a curve, up to which a point counts for its range in a summary [-]."""


class Curve(NamedTuple):
    """A quantity over what it depends on.

    Attributes:
      value: (point,).
      standard_error: (point,).
      n_basis: how many B-splines make it.
    """

    value: Array
    standard_error: Array
    n_basis: int


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class VaryingEstimate(Result):
    """Parameters of one joint, or of a single direction, over time or posture.

    Attributes:
      label: who, in which condition, how many trials.
      labels: condition, subject and joint, as the last columns of tables have them.
      variable: "time" or "scheduling".
      angular: whether it is a joint, or a single direction.
      grid: where curves are given [s, or rad or m], (point,).
      curves: quantity to its curve: "stiffness", "damping" and, with a reflex, "gain".
      inertia: [kg m^2, or kg].
      inertia_error: its standard error.
      tried: structures that were fitted, the best first.
      dynamics: delay, frequency, damping ratio and threshold of the reflex path, as in `joint.model.UNITS`.
      vaf: torque or force that the model explains in the samples that were fitted [%].
      held_out_vaf: in the rest, simulated from the angle alone [%]; None if everything was fitted.
      n_trials: how many trials.
      n_groups: repetitions or stretches from whose differences the errors come.
      remarks: what a reader must know before trusting the curves, a sentence each.
    """

    label: str
    labels: Mapping[str, str]
    variable: str
    angular: bool
    grid: Array
    curves: Mapping[str, Curve]
    inertia: float
    inertia_error: float
    tried: tuple[ScoredStructure, ...]
    dynamics: Mapping[str, float]
    vaf: float
    held_out_vaf: float | None
    n_trials: int
    n_groups: int
    remarks: tuple[str, ...] = ()

    @property
    def structure(self) -> JointStructure:
        """The reflex path's static nonlinearity, and the direction of stretch that it answers to."""
        return self.tried[0].structure

    def interval(self, name: str, level: float = 0.95) -> tuple[Array, Array]:
        """Lower and upper end of the pointwise confidence band of a curve, (point,) each.

        Errors that come from a few groups are uncertain themselves, so that the band is that of Student's t with one
        degree of freedom less than groups.

        Args:
          name: key of `curves`.
          level: probability that the band holds the truth at a point [-].

        Raises:
          KeyError: there is no such curve.
        """
        curve = self.curves[name]
        half = quantile(level, self.n_groups - 1) * curve.standard_error
        return curve.value - half, curve.value + half

    def unit_of(self, name: str) -> str:
        """Unit of a curve, of the inertia, or of one of `dynamics`; the gain is that of the velocity feedback."""
        return UNITS["reflex_gain" if name == "gain" else name][0 if self.angular else 1]

    @property
    def unit(self) -> str:
        """Unit of the grid."""
        return "s" if self.variable == "time" else "rad" if self.angular else "m"

    def describe(self) -> Description:
        """Constant parameters, and of each curve its median error and its range where it is known."""
        rows = []
        for name, curve in self.curves.items():
            finite = curve.standard_error[np.isfinite(curve.standard_error)]
            error = np.median(finite) if len(finite) else np.inf
            known = curve.value[curve.standard_error <= KNOWN * error]
            rows.append((name, f"{known.min():.4g}", f"{known.max():.4g}", f"{error:.2g}", f"{curve.n_basis}"))
        over = "time" if self.variable == "time" else "the scheduling variable"
        what, driven, moved = (
            ("Joint", "torque", "angle") if self.angular else ("One direction", "force", "displacement")
        )
        facts = [
            sentence_of(self.tried),
            f"inertia {self.inertia:.4g} +/- {self.inertia_error:.2g} {self.unit_of('inertia')}; the model explains "
            f"{self.vaf:.1f} % of the {driven}",
        ]
        if self.dynamics:
            each = ", ".join(
                f"{name} {value:.3g} {self.unit_of(name)}".removesuffix(" -") for name, value in self.dynamics.items()
            )
            facts.append(f"reflex path: {each}")
        if self.held_out_vaf is not None:
            facts.append(f"held out, simulated from the {moved} alone: {self.held_out_vaf:.1f} % of the {driven}")
        return Description(
            title=f"{what} of {self.label}"
            + (f" ({joint})" if (joint := self.labels["joint"]) else "")
            + f", over {over}",
            facts=tuple(facts),
            table=Table(("quantity", "least", "greatest", "standard error", "splines"), tuple(rows)),
            remarks=self.remarks,
        )

    def to_frame(self) -> pd.DataFrame:
        """One row per point and quantity: value, standard error and 95 % band. The last columns are `labels`."""
        frames = []
        for name, curve in self.curves.items():
            lower, upper = self.interval(name)
            columns = {"quantity": name, self.variable: self.grid, "value": curve.value}
            columns |= {"standard_error": curve.standard_error, "lower_95": lower, "upper_95": upper}
            frames.append(pd.DataFrame({**columns, "unit": self.unit_of(name)}))
        return pd.concat(frames, ignore_index=True).assign(**self.labels)

    def to_xarray(self) -> xr.Dataset:
        """Curves and their standard errors along `variable`."""
        variables: dict[str, Any] = {}
        for name, curve in self.curves.items():
            unit = {"units": self.unit_of(name)}
            variables[name] = (self.variable, curve.value, unit)
            variables[f"{name}_error"] = (self.variable, curve.standard_error, unit)
        return xr.Dataset(variables, coords={self.variable: (self.variable, self.grid, {"units": self.unit})})

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw each curve with its 95 % band.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (quantity,).
        """
        from armperturb.plots.courses import Course, plot_courses

        label = f"{'time' if self.variable == 'time' else 'scheduling variable'} ({self.unit})"
        courses = [
            Course(
                f"{name} ({self.unit_of(name)})",
                self.grid,
                np.where(np.isfinite(curve.standard_error), curve.value, np.nan),
                *self.interval(name),
            )
            for name, curve in self.curves.items()
        ]
        return plot_courses(courses, label, figure)
