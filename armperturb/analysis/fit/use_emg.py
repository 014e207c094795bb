"""EMG in fits of arms: which trials have it, and what cannot be done with it."""

from dataclasses import dataclass, field, replace

import numpy as np

from armperturb.analysis.arm.parameters import MATRIX
from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.emg.outputs import dead_muscles, reflex_outputs
from armperturb.analysis.fit.arm_fit import ArmFit
from armperturb.analysis.fit.emg_likelihood import FEEDBACK, ElectromechanicalDelay, EmgLikelihood
from armperturb.analysis.fit.group import Group
from armperturb.analysis.trials import ConditionTrials
from armperturb.validation import require_type


@dataclass(frozen=True, kw_only=True, eq=False)
class UseOfEmg:
    """EMG that fits use beside the movement, see `emg_likelihood`.

    Attributes:
      envelopes: of the person, with all trials that are fitted.
      delay: what is known of the electromechanical delay.

    Raises:
      TypeError: envelopes are no `Envelopes`, or delay no `ElectromechanicalDelay`.
    """

    envelopes: Envelopes
    delay: ElectromechanicalDelay = field(default_factory=ElectromechanicalDelay)

    def __post_init__(self) -> None:
        require_type("UseOfEmg: envelopes", self.envelopes, Envelopes, "those of armperturb.envelopes")
        require_type("UseOfEmg: delay", self.delay, ElectromechanicalDelay, "an ElectromechanicalDelay")

    def added_to(self, group: Group, recorded: ConditionTrials) -> Group:
        """A group with its EMG; the same group where its structure has no reflexes, of which EMG tells nothing.

        Args:
          group: of one condition.
          recorded: its trials as they were recorded.

        Raises:
          ValueError: trials differ in length, the structure has force feedback, which is not known of EMG, or as
            `reflex_outputs`.
        """
        initial = np.array([group.structure.initial[name] for name in group.structure.free])
        arm = group.structure.parameters(group.body.task, initial)
        free = group.structure.mixing.any(axis=1)
        acts = (arm != 0.0) | free
        if acts[MATRIX["kf"]].any():
            raise ValueError(
                f"identify: EMG with model {group.structure.name}, which has force feedback; expected one without "
                "(e.g. --model 3)"
            )
        if len(group.parts) > 1:
            raise ValueError(
                f"identify: EMG of {group.label}, whose trials differ in length; expected one length (any without "
                "--emg)"
            )
        if not any(acts[MATRIX[name]].any() for name in FEEDBACK):
            return group
        return group.with_emg(EmgLikelihood(reflex_outputs(recorded, self.envelopes), self.delay))


def told_of_emg(fit: ArmFit, emg: UseOfEmg, recorded: ConditionTrials) -> ArmFit:
    """A fit with the remark that EMG tells nothing of it, or which muscles it does without, if that is so.

    Args:
      fit: of a condition.
      emg: that was to be used.
      recorded: trials of the condition.
    """
    if not any(name.startswith("g_") for name in fit.detail.values):
        said = f"EMG is not used: model {fit.structure} has no reflexes, of which it tells; the movement alone is used"
    elif dead := dead_muscles(recorded, emg.envelopes):
        said = f"EMG of {', '.join(dead)} is dead in a part of a trial: left out of the fit in all trials"
    else:
        return fit
    return replace(fit, remarks=(*fit.remarks, said))
