"""EMG that reflexes make of rotation, in the likelihood of an arm: derivatives, recovery, and what it adds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.arm.parameters import PARAMETERS, parameter_vector
from armperturb.analysis.emg.outputs import ReflexOutputs
from armperturb.analysis.fit.emg_laws import MIXED, STRETCH, TORQUE
from armperturb.analysis.fit.emg_likelihood import ElectromechanicalDelay, EmgLikelihood
from armperturb.subject import POSITION

RATE, N, N_TRIALS = 200.0, 4000, 3
ARM = replace(POSITION, Td_s=0.034, Td_e=0.027)
GAINS = {"g_s": 0.02, "g_e": 0.016, "g_bs": 0.008, "g_be": 0.011}
OTHERS = {"g_b": 0.012, "g_sb": 0.005, "g_eb": 0.006}
FREE = ("kv_s", "kv_se", "kv_e", "kp_s", "kp_se", "kp_e", "Td_s", "Td_e")


def outputs(noise=0.02, lag=0.0, of_handle=False, from_rest=False, seed=0, mean=0.0):
    """Differences of antagonists, made in the time domain, ten times as finely as they are sampled."""
    rng = np.random.default_rng(seed)
    fine = 10 * RATE
    band = signal.butter(2, (0.5, 8.0), "bandpass", fs=fine, output="sos")
    q = signal.sosfiltfilt(band, rng.standard_normal((N_TRIALS, 2, 10 * N)))
    q *= 0.02 / q.std()
    time = np.arange(10 * N) / fine
    if from_rest:
        q = (q + mean) * (0.5 - 0.5 * np.cos(np.pi * np.minimum(time, 1.0)))
    kv, kp = (
        np.array([[getattr(ARM, f"{k}_{j}") for j in row] for row in (("s", "se"), ("se", "e"))]) for k in ("kv", "kp")
    )
    excitation = np.einsum("ij,tjn->tin", kv, np.gradient(q, 1.0 / fine, axis=-1)) + np.einsum("ij,tjn->tin", kp, q)
    late = np.stack(
        [
            [np.interp(time - delay + lag, time, each[joint]) for each in excitation]
            for joint, delay in enumerate((ARM.Td_s, ARM.Td_e))
        ],
        axis=1,
    )
    both = GAINS["g_bs"] * late[:, 0] + GAINS["g_be"] * late[:, 1]
    clean = np.stack([GAINS["g_s"] * late[:, 0], GAINS["g_e"] * late[:, 1], both], axis=1)[..., ::10]
    noisy = clean + noise * rng.standard_normal(clean.shape)
    rotation, load = q[..., ::10].swapaxes(1, 2), None
    if of_handle:
        # The grip gives way by its damper and spring under a force that is a rotation of its own.
        force = signal.sosfiltfilt(band, rng.standard_normal((N_TRIALS, 2, 10 * N))) * 300.0
        spring = signal.bilinear([1.0], [ARM.b_h, ARM.k_h], fine)
        inverse = np.linalg.inv(hand_jacobian(ARM))
        load = (inverse @ force)[..., ::10].swapaxes(1, 2)
        rotation = rotation + (inverse @ signal.lfilter(*spring, force))[..., ::10].swapaxes(1, 2)
    return ReflexOutputs(
        groups=("s", "e", "se"),
        difference=noisy.swapaxes(1, 2),
        rotation=rotation,
        grip_load=load,
        rate=RATE,
        averaging=1e-6,
        from_rest=from_rest,
    )


def mixing(likelihood, free=FREE):
    names = (*PARAMETERS, *likelihood.names)
    return np.eye(len(names))[:, [names.index(name) for name in free]]


def at(likelihood, arm=ARM, **values):
    own = {**GAINS, **OTHERS, "T_em": 0.0} | values
    return np.append(parameter_vector(arm), [own[name] for name in likelihood.names])


def steps(likelihood, values, free, n=6):
    """Gauss-Newton steps from values, and the errors at their end."""
    mix = mixing(likelihood, free)
    for _ in range(n):
        likelihood.weigh(values)
        normal = likelihood.normal(values, mix)
        values = values + mix @ np.linalg.solve(normal.information, normal.slope)
    return mix.T @ values, np.sqrt(np.diag(np.linalg.inv(normal.information)))


@pytest.mark.parametrize(("of_handle", "law"), [(False, TORQUE), (True, TORQUE), (False, STRETCH), (True, MIXED)])
def test_slope_is_that_of_the_cost(of_handle, law):
    likelihood = EmgLikelihood(outputs(of_handle=of_handle), ElectromechanicalDelay(mean=0.0, sd=0.01), law)
    free = (*FREE, "ka_s", "ka_se", "ka_e", *likelihood.names, *(("b_h", "k_h") if of_handle else ()))
    mix = mixing(likelihood, free)
    values = at(likelihood, replace(ARM, kv_s=18.0, Td_e=0.03, ka_se=0.1), T_em=0.002)
    likelihood.weigh(values)
    normal = likelihood.normal(values, mix)
    for column in range(len(free)):
        step = 1e-4 * max(abs(mix[:, column] @ values), 1e-3)
        ends = [likelihood.cost(values + sign * step * mix[:, column]) for sign in (1, -1)]
        assert -2.0 * normal.slope[column] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4), free[column]


def test_gains_of_reflexes_and_delays_are_those_that_made_the_emg():
    likelihood = EmgLikelihood(outputs(), ElectromechanicalDelay())
    free = ("kv_se", "kv_e", "kp_s", "kp_se", "kp_e", "Td_s", "Td_e", "g_s", "g_bs", "g_be")
    start = at(likelihood, replace(ARM, kp_s=0.0, kp_e=60.0, kv_se=12.0, Td_s=0.028, Td_e=0.032), g_s=0.015)
    values, errors = steps(likelihood, start, free)
    true = mixing(likelihood, free).T @ at(likelihood)
    assert np.abs((values - true) / errors).max() < 3.5
    assert errors[free.index("Td_s")] < 1e-3
    fit = likelihood.lack_of_fit(start + mixing(likelihood, free) @ (values - mixing(likelihood, free).T @ start))
    assert fit.p_value > 0.01
    assert likelihood.lack_of_fit(at(likelihood, replace(ARM, Td_s=0.045))).p_value < 1e-6


@pytest.mark.parametrize(("from_rest", "mean"), [(False, 0.0), (True, 0.0), (True, 0.02)])
@pytest.mark.parametrize("seed", [0, 1])
def test_feedback_is_right_though_the_arm_still_moves_where_the_window_fades(from_rest, mean, seed):
    """With next to no noise: derivatives and delays of what is windowed are not those of the rotation."""
    made = outputs(noise=1e-4, from_rest=from_rest, seed=seed, mean=mean)
    likelihood = EmgLikelihood(made, ElectromechanicalDelay())
    values, _ = steps(likelihood, at(likelihood), FREE)
    # Of an arm that is pushed aside, the level before the first answers is that of rest to first order of the delay.
    np.testing.assert_allclose(values, mixing(likelihood).T @ at(likelihood), rtol=1.5e-2 if mean else 3e-3)


def test_a_grip_that_gives_way_is_taken_out_of_the_handle():
    likelihood = EmgLikelihood(outputs(of_handle=True), ElectromechanicalDelay())
    free = ("kp_s", "kp_se", "kp_e", "Td_s", "Td_e", "b_h", "k_h")
    values, errors = steps(likelihood, at(likelihood, replace(ARM, k_h=18000.0, b_h=40.0)), free)
    true = mixing(likelihood, free).T @ at(likelihood)
    assert np.abs((values - true) / errors).max() < 3.5
    assert errors[-1] < 0.1 * true[-1]


def test_start_is_least_squares_of_the_gains():
    likelihood = EmgLikelihood(outputs(noise=1e-6), ElectromechanicalDelay())
    np.testing.assert_allclose(likelihood.start(parameter_vector(ARM)), list(GAINS.values()), rtol=2e-3)


def test_the_mixture_of_laws_holds_each_of_them():
    alike = replace(ARM, Td_e=ARM.Td_s)
    mixed, torque, stretch = (
        EmgLikelihood(outputs(), ElectromechanicalDelay(), law) for law in (MIXED, TORQUE, STRETCH)
    )
    none = dict.fromkeys((*GAINS, *OTHERS), 0.0)
    of_torque = {**GAINS, "g_sb": GAINS["g_s"], "g_eb": GAINS["g_e"], "g_b": GAINS["g_bs"] + GAINS["g_be"]}
    for law, gains in ((torque, of_torque), (stretch, {name: (GAINS | OTHERS)[name] for name in stretch.names})):
        expected = law._predicted(at(law, alike))
        np.testing.assert_allclose(mixed._predicted(at(mixed, alike, **none | gains)), expected, rtol=1e-9)


def test_muscles_that_answer_late_are_told_by_delay_of_the_emg_alone():
    """EMG is 10 ms earlier than the torque: only with that known is the delay that of the torque."""
    early = outputs(lag=0.01)
    known = EmgLikelihood(early, ElectromechanicalDelay(mean=0.01))
    delays, errors = steps(known, at(known), ("Td_s", "Td_e"))
    np.testing.assert_allclose(delays, [ARM.Td_s, ARM.Td_e], atol=3.5 * errors.max())
    unknown = EmgLikelihood(early, ElectromechanicalDelay(mean=0.0, sd=0.02))
    assert unknown.prior == {"T_em": (0.0, 0.02)}
    lag, _ = steps(unknown, at(unknown), ("T_em",))
    assert lag[0] == pytest.approx(0.01, abs=1e-3)


@pytest.mark.parametrize(("mean", "sd"), [(-0.01, 0.0), (0.2, 0.0), (0.01, 0.1)])
def test_delays_that_nobody_has_are_refused(mean, sd):
    with pytest.raises(ValueError, match="electromechanical delay: "):
        ElectromechanicalDelay(mean=mean, sd=sd)
