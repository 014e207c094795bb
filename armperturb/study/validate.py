"""Monte-Carlo judgement of the estimators, on synthetic people whose truth is known.

Groups of trials are simulated and identified again and again. What an estimator gives is compared with the truth, its error
with the Cramer-Rao bound (of all that the trials hold), and its intervals with how often they hold the truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import stats

from armperturb.analysis.arm_model import parameter_vector
from armperturb.analysis.fit import fit_admittance
from armperturb.analysis.body import body_of
from armperturb.analysis.maximum_likelihood import Group, Method, estimate
from armperturb.analysis.spectra import estimate_spectra, line_spectra
from armperturb.analysis.structures import STRUCTURES, Structure, unit
from armperturb.controllers.remnant import HUMAN_NOISE, HumanNoise
from armperturb.environment import Environment
from armperturb.envs.experiment import Trial, run_experiment
from armperturb.envs.instruments import Instruments
from armperturb.perturbations import Multisine
from armperturb.study.protocol import trial_seed
from armperturb.subject import POSITION, RELAX, TASKS, Subject
from armperturb.validation import require_number

Array = NDArray[np.float64]
Row = dict[str, Any]

Wrong = Literal["nothing", "delay", "force feedback", "grip"]
"""What is wrong on purpose with the structure that is fitted."""

ESTIMATORS = ("thesis", "frequency", "record")

RMS_FORCE = {"PT": 5.4, "RT": 0.9}
"""Published RMS force per axis in PT7.5 and RT7.5 [N] (table 2.1)."""

DURATION = 32.0
"""Of a trial [s], as the multisine of section 2.4."""

WRONG_DELAY = 0.010
"""By how much the fixed delay is off [s]."""

WRONG_GRIP = 0.8
"""Fixed over true grip stiffness [-]."""

FORCE_FEEDBACK = -0.5
"""Gain of the inhibition by tendon organs that the structure leaves out [-]; the published ones are near it (C.8)."""

SAME_OPTIMUM = 0.5
"""Twice the log likelihood by which a fit may miss the one that starts at the truth [-]: far below what any datum tells."""


@dataclass(frozen=True, kw_only=True)
class ValidateSettings:
    """What a validation is made of.

    Attributes:
      task: "PT" or "RT": whose preset is perturbed, in the manner of PT7.5 or RT7.5.
      subject: TOML file of who is perturbed instead; its task is used.
      model: structure that is fitted, see `armperturb.analysis.structures`; what it fixes is fixed at the truth.
      groups: how often it all is repeated.
      trials: that are identified together.
      estimators: of `ESTIMATORS`, those that are judged.
      noise: factor on the person's noise; 0 leaves the instruments' alone.
      force: RMS force of the multisine, per axis [N]; the published one of the task if None.
      wrong: what is wrong on purpose.
      multibody: whether MuJoCo's arm is perturbed, which moves in a circle; the linear one if not, for which the
        structure is exactly right.
      seed: of everything random.

    Raises:
      TypeError: a value has the wrong type.
      ValueError: a value is out of its range.
    """

    task: str = "PT"
    subject: Path | None = None
    model: str = "3b"
    groups: int = 40
    trials: int = 8
    estimators: tuple[str, ...] = ESTIMATORS
    noise: float = 1.0
    force: float | None = None
    wrong: Wrong = "nothing"
    multibody: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if self.task not in TASKS:
            raise ValueError(f"validate: task = {self.task!r}; expected one of {', '.join(TASKS)}")
        if self.model not in STRUCTURES:
            raise ValueError(f"validate: model = {self.model!r}; expected one of {', '.join(STRUCTURES)}")
        for name in ("groups", "trials"):
            require_number("validate", name, getattr(self, name), at_least=1)
        for name in self.estimators:
            if name not in ESTIMATORS:
                raise ValueError(f"validate: estimators = {name!r}; expected some of {', '.join(ESTIMATORS)}")
        require_number("validate", "noise", self.noise, at_least=0.0)
        if self.force is not None:
            require_number("validate", "force", self.force, above=0.0)
        if self.wrong not in get_args(Wrong):
            raise ValueError(f"validate: wrong = {self.wrong!r}; expected one of {', '.join(get_args(Wrong))}")
        require_number("validate", "seed", self.seed, at_least=0)

    def truth(self) -> Subject:
        """Who is perturbed.

        Raises:
          ValueError: the file is refused.
          OSError: the file cannot be read.
        """
        subject = Subject.load(self.subject) if self.subject else {"PT": POSITION, "RT": RELAX}[self.task]
        if self.wrong == "force feedback":
            subject = replace(subject, kf_s=FORCE_FEEDBACK, kf_e=FORCE_FEEDBACK)
        return subject

    def structure(self) -> Structure:
        """What is fitted: the model, with what it fixes at the truth but for what is wrong on purpose."""
        truth, structure = self.truth(), STRUCTURES[self.model]
        values = {name: getattr(truth, name) for name in structure.fixed[truth.task]}
        if self.wrong == "delay":
            values |= {name: getattr(truth, name) + WRONG_DELAY for name in ("Td_s", "Td_e")}
        elif self.wrong == "force feedback":
            values |= {name: 0.0 for name in ("kf_s", "kf_se", "kf_e")}
        elif self.wrong == "grip":
            values["k_h"] = WRONG_GRIP * truth.k_h
        return structure.fixing(**values).named(structure.name) if values else structure


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """One estimator on one group of trials.

    Attributes:
      values: estimates, (parameter,), SI.
      error: standard errors, (parameter,), SI.
      covered: whether the 95 % intervals hold the truth, (parameter,).
      converged: whether the search ended at an optimum.
      stable: whether the arm is stable.
      is_global: whether no better optimum is found from the truth.
      suspicious: whether the estimator itself says that the structure is wrong; None if it cannot.
    """

    values: Array
    error: Array
    covered: NDArray[np.bool_]
    converged: bool
    stable: bool
    is_global: bool
    suspicious: bool | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Validation:
    """What came out.

    Attributes:
      settings: what was done.
      names: of the free parameters.
      truth: their true values, (parameter,), SI.
      bound: Cramer-Rao bound of their standard deviation from the whole records, (parameter,), SI.
      judged: estimator to one entry per group.
    """

    settings: ValidateSettings
    names: tuple[str, ...]
    truth: Array
    bound: Array
    judged: dict[str, tuple[Judged, ...]]

    def rows(self) -> list[Row]:
        """Bias, error, bound and coverage per estimator and parameter."""
        rows = []
        for estimator, judged in self.judged.items():
            deviation = np.array([one.values for one in judged]) - self.truth
            rms = np.sqrt(np.mean(deviation**2, axis=0))
            for column, name in enumerate(self.names):
                scale = 100.0 / abs(self.truth[column]) if self.truth[column] else np.nan
                rows.append(
                    {
                        "estimator": estimator,
                        "parameter": name,
                        "unit": unit(name),
                        "true": float(self.truth[column]),
                        "bias": float(deviation[:, column].mean()),
                        "rms_error": float(rms[column]),
                        "rms_error_percent": float(scale * rms[column]),
                        "bound": float(self.bound[column]),
                        "rms_error_over_bound": float(rms[column] / self.bound[column]),
                        "mean_standard_error": float(np.mean([one.error[column] for one in judged])),
                        "coverage_percent": 100.0 * float(np.mean([one.covered[column] for one in judged])),
                    }
                )
        return rows

    def summary(self) -> list[Row]:
        """How the fits went, per estimator."""
        rows = []
        for estimator, judged in self.judged.items():
            deviation = np.array([one.values for one in judged]) - self.truth
            biased = np.max(np.abs(deviation) / np.array([one.error for one in judged]), axis=1) > 2.0
            flagged = [one.suspicious for one in judged]
            rows.append(
                {
                    "estimator": estimator,
                    "groups": len(judged),
                    "converged_percent": 100.0 * float(np.mean([one.converged for one in judged])),
                    "stable_percent": 100.0 * float(np.mean([one.stable for one in judged])),
                    "global_percent": 100.0 * float(np.mean([one.is_global for one in judged])),
                    "pooled_coverage_percent": 100.0 * float(np.mean([one.covered for one in judged])),
                    "median_error_over_bound": float(np.median(np.sqrt(np.mean(deviation**2, axis=0)) / self.bound)),
                    "flagged_percent": 100.0 * float(np.mean([bool(one) for one in flagged]))
                    if None not in flagged
                    else np.nan,
                    "flagged_of_biased_percent": 100.0 * float(np.mean(np.array(flagged, dtype=bool)[biased]))
                    if None not in flagged and biased.any()
                    else np.nan,
                }
            )
        return rows


def run_group(settings: ValidateSettings, number: int) -> tuple[int, dict[str, Judged], Array]:
    """Simulate and identify one group of trials.

    Args:
      settings: what to do.
      number: of the group, from 0; it and the settings determine everything.

    Returns:
      The number, estimator to what it made of the group, and the Fisher information at the truth.
    """
    truth, structure = settings.truth(), settings.structure()
    recording = run_experiment(
        [_trial(settings, truth, number, trial) for trial in range(settings.trials)],
        linear=not settings.multibody,
        instruments=Instruments(marker_noise=None, emg=None),
        n_threads=1,
    )
    body = body_of(recording)
    group = Group.prepare(recording, body, structure)
    values = true_values(truth, structure)
    group.record.weigh(structure.parameters(truth.task, values))
    information = group.record.normal(structure.parameters(truth.task, values), structure.mixing).information
    judged = {}
    for estimator in settings.estimators:
        if estimator == "thesis":
            judged[estimator] = _by_thesis(recording, body, structure, group.environment, values)
        else:
            judged[estimator] = _by_likelihood(group, estimator, values)
    return number, judged, information


def true_values(truth: Subject, structure: Structure) -> Array:
    """Values of a structure's free parameters that are nearest to an arm, (parameter,), SI."""
    fixed = structure.parameters(truth.task, np.zeros(len(structure.free)))
    free = structure.mixing.any(axis=1)
    return np.linalg.lstsq(structure.mixing[free], (parameter_vector(truth) - fixed)[free], rcond=None)[0]


def collect(settings: ValidateSettings, results: Sequence[tuple[int, dict[str, Judged], Array]]) -> Validation:
    """What `run_group` gave of every group, together."""
    ordered = sorted(results, key=lambda result: result[0])
    structure = settings.structure()
    information = np.mean([one for _, _, one in ordered], axis=0)
    return Validation(
        settings=settings,
        names=structure.free,
        truth=true_values(settings.truth(), structure),
        bound=np.sqrt(np.diag(np.linalg.inv(information))),
        judged={name: tuple(judged[name] for _, judged, _ in ordered) for name in settings.estimators},
    )


def _trial(settings: ValidateSettings, truth: Subject, group: int, number: int) -> Trial:
    force = RMS_FORCE[truth.task] if settings.force is None else settings.force
    rng = np.random.default_rng(trial_seed(settings.seed, "validate multisine", group, number))
    return Trial(
        subject=truth,
        perturbation=replace(Multisine.draw(seed=rng, rms=force, crested=False), duration=DURATION),
        condition=f"{truth.task}7.5",
        repetition=number,
        seed=trial_seed(settings.seed, "validate trial", group, number),
        noise=_scaled(HUMAN_NOISE[truth.task], settings.noise),
    )


def _scaled(noise: HumanNoise, factor: float) -> HumanNoise:
    """The same noise, so many times stronger, of a person who is the same in all trials: else there is no one truth."""
    louder = {
        name: factor * getattr(noise, name)
        for name in ("remnant_share", "remnant_floor", "voluntary_share", "voluntary_floor")
    }
    return replace(noise, **louder, spread_b=0.0, spread_k=0.0, spread_kv=0.0, spread_kp=0.0)


def _by_likelihood(group: Group, method: Method, truth: Array) -> Judged:
    found = estimate([group], method)
    lower, upper = np.array(list(group.structure.bounds.values())).T
    names = group.structure.free
    inside = {name: float(value) for name, value in zip(names, np.clip(truth, lower, upper), strict=True)}
    from_truth = estimate([group], method, start=inside)
    values, error = np.array([*found.values.values()]), np.array([*found.standard_error.values()])
    return Judged(
        values=values,
        error=error,
        covered=np.array(
            [found.interval(name).lower <= true <= found.interval(name).upper for name, true in zip(names, truth, strict=True)]
        ),
        converged=found.converged,
        stable=found.stable,
        is_global=found.objective <= from_truth.objective + SAME_OPTIMUM,
        suspicious=found.is_suspicious,
    )


def _by_thesis(
    recording: xr.Dataset, body: Subject, structure: Structure, environment: Environment, truth: Array
) -> Judged:
    """Each trial alone, averaged as published; intervals from the mean of the standard errors of eq. 2.22."""
    fits = []
    for trial in range(recording.sizes["trial"]):
        spectra = estimate_spectra(line_spectra(recording.isel(trial=[trial])))
        fits.append(
            fit_admittance(
                spectra.frequency, spectra.arm, body, structure, environment, coherence=spectra.coherence, delay="pade"
            )
        )
    values = np.mean([[*fit.values.values()] for fit in fits], axis=0)
    error = np.mean([[*fit.sem.values()] for fit in fits], axis=0)
    half = stats.norm.ppf(0.975) * error
    return Judged(
        values=values,
        error=error,
        covered=np.abs(values - truth) <= half,
        converged=all(fit.converged for fit in fits),
        stable=all(fit.stable for fit in fits),
        is_global=all(fit.n_starts_agree == fit.n_starts for fit in fits),
        suspicious=None,
    )
