from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from armperturb import POSITION, Environment, Instruments, Multisine, Trial, arm_admittance, run_experiment
from armperturb.analysis.arm.linear_arm import environment_admittance, total_admittance
from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.response import arx
from armperturb.analysis.response.arx import Regression, fit_arx
from armperturb.analysis.response.estimate import METHODS, response
from armperturb.analysis.response.joint_records import admittance_of, excited_frequencies, joint_records, variance_of
from armperturb.analysis.response.spectra import estimate_spectra, line_spectra
from armperturb.analysis.response.subspace import fit_subspace
from armperturb.analysis.trials import TrialRecord
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.recording import make_recording

ENVIRONMENT = Environment()
MASS = np.array([[1.6, 0.3], [0.3, 1.1]])
DAMPING = np.array([[25.0, -4.0], [-4.0, 15.0]])
STIFFNESS = np.array([[450.0, 80.0], [80.0, 250.0]])
BELOW_20 = np.geomspace(0.3, 20.0, 15)


def load_admittance(frequency):
    s = 2j * np.pi * frequency[:, None, None]
    return np.linalg.inv(MASS * s**2 + DAMPING * s + STIFFNESS)


def multisines(n_trials, duration, rate):
    drawn = [Multisine.draw(seed=seed, rms=5.0, duration=duration, crested=False) for seed in range(n_trials)]
    return np.array([one.sample(rate, round(duration * rate)) for one in drawn])


def coloured_noise(n_trials, duration, rate):
    """Much of it is above half the rate to which records at 1 kHz are brought."""
    white = np.random.default_rng(0).normal(size=(n_trials, round(duration * rate), 2))
    return 5.0 * signal.sosfilt(signal.butter(4, 250.0, fs=rate, output="sos"), white, axis=1)


def recording_of(d, f, x, rate, onset=np.nan, hit=np.nan):
    trials = {
        "subject": "load",
        "task": "PT",
        "condition": "PT7.5",
        "repetition": 0,
        "pulse_level": 0.0,
        "pulse_direction": 0.0,
        "pulse_onset": onset,
        "l_h": 0.33,
        "l_f": 0.34,
        "theta_s_deg": 45.0,
        "theta_e_deg": 90.0,
        "limit_time": hit,
    }
    labels = {name: np.broadcast_to(value, len(d)) for name, value in trials.items()}
    return make_recording({"perturbation": d, "force": f, "displacement": x}, labels, rate)


def load_recording(drive, n_trials=2, duration=30.0, rate=200.0):
    """A mass-spring-damper in the place of the arm, integrated at 1 kHz."""
    d = drive(n_trials, duration, 1000.0)
    mass = MASS + ENVIRONMENT.m_env * np.eye(2)
    damping, stiffness = DAMPING + ENVIRONMENT.b_env * np.eye(2), STIFFNESS + ENVIRONMENT.k_env * np.eye(2)
    inverse = np.linalg.inv(mass)
    a = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ stiffness, -inverse @ damping]])
    b = np.concatenate([np.zeros((2, 2)), inverse])
    # f = MASS x'' + DAMPING x' + STIFFNESS x
    to_force = np.concatenate([STIFFNESS, DAMPING], axis=1) + MASS @ a[2:]
    c = np.concatenate([to_force, np.eye(2, 4)])
    system = (a, b, c, np.concatenate([MASS @ inverse, np.zeros((2, 2))]))
    a, b, c, through, _ = signal.cont2discrete(system, 1e-3, "foh")
    # Mode by mode, which takes no loop over the samples.
    poles, modes = np.linalg.eig(a)
    drive = d @ np.linalg.solve(modes, b).T
    amounts = [signal.lfilter([0.0, 1.0], [1.0, -pole], drive[..., mode], axis=1) for mode, pole in enumerate(poles)]
    y = (np.stack(amounts, axis=-1) @ (c @ modes).T).real + d @ through.T
    kept = slice(None, None, round(1000.0 / rate))
    return recording_of(d[:, kept], y[:, kept, :2], y[:, kept, 2:], rate)


def relative_error(values, truth):
    return np.linalg.norm(values - truth, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2))


@pytest.fixture(scope="module")
def load():
    return load_recording(multisines)


def noisy_trials(seeds, duration=32.0):
    # Of the slow remnant alone, which models of finite order describe; docs/response.md has figures for the whole one.
    unchanged = dict.fromkeys(("spread_b", "spread_k", "spread_kv", "spread_kp"), 0.0)
    slow = replace(HUMAN_NOISE["PT"], remnant_share=0.4, fast_share=0.0, **unchanged)
    drawn = {seed: Multisine.draw(seed=seed, rms=5.4, duration=duration, crested=False) for seed in seeds}
    trials = [Trial(subject=POSITION, perturbation=drawn[seed], seed=seed, noise=slow) for seed in seeds]
    return run_experiment(trials, linear=True, instruments=Instruments(marker_noise=None, emg=None), n_threads=1)


@pytest.fixture(scope="module")
def noisy_arm():
    return noisy_trials(range(3))


@pytest.mark.parametrize("what", ["arm", "environment", "total"])
@pytest.mark.parametrize(
    "method",
    [
        pytest.param(method, marks=[pytest.mark.slow(reason="fits a model of high order")] * (method == "subspace"))
        for method in sorted(set(METHODS) - {"welch", "multitaper"})
    ],
)
def test_a_load_is_recovered_from_multisines(load, method, what):
    # Spectra are averages over clusters: they stand for their mean frequency where responses bend little, above 2 Hz.
    frequency = response(load, "spectral").frequency
    frequency = frequency[(frequency < 20.0) & (frequency > (2.5 if method == "spectral" else 0.0))]
    truth = {
        "arm": load_admittance,
        "environment": lambda f: environment_admittance(ENVIRONMENT, f),
        "total": lambda f: np.linalg.inv(
            np.linalg.inv(load_admittance(f)) + np.linalg.inv(environment_admittance(ENVIRONMENT, f))
        ),
    }[what](frequency)
    found = response(load, method, frequency, what=what)
    assert found.what == what
    np.testing.assert_array_equal(found.frequency, frequency)
    assert relative_error(found.response, truth).max() < (0.05 if method == "spectral" else 0.02)


@pytest.mark.parametrize("method", ["arx", "subspace"])
def test_a_load_is_recovered_from_noise_at_another_rate(method):
    recording = load_recording(coloured_noise, n_trials=1, duration=20.0, rate=1000.0)
    found = response(recording, method, BELOW_20)
    assert relative_error(found.response, load_admittance(BELOW_20)).max() < 0.02


@pytest.fixture(scope="module")
def quiet_arm():
    drawn = [Multisine.draw(seed=seed, rms=5.4, crested=False) for seed in range(2)]
    return run_experiment([Trial(subject=POSITION, perturbation=each) for each in drawn], linear=True, n_threads=1)


@pytest.mark.slow(reason="simulates a laboratory and fits models")
@pytest.mark.parametrize("method", ["arx", "subspace"])
def test_an_arm_with_delayed_reflexes_is_recovered(quiet_arm, method):
    frequency = line_spectra(quiet_arm).frequency
    frequency = frequency[frequency < 20.0]
    found = response(quiet_arm, method, frequency)
    assert relative_error(found.response, arm_admittance(POSITION, frequency)).max() < 0.01


@pytest.mark.slow(reason="simulates noisy trials")
@pytest.mark.parametrize("method", ["arx", "subspace"])
def test_of_a_noisy_arm_models_err_less_than_spectra(noisy_arm, method):
    spectra = estimate_spectra(line_spectra(noisy_arm))
    kept = spectra.frequency < 20.0
    truth = arm_admittance(POSITION, spectra.frequency[kept])
    found = response(noisy_arm, method, spectra.frequency[kept])
    size = {
        name: np.sqrt(np.mean(relative_error(values, truth) ** 2))
        for name, values in (("model", found.response), ("spectra", spectra.arm[kept]))
    }
    assert size["model"] < 0.6 * size["spectra"]
    assert (found.covariance is None) == (method == "subspace")  # for which three trials are too few


@pytest.mark.slow(reason="simulates eight recordings of noisy trials")
def test_covariance_of_arx_is_that_of_its_errors():
    ratios = []
    for first in range(0, 24, 3):  # errors of one recording go together
        found = response(noisy_trials(range(first, first + 3), 16.0), "arx", BELOW_20)
        ratios.append(np.mean(np.abs(found.response - arm_admittance(POSITION, BELOW_20)) ** 2 / found.covariance))
    assert 0.5 < np.mean(ratios) < 1.5


@pytest.mark.slow(reason="simulates noisy trials")
@pytest.mark.parametrize("fit", [fit_arx, fit_subspace])
def test_models_of_a_noisy_arm_are_stable_and_as_slow_as_it(noisy_arm, fit):
    slowest = np.exp(largest_real_pole(POSITION, ENVIRONMENT) / noisy_arm.attrs["rate"])
    assert fit(joint_records(noisy_arm), BELOW_20).largest_pole == pytest.approx(slowest, abs=0.003)


@pytest.mark.slow(reason="simulates noisy trials")
def test_a_model_straight_from_force_to_displacement_would_be_biased(noisy_arm):
    records = joint_records(noisy_arm)
    straight = [TrialRecord(record.response[:, :2], record.response[:, 2:], record.rate) for record in records]
    truth = arm_admittance(POSITION, BELOW_20)
    direct = Regression(straight, 30).model(30).response(BELOW_20)[0]
    joint = response(noisy_arm, "arx", BELOW_20, order=30).response
    assert np.median(relative_error(joint, truth)) < 0.3 * np.median(relative_error(direct, truth))


@pytest.mark.slow(reason="simulates noisy trials")
def test_responses_of_one_recording_fit_together(noisy_arm):
    frequency = BELOW_20
    order = {"order": 15}
    arm, environment, total = (
        response(noisy_arm, "arx", frequency, what=what, **order).response for what in ("arm", "environment", "total")
    )
    np.testing.assert_allclose(np.linalg.inv(total), np.linalg.inv(arm) + np.linalg.inv(environment), rtol=1e-6)
    truth = total_admittance(POSITION, ENVIRONMENT, frequency)
    assert np.median(relative_error(total, truth)) < 0.1


@pytest.mark.parametrize("method", ["multisine", "spectral"])
def test_some_frequencies_of_a_multisine(load, method):
    whole = response(load, method)
    some = response(load, method, whole.frequency[[4, 2]])
    for name in ("frequency", "response", "covariance", "dof"):
        np.testing.assert_array_equal(getattr(some, name), getattr(whole, name)[[4, 2]])


def test_as_many_averages_as_inputs_tell_no_covariance(load):
    with pytest.warns(RuntimeWarning, match="as many averages as inputs"):
        found = response(load, "spectral", lines_per_average=1)
    assert found.covariance is None


@pytest.mark.slow(reason="repeats estimates on drawn records")
def test_circles_hold_a_load_whose_force_is_noisy(load):
    wanted = response(load, "spectral").frequency
    wanted = wanted[(wanted > 4.0) & (wanted < 16.0)]
    covered = {"spectral": [], "subspace": []}
    for seed in range(4):
        white = np.random.default_rng(seed).normal(size=load["force"].shape)
        own = signal.sosfilt(signal.butter(2, 30.0, fs=200.0, output="sos"), white, axis=1)
        noisy = load.assign(force=load["force"] + 0.3 * own)
        # Four trials for the jackknife.
        later = noisy.isel(time=slice(3000, None)).assign_coords(time=noisy["time"].values[:3000])
        halves = [noisy.isel(time=slice(0, 3000)), later]
        for method, recording, options in (("spectral", noisy, {}), ("subspace", halves, {"order": 8})):
            found = response(recording, method, wanted, **options)
            covered[method].append(found.covers(load_admittance(wanted)).mean())
    for values in covered.values():
        assert np.mean(values) >= 0.85


@pytest.mark.slow(reason="simulates trials")
@pytest.mark.parametrize("method", ["arx", "subspace", "welch", "multitaper", "noise"])
def test_what_is_before_the_start_is_left_out(load, method):
    later = load.isel(time=slice(1000, None)).assign_coords(time=load["time"].values[:-1000])
    frequency = response(load, "spectral").frequency[3:8]
    options = {"noise": {"balance": False}, "arx": {"order": 8}, "subspace": {"order": 8, "past": 12}}.get(method, {})
    found, expected = (
        response(recording, method, frequency, window_start=start, **options)
        for recording, start in ((load, 5.0), (later, 0.0))
    )
    np.testing.assert_allclose(found.response, expected.response, rtol=1e-9)


# ARX models against difference equations.

A = np.array([[[0.5, 0.1, 0, 0], [0, 0.4, 0.1, 0], [0, 0, 0.3, -0.2], [0.1, 0, 0, 0.6]], -0.3 * np.eye(4)])
B = np.array([np.arange(8.0).reshape(4, 2) / 8, np.ones((4, 2)) * [1.0, -0.5]])
D = np.array([[1.0, 0.2], [-0.1, 1.0], [0.3, 0.3], [0.0, 0.5]])


def arx_response(frequency, rate):
    q = np.exp(-2j * np.pi * frequency / rate)[:, None, None]
    return np.linalg.solve(np.eye(4) - A[0] * q - A[1] * q**2, D + B[0] * q + B[1] * q**2)


def arx_records(lengths, seed, noise, offset=0.0):
    rng = np.random.default_rng(seed)
    inputs, outputs = [], []
    for trial, n in enumerate(lengths):
        u = rng.normal(size=(n, 2))
        y = rng.normal(size=(n, 4))
        drive = u[2:] @ D.T + u[1:-1] @ B[0].T + u[:-2] @ B[1].T + noise * rng.normal(size=(n - 2, 4))
        for k in range(2, n):
            y[k] = A[0] @ y[k - 1] + A[1] @ y[k - 2] + drive[k - 2]
        inputs.append(u + offset * trial)
        outputs.append(y - offset * trial**2)
    return [TrialRecord(u, y, 100.0) for u, y in zip(inputs, outputs, strict=True)]


def test_trials_of_unequal_length_from_any_start_and_offset_are_not_joined():
    model = fit_arx(arx_records([60, 100, 150], 0, 0.0, offset=3.0), BELOW_20, order=2)
    np.testing.assert_allclose(model.past, np.concatenate([A, B], axis=2), atol=1e-5)
    np.testing.assert_allclose(model.direct, D, atol=1e-5)
    joint = model.response(BELOW_20)[0]
    np.testing.assert_allclose(joint, arx_response(BELOW_20, 100.0), atol=1e-4)
    companion = np.block([[A[0], A[1]], [np.eye(4), np.zeros((4, 4))]])
    assert model.largest_pole == pytest.approx(np.abs(np.linalg.eigvals(companion)).max(), abs=1e-5)


def test_one_factor_holds_the_least_squares_of_every_order():
    records = arx_records([400], 1, 1.0)
    regression = Regression(records, 6)
    u, y, _ = records[0]
    for order in (1, 4, 6):
        both = np.concatenate([y, u], axis=1)
        rows = [np.ones((394, 1)), u[6:], *(both[6 - lag : 400 - lag] for lag in range(1, order + 1))]
        phi = np.concatenate(rows, axis=1)
        theta, squares = np.linalg.lstsq(phi, y[6:], rcond=None)[:2]
        model = regression.model(order)
        np.testing.assert_allclose(model.direct, theta[1:3].T, atol=1e-6)
        np.testing.assert_allclose(model.past[-1], theta[-6:].T, atol=1e-6)
        np.testing.assert_allclose(np.diag(model.noise), squares / (394 - phi.shape[1]), rtol=1e-6)


@pytest.mark.slow(reason="repeats estimates on drawn records")
def test_the_covariance_is_that_of_repetitions():
    frequency = np.array([1.0, 8.0, 20.0, 40.0])
    truth = {what: admittance_of(what, arx_response(frequency, 100.0)) for what in ("arm", "environment", "total")}
    ratio = {what: [] for what in truth}
    for seed in range(150):
        # Of little noise, as the variance is of first order, and d - f nearly vanishes in some directions.
        model = fit_arx(arx_records([150, 150], seed, 0.05), frequency, order=2)
        for what, right in truth.items():
            joint, noise, spread = model.response(frequency)
            error = admittance_of(what, joint) - right
            ratio[what].append(np.abs(error) ** 2 / variance_of(what, joint, noise, spread))
    for values in ratio.values():
        # 150 squares of normal errors, complex or nearly real: each mean has a spread of 0.08 to 0.12.
        assert np.mean(values) == pytest.approx(1.0, abs=0.1)
        assert np.abs(np.mean(values, axis=0) - 1.0).max() < 0.5


def test_long_trials_are_factored_in_parts(monkeypatch):
    records = arx_records([400, 300], 0, 0.3)
    whole = Regression(records, 6).model(4)
    monkeypatch.setattr(arx, "MOST_ROWS", 90)
    parts = Regression(records, 6).model(4)
    for found, expected in ((parts.weights, whole.weights), (parts.noise, whole.noise)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_the_order_is_enough_and_not_much_more():
    orders = [fit_arx(arx_records([400], seed, 0.3), BELOW_20, highest_order=12).order for seed in range(5)]
    assert min(orders) >= 2
    assert np.median(orders) <= 4


# Subspace models against state space.


def state_space_records(noise, seed=3):
    rng = np.random.default_rng(seed)
    poles = np.array([0.95 * np.exp(0.3j), 0.9 * np.exp(0.8j), 0.8])
    a = np.zeros((5, 5))
    for place, pole in ((0, poles[0]), (2, poles[1])):
        a[place : place + 2, place : place + 2] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
    a[4, 4] = poles[2].real
    b, c = rng.normal(size=(5, 2)), rng.normal(size=(4, 5))
    d = np.concatenate([np.eye(2), np.zeros((2, 2))])
    inputs = [rng.normal(size=(n, 2)) for n in (500, 300)]
    outputs = []
    for u in inputs:
        y = signal.dlsim((a, b, c, d, 0.01), u)[1]
        # Noise of the process and of the measurement.
        disturbed = signal.dlsim((a, np.eye(5), c, np.zeros((4, 5)), 0.01), noise * rng.normal(size=(len(u), 5)))[1]
        outputs.append(y + disturbed + noise * rng.normal(size=y.shape))
    delay = np.exp(2j * np.pi * 0.01 * BELOW_20)[:, None, None]
    judge = c @ np.linalg.solve(delay * np.eye(5) - a, np.broadcast_to(b.astype(complex), (len(BELOW_20), 5, 2))) + d
    records = [TrialRecord(u, y, 100.0) for u, y in zip(inputs, outputs, strict=True)]
    return records, judge, np.linalg.eigvals(a)


def test_without_noise_a_subspace_model_is_the_system():
    records, truth, poles = state_space_records(0.0)
    model = fit_subspace(records, BELOW_20, order=5, past=6)
    assert model.singular_values[5] < 1e-3 * model.singular_values[4]
    np.testing.assert_allclose(model.response(BELOW_20), truth, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(model.a)), np.sort_complex(poles), atol=1e-3)


def test_with_noise_a_subspace_model_is_close_and_of_few_states():
    records, truth, _ = state_space_records(0.1)
    model = fit_subspace(records, BELOW_20, past=12)
    assert 5 <= model.order <= 12
    assert np.median(np.abs(model.response(BELOW_20) - truth) / np.abs(truth)) < 0.05
    assert model.largest_pole < 1.0


# What goes in.


def test_records_end_at_the_pulse_of_each_trial(load):
    onsets = np.array([12.0, np.nan])
    cut = load.assign_coords(pulse_onset=("trial", onsets, load["pulse_onset"].attrs))
    assert [len(record.perturbation) for record in joint_records(cut)] == [2400, 6000]


@pytest.mark.slow(reason="estimates many spectra")
def test_several_recordings_may_have_several_lengths(load):
    shorter = load.isel(trial=[0], time=slice(0, 3000))
    found = response([load.isel(trial=[1]), shorter], "arx", BELOW_20)
    assert relative_error(found.response, load_admittance(BELOW_20)).max() < 0.02


def test_the_excited_frequencies_are_those_of_the_disturbance(load):
    found = excited_frequencies(joint_records(load))
    lines = line_spectra(load).frequency
    apart = np.abs(found[:, None] - lines).min(axis=1)
    assert apart.max() < 0.21
    assert np.abs(found - lines[:, None]).min(axis=1).max() < 0.1


def constant(recording, name, axis):
    values = recording[name].values.copy()
    values[:, :, axis] = 1.0
    return recording.assign({name: (recording[name].dims, values, recording[name].attrs)})


def one_direction(recording):
    values = recording["perturbation"].values[:, :, [0, 0]] * [1.0, 2.0]
    name = recording["perturbation"]
    return recording.assign(perturbation=(name.dims, values, name.attrs))


def with_nan(recording):
    values = recording["force"].values.copy()
    values[1, 7, 0] = np.nan
    return recording.assign(force=(recording["force"].dims, values, recording["force"].attrs))


@pytest.mark.parametrize("method", ["arx", "subspace"])
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda r: constant(r, "displacement", 1), "displacement along y is constant in all trials"),
        (lambda r: constant(r, "perturbation", 0), "perturbation along x is constant in all trials"),
        (one_direction, "are not independent"),
        (with_nan, "force of trial 1 is nan at sample 7"),
        (lambda r: r.isel(time=slice(0, 200)), "200 samples|400 samples"),
        (lambda r: r.isel(trial=[]), "there are no trials"),
        (lambda r: [], "recordings is empty"),
        (lambda r: [r, load_recording(multisines, 1, 12.0, 100.0)], "rate = 100, 200 Hz; expected one rate"),
        (
            lambda r: r.assign_coords(limit_time=("trial", [np.nan, 3.0], r["limit_time"].attrs)),
            "trial 1 reached the workspace limit at 3.000 s",
        ),
        (
            lambda r: r.assign_coords(pulse_onset=("trial", [9.0, 0.0], r["pulse_onset"].attrs)),
            "trial 1 ends at 0 s; expected more than 0 s",
        ),
    ],
)
def test_recordings_are_refused(load, method, spoil, message):
    with pytest.raises(ValueError, match=message):
        response(spoil(load), method, BELOW_20)


@pytest.mark.parametrize(
    ("arguments", "options", "error", "message"),
    [
        (
            ("wavelet",),
            {},
            ValueError,
            "method = 'wavelet'; expected one of multisine, noise, welch, multitaper, spectral, arx, subspace",
        ),
        (("arx", [0.0, 1.0]), {}, ValueError, "frequency = 0 Hz; expected above 0 and below 100 Hz"),
        (("subspace", [100.0]), {}, ValueError, "frequency = 100 Hz"),
        (("arx", [np.nan]), {}, ValueError, "frequency = nan Hz"),
        (("arx", 3.0), {}, ValueError, r"frequency has shape \(\)"),
        (("arx", []), {}, ValueError, r"frequency has shape \(0,\)"),
        (("spectral", [1.0]), {}, ValueError, "frequency = 1 Hz; expected one of the averaged lines"),
        (("arx",), {"what": "leg"}, ValueError, "what = 'leg'; expected one of arm, environment, total"),
        (("spectral",), {"what": "leg"}, ValueError, "what = 'leg'"),
        (("subspace",), {"what": "leg"}, ValueError, "what = 'leg'"),
        (("arx",), {"order": 0}, ValueError, "order = 0"),
        (("arx",), {"order": 2.5}, TypeError, "order = 2.5"),
        (("arx",), {"order": 700}, ValueError, "order 700 has 4202 coefficients for each channel, and 12000 samples"),
        (("arx",), {"highest_order": 0}, ValueError, "highest order = 0"),
        (("subspace",), {"order": 0}, ValueError, "order = 0"),
        (("subspace",), {"order": 97}, ValueError, "order = 97; expected at most 96 with past = 24"),
        (("subspace",), {"past": 0}, ValueError, "past = 0"),
        (("arx",), {"past": 3}, TypeError, "past"),
        (("multisine", [1.0]), {}, ValueError, "frequency = 1 Hz; expected one of the averaged lines"),
        (("multisine",), {"period": 0.0}, ValueError, "period = 0"),
        (("welch", [0.0]), {}, ValueError, "frequency = 0 Hz; expected above 0 and below 100 Hz"),
        (("noise", [100.0]), {}, ValueError, "frequency = 100 Hz; expected above 0 and below 100 Hz"),
        (("multitaper",), {"half_bandwidth": -1.0}, ValueError, "half_bandwidth = -1"),
        (("welch",), {"segment": 0.0}, ValueError, "segment = 0"),
        (("welch",), {"what": "leg"}, ValueError, "what = 'leg'"),
        (("noise",), {"what": "leg"}, ValueError, "what = 'leg'"),
        (("arx",), {"window_start": 40.0}, ValueError, "trial 0 ends at 30 s; expected more than 40 s"),
        (("multitaper",), {"window_start": 40.0}, ValueError, "trial 0 ends at 30 s; expected more than 40 s"),
    ],
)
def test_requests_are_refused(load, arguments, options, error, message):
    with pytest.raises(error, match=message):
        response(load, *arguments, **options)
