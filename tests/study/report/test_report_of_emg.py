"""The section EMG of people whose amplitudes have different references."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from invented_emg import noise, recorded

from armperturb.recording_files import save_recording
from armperturb.study.protocol import THESIS
from armperturb.study.report.emg import emg_drawings, emg_rows, emg_section
from armperturb.study.results import emg
from armperturb.study.results.cases import Case, arms_of
from armperturb.study.results.emg import Cocontraction, Level, PersonEmg, Reflex, person_emg
from armperturb.subject import POSITION, RELAX


def person(name, unit, value):
    """EMG of one value [-]."""
    rows = [Cocontraction(condition, "during", "elbow", value, 0.5) for condition in ("PT7.5", "PT22.5")]
    return PersonEmg(
        name=name,
        unit=unit,
        limit=0.02 if "maximal" in unit else 0.1,
        levels=(Level("RT7.5", "during", "biceps", value, value / 2, 4, 0.9, False),),
        cocontraction=tuple(rows),
    )


MAXIMAL = "% of maximal contraction"
PEOPLE = (person("S1", "% of PT22.5", 0.9), *(person(f"S{n}", MAXIMAL, 0.01 * n) for n in (2, 3, 4)))


def test_means_tests_and_figures_are_of_people_of_one_unit():
    study = SimpleNamespace(emg=PEOPLE, protocol=THESIS)
    section = emg_section(study)
    assert section["unit"] == MAXIMAL
    assert section["others"] == ["S1 (% of PT22.5)"]
    assert [row["mean"] for row in section["index"]] == pytest.approx([3.0, 3.0])
    assert section["levels"][0]["mean"] == pytest.approx(3.0)
    assert {row["n"] for row in section["tests"]} == {3}
    assert "2 % of maximal contraction in S2, S3, S4" in section["relaxation"]
    assert "10 % of PT22.5 in S1" in section["relaxation"]
    tables = emg_rows(study)
    assert {row["subject"]: row["unit"] for row in tables["emg_cocontraction"]}["S1"] == "% of PT22.5"
    # In percent, as their unit says.
    assert [row["amplitude"] for row in tables["emg_levels"]] == pytest.approx([90.0, 2.0, 3.0, 4.0])
    assert [row["lower_95"] for row in tables["emg_levels"]] == pytest.approx([45.0, 1.0, 1.5, 2.0])
    assert [row["index"] for row in tables["emg_cocontraction"]] == pytest.approx(np.repeat([90.0, 2.0, 3.0, 4.0], 2))
    assert {row["ratio"] for row in tables["emg_cocontraction"]} == {0.5}
    assert len(emg_drawings(study)["emg_cocontraction"].args[0]) == 3


@pytest.mark.slow(reason="simulates trials with EMG")
def test_contractions_that_last_for_a_part_of_their_trial_have_no_level(tmp_path):
    contracted = np.zeros(20_000)
    contracted[2_000:12_000] = 1.0
    amplitude = np.stack([contracted, 0.5 * contracted, np.full(20_000, 0.1), np.zeros(20_000)])
    conditions = ["MVC", "half", "PT7.5", "REST"]
    volts = amplitude[:, None] * noise((4, 2, 20_000)) + 1e-3 * np.random.default_rng(0).standard_normal((4, 2, 20_000))
    recording = recorded(volts, conditions)
    save_recording(recording, tmp_path / "A.nc")
    told = person_emg("A", tmp_path / "A.nc", contractions=("half",))
    assert told.unit == MAXIMAL
    assert {row.condition for row in told.levels} == {"PT7.5", "REST"}
    assert {row.condition for row in told.cocontraction} == {"PT7.5", "REST"}
    assert [row.amplitude for row in told.levels if row.condition == "PT7.5"] == pytest.approx([0.1, 0.1], rel=0.1)


@pytest.mark.slow(reason="simulates trials with EMG")
def test_a_contraction_recorded_with_the_relax_task_is_no_relaxation(tmp_path):
    amplitude = np.array([0.5, 0.1, 0.01, 0.0])
    volts = amplitude[:, None, None] * noise((4, 2, 20_000))
    volts += 1e-3 * np.random.default_rng(0).standard_normal(volts.shape)
    recording = recorded(volts, ["half", "PT7.5", "RT7.5", "REST"], task=["RT", "PT", "RT", "RT"])
    save_recording(recording, tmp_path / "A.nc")
    told = person_emg("A", tmp_path / "A.nc", contractions=("half",))
    assert told.unit == "% of half"
    assert not any("nothing is known of relaxation" in line for line in told.remarks)
    assert {row.condition for row in told.levels if row.is_active} == {"PT7.5"}
    assert {row.condition for row in told.cocontraction} == {"PT7.5", "RT7.5", "REST"}


def test_conditions_are_compared_in_the_order_of_their_movement_wherever_the_protocol_has_them():
    backwards = replace(THESIS, conditions=THESIS.conditions[::-1])
    for protocol in (THESIS, backwards):
        rows = emg_rows(SimpleNamespace(emg=PEOPLE, protocol=protocol))["emg_tests"]
        assert {row["conditions"] for row in rows} == {"PT7.5, PT22.5"}
        drawn = emg_drawings(SimpleNamespace(emg=PEOPLE, protocol=protocol))["emg_cocontraction"].args[1]
        assert [each.name for each in drawn if each.task == "PT" and each.has_multisine] == ["PT2.5", "PT7.5", "PT22.5"]


def test_people_without_an_index_have_no_figure_of_it():
    relaxed = PersonEmg(name="S0", unit="% of RT2.5", limit=0.1, levels=PEOPLE[0].levels)
    assert emg_drawings(SimpleNamespace(emg=(relaxed,), protocol=THESIS)) == {}
    # Others go before them, however few they are.
    assert emg_section(SimpleNamespace(emg=(relaxed, relaxed, *PEOPLE[:1]), protocol=THESIS))["unit"] == "% of PT22.5"


@pytest.mark.slow(reason="simulates trials with EMG")
def test_the_grip_of_each_conditions_arm_is_taken_off_and_what_has_none_is_named(tmp_path, monkeypatch):
    volts = np.array([0.5, 0.1])[:, None, None] * noise((2, 2, 20_000))
    save_recording(recorded(volts, ["PT7.5", "RT7.5"], task=["PT", "RT"]), tmp_path / "A.nc")
    used = {}

    def respond(trials, _, arm):
        used[trials.label] = arm
        return SimpleNamespace(remarks=(), responses=pd.DataFrame(columns=["muscle", *Reflex._fields[2:]]))

    monkeypatch.setattr(emg, "reflexes", respond)
    told = person_emg("A", tmp_path / "A.nc", arms={"PT7.5": POSITION})
    assert used == {"PT7.5": POSITION, "RT7.5": None}
    (said,) = (line for line in told.remarks if "the handle's movement passes for the hand's" in line)
    assert said.startswith("A: delays from rotation to EMG in RT7.5 may be too short")
    everywhere = person_emg("A", tmp_path / "A.nc", arms={"PT7.5": POSITION, "RT7.5": RELAX})
    assert not any("passes for the hand's" in line for line in everywhere.remarks)


def test_pulses_alone_have_the_arm_of_another_condition_of_the_task():
    conditions = [THESIS.condition(name) for name in ("PT0", "PT2.5", "PT7.5", "RT0", "RT7.5")]
    arms = {"PT2.5": replace(POSITION, k_h=1.0), "PT7.5": replace(POSITION, k_h=2.0)}

    def case(condition):
        arm = arms.get(condition.name)
        done = None if arm is None else SimpleNamespace(fit=SimpleNamespace(arm=arm))
        return Case(condition=condition, name="A", recording=None, identification=done, left_out=())

    cases = [case(each) for each in conditions if each.has_multisine]
    assert arms_of(cases, conditions) == arms | {"PT0": arms["PT2.5"]}
