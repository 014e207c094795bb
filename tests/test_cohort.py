"""Draws around the presets, and people with a body, whose muscles are linear or yield."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.cohort import (
    BODY,
    CUFF_AND_HANDLE_MASS,
    ELBOW_ANGLE_DEG,
    MAX_DEVIATION,
    MUSCLES,
    NONLINEAR_MARGIN,
    SHOULDER_ANGLE_DEG,
    SPREAD,
    SPREAD_ALIKE,
    SPREAD_LEVEL,
    SPREAD_OWN,
    STABILITY_MARGIN,
    Person,
    average_person,
    draw_cohort,
    draw_person,
    draw_subject,
)
from armperturb.environment import Environment
from armperturb.study.published import tables as published
from armperturb.study.report.tables import true_value
from armperturb.subject import PRESETS, at_level


@pytest.mark.parametrize(("preset", "condition"), [("relax", "RT7.5"), ("position", "PT7.5")])
def test_spread_is_the_published_one(preset, condition):
    for name, sd in SPREAD[preset].items():
        assert published.parameter(condition, name).sd == pytest.approx(sd, rel=1e-12)


@pytest.mark.parametrize("preset", PRESETS)
def test_people_are_stable_different_and_near_the_mean(preset):
    people = [draw_subject(preset, seed) for seed in range(60)]
    assert max(largest_real_pole(person, Environment()) for person in people) < -STABILITY_MARGIN
    for name, sd in SPREAD[preset].items():
        values = np.array([true_value(person, name) for person in people])
        assert len(np.unique(values)) == len(people)
        # Redrawing shifts and narrows the distribution, by less than half an SD and half of the spread.
        assert abs(values.mean() - true_value(PRESETS[preset], name)) < 0.5 * sd + 3 * sd / np.sqrt(len(people))
        assert 0.5 * sd < values.std() < 1.4 * sd
        if name[:2] in ("kv", "kp"):
            assert values.min() >= 0


def test_same_seed_same_person():
    assert draw_subject("position", 3, name="A") == draw_subject("position", 3, name="A")
    assert draw_subject("position", 3) != draw_subject("position", 4)


def test_unknown_preset_is_named():
    with pytest.raises(ValueError, match="preset = 'tense'; expected one of relax, position"):
        draw_subject("tense", 0)


@pytest.mark.parametrize("muscles", MUSCLES)
def test_person_depends_on_seed_and_number_only(muscles):
    cohort = draw_cohort(4, 7, muscles=muscles)
    assert cohort[:2] == draw_cohort(2, 7, muscles=muscles)
    assert cohort[3] == draw_person(7, 3, muscles=muscles)
    other = draw_cohort(4, 8, muscles=muscles)
    assert len({person.height for person in cohort + other}) == 8
    assert [person.name for person in cohort] == ["S01", "S02", "S03", "S04"]
    assert pickle.loads(pickle.dumps(cohort)) == cohort
    assert len({hash(person) for person in cohort}) == 4


@pytest.mark.parametrize("muscles", MUSCLES)
def test_one_body_in_both_tasks_and_own_muscles_in_each(muscles):
    for person in draw_cohort(20, 0, muscles=muscles):
        position, relax = person.subjects["PT"], person.subjects["RT"]
        assert (position.task, relax.task) == ("PT", "RT")
        for name in ("name", "l_h", "l_f", "m_h", "m_f", "theta_s_deg", "theta_e_deg"):
            assert getattr(position, name) == getattr(relax, name)
        assert position.name == person.name
        # Winter (2009): upper arm 0.186 of the height and 0.028 of the mass; forearm and hand 0.022 of the mass.
        assert position.l_h == pytest.approx(0.186 * person.height)
        assert 0.146 * person.height < position.l_f < (0.146 + 0.108) * person.height
        assert position.m_h == pytest.approx(0.028 * person.mass)
        assert position.m_f == pytest.approx(0.022 * person.mass + CUFF_AND_HANDLE_MASS)
        assert position.k_s > (5 if muscles == "linear" else 2) * relax.k_s
        for subject in (position, relax):
            assert (subject.muscle is None) == (muscles == "linear")
            assert largest_real_pole(replace(subject, muscle=None), Environment()) < -STABILITY_MARGIN


def test_muscles_change_no_body():
    linear, nonlinear = (draw_cohort(3, 5, muscles=muscles) for muscles in ("linear", "nonlinear"))
    assert draw_cohort(3, 5) == nonlinear
    for one, other in zip(linear, nonlinear, strict=True):
        assert (one.height, one.mass, one.subjects["PT"].posture.tolist()) == (
            other.height, other.mass, other.subjects["PT"].posture.tolist(),
        )  # fmt: skip
        assert not one.levels


@pytest.fixture(scope="module")
def nonlinear_people():
    return draw_cohort(60, 3)


@pytest.mark.slow(reason="poles of twenty people at all their levels")
def test_nonlinear_people_are_stable_at_their_levels_with_and_without_short_range_stiffness(nonlinear_people):
    for person in nonlinear_people[:20]:
        assert person.levels.keys() == average_person().levels.keys()
        assert min(person.levels.values()) > 0
        for task, subject in person.subjects.items():
            own = [level for condition, level in person.levels.items() if condition.startswith(task)]
            for level in (1.0, *own):
                arms = at_level(subject, level).linear_arms
                assert len(arms) == 2
                for arm in arms:
                    assert largest_real_pole(arm, Environment()) < -NONLINEAR_MARGIN


@pytest.mark.slow(reason="draws sixty nonlinear people")
def test_nonlinear_people_differ_around_the_average(nonlinear_people):
    people, average = nonlinear_people, average_person()
    for condition, level in average.levels.items():
        own = np.array([person.levels[condition] for person in people])
        assert len(np.unique(own)) == len(people)
        assert np.median(own / level) == pytest.approx(1.0, abs=0.8 * SPREAD_LEVEL)
    for task, mean in average.subjects.items():
        subjects = [person.subjects[task] for person in people]
        for quantity in ("b", "k"):
            ratio = np.array([subject.muscle_groups(quantity) for subject in subjects]) / mean.muscle_groups(quantity)
            assert len(np.unique(ratio)) == ratio.size
            # Redrawing shifts and narrows the distribution, by less than half an SD and half of the spread.
            sd = np.hypot(SPREAD_ALIKE[task], SPREAD_OWN[task])
            assert np.abs(np.log(ratio).mean(axis=0)).max() < 0.5 * sd + 3 * sd / np.sqrt(len(people))
            assert (np.log(ratio).std(axis=0) > 0.5 * sd).all()
            assert (np.log(ratio).std(axis=0) < 1.4 * sd).all()
        for name in ("short_range_stiffness", "elastic_limit_deg"):
            values = np.array([subject.muscle.of_elements(name) for subject in subjects])
            assert len(np.unique(values)) == values.size
        for name in ("loss_angle_deg", "recovery_time", "thinning_velocity", "spindle_saturation"):
            assert {subject.muscle.of_elements(name) for subject in subjects} == {mean.muscle.of_elements(name)}
        for name in ("b_h", "k_h", "Td_s", "fact_e"):
            assert {getattr(subject, name) for subject in subjects} == {getattr(mean, name)}


@pytest.mark.slow(reason="draws three hundred people")
def test_cohort_is_spread_as_published():
    people = draw_cohort(300, 1, muscles="linear")
    arms = [person.subjects["PT"] for person in people]
    # Draws are cut at 2.5 SD, which takes 6 % off the SD; 0.2 SD is more than three standard errors of either.
    for field, (mean, sd) in {"theta_s_deg": SHOULDER_ANGLE_DEG, "theta_e_deg": ELBOW_ANGLE_DEG}.items():
        values = [getattr(arm, field) for arm in arms]
        assert np.mean(values) == pytest.approx(mean, abs=0.2 * sd)
        assert np.std(values) == pytest.approx(sd, rel=0.2)
        assert np.abs(np.array(values) - mean).max() <= MAX_DEVIATION * sd
    for preset, task in (("position", "PT"), ("relax", "RT")):
        for name, sd in SPREAD[preset].items():
            if name not in BODY:
                values = np.array([getattr(person.subjects[task], name) for person in people])
                # Stability needs damping: redrawing moves b_e by half an SD, here as in `draw_subject`.
                assert abs(values.mean() - getattr(PRESETS[preset], name)) < 0.7 * sd
                assert 0.5 * sd < values.std() < 1.3 * sd
    # Bodies are not drawn from the thesis's masses, yet are no strangers to them (table C.18).
    assert np.mean([arm.m_h for arm in arms]) == pytest.approx(2.06, abs=0.1)
    assert np.mean([arm.m_f for arm in arms]) == pytest.approx(1.86, abs=0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((0, 1), "cohort: n = 0; expected"), ((2, -1), "cohort: seed = -1; expected")],
)
def test_impossible_cohort_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        draw_cohort(*arguments)


@pytest.mark.parametrize(
    ("arguments", "field"), [((1.0, 0), "n = 1.0"), ((1, None), "seed = None"), ((1, 1.5), "seed")]
)
def test_numbers_of_a_cohort_are_whole(arguments, field):
    with pytest.raises(TypeError, match=rf"cohort: {field}.*; expected a whole number"):
        draw_cohort(*arguments)


@pytest.mark.parametrize("draw_some", [draw_cohort, draw_person])
def test_unknown_muscles_are_refused(draw_some):
    with pytest.raises(ValueError, match="cohort: muscles = 'soft'; expected one of nonlinear, linear"):
        draw_some(1, 0, muscles="soft")


@pytest.mark.parametrize(
    ("level", "error"),
    [(0.0, ValueError), (-0.5, ValueError), (np.inf, ValueError), (np.nan, ValueError), ("1", TypeError)],
)
def test_impossible_levels_are_refused(level, error):
    with pytest.raises(error, match=r"Person: levels\['PT0'\] = .*; expected a"):
        Person(name="A", height=1.8, mass=75.0, subjects={}, levels={"PT2.5": 1.0, "PT0": level})


def test_subject_of_another_task_is_refused():
    with pytest.raises(ValueError, match="subjects\\['PT'\\] has the task 'RT'"):
        Person(name="A", height=1.8, mass=75.0, subjects={"PT": PRESETS["relax"]})


def test_a_name_that_is_none_is_refused():
    for name, error in ((None, TypeError), ("", TypeError), ("a\nb", ValueError)):
        with pytest.raises(error, match="Person: name = "):
            Person(name=name, height=1.8, mass=75.0, subjects={})
