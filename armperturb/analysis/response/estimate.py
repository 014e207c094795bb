"""Frequency responses without a model of the arm, by one call and any of seven methods.

A method is a function from a recording, or several, to a `FrequencyResponse`. All take what is wanted (`what`), where
(`frequency`) and from when on (`window_start`); each has options of its own.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from armperturb.analysis.defaults import LINES_PER_AVERAGE, WINDOW_START
from armperturb.analysis.manipulator import remarks_on_trials
from armperturb.analysis.pulses_alone import used_whole
from armperturb.analysis.response.arx import fit_arx
from armperturb.analysis.response.closed_loop import estimate_noise
from armperturb.analysis.response.frequency_response import FrequencyResponse, System, require_frequencies
from armperturb.analysis.response.joint_records import admittance_of, excited_frequencies, joint_records, variance_of
from armperturb.analysis.response.local_polynomial import N_INPUTS, Window, fit_locally, frequency_response
from armperturb.analysis.response.multisines import estimate_multisine
from armperturb.analysis.response.one_axis import one_axis_response
from armperturb.analysis.response.spectra import averaged_spectra, line_spectra
from armperturb.analysis.response.subspace import fit_subspace
from armperturb.analysis.response.tapers import estimate_multitaper, estimate_welch
from armperturb.analysis.trials import SeveralTrials, TrialRecord, prepared, prepared_condition, prepared_recordings
from armperturb.arrays import Array
from armperturb.joined_recordings import join_recordings
from armperturb.recording import is_one_axis, labels_of, named
from armperturb.validation import require_one_of

FEWEST_TRIALS = 4
"""Trials from which on their differences tell the covariance of a subspace estimate."""


def spectral_response(
    recording: SeveralTrials,
    *,
    frequency: ArrayLike | None = None,
    what: System = "arm",
    window_start: float = WINDOW_START,
    period: float | None = None,
    lines_per_average: int = LINES_PER_AVERAGE,
) -> FrequencyResponse:
    """Response by averaged spectra of a periodic disturbance as in the thesis, see `spectra.estimate_spectra`.

    The covariance takes whatever the lines of an average leave for noise, also that they differ. There is none with as
    many averages as inputs.

    Args:
      recording: trials of one person in one condition, of one duration.
      frequency: some of those at which there are estimates [Hz], (frequency,); None gives all.
      what: "arm" (x over f), "environment" (x over d - f) or "total" (x over d) [m/N].
      window_start: start of the window, after the transient has gone [s].
      period: of the disturbance [s]; None to find it.
      lines_per_average: adjacent lines that are averaged.

    Raises:
      ValueError: as `line_spectra`, `estimate_spectra` and `join_recordings`; or there is no estimate at a frequency.
    """
    several = prepared_recordings(recording)
    trials = (
        several[0] if len(several) == 1 else prepared(join_recordings([part.recording for part in several]).recording)
    )
    lines = line_spectra(trials, window_start=window_start, period=period)
    spectra = averaged_spectra(trials, window_start=window_start, period=period, lines_per_average=lines_per_average)
    if spectra.n_averages.min() <= N_INPUTS:
        values = getattr(spectra, what)
        return FrequencyResponse(frequency=spectra.frequency, response=values, covariance=None, what=what).at(frequency)
    answer = np.concatenate([lines.force, lines.displacement], axis=-1)
    ends = np.cumsum(spectra.n_averages // len(answer))
    fits = []
    for centre, group in zip(spectra.frequency, np.split(np.arange(ends[-1]), ends[:-1]), strict=True):
        excited = np.ones(len(group), dtype=bool)
        trial_lines = zip(lines.perturbation[:, group], answer[:, group], strict=True)
        windows = [Window(lines.frequency[group], d, z, excited) for d, z in trial_lines]
        fits.append(fit_locally(windows, float(centre), order=0, leakage_order=-1))
    return frequency_response(fits, what, [(fit.noise, fit.dof) for fit in fits]).at(frequency)


def arx_response(
    recording: SeveralTrials,
    *,
    frequency: ArrayLike | None = None,
    what: System = "arm",
    window_start: float = 0.0,
    **options: Any,
) -> FrequencyResponse:
    """Response by a multivariable ARX model from d to (f, x), with covariance, see `arx`.

    Args:
      recording: trials of one person in one condition; several recordings may have several durations. Whatever is
        before the pulse is used, transients included.
      frequency: where the response is wanted [Hz], (frequency,); None takes those that the disturbance excites.
      what: "arm" (x over f), "environment" (x over d - f) or "total" (x over d) [m/N].
      window_start: start of what is used [s].
      **options: `order` and `highest_order` of `fit_arx`.

    Raises:
      TypeError: an order is not a whole number.
      ValueError: as `joint_records` and `fit_arx`, or a frequency is out of range.
    """
    records, wanted = _records_and_frequencies(recording, window_start, frequency)
    model = fit_arx(records, wanted, what=what, **options)
    joint = model.response(wanted)
    values, variance = admittance_of(what, joint[0]), variance_of(what, *joint)
    return FrequencyResponse(frequency=wanted, response=values, covariance=variance, what=what)


def subspace_response(
    recording: SeveralTrials,
    *,
    frequency: ArrayLike | None = None,
    what: System = "arm",
    window_start: float = 0.0,
    **options: Any,
) -> FrequencyResponse:
    """Response by a state-space model from d to (f, x), see `subspace`.

    With four trials or more the covariance is that of the jackknife: the model of the same order is fitted without each
    trial in turn. Fewer tell none. It holds no bias of the order.

    Args:
      recording: as for `arx_response`.
      frequency: as for `arx_response`.
      what: as for `arx_response`.
      window_start: as for `arx_response`.
      **options: `order` and `past` of `fit_subspace`.

    Warns:
      RuntimeWarning: the model is unstable.

    Raises:
      TypeError: an order is not a whole number.
      ValueError: as `joint_records` and `fit_subspace`, or a frequency is out of range.
    """
    records, wanted = _records_and_frequencies(recording, window_start, frequency)
    model = fit_subspace(records, wanted, what=what, **options)
    n_trials = len(records)
    covariance = dof = None
    if n_trials >= FEWEST_TRIALS:
        without = []
        for left_out in range(n_trials):
            others = records[:left_out] + records[left_out + 1 :]
            fewer = fit_subspace(others, wanted, what=what, **options | {"order": model.order})
            without.append(admittance_of(what, fewer.response(wanted)))
        covariance = (n_trials - 1) * np.var(without, axis=0)
        dof = np.full(len(wanted), n_trials - 1.0)
    values = admittance_of(what, model.response(wanted))
    return FrequencyResponse(frequency=wanted, response=values, covariance=covariance, what=what, dof=dof)


METHODS: dict[str, Callable[..., FrequencyResponse]] = {
    "multisine": estimate_multisine,
    "noise": estimate_noise,
    "welch": estimate_welch,
    "multitaper": estimate_multitaper,
    "spectral": spectral_response,
    "arx": arx_response,
    "subspace": subspace_response,
}
"""Name of a method to what estimates by it."""


def response(
    recording: SeveralTrials, method: str | None = None, frequency: ArrayLike | None = None, **options: Any
) -> FrequencyResponse:
    """Frequency response of the arm, the environment or both, without a model of the arm.

    A recording of one axis gives an `AxisResponse`: admittance on a force servo, impedance on a position servo, with
    coherence and distortion, see `one_axis`.

    Args:
      recording: trials of one person in one condition, or several such recordings; used up to their pulses, or with
        these where nothing else perturbs them.
      method: one of `METHODS`; None is "multisine", and of one axis "noise", which takes any disturbance and is the
        only one there. Of multisines, whatever their lines and their period: "multisine", or "spectral" as in
        the thesis. Of any disturbance with power at all frequencies of interest: "noise", "welch" or "multitaper". Of
        either: the models "arx" and "subspace".
      frequency: where the response is wanted [Hz], (frequency,); None leaves it to the method. Methods for multisines
        have estimates at the middles of clusters alone.
      **options: `what`: "arm" (default, x over f), "environment" (x over d - f) or "total" (x over d); `window_start`
        of what is used [s]; and those of the method, see its function.

    Raises:
      TypeError: the method lacks an option, or recording is no `Dataset`.
      ValueError: the method is unknown, trials differ in subject, task, condition or posture, or as its function.
    """
    require_one_of("response", "what", options.get("what", "arm"), get_args(System))
    several = prepared_condition(recording)
    if is_one_axis(several[0].recording):
        require_one_of("response of one axis", "method", method, (None, "noise"))
        return one_axis_response(several, frequency=frequency, **options)
    several = used_whole(several)
    method = "multisine" if method is None else method
    require_one_of("response", "method", method, list(METHODS))
    estimate = METHODS[method](several, frequency=frequency, **options)
    return replace(
        estimate,
        label=f"{named([trials.recording for trials in several])}, {method}",
        remarks=(*remarks_on_trials(several), *estimate.remarks),
        labels=labels_of(several[0].recording),
    )


def _records_and_frequencies(
    recording: SeveralTrials, window_start: float, frequency: ArrayLike | None
) -> tuple[list[TrialRecord], Array]:
    records = joint_records(recording, window_start)
    wanted = excited_frequencies(records) if frequency is None else require_frequencies(frequency, records[0].rate)
    return records, wanted
