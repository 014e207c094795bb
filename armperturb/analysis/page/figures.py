"""Figures of the page, each drawn once."""

from collections.abc import Mapping, Sequence

import numpy as np

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.analysis.fit.diagnosis import Diagnosis
from armperturb.analysis.fit.identification import Identification, Identifications
from armperturb.analysis.measures.endpoint import EndpointImpedance, plot_endpoints
from armperturb.analysis.measures.vaf import driving
from armperturb.analysis.response.frequency_response import FrequencyResponse
from armperturb.analysis.trials import ConditionTrials
from armperturb.pages.page import Picture
from armperturb.plots.bands import Curve, plot_responses
from armperturb.plots.diagnosis import plot_fit_quality, plot_residual
from armperturb.plots.parameters import plot_parameters
from armperturb.plots.pulses import PredictedPulse, plot_pulses
from armperturb.plots.style import colours_for, new_figure
from armperturb.plots.traces import plot_traces

AFTER, BEFORE = 0.8, 0.05
"""Time around a pulse's onset that is shown [s]."""

MOST_PULSES = 4
"""Pulses that are shown of a condition."""


def parameters(results: Identifications) -> Picture:
    """Parameters with their intervals."""
    figure = new_figure(1.0)
    plot_parameters({label: result.to_frame() for label, result in results.items()}, figure)
    return Picture.of(figure)


def endpoint(endpoints: Mapping[str, EndpointImpedance]) -> Picture:
    """Ellipses at the hand."""
    figure = new_figure(1.0)
    plot_endpoints(endpoints, figure)
    return Picture.of(figure)


def admittance(results: Identifications, responses: Mapping[str, FrequencyResponse]) -> Picture:
    """Estimates as points with their limits, models as lines with their bands.

    Args:
      results: with the models.
      responses: condition to the estimate.
    """
    curves = []
    for (label, result), colour in zip(results.items(), colours_for(len(results)), strict=True):
        estimate = responses[label]
        dense = np.geomspace(estimate.frequency[0], estimate.frequency[-1], 120)
        points = {"color": colour, "marker": "o", "linestyle": "", "markersize": 2.5}
        known = None if estimate.covariance is None else estimate.bands()
        model, bands = arm_admittance(result.fit.arm, dense), result.fit.admittance_bands(dense)
        curves += [
            Curve(f"{label}, estimated", estimate.frequency, estimate.response, known, points, (dense, model)),
            Curve(f"{label}, model", dense, model, bands, {"color": colour}),
        ]
    figure = new_figure(1.0)
    plot_responses(curves, figure=figure)
    return Picture.of(figure)


def quality(results: Identifications, diagnoses: Mapping[str, Diagnosis]) -> Picture:
    """Coherence, and lack of fit by band."""
    figure = new_figure(1.0)
    plot_fit_quality(
        {label: (result.spectra.frequency, result.spectra.coherence) for label, result in results.items()},
        {label: [(band.low, band.high, band.chi2 / 8.0) for band in each.bands] for label, each in diagnoses.items()},
        figure,
    )
    return Picture.of(figure)


def traces(trials: ConditionTrials) -> Picture:
    """The first trial as recorded."""
    figure = new_figure(1.0)
    d, f, x = (values[0] for values in trials.signals)
    plot_traces((d, f, x), trials.rate, figure)
    return Picture.of(figure)


def residual(diagnosis: Diagnosis) -> Picture:
    """What the model leaves, over time and frequency."""
    figure = new_figure(1.0)
    plot_residual(
        (diagnosis.time, diagnosis.recorded, diagnosis.residual),
        (diagnosis.frequency, diagnosis.moved, diagnosis.left, diagnosis.noise),
        figure,
    )
    return Picture.of(figure)


def pulses(results: Identifications, trials: Mapping[str, Sequence[ConditionTrials]]) -> Picture | None:
    """Pulses as recorded and as predicted, the first of each direction; None where there are none."""
    shown = [
        pulse for label, result in results.items() for pulse in _pulses_of(result, trials[label]) if result.fit.stable
    ]
    if not shown:
        return None
    figure = new_figure(1.0)
    plot_pulses(shown, figure)
    return Picture.of(figure)


def _pulses_of(result: Identification, parts: Sequence[ConditionTrials]) -> list[PredictedPulse]:
    by_title: dict[str, PredictedPulse] = {}
    for part in parts:
        for trial in np.flatnonzero(part.onset < part.n_samples).tolist():
            title = f"{part.label}, {part.direction_deg[trial]:g}°"
            onset, rate = int(part.onset[trial]), part.rate
            last = int(min(onset + AFTER * rate, part.limit[trial], part.n_samples))
            if title in by_title or len(by_title) == MOST_PULSES:
                continue
            around = slice(max(onset - round(BEFORE * rate), 0), last)
            path = simulate_linear(result.fit.arm, part.environment, driving(part, trial, last), rate)
            by_title[title] = PredictedPulse(
                title,
                (np.arange(around.start, last) - onset) / rate,
                part.recorded_displacement[trial, around],
                {"predicted": path.displacement[around]},
            )
    return list(by_title.values())
