"""Tests within people against pingouin and SciPy, and against sums that can be done by hand."""

import itertools
import math
import warnings

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from armperturb.analysis.measures.statistics import (
    ADJACENT,
    adjacent_effects,
    anova,
    effect_of_condition,
    friedman,
    mauchly,
    post_hoc,
    shapiro,
)


def design(n, k, seed, effect=1.0, scale=1.0, people=3.0):
    """People who differ more than k conditions do, whose noise is correlated and not equally large."""
    draw = np.random.default_rng([n, k, seed])
    noise = draw.standard_normal((n, k)) @ draw.uniform(-0.5, 1.0, (k, k)) + 0.3 * draw.standard_normal((n, k))
    return scale * (people * draw.standard_normal((n, 1)) + noise + effect * draw.standard_normal(k))


DESIGNS = {
    f"{n} people, {k} conditions, {effect:g} x {scale:g}": design(n, k, seed, effect, scale)
    for seed, (n, k, (effect, scale)) in enumerate(
        itertools.product((3, 10, 30), (2, 3, 4, 6), ((0.0, 1.0), (0.3, 1e-6), (6.0, 1e6)))
    )
}
TESTABLE = {name: y for name, y in DESIGNS.items() if len(y) >= y.shape[1] > 2}
TIED = {name: np.round(y / np.std(y) * 2) for name, y in list(DESIGNS.items())[::3]}


def close(value, judge):
    """To 1e-8, relative, or absolute of a p that is smaller than that."""
    assert value == pytest.approx(float(judge), rel=1e-8, abs=1e-8)


@pytest.fixture(scope="module")
def judge():
    """Pingouin's functions by name; what they warn of is theirs."""

    def call(function, *arguments, **options):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import pingouin

            return getattr(pingouin, function)(*arguments, **options)

    return call


@pytest.fixture
def values():
    """Ten people who differ far more than the four conditions do."""
    draw = np.random.default_rng(1)
    return draw.standard_normal((10, 4)) + 5 * draw.standard_normal((10, 1)) + [0.0, 0.5, 1.0, 1.5]


@pytest.mark.parametrize("name", DESIGNS)
def test_variance_is_analysed_as_the_judge_does(judge, name):
    y = DESIGNS[name]
    table = pd.DataFrame(y)
    theirs, partial = (judge("rm_anova", table, correction=True, effsize=size).iloc[0] for size in ("ng2", "np2"))
    ours = anova(y)
    assert ours.f == pytest.approx(theirs["F"], rel=1e-8)
    assert ours.dof == (theirs["ddof1"], theirs["ddof2"])
    close(ours.p, theirs["p_unc"])
    close(ours.epsilon, judge("epsilon", table))
    close(ours.p_adjusted, theirs.get("p_GG_corr", theirs["p_unc"]))
    close(ours.eta2, theirs["ng2"])
    close(ours.partial_eta2, partial["np2"])


@pytest.mark.parametrize("name", TESTABLE)
def test_sphericity_is_judged_as_the_judge_does(judge, name):
    _, w, chi2, dof, p = judge("sphericity", pd.DataFrame(TESTABLE[name]))
    ours = mauchly(TESTABLE[name])
    close(ours.w, w)
    assert ours.chi2 == pytest.approx(chi2, rel=1e-8)
    assert ours.dof == dof
    close(ours.p, p)


@pytest.mark.parametrize("name", [*DESIGNS, *(f"tied, {name}" for name in TIED)])
def test_ranks_are_tested_as_the_judges_do(judge, name):
    y = TIED[name.removeprefix("tied, ")] if name.startswith("tied") else DESIGNS[name]
    theirs = judge("friedman", pd.DataFrame(y)).iloc[0]
    ours = friedman(y)
    close(ours.q, theirs["Q"])
    close(ours.w, theirs["W"])
    assert ours.dof == theirs["ddof1"]
    if y.shape[1] > 2:
        close(ours.p, theirs["p_unc"])
        close(ours.p, stats.friedmanchisquare(*y.T).pvalue)
    else:
        rises, falls = np.sum(y[:, 1] > y[:, 0]), np.sum(y[:, 1] < y[:, 0])
        outcomes = np.array([math.comb(rises + falls, ups) for ups in range(rises + falls + 1)])
        close(ours.p, np.sum(outcomes[outcomes <= outcomes[rises]]) / outcomes.sum())


@pytest.mark.parametrize(("n", "p"), [(4, 0.125), (5, 0.0625), (6, 0.03125)])
def test_two_conditions_need_six_people(n, p):
    assert friedman([[1.0, 2.0]] * n).p == pytest.approx(p)


@pytest.mark.parametrize("name", list(DESIGNS)[::5])
def test_pairs_and_normality_are_tested_as_the_judges_do(judge, name):
    y = DESIGNS[name]
    theirs = judge("normality", pd.DataFrame(y))
    columns = {"dv": "value", "within": "variable", "subject": "index"}
    long = pd.DataFrame(y).reset_index().melt("index")
    pairs = judge("pairwise_tests", long, **columns, padjust="bonf", effsize="none")
    single = judge("ttest", y[:, 0], y[:, 1], paired=True).iloc[0]
    for ours, (_, row), column in zip(shapiro(y), theirs.iterrows(), y.T, strict=True):
        close(ours.w, row["W"])
        close(ours.p, row["pval"])
        close(ours.p, stats.shapiro(column).pvalue)
    first = post_hoc(y[:, :2])[0, 1]
    close(first.t, single["T"])
    close(first.p, single["p_val"])
    assert first.dof == single["dof"]
    found = post_hoc(y)
    assert set(found) == set(zip(pairs["A"], pairs["B"], strict=True))
    for _, row in pairs.iterrows():
        ours = found[row["A"], row["B"]]
        close(ours.t, row["T"])
        close(ours.p, row["p_unc"])
        close(ours.p_bonferroni, row["p_corr"] if len(pairs) > 1 else row["p_unc"])
        close(ours.p, stats.ttest_rel(y[:, row["A"]], y[:, row["B"]]).pvalue)


def test_two_conditions_are_a_dependent_t_test(values):
    pair = values[:, :2]
    expected = stats.ttest_rel(*pair.T)
    effect = effect_of_condition(pair)
    assert effect.test == "ANOVA"
    assert effect.p == pytest.approx(expected.pvalue)
    assert effect.statistic == pytest.approx(expected.statistic**2)
    assert (effect.dof, effect.mauchly_p, effect.epsilon) == ((1.0, 9.0), 1.0, 1.0)
    assert mauchly(pair) == (1.0, 0.0, 0, 1.0)


def test_anova_by_hand():
    """Sums of squares: 12 between conditions, 12 left over, with 2 and 10 degrees of freedom; so F = 5."""
    y = np.array(list(itertools.permutations([-1.0, 0.0, 1.0]))) + np.arange(3.0)
    effect = effect_of_condition(y)
    assert effect.test == "ANOVA"
    assert effect.statistic == pytest.approx(5.0)
    assert effect.dof == (2.0, 10.0)
    assert effect.p == pytest.approx(stats.f.sf(5.0, 2, 10))
    assert effect.effect_size == anova(y).partial_eta2 == pytest.approx(0.5)
    assert effect.epsilon == pytest.approx(1.0)
    assert effect.n == 6


def test_people_may_differ(values):
    far = values + 100 * np.arange(10)[:, None] ** 0.5
    assert effect_of_condition(values).test == "ANOVA"
    assert effect_of_condition(far).p == pytest.approx(effect_of_condition(values).p)
    assert anova(far).partial_eta2 == pytest.approx(anova(values).partial_eta2)
    assert anova(far).eta2 < 0.01 * anova(values).eta2


def test_not_normal_is_ranked(values):
    odd = values.copy()
    odd[:, 0] = [0.0] * 9 + [100.0]
    effect, expected = effect_of_condition(odd), stats.friedmanchisquare(*odd.T)
    assert (effect.test, effect.dof) == ("Friedman", (3,))
    assert effect.statistic == pytest.approx(expected.statistic)
    assert effect.p == pytest.approx(expected.pvalue)
    assert effect.effect_size == pytest.approx(expected.statistic / 30)
    assert effect.shapiro_p == pytest.approx([stats.shapiro(column).pvalue for column in odd.T])
    assert effect.shapiro_p[0] < 0.05 < min(effect.shapiro_p[1:])


def test_not_spherical_is_adjusted():
    """Where one condition alone varies, the adjustment goes to its limit: degrees of freedom as for two conditions."""
    draw = np.random.default_rng(4)
    alone = draw.standard_normal(12) + 1.0
    y = np.column_stack([alone, 1e-4 * draw.standard_normal((12, 3))])
    effect = effect_of_condition(y)
    assert effect.test == "ANOVA, Greenhouse-Geisser"
    assert effect.p == pytest.approx(stats.ttest_1samp(alone, 0.0).pvalue, rel=1e-2)
    assert effect.epsilon == pytest.approx(1 / 3, rel=1e-3)
    assert effect.dof == pytest.approx((1.0, 11.0), rel=1e-3)
    assert effect.mauchly_p < 1e-10


def test_conditions_that_are_the_same_do_not_differ():
    """In numbers that a mean over conditions rounds."""
    y = np.tile(np.random.default_rng(3).uniform(0.1, 1.0, (7, 1)), (1, 3))
    assert anova(y) == (0.0, (2, 12), 1.0, 1.0, 1.0, 0.0, 0.0)
    assert mauchly(y) == (1.0, 0.0, 2, 1.0)
    assert friedman(y) == (0.0, 2, 1.0, 0.0)
    assert set(post_hoc(y).values()) == {(0.0, 6, 1.0, 1.0)}
    assert effect_of_condition(y).p == 1.0
    assert effect_of_condition(np.full((4, 3), 0.1)).p == 1.0


@pytest.mark.parametrize("people", [0.0, 0.1])
def test_the_same_difference_in_everybody_is_certain(people):
    """0.1, 0.2 and so on add up with rounding, which is no variation."""
    y = people * np.array([[1.0], [2.0], [3.0], [7.0]]) + np.array([0.1, 0.2, 0.7])
    result = anova(y)
    assert (result.f, result.p, result.epsilon, result.p_adjusted, result.partial_eta2) == (
        math.inf,
        0.0,
        1.0,
        0.0,
        1.0,
    )
    assert mauchly(y) == (1.0, 0.0, 2, 1.0)
    assert friedman(y).w == pytest.approx(1.0)
    assert set(post_hoc(y).values()) == {(-math.inf, 3, 0.0, 0.0)}
    effect = effect_of_condition(y)
    assert (effect.test, effect.p) == ("ANOVA", 0.0)
    between, total = 4 * np.sum((y.mean(axis=0) - y.mean()) ** 2), np.sum((y - y.mean()) ** 2)
    assert result.eta2 == pytest.approx(between / total)


def test_two_conditions_that_are_the_same_beside_others(judge, values):
    """A combination that does not vary is as far from spherical as can be; all else is as ever."""
    y = values[:, [0, 1, 1]]
    w, chi2, dof, p = mauchly(y)
    assert (w, chi2, dof, p) == (0.0, math.inf, 2, 0.0)
    assert anova(y).epsilon == pytest.approx(0.5)
    table = judge("rm_anova", pd.DataFrame(y, columns=list("abc")), correction=True).iloc[0]
    close(anova(y).f, table["F"])
    close(anova(y).p_adjusted, table["p_GG_corr"])
    assert post_hoc(y)[1, 2] == (0.0, 9, 1.0, 1.0)
    effect = effect_of_condition(y)
    assert effect.test == "ANOVA, Greenhouse-Geisser"
    # As the t-test of the two conditions that there are.
    assert effect.p == pytest.approx(post_hoc(y[:, :2])[0, 1].p)


def test_a_condition_that_is_constant_is_no_refusal_of_normality(judge, values):
    y = values.copy()
    y[:, 2] = 0.3
    assert shapiro(y)[2] == (1.0, 1.0)
    table = judge("rm_anova", pd.DataFrame(y), correction=True).iloc[0]
    close(anova(y).p_adjusted, table["p_GG_corr"])
    close(mauchly(y).p, table["p_spher"])
    assert effect_of_condition(y).test == "ANOVA, Greenhouse-Geisser"


def test_fewer_people_than_conditions_are_adjusted():
    """Their covariance has no inverse, so that sphericity cannot be tested; epsilon is at least its lower bound."""
    y = design(4, 6, seed=0)
    sphericity = mauchly(y)
    assert np.isnan([sphericity.w, sphericity.chi2, sphericity.p]).all()
    effect = effect_of_condition(y)
    assert effect.test == "ANOVA, Greenhouse-Geisser"
    assert np.isnan(effect.mauchly_p)
    assert 1 / 5 <= effect.epsilon <= 3 / 5  # three people's worth of directions, of five
    assert effect.p == pytest.approx(anova(y).p_adjusted)
    # As many people as conditions are enough.
    assert np.isfinite(mauchly(design(6, 6, seed=0)).p)


def test_pairs_pay_for_their_number(values):
    for (i, j), test in post_hoc(values).items():
        expected = stats.ttest_rel(values[:, i], values[:, j])
        assert test.t == pytest.approx(expected.statistic)
        assert test.p_bonferroni == pytest.approx(min(1.0, 6 * expected.pvalue))


@pytest.mark.slow(reason="repeats tests on drawn samples")
def test_false_alarms_are_as_rare_as_said():
    """Without effect, spherical or not, what is significant is 5 % of designs."""
    draw = np.random.default_rng(11)
    spherical = draw.standard_normal((600, 10, 4))
    mixed = draw.standard_normal((600, 10, 4)) * [4.0, 1.0, 0.5, 0.2]
    assert np.mean([anova(y).p < 0.05 for y in spherical]) == pytest.approx(0.05, abs=0.025)
    assert np.mean([mauchly(y).p < 0.05 for y in spherical]) == pytest.approx(0.05, abs=0.025)
    found = [anova(y) for y in mixed]
    assert np.mean([one.p_adjusted < 0.05 for one in found]) == pytest.approx(0.05, abs=0.025)
    assert np.mean([one.p < 0.05 for one in found]) > 0.08


@pytest.mark.parametrize("n", [2, 3, 4, 5, 18])
def test_effects_count_in_runs_of_frequencies(n):
    p = np.random.default_rng(n).choice([0.01, 0.5, np.nan], (n, 2, 40), p=[0.7, 0.2, 0.1])
    expected = np.zeros(p.shape, dtype=bool)
    for first in range(n - 3):
        run = (p[first : first + 4] < 0.05).all(axis=0)
        expected[first : first + 4] |= run
    np.testing.assert_array_equal(adjacent_effects(p), expected)
    assert ADJACENT == 4
    assert expected.any() == (n >= 4)


def test_three_adjacent_frequencies_are_none():
    assert not adjacent_effects([0.01, 0.01, 0.01, 0.05, 0.01, 0.01, 0.01]).any()
    assert adjacent_effects([0.5, 0.01, 0.01, 0.01, 0.049]).tolist() == [False, True, True, True, True]
    with pytest.raises(ValueError, match=r"p = 0\.01; expected one for each frequency"):
        adjacent_effects(0.01)


@pytest.mark.parametrize("shape", [(2, 3), (5, 1), (5,)])
@pytest.mark.parametrize("test", [effect_of_condition, anova, mauchly, friedman, shapiro, post_hoc])
def test_refuses_too_few(test, shape):
    with pytest.raises(ValueError, match="expected at least 3 people and 2 conditions"):
        test(np.zeros(shape))


@pytest.mark.parametrize("test", [effect_of_condition, post_hoc])
def test_names_what_is_missing(values, test):
    values[4, 2] = np.nan
    with pytest.raises(ValueError, match="value of subject 4 in condition 2 = nan; expected a finite number"):
        test(values)
    people, conditions = [f"P{i}" for i in range(10)], ["PT0", "PT2.5", "PT7.5", "PT22.5"]
    with pytest.raises(ValueError, match=r"value of subject P4 in condition PT7\.5 = nan"):
        test(values, subjects=people, conditions=conditions)
    with pytest.raises(ValueError, match=r"9 subjects; expected 10, as values is of shape \(10, 4\)"):
        test(values, subjects=people[1:], conditions=conditions)
