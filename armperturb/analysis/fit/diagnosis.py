"""What an estimated arm leaves unexplained: over time, over frequency beside the modelled noise, and band by band."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armperturb.analysis.arm.parameters import MATRIX, PARAMETERS, parameter_vector
from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.analysis.fit.frequency_bands import BandOfLack
from armperturb.analysis.fit.group import highest_frequency, record_likelihood
from armperturb.analysis.fit.identification import Identification
from armperturb.analysis.fit.likelihood import RecordLikelihood
from armperturb.analysis.fit.maximum_likelihood import Estimate
from armperturb.analysis.fit.trial_effects import QUANTITIES
from armperturb.analysis.measures.vaf import driving
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Diagnosis:
    """What an arm leaves of the trials of one condition, up to the first pulse.

    Attributes:
      time: [s], (time,).
      recorded: displacement of the first trial [m], (time, axis).
      residual: the same less what the arm predicts, (time, axis).
      frequency: [Hz], (frequency,).
      moved: spectral density of the displacement, mean over trials [m^2/Hz], (frequency, axis).
      left: of the residual, likewise.
      noise: as the likelihood models it, likewise.
      bands: how far the disturbance explains the residual in each excited band; trials may differ as the estimate has
        it.
    """

    time: Array
    recorded: Array
    residual: Array
    frequency: Array
    moved: Array
    left: Array
    noise: Array
    bands: tuple[BandOfLack, ...]


def diagnose(identification: Identification, parts: Sequence[ConditionTrials]) -> Diagnosis:
    """Compare the trials of one condition with the arm that was identified from them.

    Args:
      identification: of the condition.
      parts: its trials, those of one length together; the longest are shown.
    """
    trials = max(parts, key=lambda part: part.n_samples)
    fit, end = identification.fit, trials.first_onset
    predicted = simulate_linear(fit.arm, trials.environment, driving(trials, 0, end), trials.rate)
    recorded = trials.recorded_displacement[0, :end]
    likelihood = record_likelihood(trials, highest_frequency(parts, float(identification.spectra.frequency[-1])))
    spread = fit.detail.trial_spread if isinstance(fit.detail, Estimate) else {}
    values = _of_trials(likelihood, parameter_vector(fit.arm), np.array([spread.get(name, 0.0) for name in QUANTITIES]))
    likelihood.weigh(values)
    frequency, moved, left, noise = likelihood.densities(values)
    return Diagnosis(
        time=np.arange(end) / trials.rate,
        recorded=recorded,
        residual=recorded - predicted.displacement,
        frequency=frequency,
        moved=moved,
        left=left,
        noise=noise,
        bands=likelihood.lack_by_band(values),
    )


def _of_trials(likelihood: RecordLikelihood, mean: Array, spread: Array) -> Array:
    """Parameters of the arm of each trial, (trial, parameter), as far as they differ, else of all, (parameter,)."""
    if not spread.any():
        return mean
    design = np.zeros((len(PARAMETERS), len(QUANTITIES)))
    for column, quantity in enumerate(QUANTITIES):
        rows = MATRIX[quantity].ravel()
        design[rows, column] = mean[rows]
    likelihood.weigh(mean)
    normal = likelihood.normal(mean, design)
    # Best linear prediction, of effects whose standard deviation is one.
    scaled = [
        np.linalg.solve(np.eye(len(spread)) + spread[:, None] * information * spread, spread * slope)
        for slope, information in zip(normal.slopes, normal.informations, strict=True)
    ]
    return np.asarray(mean + (spread * np.array(scaled)) @ design.T)
