"""Tests within people against SciPy's, and against sums that can be done by hand."""

import itertools

import numpy as np
import pytest
from scipy import stats

from armperturb.analysis.statistics import effect_of_condition, paired_p, post_hoc


@pytest.fixture
def values():
    """Ten people who differ far more than the four conditions do."""
    draw = np.random.default_rng(1)
    return draw.standard_normal((10, 4)) + 5 * draw.standard_normal((10, 1)) + [0.0, 0.5, 1.0, 1.5]


def test_two_conditions_are_a_dependent_t_test(values):
    pair = values[:, :2]
    expected = stats.ttest_rel(*pair.T).pvalue
    assert paired_p(*pair.T) == pytest.approx(expected)
    assert effect_of_condition(pair) == ("ANOVA", pytest.approx(expected))
    assert post_hoc(pair) == {(0, 1): pytest.approx(expected)}


def test_anova_by_hand():
    """Sums of squares: 12 between conditions, 12 left over, with 2 and 10 degrees of freedom; so F = 5."""
    y = np.array(list(itertools.permutations([-1.0, 0.0, 1.0]))) + np.arange(3.0)
    assert effect_of_condition(y) == ("ANOVA", pytest.approx(stats.f.sf(5.0, 2, 10)))


def test_people_may_differ(values):
    far = values + 100 * np.arange(10)[:, None] ** 0.5
    assert effect_of_condition(values).test == "ANOVA"
    assert effect_of_condition(far).p == pytest.approx(effect_of_condition(values).p)


def test_not_normal_is_ranked(values):
    odd = values.copy()
    odd[:, 0] = [0.0] * 9 + [100.0]
    expected = stats.friedmanchisquare(*odd.T).pvalue
    assert effect_of_condition(odd) == ("Friedman", pytest.approx(expected))


def test_not_spherical_is_adjusted():
    """Where one condition alone varies, the adjustment goes to its limit: degrees of freedom as for two conditions."""
    draw = np.random.default_rng(4)
    alone = draw.standard_normal(12) + 1.0
    y = np.column_stack([alone, 1e-4 * draw.standard_normal((12, 3))])
    test, p = effect_of_condition(y)
    assert test == "ANOVA, Greenhouse-Geisser"
    assert p == pytest.approx(stats.ttest_1samp(alone, 0.0).pvalue, rel=1e-2)


def test_pairs_pay_for_their_number(values):
    for (i, j), p in post_hoc(values).items():
        assert p == pytest.approx(min(1.0, 6 * stats.ttest_rel(values[:, i], values[:, j]).pvalue))


def test_people_who_are_all_alike():
    assert paired_p([1.0, 2.0, 3.0], [1.0, 2.0, 3.0]) == 1.0
    assert paired_p([2.0, 3.0, 4.0], [1.0, 2.0, 3.0]) == 0.0
    assert effect_of_condition(np.tile([1.0, 2.0, 3.0], (4, 1))).p == 0.0


@pytest.mark.parametrize("shape", [(2, 3), (5, 1), (5,)])
def test_refuses_too_few(shape):
    with pytest.raises(ValueError, match="expected at least 3 people and 2 conditions"):
        effect_of_condition(np.zeros(shape))


def test_refuses_what_is_missing(values):
    values[0, 0] = np.nan
    with pytest.raises(ValueError, match="not all finite"):
        effect_of_condition(values)
