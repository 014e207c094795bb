"""Multisines whose period fits into a trial many times: each line tells the response, and none lies between."""

import numpy as np
import pytest

from armperturb.analysis.fit.identify import identify
from armperturb.analysis.response.best_linear import best_linear
from armperturb.analysis.response.estimate import response
from armperturb.recording import make_recording

RATE, PERIOD = 100.0, 2.0


def load(frequency):
    """Impedance of a load that resonates with the manipulator near 3 Hz [N/m], (frequency, 2, 2)."""
    s = 2j * np.pi * np.asarray(frequency)[:, None, None]
    mass, damping = np.array([[1.0, 0.2], [0.2, 0.8]]), np.array([[6.0, 1.0], [1.0, 5.0]])
    return mass * s**2 + damping * s + np.array([[700.0, 150.0], [150.0, 500.0]])


def recorded(seed, lines, n_trials=4, seconds=16.0):
    """Trials amid the movement; the load's own force is random and repeats as little as the instruments' noise.

    Args:
      seed: of phases and noise.
      lines: that are excited along x and along y [Hz].
      n_trials: with other phases each.
      seconds: that each lasts.
    """
    rng, n = np.random.default_rng(seed), round((seconds + 8.0) * RATE)
    frequency, kept = np.fft.rfftfreq(n, 1.0 / RATE), slice(round(8.0 * RATE), None)
    s = 2j * np.pi * frequency
    environment = (2.0 * s**2 + 8.0 * s + 100.0)[:, None, None] * np.eye(2)
    impedance, time = load(frequency), np.arange(n)[:, None] / RATE
    signals = {
        name: np.empty((n_trials, round(seconds * RATE), 2)) for name in ("perturbation", "force", "displacement")
    }
    for trial in range(n_trials):
        phases = [rng.uniform(0.0, 2.0 * np.pi, len(mine)) for mine in lines]
        waves = [np.cos(2.0 * np.pi * time * mine + phase) for mine, phase in zip(lines, phases, strict=True)]
        d = np.stack([wave.sum(axis=1) for wave in waves], axis=1)
        push = np.fft.rfft(0.3 * rng.standard_normal((n, 2)), axis=0)
        whole = np.fft.rfft(d, axis=0)
        x = np.linalg.solve(environment + impedance, (whole + push)[:, :, None])
        f = whole - np.einsum("fij,fj->fi", environment, x[:, :, 0])
        signals["perturbation"][trial] = d[kept]
        signals["force"][trial] = np.fft.irfft(f, n, axis=0)[kept] + 0.01 * rng.standard_normal(d[kept].shape)
        path = np.fft.irfft(x[:, :, 0], n, axis=0)[kept]
        signals["displacement"][trial] = path + 1e-5 * rng.standard_normal(path.shape)
    fixed = {"subject": "load", "task": "PT", "condition": "A", "repetition": 0, "pulse_level": 0.0}
    fixed |= {"l_h": 0.3, "l_f": 0.3, "theta_s_deg": 22.5, "theta_e_deg": 82.3}
    fixed |= dict.fromkeys(("pulse_direction", "pulse_onset", "limit_time"), np.nan)
    labels = {name: [value] * n_trials for name, value in fixed.items()}
    return make_recording(signals, labels, RATE)


ALL = np.arange(1, 2 * 20) / PERIOD


@pytest.mark.parametrize(("gap", "n_trials"), [(1, 4), (2, 4), (1, 8)])
def test_every_point_lies_near_its_lines_and_circles_hold(gap, n_trials):
    """Of forty lines, 0.5 Hz apart; of twenty."""
    held = []
    for seed in range(6):
        found = response(recorded(seed, (ALL[::gap], ALL[::gap]), n_trials), "multisine")
        assert len(found.frequency) >= 12
        assert not found.remarks
        held.append(found.covers(np.linalg.inv(load(found.frequency))).mean())
    assert np.mean(held) > 0.91


def test_lines_of_one_axis_each_are_pooled_and_that_is_said():
    found = response(recorded(0, (ALL[::2], ALL[1::2])), "multisine")
    assert len(found.frequency) < 12
    assert "lines of the perturbation are 0.5 Hz apart, and single ones do not tell" in found.remarks[-1]
    truth = np.linalg.inv(load(found.frequency))
    far = found.frequency > 6.0
    assert np.abs(found.response - truth)[far].max() < 0.1 * np.abs(truth)[far].max()


def test_a_short_trial_is_left_out_and_costs_no_points():
    long, short = recorded(0, (ALL, ALL)), recorded(1, (ALL, ALL), n_trials=1, seconds=4.5)
    alone, both = response(long, "multisine"), response([long, short], "multisine")
    np.testing.assert_array_equal(both.response, alone.response)
    assert "1 of 5 trials hold fewer than 4 periods of 2 s, and are left out" in both.remarks[-1]


def test_short_trials_are_used_where_the_others_do_not_tell_x_from_y():
    held = []
    for seed in range(6):
        parts = [recorded(10 * seed, (ALL, ALL), 1, 50.0), recorded(10 * seed + 1, (ALL, ALL), 2, 9.0)]
        found = response(parts, "multisine")
        assert len(found.frequency) >= 12
        assert not found.remarks
        held.append(found.covers(np.linalg.inv(load(found.frequency))).mean())
    assert np.mean(held) > 0.91


def test_lines_that_push_in_one_direction_alone_tell_no_response():
    """Each stands alone, so that noise of the perturbation would pass for a push along the other axis."""
    lines = np.unique(np.round(np.geomspace(0.3 * 20.0, 20.0 * 20.0, 30))) / 20.0
    recording = recorded(0, (lines[::2], lines[1::2]), seconds=45.0)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(recording["perturbation"].shape)
    for given in (recording, recording.assign(perturbation=recording["perturbation"] + noise)):
        with pytest.raises(ValueError, match=r"x and y are not independent at .* or the method arx"):
            response(given, "multisine")
    assert identify(recording, "1").fit.converged  # which needs no response


def test_lines_far_apart_tell_no_distortion():
    """A linear response that bends between them would pass for it."""
    with pytest.raises(ValueError, match=r"are 4\.5 Hz apart near 2\.75 Hz; expected at most 1\.25 Hz"):
        best_linear(recorded(0, (ALL[::3], ALL[::3])))


def test_a_single_trial_is_said_to_tell_little_of_distortion():
    lines = np.arange(2, 400) / 20.0
    assert "of a single trial, an arm whose response bends" in distortion_of(lines, 1).describe().remarks[-1]
    several = distortion_of(lines, 3)
    assert not several.describe().remarks
    assert several.p_value > 0.01
    with pytest.raises(ValueError, match=r"expected at most 1\.25 Hz, over which a linear response hardly bends"):
        distortion_of(np.arange(1, 100) / 5.0, 1)


def distortion_of(lines, n_trials):
    return best_linear(recorded(0, (lines, lines), n_trials=n_trials, seconds=30.0))
