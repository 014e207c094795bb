"""Spectral estimates against systems that are known."""

import numpy as np
import pytest

from armperturb.analysis.response.spectra import LineSpectra, estimate_spectra, excited_lines, line_spectra
from armperturb.recording import make_recording

RATE, PERIOD, START = 200.0, 5.12, 2.0
N_PERIOD = round(RATE * PERIOD)
LINES = np.concatenate([np.arange(first, first + 4) for first in (3, 20, 60, 150)])


def random_matrices(rng, n):
    """Well-conditioned complex 2 x 2 matrices, (n, 2, 2)."""
    return rng.normal(size=(n, 2, 2)) + 1j * rng.normal(size=(n, 2, 2)) + 3 * np.eye(2)


def synthetic(n_trials, seed=0, *, constant=False, noise=0.0, directions=None, n_periods=1):
    """A recording of a loop with known arm H and environment E, and these at the lines.

    Not a real system: H and E are drawn anew per line (or once, where constant), so that a lost transpose or a wrong
    line shows.
    """
    rng = np.random.default_rng(seed)
    arm, environment = (random_matrices(rng, 1 if constant else len(LINES)) for _ in range(2))
    arm, environment = (np.broadcast_to(m, (len(LINES), 2, 2)) for m in (arm, environment))
    total = np.linalg.inv(np.linalg.inv(environment) + np.linalg.inv(arm))
    d = np.exp(2j * np.pi * rng.random((n_trials, len(LINES), 2)))
    if directions is not None:
        d = d[..., :1] * np.asarray(directions)[:, None, :]
    x = np.einsum("lij,tlj->tli", total, d)
    f = np.einsum("lij,tlj->tli", np.linalg.inv(arm), x)

    def in_time(lines):
        spectrum = np.zeros((n_trials, N_PERIOD // 2 + 1, 2), complex)
        spectrum[:, LINES] = lines
        period = np.fft.irfft(spectrum, N_PERIOD, axis=1)
        # The window starts in the middle of a period of length N_PERIOD: only relative phase matters.
        n_time = round(START * RATE) + n_periods * N_PERIOD
        return np.take(period, np.arange(n_time) - round(START * RATE), axis=1, mode="wrap")

    signals = {"perturbation": in_time(d), "force": in_time(f), "displacement": in_time(x)}
    if noise:
        for name in ("force", "displacement"):
            signals[name] = signals[name] + noise * rng.normal(size=signals[name].shape)
    return make_recording(signals, labels(n_trials), RATE), arm, environment, total


def labels(n_trials):
    fixed = {"repetition": 0, "pulse_level": 0.0, "l_h": 0.3, "l_f": 0.3, "theta_s_deg": 22.5, "theta_e_deg": 82.3}
    text = {"subject": "S", "task": "PT", "condition": "PT"}
    empty = dict.fromkeys(("pulse_direction", "pulse_onset", "limit_time"), np.nan)
    return {name: [value] * n_trials for name, value in {**fixed, **text, **empty}.items()}


def estimate(recording, lines_per_average=4, start=START, period=PERIOD):
    lines = line_spectra(recording, window_start=start, period=period)
    return estimate_spectra(lines, lines_per_average=lines_per_average)


def test_every_line_of_several_trials_is_exact():
    recording, arm, environment, total = synthetic(3)
    spectra = estimate(recording, 1)
    np.testing.assert_allclose(spectra.frequency, LINES / PERIOD)
    np.testing.assert_allclose(spectra.arm, arm, rtol=1e-9)
    np.testing.assert_allclose(spectra.environment, environment, rtol=1e-9)
    np.testing.assert_allclose(spectra.total, total, rtol=1e-9)
    np.testing.assert_allclose(spectra.coherence, 1.0, rtol=1e-9)
    assert (spectra.n_averages == 3).all()


def test_one_trial_is_averaged_over_clusters():
    recording, arm, environment, total = synthetic(1, constant=True)
    spectra = estimate(recording)
    np.testing.assert_allclose(spectra.frequency, LINES.reshape(4, 4).mean(axis=1) / PERIOD)
    for found, known in ((spectra.arm, arm), (spectra.environment, environment), (spectra.total, total)):
        np.testing.assert_allclose(found, known[:4], rtol=1e-9)
    assert (spectra.n_averages == 4).all()


def test_one_direction_per_trial_is_enough():
    recording, arm, _, _ = synthetic(2, directions=[(1, 0), (0, 1)])
    with pytest.warns(RuntimeWarning, match="as many averages as inputs"):
        spectra = estimate(recording, 1)
    np.testing.assert_allclose(spectra.arm, arm, rtol=1e-9)


def test_average_is_taken_on_spectra_not_on_gains():
    recording, *_ = synthetic(5, noise=0.05)
    spectra = estimate(recording)
    gains = [estimate(recording.isel(trial=[i])).arm for i in range(5)]
    assert not np.allclose(spectra.arm, np.mean(gains, axis=0), rtol=1e-3)
    d, f, x = (
        np.fft.rfft(recording[name].values[:, -N_PERIOD:], axis=1)[:, LINES[:4]]
        for name in ("perturbation", "force", "displacement")
    )
    # Eq. A.14 spelled out: sums over lines and trials of conj(D_i) X_j.
    phi_dx, phi_df = (
        sum(np.outer(a.conj(), b) for a, b in zip(d.reshape(-1, 2), y.reshape(-1, 2), strict=True)) for y in (x, f)
    )
    np.testing.assert_allclose(spectra.arm[0], phi_dx.T @ np.linalg.inv(phi_df).T, rtol=1e-9)


def test_coherence_is_the_share_that_regression_explains():
    recording, *_ = synthetic(6, noise=0.03)
    spectra = estimate(recording)
    d, x = (
        np.fft.rfft(recording[name].values[:, -N_PERIOD:], axis=1)[:, LINES[8:12]].reshape(-1, 2)
        for name in ("perturbation", "displacement")
    )
    fitted = d @ np.linalg.lstsq(d, x, rcond=None)[0]
    explained = np.sum(np.abs(fitted) ** 2, axis=0) / np.sum(np.abs(x) ** 2, axis=0)
    np.testing.assert_allclose(spectra.coherence[2], explained, rtol=1e-9)
    assert (explained < 0.999).all()


@pytest.mark.slow(reason="repeats estimates on drawn records")
@pytest.mark.parametrize("n_trials", [1, 4])
def test_coherence_of_pure_noise_is_inputs_over_averages(n_trials):
    values = []
    for seed in range(60):
        recording, *_ = synthetic(n_trials, seed)
        rng = np.random.default_rng(1000 + seed)
        noise = rng.normal(size=recording["displacement"].shape)
        values.append(estimate(recording.assign(displacement=recording["displacement"] * 0 + noise)).coherence)
    # 2 inputs over 4 lines per trial; the mean of 480 values scatters by about 0.01.
    assert np.mean(values) == pytest.approx(2 / (4 * n_trials), abs=0.04)


def test_whole_periods_are_averaged_in_time():
    recording, arm, _, _ = synthetic(4, noise=0.02, n_periods=1)
    longer, same_arm, _, _ = synthetic(4, noise=0.02, n_periods=16)
    np.testing.assert_array_equal(arm, same_arm)
    short_error, long_error = (np.abs(estimate(r, 1).arm - arm).mean() for r in (recording, longer))
    assert long_error < 0.5 * short_error  # a quarter is expected
    assert (estimate(longer, 1).n_averages == 4).all()


def test_window_ends_at_the_pulse():
    recording, arm, _, _ = synthetic(3, n_periods=2)
    onset = START + PERIOD
    recording["pulse_onset"][:] = onset
    recording["force"][:, round(onset * RATE) :] += 1.0
    np.testing.assert_allclose(estimate(recording, 1).arm, arm, rtol=1e-9)


def test_a_disturbance_that_is_weak_along_an_axis_counts():
    recording, *_ = synthetic(3)
    weak = recording.copy(deep=True)
    weak["perturbation"][..., 0] *= 1e-4
    np.testing.assert_allclose(estimate(weak).arm, estimate(recording).arm, rtol=1e-6)
    weak["perturbation"][..., 1] = 1e4 * weak["perturbation"][..., 0]
    with pytest.raises(ValueError, match="are not independent"):
        estimate(weak)


def test_runs_of_lines_are_cut_into_groups():
    recording, *_ = synthetic(2)
    assert len(estimate(recording, 3).frequency) == 4
    assert len(estimate(recording, 2).frequency) == 8


def hit(recording):
    recording["limit_time"][1] = 3.5
    return recording


@pytest.mark.parametrize(
    ("recording", "options", "message"),
    [
        (synthetic(1)[0], {"lines_per_average": 1}, r"1 average at 0.586 Hz for 2 inputs; expected at least 2"),
        (synthetic(3, directions=[(1, 0)] * 3)[0], {}, r"along y has no power at .* Hz; expected .* both axes"),
        (synthetic(3, directions=[(1, 2)] * 3)[0], {}, r"are not independent at .* Hz; expected independent"),
        (hit(synthetic(3)[0]), {}, r"trial 1 reached the workspace limit at 3.500 s"),
        (synthetic(3)[0], {"start": 3.0}, r"holds 7.12 s before .*; expected a whole period of 5.12 s from 3 s on"),
        (synthetic(3)[0], {"period": 5.1234}, r"rate = 200 Hz; expected one at which the period of 5.1234 s"),
        (synthetic(3)[0], {"start": float("nan")}, r"start = nan; expected a finite number at least 0"),
        (synthetic(3)[0], {"period": float("inf")}, r"period = inf; expected a finite number above 0"),
        (synthetic(3)[0], {"lines_per_average": 0}, r"lines_per_average = 0; expected a whole number of at least 1"),
        (synthetic(3)[0].drop_vars("force"), {}, r"variable 'force' is missing"),
    ],
)
def test_bad_input_is_named(recording, options, message):
    with pytest.raises(ValueError, match=message):
        estimate(recording, **options)


@pytest.mark.parametrize("name", ["force", "displacement"])
def test_a_silent_channel_is_named(name):
    recording, *_ = synthetic(2)
    with pytest.raises(ValueError, match=f"{name} is constant from 2 s on"):
        estimate(recording.assign({name: recording[name] * 0}))


def test_a_silent_perturbation_is_named():
    recording, *_ = synthetic(2)
    with pytest.raises(ValueError, match="perturbation is zero from 2 s on"):
        estimate(recording.assign(perturbation=recording["perturbation"] * 0))


def test_every_second_line_is_adjacent_to_the_next():
    """A multisine of odd lines is averaged as one of all lines is."""
    generator = np.random.default_rng(0)
    names = ("perturbation", "force", "displacement")
    signals = {name: generator.standard_normal((2, 12, 4)).view(complex) for name in names}
    every, odd = (
        LineSpectra(line=step * np.arange(1, 13), frequency=step / 20 * np.arange(1, 13), **signals) for step in (1, 2)
    )
    for n, n_points in ((4, 3), (6, 2), (12, 1)):
        assert len(estimate_spectra(odd, lines_per_average=n).frequency) == n_points
        assert estimate_spectra(odd, lines_per_average=n).total == pytest.approx(
            estimate_spectra(every, lines_per_average=n).total
        )


def test_what_is_faint_beside_other_lines_is_no_line():
    power = np.full((400, 2), [3e-4, 3e-6])  # what a fade leaves; y is driven with a tenth of the amplitude
    lines = np.array([3, 5, 8, 13, 21, 34, 55, 89, 144, 233])
    power[lines] = np.where(lines < 50, 1.0, 0.15)[:, None] * [1.0, 0.01]
    power[0] = 0.0
    found = excited_lines(power)
    np.testing.assert_array_equal(found[found < 300], lines)  # beyond, nothing else is near
    falling = 1.0 / np.maximum(np.arange(400.0), 1.0) ** 2
    falling[0] = 0.0
    np.testing.assert_array_equal(excited_lines(falling[:, None]), np.arange(1, 100))  # a hundredth of the amplitude


def test_lines_that_are_far_apart_are_averaged_over_trials_alone():
    generator = np.random.default_rng(0)
    for n_trials, n_lines in ((1, 4), (2, 2), (4, 1), (6, 1)):
        signals = {
            name: generator.standard_normal((n_trials, 12, 4)).view(complex)
            for name in ("perturbation", "force", "displacement")
        }
        lines = LineSpectra(line=np.arange(1, 13), frequency=0.5 * np.arange(1, 13), **signals)
        assert (estimate_spectra(lines).n_averages == n_trials * n_lines).all()
        assert (estimate_spectra(lines, lines_per_average=6).n_averages == n_trials * 6).all()


def test_lines_of_one_axis_each_count_though_one_axis_is_weak():
    power = np.zeros((200, 2))
    power[1::2, 0], power[2::2, 1] = 1.0, 0.005
    np.testing.assert_array_equal(excited_lines(power), np.arange(1, 200))


def test_trials_of_one_realisation_are_averaged_over_lines_however_far_apart():
    generator = np.random.default_rng(0)
    signals = {
        name: np.repeat(generator.standard_normal((1, 12, 4)).view(complex), 6, axis=0)
        for name in ("perturbation", "force", "displacement")
    }
    lines = LineSpectra(line=np.arange(1, 13), frequency=0.5 * np.arange(1, 13), **signals)
    assert (estimate_spectra(lines).n_averages == 24).all()


def test_a_rest_of_lines_moves_no_point_at_low_frequencies():
    generator = np.random.default_rng(0)
    signals = {
        name: generator.standard_normal((2, 15, 4)).view(complex) for name in ("perturbation", "force", "displacement")
    }
    points = [
        estimate_spectra(
            LineSpectra(
                line=np.arange(1, n + 1),
                frequency=0.1 * np.arange(1, n + 1),
                **{name: each[:, :n] for name, each in signals.items()},
            )
        ).frequency
        for n in (12, 13, 14)
    ]
    for each in points:
        np.testing.assert_allclose(each[0], 0.25)
        assert len(each) == 3


def test_estimates_are_interpolated_along_the_logarithm():
    recording, *_ = synthetic(4)
    spectra = estimate(recording)
    same = spectra.interpolated(spectra.frequency)
    np.testing.assert_allclose(same.arm, spectra.arm)
    np.testing.assert_array_equal(same.n_averages, spectra.n_averages)
    between = spectra.interpolated(np.sqrt(spectra.frequency[1:] * spectra.frequency[:-1]))
    np.testing.assert_allclose(np.abs(between.arm), np.sqrt(np.abs(spectra.arm[1:] * spectra.arm[:-1])))
    np.testing.assert_allclose(between.coherence, (spectra.coherence[1:] + spectra.coherence[:-1]) / 2.0)
