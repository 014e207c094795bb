"""What the sections of the report say of findings that few people have, or that were given to them."""

import math
import re
from dataclasses import replace

import pytest
from invented import people_of, study_of

from armperturb.cohort import draw_person
from armperturb.environment import Strap
from armperturb.pages.page import Picture, rendered
from armperturb.study.comparison.effects import effects
from armperturb.study.recording.settings import StudySettings
from armperturb.study.report.findings import fall_is_given, findings, set_levels
from armperturb.study.report.sections import lost_pulses, named_by_displacement, of_people, sections
from armperturb.study.report.words import WORDS
from armperturb.study.results.mean_admittance import by_task, differ_in_amplitude

TABLES = ("summary", "fits", "estimates", "conditions", "parameters_summary")
"""That sections read."""


def summary(study, **changed):
    """The text of the first screen, with other findings where some are given."""
    shown = {
        **{"rows": [1], "findings": {**findings(study), **changed}, "alone": None, "given": False, "relaxation": ""},
        "fits": [],
        "set_levels": set_levels(study, findings(study).get("amplitude_PT") or findings(study).get("condition_PT")),
        **{"flagged": 0, "reasons": {}, "differ": math.nan, "lost_pulses": lost_pulses(study)},
    }
    n = len(study.names)
    people = f"{n} {'person' if n == 1 else 'people'}"
    page = rendered(
        *("armperturb.study.report", "page.html", {"summary": shown}, WORDS["sections"], {}),
        study=study,
        people=people,
        intervals="",
    )
    return re.sub(r"\s+", " ", re.sub("<[^>]+>", "", page.split('<section id="summary">')[1]))


def section(study, name, drawn=(), **shown):
    """The text of a section of people who were simulated, with the captions of these figures."""
    pictures = dict.fromkeys(drawn, Picture("<svg/>", 1.0, 1.0))
    page = rendered(
        *("armperturb.study.report", "page.html", {name: {"rows": [], **shown}}, WORDS["sections"], pictures),
        **{
            "study": study,
            "first": "S01",
            "over_people": "",
            "people": "",
            "multisine": {"lines": 72, "clusters": 18, "period": 20},
        },
    )
    return re.sub(r"\s+", " ", re.sub("<[^>]+>", "", page.split(f'<section id="{name}">')[1]))


def stills(study, tasks):
    """The text of the section with stills of pulses, without films."""
    page = rendered(
        *("armperturb.study.report", "page.html", {"stills": {"tasks": tasks, "films": (), "reason": ""}}),
        *(WORDS["sections"], {"stills": Picture("<svg/>", 1.0, 1.0)}),
        study=study,
        first="S01",
    )
    return re.sub(r"\s+", " ", re.sub("<[^>]+>", "", page.split('<section id="stills">')[1]))


def test_stills_are_of_the_tasks_that_have_pulses_from_rest(study):
    text = stills(study, ["PT", "RT"])
    assert "The hardest pulse from rest of each task, from above." in text
    assert "Two recorded trials of S01 from above" in text
    for task, doing in (("PT", "keeping position"), ("RT", "relaxing")):
        text = stills(study, [task])
        assert f"The hardest pulse from rest of {task}, from above." in text
        assert f"A recorded trial of S01 from above: the hardest pulse from rest while {doing}." in text
    assert "about a fixed shoulder" not in text
    strapped = replace(study, protocol=replace(study.protocol, strap=Strap()))
    assert "The arm is drawn about a fixed shoulder." in stills(strapped, ["PT"])


@pytest.fixture(scope="module")
def study():
    return study_of(people_of())


def test_findings_of_some_people_say_of_how_many(study):
    text = summary(study)
    assert "of 3 people)" not in text
    assert "intervals of the mean over 3 people." in text
    fewer = [case for case in study.cases if case.name == "S01" or case.condition.name != "RT7.5"]
    text = summary(replace(study, cases=tuple(fewer)))
    assert "as when holding the position (1 of 3 people)." in text
    assert "intervals of the mean over people." in text


def test_means_of_some_people_say_of_how_many(study):
    assert of_people(study, {"PT7.5": 3, "RT7.5": 3}) == of_people(study, {}) == "3 people"
    assert of_people(study, {"PT7.5": 2}) == "2 of 3 people"
    assert of_people(study, {"PT7.5": 2, "RT7.5": 2}) == "3 people (2 in PT7.5, 2 in RT7.5)"  # who may be others
    assert of_people(study, {"PT7.5": 3, "RT7.5": 1}) == "3 people (3 in PT7.5, 1 in RT7.5)"


def test_a_finding_is_said_with_the_doubt_about_it(study):
    settled = replace(findings(study)["tasks"], mean=4.0, lower=2.0, upper=8.0)
    for finding, said in ((settled, ""), (replace(settled, lower=0.5, upper=32.0), "; the interval includes 1")):
        assert f"as when holding the position{said}." in summary(study, tasks=finding)
        text = section(study, "admittance", findings={"tasks": finding}, tasks={}, main={})
        assert f"as people who hold the position{said}. " in text
        assert f"to the multisine before it{said}." in summary(study, excess=finding)


def test_a_stiffness_that_sits_on_its_bound_is_no_finding(study):
    row = {"parameter": "k_s", "unit": "Nm/rad", "estimated_mean": 50.0, "estimated_sd": 5.0}
    row |= {f"{of}_{what}": math.nan for of in ("thesis", "published") for what in ("mean", "sd")}
    rows = [{**row, "condition": name} for name in ("PT7.5", "RT7.5")]
    shown = {"rows": rows, "main": ["PT7.5", "RT7.5"], "flagged": {"PT7.5": (3, 3)}, "tasks": {}}
    known, unknown = (
        section(study, "parameters", **shown, stuck=stuck).replace("&nbsp;", " ") for stuck in ({}, {"PT7.5": (3, 3)})
    )
    assert "The stiffness of the shoulder is 50.0 ± 5.0 Nm/rad in PT7.5 and 50.0 ± 5.0 Nm/rad in RT7.5" in known
    assert "In PT7.5, 3 of 3 fits are flagged" in known
    assert "The stiffness of the shoulder is not known in PT7.5: it is at its bound in 3 of 3 fits." in unknown
    assert "The stiffness of the shoulder is 50.0 ± 5.0 Nm/rad in RT7.5" in unknown
    assert "are flagged" not in unknown


def test_a_study_whose_pulses_were_all_lost_says_so_at_the_top(study):
    assert "No pulse" not in summary(study)
    people = tuple(replace(person, trials=()) for person in study.people)
    text = summary(replace(study, people=people))
    planned = sum(trial.level > 0 for trial in study.protocol.planned_trials())
    assert f"No pulse could be measured in any of {planned * 3} trials: the section What was left out" in text


def test_what_is_said_of_conditions_and_method_is_true_of_other_protocols(study):
    made = StudySettings(subjects=3)
    numbers, practice, forces = (
        "Numbers after them are the intended",
        "How the forces were chosen",
        "In a practice session",
    )
    thesis = replace(study, made=made)
    assert named_by_displacement(thesis)
    conditions = [c for c in study.protocol.conditions if c.pulse_levels and not c.has_multisine]
    alone = replace(thesis.protocol, conditions=tuple(conditions), pulse_unit_condition="", pulse_unit=10.0)
    pulses = replace(thesis, protocol=alone)
    weaker = replace(study.protocol.condition("PT7.5"), rms_displacement=0.002)
    other = replace(thesis, protocol=replace(thesis.protocol, conditions=(weaker,)))
    assert not named_by_displacement(pulses)
    assert not named_by_displacement(other)
    for each, has in ((thesis, True), (pulses, False)):
        shown = {"drifting": [], "named_by_displacement": named_by_displacement(each)}
        text = section(each, "conditions", **shown, holding=3.04)
        assert [words in text for words in (numbers, practice)] == [has, has]
        assert ("at equal movement, holding takes 3.0 times the force of relaxing." in text) == has
        assert "at equal movement" not in section(each, "conditions", **shown, holding=math.nan)
        text = section(each, "method")
        assert [words in text for words in (forces, "A multisine force", "Analysis.")] == [has, has, has]
    assert "Perturbation. A pulse of force." in text


def test_one_person_has_no_intervals(study):
    cases = tuple(case for case in study.cases if case.name == "S01")
    text = summary(replace(study, cases=cases, people=study.people[:1]))
    assert "In brackets" not in text
    assert "there is no interval. No fit is flagged." in text


def test_the_fall_is_given_where_it_is_one_and_levels_differ(study):
    finding = replace(findings(study)["amplitude_PT"], mean=0.7)
    person = draw_person(0, 0)
    nonlinear = replace(study, cohort=(person,))
    assert (finding.above, finding.below) == ("PT22.5", "PT2.5")
    assert fall_is_given(nonlinear, finding)
    assert not fall_is_given(nonlinear, replace(finding, mean=1.2))
    assert not fall_is_given(nonlinear, replace(finding, above="large", below="small"))
    assert not fall_is_given(replace(study, cohort=(replace(person, levels={}),)), finding)
    assert not fall_is_given(nonlinear, None)


def with_conditions(study, **changes):
    """The study, whose conditions with a multisine in the position task have other values, in their order."""
    changed = iter(zip(*changes.values(), strict=True))
    conditions = tuple(
        replace(each, **dict(zip(changes, next(changed), strict=True)))
        if each.task == "PT" and each.has_multisine
        else each
        for each in study.protocol.conditions
    )
    by_name = {each.name: each for each in conditions}
    cases = tuple(replace(case, condition=by_name[case.condition.name]) for case in study.cases)
    return replace(study, protocol=replace(study.protocol, conditions=conditions), cases=cases)


def test_a_difference_in_co_contraction_is_not_called_one_in_movement(study):
    assert "Larger movements. While relaxing" in summary(study)
    assert "Co-contraction differs" not in summary(study)
    both = with_conditions(study, co_contraction=(0.6, 1.0, 1.5))
    assert "Co-contraction differs: the protocol sets" in (text := summary(both))
    assert "Larger movements. While relaxing" in text
    levels = with_conditions(study, co_contraction=(0.6, 1.0, 1.5), rms_displacement=(0.0075,) * 3, reached=(1.0,) * 3)
    text = summary(levels)
    assert "sets 0.60 times people's own in PT2.5 and 1.5 times in PT22.5" in text
    assert re.search("Conditions with the same intended movement. While holding, admittance (rises|falls)", text)
    assert findings(levels).keys() == {"tasks", "amplitude_RT", "condition_PT", "excess"}
    assert not fall_is_given(replace(levels, cohort=(draw_person(0, 0),)), findings(levels)["condition_PT"])


def test_linear_people_differ_by_the_co_contraction_that_the_protocol_sets(study):
    linear = replace(study, made=StudySettings(subjects=3, muscles="linear"))
    for each, is_set in ((linear, False), (with_conditions(linear, co_contraction=(0.6, 1.0, 1.5)), True)):
        conditions = by_task(each)["PT"]
        assert differ_in_amplitude(conditions) != is_set
        shown = {"findings": {}, "tasks": {"PT": conditions}, "amplitudes": {"PT": not is_set}, "main": {}}
        shown["in_all"] = {"PT": "3 people"}
        text = section(each, "admittance", ["admittance_by_amplitude_PT"], **shown, effects=effects(each))
        assert ("differs here is how much they co-contract, noise, and how much the arm" in text) == is_set
        assert ("from all trials, darker for larger movements" in text) != is_set


def test_tests_that_were_not_made_are_told_though_there_is_none(study):
    def shown(people):
        told = replace(study, people=people, cases=())
        tested = replace(effects(told), rows=(), pairs=(), admittance={}, remarks=("b_s, PT: not tested",))
        tables = {key: [] for key in TABLES}
        return sections(told, None, tested, tables, yielding=None, shoulder=None, drawn=())

    assert shown(study.people)["statistics"]["effects"].remarks
    assert "statistics" not in shown(study.people[:2])


def test_recordings_of_people_are_not_called_simulated(study):
    joint = {"table": "F.2", "condition": "PT2.5", "quantity": "rms_velocity_s", "path_mean": 0.2, "path_sd": 0.1}
    joint |= {f"{of}_{what}": math.nan for of in ("simulated", "published") for what in ("mean", "sd")}
    shown = {"joints": [joint], "limits": [], "printed_limits": [], "shoulder": None, "names": {}}
    text = section(study, "kinematics", ["joint_rotations"], **shown, has_truth=False)
    assert "from the handle's path. Dots" in text
    assert "simulated" not in text
    assert "as simulated. Dots" in section(study, "kinematics", ["joint_rotations"], **shown, has_truth=True)
    assert "The hand holds the manipulator, which" in section(study, "method")
    simulated = section(replace(study, made=StudySettings()), "method", ["pulse_signal", "perturbation"])
    assert "The hand holds a simulated manipulator, which" in simulated
    assert "half a sine" in simulated
    assert "full power up to 1.5" in simulated
    of_people = section(study, "method", ["pulse_signal", "perturbation"])
    assert "and the pulse enlarged." in of_people
    assert "density of its multisine, if it holds a whole period." in of_people
