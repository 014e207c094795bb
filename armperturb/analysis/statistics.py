"""Tests of an effect within people: conditions, or pairs of them (thesis 2.9)."""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Array = NDArray[np.float64]

ALPHA = 0.05
"""Level of significance [-]."""

FEWEST = 3
"""How many people an effect is tested in at least."""


class Effect(NamedTuple):
    """Whether conditions differ within people.

    Attributes:
      test: "ANOVA", "ANOVA, Greenhouse-Geisser" or "Friedman".
      p: that they differ as much by chance [-].
    """

    test: str
    p: float


def effect_of_condition(values: ArrayLike) -> Effect:
    """One-way repeated-measures test of whether conditions differ.

    An analysis of variance; with the Greenhouse-Geisser adjustment where Mauchly's test refuses sphericity, and
    Friedman's test instead where Shapiro and Wilk's refuses that a condition is normally distributed.

    Args:
      values: finite, of at least three people and two conditions, (subject, condition).

    Raises:
      ValueError: there are fewer, or values are not finite.

    Source: thesis 2.9.
    """
    y = np.asarray(values, dtype=float)
    if y.ndim != 2 or len(y) < FEWEST or y.shape[1] < 2:
        raise ValueError(f"values of shape {y.shape}; expected at least {FEWEST} people and 2 conditions")
    if not np.isfinite(y).all():
        raise ValueError("values are not all finite; expected a number for each person and condition")
    n, k = y.shape
    if any(np.ptp(column) and stats.shapiro(column).pvalue < ALPHA for column in y.T):
        return Effect("Friedman", float(stats.chi2.sf(_friedman(y), k - 1)))
    within = y - y.mean(axis=1, keepdims=True)
    between = n * np.sum(within.mean(axis=0) ** 2)
    rest = np.sum((within - within.mean(axis=0)) ** 2)
    f = between / (k - 1) / (rest / ((k - 1) * (n - 1))) if rest > 0.0 else np.inf
    sphericity, epsilon = _sphericity(y)
    adjusted = sphericity < ALPHA
    share = epsilon if adjusted else 1.0
    p = float(stats.f.sf(f, share * (k - 1), share * (k - 1) * (n - 1)))
    return Effect("ANOVA, Greenhouse-Geisser" if adjusted else "ANOVA", p)


def paired_p(first: ArrayLike, second: ArrayLike) -> float:
    """Two-sided p of the dependent t-test [-]; of one value per person, in the same order."""
    difference = np.asarray(first, dtype=float) - np.asarray(second, dtype=float)
    error = difference.std(ddof=1) / np.sqrt(len(difference))
    if not error > 0.0:
        return 0.0 if difference.any() else 1.0
    return float(2 * stats.t.sf(abs(difference.mean()) / error, len(difference) - 1))


def post_hoc(values: ArrayLike) -> dict[tuple[int, int], float]:
    """Dependent t-tests of all pairs of conditions, their p times the number of pairs (Bonferroni), at most 1 [-].

    Args:
      values: (subject, condition).
    """
    y = np.asarray(values, dtype=float)
    pairs = list(itertools.combinations(range(y.shape[1]), 2))
    return {(i, j): min(1.0, len(pairs) * paired_p(y[:, i], y[:, j])) for i, j in pairs}


def _friedman(y: Array) -> float:
    """Friedman's statistic, corrected for ties; SciPy's refuses two conditions."""
    n, k = y.shape
    ranks = np.apply_along_axis(stats.rankdata, 1, y)
    spread = np.sum((ranks - (k + 1) / 2) ** 2)
    if not spread > 0.0:
        return 0.0
    return float((k - 1) * np.sum((ranks.sum(axis=0) - n * (k + 1) / 2) ** 2) / spread)


def _sphericity(y: Array) -> tuple[float, float]:
    """P of Mauchly's test, and Greenhouse and Geisser's epsilon."""
    n, k = y.shape
    contrasts = _contrasts(k)
    covariance = np.atleast_2d(contrasts @ np.cov(y, rowvar=False) @ contrasts.T)
    trace = float(np.trace(covariance))
    if k == 2 or not trace > 0.0:
        return 1.0, 1.0
    d = k - 1
    epsilon = trace**2 / (d * float(np.sum(covariance**2)))
    if n <= d:
        return 1.0, epsilon
    w = float(np.linalg.det(covariance)) / (trace / d) ** d
    scale = n - 1 - (2 * d**2 + d + 2) / (6 * d)
    return float(stats.chi2.sf(-scale * np.log(max(w, 1e-300)), d * (d + 1) / 2 - 1)), epsilon


def _contrasts(k: int) -> Array:
    """Orthonormal contrasts of k conditions, (k - 1, k)."""
    centred = np.eye(k) - 1.0 / k
    return np.asarray(np.linalg.svd(centred)[2][: k - 1])
