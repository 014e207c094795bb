"""Whether d - f moves a positive mass, spring and damper of a handle, or would with other signs, axes or scales.

All 64 orientations of the axes of force and displacement relative to those of the perturbation are tried in each trial,
and factors on the force. An error in the orientation of all three signals together has no effect.
"""

import functools
from collections.abc import Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import fft, signal

from armperturb.analysis.cuts import before_limit
from armperturb.analysis.force_balance import EDGE
from armperturb.analysis.imbalance import inner_products, signal_row
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.recording import REQUIRED_SIGNALS

LIGHTEST, HEAVIEST = 0.1, 60.0
"""Smallest and largest mass of a handle [kg]; outside, a unit is wrong."""

UNBALANCED = 0.02
"""Unexplained share of the load above which a note is given [-]."""

FAR_BETTER = 0.5
"""Ratio of unexplained shares below which other signs or axes are far better [-]; by chance it is 0.9."""

RIGHT = 0.05
"""Unexplained share of the load below which other signs, axes or units are named as the right ones [-]."""

RESCALED = 1.2
"""Smallest factor on the force that means another unit and not a badly calibrated gauge [-]."""

SLOWEST = 20.0
"""Lowest sampling rate at which inertia is seen [Hz]."""

BAND = (0.2, 8.0)
"""Frequencies at which signs and axes are compared [Hz]."""

_SIGNED = [np.diag(s) @ np.eye(2)[list(p)] for p in permutations((0, 1)) for s in product((1.0, -1.0), repeat=2)]


class Explained(NamedTuple):
    """What mass, damping and stiffness explain of the load.

    Attributes:
      left: share that they leave [-].
      mass: [kg].
    """

    left: float
    mass: float


def signals_before_limit(recording: xr.Dataset) -> tuple[list[int], Array, Array, Array]:
    """Trials that never reached the workspace limit, or all, up to where the first did; and d, f and x of them.

    Args:
      recording: the trials.

    Returns:
      Numbers of the trials; d and f [N] and x [m], (trial, time, axis) each.
    """
    trials, n_time = before_limit(recording)
    d, f, x = (recording[name].values[trials, :n_time] for name in REQUIRED_SIGNALS)
    return trials, d, f, x


def wrong_signs(recording: xr.Dataset, names: Sequence[str] = ()) -> tuple[str, Array | None]:
    """What other signs, axes or scales would explain a recording far better.

    Args:
      recording: the trials.
      names: of the trials, for the text; by default their numbers, from 1.

    Returns:
      What is wrong and what would put it right, without full stop, empty if there is no such change; and inner products
      of d, f, acceleration, velocity and displacement of each trial, (trial, 10, 10), None if the recording is too
      short or its sampling rate too low for a comparison.
    """
    rate = float(recording.attrs["rate"])
    names = names or [f"trial {trial + 1}" for trial in range(recording.sizes["trial"])]
    trials, d, f, x = signals_before_limit(recording)
    if d.shape[1] < 10 * round(EDGE * rate) or rate < SLOWEST:
        return "", None
    grams = _grams(d, f, x, rate)
    for trial, gram in zip(trials, grams, strict=True):
        declared = explained(gram)
        remedy = _remedy(gram, min(FAR_BETTER * declared.left, RIGHT) if declared.mass > 0.0 else UNBALANCED)
        if remedy is not None:
            where = f" in {names[trial]}" if names[trial] else ""
            text = (
                f"d - f does not move a mass, spring and damper{where} ({in_numbers(declared)}); expected signs, axes "
                "and units with which it does (force must be the reaction force that the handle exerts on the hand), "
                f"as it would if {remedy}"
            )
            return text, grams
    return "", grams


def in_numbers(declared: Explained) -> str:
    """Mass and unexplained share in words."""
    return f"its mass comes out at {declared.mass:.3g} kg, and {declared.left:.2g} of the load is left unexplained"


def no_handle(environment: Environment, lower: float = LIGHTEST, upper: float = HEAVIEST) -> str:
    """What is wrong with a mass outside its limits [kg], without full stop; empty if nothing is."""
    if lower <= environment.m_env <= upper:
        return ""
    return (
        f"d - f moves a mass of {environment.m_env:.4g} kg; expected {lower:.3g} to {upper:.3g} kg (a wrong unit of "
        "displacement, or of both forces?)"
    )


def explained(gram: Array) -> Explained:
    """What mass, damping and stiffness explain of the load, from inner products of `wrong_signs`, (10, 10)."""
    weights, left = _regressions(inner_products(gram, _load_terms(np.eye(2), np.eye(2)))[None])
    return Explained(float(left[0]), float(weights[0, 0]))


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


def _load_terms(of_force: Array, of_displacement: Array) -> Array:
    """The load, and what it may move, with other axes of force and displacement, (term, 2, 10)."""
    return np.stack(
        [signal_row(0) - signal_row(1, of_force), *(signal_row(place, of_displacement) for place in (2, 3, 4))]
    )


def _remedy(gram: Array, least: float) -> str | None:
    """The smallest change of signs, axes or scale of the force that leaves at most so much, in words; None if none."""
    changed, terms = _turned()
    weights, left = _regressions(inner_products(gram, terms))
    tried = list(zip(changed, map(Explained, left.tolist(), weights[:, 0].tolist()), strict=True))
    gain, rescaled = _rescaled(gram)
    if gain > 0.0 and abs(np.log(gain)) > np.log(RESCALED) and rescaled.left < UNBALANCED:
        tried.append((f"force were multiplied by {gain:.4g} (the unit of one of the two forces)", rescaled))
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


def _rescaled(gram: Array) -> tuple[float, Explained]:
    """Factor on the force that explains the perturbation best, and how well it does."""
    inner = inner_products(gram, np.stack([signal_row(place) for place in (0, 2, 3, 4, 1)]))
    (weights,), (left,) = _regressions(inner[None])
    gain = float(weights[-1])
    load = inner[0, 0] - 2.0 * gain * inner[0, 4] + gain**2 * inner[4, 4]
    return gain, Explained(float(left * inner[0, 0] / load) if load > 0.0 else 1.0, float(weights[0]))


def _regressions(inner: Array) -> tuple[Array, Array]:
    """Weights with which the other terms explain the first, and the share of it that they leave.

    Args:
      inner: products of the terms, (..., term, term).

    Returns:
      (..., other term), zero if a term is zero throughout, and (...), then one.
    """
    scale = np.sqrt(np.diagonal(inner, axis1=-2, axis2=-1))
    moves = np.asarray((scale > 0.0).all(axis=-1, keepdims=True))
    scale = np.where(moves, scale, 1.0)
    scaled = inner / (scale[..., :, None] * scale[..., None, :]) * moves[..., None]
    others = np.linalg.pinv(scaled[..., 1:, 1:], rcond=inner.shape[-1] * np.finfo(float).eps, hermitian=True)
    weights = (others @ scaled[..., 1:, :1])[..., 0]
    left = 1.0 - np.sum(weights * scaled[..., 1:, 0], axis=-1)
    return weights * scale[..., :1] / scale[..., 1:], np.maximum(left, 0.0)
