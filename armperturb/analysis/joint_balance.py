"""Whether a recording of one axis obeys physics: a limb has a positive inertia, of the size that a joint can have.

Torque is regressed on acceleration, velocity and angle over a band of frequencies; inertia dominates its upper end.
Where the movement stays below the joint's natural frequency, stiffness makes most of the torque, and a reflex's phase
may look like inertia of either sign. On a force servo d - f must move the virtual environment besides, as in `balance`.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import fft, signal

from armperturb.analysis.cuts import before_limit
from armperturb.analysis.force_balance import EDGE
from armperturb.analysis.plateaus import clipped_stretches
from armperturb.arrays import Array

DEGREES = 180.0 / np.pi
"""In a radian; factor by which an inertia is too small where an angle in degrees is declared in radians [-]."""

LARGEST_ANGLE = 2 * np.pi
"""Of any joint [rad]."""

INERTIAS: Mapping[str, tuple[float, float]] = {
    "ankle": (0.002, 0.4),
    "wrist": (0.0005, 0.1),
    "elbow": (0.01, 2.0),
    "knee": (0.03, 6.0),
    "any": (0.0002, 10.0),
    "mass": (0.05, 100.0),
}
"""Joint to the least and greatest inertia of limb and device [kg m^2]; masses of a single direction [kg]."""

BAND = (1.0, 30.0)
"""Frequencies of the regression [Hz]."""

SEGMENT = 2.0
"""Length of the stretches whose differences give standard errors [s]."""

SURE = 6.0
"""Inertia over its standard error from which on its sign and size are judged [-]."""

APART = 0.01
"""One less the squared correlation of acceleration and displacement below which inertia and stiffness are one quantity.
It is nothing of a sine, 0.002 of one with noise of 1 % of its size, and 0.04 of tones at 4 and 5 Hz [-]."""

TOO_MUCH = 0.5
"""Share of d - f that a virtual environment may leave unexplained [-]."""


class Regression(NamedTuple):
    """Inertia, damping and stiffness with which a load moves.

    Attributes:
      inertia: [kg m^2], or mass [kg].
      standard_error: of the inertia.
      stiffness: [Nm/rad], or [N/m].
      inertial: RMS of what inertia makes of the load, over that of what stiffness does [-].
      left: unexplained share of the load [-].
      apart: one less the squared correlation of acceleration and displacement [-].
    """

    inertia: float
    standard_error: float
    stiffness: float
    inertial: float
    left: float
    apart: float

    @property
    def is_sine(self) -> bool:
        """Whether the movement is so nearly a sine that inertia and stiffness are one quantity."""
        return self.apart < APART

    @property
    def shows_inertia(self) -> bool:
        """Whether the inertia can be known, and is larger than its error."""
        return not self.is_sine and abs(self.inertia) >= SURE * self.standard_error

    @property
    def contradicts(self) -> bool:
        """Whether inertia and stiffness have opposite signs and stiffness, which is most of the load, decides."""
        return self.inertia * self.stiffness < 0.0 and self.inertial < 1.0


def limb_inertia(recording: xr.Dataset) -> float | None:
    """Inertia that the force moves [kg m^2], or mass [kg]; None if the movement is too short or slow to show one.

    Inertia and stiffness of opposite signs show none either where stiffness is most of the load.
    """
    x, f = _signals(recording, "displacement", "force")
    limb = _regression(f, x, float(recording.attrs["rate"]))
    return None if limb is None or not limb.shows_inertia or limb.contradicts else limb.inertia


def check_joint(recording: xr.Dataset, mass: float | None = None, source: str = "recording") -> list[str]:
    """Refuse a recording of one axis whose signals do not belong together.

    Args:
      recording: the trials, see `wrong_joint`.
      mass: inertia that a force servo was set to [kg m^2, or kg]; None if unknown.
      source: where the recording comes from, for the message.

    Returns:
      Notes for the reader, one sentence each.

    Raises:
      ValueError: the limb's inertia is negative or not a joint's, or d - f does not move a virtual environment.
    """
    wrong, notes = wrong_joint(recording, mass)
    if wrong:
        raise ValueError(f"{source}: {wrong}")
    return notes


def impossible_joint(recording: xr.Dataset) -> tuple[str, ...]:
    """What of the signals no joint can show, as remarks: signs, units, channels that stand still; mostly nothing."""
    wrong, _ = wrong_joint(recording)
    return (*filter(None, [wrong]), *standing_still(recording))


def standing_still(recording: xr.Dataset) -> list[str]:
    """Signals of trials that are constant or clipped, a sentence each, without full stop.

    Args:
      recording: the trials, see `wrong_joint`.
    """
    trials, n_time = before_limit(recording)
    numbers, has_perturbation = recording["trial"].values[trials], "perturbation" in recording.data_vars
    perturbation = recording["perturbation"].values[trials, :n_time] if has_perturbation else [None] * len(numbers)
    is_driven = not has_perturbation or bool(recording["perturbation"].values.any())
    said = []
    for name in ("force", "displacement"):
        is_imposed = name == "displacement" and recording.attrs["servo"] == "position"  # which may hold its position
        constant, clipped = [], []
        for number, values, d in zip(numbers, recording[name].values[trials], perturbation, strict=True):
            of_trial = values[:n_time, 0]
            if np.ptp(of_trial) == 0.0:
                constant.append(f"{number} (at {of_trial[0]:.4g})")
                continue
            plateaus = [] if is_imposed else clipped_stretches(of_trial, may_rest=not is_driven)
            plateaus = [(first, end) for first, end in plateaus if d is None or np.ptp(d[first:end]) > 0.0]
            if plateaus:
                clipped.append(f"{number} (at {of_trial[plateaus[0][0]]:.4g}, {len(plateaus)} times)")
        for what, where in (("constant", constant), ("clipped", clipped)):
            if where and (what == "clipped" or is_driven):
                several = "trials" if len(where) > 1 else "trial"
                said.append(f"{name} is {what} in {several} {', '.join(where)}; leave such trials out")
    return said


def wrong_joint(recording: xr.Dataset, mass: float | None = None) -> tuple[str, list[str]]:
    """What is wrong with the signals of one axis.

    Args:
      recording: the trials. Those that reached the workspace limit count only if there are no others, up to the limit.
      mass: inertia that a force servo was set to [kg m^2, or kg]; None if unknown.

    Returns:
      What is wrong and what was expected, without full stop, empty if nothing is; and notes, one sentence each.
    """
    rate, angular = float(recording.attrs["rate"]), recording["displacement"].attrs["units"] == "rad"
    x, f = _signals(recording, "displacement", "force")
    unit = "kg m^2" if angular else "kg"
    limb = _regression(f, x, rate)
    if limb is None:
        short = f"{x.shape[1] / rate:.3g} s at {rate:g} Hz are too short, or too slow, to show an inertia: unchecked"
        return _large_angle(recording), [short]
    if recording.attrs["servo"] == "force":
        (d,) = _signals(recording, "perturbation")
        if wrong := _wrong_environment(d - f, x, rate, mass, unit):
            return wrong, []
    if limb.is_sine:
        sine = "the movement is nearly a sine, which does not show inertia: signs and units are unchecked"
        return _large_angle(recording), [sine]
    if not limb.shows_inertia:
        slow = (
            f"the movement does not show an inertia, which comes out at {limb.inertia:.3g} +/- "
            f"{limb.standard_error:.2g} {unit} (too slow, too noisy, or stretches that disagree): signs and units are "
            "unchecked"
        )
        return _large_angle(recording), [slow]
    if limb.contradicts:
        per = "Nm/rad" if angular else "N/m"
        turned = " (that of a joint is positive: signals.force.exerted_by the other?)" * (limb.stiffness < 0.0)
        return _large_angle(recording), [
            f"the movement is too slow to show the sign of force: inertia comes out at {limb.inertia:.3g} {unit} and "
            f"stiffness at {limb.stiffness:.3g} {per}{turned}, as reflexes can make them below the joint's natural "
            "frequency: signs and units are unchecked"
        ]
    joint = recording.attrs.get("joint", "any")
    lower, upper = INERTIAS.get(joint if angular else "mass", INERTIAS["any"])
    shown = f"the limb's inertia comes out at {limb.inertia:.3g} {unit}"
    of_joint = f" of the {joint}" if joint in INERTIAS and joint != "any" else ""
    expected = f"expected {lower:g} to {upper:g} {unit}{of_joint}"
    if limb.inertia < 0.0:
        return (
            f"{shown}; {expected}, as it would if the sign of force were turned (signals.force.exerted_by of the "
            "sidecar: the other of handle and hand)"
        ), []
    if not lower <= limb.inertia <= upper:
        is_degrees = angular and limb.inertia < lower and lower <= limb.inertia * DEGREES <= upper
        remedy = "an angle in degrees declared rad?" if is_degrees else "a wrong unit of displacement or force?"
        return f"{shown}; {expected} ({remedy} signals.displacement.unit)", []
    return _large_angle(recording), []


def _signals(recording: xr.Dataset, *names: str) -> tuple[Array, ...]:
    """Signals of those trials, and up to where, they are valid, (trial, time) each."""
    trials, n_time = before_limit(recording)
    return tuple(recording[name].values[trials, :n_time, 0] for name in names)


def _large_angle(recording: xr.Dataset) -> str:
    """What is wrong with angles that no joint has; empty if nothing is."""
    largest = float(np.abs(recording["displacement"].values).max())
    if recording["displacement"].attrs["units"] != "rad" or largest <= LARGEST_ANGLE:
        return ""
    return (
        f"displacement is {largest:.4g} rad; expected at most {LARGEST_ANGLE:.4g} (an angle in degrees declared rad? "
        "signals.displacement.unit)"
    )


def _wrong_environment(load: Array, x: Array, rate: float, mass: float | None, unit: str) -> str:
    """What is wrong with a force servo whose d - f does not move a positive inertia; empty if it does."""
    moved = _regression(load, x, rate)
    if moved is None:
        return ""
    what = f"its inertia comes out at {moved.inertia:.3g} {unit}, and {moved.left:.2g} of the load is left unexplained"
    if moved.left > TOO_MUCH or (moved.inertia <= 0.0 and not moved.is_sine):
        return (
            f"d - f does not move an inertia, damper and spring ({what}); expected the perturbation of a virtual "
            "environment (servo = position for an imposed movement; signals.force.exerted_by the other?)"
        )
    if mass is not None and not moved.is_sine and not mass / 1.5 <= moved.inertia <= 1.5 * mass:
        return (
            f"d - f moves an inertia of {moved.inertia:.4g} {unit}; expected {mass:.4g} {unit} as environment.m_env of "
            "the sidecar says (a wrong unit of displacement, or of both forces?)"
        )
    return ""


def _regression(load: Array, x: Array, rate: float) -> Regression | None:
    """Least squares of a load on acceleration, velocity and displacement, (trial, time) each; None if too short."""
    n_edge, n_segment = round(EDGE * rate), round(SEGMENT * rate)
    n_inner = x.shape[1] - 2 * n_edge
    top = min(BAND[1], 0.25 * rate)
    if n_inner < n_segment // 2 or top < 4.0 * BAND[0]:
        return None
    n_segment = min(n_segment, n_inner)
    s = 2j * np.pi * fft.rfftfreq(fft.next_fast_len(x.shape[1] + 4 * n_edge, real=True), 1.0 / rate)
    smooth = 0.5 - 0.5 * np.cos(np.pi * np.clip((1.4 * top - np.abs(s) / (2 * np.pi)) / (0.3 * top), 0.0, 1.0))
    frequency = fft.rfftfreq(n_segment, 1.0 / rate)
    used = (frequency >= BAND[0]) & (frequency <= top)
    taper = signal.windows.hann(n_segment, sym=False)
    columns = []
    for values, powers in ((load, (0,)), (x, (2, 1, 0))):
        line = values - values.mean(axis=1, keepdims=True)
        spectrum = fft.rfft(line, 2 * (len(s) - 1), axis=1) * smooth
        for power in powers:
            inner = fft.irfft(spectrum * s**power, 2 * (len(s) - 1), axis=1)[:, n_edge : n_edge + n_inner]
            pieces = inner[:, : n_inner // n_segment * n_segment].reshape(-1, n_segment)
            columns.append(fft.rfft(pieces * taper, axis=1)[:, used])
    stacked = np.stack(columns)
    grams = np.einsum("apf,bpf->pab", stacked.conj(), stacked).real
    gram = grams.sum(axis=0)
    if not (np.diag(gram) > 0.0).all():
        return None
    inverse = np.linalg.pinv(gram[1:, 1:], hermitian=True)
    weights = inverse @ gram[1:, 0]
    scores = grams[:, 1:, 0] - grams[:, 1:, 1:] @ weights
    covariance = inverse @ (scores.T @ scores) @ inverse
    left = float((gram[0, 0] - weights @ gram[1:, 0]) / gram[0, 0])
    inertial, _, elastic = np.abs(weights) * np.sqrt(np.diag(gram)[1:])
    ratio = float(inertial / max(elastic, np.finfo(float).tiny))
    apart = float(1.0 - gram[1, 3] ** 2 / (gram[1, 1] * gram[3, 3]))
    return Regression(float(weights[0]), float(np.sqrt(covariance[0, 0])), float(weights[2]), ratio, left, apart)
