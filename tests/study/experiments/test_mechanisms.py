"""Why people yield: arms with and without each mechanism of the muscle law."""

import runpy
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from armperturb.cohort import average_person, draw_cohort
from armperturb.environment import Environment
from armperturb.files import write_whole
from armperturb.muscle_law import MuscleLaw
from armperturb.pages.formats import MISSING, digits
from armperturb.study.experiments import mechanisms as why
from armperturb.study.experiments.mechanisms import (
    AMPLITUDES,
    LINEAR,
    MECHANISMS,
    NEEDED,
    ONE_LEVEL,
    WHOLE,
    has_law,
    intrinsic_loop,
    variants,
    why_people_yield,
)
from armperturb.study.protocol import THESIS
from armperturb.study.recording.manifest import Manifest
from armperturb.study.recording.settings import StudySettings
from armperturb.study.report import report
from armperturb.study.report.figures import mechanisms as yielding_figures
from armperturb.study.report.figures import rig as rig_figures
from armperturb.study.report.report import write_report
from armperturb.study.results.study_result import StudyResult

ROOT = Path(__file__).parents[3]
ALL_ON = MuscleLaw(
    short_range_stiffness=10.0,
    elastic_limit_deg=0.7,
    elastic_limit_spread=0.5,
    elastic_limit_slope=0.02,
    loss_angle_deg=20.0,
    thinning_velocity=1.0,
    spindle_saturation=1.0,
    spindle_direction=0.5,
)


def with_law(law, **levels):
    average = average_person()
    subjects = {task: replace(subject, muscle=law) for task, subject in average.subjects.items()}
    return replace(average, subjects=subjects, levels=levels)


def test_each_arm_lacks_one_mechanism():
    person = with_law(ALL_ON, PT0=0.5)
    arms = variants(person)
    assert list(arms) == [WHOLE, LINEAR, *MECHANISMS, ONE_LEVEL]
    assert arms[WHOLE] == person
    assert arms[ONE_LEVEL] == replace(person, levels={})
    off = asdict(MuscleLaw())
    for name, fields in MECHANISMS.items():
        for task, subject in person.subjects.items():
            expected = {**asdict(ALL_ON), **{field: off[field] for field in fields}}
            assert arms[name].subjects[task] == replace(subject, muscle=MuscleLaw(**expected))
    assert all(subject.muscle is None for subject in arms[LINEAR].subjects.values())


def test_mechanisms_that_a_person_lacks_are_not_switched_off():
    assert list(variants(with_law(MuscleLaw(thinning_velocity=1.0)))) == [WHOLE, LINEAR, "damping does not thin"]


def test_linear_people_do_not_yield():
    with pytest.raises(ValueError, match="'S01' has linear muscles; expected a muscle law"):
        why_people_yield(draw_cohort(1, 0, muscles="linear")[0])


def test_linear_muscle_knows_no_amplitude(explained):
    rest, moved = (explained.responses[LINEAR, name] for name in ("RT0", "RT22.5"))
    assert moved.peak / rest.peak == pytest.approx(1.0, abs=0.03)
    # What is left of the multisine is part of the largest force.
    assert explained.pulse_rise(LINEAR) == pytest.approx(1.0, abs=0.1)
    assert explained.rise(LINEAR, "RT22.5", "RT2.5") == pytest.approx(1.0, abs=0.02)
    assert explained.rise(LINEAR, "PT2.5", "PT22.5") == pytest.approx(1.0, abs=0.02)
    assert explained.rise(WHOLE, "RT22.5", "RT2.5") > 1.2


def test_a_law_that_is_off_is_linear_muscle(explained):
    assert explained.variants == (WHOLE, LINEAR, "no short-range stiffness")
    assert not explained.unstable
    for condition in NEEDED:
        off, linear = (explained.responses[name, condition] for name in (explained.variants[2], LINEAR))
        np.testing.assert_array_equal(off.gain, linear.gain)
        np.testing.assert_array_equal(off.distance, linear.distance)


def test_arms_that_are_the_same_are_simulated_once(explained):
    for condition in AMPLITUDES["PT"]:
        assert len({id(explained.responses[name, condition]) for name in explained.variants}) == 1


def test_rows_tell_responses_and_people(explained):
    *rows, people = explained.rows()
    assert [row["arm"] for row in rows] == list(explained.variants)
    whole = rows[0]
    assert whole["peak_RT22.5_m"] == explained.responses[WHOLE, "RT22.5"].peak
    assert whole["RT_rise"] == explained.rise(WHOLE, "RT22.5", "RT2.5")
    after, before = (explained.responses[WHOLE, name].pulse_admittance for name in ("RT22.5", "RT0"))
    assert whole["pulse_admittance_RT22.5_over_RT0"] == after / before
    assert (people["RT_rise"], people["PT_fall"]) == (3.8, 1.5)
    assert people["peak_RT0_m"] == pytest.approx(0.1938)
    assert people.keys() == whole.keys()


@pytest.mark.slow(reason="simulates arms without mechanisms")
def test_unstable_arms_are_told(monkeypatch):
    # Damping that thins at once leaves the reflexes alone with their delay, unless they saturate too.
    law = MuscleLaw(thinning_velocity=0.02, spindle_saturation=0.02)
    person = with_law(law)
    monkeypatch.setattr(why, "CONDITIONS", ("PT7.5",))
    monkeypatch.setattr(why, "CALM", 5.0)
    found = why_people_yield(person, timestep=5e-3)
    name = "spindles do not saturate"
    assert (name, "PT7.5") not in found.responses
    assert found.unstable[name, "PT7.5"].startswith(("leaves the workspace", "self-sustained"))


SWINGS = "self-sustained oscillation: still moves 8 s after a pulse"


@pytest.mark.parametrize(
    ("rate_of_decay", "told"),
    [
        (0.0, SWINGS),
        (-0.5, SWINGS),
        (0.4, ""),
        (5.0, ""),
    ],
)
def test_arms_that_do_not_come_to_rest_are_told(rate_of_decay, told):
    time = np.arange(0.0, 8.5, 0.005)
    swing = 0.1 * np.exp(-rate_of_decay * time) * np.sin(2.0 * np.pi * 3.0 * time)
    handle = np.stack([np.zeros((2, len(time))), [swing, 0.0 * swing]], axis=-1)
    assert (
        why._oscillation(xr.Dataset({"displacement": (("trial", "time", "axis"), handle)}, attrs={"rate": 200.0}))
        == told
    )


def test_arms_without_stable_poles_are_told_and_not_simulated(monkeypatch):
    person = with_law(MuscleLaw(spindle_saturation=1.0))
    position = replace(person.subjects["PT"], **{f"kv_{joint}": 1e3 for joint in ("s", "e")})
    monkeypatch.setattr(why, "CONDITIONS", ("PT2.5", "PT7.5"))
    found = why_people_yield(replace(person, subjects={"PT": position}))
    assert not found.responses
    assert set(found.unstable) == {(name, condition) for name in found.variants for condition in ("PT2.5", "PT7.5")}
    assert set(found.unstable.values()) == {"is unstable for small or for large movements"}
    rows = found.rows()
    assert rows[0]["unstable_in"] == "PT2.5 PT7.5"
    assert np.isnan([rows[0]["PT_fall"], rows[0]["RT_rise"], rows[0]["peak_PT7.5_m"]]).all()


def test_loops_of_linear_muscle_are_spring_and_damper():
    subject = average_person().subjects["RT"]
    amplitude, frequency = np.array([0.01, 0.05, 0.1]), 1.25
    stretch, torque = intrinsic_loop(replace(subject, muscle=None), amplitude, frequency=frequency)
    k, b = (np.array(subject.muscle_groups(quantity)) for quantity in "kb")
    phase = np.linspace(0.0, 2.0 * np.pi, len(stretch))[:, None]
    np.testing.assert_allclose(stretch, amplitude * np.sin(phase), atol=1e-12)
    velocity = amplitude * 2.0 * np.pi * frequency * np.cos(phase)
    np.testing.assert_allclose(torque, k * stretch + b * velocity, atol=1e-9)


def test_loops_of_muscle_that_yields_soften_and_lose():
    subject = average_person().subjects["RT"]
    law = MuscleLaw(short_range_stiffness=10.0, elastic_limit_deg=0.7)
    still = replace(subject, b_s=0.0, b_se=0.0, b_e=0.0)
    small, large = (
        intrinsic_loop(replace(still, muscle=law), np.full(3, np.radians(degrees))) for degrees in (0.5, 5.0)
    )
    stiffness = np.array(subject.muscle_groups("k"))
    for (stretch, torque), share in ((small, 1.0), (large, 0.7 / 5.0)):
        top = stretch.argmax(axis=0)[0]
        np.testing.assert_allclose(torque[top] / stretch[top], stiffness + 10.0 * share, rtol=0.02)
    lost = [np.trapezoid(torque, stretch, axis=0) for stretch, torque in (small, large)]
    limit = np.radians(0.7)
    np.testing.assert_allclose(lost[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(lost[1], 4.0 * 10.0 * limit * (np.radians(5.0) - limit), rtol=0.02)


def test_figures_do_without_arms_that_are_unstable(explained):
    one = {(WHOLE, "RT2.5"): explained.responses[WHOLE, "RT2.5"]}
    for responses, n_lines in ((one, (3, 2, 0)), ({}, (0, 0, 0))):
        found = replace(explained, responses=responses)
        for draw, expected in zip(
            (yielding_figures.loops, yielding_figures.admittance, yielding_figures.pulses), n_lines, strict=True
        ):
            assert sum(len(ax.lines) for ax in draw(found).axes) == expected


def test_example_draws_and_tells(explained, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(why, "why_people_yield", lambda person: explained)
    monkeypatch.setattr("armperturb.plots.style.save_png", lambda figure, path, _: write_whole(path, b""))
    runpy.run_path(str(ROOT / "docs" / "figures" / "muscle_mechanisms.py"))["main"](tmp_path / "folder")
    assert {path.name for path in (tmp_path / "folder").iterdir()} == {
        f"yielding_{name}.png" for name in ("loops", "admittance", "pulses")
    }
    assert "people, published mean" in capsys.readouterr().out


def study_of(person):
    """A study of which nothing but who took part is known."""
    return StudyResult(
        made=Manifest.of([person], THESIS, StudySettings(seed=3)),
        protocol=THESIS,
        environment=Environment(),
        cohort=(person,),
        cases=(),
    )


def without_pictures(*args, **options):
    raise RuntimeError("no OpenGL context")


@pytest.fixture
def reported(explained, tmp_path, monkeypatch):
    """The text of the report on somebody, and how `why_people_yield` was asked."""
    monkeypatch.setattr(rig_figures, "render", without_pictures)

    def write(person, found=explained):
        asked = []
        monkeypatch.setattr(report, "why_people_yield", lambda *given, **named: asked.append((given, named)) or found)
        monkeypatch.setattr(report, "moving_shoulder", lambda *given, **named: None)  # tests/test_shoulder.py
        return write_report(study_of(person), tmp_path).read_text(encoding="utf-8"), asked

    return write


def test_report_says_why_the_first_person_yields(reported, explained, tmp_path):
    person = draw_cohort(1, 3)[0]
    assert has_law(person)
    text, asked = reported(person)
    assert asked == [((person,), {"environment": Environment(), "seed": 3})]
    assert text.index('<section id="summary"') < text.index('<section id="yielding"')
    assert text.index('<section id="yielding"') < text.index('<section id="left_out"')
    for name in ("loops", "admittance", "pulses"):
        assert f'id="figure-yielding_{name}"' in text
        assert (tmp_path / "figures" / f"yielding_{name}.svg").is_file()
    assert (tmp_path / "tables" / "yielding.csv").read_text(encoding="utf-8").startswith("arm,peak_RT0_m,peak_RT22.5_m")
    for row in explained.rows():
        assert f"<th>{row['arm']}</th>" in text
        assert f"<td>{digits(row['RT_rise'])}</td>" in text
    assert "Not shown" not in text


def test_report_says_which_arms_are_not_shown(reported, explained, blank_pictures):
    gone = {key: "still <swings>" for key in explained.responses if key[0] != WHOLE}
    kept = {key: response for key, response in explained.responses.items() if key not in gone}
    text, _ = reported(draw_cohort(1, 3)[0], replace(explained, responses=kept, unstable=gone))
    assert "Linear muscle, RT22.5: still &lt;swings&gt;." in text
    assert f"<th>{LINEAR}</th>\n" + 3 * f"<td>{MISSING}</td>" in text


def test_report_says_nothing_of_the_law_of_linear_people(reported):
    person = draw_cohort(1, 3, muscles="linear")[0]
    assert not has_law(person)
    text, asked = reported(person)
    assert not asked
    assert 'id="yielding"' not in text
