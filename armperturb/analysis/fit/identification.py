"""What an identification yields, of one condition and of several beside each other."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.defaults import Estimator
from armperturb.analysis.fit.arm_fit import ArmFit
from armperturb.analysis.fit.maximum_likelihood import Estimate
from armperturb.analysis.fit.structures import unit
from armperturb.analysis.measures.endpoint import EndpointImpedance
from armperturb.analysis.response.spectra import SpectralEstimate
from armperturb.analysis.results import Description, Result, Table, parameter_table, plain
from armperturb.arrays import Array
from armperturb.environment import Environment

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

ESTIMATOR_NAMES: Mapping[Estimator, str] = {
    "thesis": "the thesis's estimator, trial by trial",
    "frequency": "maximum likelihood of mean periods",
    "record": "maximum likelihood of whole records",
}
"""What each estimator is called where people read it."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Identification(Result):
    """What one condition of a recording yields.

    Attributes:
      n_trials: how many trials it comes from.
      spectra: estimated admittances and coherence.
      environment: mass, spring and damper that the manipulator really showed.
      fit: the arm model.
      vaf: variance of the displacement that the fitted model accounts for, x and y, mean over trials [%], (axis,).
    """

    n_trials: int
    spectra: SpectralEstimate
    environment: Environment
    fit: ArmFit
    vaf: Array

    def describe(self) -> Description:
        """Who and what was identified, how well the arm predicts, and its parameters."""
        fit, held = self.fit, self.environment
        trials = f"{self.n_trials} trial{'' if self.n_trials == 1 else 's'}"
        return Description(
            title=f"Arm of {fit.arm.name} in {fit.condition} ({fit.arm.task}), {trials}: model {fit.structure}, "
            f"{ESTIMATOR_NAMES[fit.estimator]}",
            facts=(
                f"VAF x {self.vaf[0]:.1f} %, y {self.vaf[1]:.1f} %; {fit.message}",
                f"environment {held.m_env:.4g} kg, {held.b_env:.3g} Ns/m, {held.k_env:.4g} N/m",
            ),
            table=parameter_table(self.to_frame()),
            remarks=fit.remarks,
            details=(
                f"criterion (eq. 2.19) {plain(fit.criterion)}; largest pole of arm and environment "
                f"{plain(fit.largest_real_pole, 3)} 1/s; least coherence {self.spectra.coherence.min():.3f}",
            ),
        )

    def endpoint(
        self, *, posture_deg: tuple[float, float] | None = None, force: ArrayLike | None = None
    ) -> EndpointImpedance:
        """Stiffness, damping and inertia at the hand, see `ArmFit.endpoint`."""
        return self.fit.endpoint(posture_deg=posture_deg, force=force)

    def to_frame(self) -> "pd.DataFrame":
        """One row per free parameter, with the columns of `results.PARAMETER_COLUMNS`."""
        return self.fit.to_frame()

    def to_xarray(self) -> xr.Dataset:
        """The spectral estimate (see `SpectralEstimate.to_xarray`), and `model`: the fitted arm's admittance."""
        model = arm_admittance(self.fit.arm, self.spectra.frequency)
        made = ("frequency", "output", "input"), model, {"units": "m/N", "long_name": "admittance of the model"}
        return self.spectra.to_xarray().assign(model=made).assign_attrs(**self.fit.labels, condition=self.fit.condition)

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the estimated admittance and that of the fitted arm with its 95 % bands.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (output, input, 2): gain and phase of each element.
        """
        return Identifications({self.fit.condition: self}).plot(figure)


class Identifications(Result, Mapping[str, Identification]):
    """Condition to what it yields, in the order of the recording; reads as a dictionary."""

    def __init__(self, by_condition: Mapping[str, Identification]) -> None:
        self._by_condition = dict(by_condition)

    def __getitem__(self, condition: str) -> Identification:
        return self._by_condition[condition]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_condition)

    def __len__(self) -> int:
        return len(self._by_condition)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What fits say of themselves, each once, after the conditions that it is said of unless these are all."""
        whose: dict[str, dict[str, None]] = {}
        for condition, result in self.items():
            for remark in result.fit.remarks:
                whose.setdefault(remark, {})[condition] = None
        return tuple(said if len(of) == len(self) else f"{', '.join(of)}: {said}" for said, of in whose.items())

    def describe(self) -> Description:
        """Who was identified, how well each arm predicts, and the estimates of all conditions side by side."""
        first = next(iter(self.values())).fit
        names = dict.fromkeys(name for result in self.values() for name in result.fit.values)
        models = {condition: f"model {result.fit.structure}, " for condition, result in self.items()}
        shared = models[first.condition] if len(set(models.values())) == 1 else ""
        return Description(
            title=f"Arm of {first.arm.name} in {len(self)} condition{'' if len(self) == 1 else 's'}: "
            f"{shared}{ESTIMATOR_NAMES[first.estimator]}",
            facts=tuple(
                f"{condition}: {'' if shared else models[condition]}{result.n_trials} trial"
                f"{'' if result.n_trials == 1 else 's'}, "
                f"VAF x {result.vaf[0]:.1f} %, y {result.vaf[1]:.1f} %; {result.fit.message}"
                for condition, result in self.items()
            ),
            table=Table(
                ("parameter", "unit", *self),
                tuple((name, unit(name), *(_with_error(of.fit, name) for of in self.values())) for name in names),
            ),
            remarks=self.remarks,
            details=("Estimates +/- standard errors; to_frame() has 95 % intervals.",),
        )

    def to_frame(self) -> "pd.DataFrame":
        """One row per condition and free parameter, with the columns of `results.PARAMETER_COLUMNS`.

        A parameter that conditions share has one row, whose condition names them with + between.
        """
        import pandas as pd

        frame = pd.concat([result.to_frame() for result in self.values()], ignore_index=True)
        together = next(iter(self.values())).fit.detail
        if isinstance(together, Estimate) and len(together.arms) > 1:
            places = [together.place_of(name) for name in together.values]
            shared = {parameter: condition for parameter, condition in places if condition not in together.arms}
            frame["condition"] = [
                shared.get(parameter, condition)
                for parameter, condition in zip(frame["parameter"], frame["condition"], strict=True)
            ]
        return frame.drop_duplicates(["parameter", "condition"], ignore_index=True)

    def to_xarray(self) -> xr.Dataset:
        """`Identification.to_xarray` of all conditions, along a dimension of that name."""
        parts = [result.to_xarray() for result in self.values()]
        data = xr.concat(parts, xr.DataArray(list(self), dims="condition", name="condition"), join="outer")
        data.attrs = dict(next(iter(self.values())).fit.labels)
        return data

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the estimated admittance of each condition and that of the fitted arm with its 95 % bands.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (output, input, 2): gain and phase of each element.
        """
        from armperturb.plots.bands import Curve, plot_responses
        from armperturb.plots.style import colours_for

        curves = []
        for (condition, result), colour in zip(self.items(), colours_for(len(self)), strict=True):
            spectra = result.spectra
            dense = np.geomspace(spectra.frequency[0], spectra.frequency[-1], 200)
            points = {"color": colour, "marker": "o", "linestyle": "", "markersize": 3.5}
            model, bands = arm_admittance(result.fit.arm, dense), result.fit.admittance_bands(dense)
            curves += [
                Curve(f"{condition}, estimated", spectra.frequency, spectra.arm, None, points, (dense, model)),
                Curve(f"{condition}, model {result.fit.structure}", dense, model, bands, {"color": colour}),
            ]
        return plot_responses(curves, figure=figure)


def _with_error(fit: ArmFit, name: str) -> str:
    if name not in fit.values:
        return "-"
    error = fit.standard_error[name]
    mark = " (bound)" if name in fit.at_bound else ""
    if not np.isfinite(error):
        return f"{plain(fit.values[name])} +/- inf{mark}"
    return f"{plain(fit.values[name])} +/- {plain(error, 2)}{mark}"
