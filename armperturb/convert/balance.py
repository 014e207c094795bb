"""Whether a recording obeys physics: d - f must move a positive mass, spring and damper (thesis eqs 2.11, A.19).

The environment is linear, isotropic and passive, whoever holds the handle. If other signs or axes balance far better
than the declared ones, the error message names them, see `signs`. What is wrong by less, as a badly calibrated gauge or
a late signal, is named by `imbalance`.
"""

import math
from collections.abc import Sequence

import numpy as np
import xarray as xr

from armperturb.analysis.force_balance import EDGE, Balance
from armperturb.analysis.imbalance import Imbalance, signal_row
from armperturb.analysis.signs import (
    HEAVIEST,
    LIGHTEST,
    UNBALANCED,
    explained,
    in_numbers,
    no_handle,
    signals_before_limit,
    wrong_signs,
)
from armperturb.arrays import Array
from armperturb.environment import Environment

SET_TO = 1.5
"""Largest ratio of the estimated mass to the mass that the manipulator was set to [-]."""

TOO_MUCH = 0.1
"""Unexplained share of the load above which a recording is refused [-]."""

CLEAR = 0.9
"""Share of what is left that a fault of a signal must explain to be named as the reason of a refusal [-]."""

SEEN = 0.01
"""Smallest power of a disturbance, relative to the load, that shows its sign and axes [-]."""

DRIFT = 5e-4
"""Largest change of the skew of force and displacement over a trial [s], unless it is within 3 standard errors."""


def check_balance(
    recording: xr.Dataset, mass: float | None = None, names: Sequence[str] = (), source: str = "recording"
) -> list[str]:
    """Refuse a recording whose force, displacement and perturbation do not belong together.

    Args:
      recording: the trials. Those that reached the workspace limit count only if there are no others, up to the limit.
      mass: that the manipulator was set to [kg]; None if unknown.
      names: of the trials, for the message; by default their numbers, from 1.
      source: where the recording comes from, for the message.

    Returns:
      Notes for the reader, one sentence each.

    Raises:
      ValueError: d - f does not move a positive mass, spring and damper, or one that is no handle's; the message says
        what change of sign, axes or unit would put it right, if any does.
    """
    rate = float(recording.attrs["rate"])
    grams = require_signs(recording, names, source)
    _, d, f, x = signals_before_limit(recording)
    if grams is None:
        return [
            f"{d.shape[1] / rate:.3g} s at {rate:g} Hz are too short, or too slow, to hold the force against the "
            "movement: signs, axes and units are unchecked"
        ]
    gram = grams.sum(axis=0)
    declared = explained(gram)
    balance = Balance(d, f, x, rate)
    try:
        with np.errstate(all="ignore"):  # where nothing moves there is nothing to divide by
            environment = balance.fit()[0]
    except (ValueError, np.linalg.LinAlgError):
        environment = None
    if environment is None or declared.left > TOO_MUCH:
        raise ValueError(
            f"{source}: d - f does not move a mass, spring and damper ({in_numbers(declared)}); expected a positive "
            f"mass and the force that the handle exerts on the hand, {_why(balance.imbalance)}"
        )
    _require_mass(environment, mass, source)
    notes = _skews(balance, d, f, x, rate, source)
    if balance.imbalance is not None:
        notes = [balance.imbalance.text]
    if declared.left > UNBALANCED and not notes:  # which a skew would explain
        notes.append(
            f"d - f moves a mass of {declared.mass:.3g} kg, but {declared.left:.2g} of its power is left unexplained; "
            f"expected less than {UNBALANCED:g} (a force sensor that is noisy or has a dead band, friction of the "
            "manipulator, motors that make another force than commanded, or one trial that differs from others?)"
        )
    # Rows 0 and 1 of the products are d, 2 and 3 are f.
    pushed, load = (float(np.trace(sides @ gram @ sides.T)) for sides in (signal_row(0), signal_row(0) - signal_row(1)))
    if pushed < SEEN * load:
        notes.append("the perturbation is too weak beside other forces: its sign, axes and unit are unchecked")
    return notes


def require_handle(recording: xr.Dataset, source: str = "recording") -> None:
    """Refuse a recording whose d - f moves a mass that is no handle's; one in which it moves none is not looked at.

    Raises:
      ValueError: the mass is too small or too large.
    """
    _, d, f, x = signals_before_limit(recording)
    try:
        with np.errstate(all="ignore"):
            moved = Balance(d, f, x, float(recording.attrs["rate"])).fit()[0]
    except (ValueError, np.linalg.LinAlgError):
        return
    _require_mass(moved, None, source)


def _require_mass(environment: Environment, mass: float | None, source: str) -> None:
    """Refuse a mass that is not near the one that was set, or none that a handle has [kg]."""
    lower, upper = (LIGHTEST, HEAVIEST) if mass is None else (mass / SET_TO, mass * SET_TO)
    if wrong := no_handle(environment, lower, upper):
        raise ValueError(f"{source}: {wrong}")


def require_signs(recording: xr.Dataset, names: Sequence[str] = (), source: str = "recording") -> Array | None:
    """Refuse a recording that other signs, axes or scales would explain far better.

    Args:
      recording: the trials.
      names: of the trials, for the message; by default their numbers, from 1.
      source: where the recording comes from, for the message.

    Returns:
      Inner products of the signals of each trial, see `wrong_signs`; None if the recording is too short or its sampling
      rate too low for a comparison.

    Raises:
      ValueError: there is such a change; the message names it.
    """
    wrong, grams = wrong_signs(recording, names)
    if wrong:
        raise ValueError(f"{source}: {wrong}")
    return grams


def _why(imbalance: Imbalance | None) -> str:
    """What is wrong with a recording that is refused."""
    if imbalance is not None and imbalance.share > CLEAR:
        return f"but {imbalance.text}"
    return (
        "and no change of signs, axes or scale of the force puts it right (a sensor that failed, dropped samples, two "
        "recordings in one?)"
    )


def _skews(balance: Balance, d: Array, f: Array, x: Array, rate: float, source: str) -> list[str]:
    """Refuse clocks of force and displacement that drift apart; a note if they differ."""
    half = d.shape[1] // 2
    halves = (slice(half), slice(half, 2 * half)) if half >= 10 * round(EDGE * rate) else ()
    skews = []
    for each in (balance, *(Balance(d[:, part], f[:, part], x[:, part], rate) for part in halves)):
        try:
            with np.errstate(all="ignore"):  # without information there is no standard error
                skews.append(each.skew(*each.fit()))
        except (ValueError, np.linalg.LinAlgError):  # nothing moves in this part
            return []
        if np.isnan(skews[-1].standard_error):
            return []
    whole, *parts = skews
    change = parts[1].time - parts[0].time if parts else 0.0
    error = math.hypot(*(part.standard_error for part in parts))
    if abs(change) > max(DRIFT, 3.0 * error):
        raise ValueError(
            f"{source}: force drifts against displacement by {1e3 * change:.2f} ms from the first to the second half "
            f"of {d.shape[1] / rate:.4g} s (standard error {1e3 * error:.2f} ms); expected clocks that run alike"
        )
    if abs(whole.time) > max(2e-4, 3.0 * whole.standard_error):
        return [
            f"force is recorded {1e3 * whole.time:.2f} ms later than displacement (standard error "
            f"{1e3 * whole.standard_error:.2f} ms)"
        ]
    return []
