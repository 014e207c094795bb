"""What a nonlinear fit of one person gives: estimates with confidence intervals, and remarks on them."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from armperturb.analysis.fit.whittle import LackOfFit
from armperturb.analysis.nonlinear.model import (
    SIGNED,
    Model,
    Parameters,
    coordinate,
    leveled_condition,
    stem,
    unit,
    value_at,
    value_per_coordinate,
)
from armperturb.analysis.nonlinear.noise import Noise
from armperturb.analysis.nonlinear.search import LEAST_SPREAD
from armperturb.analysis.nonlinear.simulated import State
from armperturb.analysis.results import Description, FitResult, Interval, inseparable, parameter_table, quantile
from armperturb.arrays import Array
from armperturb.subject import Subject
from armperturb.validation import require_one_of

UNCERTAIN = 0.25
"""Standard error of a coordinate from which on a remark is made [-]."""

TOGETHER = 0.8
"""Correlation from which on the ratio or product of two parameters is named, if one of them is poorly determined
[-]."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class NonlinearEstimate(FitResult):
    """Maximum-likelihood estimate of one person's parameters, in the units of `Subject` and `MuscleLaw`.

    Confidence intervals are symmetric in the logarithm of parameters that are positive, and in the parameter itself
    where it may be negative; `standard_error` is that of the parameter itself, by linear approximation.

    Attributes:
      coordinate_error: standard error of the estimates' coordinates [-]; `correlation` is that of these errors.
      model: the structure.
      parameters: what was free in it.
      spread: task and quantity to the SD over trials of the logarithm of a factor on it.
      objective: minus twice the log-likelihood at the best effects of trials, but for a constant.
      lack_of_fit: condition to what is left in its residual that the disturbance explains.
      n_steps: of the search.
      n_conditions: how many conditions were fitted.
      state: where the search ended.
      noises: of each set of trials.
      strengths: factor on the amplitude of draws of each noise, (frequency,) each.
    """

    coordinate_error: Mapping[str, float]
    model: Model
    parameters: Parameters
    spread: Mapping[tuple[str, str], float]
    objective: float
    lack_of_fit: Mapping[str, LackOfFit]
    n_steps: int
    n_conditions: int
    state: State
    noises: tuple[Noise, ...]
    strengths: tuple[Array, ...]

    def interval(self, name: str, level: float = 0.95) -> Interval:
        """Confidence interval of a parameter: symmetric in its logarithm, or in itself if it may be negative.

        Args:
          name: of the parameter, as in `values`.
          level: probability with which such intervals hold the true value [-].

        Raises:
          ValueError: there is no such parameter, or level is no probability.
        """
        require_one_of("interval", "name", name, list(self.values))
        return _interval(name, self.values[name], quantile(level) * self.coordinate_error[name])

    def unit_of(self, name: str) -> str:
        """Unit of a parameter; "-" if it has none."""
        return unit(name)

    def place_of(self, name: str) -> tuple[str, str]:
        """Name of a parameter in tables, and the condition in which it holds; "" if it holds in all of its task."""
        condition = leveled_condition(name)
        return ("level", condition) if condition else (name, "")

    @property
    def labels(self) -> dict[str, str]:
        """The subject."""
        return {"subject": next(iter(self.parameters.bodies.values())).name}

    def subject(self, task: str, condition: str = "") -> Subject:
        """The person in a task and condition, in a trial like the average one."""
        return self.parameters.person(task, self.state.point, condition)

    def describe(self) -> Description:
        """Whose muscles they are, how the search ended, and the parameters."""
        name = self.labels["subject"]
        fits = ", ".join(f"{label} {test.p_value:.2g}" for label, test in self.lack_of_fit.items())
        differing = {kind: sd for kind, sd in self.spread.items() if sd > LEAST_SPREAD}
        spread = ", ".join(f"{quantity} [{task}] {100.0 * sd:.0f} %" for (task, quantity), sd in differing.items())
        return Description(
            title=f"Muscles of {name} in {' and '.join(self.parameters.bodies)}: {self.model.law} law, maximum "
            f"likelihood of raw trials in {self.n_conditions} condition{'' if self.n_conditions == 1 else 's'}",
            facts=(f"{self.message} after {self.n_steps} steps; lack of fit, p: {fits}",),
            table=parameter_table(self.to_frame().assign(parameter=list(self.values))),
            remarks=self.remarks,
            details=(
                f"SD over trials: {spread or 'none that shows'}",
                f"minus twice the log-likelihood, but for a constant: {self.objective:.2f}",
            ),
        )


def _interval(name: str, value: float, half: float) -> Interval:
    """The interval that reaches so far to both sides in the logarithm of a parameter, or in itself, if it has no sign.

    Args:
      name: of the parameter.
      value: its estimate.
      half: of the interval, in the parameter's coordinate.
    """
    if stem(name) in SIGNED:  # the coordinate is a logarithm on either side of zero, which an interval has to cross
        reach = half * value_per_coordinate(name, value)
        return Interval(value - reach, value + reach)
    middle = coordinate(name, value)
    return Interval(value_at(name, middle - half), value_at(name, middle + half))


def remarks_on(
    values: Mapping[str, float], error: Mapping[str, float], correlation: Array, at_bound: Collection[str]
) -> list[str]:
    """What the errors of a fit say about its parameters, a sentence each.

    Args:
      values: parameter to its estimate.
      error: parameter to the standard error of its coordinate.
      correlation: of the errors, (parameter, parameter).
      at_bound: parameters that sit on a bound.
    """
    names, half = list(values), quantile(0.95)
    remarks = [f"{name} sits on a bound" for name in at_bound]
    for name in names:
        if error[name] > UNCERTAIN and name not in at_bound:
            low, high = _interval(name, values[name], half * error[name])
            remarks.append(f"{name} is poorly determined: {values[name]:.3g} ({low:.2g} to {high:.2g})")
    # What is not far from zero has no logarithm, and stands in no ratio.
    without = {*at_bound, *(name for name in names if values[name] <= 10.0 * SIGNED.get(stem(name), 0.0))}
    for i, j in _pairs(correlation, TOGETHER):
        name, other, r = names[i], names[j], float(correlation[i, j])
        a, b = error[name], error[other]
        combined = float(np.sqrt(max(a**2 + b**2 - 2.0 * abs(r) * a * b, 0.0)))
        if max(a, b) > UNCERTAIN >= combined and not {name, other} & without:
            ratio, factor = values[name] * values[other] ** -np.sign(r), float(np.exp(half * combined))
            remarks.append(
                f"{name} {'/' if r > 0.0 else '*'} {other} is well determined: {ratio:.3g} ({ratio / factor:.2g} to "
                f"{ratio * factor:.2g}), standard error of the logarithm {combined:.2f}, of each alone {a:.2f} and "
                f"{b:.2f}"
            )
    return [*remarks, *inseparable(names, correlation)]


def _pairs(correlation: Array, least: float) -> list[tuple[int, int]]:
    """Pairs of parameters whose errors correlate by more."""
    rows, columns = np.nonzero(np.triu(np.abs(correlation) > least, 1))
    return list(zip(rows.tolist(), columns.tolist(), strict=True))
