"""What a reader is told first: whether to trust a fit, why it may be wrong, and what the data cannot tell."""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from armperturb.analysis.defaults import FEWEST_TRIALS
from armperturb.analysis.fit.diagnosis import Diagnosis
from armperturb.analysis.fit.emg_likelihood import FEW_WITH_EMG, UNTIMELY
from armperturb.analysis.fit.frequency_bands import BandOfLack
from armperturb.analysis.fit.identification import Identification
from armperturb.analysis.fit.maximum_likelihood import LARGE_LACK, SKEWED, SUSPICIOUS, UNLIKE, Estimate
from armperturb.analysis.fit.trial_effects import ASSUMED
from armperturb.analysis.fit.whittle import LackOfFit
from armperturb.analysis.imbalance import Imbalance, Kind
from armperturb.analysis.page.data_check import DataCheck
from armperturb.analysis.response.best_linear import BestLinear
from armperturb.analysis.results import FitResult, limits_of, plain
from armperturb.pages.formats import chance
from armperturb.recording import LABELS

REFLEXES = (1.5, 6.0)
"""Frequencies at which reflexes act most [Hz]; above, inertia and grip do."""

SUPPORTED = 0.4
"""Share of the lack of fit at a cause's frequencies from which on these support it [-]."""

BEYOND, FAR_BEYOND = 2.0, 10.0
"""Standard errors of the best-known parameter from which on an error is beyond its interval, and far beyond [-]."""

LARGE_BIAS = 0.05
"""Error of the arm's impedance below which parameters that are that far off can still be used with care [-]."""

BODY = ("i_", "m_", "b_", "k_", "b.", "k.")
"""How the names of inertia, damping and stiffness start, which are in proportion to the impedance."""

REMEDIES: dict[Kind, str] = {
    "gain": "Check the sign of the force; calibrate the gauge and the perturbation.",
    "gains": "Calibrate the gauge, axis by axis.",
    "crosstalk": "Calibrate the sensor with a matrix, which takes what leaks from one axis into the other off.",
    "rotation": "Turn the force into the axes of the other signals (signals.force.axes, if it is by right angles).",
    "displacement axes": "Turn x and y of the displacement into the axes of the other signals.",
    "perturbation axes": "Turn x and y of the perturbation into the axes of the other signals.",
    "load": "Make the manipulator alike in all directions: a mass, damping and stiffness.",
    "unknown": "Pass all signals through the same filters, and check each sensor.",
}
"""What helps; against a delay, one clock does."""

ONE_CLOCK = "Record all signals by one clock and through one filter."

INCOHERENT = 0.5
"""Coherence below which noise dominates [-]."""


class Verdict(NamedTuple):
    """Whether to trust the parameters of one condition.

    Attributes:
      level: in a word.
      text: why, in a sentence or two.
    """

    level: Literal["trust", "care", "reject"]
    text: str


class Cause(NamedTuple):
    """Why a fit may be wrong.

    Attributes:
      name: of the cause.
      evidence: what the data say of it.
      remedy: what to check or to try.
      supported: whether the data speak for it; None if they do not tell.
    """

    name: str
    evidence: str
    remedy: str
    supported: bool | None


def verdict(identification: Identification, bands: Sequence[BandOfLack], imbalance: Imbalance | None = None) -> Verdict:
    """Whether to trust the parameters of one condition.

    Args:
      identification: of the condition.
      bands: its lack of fit, which counts where the fit is of several conditions together.
      imbalance: what is wrong with its signals, which no lack of fit need show; None where nothing is.
    """
    of_fit = _of_fit(identification, bands)
    untimely = next((remark for remark in identification.fit.remarks if remark.startswith(UNTIMELY)), "")
    if untimely and of_fit.level == "trust":
        of_fit = Verdict("care", f"{untimely}. {of_fit.text}")
    return of_fit if imbalance is None else with_imbalance(of_fit, identification.fit, imbalance)


def with_imbalance(of_fit: Verdict, fit: FitResult, imbalance: Imbalance) -> Verdict:
    """Whether to trust parameters from signals of which something is wrong, see `verdict`.

    Args:
      of_fit: whether to trust the fit, were the signals right.
      fit: the parameters.
      imbalance: what is wrong with the signals.
    """
    errors = imbalance.bias / _best_known(fit)
    if not (errors > BEYOND or math.isfinite(imbalance.delay)):
        return of_fit
    is_far = errors > FAR_BEYOND and imbalance.bias > LARGE_BIAS
    wrong = f"{imbalance.text[0].upper()}{imbalance.text[1:]}"
    by = f", {errors:.2g} standard errors of the best-known parameter" if errors else ""  # no intervals, no errors
    return Verdict("reject" if is_far or of_fit.level == "reject" else "care", f"{wrong}{by}. {of_fit.text}")


def _best_known(fit: FitResult) -> float:
    """Smallest relative standard error of inertia, damping and stiffness [-]; infinite if none is known."""
    errors = (
        fit.standard_error[name] / abs(value) for name, value in fit.values.items() if name.startswith(BODY) and value
    )
    return min((error for error in errors if error > 0.0), default=math.inf)


def _of_fit(identification: Identification, bands: Sequence[BandOfLack]) -> Verdict:
    """Whether the model explains the movement."""
    fit = identification.fit
    if not fit.converged:
        return Verdict("reject", f"The search did not end at an optimum ({fit.message}).")
    if not fit.stable:
        return Verdict("reject", "The estimated arm is unstable on the manipulator, which the recorded one was not.")
    if not isinstance(fit.detail, Estimate):
        return Verdict("care", "The thesis's estimator gives no test of fit: judge by the variance accounted for.")
    lack = LackOfFit(fit.detail.chi2, fit.detail.dof)
    if fit.detail.doubts_emg:
        level: Literal["care", "reject"] = "reject" if lack.chi2 > LARGE_LACK * lack.dof else "care"
        return Verdict(level, f"{UNLIKE} ({numbers_of(lack)}). Rely on a fit without --emg.")
    if len(fit.detail.arms) > 1:
        lack = LackOfFit(sum(band.chi2 for band in bands), max(8 * len(bands) - len(fit.values), 1))
    ratio, numbers = lack.chi2 / lack.dof, numbers_of(lack)
    if lack.p_value >= SUSPICIOUS:
        return Verdict("trust", f"The model explains the movement as far as the noise lets one see ({numbers}).")
    if ratio <= LARGE_LACK and fit.choice is None:
        return Verdict(
            "care",
            f"The perturbation explains slightly more of the movement than the model does ({numbers}). Intervals are "
            f"{plain(math.sqrt(fit.detail.dispersion), 3)} times as wide as noise alone makes them.",
        )
    wrong = "the model is wrong" if fit.choice is None else "none of the structures that were tried is right"
    more = "The perturbation explains more of the movement than the model does"
    return Verdict("reject", f"{more} ({numbers}): {wrong}.")


def numbers_of(lack: LackOfFit) -> str:
    """A lack of fit in numbers."""
    p = lack.p_value
    p_value = f"p {'' if p < 1e-3 else '= '}{chance(p)}"
    return f"lack of fit over its degrees of freedom {plain(lack.chi2 / lack.dof, 3)}, {p_value}"


def likely_causes(
    identification: Identification, check: DataCheck, diagnosis: Diagnosis, distortion: BestLinear | None
) -> list[Cause]:
    """Why a fit may be wrong, in the order in which to look.

    Args:
      identification: of the condition.
      check: of its trials.
      diagnosis: what the arm leaves of them.
      distortion: best linear approximation; None where the trials do not allow one.
    """
    arm, bands = identification.fit.arm, diagnosis.bands
    above, middle = _share(bands, REFLEXES[1], math.inf), _share(bands, *REFLEXES)
    causes = []
    detail = identification.fit.detail
    if isinstance(detail, Estimate) and detail.doubts_emg:
        causes.append(
            Cause(
                "EMG",
                f"{UNLIKE}: the lack of fit is that of EMG more than that of the movement.",
                "Fit without --emg; check the muscles' joints and signs (signals.emg.muscles of the sidecar).",
                True,
            )
        )
    time, error = check.skew
    if check.imbalance is not None:
        late = math.isfinite(check.imbalance.delay)
        evidence = f"{check.imbalance.text[0].upper()}{check.imbalance.text[1:]}."
        remedy = ONE_CLOCK if late else REMEDIES[check.imbalance.kind]
        if check.imbalance.kind == "perturbation" and check.imbalance.delay < 0.0:
            lag = f"{1e3 * abs(check.imbalance.delay):.2f} ms"
            remedy += f" A command that is held between its samples acts later: delay it by {lag} in the file."
        causes.append(Cause("clocks" if late else "force balance", evidence, remedy, True))
    elif abs(time) > max(SKEWED, 3.0 * error):
        causes.append(
            Cause(
                "clocks",
                f"Force is recorded {1e3 * time:.2f} ms later than displacement (standard error {1e3 * error:.2f} ms), "
                "which turns inertia into damping.",
                "Record both by one clock.",
                True,
            )
        )
    free = set(identification.fit.values)
    fast = f"{above:.0%} of the lack of fit lies above {REFLEXES[1]:g} Hz, where inertia and grip act."
    slow = f"{middle:.0%} lies between {REFLEXES[0]:g} and {REFLEXES[1]:g} Hz, where reflexes act."
    causes += [
        _unless_free("inertia", fast, "Free the joint inertia: --fix m=0 --free i.", above, "i_s" in free),
        _unless_free("grip", fast, "Hold the grip rigid (--fix k_h=rigid), or free it.", above, "k_h" in free),
        Cause(
            "wrong geometry",
            f"Used: upper arm {arm.l_h:.3g} m, forearm {arm.l_f:.3g} m, shoulder {arm.theta_s_deg:.3g}°, elbow "
            f"{arm.theta_e_deg:.3g}°. The data do not tell these.",
            "Compare with the person: labels l_h, l_f, theta_s_deg and theta_e_deg of the sidecar.",
            None,
        ),
        _unless_free("delay", slow, "Free delays and cut-offs: --free Td fact.", middle, "Td_s" in free),
    ]
    last = nonlinearity(distortion)
    causes.insert(0 if last.supported else len(causes), last)
    return causes


def _unless_free(name: str, evidence: str, remedy: str, share: float, is_free: bool) -> Cause:
    if is_free:
        return Cause(name, f"{evidence} The model has it free already.", "Look elsewhere first.", False)
    return Cause(name, evidence, remedy, share > SUPPORTED)


def _share(bands: Sequence[BandOfLack], low: float, high: float) -> float:
    """Share of the lack of fit, beyond what noise makes, in bands whose middle is between two frequencies [-]."""
    excess = [(math.sqrt(band.low * band.high), max(band.chi2 - 8.0, 0.0)) for band in bands]
    total = sum(part for _, part in excess)
    return sum(part for middle, part in excess if low <= middle < high) / total if total else 0.0


def nonlinearity(distortion: BestLinear | None) -> Cause:
    """How nonlinear the arm is, where that is known."""
    remedy = "Identify a muscle law: --model nonlinear; or perturb less."
    if distortion is None:
        return Cause(
            "nonlinearity", "Only multisines in two or more trials tell how nonlinear the arm is.", remedy, None
        )
    shares = " and ".join(
        f"{max(share, 0.0):.1%} (± {error:.1%}) in {axis}"
        for axis, share, error in zip(LABELS["axis"], distortion.share, distortion.share_error, strict=True)
    )
    if distortion.p_value >= SUSPICIOUS:
        evidence = f"No distortion was found: of the response's power {shares}, p = {chance(distortion.p_value)}."
        return Cause("nonlinearity", evidence, remedy, False)
    clear = distortion.distortion > 2.0 * distortion.distortion_error
    where = " and ".join(
        f"{_listed(distortion.response.frequency[clear[:, axis]])} Hz in {name}"
        for axis, name in enumerate(LABELS["axis"])
        if clear[:, axis].any()
    )
    evidence = f"Distortion was found: of the response's power {shares}{f'; around {where}' if where else ''}."
    return Cause("nonlinearity", evidence, remedy, True)


def _listed(frequency: np.ndarray) -> str:
    return ", ".join(f"{value:.2g}" for value in frequency[:6]) + (" and more" if len(frequency) > 6 else "")


def unknowns(identification: Identification, check: DataCheck, undecided: Sequence[str] = ()) -> list[str]:
    """What the trials of a condition cannot tell, a sentence each.

    Args:
      identification: of the condition.
      check: of its trials.
      undecided: choices of structure that they leave open.
    """
    fit, spectra = identification.fit, identification.spectra
    said = [f"Which structure is right is open in this choice: {choice}." for choice in undecided]
    said += [f"{text}." for text in limits_of(fit)]
    low, high = spectra.frequency[0], spectra.frequency[-1]
    said.append(
        f"Below {plain(low, 2)} and above {plain(high, 3)} Hz nothing was perturbed: what is said there, static "
        "stiffness included, extends the model."
    )
    for axis, name in enumerate(LABELS["axis"]):
        poor = spectra.frequency[spectra.coherence[:, axis] < INCOHERENT]
        if len(poor):
            said.append(f"Around {_listed(poor)} Hz noise dominates the displacement along {name}.")
    if check.n_trials < FEWEST_TRIALS:
        made_of_it = f"assume {ASSUMED:.0%}" if FEW_WITH_EMG in fit.remarks else "ignore it"
        said.append(
            f"{check.n_trials} {'trial does' if check.n_trials == 1 else 'trials do'} not tell how much the person "
            f"differs from trial to trial, which {FEWEST_TRIALS} or more would: intervals {made_of_it}."
        )
    said.append(
        f"All holds for this posture (shoulder {fit.arm.theta_s_deg:.3g}°, elbow {fit.arm.theta_e_deg:.3g}°), and for "
        "movements as large as those recorded."
    )
    return said
