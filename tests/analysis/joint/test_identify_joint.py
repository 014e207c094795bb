"""Joint identification on simulated people whose equations share nothing with the package."""

import json
from dataclasses import replace

import numpy as np
import one_joint
import pytest
import xarray as xr
from scipy import signal

from armperturb.analysis.joint.estimate import Profile, estimate_joint, likelihood_profiles
from armperturb.analysis.joint.export import joint_summary, write_joint
from armperturb.analysis.joint.identify import identify_joint
from armperturb.analysis.joint.intrinsic import check_intrinsic
from armperturb.analysis.joint.likelihood import JointLikelihood, environment_of
from armperturb.analysis.joint.model import JointModel, JointStructure
from armperturb.analysis.joint.prediction import explained, fit_free_model
from armperturb.analysis.joint.signals import joint_signals
from armperturb.analysis.joint.torque_likelihood import band_of
from armperturb.analysis.page.joint_page import joint_verdict, write_joint_page
from armperturb.analysis.page.page import Origin
from armperturb.analysis.results import PARAMETER_COLUMNS, quantile


@pytest.fixture(scope="module")
def ankle():
    """A person with a one-sided reflex, half a minute on a position servo."""
    return one_joint.person("ankle", 5)


@pytest.fixture(scope="module")
def recording(ankle):
    return one_joint.recording(ankle, 5, duration=30.0, decibel=20.0)


@pytest.fixture(scope="module")
def result(recording):
    return identify_joint(recording, fit_until=20.0)


@pytest.mark.parametrize("reflex", ["none", "linear", "half-wave"])
def test_derivatives_are_those_of_differences(recording, reflex):
    signals = joint_signals(recording.isel(time=slice(0, 6000)))
    structure = JointStructure(reflex=reflex, short_range=reflex != "half-wave")
    usual = {"short_range_limit": 0.01, "reflex_delay": 0.04, "reflex_frequency": 2.0, "reflex_threshold": 0.05}
    values = np.array([usual.get(name, 0.9) for name in structure.parameters])
    model = JointModel(structure, signals)
    for place, (name, exact) in enumerate(model.derivatives(values).items()):
        if name == "short_range_limit":  # a difference itself
            continue
        step = 1e-5 * values[place]
        up, down = (model.torque(values + sign * step * np.eye(len(values))[place]) for sign in (1, -1))
        error = np.abs((up - down) / (2 * step) - exact).max() / np.abs(exact).max()
        assert error < 1e-4, name


def test_errors_count_that_the_noise_is_estimated(recording):
    signals, structure = joint_signals(recording.isel(time=slice(0, 5000))), JointStructure(reflex="none")
    fit, likelihood = estimate_joint(structure, signals), JointLikelihood(structure, signals)
    for _ in range(4):  # offset and drift are taken out with the noise as last weighed
        likelihood.weigh(fit.values)
    known, left = likelihood.informations(fit.values, np.eye(3))
    np.testing.assert_allclose(np.diag(fit.covariance), np.diag(np.linalg.inv(left)), rtol=1e-3)
    assert np.all(np.diag(fit.covariance) > 1.01 * np.diag(np.linalg.inv(known)))


@pytest.mark.slow(reason="a search by maximum likelihood of two structures")
def test_a_half_wave_that_is_asked_for_is_described_with_its_direction(recording):
    result = identify_joint(recording.isel(time=slice(0, 4000)), reflex="half-wave")
    assert len(result.tried) == 2
    said = f"structure as asked for, its direction chosen by left-out data: {result.structure.name}"
    assert said in result.summary()
    assert joint_summary(result)["remarks"][0] == said
    (limit,) = [line for line in result.plot()[2].lines if line.get_linestyle() == ":"]
    np.testing.assert_allclose(limit.get_ydata(), quantile(0.95) ** 2)


@pytest.mark.slow(reason="identifies a joint")
def test_drift_counts_for_no_prediction(recording):
    signals = joint_signals(recording.isel(time=slice(0, 8000)))
    drifting = replace(signals, torque=signals.torque + 7.0 + np.linspace(0.0, 30.0, signals.torque.shape[1]))
    nothing = np.zeros_like(signals.torque)
    predicted = signals.torque + 0.1 * np.cos(np.arange(signals.torque.shape[1]))
    assert explained(drifting.torque, predicted) == pytest.approx(explained(signals.torque, predicted), abs=1e-9)
    assert explained(signals.torque, nothing) == pytest.approx(0.0, abs=1e-9)
    still, moved = fit_free_model(signals), fit_free_model(drifting)
    assert moved.left_out_vaf == pytest.approx(still.left_out_vaf, abs=1e-6)
    np.testing.assert_allclose(moved.torque(signals), still.torque(signals), atol=1e-6)
    assert check_intrinsic(drifting, nothing).left_out_vaf == pytest.approx(
        check_intrinsic(signals, nothing).left_out_vaf, abs=1e-6
    )


@pytest.mark.parametrize(("top", "highest"), [(60.0, 51.0), (100.0, 51.0), (20.0, 17.0)])
def test_the_band_is_that_which_the_likelihood_counts(recording, top, highest):
    signals = joint_signals(recording.isel(time=slice(0, 4000)), top=top)
    lowest, most = band_of(signals)
    assert (lowest, most) == (0.05, pytest.approx(highest))
    counted = JointLikelihood(JointStructure(reflex="none"), signals).frequency
    assert lowest <= counted[0] <= counted[-1] <= most < counted[-1] + 1.0


def test_a_movement_beyond_the_band_is_measured(recording):
    time = np.arange(1000) / 100.0
    tones = 1.0 / 5.0 * np.sin(2 * np.pi * 5.0 * time) + 0.2 / 35.0 * np.sin(2 * np.pi * 35.0 * time)
    slow = recording.isel(time=slice(0, 1000)).assign_attrs(rate=100.0).assign_coords(time=time)
    slow["time"].attrs["units"] = "s"
    moved = slow.assign(displacement=slow["displacement"].copy(data=0.05 * tones[None, :, None]))
    assert joint_signals(moved).beyond == pytest.approx(0.2**2, rel=0.05)
    assert joint_signals(recording).beyond < 1e-3


@pytest.mark.slow(reason="a search by maximum likelihood of four structures")
def test_the_reflex_and_its_parameters(ankle, result):
    assert result.structure.reflex == "half-wave"
    assert result.structure.side == ankle.side
    for name, tolerance in {"inertia": 0.02, "damping": 0.05, "stiffness": 0.05, "reflex_gain": 0.15}.items():
        assert result.values[name] == pytest.approx(getattr(ankle, name), rel=tolerance), name
    assert result.values["reflex_delay"] == pytest.approx(ankle.reflex_delay, abs=2e-3)
    for name in result.values:
        assert abs(result.values[name] - getattr(ankle, name)) < 4.5 * result.standard_error[name], name


@pytest.mark.slow(reason="shares the search above")
def test_what_was_held_out_is_predicted(result):
    assert result.held_out["cascade"] > 95.0
    assert result.held_out_vaf == result.held_out[result.predicted_by]
    assert joint_summary(result)["held_out_vaf"] == result.held_out_vaf


@pytest.mark.slow(reason="shares the search above")
def test_the_profile_of_the_delay_has_its_minimum_at_the_estimate(result):
    delays, rise, _ = result.profiles["reflex_delay"]
    assert delays[np.argmin(rise)] == pytest.approx(result.values["reflex_delay"], abs=1e-3)
    assert min(rise[0], rise[-1]) > 3.84
    # Little noise: the likelihood is quadratic, and the interval that of the standard error.
    half = 1.96 * result.standard_error["reflex_delay"]
    lower, upper = result.interval("reflex_delay")
    assert lower == pytest.approx(result.values["reflex_delay"] - half, abs=0.1 * half)
    assert upper == pytest.approx(result.values["reflex_delay"] + half, abs=0.1 * half)


def test_an_interval_of_a_profile_ends_where_its_root_says():
    held = np.array([0.0, 1.0, 2.0, 4.0, 6.0])
    skewed = Profile(held, np.array([16.0, 4.0, 0.0, 1.0, 4.0]), (0.5, 9.0))
    assert skewed.interval(2.0) == (1.0, 6.0)
    assert skewed.interval(3.0) == (0.5, 8.0)  # at a bound, and beyond what was held
    two_minima = Profile(held, np.array([9.0, 0.0, 9.0, 1.0, 9.0]), (0.0, 9.0))
    assert two_minima.interval(2.0) == pytest.approx((1.0 / 3.0, 5.0))


def test_an_interval_holds_the_estimate_where_the_profile_is_lowest_elsewhere(result):
    lower, upper = result.interval("reflex_delay")
    estimate, width = result.values["reflex_delay"], upper - lower
    for side in (-1.0, 1.0):
        held, rise, bounds = result.profiles["reflex_delay"]
        moved = replace(result, profiles={"reflex_delay": Profile(held + 2.0 * side * width, rise, bounds)})
        ends = moved.interval("reflex_delay")
        assert ends.lower <= estimate <= ends.upper
        assert max(ends.upper - estimate, estimate - ends.lower) > 1.9 * width


@pytest.mark.slow(reason="profiles a likelihood")
def test_profiles_reach_both_minima_of_a_threshold(recording):
    """A movement that rests between its switches: thresholds either side of rest explain its reflex."""
    rng = np.random.default_rng(0)
    switched = 0.02 * np.repeat(rng.choice([-1.0, 1.0], 200), 150)
    angle = signal.sosfilt(signal.butter(2, 20.0, fs=one_joint.RATE, output="sos"), switched)
    moved = joint_signals(recording.assign(displacement=recording["displacement"].copy(data=angle[None, :, None])))
    structure, true = JointStructure(), np.array([0.016, 0.8, 70.0, 8.0, 0.04, 2.5, 0.8, 0.1])
    torque = JointModel(structure, moved).torque(true)
    noise = signal.lfilter(*signal.butter(1, 3.0, fs=moved.rate), rng.normal(size=torque.shape))
    moved = replace(moved, torque=torque + 0.18 * torque.std() / noise.std() * noise)
    fit, names = estimate_joint(structure, moved), ("reflex_gain", "reflex_threshold")
    assert fit.values[-1] < 0.0
    profiles = likelihood_profiles(fit, moved, None, names)
    assert tuple(profiles) == names
    for name in names:
        lower, upper = profiles[name].interval(1.96)
        assert lower < true[structure.parameters.index(name)] < upper, name
    # From the minimum that is nearest alone it would end at 8.8.
    assert profiles["reflex_gain"].interval(1.96).upper > 9.5


@pytest.mark.slow(reason="shares the search above")
def test_an_impulse_response_agrees_with_the_intrinsic_path(ankle, result):
    check = result.intrinsic
    assert abs(check.left_out_vaf - check.structured_vaf) < 0.2
    assert np.argmax(np.abs(check.response)) == len(check.lag) // 2
    assert check.response[len(check.lag) // 2] == pytest.approx(ankle.inertia, rel=0.1)
    assert not any("impulse response" in remark for remark in result.remarks)


def test_an_impulse_response_finds_an_intrinsic_path_that_is_more(recording):
    signals = joint_signals(recording.isel(time=slice(0, 12000)))
    late = np.roll(signals.acceleration, round(0.01 * signals.rate), axis=1)  # as in a soft fixation
    more = replace(signals, torque=0.01 * signals.acceleration + 0.01 * late + 60.0 * signals.angle)
    plain = replace(signals, torque=0.02 * signals.acceleration + 0.5 * signals.velocity + 60.0 * signals.angle)
    nothing = np.zeros_like(signals.angle)
    of_more, of_plain = check_intrinsic(more, nothing), check_intrinsic(plain, nothing)
    assert of_more.left_out_vaf - of_more.structured_vaf > 2.0
    assert of_plain.left_out_vaf - of_plain.structured_vaf == pytest.approx(0.0, abs=0.01)
    np.testing.assert_allclose(of_plain.response, 0.02 * (of_plain.lag == 0.0), atol=2e-4)


@pytest.mark.slow(reason="shares the search above")
def test_files_and_page(result, tmp_path):
    write_joint(result, tmp_path)
    write_joint_page(result, tmp_path / "identify.html", Origin())
    assert tuple(result.to_frame().columns) == (*PARAMETER_COLUMNS, "joint")
    header, first, *_ = (tmp_path / "parameters.csv").read_text().splitlines()
    assert header == ",".join((*PARAMETER_COLUMNS, "joint"))
    assert first.endswith(",PT,S,ankle")
    summary = json.loads((tmp_path / "fit.json").read_text())
    assert [summary[name] for name in ("reflex", "subject", "joint")] == ["half-wave", "S", "ankle"]
    assert "Ankle of S" in (tmp_path / "identify.html").read_text()
    assert len(repr(result).splitlines()) <= 25


@pytest.mark.slow(reason="a search by maximum likelihood of four structures")
def test_nobody_gets_a_reflex_that_has_none():
    person = one_joint.person("wrist", 6, "none")
    result = identify_joint(one_joint.recording(person, 6, duration=20.0, name="wrist"))
    assert result.structure.reflex == "none"
    assert result.values["stiffness"] == pytest.approx(person.stiffness, rel=0.05)


@pytest.mark.slow(reason="a search by maximum likelihood")
def test_a_structure_without_the_reflex_lacks_fit(recording, result):
    assert result.lack_of_fit.p_value > 0.001
    without = identify_joint(recording, reflex="none")
    assert without.lack_of_fit.p_value < 1e-6
    assert any("leaves what a linear response explains" in remark for remark in without.remarks)
    assert joint_verdict(result).level == "trust"
    assert joint_verdict(without).level != "trust"
    # As if a free model were no better: so large a lack of fit alone is reason enough.
    alike = replace(without, free_model=replace(without.free_model, left_out_vaf=without.vaf["total"]))
    assert joint_verdict(alike).level == "reject"
    assert "lack of fit over its degrees of freedom" in joint_verdict(alike).text
    assert joint_verdict(replace(without, free_model=None)).level == "reject"


@pytest.mark.slow(reason="a search in a closed loop")
def test_a_force_servo_gives_the_same_joint():
    person = one_joint.person("ankle", 7, "linear")
    made = one_joint.recording(person, 7, "force", duration=30.0)
    result = identify_joint(made, reflex="linear")
    delays, fall, _ = result.profiles["reflex_delay"]
    at_error = result.values["reflex_delay"] + np.array([-2.0, 2.0]) * result.standard_error["reflex_delay"]
    # Two standard errors are a fall of four.
    np.testing.assert_allclose(np.interp(at_error, delays, fall), 4.0, atol=2.0)
    assert result.environment.inertia == pytest.approx(0.25 * person.inertia, rel=1e-4)
    assert result.lack_of_fit.p_value > 0.001
    for name, tolerance in {"inertia": 0.05, "damping": 0.08, "stiffness": 0.08}.items():
        assert result.values[name] == pytest.approx(getattr(person, name), rel=tolerance), name


@pytest.mark.slow(reason="a search in a closed loop")
def test_without_noise_a_force_servo_leaves_no_bias():
    person = one_joint.person("elbow", 8, "linear")
    signals = joint_signals(one_joint.recording(person, 8, "force", duration=30.0, decibel=80.0, name="elbow"))
    fit = estimate_joint(JointStructure(reflex="linear"), signals, environment_of(signals))
    true = [getattr(person, name) for name in fit.structure.parameters]
    np.testing.assert_allclose(fit.values, true, rtol=1e-3)


@pytest.mark.slow(reason="identifies a joint")
def test_what_follows_the_workspace_limit_does_not_count(recording):
    whole = recording.isel(time=slice(0, 8000))
    spoiled = whole.assign_coords(limit_time=("trial", [6.0], whole["limit_time"].attrs)).copy(deep=True)
    spoiled["force"][:, 6000:] = 50.0
    until, cut = (identify_joint(each, reflex="none") for each in (spoiled, whole.isel(time=slice(0, 6000))))
    assert until.values == cut.values
    assert until.remarks[0] == (
        "all trials met the workspace limit (limit_time), and are used up to the first time that one did: 6 s"
    )
    again = whole.assign_coords(repetition=("trial", [1], whole["repetition"].attrs))
    both = xr.concat([spoiled, again], "trial", combine_attrs="override")
    assert identify_joint(both, reflex="none").remarks[0].startswith("1 of 2 trials met the workspace limit")
    with pytest.raises(ValueError, match=r"limit_time = 0 s; expected trials that start inside"):
        identify_joint(whole.assign_coords(limit_time=("trial", [0.0], whole["limit_time"].attrs)))
    other = both.assign_coords(subject=("trial", ["S", "T"], whole["subject"].attrs))
    with pytest.raises(ValueError, match=r"subject has several values \(S, T\).*--subject.*subject.values == 'S'"):
        identify_joint(other, reflex="none")


def test_bad_options_are_named(recording):
    with pytest.raises(ValueError, match=r"longest_delay = 40 s; expected at most a quarter of the record"):
        identify_joint(recording, longest_delay=40.0)
    with pytest.raises(ValueError, match=r"fit_until = 40.0; expected"):
        identify_joint(recording, fit_until=40.0)
    with pytest.raises(ValueError, match="duration = 2 s; expected at least 4 s"):
        identify_joint(recording.isel(time=slice(0, 2000)))
