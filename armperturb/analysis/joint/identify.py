"""Identification of a joint: structure chosen by left-out data, parameters with intervals, and held-out prediction."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import xarray as xr

from armperturb.analysis.cuts import inside_limit, one_condition
from armperturb.analysis.fit.whittle import LackOfFit
from armperturb.analysis.joint.choice import ScoredStructure, score_of, sentence_of, structures
from armperturb.analysis.joint.estimate import JointEstimate, Profile, estimate_joint, likelihood_profiles
from armperturb.analysis.joint.intrinsic import IntrinsicCheck, check_intrinsic
from armperturb.analysis.joint.likelihood import Loop, environment_of, simulated_movement
from armperturb.analysis.joint.model import (
    LONGEST_DELAY,
    REFLEXES,
    THRESHOLD,
    UNITS,
    JointModel,
    JointStructure,
    Reflex,
)
from armperturb.analysis.joint.odd_trials import odd_trials
from armperturb.analysis.joint.part_differences import PartDifferences, part_differences
from armperturb.analysis.joint.prediction import FreeModel, explained, fit_free_model
from armperturb.analysis.joint.remarks import remarks_on
from armperturb.analysis.joint.signals import SHORTEST, JointSignals, joint_signals, mean_angle
from armperturb.analysis.joint.torque_likelihood import band_of
from armperturb.analysis.joint.trial_differences import trial_differences
from armperturb.analysis.joint_balance import standing_still, wrong_joint
from armperturb.analysis.results import Description, FitResult, Interval, parameter_table, quantile
from armperturb.arrays import Array
from armperturb.copied_trials import without_copies
from armperturb.recording import check_recording, named
from armperturb.validation import require_number, require_one_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class TriedStructure(NamedTuple):
    """A structure that was fitted.

    Attributes:
      estimate: with it.
      score: see `choice.ScoredStructure`.
    """

    estimate: JointEstimate
    score: float


class Trace(NamedTuple):
    """What was recorded and what is predicted of one trial.

    Attributes:
      time: [s], (time,).
      recorded: torque of a position servo, angle of a force servo, (time,).
      predicted: the same, from the input alone, (time,).
      paths: path to its torque, (time,).
    """

    time: Array
    recorded: Array
    predicted: Array
    paths: Mapping[str, Array]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class JointIdentification(FitResult):
    """A joint that was identified from the trials of one condition.

    Attributes:
      label: who, in which condition, how many trials.
      subject: who.
      condition: of the trials.
      joint: its name; empty if unknown.
      servo: "force" or "position".
      angular: whether it is a joint, or a single direction.
      structure: that was chosen, or asked for.
      tried: all structures that were fitted, the best first.
      vaf: of the fitted trials, by the parallel cascade and by each path alone [%].
      free_model: for prediction; None of a force servo.
      intrinsic: the intrinsic path without a structure; None of a force servo.
      held_out: kind of model to the VAF of what follows `fit_until`, from the input alone [%]; empty without.
      fit_until: end of what was fitted [s]; None for all.
      environment: inertia, damping and stiffness of a force servo's virtual environment; None of a position servo.
      lack_of_fit: whether the structure leaves something that a linear response to the servo's input explains.
      trial_spread: "damping", "stiffness" and others to the standard deviation over trials of the factor by which it
        differs [-]; without those that do not differ.
      faults: what is wrong with signals, or with those of single trials, a sentence each; mostly nothing.
      parts: how parts of the trials differ.
      top: frequency up to which the movement counts [Hz].
      beyond: power of the velocity next above that, over its power below [-], see `signals.JointSignals`.
      profiles: parameter of the reflex path to the profile of its likelihood; of a force servo only that of the delay.
      band: of the frequencies that count [Hz].
      trace: of the first trial.
    """

    label: str
    subject: str
    condition: str
    joint: str
    servo: str
    angular: bool
    structure: JointStructure
    tried: tuple[TriedStructure, ...]
    vaf: Mapping[str, float]
    free_model: FreeModel | None
    intrinsic: IntrinsicCheck | None
    held_out: Mapping[str, float]
    fit_until: float | None
    environment: Loop | None
    lack_of_fit: LackOfFit
    trial_spread: Mapping[str, float]
    faults: tuple[str, ...]
    parts: PartDifferences
    top: float
    beyond: float
    profiles: Mapping[str, Profile]
    band: tuple[float, float]
    trace: Trace

    @property
    def predicted_by(self) -> str:
        """Model of the held-out prediction: that which predicts better within what was fitted.

        The free model is judged on blocks that its fits left out, the cascade on what it was fitted to. With its few
        parameters that favours it by some 5 % of what noise leaves: by 0.1 to 1 % VAF at 15 to 5 dB, within which
        either will do.
        """
        free = self.free_model is not None and self.free_model.left_out_vaf > self.vaf["total"]
        return "free" if free else "cascade"

    @property
    def held_out_vaf(self) -> float | None:
        """VAF of what was not fitted, simulated from the input alone [%]; None without."""
        return self.held_out.get(self.predicted_by)

    def interval(self, name: str, level: float = 0.95) -> Interval:
        """Confidence interval of a parameter.

        Those of the reflex path are intervals of the profile likelihood on a position servo, as its delay, dynamics and
        threshold enter nonlinearly; others follow from the standard error.

        Args:
          name: of the parameter, as in `values`.
          level: probability with which such intervals hold the true value [-].
        """
        if self.servo == "force" or name not in self.profiles:
            return super().interval(name, level)
        lower, upper = self.profiles[name].interval(quantile(level, self.degrees_of_freedom.get(name, math.inf)))
        # Where noise and parameters do not settle together, the profile is lowest away from the estimate.
        return Interval(min(lower, self.values[name]), max(upper, self.values[name]))

    def unit_of(self, name: str) -> str:
        """Unit of a parameter."""
        return UNITS[name][0 if self.angular else 1]

    def place_of(self, name: str) -> tuple[str, str]:
        """Name of a parameter, and the condition."""
        return name, self.condition

    @property
    def labels(self) -> dict[str, str]:
        """The subject, and the joint."""
        return {"subject": self.subject, "joint": self.joint}

    @property
    def sentence(self) -> str:
        """What was chosen, and how clearly."""
        return sentence_of([ScoredStructure(each.estimate.structure, each.score) for each in self.tried])

    @property
    def differing(self) -> str:
        """What differs from trial to trial, in words; empty if nothing does."""
        each = [f"{name.replace('_', ' ')} {spread:.1%}" for name, spread in self.trial_spread.items()]
        return f"SD over trials: {', '.join(each)}; intervals are of the mean over trials" if each else ""

    def describe(self) -> Description:
        """Parameters, how the structure was chosen, and how well it predicts."""
        shares = ", ".join(f"{name} {share:.1f} %" for name, share in self.vaf.items())
        facts = [self.sentence, f"VAF of the fitted trials: {shares}"]
        if self.trial_spread:
            facts.append(self.differing)
        if self.held_out:
            each = ", ".join(f"{name} {share:.1f} %" for name, share in self.held_out.items())
            facts.append(f"VAF after {self.fit_until:g} s, from the input alone: {each}")
        return Description(
            title=("Joint" if self.angular else "One direction")
            + f" of {self.label}"
            + (f" ({self.joint})" if self.joint else "")
            + f", {self.servo} servo",
            facts=tuple(facts),
            table=parameter_table(self.to_frame()),
            remarks=self.remarks,
        )

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw recorded and predicted torque (or angle), the paths, and the profile of the delay.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (2,), and a third of the profile where there is a reflex.
        """
        from armperturb.plots.joints import plot_joint

        quantity = ("torque [Nm]", "angle [rad]") if self.angular else ("force [N]", "displacement [m]")
        return plot_joint(
            self.trace,
            self.profiles.get("reflex_delay"),
            self.fit_until,
            quantity[self.servo == "force"],
            quantity[0],
            quantile(0.95, self.degrees_of_freedom.get("reflex_delay", math.inf)) ** 2,
            figure,
        )


def identify_joint(
    recording: xr.Dataset,
    *,
    reflex: Reflex | None = None,
    short_range: bool = False,
    fit_until: float | None = None,
    longest_delay: float = LONGEST_DELAY,
) -> JointIdentification:
    """Identify intrinsic and reflex path of a joint from torque and angle.

    Args:
      recording: trials of one axis, of one person in one condition. Short segments and ensembles are taken as they are.
        Trials that met the limit of the workspace count only if there are no others, up to then.
      reflex: "none", "linear" or "half-wave"; None to let left-out data choose.
      short_range: whether the intrinsic path has short-range stiffness.
      fit_until: time up to which trials are fitted [s]; what follows is predicted from the input alone. None for all.
      longest_delay: of the reflex [s].

    Raises:
      TypeError: a number is none.
      ValueError: the recording is refused, of two axes, of several people, tasks or conditions, or too short, or an
        option is out of its range.
    """
    check_recording(recording)
    require_one_of("identify", "reflex", reflex, (None, *REFLEXES))
    values = one_condition([recording])
    each_once = without_copies(recording)
    (recording,), left_out = inside_limit([each_once])
    rate = float(recording.attrs["rate"])
    duration = recording.sizes["time"] / rate
    require_number("identify", "fit_until", fit_until, at_least=SHORTEST, at_most=duration - 1.0, optional=True)
    require_number("identify", "longest_delay", longest_delay, at_least=0.01)
    if longest_delay > 0.25 * duration:
        raise ValueError(
            f"identify: longest_delay = {longest_delay:g} s; expected at most a quarter of the record, which lasts "
            f"{duration:.3g} s"
        )
    fitted = recording if fit_until is None else recording.isel(time=slice(0, round(fit_until * rate)))
    reference = mean_angle(fitted)
    signals = joint_signals(fitted, reference=reference)
    loop = environment_of(signals) if signals.servo == "force" else None
    tried = _tried(signals, loop, reflex, short_range, longest_delay)
    best = tried[0].estimate
    free = fit_free_model(signals) if loop is None else None
    intrinsic = check_intrinsic(signals, _reflex_torque(signals, best)) if loop is None else None
    every = joint_signals(recording, reference=reference)
    model = JointModel(best.structure, signals)
    names = best.structure.parameters
    differences = trial_differences(best, signals, loop)
    covariance, dof = best.covariance + differences.added, differences.degrees_of_freedom
    error = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore"):
        correlation = covariance / np.outer(error, error)
    at_bound = tuple(name for name, bound in zip(names, best.at_bound, strict=True) if bound)
    wrong, notes = wrong_joint(recording)
    angular = recording["displacement"].attrs["units"] == "rad"
    odd = odd_trials(best, signals, loop).sentence(angular=angular)
    faults = tuple(filter(None, [wrong, *standing_still(recording), odd]))
    result = JointIdentification(
        values=dict(zip(names, map(float, best.values), strict=True)),
        standard_error=dict(zip(names, map(float, error), strict=True)),
        correlation=correlation,
        degrees_of_freedom={name: float(each) for name, each in zip(names, dof, strict=True) if np.isfinite(each)},
        at_bound=at_bound,
        converged=best.converged,
        message="converged" if best.converged else "the rounds of weighing did not settle",
        remarks=(*each_once.remarks, *faults, *notes, *left_out),
        label=named(recording),
        subject=str(values["subject"]),
        condition=str(values["condition"]),
        joint=str(recording.attrs.get("joint", "")),
        servo=signals.servo,
        angular=angular,
        structure=best.structure,
        tried=tuple(tried),
        vaf=_shares(signals, model, best.values, loop),
        free_model=free,
        intrinsic=intrinsic,
        held_out={} if fit_until is None else _held_out(every, best, loop, free, fit_until),
        fit_until=fit_until,
        environment=loop,
        lack_of_fit=best.lack,
        trial_spread=differences.spread,
        faults=faults,
        parts=part_differences(best, signals, loop),
        top=signals.top,
        beyond=signals.beyond,
        profiles=_profiles(best, differences.added, signals, loop, longest_delay),
        band=band_of(signals),
        trace=_trace(every, best, loop, free),
    )
    return replace(result, remarks=(*result.remarks, *remarks_on(result, len(signals.angle))))


def _tried(
    signals: JointSignals, loop: Loop | None, reflex: Reflex | None, short_range: bool, longest_delay: float
) -> list[TriedStructure]:
    estimates = [
        estimate_joint(each, signals, loop, longest_delay=longest_delay)
        for each in structures(reflex, short_range=short_range)
    ]
    scored = [
        TriedStructure(each, score_of(each.structure, each.objective, each.loss))
        for each in estimates
        if reflex is not None or not _is_hardly_half(each)
    ]
    return sorted(scored, key=lambda each: each.score)


def _is_hardly_half(estimate: JointEstimate) -> bool:
    """Whether a half-wave's threshold is so low that it passes nearly all of the movement, as a linear reflex does.

    Where the joint does more than the model has, what such a half-wave cuts off fits by chance.
    """
    if THRESHOLD not in estimate.structure.parameters:
        return False
    place = estimate.structure.parameters.index(THRESHOLD)
    return bool(estimate.at_bound[place] and estimate.values[place] < 0.0)


def _reflex_torque(signals: JointSignals, best: JointEstimate) -> Array:
    """Torque of the reflex path, (trial, time); zero without one."""
    paths = JointModel(best.structure, signals).paths(best.values)
    return paths.get("reflex", np.zeros_like(signals.torque))


def _shares(signals: JointSignals, model: JointModel, values: Array, loop: Loop | None) -> dict[str, float]:
    """VAF of the torque by the whole model and by each path; of the movement too on a force servo."""
    paths = model.paths(values)
    used = signals.used
    shares = {"total": explained(signals.torque[:, used], model.torque(values)[:, used])}
    shares |= {name: explained(signals.torque[:, used], path[:, used]) for name, path in paths.items()}
    if loop is not None:
        moved = simulated_movement(model.structure, values, signals, loop)
        shares["movement"] = explained(signals.angle[:, used], moved.angle[:, used])
    return shares


def _predictions(
    signals: JointSignals, best: JointEstimate, loop: Loop | None, free: FreeModel | None
) -> tuple[Array, dict[str, Array]]:
    """What was recorded, and kind of model to its prediction from the input alone, (trial, time) each."""
    if loop is not None:
        return signals.angle, {"cascade": simulated_movement(best.structure, best.values, signals, loop).angle}
    predicted = {"cascade": JointModel(best.structure, signals).torque(best.values)}
    if free is not None:
        predicted["free"] = free.torque(signals)
    return signals.torque, predicted


def _held_out(
    signals: JointSignals, best: JointEstimate, loop: Loop | None, free: FreeModel | None, fit_until: float
) -> dict[str, float]:
    recorded, predicted = _predictions(signals, best, loop, free)
    part = slice(round(fit_until * signals.rate), signals.used.stop)
    return {name: explained(recorded[:, part], each[:, part]) for name, each in predicted.items()}


def _trace(signals: JointSignals, best: JointEstimate, loop: Loop | None, free: FreeModel | None) -> Trace:
    recorded, predicted = _predictions(signals, best, loop, free)
    used = signals.used
    paths = JointModel(best.structure, signals).paths(best.values)
    one_trial = predicted["cascade"][0, used]
    offset = recorded[0, used].mean() - one_trial.mean()
    return Trace(
        time=(np.arange(signals.angle.shape[1]) / signals.rate)[used],
        recorded=recorded[0, used],
        predicted=one_trial + offset,
        paths={name: path[0, used] for name, path in paths.items()},
    )


def _profiles(
    best: JointEstimate, added: Array, signals: JointSignals, loop: Loop | None, longest_delay: float
) -> dict[str, Profile]:
    names = [name for name in best.structure.parameters if name.startswith("reflex_")]
    free = [name for name, bound in zip(best.structure.parameters, best.at_bound, strict=True) if not bound]
    wanted = [name for name in (names if loop is None else names[1:2]) if name in free]
    return likelihood_profiles(best, signals, loop, wanted, added=added, longest_delay=longest_delay)
