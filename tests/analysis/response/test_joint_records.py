"""Rates of records: one rule for fits and for frequency responses."""

from types import SimpleNamespace

import numpy as np
import pytest

from armperturb.analysis.response.joint_records import resampled
from armperturb.analysis.response.record_window import RecordWindow
from armperturb.analysis.trials import TrialRecord


@pytest.mark.parametrize(
    ("rate", "left"),
    [
        (50.0, 50.0), (200.0, 200.0), (250.0, 250.0), (300.0, 300.0), (301.0, 150.5), (400.0, 200.0), (500.0, 250.0),
        (700.0, 700.0 / 3), (960.0, 192.0), (1000.0, 200.0), (1500.0, 1500.0 / 7), (2000.0, 200.0), (2048.0, 204.8),
    ],
)  # fmt: skip
def test_fits_and_responses_keep_the_same_samples(rate, left):
    record = TrialRecord(np.zeros((600, 2)), np.zeros((600, 4)), rate)
    trials = SimpleNamespace(first_onset=600, n_samples=600, rate=rate, from_rest=True)
    assert resampled(record).rate == pytest.approx(left)
    assert rate / RecordWindow.of(trials).factor == pytest.approx(left)
