"""Spectra of one condition, whatever its excitation: of whole periods where there are any, else of whole records."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from armperturb.analysis.defaults import LINES_PER_AVERAGE, SETTLED, SETTLING, WINDOW_START
from armperturb.analysis.per_trials import per_trials
from armperturb.analysis.periods import common_period, settled_start
from armperturb.analysis.response.closed_loop import local_fits
from armperturb.analysis.response.joint_records import admittance_of
from armperturb.analysis.response.spectra import LineSpectra, SpectralEstimate, averaged_spectra, line_spectra
from armperturb.analysis.trials import ConditionTrials
from armperturb.recording import labels_of


@per_trials
def whole_periods_start(trials: ConditionTrials, window_start: float = WINDOW_START) -> float | None:
    """Latest time from which trials hold a whole period: `window_start`, or else `SETTLING` or `SETTLED` [s].

    None where the disturbance has no period, or trials hold none.

    Args:
      trials: of one condition, or their recording.
      window_start: start of the window of whole periods, as it is wanted [s].
    """
    try:
        period = common_period([trials], window_start)
    except ValueError:
        return None
    latest, *earlier = (settled_start([trials], wanted) for wanted in (window_start, SETTLING, SETTLED))
    for start in (latest, *(each for each in earlier if each <= latest)):
        with suppress(ValueError):
            trials.window(start, period)
            return start
    return None


def periodic_lines(
    parts: Sequence[ConditionTrials], window_start: float = WINDOW_START, period: float | None = None
) -> LineSpectra | None:
    """Lines of whole periods; None where the disturbance has none, they are too short, or trials differ in length.

    Args:
      parts: trials of one condition, those of one length together.
      window_start: start of the window of whole periods [s].
      period: of the disturbance [s]; None to find it.

    Raises:
      ValueError: as `line_spectra`, with a stated period.
    """
    if len(parts) > 1 and period is None:
        return None
    try:
        return line_spectra(parts[0], window_start=window_start, period=period)
    except ValueError:
        if period is not None:
            raise
        return None


def condition_spectra(
    parts: Sequence[ConditionTrials],
    *,
    window_start: float = WINDOW_START,
    period: float | None = None,
    lines_per_average: int = LINES_PER_AVERAGE,
) -> SpectralEstimate:
    """Admittances and coherence of one condition.

    Args:
      parts: trials of one condition, those of one length together.
      window_start: start of the window of whole periods [s].
      period: of the disturbance [s]; None to find it. Where trials hold no whole period from `window_start` on, the
        window is earlier, see `whole_periods_start`. Where there is no period, or its lines do not tell the response,
        whole records are used, see `closed_loop.estimate_noise`.
      lines_per_average: of whole periods, see `estimate_spectra`.

    Raises:
      ValueError: as `averaged_spectra` with a stated period, and as `estimate_noise` otherwise.
    """
    start: float | None = window_start
    if period is None:
        start = whole_periods_start(parts[0], window_start) if len(parts) == 1 else None
    if start is None or periodic_lines(parts, start, period) is None:
        return _by_whole_records(parts)
    try:
        return averaged_spectra(parts[0], window_start=start, period=period, lines_per_average=lines_per_average)
    except ValueError:
        if period is None:
            with suppress(ValueError):
                return _by_whole_records(parts)
        raise


def _by_whole_records(parts: Sequence[ConditionTrials]) -> SpectralEstimate:
    """As `_of_whole_records`, stored with the trials."""
    key = ("whole records", tuple(parts))
    if key not in parts[0].results:
        parts[0].results[key] = _of_whole_records(parts)
    spectra: SpectralEstimate = parts[0].results[key]
    return spectra


def _of_whole_records(parts: Sequence[ConditionTrials]) -> SpectralEstimate:
    later = not all(part.from_rest for part in parts) and all(part.is_perturbed(SETTLED) for part in parts)
    start = SETTLED if later else 0.0
    fits, power = local_fits(parts, start)
    joint = np.array([fit.answer for fit in fits])
    arm, environment, total = (admittance_of(what, joint) for what in ("arm", "environment", "total"))
    moved = np.einsum("fij,fjk,fik->fi", total, power, total.conj()).real
    noise = np.array([np.diag(fit.noise)[2:].real for fit in fits])
    return SpectralEstimate(
        frequency=np.array([fit.frequency for fit in fits]),
        arm=arm,
        environment=environment,
        total=total,
        coherence=moved / (moved + noise),
        n_averages=np.round([fit.dof for fit in fits]).astype(np.int64),
        labels=labels_of(parts[0].recording),
    )
