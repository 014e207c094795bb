"""What a reader of an identified joint is told besides its parameters: why they may be wrong, or are."""

from typing import TYPE_CHECKING

import numpy as np
from scipy import fft, signal

from armperturb.analysis.defaults import FEWEST_TRIALS
from armperturb.analysis.fit.frequency_bands import EXCITED_POWER
from armperturb.analysis.fit.maximum_likelihood import SUSPICIOUS
from armperturb.analysis.fit.trial_effects import FEW
from armperturb.analysis.joint.model import Reflex
from armperturb.analysis.joint.signals import RATE, TOP
from armperturb.analysis.results import plain
from armperturb.arrays import Array

if TYPE_CHECKING:
    from armperturb.analysis.joint.identify import JointIdentification

LACKING = 2.0
"""VAF by which the free model is ahead from which on a remark says so [%]."""

MOST = 50.0
"""VAF below which more is left than is explained [%]."""

RESOLUTION = 5
"""Lines of a spectrum with a Hann window over which one frequency spreads."""

BEYOND = 0.025
"""Power of the velocity next above the band, over that below, from which on it changes a half-wave [-]. Of simulated
ankles threshold and gain are right at 0.4 to 1.7 %, and 1.6 to 5 standard errors off at 3.3 to 9 %."""


def remarks_on(result: "JointIdentification", n_trials: int) -> tuple[str, ...]:
    """Remarks, without full stop each.

    Args:
      result: complete but for these.
      n_trials: that were fitted.
    """
    said = ruled_out(result)
    said += [
        each
        for each in (
            result.parts.sentence,
            cut_short(result.structure.reflex, result.top, result.beyond),
            outweighed(result),
        )
        if each
    ]
    said += [f"{name} sits on a bound, and has no interval" for name in result.at_bound]
    if n_trials < FEWEST_TRIALS:
        said.append(FEW)
    if not result.converged:
        said.append("the noise and the parameters did not settle together: intervals may be too short")
    lack = result.lack_of_fit
    if lack.p_value < SUSPICIOUS:
        said.append(
            f"the structure leaves what a linear response explains (chi2/dof = {lack.chi2 / lack.dof:.3g}): estimates "
            "may be biased by more than their intervals say"
        )
    free, intrinsic = result.free_model, result.intrinsic
    if free is not None and (ahead := free.left_out_vaf - result.vaf["total"]) > LACKING:
        said.append(
            f"a free model predicts {ahead:.1f} % more of the torque's variance on left-out data than the parallel "
            "cascade accounts for: the joint does more than the cascade has"
        )
    if intrinsic is not None and (further := intrinsic.left_out_vaf - intrinsic.structured_vaf) > LACKING:
        said.append(
            f"an impulse response without structure explains {further:.1f} % more of what the reflex path leaves, on "
            "left-out data, than inertia, damping and stiffness: the intrinsic path is not these alone"
        )
    return tuple(said)


def ruled_out(result: "JointIdentification") -> list[str]:
    """What rules the parameters out however well they fit, without full stop each."""
    said = []
    n_frequencies, n_parameters = _frequencies(result), len(result.values)
    if 2 * n_frequencies < n_parameters:
        counted = "1 frequency" if n_frequencies == 1 else f"{n_frequencies} frequencies"
        said.append(
            f"the movement has power at {counted} alone, and a response is two numbers at each: the structure has "
            f"{n_parameters} free parameters, which no such movement determines; perturb a band of frequencies"
        )
    lower, upper = result.interval("stiffness")
    if result.values["stiffness"] + result.values.get("short_range_stiffness", 0.0) < 0.0 and upper < 0.0:
        said.append(
            f"the stiffness of the joint is negative ({plain(lower, 3)} to {plain(upper, 3)} "
            f"{result.unit_of('stiffness')}), but a joint resists what moves it: the sign of torque or angle is "
            "turned (signals.force.exerted_by of the sidecar), or the structure is wrong"
        )
    return said


def cut_short(reflex: Reflex, top: float, beyond: float) -> str:
    """That a half-wave needs more of the movement than is used, without full stop; empty where it does not.

    Args:
      reflex: of the structure.
      top: frequency up to which the movement is used [Hz].
      beyond: power of the velocity next above that, over its power below [-].
    """
    if reflex != "half-wave" or beyond < BEYOND:
        return ""
    remedy = "perturb with less that is fast" if top >= TOP else f"record or convert at {RATE:g} Hz or more"
    return (
        f"the movement, or noise of its sensor, goes on beyond {top:g} Hz, up to which it is used (a further "
        f"{100.0 * beyond:.0f} % of the velocity's power is just above), and a half-wave needs all of it: gain "
        f"and threshold of the reflex may be wrong; {remedy}"
    )


def outweighed(result: "JointIdentification") -> str:
    """That more is left than is explained, without full stop; empty where it is not."""
    share, of = result.vaf["total"], "torque" if result.angular else "force"
    if result.servo == "force":
        share, of = result.vaf["movement"], "movement"
    if share >= MOST:
        return ""
    return (
        f"the cascade leaves {100.0 - share:.0f} % of the variance of the {of}, more than it explains, and all of that "
        "is taken to be noise that has nothing to do with the perturbation: compare what was recorded and what is "
        "predicted, and leave out what is not valid (limit_time of the sidecar)"
    )


def _frequencies(result: "JointIdentification") -> int:
    """At how many frequencies the movement has power, as far as the spectrum resolves them.

    The first trial's movement is counted where the model has it without noise; the bands in which a lack of fit is
    looked for are those of all trials, which may have a frequency each, and count where they are more.
    """
    trace = result.trace
    moved = trace.predicted if result.servo == "force" else trace.paths["intrinsic"]
    # Beside a slow movement, what is small and fast shows in the differences.
    return max(_peaks(moved), _peaks(np.diff(moved)), result.lack_of_fit.dof // 2)


def _peaks(values: Array) -> int:
    """Frequencies at which a signal has power, as far as its spectrum resolves them."""
    tapered = (values - values.mean()) * signal.windows.hann(len(values), sym=False)
    power = np.abs(fft.rfft(tapered)) ** 2
    count, after = 0, 0
    for line in np.flatnonzero(power > EXCITED_POWER * power.max()):
        if line >= after:
            count, after = count + 1, int(line) + RESOLUTION
    return count
