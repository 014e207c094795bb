"""How well trials tell the manipulator in which they were recorded."""

import numpy as np

from armperturb.analysis.per_trials import per_trials
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array


@per_trials
def manipulator_covariance(trials: ConditionTrials) -> Array:
    """Covariance of the errors of the manipulator's mass, damping and stiffness in SI units, (3, 3).

    It is zero of a manipulator that is given without one.
    """
    if trials.given is not None:
        return np.zeros((3, 3)) if trials.given_covariance is None else trials.given_covariance
    if trials.whole is not None:
        return manipulator_covariance(trials.whole)
    return trials.balance.covariance(*trials.instruments)
