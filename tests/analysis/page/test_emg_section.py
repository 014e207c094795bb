"""The section EMG of the page: what it shows, and why it leaves something out."""

import numpy as np
from invented_emg import noise, recorded

from armperturb.analysis.emg.envelope import envelopes
from armperturb.analysis.page.emg import emg_section
from armperturb.analysis.trials import trials_by_condition

REASONS = (
    "no rotation of shoulder and elbow",
    "last at most 0.1 s before the pulse",
    "(1 x 6 s before the pulse) have 3.1 independent lines",
    "the latest pulse of early comes after 0.1 s",
)


def test_what_is_left_out_is_said_with_its_reason():
    """Also where the reason is another one than the length of the trials."""
    conditions = ["still", "early", "still"]
    recording = recorded(noise((3, 2, 28_000)), conditions, pulse_onset=[np.nan, 0.1, np.nan])
    still, early = trials_by_condition(recording).values()
    trials = {"still": [still], "early": [early], "one": [still.take([0])]}
    shown = emg_section(envelopes(recording), trials, {})
    assert not shown.conditions
    assert not shown.has_pulses
    for line, reason in zip(shown.left_out, REASONS, strict=True):
        assert line.startswith("Not shown: ")
        assert reason in line


def test_rest_is_no_test_of_relaxation():
    """Its noise is what amplitudes are measured from, whatever its task is called."""
    volts = np.array([0.3, 1.0, 0.0])[:, None, None] * noise((3, 2, 20_000)) + 1e-3 * noise((3, 2, 20_000), 1)
    recording = recorded(volts, ["PT", "MVC", "REST"], task=["PT", "PT", "RT"])
    assert not emg_section(envelopes(recording), {}, {}).sentence
    assert emg_section(envelopes(recorded(volts, ["RT", "MVC", "REST"])), {}, {}).sentence
