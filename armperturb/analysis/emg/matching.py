"""Which trials of the envelopes those of a condition are."""

import numpy as np

from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Indices

COMPARED = ("repetition", "pulse_level", "pulse_direction", "pulse_onset")
"""Labels that tell the trials of a condition apart."""

EXPECTED = "the same trials in the same order (ap.envelopes of this recording)"
"""What envelopes hold of a condition, for messages."""


def rows_of(trials: ConditionTrials, envelopes: Envelopes) -> Indices:
    """Which trials of the envelopes these are, (trial,).

    Args:
      trials: all of a condition that the envelopes hold, in their order, or some that were taken from these.
      envelopes: of the person.

    Raises:
      ValueError: the envelopes are somebody else's, or hold more trials of the condition, fewer, or others.
    """
    whole, labels = trials.whole or trials, envelopes.labels
    if whole.name != (whose := str(labels["subject"].iloc[0])):
        raise ValueError(f"EMG is not used: it is {whose}'s, the other signals {whole.name}'s; expected one person's")
    rows = np.flatnonzero((labels["condition"] == whole.label).to_numpy())
    if len(rows) != whole.n_trials:
        raise ValueError(
            f"EMG is not used: it has {len(rows)} trials of {whole.label}, the other signals {whole.n_trials}; "
            f"expected {EXPECTED}"
        )
    for name in COMPARED:
        ours, theirs = (np.asarray(each, dtype=float) for each in (labels[name].iloc[rows], whole.recording[name]))
        # A pulse after the workspace limit, or in a trial that is used whole, has no onset.
        without = np.logical_or if name == "pulse_onset" else np.logical_and
        other = np.flatnonzero((ours != theirs) & ~without(np.isnan(ours), np.isnan(theirs)))
        if len(other):
            raise ValueError(
                f"EMG is not used: {name} of trial {other[0]} of {whole.label} is {ours[other[0]]:g} in the envelopes, "
                f"{theirs[other[0]]:g} in the other signals; expected {EXPECTED}"
            )
    return rows if trials.whole is None else rows[trials.numbers]
