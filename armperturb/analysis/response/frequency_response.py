"""A frequency response with the uncertainty of each of its elements, whichever method estimated it."""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment
from armperturb.recording import LABELS
from armperturb.validation import require_number

System = Literal["arm", "environment", "total"]
"""From f to x, from d - f to x, from d to x."""


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


@dataclass(frozen=True, kw_only=True, eq=False)
class FrequencyResponse:
    """An estimated frequency response.

    The error of an element is taken to be circular complex normal: its real and imaginary part are independent and
    have half its variance each. That holds for estimates that are linear in many samples of noise.

    Attributes:
      frequency: [Hz], (frequency,).
      response: [m/N], (frequency, output, input).
      covariance: variance of each element, the mean of |error|^2 [(m/N)^2], (frequency, output, input); None if the
        method does not tell.
      what: of which system, e.g. "arm" (from f to x), "environment" (from d - f to x), "total" (from d to x).
      dof: complex degrees of freedom behind `covariance`, (frequency,); None if it is as good as exact.
      environment: mass, damping and stiffness whose force balance made the signals better; None if none did.

    Raises:
      ValueError: shapes do not fit together.
    """

    frequency: Array
    response: ComplexArray
    covariance: Array | None
    what: str
    dof: Array | None = None
    environment: Environment | None = None

    def __post_init__(self) -> None:
        n = len(self.frequency)
        if self.response.ndim != 3 or len(self.response) != n:
            raise ValueError(
                f"FrequencyResponse: response of shape {self.response.shape}; expected ({n}, output, input)"
            )
        if self.covariance is not None and self.covariance.shape != self.response.shape:
            raise ValueError(
                f"FrequencyResponse: covariance of shape {self.covariance.shape}; expected {self.response.shape}"
            )
        if self.dof is not None and self.dof.shape != (n,):
            raise ValueError(f"FrequencyResponse: dof of shape {self.dof.shape}; expected ({n},)")

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

    def rows(self) -> list[dict[str, Any]]:
        """One row per frequency, output and input, ready for `export.write_csv`.

        `standard_error` is that of the real and of the imaginary part, each; `radius_95` that of the circle in which
        the element lies with 95 %. Both are empty without covariance.
        """
        known = self.covariance is not None
        error = np.sqrt(self.covariance / 2) if self.covariance is not None else np.empty(0)
        radius = self.radius() if known else error
        return [
            {
                "frequency_hz": float(frequency),
                "output": LABELS["axis"][output],
                "input": LABELS["axis"][input_],
                "real": float(value.real),
                "imag": float(value.imag),
                "gain_m_per_N": float(abs(value)),
                "phase_deg": float(np.degrees(np.angle(value))),
                "standard_error": float(error[k, output, input_]) if known else "",
                "radius_95": float(radius[k, output, input_]) if known else "",
            }
            for k, frequency in enumerate(self.frequency)
            for output in range(2)
            for input_ in range(2)
            for value in (self.response[k, output, input_],)
        ]


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


def require_system(what: str) -> None:
    """Refuse what is no `System`.

    Raises:
      ValueError: it is something else.
    """
    if what not in get_args(System):
        raise ValueError(f"what = {what!r}; expected one of {', '.join(get_args(System))}")
