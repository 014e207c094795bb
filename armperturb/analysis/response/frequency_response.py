"""A frequency response with the uncertainty of each of its elements, whichever method estimated it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from armperturb.analysis.results import Description, Result, Table, plain, response_coordinates, response_frame
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment
from armperturb.recording import LABELS
from armperturb.validation import require_number

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

System = Literal["arm", "environment", "total"]
"""From f to x, from d - f to x, from d to x."""

SYSTEMS: Mapping[str, str] = {
    "arm": "of the arm, from f to x",
    "environment": "of the environment, from d - f to x",
    "total": "of arm and environment, from d to x",
}
"""What each system is called where people read it."""


SAME_FREQUENCY = 1e-6
"""Difference of frequencies that are the same, over their size [-]."""


class Bands(NamedTuple):
    """Limits of gain and phase.

    Attributes:
      gain_low: [m/N], not below zero, (frequency, output, input).
      gain_high: [m/N], likewise.
      phase_low: [rad], (frequency, output, input).
      phase_high: [rad], likewise; a whole turn above `phase_low` where the phase is not known at all.
    """

    gain_low: Array
    gain_high: Array
    phase_low: Array
    phase_high: Array


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FrequencyResponse(Result):
    """An estimated frequency response.

    The error of an element is taken to be circular complex normal: its real and imaginary part are independent and
    have half its variance each. That holds for estimates that are linear in many samples of noise.

    Attributes:
      frequency: [Hz], (frequency,).
      response: [m/N], (frequency, output, input).
      covariance: variance of each element, the mean of |error|^2 [(m/N)^2], (frequency, output, input); None if the
        method gives none.
      what: of which system, e.g. "arm" (from f to x), "environment" (from d - f to x), "total" (from d to x).
      dof: complex degrees of freedom behind `covariance`, (frequency,); None if it is as good as exact.
      environment: mass, damping and stiffness whose force balance made the signals better; None if none did.
      label: of whom, in which condition and by which method, for people to read.
      remarks: what a reader must know before trusting it, a sentence each.
      labels: condition and subject, and of one axis the joint, as the last columns of tables have them.

    Raises:
      ValueError: shapes do not fit together.
    """

    frequency: Array
    response: ComplexArray
    covariance: Array | None
    what: str
    dof: Array | None = None
    environment: Environment | None = None
    label: str = ""
    remarks: tuple[str, ...] = ()
    labels: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n, shape = len(self.frequency), self.response.shape
        if len(shape) != 3 or shape[0] != n:
            raise ValueError(f"FrequencyResponse: response of shape {shape}; expected ({n}, output, input)")
        for name, values, expected in (("covariance", self.covariance, shape), ("dof", self.dof, (n,))):
            if values is not None and values.shape != expected:
                raise ValueError(f"FrequencyResponse: {name} of shape {values.shape}; expected {expected}")

    def at(self, frequency: ArrayLike | None) -> Self:
        """The estimates at some of the frequencies [Hz], (frequency,); all for None.

        Raises:
          ValueError: there is no estimate at one of them.
        """
        if frequency is None:
            return self
        wanted = require_frequencies(frequency, np.inf)
        nearest = np.abs(self.frequency - wanted[:, None]).argmin(axis=1)
        off = np.abs(self.frequency[nearest] - wanted) > SAME_FREQUENCY * wanted
        if off.any():
            raise ValueError(
                f"frequency = {wanted[off][0]:g} Hz; expected one of the averaged lines, of which "
                f"{self.frequency[nearest[off][0]]:.6g} Hz is nearest (or another method)"
            )
        return replace(
            self,
            frequency=wanted,
            response=self.response[nearest],
            covariance=None if self.covariance is None else self.covariance[nearest],
            dof=None if self.dof is None else self.dof[nearest],
        )

    def radius(self, level: float = 0.95) -> Array:
        """Radius of the circle about each element in which the true one lies [m/N], (frequency, output, input).

        |error|^2 over its estimated variance has an F distribution with 2 and 2 dof degrees of freedom.

        Args:
          level: probability of that, of each element by itself [-].

        Raises:
          ValueError: there is no covariance, or level is no probability.
        """
        require_number("radius", "level", level, above=0.0, below=1.0)
        if self.covariance is None:
            raise ValueError("FrequencyResponse: covariance = None; expected the variance of each element")
        dof = np.full(len(self.frequency), np.inf) if self.dof is None else self.dof
        quantile = np.where(np.isinf(dof), -np.log1p(-level), stats.f.ppf(level, 2, 2 * np.minimum(dof, 1e9)))
        return np.asarray(np.sqrt(quantile[:, None, None] * self.covariance))

    def covers(self, truth: ComplexArray, level: float = 0.95) -> NDArray[np.bool_]:
        """Whether the circle about each element holds the true one, (frequency, output, input).

        Raises:
          ValueError: as `radius`.
        """
        return np.asarray(np.abs(self.response - truth) <= self.radius(level))

    def bands(self, level: float = 0.95) -> Bands:
        """Largest and smallest gain and phase of the circles of `radius`.

        Raises:
          ValueError: as `radius`.
        """
        radius, gain, phase = self.radius(level), np.abs(self.response), np.angle(self.response)
        angle = np.where(radius < gain, np.arcsin(np.minimum(radius / gain, 1.0)), np.pi)
        return Bands(np.maximum(gain - radius, 0.0), gain + radius, phase - angle, phase + angle)

    def describe(self) -> Description:
        """What was estimated, and gain and phase at each frequency."""
        n, known = len(self.frequency), self.covariance is not None
        held = self.environment
        title = f"Frequency response {SYSTEMS.get(self.what, self.what)}"
        span = f"{n} frequencies, {self.frequency[0]:.3g} to {self.frequency[-1]:.3g} Hz"
        facts = [f"{span}; gain in mm/N{' +/- 95 % limit, phase in degrees' if known else ', no uncertainty'}"]
        if held is not None:
            facts.append(f"force balance used: {held.m_env:.4g} kg, {held.b_env:.3g} Ns/m, {held.k_env:.4g} N/m")
        gain, phase = 1e3 * np.abs(self.response), np.degrees(np.angle(self.response))
        limits = 1e3 * self.radius() if known else None
        elements = [(i, j) for i in range(2) for j in range(2)]

        def cell(k: int, i: int, j: int) -> str:
            error = "" if limits is None else f" +/- {plain(limits[k, i, j], 2)}"
            return f"{plain(gain[k, i, j], 3)}{error} {phase[k, i, j]:4.0f}°"

        return Description(
            title=f"{title} ({self.label})" if self.label else title,
            facts=tuple(facts),
            table=Table(
                ("frequency [Hz]", *(f"H_{LABELS['axis'][i]}{LABELS['axis'][j]}" for i, j in elements)),
                tuple((plain(f), *(cell(k, i, j) for i, j in elements)) for k, f in enumerate(self.frequency)),
            ),
            remarks=self.remarks,
        )

    def to_frame(self) -> "pd.DataFrame":
        """One row per frequency, output and input.

        `standard_error` is that of the real and of the imaginary part, each; `radius_95` that of the circle in which
        the element lies with 95 %. Both are missing without covariance. The last columns are `labels`.
        """
        frame = response_frame(self.frequency, self.response)
        if self.covariance is None:
            return frame.assign(standard_error=None, radius_95=None, **self.labels)
        error = np.sqrt(self.covariance / 2).ravel()
        return frame.assign(standard_error=error, radius_95=self.radius().ravel(), **self.labels)

    def to_xarray(self) -> xr.Dataset:
        """Variables `response`, and where they are known `covariance` and `dof`, along frequency, output and input."""
        element = ("frequency", "output", "input")
        name = f"frequency response {SYSTEMS.get(self.what, self.what)}"
        variables: dict[str, Any] = {"response": (element, self.response, {"units": "m/N", "long_name": name})}
        if self.covariance is not None:
            described = {"units": "(m/N)^2", "long_name": "variance of each element"}
            variables["covariance"] = (element, self.covariance, described)
        if self.dof is not None:
            variables["dof"] = ("frequency", self.dof, {"long_name": "complex degrees of freedom of the covariance"})
        attributes = {"what": self.what, **self.labels}
        return xr.Dataset(variables, coords=response_coordinates(self.frequency), attrs=attributes)

    def plot(self, level: float = 0.95, figure: "Figure | None" = None) -> Any:
        """Draw gain and phase of each element, with the bands of `bands` where the covariance is known.

        Args:
          level: probability with which a band holds the true response [-].
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (output, input, 2): gain and phase.

        Raises:
          ValueError: the level is no probability.
        """
        from armperturb.plots.bands import Curve, plot_responses

        bands = None if self.covariance is None else self.bands(level)
        curve = Curve(f"estimate ({self.what})", self.frequency, self.response, bands)
        return plot_responses([curve], f"{level:.0%} of each element", figure)


def require_frequencies(frequency: ArrayLike, rate: float) -> Array:
    """Frequencies as an array, (frequency,).

    Args:
      frequency: [Hz].
      rate: of the samples [Hz].

    Raises:
      ValueError: there are none, they are no row of numbers, or one is not between 0 and half the rate.
    """
    wanted = np.array(frequency, dtype=float)
    if wanted.ndim != 1 or not len(wanted):
        raise ValueError(f"frequency has shape {wanted.shape}; expected (frequency,), at least one")
    wrong = ~((wanted > 0.0) & (wanted < 0.5 * rate))
    if wrong.any():
        raise ValueError(f"frequency = {wanted[wrong][0]:g} Hz; expected above 0 and below {0.5 * rate:g} Hz")
    return wanted
