"""What makes amplitudes doubtful though no channel is dead: weak contractions, loose electrodes, tone at rest."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from armperturb.arrays import Array

ABOVE_NOISE = 10.0
"""Power over that of the silent channel from which on a muscle is active [-]."""

AT_NOISE = 2.0
"""Power over that of the silent channel up to which a trial tells nothing but noise [-]."""

LARGEST = 1.0
"""Amplitude over that of a maximal contraction above which this was none [-]."""

TONE, MOSTLY = 0.02, 0.5
"""Amplitude at rest over that of the reference, and share of the muscle in it, above which a person has tone [-]."""


def remarks_on_amplitudes(
    names: Sequence[str],
    labels: pd.DataFrame,
    power: Array,
    noise: Array,
    tone: Array,
    *,
    maximal: str | None,
    rest: str,
) -> list[str]:
    """What is doubtful, a line each.

    Args:
      names: of the muscles.
      labels: of the trials.
      power: mean of each trial up to its pulse, over that of the reference, (trial, muscle).
      noise: of the silent channels, likewise, (muscle,).
      tone: share of the power at rest that has the spectrum of the muscle, (muscle,).
      maximal: condition of the maximal contractions that amplitudes are relative to; None without.
      rest: condition of the trials at rest.
    """
    said = []
    conditions = labels["condition"].to_numpy()
    for column, name in enumerate(names):
        of_muscle, silent = power[:, column], float(noise[column])
        if maximal is not None and silent > 0.0 and ABOVE_NOISE * silent > 1.0:
            said.append(
                f"EMG of {name}: {maximal} is hardly above the noise of the channel; expected a contraction with the "
                "electrode on"
            )
        for condition in dict.fromkeys(conditions.tolist()):
            trials = np.flatnonzero((conditions == condition) & np.isfinite(of_muscle))
            if condition in (maximal, rest) or not len(trials):
                continue
            mean = np.sqrt(max(float(of_muscle[trials].mean()) - silent, 0.0))
            if maximal is not None and mean > LARGEST:
                said.append(
                    f"EMG of {name}: {100.0 * mean:.0f} % of maximal contraction in {condition}; expected at most "
                    f"{100.0 * LARGEST:.0f} % ({maximal} was too weak, or its electrode loose)"
                )
            loose = trials[of_muscle[trials] < AT_NOISE * silent]
            if len(loose) and of_muscle[trials].max() > ABOVE_NOISE * silent:
                which = ", ".join(str(trial) for trial in loose)
                said.append(
                    f"EMG of {name}: nothing but noise in trial {which}, though it is active in others of {condition}; "
                    "expected trials with the electrode on"
                )
    at_rest = np.sqrt(tone * noise)
    if active := [
        name for name, level, share in zip(names, at_rest, tone, strict=True) if level > TONE and share > MOSTLY
    ]:
        said.append(
            f"EMG of {', '.join(active)}: the trials of {rest} have the spectrum of an active muscle, which counts as "
            f"noise, so that amplitudes are too small; expected relaxed muscles in {rest}, or no such trials"
        )
    return said
