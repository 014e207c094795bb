"""Trials of a condition: checked, cut and identified once."""

import pickle

import numpy as np
import pytest

from armperturb.analysis import periods as module
from armperturb.analysis.cuts import onset_samples
from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.analysis.force_balance import Balance
from armperturb.analysis.periods import check_period, common_period
from armperturb.analysis.response.estimate import response
from armperturb.analysis.response.spectra import averaged_spectra, line_spectra
from armperturb.analysis.trials import ConditionTrials, prepared_recordings, trials_by_condition


@pytest.fixture(scope="module")
def pulsed(noisy_relax_recording):
    """Three trials that end in pulses at 28.5 s or later, of which the last meets the workspace limit after its own."""
    recording = noisy_relax_recording.isel(trial=slice(3))
    onset = recording["pulse_onset"].values
    return recording.assign_coords(limit_time=("trial", [np.nan, np.nan, onset[2] + 0.1]))


def test_the_onset_is_the_first_sample_of_the_pulse_or_the_end(pulsed):
    onsets = pulsed["pulse_onset"].values.copy()
    onsets[1] = np.nan
    changed = pulsed.assign_coords(pulse_onset=("trial", onsets))
    n = pulsed.sizes["time"]
    assert onset_samples(changed).tolist() == [round(onsets[0] * 200.0), n, round(onsets[2] * 200.0)]
    assert onset_samples(changed.assign_coords(pulse_onset=("trial", [1e3] * 3))).tolist() == [n] * 3


def test_people_may_be_numbered(pulsed):
    assert ConditionTrials.prepare(pulsed.assign_coords(subject=("trial", [7, 7, 7]))).body.name == "7"


def test_the_multisine_is_what_comes_before_the_first_pulse_of_trials_inside(pulsed):
    trials = ConditionTrials.prepare(pulsed)
    first = trials.first_onset
    early = pulsed.assign_coords(limit_time=("trial", [np.nan, 20.0, np.nan]))
    assert trials.multisine.numbers.tolist() == [0, 1, 2]  # the pulse alone took the last to the limit
    assert trials.multisine.n_samples == first
    assert np.isinf(trials.multisine.limit).all()
    assert ConditionTrials.prepare(early).multisine.numbers.tolist() == [0, 2]
    with pytest.raises(
        ValueError, match=r"trial 2 reached the workspace limit .*recording.isel\(trial=\[...\]\) takes"
    ):
        line_spectra(trials)
    assert line_spectra(trials.multisine).line.size > 20


def test_trials_that_were_used_can_be_sent_to_another_process_with_their_results(pulsed, monkeypatch):
    trials = ConditionTrials.prepare(pulsed).take([0, 1])
    used = response(trials, window_start=2.0)
    line_spectra(trials.whole.multisine)
    copy = pickle.loads(pickle.dumps(trials))
    monkeypatch.setattr(Balance, "fit", lambda _: pytest.fail("the manipulator is identified again"))
    assert copy.environment == trials.environment
    assert len(copy.results) == len(trials.results) > 0
    np.testing.assert_array_equal(response(copy, window_start=2.0).response, used.response)


def test_trials_that_are_taken_share_manipulator_and_displacement(pulsed, monkeypatch):
    trials = ConditionTrials.prepare(pulsed)
    whole = trials.displacement
    monkeypatch.setattr(Balance, "fit", lambda _: pytest.fail("the manipulator is identified again"))
    taken = trials.take([0, 2]).take([1])
    assert taken.numbers.tolist() == [2]
    np.testing.assert_array_equal(taken.displacement, whole[[2]])
    assert taken.environment == trials.environment
    cut = taken.before(4000)
    assert (cut.end, taken.end) == (4000, trials.end)
    np.testing.assert_array_equal(cut.displacement, whole[[2]])


def test_fits_end_before_the_limit_and_before_the_end(pulsed):
    assert ConditionTrials.prepare(pulsed).end == pytest.approx(pulsed["limit_time"].values[2] * 200.0, abs=1)
    free = pulsed.assign_coords(limit_time=("trial", [np.nan] * 3))
    assert ConditionTrials.prepare(free).end == pulsed.sizes["time"] - 100


def test_results_are_kept_with_the_trials(pulsed, monkeypatch):
    trials = ConditionTrials.prepare(pulsed).multisine
    counts = {"find_period": 0}
    find = module.find_period

    def counted(*arguments):
        counts["find_period"] += 1
        return find(*arguments)

    monkeypatch.setattr(module, "find_period", counted)
    assert averaged_spectra(trials) is averaged_spectra(trials, lines_per_average=4)
    assert averaged_spectra(trials) is not averaged_spectra(trials, lines_per_average=2)
    assert common_period([trials], 8.0) == common_period([trials], 2.0) == 20.48
    assert counts["find_period"] == 1


def test_the_found_period_is_that_which_is_stated(relax_recording):
    trials = ConditionTrials.prepare(relax_recording)
    np.testing.assert_array_equal(line_spectra(trials).force, line_spectra(trials, period=20.48).force)
    for period in (10.0, 20.0):
        with pytest.raises(
            ValueError, match=rf"period = {period:g} s; .* does not repeat after it from 4 s on \(without"
        ):
            check_period(trials, 8.0, period)
    check_period(trials, 8.0, 20.48)
    check_period(trials, 8.0, None)
    with pytest.raises(ValueError, match=r"period of 0\.001 s is a whole number of samples"):
        check_period(trials, 8.0, 0.001)


def test_trials_that_are_cut_at_their_first_sample_have_nothing_to_fit(relax_recording):
    trials = ConditionTrials.prepare(relax_recording)
    assert trials.before(0).end == 0


def test_recordings_of_other_lengths_have_one_period(relax_recording):
    whole, brief = relax_recording.isel(trial=[0, 1]), relax_recording.isel(trial=[2], time=slice(0, 4000))
    with pytest.raises(ValueError, match="does not repeat"):
        common_period([ConditionTrials.prepare(brief)], 2.0)
    assert common_period(prepared_recordings([whole, brief]), 2.0) == 20.48


def test_conditions_of_several_people_are_refused(relax_recording, noisy_relax_recording):
    conditions = trials_by_condition(noisy_relax_recording)
    assert {label: trials.n_trials for label, trials in conditions.items()} == {"RT7.5": 3, "RT22.5": 3}
    assert conditions["RT22.5"].label == "RT22.5"
    mixed = relax_recording.assign_coords(subject=("trial", ["a", "b", "a", "b"]))
    with pytest.raises(ValueError, match="subject = a, b; expected one person"):
        trials_by_condition(mixed)
    with pytest.raises(ValueError, match=r"subject has several values \(a, b\)"):
        ConditionTrials.prepare(mixed).body  # noqa: B018


@pytest.mark.slow(reason="runs every estimator")
def test_estimators_take_prepared_trials_as_they_take_recordings(relax_recording):
    trials = ConditionTrials.prepare(relax_recording)
    found, expected = response(trials), response(relax_recording)
    np.testing.assert_array_equal(found.response, expected.response)
    structure = STRUCTURES["1"]
    initials = [Group.prepare(source, structure).initial for source in (trials, relax_recording)]
    np.testing.assert_array_equal(*initials)
