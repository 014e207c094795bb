"""Fits to trials that MuJoCo simulated: truth found, intervals, going on after a stop, and what is refused."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import nonlinear_trials as made
import numpy as np
import pytest
import xarray as xr

from armperturb.analysis.nonlinear import identify
from armperturb.analysis.nonlinear.choice import Choice, Gain, Judged, compare_laws, left_out_likelihood
from armperturb.analysis.nonlinear.draws import (
    inverse_of_mixed,
    lack_of_fit,
    mixed_information,
    predict_with_noise,
    simulate_deviations,
)
from armperturb.analysis.nonlinear.estimate import fit, free_parameters, nearest_arms
from armperturb.analysis.nonlinear.model import Model, coordinate, true_values
from armperturb.analysis.nonlinear.noise import NoiseDraws
from armperturb.analysis.nonlinear.prediction import (
    facts_of,
    predict_pulses,
    predict_pulses_linearly,
    remarks_on_peaks,
)
from armperturb.analysis.nonlinear.problem import Normal, Problem
from armperturb.analysis.nonlinear.result import remarks_on
from armperturb.analysis.nonlinear.simulated import State
from armperturb.analysis.nonlinear.start import best_start
from armperturb.analysis.nonlinear.trials import fitted_conditions, training_sets
from armperturb.analysis.results import PARAMETER_COLUMNS
from armperturb.cohort import average_person, draw_person
from armperturb.joined_recordings import stack_trials
from armperturb.muscle_law import ELEMENTS
from armperturb.subject import RELAX, at_level

PERSON = average_person().subjects["RT"]
TRUE = true_values(PERSON, {})
FREE = ("k.shoulder", "short_range_stiffness.shoulder", "elastic_limit_deg.shoulder", "thinning_velocity")
FEW = Model(fixed={name: value for name, value in TRUE.items() if name not in FREE and name in set(TRUE) - {
    "Td", "fact", *(f"{group}.{e}" for group in ("kv", "kp") for e in ("shoulder", "two-joint", "elbow")),
    "spindle_saturation", "spindle_direction", "spindle_threshold",
}})  # fmt: skip


def linear_arm(share):
    """An arm whose bonds hold as much of the time as the share says: near what a linear fit gives."""
    k, s = (np.array([TRUE[f"{name}.{e}"] for e in ELEMENTS]) for name in ("k", "short_range_stiffness"))
    shoulder, both, elbow = k + share * s
    return replace(PERSON, muscle=None, k_s=shoulder + both, k_se=both, k_e=elbow + both)


ARM = linear_arm(0.25)
ARMS = {"RT2.5": linear_arm(0.7), "RT7.5": ARM}


@pytest.fixture(autouse=True, scope="module")
def compiled(once):
    once("compiled arms", made.compile_arms)


def sets_of(once, name, person, n_trials, noisy):
    def make(_):
        return [
            made.trial_set(
                made.record(
                    person,
                    [made.push(10 * i + k, rms) for k in range(n_trials)],
                    noisy=noisy,
                    condition=condition,
                )
            )
            for i, (condition, rms) in enumerate((("RT2.5", 0.5), ("RT7.5", 1.5)))
        ]

    return once(f"nonlinear trials, {name}", make)


@pytest.fixture(scope="module")
def ideal(once):
    """One noise-free trial at each of two amplitudes."""
    return sets_of(once, "ideal", PERSON, 1, False)


@pytest.fixture(scope="module")
def noisy(once):
    """Four noisy trials at each of two amplitudes."""
    return sets_of(once, "noisy", PERSON, 4, True)


@pytest.fixture(scope="module")
def noisy_fit(noisy, once):
    return once("nonlinear fit", lambda _: fit(noisy, ARMS, FEW, n_pairs=2))


@pytest.mark.slow(reason="compiles, simulates and fits")
def test_without_noise_the_truth_is_found(ideal):
    found = fit(ideal, ARMS, FEW, n_pairs=0)
    assert set(found.values) == set(FREE)
    for name in FREE:
        assert found.values[name] == pytest.approx(TRUE[name], rel=0.01)
    assert found.subject("RT", "RT7.5").muscle.of_elements("elastic_limit_deg") == pytest.approx(
        PERSON.muscle.of_elements("elastic_limit_deg"), rel=0.01
    )


@pytest.mark.slow(reason="simulates, fits and judges half-wave spindles")
def test_direction_and_threshold_of_half_wave_spindles_are_found_and_chosen():
    average = average_person().subjects["PT"]
    law = replace(average.muscle, spindle_direction=0.7, spindle_threshold=0.15)
    person = replace(average, muscle=law)
    true = true_values(person, {})
    free = ("kv.shoulder", "spindle_direction", "spindle_threshold")
    forces = [made.push(seed, 5.0, 8.0) for seed in range(4)]
    trials = made.trial_set(made.record(person, forces, condition="PT7.5"))
    arms = {"PT7.5": replace(average, muscle=None)}
    fixed = {name: value for name, value in true.items() if name not in free}
    models = {
        "half-wave": Model(law="half-wave", fixed=fixed),
        "full": Model(fixed={name: value for name, value in fixed.items() if name not in free}),
    }
    train, test = trials.take(range(2)), trials.take(range(2, 4))
    fits = {law: fit([train], arms, model, n_pairs=0, n_pairs_of_errors=2) for law, model in models.items()}
    for name in free:
        assert fits["half-wave"].values[name] == pytest.approx(true[name], rel=0.02)
    likelihood = {law: left_out_likelihood(found, [test], arms, n_pairs=0) for law, found in fits.items()}
    assert (likelihood["half-wave"] - likelihood["full"]).min() > 5.0


@pytest.mark.slow(reason="simulates eight trials and fits them")
def test_with_noise_the_intervals_hold_the_truth_and_are_no_wider_than_they_must_be(noisy_fit):
    assert noisy_fit.converged
    for name in FREE:
        low, high = noisy_fit.interval(name, 0.997)
        assert low < TRUE[name] < high
        assert noisy_fit.coordinate_error[name] < 0.4
    # The logarithm's error as a share of the value, but of what may be negative.
    relative = noisy_fit.standard_error[FREE[1]] / noisy_fit.values[FREE[1]]
    assert relative == pytest.approx(noisy_fit.coordinate_error[FREE[1]])
    narrow, wide = noisy_fit.interval(FREE[1], 0.5), noisy_fit.interval(FREE[1], 0.95)
    assert wide[0] < narrow[0] < noisy_fit.values[FREE[1]] < narrow[1] < wide[1]
    # What may be negative has an interval about itself, which crosses zero where it is not told from that.
    low, high = noisy_fit.interval(FREE[0])
    assert (low + high) / 2.0 == pytest.approx(noisy_fit.values[FREE[0]])
    assert high - low == pytest.approx(2.0 * 1.96 * noisy_fit.standard_error[FREE[0]], rel=1e-3)
    error = {**noisy_fit.coordinate_error, FREE[0]: 5.0 / np.hypot(0.1, 0.2)}
    near_zero = replace(noisy_fit, values={**noisy_fit.values, FREE[0]: 0.1}, coordinate_error=error)
    assert near_zero.interval(FREE[0]) == pytest.approx((0.1 - 9.8, 0.1 + 9.8), rel=1e-3)
    np.testing.assert_allclose(np.diag(noisy_fit.correlation), 1.0)
    assert all(test.p_value > 1e-3 for test in noisy_fit.lack_of_fit.values())
    assert not any("amplitude" in remark for remark in noisy_fit.remarks)


@pytest.mark.slow(reason="fits eight trials")
def test_a_wrong_law_leaves_a_lack_of_fit(noisy):
    fixed = {name: value for name, value in FEW.fixed.items() if name in ("m_h", "m_f", "k_h", "b_h")}
    found = fit(noisy, ARMS, Model(law="linear", fixed=fixed), n_pairs=0)
    assert min(test.p_value for test in found.lack_of_fit.values()) < 1e-3
    # Trials would have to differ more than people do.
    assert "the SD over trials of k [RT] sits on its bound of 50 %: trials differ by more, or " in found.remarks[0]
    assert any("the perturbation explains more of the movement than the linear law" in each for each in found.remarks)


class Stopped(Exception):
    pass


@pytest.mark.slow(reason="fits twice")
def test_a_search_that_was_stopped_goes_on_to_the_same_result(noisy, tmp_path):
    few = [trials.before(500).take(range(2)) for trials in noisy]
    options = {"n_pairs": 1, "n_pairs_of_errors": 2}
    whole = []
    expected = fit(few, ARMS, FEW, **options, progress=whole.append)
    lines = []

    def stop(line):
        lines.append(line)
        if len(lines) in stops:
            raise Stopped

    # Without noise in the prediction, and with it, before the last step.
    stops = (2, len(whole))
    for _ in stops:
        with pytest.raises(Stopped):
            fit(few, ARMS, FEW, **options, checkpoint=tmp_path / "c.json.gz", progress=stop)
    found = fit(few, ARMS, FEW, **options, checkpoint=tmp_path / "c.json.gz", progress=lines.append)
    # Steps during which it was stopped are taken again.
    assert lines[:2] == whole[:2]
    assert lines[2] == whole[1]
    assert len(lines) <= len(whole) + 2
    assert found.values == pytest.approx(expected.values, rel=1e-9)
    assert found.coordinate_error == pytest.approx(expected.coordinate_error, rel=1e-6)


@pytest.mark.slow(reason="fits simulated trials")
@pytest.mark.parametrize(("amplitudes", "names"), [((1, 1), "AB"), ((0, 1), "AA")])
def test_one_amplitude_is_said_to_tell_little_whatever_conditions_are_called(noisy, amplitudes, names):
    sets = [
        replace(trials, recording=trials.recording.assign_coords(condition=("trial", [name])))
        for trials, name in zip((noisy[k].take([k]) for k in amplitudes), names, strict=True)
    ]
    found = fit(sets, dict.fromkeys(names, ARM), FEW, n_pairs=0, max_steps=1)
    assert any("all trials have one amplitude" in remark for remark in found.remarks) == (amplitudes == (1, 1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"subject": "S02"}, "trials differ in subject (.*, S02); expected one person in one posture"),
        ({"l_h": 0.4}, "trials differ in l_h"),
        ({"theta_s_deg": 30.0}, "trials differ in theta_s_deg"),
    ],
)
def test_trials_of_two_people_are_refused(ideal, change, message):
    recording = ideal[1].recording.assign_coords({name: ("trial", [value]) for name, value in change.items()})
    other = replace(ideal[1], recording=recording)
    with pytest.raises(ValueError, match=message.replace("(", r"\(").replace(")", r"\)")):
        fit([ideal[0], other], ARMS, FEW)


def test_a_recording_of_two_people_is_refused():
    people = PERSON, replace(PERSON, name="S02")
    recordings = [made.record(person, [made.push(0, 0.5, duration=1.0)]) for person in people]
    with pytest.raises(ValueError, match=r"recording: subject = .*, S02; expected one person"):
        fitted_conditions(stack_trials(recordings))


def test_what_cannot_be_fitted_is_refused(ideal):
    with pytest.raises(ValueError, match="fit: n_pairs = -1; expected a finite number at least 0"):
        fit(ideal, ARMS, FEW, n_pairs=-1)
    with pytest.raises(ValueError, match="fit: n_pairs_of_errors = 1; expected a finite number at least 2"):
        fit(ideal, ARMS, FEW, n_pairs_of_errors=1)
    with pytest.raises(ValueError, match="no trials; expected at least one"):
        fit([], ARMS, FEW)
    with pytest.raises(ValueError, match="arms: none of the task RT; expected at least one"):
        fit(ideal, {}, FEW)
    with pytest.raises(ValueError, match=r"initial: 'm_h' is not free; expected k.shoulder"):
        fit(ideal, ARMS, FEW, initial={"m_h": 2.0})
    with pytest.raises(ValueError, match=r"initial: thinning_velocity = -1; expected 0.01 to 50"):
        fit(ideal, ARMS, FEW, initial={"thinning_velocity": -1.0})
    with pytest.raises(ValueError, match="sampling rates 100, 200 Hz; expected one"):
        fit([ideal[0], replace(ideal[1], recording=ideal[1].recording.assign_attrs(rate=200.0))], ARMS, FEW)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_pairs": -1}, "identify_nonlinear: n_pairs = -1; expected a finite number at least 0"),
        ({"n_pairs_of_errors": 1}, "identify_nonlinear: n_pairs_of_errors = 1; expected a finite number at least 2"),
        ({"parts": 0}, "Model: parts = 0; expected a finite number at least 1 and at most 64"),
        ({"law": "elastic"}, "Model: law = 'elastic'; expected one of linear, short-range, full, half-wave"),
        ({"free": "kv"}, "free: 'kv'; expected some of Td, fact"),
        ({"pulse_directions_deg": 20.0}, "pulses: no pulse in the direction 20 deg; expected some of none"),
    ],
)
def test_options_are_refused_before_anything_is_fitted(ideal, monkeypatch, options, message):
    monkeypatch.setattr(identify, "linear_arms", lambda *_, **__: pytest.fail("fitted before"))
    with pytest.raises(ValueError, match=message):
        identify.identify_nonlinear(ideal[0].recording, **options)
    if "n_pairs" in options:
        with pytest.raises(ValueError, match="compare_laws: n_pairs = -1"):
            compare_laws([], {}, **options)


def test_trials_that_nothing_perturbs_are_not_fitted(ideal):
    moved = ideal[0].recording
    still = moved.isel(trial=[0]).assign(perturbation=0.0 * moved["perturbation"].isel(trial=[0]))
    still = still.assign_coords(condition=("trial", ["MVC"]), repetition=("trial", [99]))
    fitted, left_out = training_sets(fitted_conditions(stack_trials([moved, still])))
    assert [trials.label for trials in fitted] == [ideal[0].label]
    assert left_out == []


def test_an_unstable_start_is_refused():
    arm = replace(average_person().subjects["PT"], muscle=None)
    trials = made.trial_set(made.record(arm, [made.push(0, 3.0, duration=6.0)], condition="PT7.5"))
    with pytest.raises(ValueError, match="initial: the arm is unstable, and so are all arms near it; expected values"):
        fit([trials], {"PT7.5": arm}, Model(law="linear"), initial=dict.fromkeys(
            ("kv.shoulder", "kv.two-joint", "kv.elbow"), 150.0))  # fmt: skip


@pytest.mark.slow(reason="simulates and fits")
def test_negative_groups_of_linear_people_are_found():
    arm = draw_person(1, 0, muscles="linear").subjects["PT"]
    true = true_values(arm, {})
    assert min(true["kp.shoulder"], true["kv.shoulder"]) < -4.0
    pushes = [made.push(seed, 3.0, duration=12.0) for seed in range(2)]
    trials = made.trial_set(made.record(arm, pushes, condition="PT7.5"))
    found = fit([trials], {"PT7.5": arm}, Model(law="linear"), initial={"kp.shoulder": 10.0}, n_pairs=0)
    for name, value in found.values.items():
        assert value == pytest.approx(true[name], rel=0.1), name
    low, high = found.interval("kp.shoulder")
    assert low < found.values["kp.shoulder"] < high < 0.0


@pytest.mark.slow(reason="fits")
def test_dampers_that_linear_arms_have_negative_start_from_small_positive_ones(ideal):
    # b_se > b_s: the shoulder's own damping is negative, which a law whose damping thins must not have.
    odd = {label: replace(arm, b_s=1.0, b_se=1.4, b_e=1.6) for label, arm in ARMS.items()}
    assert min(odd["RT2.5"].muscle_groups("b")) < 0.0
    found = fit(ideal, odd, FEW, n_pairs=0)
    for name in FREE:
        assert found.values[name] == pytest.approx(TRUE[name], rel=0.01)


def test_pulses_of_the_true_person_are_predicted_and_those_of_a_linear_arm_are_not():
    force = np.zeros((1000, 2))
    force[500:512] = 12.0, 6.0
    recording = made.record(PERSON, [force + made.push(5, 0.5, duration=10.0)])
    recorded = made.trial_set(recording.assign_coords(pulse_onset=("trial", [5.0]), pulse_direction=("trial", [27.0])))
    (itself,) = predict_pulses(recorded, PERSON)
    assert itself.vaf > 99.9
    assert itself.peak == pytest.approx(100.0, abs=1.0)
    assert itself.direction_deg == 27.0
    assert itself.time[0] == 0.0
    assert itself.time[-1] == pytest.approx(1.0)
    (linear,), (skeletal,) = predict_pulses_linearly(recorded, ARM), predict_pulses(recorded, ARM)
    assert max(linear.vaf, skeletal.vaf) < 95.0
    assert not np.allclose(linear.predicted, skeletal.predicted, rtol=0.01)
    reflexes = {"kv_s": 0.3, "kv_e": 0.3, "fact_s": 2.0, "fact_e": 2.0}
    near, short = (replace(ARM, **reflexes, Td_s=delay, Td_e=delay) for delay in (0.0076, 0.005))  # below three steps
    of_near, of_short = (predict_pulses(recorded, arm)[0].predicted for arm in (near, short))
    np.testing.assert_allclose(of_short, of_near, atol=0.05 * np.abs(of_near).max())
    assert predict_pulses(recorded.before(600), PERSON) == []  # the window is not recorded
    for end, n_predicted in ((650, 1), (649, 0)):  # 1 s, and 0.5 s that fits leave out at the end of a record
        cut = made.trial_set(recorded.recording.isel(time=slice(end)))
        assert len(predict_pulses(cut, PERSON)) == n_predicted
    shorter = replace(skeletal, **{each: getattr(skeletal, each)[:-9] for each in ("time", "recorded", "predicted")})
    models = {"nonlinear": (itself, itself), "skeletal": (skeletal, shorter)}
    nothing = SimpleNamespace(to_xarray=xr.Dataset)
    data = identify.NonlinearIdentification(estimate=nothing, choice=None, arms={}, pulses=models).to_xarray()
    np.testing.assert_array_equal(data["recorded"], np.stack([itself.recorded] * 2))
    np.testing.assert_array_equal(data["predicted"].sel(model="skeletal").isel(pulse=0), skeletal.predicted)
    assert data["predicted"].sel(model="skeletal").isnull().sum(["time", "axis"]).values.tolist() == [0, 18]
    assert data["direction_deg"].values.tolist() == [27.0, 27.0]
    assert remarks_on_peaks([itself]) == []
    cut = replace(itself, recorded=itself.recorded[: np.linalg.norm(itself.recorded, axis=1).argmax() + 1])
    assert remarks_on_peaks([itself, cut])[0].startswith("after 1 of 2 left-out pulses the handle is farthest")
    # Of arms that diverge nothing is predicted, which the medians of the others do not count.
    diverged = replace(linear, predicted=np.full_like(linear.predicted, np.nan))
    assert facts_of({"A": [itself, diverged], "B": [diverged], "C": []}) == (
        f"2 left-out pulses, A: median peak {itself.peak:.0f} %, median VAF {itself.vaf:.1f} %, 1 of 2 not "
        "predicted, as the arm diverges",
        "1 left-out pulses, B: 1 of 1 not predicted, as the arm diverges",
    )


@pytest.mark.slow(reason="five fits")
@pytest.mark.parametrize("truth", ["linear", "short-range"])
def test_left_out_trials_choose_the_law(noisy, once, truth):
    sets = sets_of(once, "linear", RELAX, 3, True) if truth == "linear" else noisy
    arms = dict.fromkeys(ARMS, RELAX) if truth == "linear" else ARMS
    end = 800 if truth == "linear" else 1400  # the shorter, the less is shown
    found = compare_laws(
        [trials.before(end).take(range(3)) for trials in sets],
        arms,
        laws=("linear", "short-range"),
        n_pairs=0,
        n_pairs_of_folds=1 if truth == "linear" else 0,
        n_pairs_of_errors=2,
    )
    assert found.chosen == truth
    assert ("these trials do not show short-range stiffness" in " ".join(found.verdict())) == (truth == "linear")
    assert found.estimate.model.law == truth
    frame = found.to_frame().set_index("law")
    assert frame.index[frame["is_chosen"]].tolist() == [truth]
    rise = frame["log_likelihood"].diff().loc["short-range"]
    assert rise == pytest.approx(frame.loc["short-range", "gain"])


def judged(values):
    conditions = tuple(np.repeat(["RT2.5", "RT7.5"], len(values) // 2).tolist())
    return Judged(model=Model(), estimate=None, log_likelihood=np.array(values), conditions=conditions, pulses=())


def test_a_gain_is_shown_if_it_is_larger_than_trials_of_a_condition_make_it_differ():
    nothing = judged([0.0] * 8)
    # What differs between conditions is no error.
    gain = judged([1.0, 1.2, 0.8, 1.0, 30.0, 30.2, 29.8, 30.0]).gain(nothing)
    assert gain.mean == pytest.approx(124.0)
    assert gain.standard_error == pytest.approx(np.sqrt(8.0 * 0.08 / 3.0))
    assert gain.dof == 6
    assert gain.is_shown
    assert not judged([-1.0, 2.0, -1.0, 2.0, 1.0, -2.0, 3.0, 0.0]).gain(nothing).is_shown
    alone = judged([50.0, 50.0]).gain(judged([0.0, 0.0]))  # one trial in each condition
    assert not alone.is_shown
    assert alone.standard_error == np.inf


def test_verdicts_say_what_is_not_shown():
    nothing = judged([0.0] * 8)
    gains = {"short-range": Gain(90.0, 9.0, 6), "full": Gain(3.0, 4.0, 6)}
    laws = dict.fromkeys(("linear", "short-range", "full"), nothing)
    choice = Choice(judged=laws, chosen="short-range", gains=gains, mechanisms={})
    assert repr(choice).startswith(
        "Laws compared: linear, short-range, full; chosen: short-range\ncompared with the linear law, "
    )
    verdict = choice.verdict()
    assert verdict[0] == (
        "compared with the linear law, the short-range law raises the log-likelihood of left-out trials by 90.0 "
        "(standard error 9.0)"
    )
    assert verdict[1] == (
        "compared with the short-range law, the full law raises the log-likelihood of left-out trials by 3.0 (standard "
        "error 4.0, not significant)"
    )
    assert "do not show thixotropy" in verdict[2]
    assert str(Gain(-30.0, 2.0, 6)) == "lowers the log-likelihood of left-out trials by 30.0 (standard error 2.0)"
    bad = SimpleNamespace(lack_of_fit={"A": SimpleNamespace(p_value=1e-9), "B": SimpleNamespace(p_value=0.4)})
    wrong = Choice(judged={**laws, "full": replace(nothing, estimate=bad)}, chosen="full", gains=gains, mechanisms={})
    assert "but the full law does not explain the trials of A (lack of fit)" in wrong.verdict()[3]
    shown = {"thixotropy": Gain(-1.0, 4.0, 6)}
    verdict = Choice(judged=laws, chosen="full", gains=gains, mechanisms=shown).verdict()
    assert verdict[-1].startswith(
        "these trials do not show thixotropy: it lowers the log-likelihood of left-out trials by 1.0"
    )


def test_conditions_of_one_trial_cannot_be_left_out(ideal):
    with pytest.raises(ValueError, match="each condition has one trial; expected two in one at least"):
        compare_laws(ideal, ARMS)


def remarks(correlation, errors=(0.39, 0.33)):
    """Remarks on two parameters with the values 43 deg and 2 s."""
    names = ("loss_angle_deg", "recovery_time")
    values, error = (dict(zip(names, numbers, strict=True)) for numbers in ((43.0, 2.0), errors))
    return remarks_on(values, error, np.array([[1.0, correlation], [correlation, 1.0]]), ())


def test_remarks_name_poorly_determined_parameters_and_what_is_determined_of_them():
    # SD of a difference: sqrt(0.39^2 + 0.33^2 - 2 * 0.86 * 0.39 * 0.33) = 0.199, exp(1.96 * 0.199) = 1.478
    first, second, both = remarks(0.86)
    assert first == "loss_angle_deg is poorly determined: 43 (20 to 92)"
    assert second.startswith("recovery_time is poorly determined")
    assert both == (
        "loss_angle_deg / recovery_time is well determined: 21.5 (15 to 32), standard error of the logarithm 0.20, of "
        "each alone 0.39 and 0.33"
    )
    (of_product,) = (remark for remark in remarks(-0.86) if "well determined" in remark)
    assert of_product.startswith("loss_angle_deg * recovery_time is well determined: 86 (58 to 1.3e+02)")
    assert not any("well determined" in remark for remark in remarks(0.7))  # too weak
    assert not any("well determined" in remark for remark in remarks(0.86, (0.9, 0.1)))  # nor is the ratio
    assert remarks(0.86, (0.2, 0.2)) == []
    assert remarks(0.96, (0.2, 0.2)) == [
        "loss_angle_deg and recovery_time are not separately identifiable (error correlation r = 0.96)"
    ]


POSITION = average_person().subjects["PT"]


def position_problem(sets, **fixed):
    arms = {"PT7.5": replace(POSITION, muscle=None)}
    parameters = free_parameters(sets, Model(fixed=fixed))
    return Problem(parameters, sets, nearest_arms(sets, arms))


@pytest.mark.slow(reason="simulates trials of two people")
@pytest.mark.parametrize("level", [0.4, 1.4])
def test_pulses_alone_start_from_the_level_that_answers_them(level):
    true = true_values(POSITION, {})
    fixed = {name: true[name] for name in Model().names("PT", ["PT7.5"])}
    multisine = made.trial_set(made.record(POSITION, [made.push(1, 1.5, 6.0)], condition="PT7.5"))
    force = np.zeros((600, 2))
    force[100:112] = 12.0, 6.0
    pulse = made.trial_set(made.record(at_level(POSITION, level), [force], condition="PT 0"))
    problem = position_problem([multisine, pulse], **fixed)
    assert problem.parameters.names == ["level.PT 0"]
    start = best_start(problem, np.zeros(1), {})
    assert np.exp(start.point) == pytest.approx([level], rel=0.15)
    assert best_start(problem, np.log([0.8]), {"level.PT 0": 0.8}).point == pytest.approx(np.log([0.8]))


@pytest.mark.slow(reason="fits")
def test_a_limit_cycle_is_found_and_invalidates_a_fit(noisy, monkeypatch):
    push = made.push(1, 1.5, 6.0)
    trials = made.trial_set(made.record(POSITION, [push], condition="PT7.5"))
    true, problem = true_values(POSITION, {}), position_problem([trials])
    names = problem.parameters.names
    state = State(np.log([true[name] for name in names]), np.zeros(4), np.full(4, 0.1))
    assert problem.limit_cycles(state) == ()
    reflexes = np.array([2.5 if name.startswith("kv") else 1.0 for name in names])
    assert problem.limit_cycles(state._replace(point=state.point + np.log(reflexes))) == ("PT7.5",)
    monkeypatch.setattr(Problem, "limit_cycles", lambda *_: ("RT7.5",))
    found = fit(noisy[:1], ARMS, FEW, n_pairs=0, max_steps=1)
    assert not found.converged
    assert "the arm has a limit cycle (self-sustained oscillation) in RT7.5" in found.remarks[0]
    # What is not valid is not printed, and says nothing of other parameters.
    assert np.isnan([*found.interval(FREE[0]), found.standard_error[FREE[0]]]).all()
    assert "not known" in found.summary()
    assert not any("determined" in remark or "identifiable" in remark for remark in found.remarks)


@pytest.mark.slow(reason="fits eight trials")
def test_a_result_reads_as_a_table(noisy_fit):
    frame = noisy_fit.to_frame()
    assert tuple(frame.columns) == PARAMETER_COLUMNS
    assert frame["parameter"].tolist() == list(FREE)
    row = frame.iloc[2]
    assert (row["unit"], row["condition"], row["at_bound"]) == ("deg", "", False)
    assert (row["lower_95"], row["upper_95"]) == noisy_fit.interval(FREE[2])
    assert noisy_fit.place_of("level.PT22.5 [PT]") == ("level", "PT22.5")
    of_two = {"level.B mid": 0.9, "level.C high": 0.8}
    leveled = replace(noisy_fit, values=of_two, standard_error=of_two, coordinate_error=of_two)
    assert [row[0] for row in leveled.describe().table.rows] == list(of_two)
    assert leveled.to_frame()["condition"].tolist() == ["B mid", "C high"]
    lines = repr(noisy_fit).splitlines()
    assert lines[0].startswith(f"Muscles of {PERSON.name} in RT: full law, maximum likelihood of raw trials in 2 ")
    assert len(lines) <= 25
    assert "SD over trials: k [RT] " in noisy_fit.summary()


@pytest.fixture
def at_truth(noisy):
    """A problem at the truth, and derivatives there."""
    problem = Problem(free_parameters(noisy, FEW), noisy, ARMS)
    effects = np.zeros(len(problem.kind_of))
    state = State(np.log([TRUE[name] for name in problem.parameters.names]), effects, np.full(len(problem.kinds), 0.08))
    problem.weigh(state, problem.residual(problem.predict([state])[0]))
    return problem, state, problem.slopes(state)


@pytest.mark.slow(reason="simulates eight trials")
def test_what_a_fit_leaves_of_a_record_moves_it_no_more(at_truth):
    problem, state, slopes = at_truth
    white = problem.white(problem.residual(problem.predict([state])[0]))
    (left,) = problem.unexplained(state, slopes, [white])
    before, after = (
        problem.gathered(state, [a @ b for a, b in zip(slopes, record, strict=True)]) for record in (white, left)
    )
    n = len(state.point)
    assert np.abs(after[:n]).max() < 1e-6 * np.abs(before[:n]).max()
    assert sum(np.sum(record**2) for record in left) < sum(np.sum(record**2) for record in white)


@pytest.mark.slow(reason="simulates eight trials")
def test_slopes_are_taken_on_this_side_of_a_bound(at_truth):
    problem, state, slopes = at_truth
    at_bound = Problem(problem.parameters, problem.sets, ARMS)
    at_bound.weigh(state, at_bound.residual(at_bound.predict([state])[0]))
    at_bound.parameters = copy.copy(problem.parameters)
    at_bound.parameters.upper = state.point  # nothing may grow
    asked = []
    predict = at_bound.predict
    at_bound.predict = lambda states, *others: asked.extend(states) or predict(states, *others)
    for found, expected in zip(at_bound.slopes(state), slopes, strict=True):
        np.testing.assert_allclose(found, expected, atol=0.01 * np.abs(expected).max())
    assert all((each.point <= state.point).all() for each in asked)


@pytest.mark.slow(reason="simulates eight trials")
def test_what_an_effect_does_follows_from_the_parameters_that_it_multiplies(noisy):
    problem = Problem(free_parameters(noisy, Model()), noisy, ARMS)
    point = np.array([coordinate(name, TRUE[name]) for name in problem.parameters.names])
    effects = 0.2 * np.random.default_rng(0).standard_normal(len(problem.kind_of))
    state = State(point, effects, np.full(len(problem.kinds), 0.08))
    found = problem.derivatives(state)
    # Without any parameter, and with one that two values are tied to, effects are simulated.
    nothing = Problem(problem.parameters.fixed_at(point), noisy, ARMS)
    alone = nothing.derivatives(state._replace(point=np.empty(0)))
    tied = free_parameters(noisy, Model(tied={"b.shoulder": "k.shoulder"}))
    assert [weights is None for weights in tied.along_effects(np.zeros(len(tied.names)))["RT"]] == [True, True]
    for of_trial, simulated in zip(found, alone, strict=True):
        assert len(simulated) == 2
        np.testing.assert_allclose(of_trial[len(point) :], simulated, atol=0.01 * np.abs(simulated).max())


@pytest.mark.slow(reason="simulates eight trials")
def test_a_trial_in_which_the_arm_diverges_says_nothing_of_where_to_go(at_truth):
    problem, state, _ = at_truth
    roots = tuple(noise.root for noise in problem.noises)
    strengths = [np.ones(len(root)) for root in roots]
    strengths[1] *= 1e6  # of the second condition
    problem.predict_with(NoiseDraws(roots, tuple(strengths), 1, 0))
    n_first = problem.sets[0].n_trials
    slopes = problem.slopes(state, noisy=True)
    assert all(np.isfinite(columns).all() for columns in slopes)
    assert [bool(columns.any()) for columns in slopes] == [True] * n_first + [False] * problem.sets[1].n_trials


@pytest.mark.slow(reason="simulates eight trials")
def test_draws_are_strong_enough_for_what_a_fit_takes_of_them(noisy, at_truth, monkeypatch):
    def strength(problem, state):
        residual = problem.residual(problem.predict([state])[0])
        assert not problem.is_noisy
        draws = predict_with_noise(problem, state, residual, 1, 0)
        assert problem.is_noisy
        return np.mean([strength.mean() for strength in draws.strengths])

    problem, state, _ = at_truth
    fitted = strength(problem, state)
    other = Problem(problem.parameters, noisy, ARMS)
    other.weigh(state, other.residual(other.predict([state])[0]))
    monkeypatch.setattr(other, "unexplained", lambda state, slopes, records: records)
    assert fitted > 1.001 * strength(other, state)


@pytest.mark.slow(reason="simulates eight trials in the presence of many draws")
def test_what_draws_leave_in_predictions_does_not_move_a_fit(at_truth):
    problem, state, _ = at_truth
    roots = tuple(noise.root for noise in problem.noises)
    draws = NoiseDraws(roots, tuple(np.ones(len(root)) for root in roots), 16, 1000)
    mean = np.mean([even for _, even in problem.odd_and_even(state, draws)], axis=0)
    moves: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for seed in range(6):
        problem.predict_with(draws._replace(n_pairs=1, seed=seed))
        left = problem.white(problem.predict([state])[0] - mean)
        for noisy, moved in moves.items():
            slopes = problem.slopes(state, noisy=noisy)
            score = problem.gathered(state, [a @ b for a, b in zip(slopes, left, strict=True)])
            moved.append(np.linalg.solve(problem.information(state, slopes), score)[: len(state.point)])
    # In standard errors of the mean over seeds: what a pair leaves is made smaller by a change of the parameters only
    # where derivatives are those in the presence of the same pair.
    own, others = (
        np.abs(np.mean(moved, axis=0) / (np.std(moved, axis=0, ddof=1) / np.sqrt(len(moved))))
        for moved in (moves[True], moves[False])
    )
    assert own.max() > 5.0
    assert others.max() < 4.0


def test_errors_count_that_predictions_move_otherwise_than_without_noise():
    class Alone(Problem):
        def __init__(self):
            self.n_trials, self.effects_of, self.kind_of = 1, [slice(0, 0)], np.empty(0, dtype=int)

        def prior(self, state):
            return np.full(3, 1e-9)

        def emg_normal(self, state):
            return Normal(np.zeros((3, 3)), np.zeros(3))

    rng, n = np.random.default_rng(0), 400
    slopes = rng.standard_normal((3, n))
    answers = np.array([[0.8, 0.0, 0.1], [0.3, 0.5, 0.0], [0.0, 0.1, 0.7]]) @ slopes + rng.standard_normal((3, n))
    state, problem = State(np.zeros(3), np.empty(0), np.empty(0)), Alone()
    alone = problem.information(state, [slopes])
    moved = inverse_of_mixed(alone, mixed_information(problem, state, [slopes], [answers]))
    # Where slopes and residual are orthogonal, of records that are the noise of unit variance alone.
    found = [np.linalg.solve(slopes @ answers.T, slopes @ rng.standard_normal(n)) for _ in range(4000)]
    np.testing.assert_allclose(np.cov(np.transpose(found)), moved @ (slopes @ slopes.T) @ moved.T, atol=4e-4)
    # What answers nothing is not taken for unknown altogether.
    answers[2] = 0.0
    moved = inverse_of_mixed(alone, mixed_information(problem, state, [slopes], [answers]))
    assert np.sqrt(np.abs(moved[2, 2])) < 3.0 / np.linalg.norm(slopes[2])


@pytest.mark.slow(reason="simulates eight trials")
def test_lack_of_fit_is_judged_by_draws(at_truth):
    problem, state, slopes = at_truth
    predicted = problem.predict([state])[0]
    roots = tuple(noise.root for noise in problem.noises)
    draws = NoiseDraws(roots, tuple(np.ones(len(root)) for root in roots), 3, 0)
    none = simulate_deviations(problem, state, draws._replace(n_pairs=0), 1)
    drawn = simulate_deviations(problem, state, draws, 2)
    stronger = type(drawn)(*([2.0 * part for part in half] for half in drawn))
    stationary, as_drawn, less = (
        lack_of_fit(problem, state, predicted, slopes, deviations) for deviations in (none, drawn, stronger)
    )
    for label in ("RT2.5", "RT7.5"):
        assert stationary[label].dof % 8 == 0
        assert less[label].dof == as_drawn[label].dof
        assert less[label].chi2 == pytest.approx(as_drawn[label].chi2 / 4.0)
