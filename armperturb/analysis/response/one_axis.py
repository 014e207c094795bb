"""The response of one axis without a model: admittance on a force servo, impedance on a position servo.

Which of the two is causal follows from the servo. A force servo pushes device and limb by d, and all is referred to d
as with two axes, so that feedback does no harm: H = T_x / T_f. A position servo imposes the movement, the torque is
what the limb answers, and Z = T_f is that from the movement to it.

A limb that answers to stretch in one direction more than in the other adds to its linear response what follows the
speed, whatever the direction. So the local polynomial fit is made twice, with and without the modulus of the velocity
as a second input: what the second explains beyond the first is distortion. On a force servo the velocity is that which
the linear response to d has, which no noise reaches. Other distortion than this counts as noise, and lowers the
coherence like noise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy import stats

from armperturb.analysis.cuts import inside_limit
from armperturb.analysis.joint_balance import impossible_joint
from armperturb.analysis.manipulator import copies_left_out
from armperturb.analysis.numerics.periodicity import find_period, samples_of_period
from armperturb.analysis.response.closed_loop import (
    HALF_WIDTH,
    HIGH_ORDERS,
    LEAKAGE_ORDER,
    LEAST_DOF,
    N_POINTS,
    excited_band,
    fit_determined,
    fit_near,
    lines_around,
)
from armperturb.analysis.response.frequency_response import FrequencyResponse, System, require_frequencies
from armperturb.analysis.response.joint_records import (
    EXCITED_DENSITY,
    HIGHEST,
    admittance_of,
    error_of,
    resampled,
    variance_of,
)
from armperturb.analysis.response.local_polynomial import (
    DependentDisturbancesError,
    LocalFit,
    Window,
    fit_locally,
    n_unknowns,
    whole_window,
    with_differences,
)
from armperturb.analysis.results import Description, Table, plain
from armperturb.analysis.trials import SeveralTrials, TrialRecord, prepared_recordings
from armperturb.arrays import Array, ComplexArray
from armperturb.recording import labels_of, named
from armperturb.validation import require_number

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

ORDER = 2
"""Of the polynomials whose residuals are compared with and without the modulus of the velocity."""

SAME_LINE, CLEAR = 1e-6, 0.9
"""Relative distance of what is one line, and half the width of a window over the distance to the next line [-]."""

OF_SYSTEM: dict[str, str] = {"arm": "", "environment": "the manipulator", "total": "limb and manipulator"}
"""Whose response it is, before the name of the person."""

LEVEL = 0.95
"""Probability with which the distortion of a linear limb stays below `distortion_limit` [-]."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class AxisResponse(FrequencyResponse):
    """Response of one axis; `response` and `covariance` have the shape (frequency, 1, 1) and the unit `units`.

    Attributes:
      kind: "admittance" or "impedance".
      units: of the response, e.g. "Nm/rad".
      coherence: share of the output's power that the linear response to the servo's input accounts for [-],
        (frequency,); the output is the torque on a position servo, the angle on a force servo.
      distortion: share of the torque's power that follows the modulus of the velocity and no linear response [-]; NaN
        where an input that repeats does not tell, which has both at a single line,
        (frequency,); unbiased, so that it may come out negative.
      distortion_limit: below which it stays with a probability of `LEVEL` if the limb is linear [-], (frequency,).
      p_linear: probability of as much distortion at all frequencies together if the limb is linear [-]; NaN where none
        tells.
    """

    kind: str
    units: str
    coherence: Array
    distortion: Array
    distortion_limit: Array
    p_linear: float

    def describe(self) -> Description:
        """What was estimated, and its values at each frequency."""
        gain, phase = np.abs(self.response).ravel(), np.degrees(np.angle(self.response)).ravel()
        radius = self.radius().ravel()
        rows = tuple(
            (
                plain(self.frequency[k]),
                f"{plain(gain[k], 3)} +/- {plain(radius[k], 2)}",
                f"{phase[k]:.0f}",
                f"{self.coherence[k]:.3f}",
                "-" if math.isnan(self.distortion[k]) else f"{max(self.distortion[k], 0.0):.1%}",
            )
            for k in range(len(self.frequency))
        )
        span = f"{len(rows)} frequencies, {plain(self.frequency[0], 3)} to {plain(self.frequency[-1], 3)} Hz"
        return Description(
            title=" of ".join(part for part in (self.kind.capitalize(), OF_SYSTEM[self.what], self.label) if part),
            facts=(f"{span}; gain with its 95 % limit", self.sentence),
            table=Table(("frequency [Hz]", f"gain [{self.units}]", "phase [deg]", "coherence [-]", "distortion"), rows),
            remarks=self.remarks,
        )

    @property
    def sentence(self) -> str:
        """Whether the limb is linear."""
        if math.isnan(self.p_linear):
            return "distortion: single lines do not tell it from the response"
        most = int(np.nanargmax(self.distortion))
        whose = "torque" if "rad" in self.units else "force"
        share, frequency = max(self.distortion[most], 0.0), self.frequency[most]
        where = f"at most {share:.1%} of the {whose}'s power, at {frequency:.3g} Hz"
        return f"distortion that follows the modulus of the velocity: {where} (p = {self.p_linear:.2g} if linear)"

    def to_frame(self) -> "pd.DataFrame":
        """One row per frequency; `standard_error` and `radius_95` as those of two axes."""
        import pandas as pd

        values = self.response.ravel()
        return pd.DataFrame(
            {
                "frequency_hz": self.frequency,
                "real": values.real,
                "imag": values.imag,
                "gain": np.abs(values),
                "phase_deg": np.degrees(np.angle(values)),
                "standard_error": np.sqrt(np.asarray(self.covariance) / 2).ravel(),
                "radius_95": self.radius().ravel(),
                "coherence": self.coherence,
                "distortion": self.distortion,
                "distortion_limit": self.distortion_limit,
                "unit": self.units,
                **self.labels,
            }
        )

    def to_xarray(self) -> xr.Dataset:
        """Variables `response`, `covariance`, `dof`, `coherence`, `distortion` and its limit along frequency."""
        name = "frequency"
        covariance, dof = np.asarray(self.covariance).ravel(), np.asarray(self.dof)
        variables: dict[str, Any] = {
            "response": (name, self.response.ravel(), {"units": self.units, "long_name": self.kind}),
            "covariance": (name, covariance, {"units": f"({self.units})^2", "long_name": "variance of the response"}),
            "dof": (name, dof, {"long_name": "complex degrees of freedom of the covariance"}),
        }
        for of in ("coherence", "distortion", "distortion_limit"):
            variables[of] = name, getattr(self, of), {"units": "-"}
        coordinates = {name: (name, self.frequency, {"units": "Hz"})}
        attributes = {"what": self.what, "p_linear": self.p_linear, **self.labels}
        return xr.Dataset(variables, coords=coordinates, attrs=attributes)

    def plot(self, level: float = 0.95, figure: "Figure | None" = None) -> Any:
        """Draw gain and phase with their bands, and coherence and distortion below them.

        Args:
          level: probability with which a band holds the true response [-].
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (3,).

        Raises:
          ValueError: the level is no probability.
        """
        from armperturb.plots.one_axis import plot_axis_response

        return plot_axis_response(self, level, figure)


def one_axis_response(
    recordings: SeveralTrials,
    *,
    what: System = "arm",
    frequency: ArrayLike | None = None,
    window_start: float = 0.0,
    order: int | None = None,
) -> AxisResponse:
    """Admittance or impedance of one axis, from any movement with power where it is wanted.

    Args:
      recordings: trials of one axis, of one person in one condition; their lengths may differ. Those that met the limit
        of the workspace count only if there are no others, up to then.
      what: "arm" is the limb; of a force servo also "environment" (x over d - f) or "total" (x over d).
      frequency: where the response is wanted [Hz], (frequency,); None takes up to 40 of those that are excited, and
        of an input that repeats its lines.
      window_start: start of what is used [s].
      order: of the response's polynomial; by default 2, or up to 5 where that fits clearly better; 0 at a line that is
        taken alone.

    Raises:
      ValueError: a recording is not of one axis, what is not there on a position servo, a signal is constant or has
        power at too few frequencies, or records are too short.
    """
    require_number("one_axis_response", "order", order, at_least=0, optional=True)
    several = prepared_recordings(recordings)
    first = several[0].recording
    if any(trials.recording.sizes["axis"] != 1 for trials in several):
        raise ValueError("recording: axes = 2; expected one axis")
    imposed = first.attrs["servo"] == "position"
    if imposed and what != "arm":
        raise ValueError(
            f"response: what = {what!r} on a position servo, which imposes the movement; expected arm, the limb"
        )
    inside, left_out = inside_limit(several)
    records = [resampled(record) for each in inside for record in _records(each, window_start, imposed=imposed)]
    spectra = [whole_window(record) for record in records]
    repeated = _lines(records, imposed=imposed)
    if frequency is not None:
        wanted = require_frequencies(frequency, records[0].rate)
    elif len(repeated):
        wanted = _spread(repeated)
    else:
        wanted = _imposed_band(records) if imposed else excited_band(records)
    orders: tuple[int, ...] = HIGH_ORDERS if order is None else (order,)
    fits, power = [], []
    try:
        for centre in wanted.tolist():
            windows = _alone(spectra, centre, repeated) if order is None else []
            if windows:
                fits.append(fit_locally(windows, centre, order=0, leakage_order=LEAKAGE_ORDER))
            else:
                windows = lines_around(spectra, centre, orders[0])
                is_line = order is None and bool((np.abs(repeated - centre) <= SAME_LINE * centre).any())
                fits.append((fit_determined if is_line else fit_near)(windows, centre, orders))
            lines = np.concatenate([window.perturbation for window in windows])
            power.append(float(np.mean(np.abs(lines) ** 2)))
        distortion, limit, p_linear = _distortion(records, spectra, wanted, fits, imposed=imposed)
    except DependentDisturbancesError as error:
        wanted_are = "its lines, as without frequency" if len(repeated) else "a band of frequencies, as of random steps"
        raise ValueError(
            f"response: the {'movement' if imposed else 'perturbation'} has power at too few frequencies near "
            f"{error.frequency:.3f} Hz; expected {wanted_are} (between single tones no response can be separated from "
            "transients)"
        ) from None
    joint, noise = np.array([fit.answer for fit in fits]), np.array([fit.noise for fit in fits])
    spread, errors = np.array([fit.factor for fit in fits]), [fit.by_trial for fit in fits]
    if imposed:
        values, variance = joint, (noise.real * spread.real).reshape(-1, 1, 1)
    else:
        values, variance = admittance_of(what, joint), variance_of(what, joint, noise, spread)
        errors = [error_of(what, part[None], each) for part, each in zip(joint, errors, strict=True)]
    covariance, dof = with_differences(wanted, variance, np.array([fit.dof for fit in fits]), errors)
    explained = np.array(power) * np.abs(joint[:, -1, 0]) ** 2
    torque, angle = (str(first[name].attrs["units"]) for name in ("force", "displacement"))
    return AxisResponse(
        frequency=wanted,
        response=values,
        covariance=covariance,
        what=what,
        dof=dof,
        label=named(inside),
        labels=labels_of(inside[0]),
        kind="impedance" if imposed else "admittance",
        units=f"{torque}/{angle}" if imposed else f"{angle}/{torque}",
        coherence=explained / (explained + noise[:, -1, -1].real),
        distortion=distortion,
        distortion_limit=limit,
        p_linear=p_linear,
        remarks=(
            *copies_left_out(several),
            *dict.fromkeys(wrong for each in inside for wrong in impossible_joint(each)),
            *left_out,
        ),
    )


def _records(recording: xr.Dataset, window_start: float, *, imposed: bool) -> list[TrialRecord]:
    """Input and output of the servo: movement and torque, or perturbation, torque and movement."""
    require_number("response", "window_start", window_start, at_least=0.0)
    rate = float(recording.attrs["rate"])
    start = round(window_start * rate)
    if recording.sizes["time"] - start < 2:
        raise ValueError(f"response: window_start = {window_start:g} s; expected less than the record")
    f, x = (np.asarray(recording[name].values[:, start:], dtype=float) for name in ("force", "displacement"))
    inputs = x if imposed else np.asarray(recording["perturbation"].values[:, start:], dtype=float)
    for name, signals in (("displacement" if imposed else "perturbation", inputs), ("force", f)):
        if np.ptp(signals, axis=1).min() == 0.0:
            raise ValueError(f"recording: {name} of a trial is constant; expected a perturbed trial (leave it out)")
    outputs = f if imposed else np.concatenate([f, x], axis=2)
    return [TrialRecord(u, z, rate) for u, z in zip(inputs, outputs, strict=True)]


def _alone(spectra: Sequence[Window], centre: float, lines: Array) -> list[Window]:
    """Windows around a line of a repeated input in which no other line has power; none where these are too narrow.

    Nothing has to be known there of how the response bends: it is that of the one line.

    Args:
      spectra: of whole records.
      centre: [Hz].
      lines: all that have power [Hz], (line,).
    """
    apart = np.abs(lines - centre)
    if not len(lines) or apart.min() > SAME_LINE * centre:
        return []
    others = apart[apart > SAME_LINE * centre]
    half = max(HALF_WIDTH[0], HALF_WIDTH[1] * centre)
    if len(others):
        half = min(half, CLEAR * float(others.min()))
    used = [each for each in (window.within(centre - half, centre + half) for window in spectra) if len(each.frequency)]
    rows = sum(len(window.frequency) for window in used)
    is_enough = rows >= n_unknowns(len(used), 0, LEAKAGE_ORDER, n_inputs=1) + LEAST_DOF
    return used if used and is_enough and all(len(each.frequency) > LEAKAGE_ORDER + 1 for each in used) else []


def _lines(records: Sequence[TrialRecord], *, imposed: bool) -> Array:
    """Lines with power of an input that repeats [Hz], (line,); none where it does not.

    Between lines there is no power, but for what leaks from them: a response there would be that to the noise.
    """
    rate = records[0].rate
    longest = max(len(record.perturbation) for record in records)
    inputs = [record.perturbation for record in records if len(record.perturbation) == longest]
    try:
        n_period = samples_of_period(find_period(inputs, rate), rate)
    except ValueError:
        return np.empty(0)
    n_periods = longest // n_period
    means = [each[-n_periods * n_period :].reshape(n_periods, n_period).mean(axis=0) for each in inputs]
    power = np.sum(np.abs(np.fft.rfft(means, axis=1)) ** 2, axis=0)
    frequency = np.fft.rfftfreq(n_period, 1.0 / rate)
    power[(frequency == 0.0) | (frequency > HIGHEST * rate)] = 0.0
    shapes = [power, power * frequency**4] if imposed else [power]
    return np.asarray(frequency[np.any([each > EXCITED_DENSITY * each.max() for each in shapes], axis=0)])


def _spread(frequency: Array) -> Array:
    """At most `N_POINTS` of some frequencies, as even as there are on a logarithmic scale."""
    even = np.geomspace(frequency[0], frequency[-1], N_POINTS)
    return np.asarray(np.unique(frequency[np.abs(frequency - even[:, None]).argmin(axis=1)]))


def _imposed_band(records: Sequence[TrialRecord]) -> Array:
    """Frequencies at which an imposed movement or its acceleration has power [Hz], (frequency,).

    The torque is elastic at low frequencies, where the movement is large, and inertial at high ones, where it is not.
    """
    second = [
        record._replace(perturbation=np.gradient(np.gradient(record.perturbation, axis=0), axis=0))
        for record in records
    ]
    both = np.unique(np.concatenate([excited_band(records), excited_band(second)]))
    return _spread(both)


def _distortion(
    records: Sequence[TrialRecord], spectra: Sequence[Window], wanted: Array, fits: Sequence[LocalFit], *, imposed: bool
) -> tuple[Array, Array, float]:
    """Share of the torque's power that follows the modulus of the velocity, its limit, and the probability of all.

    The probability is that of the frequencies whose lines do not overlap (Fisher's method).
    """
    response = np.array([fit.answer[-1, 0] for fit in fits])
    both = []
    for record, window in zip(records, spectra, strict=True):
        speed = np.abs(_velocity(record, None if imposed else (wanted, response)))
        n = len(record.perturbation)
        lines = np.fft.rfft(speed - speed.mean(), axis=0)[1:] / np.sqrt(n)
        both.append(window._replace(perturbation=np.concatenate([window.perturbation, lines], axis=1)))
    share, limit, p, end = np.empty(len(wanted)), np.empty(len(wanted)), [], 0.0
    for at, centre in enumerate(wanted.tolist()):
        windows = lines_around(both, centre, ORDER)
        alone = [window._replace(perturbation=window.perturbation[:, :1]) for window in windows]

        try:
            linear, full = (
                fit_locally(each, centre, order=ORDER, leakage_order=LEAKAGE_ORDER) for each in (alone, windows)
            )
        except DependentDisturbancesError:
            share[at] = limit[at] = math.nan
            continue
        left, less = (float(fit.noise[0, 0].real) for fit in (linear, full))
        extra = linear.dof - full.dof
        whole = float(np.sum([np.sum(np.abs(window.answer[:, 0]) ** 2) for window in windows]))
        ratio = (left * linear.dof - less * full.dof) / extra / less  # of F distribution if the limb is linear
        share[at] = less * extra * (ratio - 1.0) / whole
        quantile = float(stats.f.ppf(LEVEL, 2 * extra, 2 * full.dof))
        limit[at] = less * extra * (quantile - 1.0) / whole
        low, high = (pick(window.frequency[place] for window in windows) for pick, place in ((min, 0), (max, -1)))
        if low > end:
            p.append(max(float(stats.f.sf(max(ratio, 0.0), 2 * extra, 2 * full.dof)), 1e-300))
            end = high
    return share, limit, float(stats.chi2.sf(-2.0 * np.sum(np.log(p)), 2 * len(p))) if p else math.nan


def _velocity(record: TrialRecord, linear: tuple[Array, ComplexArray] | None) -> Array:
    """Velocity of an imposed movement, or that which a linear response to the perturbation has, (time, 1)."""
    if linear is None:
        return np.asarray(np.gradient(record.perturbation, 1.0 / record.rate, axis=0))
    n = len(record.perturbation)
    f = np.fft.rfftfreq(n, 1.0 / record.rate)
    at, values = linear
    response = np.interp(f, at, values.real, right=0.0) + 1j * np.interp(f, at, values.imag, right=0.0)
    spectrum = np.fft.rfft(record.perturbation - record.perturbation.mean(axis=0), axis=0)
    return np.asarray(np.fft.irfft(2j * np.pi * f[:, None] * response[:, None] * spectrum, n, axis=0))
