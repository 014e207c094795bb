"""Whether a recording obeys physics: d - f must move a positive mass, spring and damper (thesis eqs 2.11, A.19).

The environment is linear, isotropic and passive, whoever holds the handle. All 64 orientations of the axes of force and
displacement relative to those of the perturbation are tried in each trial. If one of them balances far better than the
declared one, the error message names it. An error in the orientation of all three signals together has no effect.
What is wrong by less, as a badly calibrated gauge or a late signal, is named by `imbalance`.
"""

import functools
import math
from collections.abc import Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import fft, signal

from armperturb.analysis.force_balance import EDGE, Balance
from armperturb.analysis.imbalance import Imbalance, inner_products, signal_row
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.recording import REQUIRED_SIGNALS

LIGHTEST, HEAVIEST = 0.1, 60.0
"""Smallest and largest mass of a handle [kg]; outside, a unit is wrong."""

SET_TO = 1.5
"""Largest ratio of the estimated mass to the mass that the manipulator was set to [-]."""

UNBALANCED = 0.02
"""Unexplained share of the load above which a note is given [-]."""

TOO_MUCH = 0.1
"""Unexplained share of the load above which a recording is refused [-]."""

FAR_BETTER = 0.5
"""Ratio of unexplained shares below which other signs or axes are far better [-]; by chance it is 0.9."""

CLEAR = 0.9
"""Share of what is left that a fault of a signal must explain to be named as the reason of a refusal [-]."""

RIGHT = 0.05
"""Unexplained share of the load below which other signs, axes or units are named as the right ones [-]."""

SEEN = 0.01
"""Smallest power of a disturbance, relative to the load, that shows its sign and axes [-]."""

RESCALED = 1.2
"""Smallest factor on the force that means another unit and not a badly calibrated gauge [-]."""

SLOWEST = 20.0
"""Lowest sampling rate at which inertia is seen [Hz]."""

BAND = (0.2, 8.0)
"""Frequencies at which signs and axes are compared [Hz]."""

DRIFT = 5e-4
"""Largest change of the skew of force and displacement over a trial [s], unless it is within 3 standard errors."""

_SIGNED = [np.diag(s) @ np.eye(2)[list(p)] for p in permutations((0, 1)) for s in product((1.0, -1.0), repeat=2)]


class _Explained(NamedTuple):
    left: float
    mass: float


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
    trials, n_time = _before_limit(recording, rate)
    d, f, x = (recording[name].values[trials, :n_time] for name in REQUIRED_SIGNALS)
    if grams is None:
        return [
            f"{n_time / rate:.3g} s at {rate:g} Hz are too short, or too slow, to hold the force against the movement: "
            "signs, axes and units are unchecked"
        ]
    gram = grams.sum(axis=0)
    declared = _explained(gram, np.eye(2), np.eye(2))
    balance = Balance(d, f, x, rate)
    try:
        with np.errstate(all="ignore"):  # where nothing moves there is nothing to divide by
            environment = balance.fit()[0]
    except (ValueError, np.linalg.LinAlgError):
        environment = None
    if environment is None or declared.left > TOO_MUCH:
        raise ValueError(
            f"{source}: d - f does not move a mass, spring and damper ({_in_numbers(declared)}); expected a positive "
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
    rate = float(recording.attrs["rate"])
    trials, n_time = _before_limit(recording, rate)
    d, f, x = (recording[name].values[trials, :n_time] for name in REQUIRED_SIGNALS)
    try:
        with np.errstate(all="ignore"):
            moved = Balance(d, f, x, rate).fit()[0]
    except (ValueError, np.linalg.LinAlgError):
        return
    _require_mass(moved, None, source)


def _require_mass(environment: Environment, mass: float | None, source: str) -> None:
    """Refuse a mass that is not near the one that was set, or none that a handle has [kg]."""
    lower, upper = (LIGHTEST, HEAVIEST) if mass is None else (mass / SET_TO, mass * SET_TO)
    if not lower <= environment.m_env <= upper:
        raise ValueError(
            f"{source}: d - f moves a mass of {environment.m_env:.4g} kg; expected {lower:.3g} to {upper:.3g} kg (a "
            "wrong unit of displacement, or of both forces?)"
        )


def require_signs(recording: xr.Dataset, names: Sequence[str] = (), source: str = "recording") -> Array | None:
    """Refuse a recording that other signs, axes or scales would explain far better.

    Args:
      recording: the trials.
      names: of the trials, for the message; by default their numbers, from 1.
      source: where the recording comes from, for the message.

    Returns:
      Inner products of the signals of each trial, see `_grams`; None if the recording is too short or its sampling rate
      too low for a comparison.

    Raises:
      ValueError: there is such a change; the message names it.
    """
    rate = float(recording.attrs["rate"])
    names = names or [f"trial {trial + 1}" for trial in range(recording.sizes["trial"])]
    trials, n_time = _before_limit(recording, rate)
    if n_time < 10 * round(EDGE * rate) or rate < SLOWEST:
        return None
    d, f, x = (recording[name].values[trials, :n_time] for name in REQUIRED_SIGNALS)
    grams = _grams(d, f, x, rate)
    for trial, gram in zip(trials, grams, strict=True):
        declared = _explained(gram, np.eye(2), np.eye(2))
        remedy = _remedy(gram, min(FAR_BETTER * declared.left, RIGHT) if declared.mass > 0.0 else UNBALANCED)
        if remedy is not None:
            where = f" in {names[trial]}" if names[trial] else ""
            raise ValueError(
                f"{source}: d - f does not move a mass, spring and damper{where} ({_in_numbers(declared)}); expected "
                "signs, axes and units with which it does (force must be the reaction force that the handle exerts on "
                f"the hand), as it would if {remedy}"
            )
    return grams


def _before_limit(recording: xr.Dataset, rate: float) -> tuple[list[int], int]:
    """Trials that never reached the limit, and all samples; or all trials, and the samples before any reached it."""
    limit, n_time = recording["limit_time"].values, recording.sizes["time"]
    free = np.flatnonzero(np.isnan(limit)).tolist()
    if free:
        return free, n_time
    return list(range(len(limit))), min(n_time, int(np.min(limit) * rate))


def _in_numbers(explained: _Explained) -> str:
    return f"its mass comes out at {explained.mass:.3g} kg, and {explained.left:.2g} of the load is left unexplained"


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


def _grams(d: Array, f: Array, x: Array, rate: float) -> Array:
    """Inner products of d, f, acceleration, velocity and displacement, axis by axis, over a band, (trial, 10, 10)."""
    n_samples, n_edge = d.shape[1], round(EDGE * rate)
    n_padded = fft.next_fast_len(n_samples + 4 * n_edge, real=True)
    s = 2j * np.pi * fft.rfftfreq(n_padded, 1.0 / rate)
    top = min(BAND[1], 0.25 * rate)
    smooth = 0.5 - 0.5 * np.cos(np.pi * np.clip((1.4 * top - np.abs(s) / (2 * np.pi)) / (0.3 * top), 0.0, 1.0))
    # Flat almost to the end, so that a pulse there counts.
    n_inner = n_samples - 2 * n_edge
    taper = signal.windows.tukey(n_inner, n_edge / n_inner, sym=False)
    frequency = fft.rfftfreq(n_inner, 1.0 / rate)
    used = (frequency > BAND[0]) & (frequency < top)
    columns = []
    for values, powers in ((d, (0,)), (f, (0,)), (x, (2, 1, 0))):
        spectrum = fft.rfft(values, n_padded, axis=1) * smooth[:, None]
        for power in powers:
            inner = fft.irfft(spectrum * (s**power)[:, None], n_padded, axis=1)[:, n_edge : n_edge + n_inner]
            # The taper would spread the offset, or drift, of a sensor over the band.
            part = fft.rfft(signal.detrend(inner, axis=1) * taper[:, None], axis=1)[:, used]
            columns += [part[..., axis] for axis in range(2)]
    stacked = np.stack(columns, axis=1)
    return np.asarray((stacked @ stacked.conj().swapaxes(1, 2)).real)


def _explained(gram: Array, of_force: Array, of_displacement: Array) -> _Explained:
    """Share of the load that mass, damping and stiffness leave, with other axes of force and displacement."""
    return _by_load(inner_products(gram, _load_terms(of_force, of_displacement)))


def _load_terms(of_force: Array, of_displacement: Array) -> Array:
    """The load, and what it may move, with other axes of force and displacement, (term, 2, 10)."""
    return np.stack(
        [signal_row(0) - signal_row(1, of_force), *(signal_row(place, of_displacement) for place in (2, 3, 4))]
    )


def _by_load(inner: Array) -> _Explained:
    weights, left = _regression(inner)
    return _Explained(left, float(weights[0]))


def _remedy(gram: Array, least: float) -> str | None:
    """The smallest change of signs, axes or scale of the force that leaves at most so much, in words; None if none."""
    changed, terms = _turned()
    tried = [(change, _by_load(inner)) for change, inner in zip(changed, inner_products(gram, terms), strict=True)]
    gain, explained = _rescaled(gram)
    if gain > 0.0 and abs(np.log(gain)) > np.log(RESCALED) and explained.left < UNBALANCED:
        tried.append((f"force were multiplied by {gain:.4g} (the unit of one of the two forces)", explained))
    changes = [(change, left) for change, (left, mass) in tried if change and mass > 0.0 and left < least]
    best = min((left for _, left in changes), default=0.0)
    good = [entry for entry in changes if entry[1] <= 2.0 * best + 1e-3]
    return min(good, key=lambda entry: (entry[0].count(" and "), entry[1]))[0] if good else None


@functools.cache
def _turned() -> tuple[list[str | None], Array]:
    """All changes of signs and axes in words, and their `_load_terms`, (change, term, 2, 10)."""
    both = list(product(_SIGNED, repeat=2))
    return [_in_words(*turned) for turned in both], np.stack([_load_terms(*turned) for turned in both])


def _in_words(of_force: Array, of_displacement: Array) -> str | None:
    """What a change of both comes to; None for no change."""
    if np.array_equal(of_force, of_displacement):
        return _change("perturbation", of_force.T)
    changes = [_change("force", of_force), _change("displacement", of_displacement)]
    return " and ".join(change for change in changes if change)


def _change(name: str, matrix: Array) -> str | None:
    if np.array_equal(matrix, np.eye(2)):
        return None
    if np.array_equal(matrix, -np.eye(2)):
        by = " (signals.force.exerted_by of the sidecar: the other of handle and hand)" if name == "force" else ""
        return f"the sign of {name} were turned{by}"
    turned = [axis for axis, row in zip("xy", matrix, strict=True) if row.sum() < 0.0]
    if matrix[0, 0] == 0.0:
        return f"x and y of {name} were swapped" + (f", {' plus '.join(turned)} with its sign turned" if turned else "")
    return f"the sign of {turned[0]} of {name} were turned"


def _rescaled(gram: Array) -> tuple[float, _Explained]:
    """Factor on the force that explains the perturbation best, and how well it does."""
    inner = inner_products(gram, np.stack([signal_row(place) for place in (0, 2, 3, 4, 1)]))
    weights, left = _regression(inner)
    gain = float(weights[-1])
    load = inner[0, 0] - 2.0 * gain * inner[0, 4] + gain**2 * inner[4, 4]
    return gain, _Explained(left * float(inner[0, 0] / load) if load > 0.0 else 1.0, float(weights[0]))


def _regression(inner: Array) -> tuple[Array, float]:
    """Weights with which the other terms explain the first, and the share of it that they leave."""
    scale = np.sqrt(np.diag(inner))
    if not (scale > 0.0).all():
        return np.zeros(len(inner) - 1), 1.0
    scaled = inner / np.outer(scale, scale)
    weights = np.linalg.lstsq(scaled[1:, 1:], scaled[1:, 0], rcond=None)[0]
    return np.asarray(weights * scale[0] / scale[1:]), max(1.0 - float(weights @ scaled[1:, 0]), 0.0)
