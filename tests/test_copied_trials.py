"""Copies of trials are recognised, and nothing else is."""

import numpy as np
import pytest
import xarray as xr

from armperturb.copied_trials import without_copies
from armperturb.recording import make_recording


@pytest.fixture(scope="module")
def recording():
    """Two trials of a condition and two of another, under the same perturbation and with small noise each."""
    rng = np.random.default_rng(0)
    shared = rng.normal(size=(400, 2))
    signals = {
        name: scale * (shared + 1e-3 * rng.normal(size=(4, 400, 2)))
        for name, scale in (("perturbation", 1.0), ("force", 5.0), ("displacement", 0.01))
    }
    labels = {"subject": ["A"] * 4, "task": ["PT"] * 4, "condition": ["PT", "PT", "other", "other"]}
    labels |= {"repetition": [0, 1, 0, 1], "pulse_level": [0.0] * 4}
    names = ("pulse_direction", "pulse_onset", "l_h", "l_f", "theta_s_deg", "theta_e_deg", "limit_time")
    return make_recording(signals, labels | {name: [np.nan] * 4 for name in names}, 100.0)


def left_out(recording):
    return without_copies(recording).remarks


def test_the_first_of_its_like_counts(recording):
    copied = recording.isel(trial=[1, 0, 1, 2, 1])
    each_once = without_copies(copied)
    assert each_once.remarks == tuple(f"trial {copy} repeats trial 0 and is left out" for copy in (2, 4))
    assert each_once.numbers.tolist() == [0, 1, 3]
    xr.testing.assert_identical(each_once.recording, copied.isel(trial=[0, 1, 3]))
    assert set(each_once.copies) == {"PT"}


def test_rounding_makes_no_other_trial(recording):
    rounded = recording.isel(trial=[0, 0]).copy(deep=True)
    rounded["displacement"].values[1] += 1e-7
    rounded["force"].values[1] = np.float32(rounded["force"].values[1])
    assert len(left_out(rounded)) == 1


def test_other_noise_and_other_conditions_are_no_copies(recording):
    assert without_copies(recording).recording is recording
    conditions = ("condition", recording["condition"].dims, ["PT", "rest"])[1:]
    assert not left_out(recording.isel(trial=[0, 0]).assign_coords(condition=conditions))


@pytest.mark.parametrize("still", [0.0, 0.02])
def test_trials_in_which_nothing_moves_are_no_copies(recording, still):
    rest = recording.isel(trial=[0, 0]).copy(deep=True)
    rest["displacement"].values[:] = still
    assert not left_out(rest)


def test_many_trials_take_no_time(recording, monkeypatch):
    many = recording.isel(trial=np.arange(200) % 4).copy(deep=True)
    many["displacement"].values[:] += 1e-4 * np.random.default_rng(1).normal(size=many["displacement"].shape)
    compared = []
    monkeypatch.setattr("armperturb.copied_trials._is_copy", lambda *trials: compared.append(trials))
    assert not left_out(many)
    assert len(compared) < 4
