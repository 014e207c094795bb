"""From a recording to the arm: admittance, environment, fitted model and how well it predicts (thesis 2.6, 2.7)."""

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from armperturb.analysis.arm_model import Delay, largest_real_pole, simulate_linear
from armperturb.analysis.fit import AdmittanceFit, fit_admittance
from armperturb.analysis.spectra import LineSpectra, SpectralEstimate, estimate_spectra, line_spectra
from armperturb.analysis.structures import Structure
from armperturb.environment import Environment
from armperturb.subject import POSITION, RELAX, TASKS, Subject


@dataclass(frozen=True, kw_only=True, eq=False)
class Identification:
    """What one condition of a recording yields.

    Attributes:
      spectra: estimated admittances and coherence.
      environment: mass, spring and damper that the manipulator really showed.
      fit: the arm model.
      vaf: variance of the displacement that the fitted model accounts for, x and y, mean over trials [%], (axis,).
    """

    spectra: SpectralEstimate
    environment: Environment
    fit: AdmittanceFit
    vaf: NDArray[np.float64]


def fit_environment(lines: LineSpectra) -> Environment:
    """Mass, damping and stiffness that the manipulator really showed (as C.1-C.3, from every line).

    At each line, D - F = (M s^2 + B s + K) X, whatever the arm does. As X is noisy, the equations are not solved by
    least squares, which would bias M, but by instrumental variables made from D.

    Raises:
      ValueError: no positive mass comes out, as happens when the sign of the force is wrong.
    """
    s = 2j * np.pi * lines.frequency[:, None, None]
    powers = np.concatenate([s**2, s, np.ones_like(s)], axis=-1)
    regressors = (powers * lines.displacement[..., None]).reshape(-1, 3)
    target = (lines.perturbation - lines.force).ravel()
    # D through a rough environment: the weights fade with frequency as the displacement does.
    rough = Environment()
    instruments = (
        powers
        * (lines.perturbation / (rough.m_env * s[..., 0] ** 2 + rough.b_env * s[..., 0] + rough.k_env))[..., None]
    )
    instruments = instruments.reshape(-1, 3).conj().T
    mass, damping, stiffness = np.linalg.solve((instruments @ regressors).real, (instruments @ target).real)
    if mass <= 0:
        raise ValueError(
            f"the environment's mass comes out at {mass:.3g} kg; expected a positive mass (force must be the reaction "
            "force that the handle exerts on the hand, so that the environment sees perturbation - force)"
        )
    return Environment(m_env=float(mass), b_env=max(float(damping), 0.0), k_env=max(float(stiffness), 0.0))


def variance_accounted_for(
    recorded: ArrayLike, predicted: ArrayLike, rate: float, *, highpass: float | None = 0.40
) -> NDArray[np.float64]:
    """Share of the recorded displacement's variance that a prediction accounts for [%], (..., axis).

    Args:
      recorded: displacement [m], (..., time, axis).
      predicted: the same, by the model.
      rate: sampling rate [Hz].
      highpass: cut-off of the third-order Butterworth high-pass, run forth and back, that takes voluntary
        interventions out of both [Hz]; None leaves them in.

    Source: eq. 2.23 and the text below it.
    """
    x, model = np.asarray(recorded, dtype=float), np.asarray(predicted, dtype=float)
    if highpass is not None:
        sections = signal.butter(3, highpass, "highpass", fs=rate, output="sos")
        x, model = (signal.sosfiltfilt(sections, values, axis=-2) for values in (x, model))
    return 100.0 * (1.0 - np.sum((x - model) ** 2, axis=-2) / np.sum(x**2, axis=-2))


def identify(
    recording: xr.Dataset,
    model: Structure | str,
    *,
    start: float = 8.0,
    period: float = 20.48,
    lines_per_average: int = 4,
    use_penalty: bool = True,
    delay: Delay = "exact",
) -> Identification:
    """Admittance, environment, fitted arm model and its VAF from the trials of one subject in one condition.

    Args:
      recording: the trials; `recording.sel` or `.isel` picks them from a larger recording.
      model: structure or its name, see `structures.STRUCTURES`.
      start: of the spectral window [s].
      period: of the disturbance [s].
      lines_per_average: see `estimate_spectra`.
      use_penalty: see `fit_admittance`.
      delay: see `fit_admittance`.

    Raises:
      ValueError: the recording is refused, holds several subjects, conditions or postures, or gives no spectra.
    """
    body = body_of(recording)
    lines = line_spectra(recording, start=start, period=period)
    spectra = estimate_spectra(lines, lines_per_average=lines_per_average)
    environment = fit_environment(lines)
    slowest = np.trace(spectra.arm[0]).real / 2
    if slowest <= 0:
        raise ValueError(
            f"the arm's admittance at {spectra.frequency[0]:.3g} Hz is {slowest:.3g} m/N; expected it above 0, like "
            "a spring's (force must be the reaction force that the handle exerts on the hand)"
        )
    fit = fit_admittance(
        spectra.frequency,
        spectra.arm,
        body,
        model,
        environment,
        coherence=spectra.coherence,
        use_penalty=use_penalty,
        delay=delay,
    )
    vaf = prediction_vaf(recording, fit.arm, environment).mean(axis=0)
    return Identification(spectra=spectra, environment=environment, fit=fit, vaf=vaf)


def body_of(recording: xr.Dataset) -> Subject:
    """Task, segment lengths and posture of the one person in a recording, in a subject whose muscles do not matter.

    Raises:
      ValueError: trials differ in subject, condition or posture, or the task is unknown.
    """
    found = {}
    for name in ("subject", "task", "condition", "l_h", "l_f", "theta_s_deg", "theta_e_deg"):
        values = list(dict.fromkeys(recording[name].values.tolist()))
        if len(values) > 1:
            raise ValueError(
                f"the recording holds several values of {name} ({', '.join(map(str, values))}); expected one"
            )
        found[name] = values[0]
    if found["task"] not in TASKS:
        raise ValueError(f"task = {found['task']!r}; expected one of {', '.join(TASKS)}")
    found.pop("condition")
    name = found.pop("subject")
    return replace(POSITION if found["task"] == "PT" else RELAX, name=name, **found)


def prediction_vaf(recording: xr.Dataset, arm: Subject, environment: Environment) -> NDArray[np.float64]:
    """VAF of the linear model's displacement up to the pulse [%], (trial, axis).

    Args:
      recording: the trials that are predicted.
      arm: the model; minus infinity if it is unstable, as its response has no bound.
      environment: what the hand held.
    """
    vaf = np.full((recording.sizes["trial"], 2), -np.inf)
    if largest_real_pole(arm, environment) >= 0:
        return vaf
    rate = float(recording.attrs["rate"])
    for trial in range(len(vaf)):
        onset = float(recording["pulse_onset"].values[trial])
        n = recording.sizes["time"] if np.isnan(onset) else round(onset * rate)
        d, x = recording["perturbation"].values[trial, :n], recording["displacement"].values[trial, :n]
        vaf[trial] = variance_accounted_for(x, simulate_linear(arm, environment, d, rate).displacement, rate)
    return vaf
