"""What the page of a joint tells its reader first."""

from dataclasses import replace

import numpy as np
import pytest

import armperturb
from armperturb.analysis.fit.whittle import LackOfFit
from armperturb.analysis.joint.identify import identify_joint
from armperturb.analysis.joint.model import JointStructure
from armperturb.analysis.joint.part_differences import PartDifferences
from armperturb.analysis.joint.remarks import remarks_on
from armperturb.analysis.page.joint_page import joint_verdict, write_joint_page
from armperturb.analysis.page.page import Origin
from armperturb.plots.style import new_figure
from armperturb.recording import make_recording

RATE = 200
TONES = (0.7, 1.3, 2.1, 3.2, 4.4, 5.6, 7.1, 9.3, 11.7, 14.2)
FITS = LackOfFit(20.0, 20)
LARGE = LackOfFit(200.0, 20)
AROUND = {"stiffness": 60.0}, {"stiffness": 80.0}


def trials(*tones, sign=1.0):
    """A joint without a reflex on a position servo, 10 s for each trial; tones of a trial in Hz."""
    time = np.arange(10 * RATE) / RATE
    rng = np.random.default_rng(4)
    angle, torque = np.zeros((len(tones), len(time))), rng.normal(size=(len(tones), len(time)))
    torque *= 0.05
    for trial, of_trial in enumerate(tones):
        for f in of_trial:
            s, tone = 2j * np.pi * f, 0.02 * np.exp(2j * np.pi * f * time + 1j * f) / np.sqrt(len(of_trial))
            angle[trial] += tone.real
            torque[trial] += sign * ((0.012 * s**2 + 0.9 * s + 70.0) * tone).real
    n = len(tones)
    labels = {"subject": ["S"] * n, "task": ["PT"] * n, "condition": ["PT"] * n, "repetition": [*range(n)]}
    labels["pulse_level"] = [0.0] * n
    empty = ("pulse_direction", "pulse_onset", "l_h", "l_f", "theta_s_deg", "theta_e_deg", "limit_time")
    labels |= {name: [np.nan] * n for name in empty}
    signals = {"displacement": angle[..., None], "force": torque[..., None]}
    return make_recording(signals, labels, RATE, servo="position", joint="ankle", angular=True)


@pytest.fixture(scope="module")
def result():
    return replace(identify_joint(trials(TONES), reflex="none"), lack_of_fit=FITS)


def on_force_servo(result):
    return replace(result, servo="force", free_model=None, vaf={"movement": result.vaf["total"], **result.vaf})


def ahead(result, by):
    return replace(result, free_model=replace(result.free_model, left_out_vaf=result.vaf["total"] + by))


def test_a_joint_that_fits_is_trusted(result):
    assert joint_verdict(result).level == "trust"
    assert joint_verdict(on_force_servo(result)).level == "trust"
    assert joint_verdict(replace(result, lack_of_fit=LackOfFit(44.0, 20))).level == "care"
    assert joint_verdict(ahead(result, 5.0)).level == "care"


def test_a_joint_that_leaves_more_than_it_explains_is_used_with_care(result):
    little = replace(result, vaf=result.vaf | {"total": 18.0})
    said = joint_verdict(ahead(little, 0.0))
    assert said.level == "care"
    assert "leaves 82 % of the variance of the torque" in said.text
    assert any("leaves 82 % of the variance of the torque" in remark for remark in remarks_on(little, 1))
    moved = on_force_servo(replace(result, vaf=result.vaf | {"total": 18.0, "movement": 90.0}))
    assert joint_verdict(moved).level == "trust"


def test_what_did_not_settle_hides_no_rejection(result):
    unsettled = joint_verdict(replace(result, converged=False))
    assert unsettled.level == "care"
    assert "did not settle" in unsettled.text
    for each in (
        replace(on_force_servo(result), lack_of_fit=LARGE),
        replace(result, lack_of_fit=LARGE),
        ahead(result, 20.0),
    ):
        assert joint_verdict(each).level == "reject"
        said = joint_verdict(replace(each, converged=False))
        assert said.level == "reject"
        assert "did not settle" in said.text


@pytest.mark.parametrize("servo", ["force", "position"])
def test_a_large_lack_of_fit_names_its_causes(result, servo):
    result = replace(on_force_servo(result) if servo == "force" else result, lack_of_fit=LARGE)
    said = joint_verdict(result)
    assert said.level == "reject"
    assert "late to each other or pass different filters" in said.text
    assert "estimates may be biased" in said.text
    # As of ankles of people: bounds of what a position servo may leave, where a free model is not far ahead.
    some = joint_verdict(replace(result, lack_of_fit=LackOfFit(104.0, 20)))
    assert some.level == ("reject" if servo == "force" else "care")
    assert "estimates may be biased" in some.text


def test_a_movement_of_one_frequency_determines_no_parameters():
    sine = identify_joint(trials((5.03,)), reflex="none")
    said = joint_verdict(sine)
    assert said.level == "reject"
    assert "power at 1 frequency alone" in said.text
    assert "3 free parameters" in said.text
    assert any("power at 1 frequency alone" in remark for remark in sine.remarks)
    assert any("nearly a sine" in remark for remark in sine.remarks)


def test_a_slow_movement_hides_no_frequencies_beside_it():
    moved = trials(TONES)
    slow = 0.3 * np.sin(2.0 * np.pi * 0.1 * moved["time"].values)[None, :, None]
    moved = moved.assign(displacement=moved["displacement"] + slow, force=moved["force"] + 70.0 * slow)
    assert not any("alone" in remark for remark in identify_joint(moved, reflex="none").remarks)


@pytest.mark.slow(reason="identifies a joint")
def test_frequencies_of_several_trials_count_together(result):
    steps = identify_joint(trials((2.03,), (5.03,), (9.03,), (14.03,)), reflex="none")
    assert joint_verdict(steps).level == "trust"


def test_a_negative_stiffness_is_not_trusted():
    negative = identify_joint(trials(TONES, sign=-1.0), reflex="none")
    assert any("stiffness of the joint is negative" in remark for remark in negative.remarks)
    turned = joint_verdict(negative)
    assert turned.level == "reject"
    assert "stiffness of the joint is negative" in turned.text
    assert "exerted_by" in turned.text


def test_parts_that_differ_are_not_one_joint(result):
    some = replace(result, parts=PartDifferences({"stiffness": 0.12}, 8, "the record", 5.0, *AROUND))
    assert joint_verdict(some).level == "care"
    assert "most before and after 5.0 s (stiffness 60.0; then stiffness 80.0)" in joint_verdict(some).text
    assert joint_verdict(replace(some, parts=some.parts._replace(spread={"stiffness": 0.3}))).level == "reject"


def test_a_half_wave_whose_movement_is_cut_short_is_used_with_care(result):
    linear = replace(result, beyond=0.07)
    assert joint_verdict(linear).level == "trust"
    for top, remedy in {30.0: "record or convert at 200 Hz or more", 60.0: "perturb with less that is fast"}.items():
        cut = replace(linear, structure=JointStructure(reflex="half-wave"), top=top)
        assert joint_verdict(cut).level == "care"
        assert f"goes on beyond {top:g} Hz" in joint_verdict(cut).text
        assert any(remark.endswith(remedy) for remark in remarks_on(cut, 1))
        assert joint_verdict(replace(cut, beyond=0.017)).level == "trust"


@pytest.mark.slow(reason="fits and draws a page")
def test_the_page_of_a_rejected_joint_points_to_no_list_of_causes(result, tmp_path):
    write_joint_page(replace(result, lack_of_fit=LARGE), tmp_path / "identify.html", Origin())
    page = (tmp_path / "identify.html").read_text()
    assert "Do not trust the parameters." in page
    assert "names likely causes" not in page


@pytest.mark.slow(reason="fits and draws a page")
def test_a_page_says_each_doubt_only_once(result, tmp_path):
    doubt = "the stiffness of the joint is negative"
    turned = identify_joint(trials(TONES, sign=-1.0), reflex="none")
    write_joint_page(turned, tmp_path / "identify.html", Origin())
    assert (tmp_path / "identify.html").read_text().lower().count(doubt) == 1


@pytest.mark.slow(reason="draws pages")
def test_a_page_tells_of_what_the_fit_has(result, tmp_path):
    notes = ("my_file/x.json: a note", "noise was left out")
    origin = Origin(command="", files={}, notes=notes, window_start=8.0, period=None)
    write_joint_page(result, tmp_path / "joint.html", origin)
    text = (tmp_path / "joint.html").read_text(encoding="utf-8")
    assert "torque of each path" in text
    assert "log-likelihood as the delay" not in text
    assert "ends what was fitted" not in text
    assert "<li>my_file/x.json: a note.</li>" in text
    assert "<li>Noise was left out.</li>" in text
    direction = replace(result, angular=False)
    assert direction.summary().startswith("One direction of S")
    write_joint_page(direction, tmp_path / "direction.html", origin)
    assert "force of each path" in (tmp_path / "direction.html").read_text(encoding="utf-8")


def test_a_plot_calls_signals_of_a_joint_by_their_quantities():
    axes = armperturb.plot(trials(TONES), figure=new_figure(1.0))
    assert [ax.get_title(loc="left") for ax in axes[:, 0]] == ["torque", "angle"]
    assert [ax.get_ylabel() for ax in axes[:, 0]] == ["[Nm]", "[deg]"]
