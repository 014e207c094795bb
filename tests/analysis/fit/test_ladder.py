"""The trials choose the structure of arms that the package did not make."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_recordings import draw_foreign

from armperturb.analysis.fit import group as group_module
from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.identify import identify, identify_conditions
from armperturb.analysis.fit.ladder import choose_structure, left_out_loss
from armperturb.analysis.fit.maximum_likelihood import estimate
from armperturb.analysis.fit.own_structures import composed
from armperturb.analysis.fit.sketch import sketch
from armperturb.analysis.fit.trial_effects import TrialScore
from armperturb.convert.importer import import_recording

JUDGED = ("k_s", "k_se", "k_e", "b_s", "b_se", "b_e")


def recorded(seed, **options):
    setup = draw_foreign(seed, n_trials=4, duration=12.0, rate=100.0, period=5.0, **options)
    return setup.truth, setup.recording()


@pytest.mark.slow(reason="fits several structures to each recording")
@pytest.mark.parametrize(("seed", "grip", "reflex"), [(5, "rigid", "none"), (6, "spring", "position")])
def test_right_structure_is_chosen_and_its_parameters_are_right(seed, grip, reflex):
    truth, recording = recorded(seed, kind="multisine", grip=grip, reflex=reflex)
    fit = identify(recording).fit
    assert fit.choice.chosen[:3] == ("free", grip, reflex)
    assert fit.choice.in_motion
    error = np.array([(fit.values[name] - truth[name]) / fit.standard_error[name] for name in JUDGED])
    assert np.abs(error).max() < 4.0
    assert f"structure chosen: inertia free, grip {grip}, reflex {reflex}; runner-up: " in fit.remarks[0]
    assert [rung.score for rung in fit.choice.rungs] == sorted(rung.score for rung in fit.choice.rungs)
    frame = fit.choice.to_frame()
    assert frame["structure"].tolist() == [rung.name for rung in fit.choice.rungs]
    assert frame["score_less_best"].iloc[0] == 0.0
    assert (frame["score_less_best"].diff()[1:] >= 0.0).all()


@pytest.mark.slow(reason="simulates and identifies a recording")
def test_a_wrong_structure_is_said_to_be_wrong():
    _, recording = recorded(6, kind="multisine", grip="spring", reflex="position")
    assert any("the disturbance explains more" in remark for remark in identify(recording, "1").fit.remarks)


@pytest.fixture(scope="module")
def example():
    """A linear person who keeps position, with all noise: two trials, so that their spectra tell little."""
    return import_recording([Path(__file__).parents[3] / "examples/data/position.csv"]).recording


@pytest.mark.filterwarnings("ignore:as many averages as inputs")
@pytest.mark.slow(reason="fits several structures")
def test_a_search_that_ends_at_a_delay_far_too_long_is_begun_again(example):
    """From the spectra of this recording, searches lead to delays of 0.1 s."""
    choice = choose_structure(Group.prepare(example, composed()))
    assert choice.chosen.reflex == "position"
    assert not choice.estimate.is_suspicious
    assert 0.02 < choice.estimate.values["Td_s"] < 0.045
    objective = {rung[:3]: rung.sketch.objective for rung in choice.rungs}
    assert objective["free", "spring", "position"] < objective["free", "spring", "velocity"]


@pytest.mark.filterwarnings("ignore:as many averages as inputs")
@pytest.mark.slow(reason="searches from several starts")
def test_a_structure_is_found_where_its_usual_starts_lead_astray(example):
    fit = estimate([Group.prepare(example, composed(inertia="free", grip="spring", reflex="position"))])
    assert not fit.is_suspicious
    assert 0.02 < fit.values["Td_s"] < 0.045


@pytest.mark.slow(reason="fits many structures")
def test_neighbours_are_searched_again_from_a_structure_that_was_found_late():
    """The first searches of this arm, of the richest structure and from it, all end in the wrong place."""
    setup = draw_foreign(731, n_trials=3, duration=16.0, rate=100.0, linear=True)
    choice = choose_structure(Group.prepare(setup.recording(), composed()))
    assert choice.chosen[:3] == ("free", setup.truth["grip"], setup.truth["reflex"])
    assert not choice.estimate.is_suspicious


def test_loss_on_left_out_trials_is_that_of_leaving_them_out():
    """A linear problem, where the loss is exact but for what is of second order in the share of a trial."""
    rng = np.random.default_rng(0)
    designs, n_trials = rng.normal(size=(6, 40, 3)), 6
    answers = designs @ [1.0, -2.0, 0.5] + rng.normal(size=(n_trials, 40))
    whole = np.linalg.lstsq(designs.reshape(-1, 3), answers.ravel(), rcond=None)[0]
    scores, loss = [], 0.0
    for trial in range(n_trials):
        design, left = designs[trial], answers[trial] - designs[trial] @ whole
        scores.append(TrialScore(range(3), design.T @ left, design.T @ design, np.zeros((3, 5))))
        others = np.delete(np.arange(n_trials), trial)
        without = np.linalg.lstsq(designs[others].reshape(-1, 3), answers[others].ravel(), rcond=None)[0]
        loss += np.sum((answers[trial] - design @ without) ** 2) - np.sum(left**2)
    assert left_out_loss(scores) == pytest.approx(loss, rel=1e-9)


@pytest.mark.slow(reason="fits long trials")
def test_long_trials_are_compared_in_segments_to_the_same_result(monkeypatch):
    """Segments lose what is about their ends, so that results differ by a part of their errors."""
    setup = draw_foreign(6, n_trials=2, duration=80.0, rate=200.0, kind="noise", grip="rigid", reflex="velocity")
    setup = replace(setup, linear=True)
    structure = composed(inertia="free", grip="rigid", reflex="velocity")
    group = Group.prepare(setup.recording(), structure)
    start = [group.initial]
    whole = sketch(group, start)
    assert group.segments is group.records
    monkeypatch.setattr(group_module, "LONGEST_RUN", 1000)
    monkeypatch.setattr(group_module, "SEGMENT", 25.0)
    cut = replace(group, made={})
    in_segments = sketch(cut, start)
    assert [likelihood.n_trials for likelihood in cut.segments] == [6]
    assert len(whole.scores) == len(in_segments.scores) == 2
    information = sum(score.information for score in whole.scores)
    error = np.sqrt(np.diag(np.linalg.inv(information)))
    assert np.abs((in_segments.values - whole.values) / error).max() < 0.7
    lost = sum(score.information for score in in_segments.scores).diagonal() / information.diagonal()
    assert lost.min() > 0.7
    assert lost.max() < 1.1


def test_a_choice_of_structure_shares_nothing():
    _, recording = recorded(6, kind="noise", grip="rigid", reflex="none")
    with pytest.raises(
        ValueError, match=r"identify: estimator = 'thesis' without a model; expected one, e.g. --model 3"
    ):
        identify(recording, estimator="thesis")


def test_conditions_are_named_as_they_are_fitted(noisy_relax_recording):
    said: list[str] = []
    first = noisy_relax_recording.isel(trial=slice(3))
    assert said == list(identify_conditions(first, estimator="frequency", progress=said.append)) == ["RT7.5"]
    for estimator in ("frequency", "thesis"):
        said.clear()
        results = identify_conditions(noisy_relax_recording, "1", estimator=estimator, progress=said.append)
        assert said == list(results) == ["RT7.5", "RT22.5"]
