"""From simulated recordings back to the people in them."""

import functools

import numpy as np
import pytest
import xarray as xr

from armperturb.analysis.fit.identify import identify, identify_conditions
from armperturb.analysis.fit.maximum_likelihood import Estimate
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.force_balance import Balance
from armperturb.analysis.measures.vaf import variance_accounted_for
from armperturb.analysis.results import quantile
from armperturb.analysis.trials import ConditionTrials
from armperturb.environment import Environment
from armperturb.study.report.tables import true_value
from armperturb.subject import POSITION, RELAX

PARTS = {"RT7.5": [0, 1, 2], "RT22.5": [3, 4, 5]}
"""Trials of each condition of the noisy recording."""


@pytest.fixture(scope="module")
def of_ideal(relax_recording, position_recording):
    """A function: what a model and an estimator make of the ideal trials of its task."""
    recordings = {"1": relax_recording, "3b": position_recording}
    return functools.cache(lambda model, estimator: identify(recordings[model], model, estimator=estimator))


@pytest.mark.slow(reason="fits many structures")
@pytest.mark.parametrize("estimator", ["record", "frequency"])
@pytest.mark.parametrize(("model", "arm"), [("1", RELAX), ("3b", POSITION)], ids=["1", "3b"])
def test_parameters_that_were_put_in_come_out(model, arm, estimator, of_ideal):
    result = of_ideal(model, estimator)
    for name, estimate in result.fit.values.items():
        assert estimate == pytest.approx(true_value(arm, name), rel=0.01), name
    assert result.fit.stable
    assert result.fit.converged
    assert (result.vaf > 99.9).all()
    assert result.fit.estimator == result.fit.detail.method == estimator
    assert result.environment.m_env == pytest.approx(Environment().m_env, rel=0.001)
    assert result.environment.k_env == pytest.approx(Environment().k_env, rel=0.001)


@pytest.mark.slow(reason="fits each trial")
def test_the_thesis_estimator_is_the_mean_over_trials(relax_recording):
    recording = relax_recording.isel(trial=[0, 1])
    result = identify(recording, "1", estimator="thesis")
    assert isinstance(result.fit.detail, ThesisEstimate)
    trials = [identify(recording.isel(trial=[k]), "1", estimator="thesis").fit for k in range(2)]
    for name, value in result.fit.values.items():
        assert value == pytest.approx(np.mean([one.values[name] for one in trials]), rel=2e-3), name
        sem = np.mean([one.standard_error[name] for one in trials])
        assert result.fit.standard_error[name] == pytest.approx(sem, rel=2e-2), name
    assert result.fit.message.startswith(("1 of 2 trials", "2 of 2 trials"))


@pytest.mark.slow(reason="identifies noisy trials")
def test_noise_widens_intervals_that_hold_the_truth(noisy_relax_recording, of_ideal):
    noisy = identify(noisy_relax_recording.assign_coords(condition=("trial", ["RT7.5"] * 6)), "1").fit
    clean = of_ideal("1", "record").fit
    scores = []
    for name, error in noisy.standard_error.items():
        assert error > 5 * clean.standard_error[name], name
        lower, upper = noisy.interval(name)
        assert (lower + upper) / 2 == pytest.approx(noisy.values[name])
        assert upper - lower == pytest.approx(2 * quantile(0.95, noisy.degrees_of_freedom.get(name, np.inf)) * error)
        scores.append((noisy.values[name] - true_value(RELAX, name)) / error)
    assert np.abs(scores).max() < 4.0
    assert isinstance(noisy.detail, Estimate)
    assert noisy.detail.p_value > 1e-3


@pytest.mark.slow(reason="identifies two conditions several times")
def test_conditions_are_identified_one_by_one_or_share_what_is_asked_for(noisy_relax_recording):
    periods = {"estimator": "frequency"}
    alone = {name: identify(noisy_relax_recording.isel(trial=part), "1", **periods) for name, part in PARTS.items()}
    apart = identify_conditions(noisy_relax_recording, "1", **periods)
    together = identify_conditions(noisy_relax_recording, "1", share=["mass", "grip", "k_s"], **periods)
    assert list(apart) == list(together) == ["RT7.5", "RT22.5"]
    shared = {"m_h", "m_f", "b_h", "k_h", "k_s"}
    first, second = (together[name].fit for name in PARTS)
    for name in first.values:
        assert (first.values[name] == second.values[name]) == (name in shared), name
        for label in PARTS:
            assert apart[label].fit.values[name] == alone[label].fit.values[name], name
    for name in shared:
        known = [alone[label].fit.standard_error[name] for label in PARTS]
        assert first.standard_error[name] < 1.05 * min(known), name
    assert first.arm.k_e != second.arm.k_e
    assert [result.fit.remarks for result in apart.values()] == [result.fit.remarks for result in alone.values()]
    assert first.detail is second.detail
    # A shared parameter is one row.
    rows = together.to_frame().groupby("parameter")["condition"].agg(list)
    for name in first.values:
        assert rows[name] == (["RT7.5+RT22.5"] if name in shared else ["RT7.5", "RT22.5"]), name
    assert (apart.to_frame()["parameter"].value_counts() == 2).all()


@pytest.mark.slow(reason="fits trials")
def test_conditions_without_a_multisine_are_left_out_if_there_are_others(relax_recording):
    labels = relax_recording["condition"].values.copy()
    labels[3] = "RT0"
    silent = relax_recording.copy(deep=True).assign_coords(condition=("trial", labels))
    silent["perturbation"][3] = 0.0
    assert list(identify_conditions(silent, "1", estimator="frequency")) == ["RT7.5"]
    with pytest.raises(ValueError, match=r"are not independent|no disturbance|perturb"):
        identify_conditions(silent.isel(trial=[3]), "1")


@pytest.mark.slow(reason="fits trials")
def test_a_condition_that_cannot_be_identified_costs_the_others_nothing(relax_recording):
    first, second = relax_recording.isel(trial=[0, 1]), relax_recording.isel(trial=[2, 3])
    wrong = second.assign(force=-second["force"]).assign_coords(condition=("trial", ["RT22.5"] * 2))
    both = xr.concat([first, wrong], "trial", combine_attrs="override")
    results = identify_conditions(both, "1", estimator="frequency")
    assert list(results) == ["RT7.5"]
    assert results["RT7.5"].fit.values == identify(first, "1", estimator="frequency").fit.values
    (why,) = (remark for remark in results.remarks if remark.startswith("RT22.5 is not identified: "))
    assert "force must be the reaction force that the handle exerts on the hand" in why
    message = "force must be the reaction force"
    with pytest.raises(ValueError, match=message):  # together or not at all
        identify_conditions(both, "1", estimator="frequency", share=["mass"])
    late = {"RT7.5": wrong.assign_coords(condition=("trial", ["RT7.5"] * 2)), "RT22.5": wrong}
    with pytest.raises(ValueError, match=message) as refused:
        identify_conditions(late, "1", estimator="frequency")
    assert str(refused.value).count(message) == 1  # once for both


@pytest.mark.slow(reason="fits trials")
def test_one_trial_is_enough(position_recording):
    result = identify(position_recording.isel(trial=[2]), "3b")
    assert len(result.spectra.frequency) == 18
    assert (result.vaf > 99.0).all()
    for name in ("m_tot", "k_s", "k_e", "b_e"):
        assert result.fit.values[name] == pytest.approx(true_value(POSITION, name), rel=0.02)


@pytest.mark.parametrize("estimator", ["record", "frequency", "thesis"])
@pytest.mark.parametrize(("model", "fixture"), [("1", "relax_recording"), ("3b", "position_recording")])
def test_wrong_sign_of_the_force_is_named(model, fixture, estimator, request):
    recording = request.getfixturevalue(fixture)
    with pytest.raises(ValueError, match="force must be the reaction force that the handle exerts on the hand"):
        identify(recording.assign(force=-recording["force"]), model, estimator=estimator)


def test_environment_is_exact_without_noise(relax_recording):
    for n_trials in (1, 4):
        names = ("perturbation", "force", "displacement")
        found, _ = Balance(*(relax_recording[name].values[:n_trials] for name in names), 200.0).fit()
        assert found.m_env == pytest.approx(Environment().m_env, rel=1e-3)
        assert found.b_env == pytest.approx(Environment().b_env, rel=1e-2)
        assert found.k_env == pytest.approx(Environment().k_env, rel=1e-2)


def test_vaf_follows_its_definition():
    time = np.arange(4000) / 200
    x = np.stack([np.sin(2 * np.pi * 2 * time), np.cos(2 * np.pi * 3 * time)], axis=-1)
    np.testing.assert_allclose(variance_accounted_for(x, x, 200), 100)
    np.testing.assert_allclose(variance_accounted_for(x, 0 * x, 200, highpass=None), 0)
    np.testing.assert_allclose(variance_accounted_for(x, 0.5 * x, 200, highpass=None), 75)
    np.testing.assert_allclose(variance_accounted_for(x, -x, 200, highpass=None), -300)


def test_vaf_forgets_slow_corrections():
    time = np.arange(6000) / 200
    x = np.stack([np.sin(2 * np.pi * 3 * time)] * 2, axis=-1)
    slow = 2 * np.sin(2 * np.pi * 0.03 * time)[:, None]
    assert (variance_accounted_for(x + slow, x, 200, highpass=None) < 50).all()
    assert (variance_accounted_for(x + slow, x, 200) > 99).all()


def test_body_is_read_from_the_recording(relax_recording):
    body = ConditionTrials.prepare(relax_recording).body
    assert (body.task, body.l_h, body.l_f, body.name) == ("RT", RELAX.l_h, RELAX.l_f, "relax")
    np.testing.assert_allclose(body.posture, RELAX.posture)


def test_mixed_recordings_are_refused(relax_recording, position_recording):
    both = xr.concat([relax_recording, position_recording], "trial", combine_attrs="override")
    with pytest.raises(ValueError, match=r"subject has several values \(relax, position\); expected"):
        identify(both, "1")


def test_bad_requests_are_named(relax_recording):
    for options, message in (
        ({"model": "9"}, "model = '9'; expected one of 1, 2, 3"),
        ({"model": "1", "estimator": "guess"}, "estimator = 'guess'; expected one of thesis, frequency, record"),
        ({"model": "1", "share": ["k_x"]}, "share: 'k_x' is no free parameter; expected mass, damping"),
        (
            {"model": "1", "estimator": "thesis", "share": ["mass", "grip"]},
            "share = mass, grip; expected nothing with estimator = 'thesis'",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            identify_conditions(relax_recording, **options)


def test_model_3b_fixes_the_published_grip_of_the_task():
    assert STRUCTURES["3b"].fixed["PT"]["k_h"] == 22.4e3
    assert STRUCTURES["3b"].fixed["RT"]["k_h"] == 8.4e3
