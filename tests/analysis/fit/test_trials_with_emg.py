"""Movement and EMG of the same trials: derivatives, sampling rates, and a person whose effort shows in the EMG."""

from dataclasses import replace

import numpy as np
import pytest

from armperturb.analysis.emg.envelope import envelopes
from armperturb.analysis.emg.outputs import reflex_outputs
from armperturb.analysis.fit.emg_laws import STRETCH, TORQUE
from armperturb.analysis.fit.emg_likelihood import FEW_WITH_EMG, UNTIMELY, ElectromechanicalDelay, EmgLikelihood
from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.joint_likelihood import JointLikelihood
from armperturb.analysis.fit.maximum_likelihood import UNLIKE, estimate
from armperturb.analysis.fit.structures import structure_of
from armperturb.analysis.trials import ConditionTrials
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.envs.lab.emg import Emg, effort_excitation
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.subject import POSITION

NOISE = replace(HUMAN_NOISE["PT"], spread_b=0.0, spread_k=0.0, spread_kv=0.0, spread_kp=0.0)


def with_emg(recording, sd=0.0):
    """Trials of a recording and their EMG."""
    trials = ConditionTrials.prepare(recording)
    likelihood = EmgLikelihood(reflex_outputs(trials, envelopes(recording)), ElectromechanicalDelay(sd=sd))
    return Group.prepare([trials], structure_of("3", wide=True)).with_emg(likelihood)


def recorded(trials, effort, **options):
    """Of a linear arm, so that nothing but noise is left of the movement."""
    instruments = Instruments(marker_noise=None, emg=Emg(effort=effort))
    return run_experiment(trials, linear=True, instruments=instruments, n_threads=1, **options)


@pytest.fixture(scope="module")
def recording(studies):
    return recorded(studies.perturbed(POSITION, 5.4, 4, noise=NOISE), 0.0)


@pytest.fixture(scope="module")
def group(recording):
    return with_emg(recording)


@pytest.fixture(scope="module")
def fitted(group):
    """The estimate from whole records; others are from mean periods where what is asked about them is the same."""
    return estimate([group])


@pytest.mark.slow(reason="simulates four trials with EMG")
def test_slope_is_that_of_the_cost(group):
    problem = JointLikelihood([group], "record", ())
    values = problem.stabilised(problem.initial({"kp_s": 20.0, "Td_e": 0.04}))
    problem.weigh(values)
    slope = problem.normal(values).slope
    for column, name in enumerate(problem.names):
        step = 1e-4 * max(abs(values[column]), 1e-3)
        ends = [problem.cost(values + sign * step * np.eye(len(values))[column]) for sign in (1, -1)]
        assert -2.0 * slope[column] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=2e-3, abs=1e-2), name


@pytest.mark.slow(reason="simulates four trials with EMG")
def test_slopes_of_long_records_are_those_of_the_derivatives(group, monkeypatch):
    problem = JointLikelihood([group], "record", ())
    values = problem.stabilised(problem.initial({"kp_s": 20.0, "Td_e": 0.04}))
    problem.weigh(values)
    slope = problem.normal(values).slope
    monkeypatch.setattr("armperturb.analysis.fit.whittle.LONGEST_RUN", 100)
    assert problem.is_long
    np.testing.assert_allclose(problem.normal(values).slope, slope, rtol=0, atol=1e-8 * np.abs(slope).max())
    problem.quick = True
    assert np.abs(problem.normal(values).slope - slope).max() > 1e-4 * np.abs(slope).max()


def by_stretch(outputs, noise=0.05):
    """The same trials with EMG of muscles each of which follows its own stretch, as the arm has it."""
    rng, rate = np.random.default_rng(0), outputs.rate
    q = outputs.rotation
    groups = {
        "s": (q[..., 0], POSITION.kv_s - POSITION.kv_se, POSITION.kp_s - POSITION.kp_se),
        "e": (q[..., 1], POSITION.kv_e - POSITION.kv_se, POSITION.kp_e - POSITION.kp_se),
        "se": (q.sum(axis=2), POSITION.kv_se, POSITION.kp_se),
    }
    made = np.empty_like(outputs.difference)
    frequency = np.fft.rfftfreq(2 * q.shape[1], 1.0 / rate)
    late = np.exp(-2j * np.pi * frequency * POSITION.Td_s)
    for place, name in enumerate(outputs.groups):
        stretch, kv, kp = groups[name]
        seen = kv * np.gradient(stretch, 1.0 / rate, axis=1) + kp * stretch
        padded = np.fft.rfft(seen, 2 * q.shape[1], axis=1) * late
        made[..., place] = 0.05 * np.fft.irfft(padded, axis=1)[:, : q.shape[1]]
    return replace(outputs, difference=made + noise * rng.standard_normal(made.shape), averaging=1e-6)


@pytest.fixture(scope="module")
def outputs(recording):
    return reflex_outputs(ConditionTrials.prepare(recording), envelopes(recording))


def with_outputs(group, outputs):
    return group.with_emg(EmgLikelihood(outputs, ElectromechanicalDelay()))


@pytest.mark.slow(reason="simulates four trials with EMG")
def test_muscles_may_follow_their_own_stretch_or_the_torque_of_their_joints(group, outputs, fitted):
    of_stretch = estimate([with_outputs(group, by_stretch(outputs))], "frequency", initial=fitted.values)
    assert (of_stretch.law, fitted.law) == (STRETCH, TORQUE)
    assert of_stretch.p_value > 0.01
    assert any(remark.startswith("EMG follows the stretch of each muscle alone") for remark in of_stretch.remarks)
    for name in ("kv_s", "kv_se", "kv_e", "kp_s", "kp_se", "kp_e"):
        error = of_stretch.values[name] - getattr(POSITION, name)
        assert abs(error) < 3.5 * of_stretch.standard_error[name], name


@pytest.mark.slow(reason="simulates four trials with EMG")
def test_emg_that_does_not_fit_is_named_and_not_the_movement(group, outputs, fitted):
    swapped = outputs.difference * np.array([-1.0 if name == "se" else 1.0 for name in outputs.groups])
    swapped = with_outputs(group, replace(outputs, difference=swapped))
    wrong = estimate([swapped], "frequency", initial=fitted.values)
    assert wrong.doubts_emg
    assert sum(remark.startswith(UNLIKE) for remark in wrong.remarks) == 1
    assert not any("more of the movement" in remark for remark in wrong.remarks)


@pytest.mark.slow(reason="simulates four trials with EMG")
def test_effort_that_shows_in_the_emg_raises_doubt(studies, fitted):
    assert fitted.p_value > 0.01
    slow = NOISE.without_fast_part()  # which never shows, and hides in the movement what does
    shown = estimate([with_emg(recorded(studies.perturbed(POSITION, 5.4, 4, noise=slow), 1.0))], "frequency")
    assert shown.p_value < 1e-4


@pytest.mark.slow(reason="simulates four trials with EMG")
def test_emg_that_is_late_is_named_unless_its_delay_is_estimated(recording, fitted):
    assert not any(remark.startswith(UNTIMELY) for remark in fitted.remarks)
    late = recording.assign(emg=recording["emg"].copy(data=np.roll(recording["emg"].values, 40, axis=1)))  # by 20 ms
    said = [remark for remark in estimate([with_emg(late)]).remarks if remark.startswith(UNTIMELY)]
    assert len(said) == 1
    assert 12.0 < float(said[0].partition("as if EMG were ")[2].partition(" ms late")[0]) < 24.0
    free = estimate([with_emg(late, sd=0.02)], "frequency")
    assert not any(remark.startswith(UNTIMELY) for remark in free.remarks)
    late["emg"].attrs["lead"] = late["emg"].attrs.get("lead", 0.0) - 0.02
    assert not any(remark.startswith(UNTIMELY) for remark in estimate([with_emg(late)], "frequency").remarks)


@pytest.mark.slow(reason="simulates two trials with EMG")
def test_two_trials_are_taken_to_differ_from_the_person(studies):
    reflexes = ("kv_s", "kv_se", "kv_e", "kp_s", "kp_se", "kp_e")
    quicker = replace(POSITION, **{name: 1.1 * getattr(POSITION, name) for name in reflexes})
    fitted = estimate([with_emg(recorded(studies.perturbed(quicker, 5.4, 2, noise=NOISE), 0.0))])
    assert FEW_WITH_EMG in fitted.remarks
    assert not fitted.trial_spread
    for name in reflexes:
        low, high = fitted.interval(name)
        assert low < getattr(POSITION, name) < high, name
        # The mean of two trials that differ by 10 %, as all gains do together, is known no better than to 7 %.
        assert fitted.standard_error[name] >= 0.07 * abs(fitted.values[name]), name


@pytest.mark.slow(reason="simulates three trials with EMG")
def test_faster_samples_are_taken_as_slowly_as_those_of_the_movement(studies):
    recording = recorded(studies.perturbed(POSITION, 5.4, 3, noise=NOISE), 0.0, timestep=1e-3, rate=1000.0)
    assert estimate([with_emg(recording)]).p_value > 0.01


def test_the_fast_part_of_the_remnant_does_not_show(studies):
    """Without reflexes nothing but effort shows, which is the same beside a fast part."""
    arm = replace(POSITION, kv_s=0.0, kv_se=0.0, kv_e=0.0, kp_s=0.0, kp_se=0.0, kp_e=0.0)
    read = [
        recorded(studies.perturbed(arm, 5.4, 1, noise=noise), 1.0)["emg"].values
        for noise in (replace(NOISE, fast_share=1.0), replace(NOISE, fast_share=0.0))
    ]
    np.testing.assert_array_equal(*read)


def test_excitation_is_what_makes_the_torque():
    """Through delay and activation dynamics, integrated in time, it gives the torque back."""
    rate, n = 2000.0, 8000
    time = np.arange(n) / rate
    torque = np.sin(2 * np.pi * np.multiply.outer(time, [1.5, 0.7])) * np.sin(np.pi * time / time[-1])[:, None] ** 4
    arm = replace(POSITION, Td_e=0.04)
    excitation = effort_excitation(arm, torque, rate)
    for column, joint in enumerate("se"):
        omega, late = 2 * np.pi * getattr(arm, f"fact_{joint}"), round(getattr(arm, f"Td_{joint}") * rate)
        drive = -np.concatenate([np.zeros(late), excitation[:-late, column]])
        state, made = np.zeros(2), np.empty(n)
        for k in range(n):
            made[k] = state[0]
            change = omega**2 * (drive[k] - state[0]) - 2 * arm.zeta_act * omega * state[1]
            state = state + np.array([state[1] + 0.5 * change / rate, change]) / rate
        assert np.abs(made - torque[:, column]).max() < 0.02 * np.abs(torque[:, column]).max()
