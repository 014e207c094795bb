"""What a score can reach: a replicate of the study in print, and headline numbers that the print itself contradicts."""

import functools
import math
from collections.abc import Mapping

import numpy as np
from scipy import stats

from armperturb.analysis.arm.linear_arm import LinearArm
from armperturb.analysis.fit.structures import structure_of
from armperturb.arrays import Array
from armperturb.perturbations.multisine import CLUSTERS, PERIOD
from armperturb.study.published import tables as published
from armperturb.study.results.trial_measures import N_LOW
from armperturb.subject import POSITION, RELAX

PEOPLE = 10
"""Number of people behind the published means and SDs."""

MODELS = "123456"

OF_PRINTED_ARMS = {"C": (49, 54), "D": (51, 64), "E": (70, 76)}
"""Appendix to the share of its cells within 1 SD that simulated people have who are the thesis's own mean arms [%]: the
lower and the higher of models 3 and 5 in PT, with the noise of people (`benchmarks.print_ceiling`)."""

AMPLITUDES = {"PT": ("C.6", "C.10"), "RT": ("C.20", "C.16")}
"""Task to the tables of the parameters with the higher and the lower admittance."""


def replicate_share(limit: float, people: int) -> float:
    """Share of cells that other people of the same population have within so many published SDs [-].

    For normally distributed people whose mean and SD were estimated from ten: the difference of two means over the
    published SD is Student's t with nine degrees of freedom times sqrt(1/10 + 1/n). Cells whose SD is over trials
    differ less.

    Args:
      limit: in published SDs.
      people: in the other study, n.
    """
    if people < 1:
        return math.nan
    return float(2.0 * stats.t.cdf(limit / math.sqrt(1.0 / PEOPLE + 1.0 / people), PEOPLE - 1) - 1.0)


def causes(within: Mapping[str, float], people: int) -> list[str]:
    """Which misses are the people's, and which the print's: a line for movements and one for fitted tables.

    Args:
      within: group of tables ("2.1 and F", "C", "D", "E") to our share of its computed cells within 1 SD [-];
        others count not.
      people: number of people behind the shares.
    """
    lines = []
    if "2.1 and F" in within:
        off, chance = 1.0 - within["2.1 and F"], 1.0 - replicate_share(1.0, people)
        lines.append(
            f"movements beyond 1 SD: {100.0 * off:.0f} % of computed cells; {100.0 * chance:.0f} % would be by the "
            "sampling of people alone"
        )
    each = [
        f"{name} {100.0 * (1.0 - within[name]):.0f} % ({100 - high} to {100 - low} %)"
        for name, (low, high) in OF_PRINTED_ARMS.items()
        if name in within
    ]
    if each:
        lines.append(
            f"fitted cells beyond 1 SD: {', '.join(each)}; in brackets what people miss who are the printed arms: only "
            "what exceeds that is our people's"
        )
    return lines


def _low_gains(table: str, model: str) -> Array:
    """Gain of the diagonal at the lowest frequencies of the arm of mean parameters, (frequency, axis)."""
    structure = structure_of(model)
    body = {"PT": POSITION, "RT": RELAX}["PT" if published.place_of(table)[1] < 13 else "RT"]
    values = [published.estimate(name, table, model=model).mean for name in structure.free]
    frequency = CLUSTERS[:N_LOW].mean(axis=1) / PERIOD
    admittance = LinearArm(body, frequency, "pade").admittance(structure.parameters(body.task, values))
    return np.abs(admittance[:, [0, 1], [0, 1]])


def amplitude_factors(task: str) -> Array:
    """How far amplitude changes the admittance of the published mean parameters, one factor per model of table C.1.

    Mean over the lowest two frequencies and the diagonal, as the text has it (3.1).

    Args:
      task: "PT", PT2.5 over PT22.5, or "RT", RT22.5 over RT2.5.
    """
    above, below = AMPLITUDES[task]
    return np.array([np.mean(_low_gains(above, model) / _low_gains(below, model)) for model in MODELS])


@functools.cache
def contradictions() -> Mapping[str, str]:
    """Name of each headline number that other printed numbers contradict to what they say.

    The headline and what contradicts it are both means over the same people, so that no people can have both.
    """
    said = {}
    for task, (above, below) in AMPLITUDES.items():
        factors = amplitude_factors(task)
        said[f"admittance_amplitude_factor_{task.lower()}"] = (
            f"mean parameters of tables {above} and {below} give {factors.min():.2g} to {factors.max():.2g}"
        )
    for condition in ("PT0", "PT7.5"):
        name = f"pulse_admittance_ratio_max_min_{condition.lower()}"
        peaks = [published.peak_displacement(condition, level).mean for level in ("max", "min")]
        moved = peaks[0] / peaks[1]
        said[name] = (
            f"table 2.1 has {moved:.2f} times the displacement: the hand's force would rise "
            f"{moved / published.headline(name):.2f}-fold with a doubled pulse"
        )
    return said
