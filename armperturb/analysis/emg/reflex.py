"""Reflexes in the EMG: the response from joint rotation to amplitude, and averages about pulses.

Of each muscle,

    a(s) = h(s) e^(-s T) (c_v s + c_p) . q(s) + noise,

where q are the rotations of both joints, c_v and c_p gains of velocity and position, T the delay from rotation to EMG,
and h the average over which the envelope is taken. The amplitude of one muscle follows lengthening alone: gains are
those of the linear response nearest to it, half of those to lengthening, and what they leave is noise. EMG noise
moves no arm, so that rotation may be any, and no disturbance is needed to tell. Parameters are maximum
likelihood estimates from the tapered spectra (Whittle 1953, Ark. Mat. 2), in noise of a smooth spectrum; standard
errors are the larger of those of such noise and of those that hold for any (Liang & Zeger 1986, Biometrika 73, by bands
and trials). The p of no response, in such noise, is that of the best of all delays (`searched_p`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import NoneType
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr
from scipy import fft, optimize, stats

from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.emg.matching import rows_of
from armperturb.analysis.emg.pulse_average import pulse_averages
from armperturb.analysis.emg.rotation import rotation
from armperturb.analysis.emg.searched_p import searched_p
from armperturb.analysis.manipulator import copies_left_out
from armperturb.analysis.results import Description, Result, Table, plain
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array, ComplexArray, Indices
from armperturb.recording import Action
from armperturb.subject import Subject
from armperturb.validation import require_type

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BAND = (0.3, 20.0)
"""Frequencies of the fit [Hz]."""

DELAYS = (0.005, 0.15)
"""Least and largest delay that is looked for [s]."""

N_DELAYS = 30
"""Delays from which the best is refined."""

BIN = 1.0
"""Width of the bands in which the response is averaged [Hz]."""

JOINTS = ("shoulder", "elbow")

GAINS = ("velocity_s", "velocity_e", "position_s", "position_e")
"""Columns of the gains of shoulder and elbow."""

WITH_LIMITS = ("delay_s", "delay_error_s", "lower_95_s", "upper_95_s")
"""Columns of a delay."""

FITTED = (*WITH_LIMITS, *GAINS, *(f"{name}_error" for name in GAINS), "coherence", "p")
"""Columns of what is fitted to a muscle."""

UNKNOWN = dict.fromkeys(FITTED, math.nan) | {"coherence": 0.0, "p": 1.0}
"""What is fitted to a muscle that is never above its noise, or whose channel is dead in too many trials."""

CLEAR = 0.001
"""Level at which a muscle counts as responding to rotation [-]."""

OPPOSITE = 3.0
"""Standard errors of the gain of a muscle's shortening from which on it answers to that [-]."""

FEWEST_SECONDS = 4.0
"""Time of a trial from which on it tells of reflexes [s]."""

FEWEST_BANDS = 6
"""Bands from which on the spectrum of the noise is told."""

FEWEST_LINES = 4.0
"""Independent lines, of all trials, from which on a band has a response [-]: four unknowns have eight numbers then."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Reflexes(Result):
    """Reflexes of a person in one condition.

    Attributes:
      condition: that it is.
      subject: the person.
      unit: of amplitudes.
      responses: one row per muscle: `delay_s`, `delay_error_s` and its 95 % limits `lower_95_s` and `upper_95_s`,
        `delay_by_phase_s`, gains `velocity_s`, `velocity_e` [s/rad] and `position_s`, `position_e` [1/rad] with their
        errors (`..._error`), `coherence` of amplitude and rotation in the whole band, and `p` of no response
        at any delay; of the trials in which the channel is not dead.
      frequency: centres of bands [Hz], (band,).
      response: H_xa from rotation of shoulder and elbow to amplitude [1/rad], (muscle, joint, band).
      response_error: standard error of its modulus, (muscle, joint, band).
      coherence: multiple coherence [-], (muscle, band).
      averages: one row per muscle and direction of the pulses: number of `trials`, amplitude in `background`, and above
        it in `short` and `long`, with standard errors over trials (`..._error`).
      remarks: muscles that answer as reflexes of what they are said to be do not.
    """

    condition: str
    subject: str
    unit: str
    responses: pd.DataFrame
    frequency: Array
    response: ComplexArray
    response_error: Array
    coherence: Array
    averages: pd.DataFrame
    remarks: tuple[str, ...] = ()

    def describe(self) -> Description:
        """Delay, gains and coherence of each muscle."""
        rows = tuple(
            (
                row["muscle"],
                *(
                    ("–", "–")
                    if math.isnan(row["delay_s"])
                    else (
                        f"{1e3 * row['delay_s']:.1f} ± {1e3 * row['delay_error_s']:.1f}",
                        f"{1e3 * row['delay_by_phase_s']:.1f}",
                    )
                ),
                plain(row["coherence"], 2),
                f"{row['p']:.2g}",
            )
            for row in self.responses.to_dict("records")
        )
        return Description(
            title=f"Reflexes of {self.subject} in {self.condition}, from rotation to EMG",
            facts=(f"amplitudes in {self.unit}",),
            table=Table(("muscle", "delay [ms]", "by phase [ms]", "coherence", "p"), rows),
            remarks=self.remarks,
        )

    def to_frame(self) -> pd.DataFrame:
        """`responses`, and condition and subject as the last columns."""
        return self.responses.assign(condition=self.condition, subject=self.subject)

    def to_xarray(self) -> xr.Dataset:
        """`response`, `response_error` and `coherence` along muscle, joint and frequency."""
        return xr.Dataset(
            {
                "response": (("muscle", "joint", "frequency"), self.response, {"units": "1/rad"}),
                "response_error": (("muscle", "joint", "frequency"), self.response_error, {"units": "1/rad"}),
                "coherence": (("muscle", "frequency"), self.coherence, {"units": "1"}),
            },
            coords={
                "muscle": list(self.responses["muscle"]),
                "joint": list(JOINTS),
                "frequency": ("frequency", self.frequency, {"units": "Hz"}),
            },
        )

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw modulus with 95 % limits, phase and coherence of the responses over frequency.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (3, joint).
        """
        from armperturb.plots.muscles import plot_reflexes

        return plot_reflexes(self, figure)


def reflexes(
    trials: ConditionTrials,
    envelopes: Envelopes,
    *,
    window_start: float = WINDOW_START,
    arm: Subject | None = None,
) -> Reflexes:
    """Reflexes of one condition, from a time on to the pulses, and averages about these.

    A trial in which a muscle's channel is dead is none of that muscle's.

    Args:
      trials: of the condition.
      envelopes: of all the person's trials.
      window_start: when the transient of the perturbation has died away [s].
      arm: of the person, as identified, whose grip gives: without it and without joint angles the handle's movement
        passes for the hand's, and delays come out wrong, those of stiff arms too short.

    Raises:
      TypeError: trials are no `ConditionTrials`, envelopes no `Envelopes`, or arm no `Subject`.
      ValueError: no trial is long enough, or together they are too short; a joint does not turn; the envelopes hold
        other trials of the condition; or neither joint angles nor the posture are known.
    """
    require_type("reflexes: trials", trials, ConditionTrials, "trials of one condition, of ConditionTrials.prepare")
    require_type("reflexes: envelopes", envelopes, Envelopes, "those of armperturb.envelopes")
    require_type("reflexes: arm", arm, (Subject, NoneType), "the person's, of an identification, or None")
    rows = rows_of(trials, envelopes)
    angles, rate, names = rotation(trials, arm), envelopes.rate, list(envelopes.muscles)
    first = round(window_start * rate)
    ends = [min(int(end), angles.shape[1]) for end in np.minimum(trials.onset, trials.limit)]
    used = [k for k, end in enumerate(ends) if end - first >= FEWEST_SECONDS * rate]
    if not used:
        raise ValueError(
            f"reflexes: trials of {trials.label} last at most {max(ends) / rate:g} s before the pulse; expected "
            f"{window_start + FEWEST_SECONDS:g} s (an earlier --window-start)"
        )
    length = min(ends[k] for k in used) - first
    frequency = fft.rfftfreq(length, 1.0 / rate)
    inside = (frequency >= BAND[0]) & (frequency < BAND[1])
    f, taper = frequency[inside], np.hanning(length)[None, :, None]
    # Neighbouring lines of a tapered spectrum share what they tell.
    shared = float(np.sum(taper**4) * length / np.sum(taper**2) ** 2)
    of_trial = np.bincount(_bands(f)) / shared
    n_lines = len(used) * of_trial.max()
    if n_lines < FEWEST_LINES:
        raise ValueError(
            f"reflexes: trials of {trials.label} ({len(used)} x {length / rate:g} s before the pulse) have "
            f"{n_lines:.1f} independent lines in {BIN:g} Hz; expected {FEWEST_LINES:g} (more or longer trials, or an "
            "earlier --window-start)"
        )
    amplitude = envelopes.amplitudes(rows)

    def spectrum(values: Array) -> ComplexArray:
        part = values[used, first : first + length]
        part = part - part.mean(axis=1, keepdims=True)
        return np.asarray(fft.rfft(part * taper, axis=1)[:, inside].swapaxes(1, 2))  # (trial, signal, frequency)

    q, a = spectrum(angles), spectrum(amplitude) / np.sinc(f * envelopes.averaging)
    turns = np.ptp(angles[used, first : first + length], axis=1)  # (trial, joint)
    if still := [name for name, extent in zip(JOINTS, turns.T, strict=True) if not extent.any()]:
        raise ValueError(
            f"reflexes: no rotation of {' and '.join(still)} in trials of {trials.label}; expected that of both joints"
        )
    bands = np.flatnonzero(len(used) * of_trial >= FEWEST_LINES)
    centre = np.array([f[_bands(f) == band].mean() for band in bands])
    fits, response, error, coherence = _of_muscles(q, a, f, shared, bands)
    # Where nothing moves the arm but the person, activity comes before rotation.
    is_perturbed = trials.drive[used, first : first + length].any()
    table = pd.DataFrame([{"muscle": name, **fit} for name, fit in zip(names, fits, strict=True)])
    table["delay_by_phase_s"] = [
        _by_phase(response[column], error[column], centre, fit) for column, fit in enumerate(fits)
    ]
    return Reflexes(
        condition=trials.label,
        subject=trials.name,
        unit=envelopes.unit,
        responses=table,
        frequency=centre,
        response=response,
        response_error=error,
        coherence=coherence,
        averages=pulse_averages(envelopes, rows.tolist()),
        remarks=(
            *copies_left_out([trials]),
            *(_remarks(trials.label, table, envelopes.muscles) if is_perturbed else ()),
        ),
    )


def _remarks(label: str, responses: pd.DataFrame, muscles: Mapping[str, Action]) -> tuple[str, ...]:
    """A line on muscles that clearly answer to shortening, of which no reflex does."""
    shortened = []
    for row in responses[responses["p"] < CLEAR].to_dict("records"):
        joints, sign = muscles[row["muscle"]]
        # Rotation is positive in flexion, which shortens flexors.
        scores = [sign * row[f"velocity_{joint}"] / row[f"velocity_{joint}_error"] for joint in joints]
        if max(scores, default=0.0) > OPPOSITE and min(scores) > -OPPOSITE:
            shortened.append(row["muscle"])
    if not shortened:
        return ()
    return (
        f"EMG of {', '.join(shortened)} in {label} answers to shortening: flexors that are named as extensors, or the "
        "other way round (sign in signals.emg.muscles of the sidecar), or activity that is no reflex",
    )


def _design(q: ComplexArray, f: Array, delay: float) -> Array:
    """Responses to unit gains, real and imaginary parts, (number, gain): velocity of both joints, then position."""
    s = 2j * np.pi * f
    delayed = np.exp(-s * delay) * q
    columns = np.concatenate([s * delayed, delayed], axis=1)  # (trial, gain, frequency)
    rows = columns.swapaxes(1, 2).reshape(-1, 4)
    return np.concatenate([rows.real, rows.imag])


def _whitened_fit(q: ComplexArray, a: ComplexArray, f: Array, shared: float) -> dict[str, float]:
    """`_fit` in noise whose spectrum is smooth: that of what a fit in flat noise leaves, a parabola in logarithms."""
    left = np.mean(np.abs(a - _explained(q, f, *_searched(q, a, f))) ** 2, axis=0)
    bands = _bands(f)
    places, counts = np.unique(bands, return_counts=True)
    power = np.array([left[bands == place].mean() for place in places])
    if len(places) < FEWEST_BANDS or not (power > 0.0).all():
        return _fit(q, a, f, shared)
    centres = np.array([np.log(f[bands == place]).mean() for place in places])
    course = np.polynomial.Polynomial.fit(centres, np.log(power), 2, w=np.sqrt(counts))
    size = np.exp(course(np.clip(np.log(f), centres[0], centres[-1])) / 2.0)
    fit = _fit(q / size, a / size, f, shared)
    left = a - _explained(q, f, fit["delay_s"], np.array([fit[name] for name in GAINS]))
    return fit | {"coherence": max(1.0 - float(np.sum(np.abs(left) ** 2) / np.sum(np.abs(a) ** 2)), 0.0)}


def _explained(q: ComplexArray, f: Array, delay: float, gains: Array) -> ComplexArray:
    """Spectrum of the amplitude that a delay [s] and `GAINS` explain, (trial, frequency)."""
    s = 2j * np.pi * f
    response = np.exp(-s * delay) * (gains[:2, None] * s + gains[2:, None])
    return np.asarray(np.sum(response * q, axis=1))


def _searched(q: ComplexArray, a: ComplexArray, f: Array) -> tuple[float, Array]:
    """Delay [s] and gains that explain most of an amplitude, (trial, frequency), in flat noise."""
    # A delay turns what the joints do, but does not change how the columns of the design go together.
    undelayed = _design(q, f, 0.0)
    inverse_gram = np.linalg.pinv(undelayed.T @ undelayed, hermitian=True)
    columns = np.concatenate([2j * np.pi * f * q, q], axis=1)  # (trial, gain, frequency)
    together = np.einsum("tgf,tf->gf", columns.conj(), a)

    def explained_by(delay: float) -> float:
        seen = (together @ np.exp(2j * np.pi * f * delay)).real
        return float(seen @ inverse_gram @ seen)

    delays = np.linspace(*DELAYS, N_DELAYS)
    start = delays[int(np.argmax([explained_by(delay) for delay in delays]))]
    step = delays[1] - delays[0]
    bounds = max(DELAYS[0], start - step), min(DELAYS[1], start + step)
    delay = float(
        optimize.minimize_scalar(lambda x: -explained_by(x), bounds=bounds, method="bounded", options={"xatol": 1e-6}).x
    )
    rows = np.concatenate([a.ravel().real, a.ravel().imag])
    gains, *_ = np.linalg.lstsq(_design(q, f, delay), rows, rcond=None)
    return delay, gains


def _fit(q: ComplexArray, a: ComplexArray, f: Array, shared: float) -> dict[str, float]:
    """Delay and gains of a muscle in flat noise, with standard errors; a is (trial, frequency)."""
    rows = np.concatenate([a.ravel().real, a.ravel().imag])
    if not rows.any():
        return UNKNOWN

    delay, gains = _searched(q, a, f)
    design, undelayed = _design(q, f, delay), _design(q, f, 0.0)
    remainder = float(np.sum((rows - design @ gains) ** 2))
    change = (_design(q, f, delay + 1e-5) - _design(q, f, delay - 1e-5)) @ gains / 2e-5
    everything = np.column_stack([design, change])
    n = len(rows) / shared
    variance = remainder / max(len(rows) - 5 * shared, 1.0)
    inverse = np.linalg.pinv(everything.T @ everything)
    of_flat_noise = np.diag(inverse) * variance * shared
    # What rectification and saturation leave is no flat noise: what a band of a trial tells is judged by how much bands
    # and trials differ. Of few, that is too little as often as too much, so that the larger of both errors counts.
    band = _bands(f)
    places = np.tile((np.arange(len(a))[:, None] * (band[-1] + 1) + band).ravel(), 2)
    scores = np.array([np.bincount(places, column) for column in (everything * (rows - design @ gains)[:, None]).T])
    n_bands = len(np.unique(places))
    of_bands = np.diag(inverse @ (scores @ scores.T) @ inverse) * n_bands / max(n_bands - 5, 1)
    errors = np.sqrt(np.maximum(of_flat_noise, of_bands))
    explained = max(1.0 - remainder / float(np.sum(rows**2)), 0.0)
    half = stats.t.ppf(0.975, max(n_bands - 5, 1)) * errors[4]
    limits = (delay, float(errors[4]), delay - half, delay + half)
    return {
        **dict(zip(WITH_LIMITS, limits, strict=True)),
        **dict(zip(GAINS, gains.tolist(), strict=True)),
        **{f"{name}_error": float(error) for name, error in zip(GAINS, errors[:4], strict=True)},
        "coherence": explained,
        "p": searched_p(explained, n, undelayed, _design(-2j * np.pi * f * q, f, 0.0), DELAYS[1] - DELAYS[0]),
    }


def _bands(f: Array) -> Indices:
    """In which band each frequency [Hz] is."""
    return np.floor(f / BIN).astype(np.intp)


def _of_muscles(
    q: ComplexArray, a: ComplexArray, f: Array, shared: float, bands: Indices
) -> tuple[list[dict[str, float]], ComplexArray, Array, Array]:
    """Fit of each muscle, and `_response` along (muscle, joint, band), of the trials in which its channel is not dead.

    Of too few lines there is no fit, and NaN in place of a response.
    """
    n_muscles, of_trial = a.shape[1], np.bincount(_bands(f)) / shared
    fits = [UNKNOWN] * n_muscles
    response = np.full((n_muscles, len(bands), len(JOINTS)), np.nan, complex)
    error, coherence = np.full(response.shape, np.nan), np.full(response.shape[:2], np.nan)
    is_alive = np.isfinite(a).all(axis=2)  # (trial, muscle)
    for alive in np.unique(is_alive, axis=1).T:
        if alive.sum() * of_trial.max() < FEWEST_LINES:
            continue
        columns = np.flatnonzero((alive == is_alive.T).all(axis=1))
        turned, active = q[alive], a[np.ix_(alive, columns)]
        enough = alive.sum() * of_trial[bands] >= FEWEST_LINES
        places = np.ix_(columns, np.flatnonzero(enough))
        response[places], error[places], coherence[places] = _response(turned, active, f, shared, bands[enough])
        for place, column in enumerate(columns):
            fits[column] = _whitened_fit(turned, active[:, place], f, shared)
    return fits, response.swapaxes(1, 2), error.swapaxes(1, 2), coherence


def _response(
    q: ComplexArray, a: ComplexArray, f: Array, shared: float, bands: Indices
) -> tuple[ComplexArray, Array, Array]:
    """H_xa and the standard error of its modulus, (muscle, band, joint), and multiple coherence, (muscle, band)."""
    places = _bands(f)
    responses, errors, coherences = [], [], []
    for place in bands:
        inputs, outputs = (each[..., places == place].swapaxes(0, 1).reshape(each.shape[1], -1) for each in (q, a))
        n = inputs.shape[1] / shared
        power = inputs @ inputs.conj().T
        inverse = np.linalg.inv(power)
        response = outputs @ inputs.conj().T @ inverse
        remainder = np.sum(np.abs(outputs - response @ inputs) ** 2, axis=1)
        total = np.maximum(np.sum(np.abs(outputs) ** 2, axis=1), 1e-300)
        noise = remainder / (inputs.shape[1] * max(1.0 - 2.0 / n, 0.1))
        responses.append(response)
        # Half of a complex error's variance lies along the modulus.
        errors.append(np.sqrt(0.5 * shared * noise[:, None] * np.diag(inverse).real))
        coherences.append(1.0 - remainder / total)
    return np.stack(responses, axis=1), np.stack(errors, axis=1), np.stack(coherences, axis=1)


def _by_phase(response: ComplexArray, error: Array, frequency: Array, fit: dict[str, float]) -> float:
    """Delay from the phase of the response to the joint that tells more, beyond the lead of its gains [s]."""
    if not fit["coherence"] > 0.0:
        return math.nan
    snr = np.abs(response) / np.maximum(error, 1e-300)
    joint = int(np.argmax(np.sum(snr**2, axis=1)))
    name = "se"[joint]
    lead = fit[f"velocity_{name}"] * 2j * np.pi * frequency + fit[f"position_{name}"]
    turned = np.angle(response[joint] / lead * np.exp(2j * np.pi * frequency * fit["delay_s"]))
    weight = snr[joint] ** 2
    omega = 2.0 * np.pi * frequency
    return float(fit["delay_s"] - np.sum(weight * omega * turned) / max(np.sum(weight * omega**2), 1e-300))
