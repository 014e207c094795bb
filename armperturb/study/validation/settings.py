"""What a validation of the estimators is made of."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from armperturb.analysis.arm.linear_arm import LinearArm
from armperturb.analysis.arm.parameters import parameter_vector
from armperturb.analysis.defaults import Estimator
from armperturb.analysis.fit.joint_likelihood import require_informative
from armperturb.analysis.fit.structures import STRUCTURES, Structure, unit
from armperturb.analysis.fit.thesis import MODEL_3_WIDE
from armperturb.analysis.fit.truth import at_truth, true_values
from armperturb.environment import ENGINES, Environment
from armperturb.perturbations import CLUSTERS
from armperturb.perturbations.multisine import PERIOD
from armperturb.subject import POSITION, RELAX, TASKS, Subject
from armperturb.validation import require_one_of, require_ranges

Wrong = Literal["nothing", "delay", "force-feedback", "grip"]
"""What is wrong on purpose with the structure that is fitted."""

ESTIMATORS: tuple[Estimator, ...] = get_args(Estimator)

WRONG_DELAY = 0.010
"""By how much the fixed delay is off [s]."""

WRONG_GRIP = 0.8
"""Fixed over true grip stiffness [-]."""

FORCE_FEEDBACK = -0.5
"""Gain of the inhibition by tendon organs that the structure leaves out [-]; the published ones are near it (C.8)."""


@dataclass(frozen=True, kw_only=True)
class ValidateSettings:
    """What a validation is made of.

    Delay and cut-off, where they are free, have the bounds of table D.2, as the cut-off of 3.5 Hz is beyond those of
    table C.2.

    Raises:
      TypeError: a value has the wrong type.
      ValueError: a value is out of its range.
    """

    task: Literal["PT", "RT"] = "PT"
    """Task whose mean arm is perturbed, as in PT7.5 or RT7.5."""
    subject: Path | None = None
    """TOML file of the person who is perturbed instead, in that person's task."""
    model: Literal["1", "2", "3", "4", "5", "6", "3a", "3b"] = "3b"
    """Model structure that is fitted; parameters that it fixes are fixed at the truth."""
    groups: int = 40
    """Number of repetitions."""
    trials: int = 8
    """Number of trials that are identified together."""
    estimators: tuple[Estimator, ...] = ESTIMATORS
    """Estimators that are judged."""
    noise: float = 1.0
    """Factor on the person's noise; 0 leaves that of the instruments."""
    force: float | None = None
    """RMS force of the multisine per axis [N]; by default the published force of the task."""
    wrong: Wrong = "nothing"
    """Deliberate error of the structure: a delay that is 10 ms too long, no force feedback although the person has it,
    or a grip that is too soft."""
    multibody: bool = False
    """Perturb the arm that moves in a circle, and not the linear one, for which the structure is exact."""
    engine: Literal["mujoco", "compiled"] = "compiled"
    """What simulates the arm that moves in a circle; see `study`."""
    seed: int = 0
    """Seed of everything random."""

    def __post_init__(self) -> None:
        require_one_of("validate", "task", self.task, TASKS)
        require_one_of("validate", "model", self.model, tuple(STRUCTURES))
        require_ranges("validate", self)
        if not self.estimators or len(set(self.estimators)) < len(self.estimators):
            raise ValueError(f"validate: estimators = {self.estimators!r}; expected at least one, each once")
        for name in self.estimators:
            if name not in ESTIMATORS:
                raise ValueError(f"validate: estimators = {name!r}; expected some of {', '.join(ESTIMATORS)}")
        require_one_of("validate", "wrong", self.wrong, get_args(Wrong))
        require_one_of("validate", "engine", self.engine, ENGINES)

    def truth(self) -> Subject:
        """Who is perturbed.

        Raises:
          ValueError: the file is refused.
          OSError: the file cannot be read.
        """
        subject = Subject.load(self.subject) if self.subject else {"PT": POSITION, "RT": RELAX}[self.task]
        if self.wrong == "force-feedback":
            subject = replace(subject, kf_s=FORCE_FEEDBACK, kf_e=FORCE_FEEDBACK)
        return subject

    def structure(self) -> Structure:
        """What is fitted: the model, with what it fixes at the truth but for what is wrong on purpose.

        Raises:
          ValueError: as `truth`; or the truth is outside the model's bounds, or does not determine its parameters, or
            what is to be wrong has no effect.
        """
        truth, structure = self.truth(), STRUCTURES[self.model]
        wide = {
            name: (MODEL_3_WIDE.bounds[name][0], structure.initial[name], MODEL_3_WIDE.bounds[name][1])
            for name in structure.free
            if name.startswith(("Td_", "fact_"))
        }
        structure = at_truth(structure.freeing(**wide), truth)
        self._require_determined(structure, truth)
        if self.wrong == "delay":
            if not any(getattr(truth, f"{gain}_{joint}") for gain in ("kv", "kp", "ka") for joint in ("s", "se", "e")):
                raise ValueError(
                    f"validate: wrong = {self.wrong!r}; expected another for {truth.name!r}, in whom nothing is delayed"
                )
            structure = structure.fixing(**{name: getattr(truth, name) + WRONG_DELAY for name in ("Td_s", "Td_e")})
        elif self.wrong == "force-feedback":
            structure = structure.fixing(kf_s=0.0, kf_se=0.0, kf_e=0.0)
        elif self.wrong == "grip":
            structure = structure.fixing(k_h=WRONG_GRIP * truth.k_h)
        for name, value in zip(structure.free, true_values(truth, structure), strict=True):
            lower, upper = structure.bounds[name]
            if not lower <= value <= upper:
                raise ValueError(
                    f"validate: {name} = {value:g} {unit(name)} in {truth.name!r}; expected {lower:g} to {upper:g}, "
                    f"the bounds of model {self.model}"
                )
        return structure.named(self.model)

    def _require_determined(self, structure: Structure, truth: Subject) -> None:
        """Refuse a model with parameters of which no movement of the person tells: none has a bound or an error."""
        arm, n_free = LinearArm(truth, CLUSTERS.ravel() / PERIOD), len(structure.free)
        gradient = arm.total_and_gradient(parameter_vector(truth), Environment())[1] @ structure.mixing
        slopes = gradient.reshape(-1, n_free)
        try:
            require_informative((slopes.conj().T @ slopes).real, structure.free)
        except ValueError as error:
            raise ValueError(
                f"validate: model = {self.model!r} for {truth.name!r}: {error}, as in --model 3b, or another person "
                "(--subject)"
            ) from None
