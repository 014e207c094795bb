"""Tests of an effect within people: conditions, or pairs of them (thesis 2.9).

All take one value per person and condition, (subject, condition), with no cell missing. With n people, k conditions,
d = k - 1, and sums of squares SS of the values less each person's mean,

    F = (SS_conditions / d) / (SS_rest / (d (n - 1))),  with d and d (n - 1) degrees of freedom,
    epsilon = tr(M)^2 / (d tr(M^2)),  W = det(M) / (tr(M) / d)^d,

M being the covariance of d orthonormal contrasts of the conditions; epsilon (Greenhouse and Geisser) multiplies both
degrees of freedom where Mauchly's test of W refuses sphericity.

Differences that are no larger than `ROUNDING` of the largest value count as none, so that conditions which are the same
in everybody, or differ by the same in everybody, are not judged by what rounding left of them.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, stats

from armperturb.arrays import Array

ALPHA = 0.05
"""Level of significance [-]."""

FEWEST = 3
"""How many people an effect is tested in at least."""

ADJACENT = 4
"""How many adjacent frequency points have to be significant, each on its own, for an effect to count (thesis 2.9)."""

ROUNDING = 1e-13
"""Share of the largest value up to which differences are those of rounding [-]."""


class Anova(NamedTuple):
    """One-way repeated-measures analysis of variance.

    Attributes:
      f: of the conditions [-]; 0 where they do not differ, infinite where they differ by the same in everybody.
      dof: degrees of freedom of the conditions and of the rest, without adjustment.
      p: without adjustment [-].
      epsilon: Greenhouse and Geisser's; 1 if all differences of two conditions vary alike, at least 1 / (k - 1) [-].
      p_adjusted: with both degrees of freedom times epsilon [-].
      eta2: generalised eta squared, the conditions' share of the sum of squares of all values [-].
      partial_eta2: the conditions' share of the sum of squares within people [-].
    """

    f: float
    dof: tuple[int, int]
    p: float
    epsilon: float
    p_adjusted: float
    eta2: float
    partial_eta2: float


class Sphericity(NamedTuple):
    """Mauchly's test.

    Attributes:
      w: 1 if all differences of two conditions vary alike, 0 if some combination of them does not vary [-].
      chi2: its transform [-].
      dof: degrees of freedom of chi2; 0 for two conditions.
      p: [-].
    """

    w: float
    chi2: float
    dof: int
    p: float


class Friedman(NamedTuple):
    """Friedman's analysis of variance by ranks.

    Attributes:
      q: the statistic, corrected for ties [-].
      dof: its degrees of freedom.
      p: from the chi-squared distribution [-].
      w: Kendall's coefficient of concordance, 0 (no order) to 1 (the same order in everybody) [-].
    """

    q: float
    dof: int
    p: float
    w: float


class Normality(NamedTuple):
    """Shapiro and Wilk's test.

    Attributes:
      w: [-].
      p: [-].
    """

    w: float
    p: float


class PairedT(NamedTuple):
    """Dependent t-test.

    Attributes:
      t: positive where the first condition is the larger [-]; 0 if the two do not differ, infinite if they differ by
        the same in everybody.
      dof: degrees of freedom.
      p: two-sided, of this test alone [-].
      p_bonferroni: times the number of pairs that are tested, at most 1 [-].
    """

    t: float
    dof: int
    p: float
    p_bonferroni: float


class Effect(NamedTuple):
    """Whether conditions differ within people.

    Attributes:
      test: "ANOVA", "ANOVA, Greenhouse-Geisser" or "Friedman".
      statistic: F, or Friedman's Q [-].
      dof: degrees of freedom, of F two (with epsilon if adjusted), of Q one.
      p: that they differ as much by chance [-].
      effect_size: generalised eta squared, or Kendall's W [-].
      mauchly_p: of the test of sphericity; NaN if there are too few people for one [-].
      epsilon: Greenhouse and Geisser's [-].
      shapiro_p: of the test of each condition's normality [-].
      n: people.
    """

    test: str
    statistic: float
    dof: tuple[float, ...]
    p: float
    effect_size: float
    mauchly_p: float
    epsilon: float
    shapiro_p: tuple[float, ...]
    n: int


def effect_of_condition(
    values: ArrayLike, *, subjects: Sequence[str] | None = None, conditions: Sequence[str] | None = None
) -> Effect:
    """One-way repeated-measures test of whether conditions differ.

    An analysis of variance; with the Greenhouse-Geisser adjustment where Mauchly's test refuses sphericity, or cannot
    tell because there are no more people than differences of conditions; and Friedman's test instead where Shapiro and
    Wilk's refuses that a condition is normally distributed.

    Args:
      values: finite, of at least three people and two conditions, (subject, condition).
      subjects: names for what is told of a missing value; "0", "1", ... by default.
      conditions: likewise.

    Raises:
      ValueError: there are fewer, a value is not finite (it is named), or the names are not as many as the values.

    Source: thesis 2.9.
    """
    y = _table(values, subjects, conditions)
    normality = tuple(test.p for test in shapiro(y))
    sphericity, variance = mauchly(y), anova(y)
    if min(normality) < ALPHA:
        ranks = friedman(y)
        test, statistic, p, size = "Friedman", ranks.q, ranks.p, ranks.w
        dof: tuple[float, ...] = (ranks.dof,)
    else:
        adjusted = not sphericity.p >= ALPHA
        share = variance.epsilon if adjusted else 1.0
        test = "ANOVA, Greenhouse-Geisser" if adjusted else "ANOVA"
        statistic, p, size = variance.f, variance.p_adjusted if adjusted else variance.p, variance.eta2
        dof = tuple(share * each for each in variance.dof)
    return Effect(test, statistic, dof, p, size, sphericity.p, variance.epsilon, normality, len(y))


def anova(values: ArrayLike) -> Anova:
    """One-way repeated-measures analysis of variance, with and without the Greenhouse-Geisser adjustment.

    Without any variation that people do not share, F is infinite and p is 0 if conditions differ; if they do not, F
    is 0 and p is 1, as nothing speaks against their being alike.

    Args:
      values: as in `effect_of_condition`.

    Raises:
      ValueError: as there.
    """
    y = _table(values)
    n, k = y.shape
    within = y - y[:, :1]  # exact zeros for conditions that are the same
    within -= within.mean(axis=1, keepdims=True)
    effect = within.mean(axis=0)
    between = n * _sum_of_squares(effect, y)
    rest = _sum_of_squares(within - effect, y)
    people = k * _sum_of_squares(y.mean(axis=1) - y.mean(), y)
    dof = (k - 1, (k - 1) * (n - 1))
    f = (between / dof[0]) / (rest / dof[1]) if rest > 0.0 else math.inf if between > 0.0 else 0.0
    m = _covariance(y)
    share = min(float(np.trace(m) ** 2 / (dof[0] * np.sum(m**2))), 1.0) if m.any() else 1.0
    p, adjusted = (float(stats.f.sf(f, part * dof[0], part * dof[1])) for part in (1.0, share))
    eta2, partial = (between / total if between > 0.0 else 0.0 for total in (between + rest + people, between + rest))
    return Anova(f, dof, p, share, adjusted, eta2, partial)


def mauchly(values: ArrayLike) -> Sphericity:
    """Mauchly's test of sphericity: that the differences of all pairs of conditions vary alike.

    p has the second-order term of the approximation by chi-squared, as R and pingouin have it. Two conditions, or
    conditions whose differences do not vary, are spherical: W and p are 1. Where some combination of the differences
    does not vary, W and p are 0. No more people than differences leave nothing to test: W, chi2 and p are NaN.

    Args:
      values: as in `effect_of_condition`.

    Raises:
      ValueError: as there.
    """
    y = _table(values)
    n, k = y.shape
    d, free = k - 1, n - 1
    dof = d * (d + 1) // 2 - 1
    covariance = _covariance(y)
    if d == 1 or not covariance.any():
        return Sphericity(1.0, 0.0, dof, 1.0)
    if free < d:
        return Sphericity(math.nan, math.nan, dof, math.nan)
    variances = np.linalg.eigvalsh(covariance)
    if variances[0] <= d * np.finfo(float).eps * variances[-1]:
        return Sphericity(0.0, math.inf, dof, 0.0)
    log_w = float(np.sum(np.log(variances / variances.mean())))
    rho = 1.0 - (2 * d**2 + d + 2) / (6 * d * free)
    second = (d + 2) * (d - 1) * (d - 2) * (2 * d**3 + 6 * d**2 + 3 * k + 2) / (288 * (free * d * rho) ** 2)
    chi2 = -free * rho * log_w
    first, next_order = (float(stats.chi2.sf(chi2, dof + more)) for more in (0, 4))
    p = first + second * (next_order - first)
    return Sphericity(math.exp(log_w), chi2, dof, min(max(p, 0.0), 1.0))


def friedman(values: ArrayLike) -> Friedman:
    """Friedman's test, also of two conditions, which SciPy's refuses: p is then that of the exact sign test.

    Where all values of each person are tied there is no order: Q and W are 0, and p is 1.

    Args:
      values: as in `effect_of_condition`.

    Raises:
      ValueError: as there.
    """
    y = _table(values)
    n, k = y.shape
    ranks = stats.rankdata(y, axis=1) - (k + 1) / 2
    spread = float(np.sum(ranks**2))
    w = float(np.sum(ranks.sum(axis=0) ** 2)) / (n * spread) if spread > 0.0 else 0.0
    q = n * (k - 1) * w
    if k == 2 and spread > 0.0:
        # With few people chi2 is far from exact: all of four in one order would have p = 0.046 in place of 0.125.
        n_more, n_less = (int(np.sum(sign * ranks[:, 0] > 0.0)) for sign in (1, -1))
        return Friedman(q, 1, float(stats.binomtest(n_more, n_more + n_less).pvalue), w)
    return Friedman(q, k - 1, float(stats.chi2.sf(q, k - 1)), w)


def shapiro(values: ArrayLike) -> tuple[Normality, ...]:
    """Shapiro and Wilk's test of each condition.

    A condition that is the same in everybody tells nothing against normality: W and p are 1.

    Args:
      values: as in `effect_of_condition`.

    Raises:
      ValueError: as there.
    """
    y = _table(values)
    spread = np.ptp(y, axis=0)
    varies = spread > ROUNDING * np.abs(y).max(axis=0)
    tests = (stats.shapiro(y[:, i] / spread[i]) if varies[i] else (1.0, 1.0) for i in range(len(spread)))
    return tuple(Normality(*map(float, test)) for test in tests)


def post_hoc(
    values: ArrayLike, *, subjects: Sequence[str] | None = None, conditions: Sequence[str] | None = None
) -> dict[tuple[int, int], PairedT]:
    """Dependent t-tests of all pairs of conditions, with Bonferroni's correction for their number.

    Args:
      values: as in `effect_of_condition`.
      subjects: likewise.
      conditions: likewise.

    Returns:
      Indices of two conditions, the lower first, to their test.

    Raises:
      ValueError: as there.
    """
    y = _table(values, subjects, conditions)
    pairs = list(itertools.combinations(range(y.shape[1]), 2))
    return {(i, j): _paired_t(y, i, j, len(pairs)) for i, j in pairs}


def adjacent_effects(p: ArrayLike) -> NDArray[np.bool_]:
    """Where an effect on the admittance counts: in runs of at least `ADJACENT` points that are each significant.

    Args:
      p: of the test at each frequency [-], in the order of frequency, (frequency, ...); NaN is not significant.

    Returns:
      True at each point of such a run, of the shape of p.

    Raises:
      ValueError: p is no array over frequency.

    Source: thesis 2.9.
    """
    significant = np.asarray(p, dtype=float) < ALPHA
    if significant.ndim == 0:
        raise ValueError(f"p = {p!r}; expected one for each frequency, (frequency, ...)")
    run = np.ones((ADJACENT,) + (1,) * (significant.ndim - 1), dtype=bool)
    return np.asarray(ndimage.binary_opening(significant, run))


def _table(values: ArrayLike, subjects: Sequence[str] | None = None, conditions: Sequence[str] | None = None) -> Array:
    y = np.asarray(values, dtype=float)
    if y.ndim != 2 or len(y) < FEWEST or y.shape[1] < 2:
        raise ValueError(f"values of shape {y.shape}; expected at least {FEWEST} people and 2 conditions")
    names = []
    for field, given, size in (("subjects", subjects, y.shape[0]), ("conditions", conditions, y.shape[1])):
        names.append([str(index) for index in range(size)] if given is None else list(given))
        if len(names[-1]) != size:
            raise ValueError(f"{len(names[-1])} {field}; expected {size}, as values is of shape {y.shape}")
    if not np.isfinite(y).all():
        i, j = np.argwhere(~np.isfinite(y))[0]
        raise ValueError(
            f"value of subject {names[0][i]} in condition {names[1][j]} = {y[i, j]:g}; expected a finite number for "
            "each person and condition"
        )
    return y


def _sum_of_squares(deviation: Array, y: Array) -> float:
    """Of deviations of y; none if they are those of rounding."""
    return float(np.sum(deviation**2)) if np.abs(deviation).max() > ROUNDING * np.abs(y).max() else 0.0


def _covariance(y: Array) -> Array:
    """Of orthonormal contrasts of the conditions, (k - 1, k - 1); zero if it is that of rounding."""
    k = y.shape[1]
    contrasts = np.linalg.svd(np.eye(k) - 1.0 / k)[2][: k - 1]
    differences = (y - y[:, :1]) @ contrasts.T
    differences -= differences.mean(axis=0)
    if not _sum_of_squares(differences, y):
        return np.zeros((k - 1, k - 1))
    return np.asarray(differences.T @ differences / (len(y) - 1))


def _paired_t(y: Array, i: int, j: int, n_pairs: int) -> PairedT:
    difference = y[:, i] - y[:, j]
    mean = float(difference.mean())
    if _sum_of_squares(difference - mean, y[:, [i, j]]):
        t, p = map(float, stats.ttest_1samp(difference, 0.0))
    elif _sum_of_squares(difference, y[:, [i, j]]):
        t, p = math.copysign(math.inf, mean), 0.0
    else:
        t, p = 0.0, 1.0
    return PairedT(t, len(y) - 1, p, min(1.0, n_pairs * p))
