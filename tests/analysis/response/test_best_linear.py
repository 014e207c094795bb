"""Noise and distortion apart, against signals in which both are known."""

import numpy as np
import pytest
from foreign_recordings import Arm, Setup
from scipy import stats
from test_frequency_response import CLUSTERS, N_PERIOD, PERIOD, RATE, TRUE, labels, multisine, recorded

from armperturb.analysis.response.best_linear import best_linear
from armperturb.analysis.results import LINES
from armperturb.plots.style import new_figure
from armperturb.recording import make_recording

FREQUENCY = np.fft.rfftfreq(N_PERIOD, 1.0 / RATE)
LOAD = np.concatenate([np.zeros((1, 2, 2), complex), TRUE["arm"](FREQUENCY[1:])])
NOISE, DISTORTION = 1e-3, 3e-5
"""SD of a sample of the displacement's noise, RMS of a line of its distortion [m]."""


def known(seed, n_trials, n_periods, *, noise=NOISE, distortion=0.0, spread=0.0):
    """The load under multisines: steady, with white noise, and periodic distortion of its own in each trial.

    The force on the load is the known one, as of a manipulator that gives way to none; `spread` is the SD over trials
    of a factor on the load's admittance.
    """
    rng = np.random.default_rng(seed)
    d = np.zeros((n_trials, len(FREQUENCY), 2), complex)
    d[:, CLUSTERS] = 100.0 * np.exp(2j * np.pi * rng.random((n_trials, len(CLUSTERS), 2)))
    x = np.einsum("fij,tfj->tfi", LOAD, d) * (1 + spread * rng.normal(size=(n_trials, 1, 1)))
    own = rng.normal(size=x.shape) + 1j * rng.normal(size=x.shape)
    x += distortion * N_PERIOD / 2 * own  # a line of amplitude |2 X / N| has the mean square 2 |X / N|^2
    index = np.arange(round(n_periods * N_PERIOD))
    d, x = (np.take(np.fft.irfft(values, N_PERIOD, axis=1), index, axis=1, mode="wrap") for values in (d, x))
    x = x + noise * rng.normal(size=x.shape)
    return make_recording({"perturbation": d, "force": d, "displacement": x}, labels(n_trials), RATE)


@pytest.mark.slow(reason="repeats estimates on drawn records")
@pytest.mark.parametrize("n_periods", [1.5, 3])
def test_levels_are_those_put_in(n_periods):
    found = [best_linear(known(seed, 4, n_periods, distortion=DISTORTION), window_start=0.0) for seed in range(6)]
    # White noise of N samples has 2 sigma^2 / N at a line; complex normal lines of unit parts a mean square of 2.
    assert np.mean([one.noise for one in found]) == pytest.approx(2 * NOISE**2 / N_PERIOD, rel=0.05)
    assert np.mean([one.distortion for one in found]) == pytest.approx(DISTORTION**2, rel=0.1)
    assert min(one.p_value for one in found) < 1e-6
    response = found[0].response
    truth = TRUE["arm"](response.frequency)
    assert np.mean([one.response.covers(truth).mean() for one in found]) == pytest.approx(0.95, abs=0.04)


@pytest.mark.slow(reason="repeats estimates on drawn records")
@pytest.mark.parametrize(("n_trials", "n_periods", "spread"), [(2, 1.5, 0.0), (4, 1.5, 0.1), (2, 3, 0.1)])
def test_linear_loads_are_linear(n_trials, n_periods, spread):
    # Loads that differ between trials as well, by their constant.
    found = [best_linear(known(100 + seed, n_trials, n_periods, spread=spread), window_start=0.0) for seed in range(18)]
    statistic = np.array([one.statistic for one in found])
    assert stats.kstest(statistic, "norm").pvalue > 0.01
    inside = [np.abs(one.distortion) <= 1.96 * one.distortion_error for one in found]
    assert 0.90 <= np.mean(inside) <= 0.99
    assert np.mean([np.abs(one.share) <= 1.96 * one.share_error for one in found]) >= 0.85


@pytest.mark.slow(reason="repeats estimates on drawn records")
@pytest.mark.parametrize(("n_trials", "duration"), [(1, 32.0), (4, 32.0), (2, 2 * PERIOD)])
def test_noise_of_a_loop_is_no_distortion(n_trials, duration):
    # The loop colours the noise; periods that fade into one another leave more of it at the edges of a record.
    statistic, inside = [], []
    for seed in range(16):
        rng = np.random.default_rng([seed, 5])
        recording = recorded(multisine(rng, n_trials, duration), rng, own=0.3, instruments=1.0)
        found = best_linear(recording, window_start=0.0)
        statistic.append(found.statistic)
        inside.append(np.abs(found.distortion) <= 1.96 * found.distortion_error)
    assert stats.kstest(statistic, "norm").pvalue > 0.01
    assert 0.90 <= np.mean(inside) <= 0.99


@pytest.mark.parametrize(("n_trials", "duration"), [(1, 32.0), (2, 32.0), (3, 3 * PERIOD), (4, 2 * PERIOD + 2.0)])
@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.1])
def test_nearly_without_noise_a_linear_load_is_linear(n_trials, duration, noise):
    rng = np.random.default_rng(6)
    found = best_linear(recorded(multisine(rng, n_trials, duration), rng, instruments=noise))
    assert abs(found.statistic) < 1.96
    assert np.mean(np.abs(found.distortion) <= 1.96 * found.distortion_error) > 0.85
    assert np.all(np.abs(found.share) < 1e-5)


@pytest.mark.slow(reason="simulates foreign arms")
@pytest.mark.parametrize("n_trials", [3, 4])
def test_a_linear_arm_that_holds_the_handle_firmly_is_linear(n_trials):
    """Its stiff grip bends the response within a cluster."""
    arm = Arm(grip=(5000.0, 50.0))
    setups = [Setup(arm=arm, n_trials=n_trials, duration=40.0, linear=True, seed=seed) for seed in range(3, 6)]
    assert min(best_linear(setup.recording()).p_value for setup in setups) > 0.01


@pytest.mark.slow(reason="repeats estimates on drawn records")
def test_one_realisation_tells_distortion_from_noise():
    found = [best_linear(known(seed, 1, 3, distortion=2 * DISTORTION), window_start=0.0) for seed in range(8)]
    assert np.mean([one.noise for one in found]) == pytest.approx(2 * NOISE**2 / N_PERIOD, rel=0.1)
    assert np.mean([one.distortion for one in found]) == pytest.approx(4 * DISTORTION**2, rel=0.3)
    linear = [best_linear(known(seed, 1, 3), window_start=0.0) for seed in range(20)]
    assert stats.kstest([one.statistic for one in linear], "norm").pvalue > 0.01


def test_linear_power_is_that_of_the_load():
    found = best_linear(known(1, 4, 3), window_start=0.0)
    lines = CLUSTERS.reshape(-1, 4)
    gain = np.sum(np.abs(TRUE["arm"](lines.ravel() / PERIOD)) ** 2, axis=2).reshape(*lines.shape, 2).mean(axis=1)
    # Mean over phases of 2 |H D / N|^2 with |D| = 100 on both axes.
    expected = 2 * (100.0 / N_PERIOD) ** 2 * gain
    assert found.linear.sum(axis=0) == pytest.approx(expected.sum(axis=0), rel=0.25)
    assert found.n_periods == pytest.approx(3.0)


def test_bad_input_is_refused():
    recording = known(1, 2, 1.5)
    with pytest.raises(ValueError, match=r"trials hold 1\.10 periods from 8\.192 s on; expected at least 1\.20"):
        best_linear(recording, window_start=0.4 * PERIOD)
    with pytest.raises(ValueError, match="a group has 2 excited lines; expected at least 3"):
        best_linear(recording, lines_per_average=2)


def test_figures_show_what_was_found():
    found = best_linear(known(1, 2, 1.5), window_start=0.0)
    axes = found.response.plot(figure=new_figure(1.0))
    gain, phase = axes[0, 0]
    bands = found.response.bands()
    shown = gain.collections[0].get_paths()[0].vertices
    assert shown[:, 1].max() == pytest.approx(bands.gain_high[:, 0, 0].max())
    turn = phase.collections[0].get_paths()[0].vertices[:, 1]
    assert np.ptp(turn) > 90.0  # from spring to mass
    assert axes.shape == (2, 2, 2)
    np.testing.assert_array_equal(gain.get_lines()[0].get_ydata(), np.abs(found.response.response[:, 0, 0]))
    lines = {line.get_label(): line.get_ydata() for line in found.plot(figure=new_figure(1.0))[0].get_lines()}
    np.testing.assert_allclose(lines["noise"], 1e3 * np.sqrt(found.noise[:, 0]))


def test_results_read_as_tables():
    found = best_linear(known(1, 2, 1.5), window_start=0.0)
    for result in (found, found.response):
        assert len(repr(result).splitlines()) <= LINES
        assert result.describe().title in result.summary()
        assert result._repr_html_().count("<tr>") == len(found.response.frequency) + 1
    assert f"p = {found.p_value:.2g} if the arm is linear" in found.summary()
    assert "2 trials" in repr(found)
    data, response = found.to_xarray(), found.response
    assert data["response"].dims == ("frequency", "output", "input")
    assert data["linear"].attrs == {"units": "m^2"}
    np.testing.assert_array_equal(data["response"], response.response)
    np.testing.assert_array_equal(data["covariance"].sel(output="y", input="x"), response.covariance[:, 1, 0])
    np.testing.assert_array_equal(data["distortion"], found.distortion)
    table = response.to_frame().set_index(["frequency_hz", "output", "input"])
    at = (response.frequency[3], "y", "x")
    assert complex(table.loc[at, "real"], table.loc[at, "imag"]) == response.response[3, 1, 0]
    assert table.loc[at, "radius_95"] == response.radius()[3, 1, 0]
    levels = found.to_frame()
    assert levels["noise_m2"].tolist() == found.noise.ravel().tolist()
    assert levels["output"].tolist()[:2] == ["x", "y"]
