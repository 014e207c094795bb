"""Tests of the effect of amplitude: on the right numbers, beside the right printed ones, and told where not made."""

import math
from dataclasses import replace

import numpy as np
import pytest
from invented import people_of, renamed, study_of
from scipy import stats

from armperturb.analysis.fit.identification import Identification
from armperturb.analysis.measures.statistics import adjacent_effects, effect_of_condition
from armperturb.analysis.response.spectra import SpectralEstimate
from armperturb.study.comparison.effects import admittance_effect, compared_pulses, effects
from armperturb.study.results.mean_admittance import at_usual_frequencies, mean_admittance

NAMES = ("S01", "S02", "S03", "S04", "S05")


@pytest.fixture(scope="module")
def people():
    return people_of(NAMES)


@pytest.fixture(scope="module")
def tested(people):
    return effects(study_of(people))


def row(rows, **wanted):
    (found,) = [one for one in rows if all(one[key] == value for key, value in wanted.items())]
    return found


def table(people, pulses, value):
    """Means over the trials of a pulse that tell something, (person, pulse)."""
    return np.array(
        [
            [
                np.nanmean([value(t) for t in one.trials if t.condition == c and abs(t.pulse_level) == level])
                for c, level in pulses
            ]
            for one in people
        ]
    )


@pytest.mark.parametrize(
    ("quantity", "value"),
    [("peak displacement", lambda t: t.displacement), ("pulse admittance", lambda t: t.displacement / t.force)],
)
@pytest.mark.parametrize(("task", "level"), [("PT", 2.0), ("RT", 1.0)])
def test_pulses_are_compared_between_amplitudes_at_one_level(people, tested, quantity, value, task, level):
    conditions = [f"{task}{amplitude}" for amplitude in ("0", "2.5", "7.5", "22.5")]
    values = table(people, [(condition, level) for condition in conditions], value)
    expected = effect_of_condition(values)
    found = row(tested.rows, quantity=quantity, task=task, conditions=", ".join(conditions))
    assert (found["test"], found["people"]) == (expected.test, 5)
    assert found["p"] == pytest.approx(expected.p)
    pair = row(tested.pairs, quantity=quantity, task=task, first=conditions[1], second=conditions[3])
    t = stats.ttest_rel(values[:, 1], values[:, 3])
    assert pair["t"] == pytest.approx(t.statistic)
    assert pair["p_bonferroni"] == pytest.approx(min(1.0, 6 * t.pvalue))
    assert pair["difference"] == pytest.approx(np.mean(values[:, 1] - values[:, 3]))


def test_levels_are_compared_by_a_dependent_t_test(people, tested):
    values = table(people, [("PT0", 2.0), ("PT0", 1.0)], lambda t: t.displacement / t.force)
    found = row(tested.rows, test="dependent t", conditions="PT0, level 2 against 1")
    assert found["p"] == pytest.approx(stats.ttest_rel(*values.T).pvalue)
    assert found["published_p"] == "0.009"


def test_parameters_are_means_over_stable_trials(people, tested):
    values = np.array(
        [
            [
                np.mean([fit.values["k_s"] for fit in one.estimates[f"PT{a}"].fits if fit.stable])
                for a in ("2.5", "7.5", "22.5")
            ]
            for one in people
        ]
    )
    found = row(tested.rows, quantity="k_s", task="PT")
    assert found["p"] == pytest.approx(effect_of_condition(values).p) == tested.parameters["PT", "k_s"]


def test_one_joint_muscles_are_joints_less_the_two_joint_muscles(people, tested):
    def difference(fit):
        return fit.values["kv_e"] - fit.values["kv_se"]

    values = np.array(
        [
            [np.mean([difference(f) for f in one.estimates[f"PT{a}"].fits if f.stable]) for a in ("2.5", "7.5", "22.5")]
            for one in people
        ]
    )
    found = row(tested.rows, quantity="kv_e*", task="PT")
    assert found["p"] == pytest.approx(effect_of_condition(values).p) == tested.parameters["PT", "kv_e*"]


def test_printed_numbers_stand_beside(tested):
    printed = {
        (one["quantity"], one["task"]): one["published_p"] for one in tested.rows if one["test"] != "dependent t"
    }
    assert printed["k_s", "PT"] == "0.002"
    assert printed["k_e", "PT"] == "ns"
    assert printed["b_se", "RT"] == "0.000"
    assert printed["pulse admittance", "PT"] == "0.001"
    assert printed["pulse prediction", "PT"] == "ns"
    assert printed["peak displacement", "PT"] == ""
    assert printed["kv_s*", "PT"] == "< 0.01"
    assert printed["kv_e*", "PT"] == printed["k_s*", "RT"] == ""
    assert len(tested.parameters) == 12 + 8 + 6 + 4
    pair = row(tested.pairs, quantity="pulse admittance", task="RT", first="RT7.5", second="RT22.5")
    assert pair["published_p"] == "0.009"


def test_gain_is_tested_at_each_frequency(people, tested):
    found = tested.admittance["PT"]
    study = study_of(people)
    gain = np.array([[abs(case.identified.spectra.arm) for case in study.of(f"PT{a}")] for a in ("2.5", "7.5", "22.5")])
    assert found.p.shape == (18, 2, 2)
    assert found.p[4, 0, 1] == pytest.approx(effect_of_condition(gain[:, :, 4, 0, 1].T).p)
    np.testing.assert_array_equal(found.counts, adjacent_effects(found.p))
    alone = [f"{f:.2g}" for f, p in zip(found.frequency, found.p[:, 1, 1], strict=True) if p < 0.05]
    assert found.alone(1, 1) == alone


def test_an_effect_on_the_gain_counts_over_four_points(people):
    study = study_of(people)
    for case in study.cases:
        if case.condition.name == "RT22.5":
            case.identified.spectra.arm[5:9] *= 100.0
            case.identified.spectra.arm[12:15] *= 100.0
    found = admittance_effect(study, "RT")
    assert (found.p[5:9] < 0.05).all()
    assert (found.p[12:15] < 0.05).all()
    assert found.counts[5:9].all()
    lonely = (found.p < 0.05) & ~found.counts
    assert lonely.any()


def test_admittances_at_frequencies_nearby_are_interpolated(people):
    frequency = np.geomspace(0.3, 20.0, 60)
    case = study_of(people).of("PT2.5")[0]

    def at(grid):
        arm = (np.exp(1j * grid) / grid)[:, None, None] * np.ones((2, 2))
        spectra = SpectralEstimate(
            frequency=grid,
            arm=arm,
            environment=arm,
            total=arm,
            coherence=np.ones((len(grid), 2)),
            n_averages=np.full(len(grid), 4),
        )
        identification = Identification(n_trials=1, spectra=spectra, environment=None, fit=None, vaf=np.ones(2))
        return replace(case, identification=identification)

    made = [at(grid) for grid in (frequency, frequency, 1.02 * frequency[:-1], 1.3 * frequency)]
    *alike, moved = at_usual_frequencies(made)
    assert alike == made[:2]  # and whoever is far off is left out
    found, expected = moved.identified.spectra, made[0].identified.spectra
    np.testing.assert_array_equal(found.frequency, frequency)
    np.testing.assert_allclose(found.arm[1:-2], expected.arm[1:-2], rtol=0.01)


@pytest.mark.slow(reason="analyses several studies")
def test_whoever_lacks_a_condition_is_left_out_by_name(people, tested):
    first = people[0]
    without = replace(first, trials=tuple(t for t in first.trials if t.condition != "PT2.5"))
    found = effects(study_of((without, *people[1:])))
    assert row(found.rows, quantity="peak displacement", task="PT")["people"] == 4
    assert row(found.rows, quantity="peak displacement", task="RT")["people"] == 5
    assert any("without S01, who has no value in PT2.5" in line for line in found.remarks)


def test_gains_at_other_frequencies_are_left_out_by_name(people):
    study = study_of(people)
    for case in study.cases:
        if case.name == "S02" and case.condition.task == "PT":
            case.identified.spectra.frequency = 1.3 * case.identified.spectra.frequency[:-1]
            case.identified.spectra.arm = case.identified.spectra.arm[:-1]
    others = replace(study, cases=tuple(case for case in study.cases if case.name != "S02"))
    assert admittance_effect(study, "PT").p == pytest.approx(admittance_effect(others, "PT").p)
    assert mean_admittance(study, "PT2.5").gain == pytest.approx(mean_admittance(others, "PT2.5").gain)
    gone = tuple(case for case in study.cases if (case.name, case.condition.name) != ("S03", "RT7.5"))
    assert [line for line in effects(replace(study, cases=gone)).remarks if line.startswith("gain")] == [
        "gain, PT: without S02, whose frequencies in every condition are not those of most people",
        "gain, RT: without S03, who was not identified in RT7.5",
    ]


@pytest.mark.slow(reason="analyses several studies")
def test_pulses_are_compared_over_the_directions_that_a_person_has_in_all_conditions(people):
    def both_ways(trials, lost=""):
        """Each trial at 20 degrees, and one that goes twice as far at 200, which one condition may have lost."""
        for t in trials:
            yield t
            gone = math.nan if t.condition == lost else 1.0
            yield t._replace(pulse_direction_deg=200.0, displacement=2.0 * gone * t.displacement, force=gone * t.force)

    def tested_of(lost):
        whole = [replace(each, trials=tuple(both_ways(each.trials))) for each in people[1:]]
        first = replace(people[0], trials=tuple(both_ways(people[0].trials, lost)))
        return first, effects(study_of((first, *whole)))

    first, lacking = tested_of("PT2.5")
    _, complete = tested_of("")
    means = first.pulses["PT7.5", "max"]
    assert means.displacement == pytest.approx(np.mean([peak for peak, _ in means.by_direction.values()]))
    wanted = {"quantity": "peak displacement", "task": "PT", "first": "PT7.5", "second": "PT22.5"}
    one_way = first.pulses["PT7.5", "max"].by_direction["20"][0] - first.pulses["PT22.5", "max"].by_direction["20"][0]
    # 1.5 times as far on average over both directions as in the first alone.
    change = row(complete.pairs, **wanted)["difference"] - row(lacking.pairs, **wanted)["difference"]
    assert change == pytest.approx(0.5 * one_way / 5)
    said = [line for line in lacking.remarks if line not in complete.remarks]
    assert [line.split(",")[0] for line in said] == ["peak displacement", "pulse admittance"]
    assert all("PT: S01 without pulses at 200°, which have no peak" in line for line in said)
    assert row(lacking.rows, quantity="peak displacement", task="PT")["people"] == 5


def test_a_direction_counts_once_however_many_trials_it_has(people):
    trial = next(t for t in people[0].trials if t.condition == "RT0")._replace(displacement=0.1, force=50.0)
    far = trial._replace(pulse_direction_deg=-160.0, displacement=0.4)
    means = replace(people[0], trials=(trial, trial, far)).pulses["RT0", "min"]
    assert (means.displacement, means.admittance) == pytest.approx((0.25, 0.005))
    assert means.by_direction.keys() == {"20", "200"}


def without_peaks(people, lost):
    """These people, of whose trials some have no peak."""
    return tuple(
        replace(
            each,
            trials=tuple(
                t._replace(displacement=math.nan, force=math.nan) if lost(each, t) else t for t in each.trials
            ),
        )
        for each in people
    )


def test_levels_that_nobody_has_peaks_of_do_not_end_the_tests(people):
    own = renamed(study_of(people))
    both = tuple(
        replace(each, pulse_levels=(1.5, 3.0)) if each.name[4:] in ("PT0", "PT7.5") else each
        for each in own.protocol.conditions
        if each.name[4:] in ("PT0", "PT7.5")
    )
    own = replace(own, protocol=replace(own.protocol, conditions=both, pulse_unit_condition=""))
    compared = "own PT0, own PT7.5 (level {})"
    assert row(effects(own).rows, quantity="peak displacement", conditions=compared.format(3))
    # Of two people out of five the largest level is too little for a test.
    few = without_peaks(own.people, lambda each, t: abs(t.pulse_level) == 3.0 and each.name not in ("S01", "S02"))
    found = effects(replace(own, people=few))
    assert row(found.rows, quantity="peak displacement", conditions=compared.format(1.5))["people"] == 5
    assert found.levels == {}
    gone = without_peaks(own.people, lambda _, t: abs(t.pulse_level) == (3.0 if t.condition == "own PT0" else 1.5))
    found = effects(replace(own, people=gone))
    assert "peak displacement, PT: not tested, as no level of pulses was measured in every condition" in found.remarks


@pytest.mark.slow(reason="analyses several studies")
def test_a_condition_of_which_no_pulse_was_measured_is_named(people):
    lost = effects(study_of(without_peaks(people, lambda _, t: t.condition == "PT2.5")))
    assert "peak displacement, PT: without PT2.5, in which no pulse was measured" in lost.remarks
    assert row(lost.rows, quantity="peak displacement", task="PT")["conditions"] == "PT0, PT7.5, PT22.5 (level max)"


def test_too_few_people_are_told():
    found = effects(study_of(people_of(("S01", "S02"))))
    assert found.rows == ()
    assert found.admittance == {}
    assert all(math.isnan(p) for p in found.parameters.values())
    assert "k_s, PT: not tested, as 2 people have a value in every condition" in found.remarks


@pytest.mark.slow(reason="analyses several studies")
def test_conditions_and_levels_of_ones_own_are_tested_likewise(people, tested):
    own = effects(renamed(study_of(people)))
    assert [row["p"] for row in own.rows] == [row["p"] for row in tested.rows]
    assert [row["t"] for row in own.pairs] == [row["t"] for row in tested.pairs]
    assert {row["published_p"] for row in (*own.rows, *own.pairs)} == {""}
    assert own.agreement == (0, 0)
    assert own.parameters == tested.parameters
    assert own.levels == {f"own {name}": p for name, p in tested.levels.items()}
    assert own.levels.keys() == {"own PT0", "own PT7.5"}
    assert row(own.rows, test="dependent t", task="PT", conditions="own PT0, level 3 against 1.5")
    for task, effect in tested.admittance.items():
        np.testing.assert_array_equal(own.admittance[task].p, effect.p)


def test_pulses_without_a_level_in_common_are_not_compared(people):
    study = study_of(people)
    other = replace(study.protocol.condition("RT7.5"), pulse_levels=(2.0,))
    conditions = tuple(other if each.name == "RT7.5" else each for each in study.protocol.conditions)
    apart = replace(study, protocol=replace(study.protocol, conditions=conditions))
    stronger = tuple(
        replace(
            each,
            trials=tuple(t._replace(pulse_level=2.0) if t.condition == "RT7.5" else t for t in each.trials),
        )
        for each in people
    )
    assert len(compared_pulses(study, "RT")) == 4
    assert compared_pulses(replace(apart, people=stronger), "RT") == ()
    assert compared_pulses(study, "RT", predicted=True) == (("RT2.5", "min"), ("RT7.5", "min"), ("RT22.5", "min"))
