"""Which trials a nonlinear fit takes, and up to when."""

import numpy as np
import pytest

from armperturb.analysis.nonlinear.trials import cut_remarks, fitted_conditions, training_sets
from armperturb.analysis.trials import ConditionTrials
from armperturb.recording import make_recording

RATE, DURATION = 100.0, 16.0


def pulsed(*onsets, still=()):
    """Trials of one condition, with noise before a pulse at these times [s]; some have nothing before it."""
    n, n_time = len(onsets), round(RATE * DURATION)
    rng = np.random.default_rng(0)
    force = rng.standard_normal((n, n_time, 2))
    force[list(still)] = 0.0
    for trial, onset in enumerate(onsets):
        if np.isfinite(onset):
            force[trial, round(onset * RATE) : round(onset * RATE) + 8] = 20.0
    has_pulse = np.isfinite(onsets)
    labels = {
        **{"subject": ["A"] * n, "task": ["RT"] * n, "condition": ["RT7.5"] * n, "repetition": list(range(n))},
        **{"pulse_level": has_pulse.astype(float), "pulse_direction": np.where(has_pulse, 20.0, np.nan)},
        **{"pulse_onset": onsets, "limit_time": [np.nan] * n, "l_h": [0.33] * n, "l_f": [0.34] * n},
        **{"theta_s_deg": [22.5] * n, "theta_e_deg": [82.3] * n},
    }
    signals = {"perturbation": force, "force": 0.1 * force, "displacement": 1e-3 * force}
    return {"RT7.5": ConditionTrials.prepare(make_recording(signals, labels, RATE))}


@pytest.mark.parametrize(
    ("onsets", "numbers", "seconds", "remarks"),
    [
        ((12.0, 12.0, 12.0, 12.0), [0, 1, 2, 3], 12.0, []),
        ((12.0, 12.0, 12.0, 3.0), [0, 1, 2], 12.0, ["RT7.5: 1 of 4 trials is not fitted, as its pulse begins at 3 s"]),
        (
            (12.0, 10.5, 9.0, 2.0),
            [0, 1, 2],
            9.0,
            [
                "RT7.5: 1 of 4 trials is not fitted, as its pulse begins at 2 s",
                "RT7.5: 2 of 4 trials are fitted up to 9 s only, where the first pulse of the others begins",
            ],
        ),
        (
            (12.0, 3.0, 2.0),
            [0],
            12.0,
            ["RT7.5: 2 of 3 trials are not fitted, as their pulses begin at 3 s or earlier"],
        ),
    ],
)
def test_an_early_pulse_costs_its_own_trial_and_no_other(onsets, numbers, seconds, remarks):
    conditions = pulsed(*onsets)
    (fitted,), (left_out,) = training_sets(conditions)
    assert fitted.numbers.tolist() == numbers
    assert fitted.end == round(seconds * RATE)
    assert left_out.n_trials == len(onsets)  # all pulses are predicted
    assert cut_remarks(conditions, [fitted]) == remarks


def test_a_trial_with_a_pulse_alone_costs_no_other():
    conditions = pulsed(12.0, 5.0, 12.0, still=[1])
    (fitted,), _ = training_sets(conditions)
    assert fitted.numbers.tolist() == [0, 2]
    assert fitted.end == round(12.0 * RATE)
    assert cut_remarks(conditions, [fitted]) == []


def test_trials_without_enough_before_the_pulse_are_named():
    conditions = pulsed(4.0, 3.0)
    fitted, left_out = training_sets(conditions)
    assert fitted == []
    assert len(left_out) == 1
    assert cut_remarks(conditions, fitted) == [
        "RT7.5: 2 of 2 trials are not fitted, as their pulses begin at 4 s or earlier"
    ]


def test_what_lasts_to_its_end_is_not_cut_by_the_pulses_of_others():
    conditions = pulsed(np.nan, 12.0)
    fitted, _ = training_sets(conditions)
    whole, before = fitted
    assert (whole.numbers.tolist(), before.numbers.tolist()) == ([0], [1])
    assert whole.end > before.end == round(12.0 * RATE)
    assert cut_remarks(conditions, fitted) == []


def test_pulses_alone_are_fitted_whole():
    recording = pulsed(3.0, 4.0, 5.0, still=[0, 1, 2])["RT7.5"].recording
    (fitted,), left_out = training_sets(fitted_conditions(recording))
    assert fitted.numbers.tolist() == [0, 1, 2]
    assert fitted.end > 5.0 * RATE
    assert left_out == []


def test_a_trial_of_rest_beside_pulses_alone_is_named():
    recording = pulsed(3.0, np.nan, still=[0, 1])["RT7.5"].recording
    with pytest.raises(ValueError, match=r"nothing perturbs a trial of RT7\.5 before its pulse, and not all have one"):
        fitted_conditions(recording)
