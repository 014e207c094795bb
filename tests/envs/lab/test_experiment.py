"""The batched experiment against theory, against a plain loop, and under bad input."""

import tracemalloc
import warnings
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import xarray as xr
from tones import PERIOD, Tones

from armperturb.analysis.arm.linear_arm import arm_admittance, environment_admittance, total_admittance
from armperturb.analysis.arm.state_space import fastest_pole, largest_real_pole
from armperturb.analysis.fit.thesis import fit_trials
from armperturb.analysis.response.spectra import estimate_spectra, line_spectra
from armperturb.cohort import average_person
from armperturb.controllers.lanes import activation_filter
from armperturb.controllers.remnant import HUMAN_NOISE, HumanNoise
from armperturb.environment import TIMESTEP, Environment
from armperturb.envs.lab.emg import Emg
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial, known_ahead, subject_in
from armperturb.models.rig import build_model, start_motors
from armperturb.perturbations import Multisine, MultisineThenPulse, Pulse, Sampled
from armperturb.perturbations.multisine import PERIOD as MULTISINE_PERIOD
from armperturb.subject import POSITION, RELAX, at_level

ENVIRONMENT = Environment()
SETTLED = {"other": 20.0, "position": 8.0}
"""Time after which the transient of the slowest of these arms, and of that preset, has gone by e^-10 [s]."""
OTHER = replace(
    POSITION,
    name="other",
    Td_s=0.0455,
    Td_e=0.0253,
    fact_s=5.0,
    fact_e=2.2,
    zeta_act=1.0,
    kp_s=60.0,
    kv_e=12.0,
    b_se=7.0,
    l_h=0.30,
    l_f=0.37,
    theta_s_deg=40.0,
    theta_e_deg=70.0,
    c_h=0.58,
    c_f=0.62,
    r_h=0.27,
    r_f=0.36,
)


def small_multisine(duration):
    # So small that the arm's geometry stays linear to 1e-3.
    return Multisine.draw(seed=4, rms=2e-3, duration=duration, crested=False)


def both_axes(subjects, settled, rms=2e-3, **options):
    """Spectra of each subject, who is moved along one axis at a time, together with the others."""
    trials = [
        Trial(subject=subject, perturbation=Tones(rms=rms, duration=settled + PERIOD, axes=(axis,)))
        for subject in subjects
        for axis in range(2)
    ]
    recording = run_experiment(trials, ENVIRONMENT, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # two averages for two inputs: coherence is not used here
        return [
            estimate_spectra(
                line_spectra(recording.isel(trial=[2 * n, 2 * n + 1]), window_start=settled, period=PERIOD),
                lines_per_average=1,
            )
            for n in range(len(subjects))
        ]


def relative_error(estimate, theory):
    return np.linalg.norm(estimate - theory, axis=(1, 2)) / np.linalg.norm(theory, axis=(1, 2))


def assert_is_theory(spectra, subject):
    f = spectra.frequency
    for estimate, theory in (
        (spectra.arm, arm_admittance(subject, f)),
        (spectra.total, total_admittance(subject, ENVIRONMENT, f)),
        (spectra.environment, environment_admittance(ENVIRONMENT, f)),
    ):
        error = relative_error(estimate, theory)
        assert error[f <= 20].max() < 0.001, subject.name
        assert error.max() < 0.003, subject.name


@pytest.mark.slow(reason="lets slow transients of six trials pass")
def test_admittance_of_the_recording_is_that_of_theory():
    subjects = (RELAX, POSITION, OTHER)
    for subject, spectra in zip(subjects, both_axes(subjects, SETTLED["other"]), strict=True):
        assert_is_theory(spectra, subject)


@pytest.mark.slow(reason="lets transients pass, at two steps")
def test_halving_the_step_divides_the_error_by_four():
    errors = []
    for timestep in (5e-3, 2.5e-3):
        [spectra] = both_axes([POSITION], SETTLED["position"], timestep=timestep)
        fast = spectra.frequency > 15
        errors.append(relative_error(spectra.arm, arm_admittance(POSITION, spectra.frequency))[fast].max())
    assert errors[0] / errors[1] > 3.5


@pytest.mark.slow(reason="lets transients pass")
def test_strain_gauge_reads_the_force_that_the_environment_misses():
    rate, settled = 1000.0, SETTLED["position"]
    tones = Tones(rms=2.0, duration=settled + PERIOD, seed=2)
    recording = run_experiment([Trial(subject=POSITION, perturbation=tones)], ENVIRONMENT, rate=rate, timestep=1e-3)
    last = recording.isel(trial=0, time=slice(round(settled * rate), None))
    s = 2j * np.pi * np.fft.rfftfreq(last.sizes["time"], 1 / rate)[:, None]
    # In the settled period every derivative is a product in frequency.
    inertial = np.fft.irfft(
        (ENVIRONMENT.m_env * s**2 + ENVIRONMENT.b_env * s + ENVIRONMENT.k_env)
        * np.fft.rfft(last["displacement"].values, axis=0),
        axis=0,
        n=last.sizes["time"],
    )
    expected = last["perturbation"].values - inertial
    assert np.sqrt(np.mean((last["force"].values - expected) ** 2) / np.mean(expected**2)) < 1e-3


def mixed_trials():
    subjects = (RELAX, POSITION, OTHER, replace(POSITION, kp_e=20.0), replace(RELAX, m_f=1.2))
    return [
        Trial(subject=subject, perturbation=Multisine.draw(seed=number, rms=1.0, duration=0.5, crested=False))
        for number, subject in enumerate(subjects)
    ]


def plain_loop(trial, n_samples, decimation, timestep=TIMESTEP):
    """The same trial by `mj_step` on one `MjData`, with reflexes written out for one linear person."""
    person, n_steps = trial.subject, n_samples * decimation
    model = build_model(person, ENVIRONMENT, timestep=timestep)
    data = mujoco.MjData(model)
    push = trial.perturbation.sample(1 / timestep, n_steps + 4, -timestep)
    start_motors(model, data, 2, np.hstack([np.zeros((4, 2)), push[:4]]))
    (kv_s, kv_se, kv_e), (kp_s, kp_se, kp_e) = (person.joint_triple(name) for name in ("kv", "kp"))
    filters = [activation_filter(cutoff, person.zeta_act, timestep) for cutoff in (person.fact_s, person.fact_e)]
    memory = [[0.0, 0.0], [0.0, 0.0]]
    log = []
    for step in range(n_steps):
        q_s, q_e = data.qpos[:2] - person.posture
        w_s, w_e = data.qvel[:2]
        for joint, excitation in enumerate(
            (
                kv_s * w_s + kv_se * w_e + kp_s * q_s + kp_se * q_e,
                kv_se * w_s + kv_e * w_e + kp_se * q_s + kp_e * q_e,
            )
        ):
            (b0, b1, b2), (_, a1, a2) = filters[joint]
            first, second = memory[joint]
            active = b0 * excitation + first
            memory[joint] = [b1 * excitation - a1 * active + second, b2 * excitation - a2 * active]
            data.ctrl[joint] = -active
        data.ctrl[4:] = push[step + 4]
        state = data.qpos.copy()
        mujoco.mj_step(model, data)
        if step % decimation == 0:
            log.append([*state, *data.sensor("strain_gauge").data[:2]])
    return np.array(log)


@pytest.mark.slow(reason="a loop of single simulations")
def test_trials_equal_a_plain_loop_to_the_last_bit_at_any_number_of_threads():
    trials = mixed_trials()
    reference = run_experiment(trials, ENVIRONMENT, n_threads=1)
    for n_threads in (2, 4):
        assert run_experiment(trials, ENVIRONMENT, n_threads=n_threads).identical(reference)
    n = reference.sizes["time"]
    for number, trial in enumerate(trials):
        alone = run_experiment([trial], ENVIRONMENT).isel(trial=0)
        lane = reference.isel(trial=number)
        loop = plain_loop(trial, n, 2)
        for name, columns in (("joint_angle", slice(0, 2)), ("displacement", slice(2, 4)), ("force", slice(4, 6))):
            np.testing.assert_array_equal(lane[name].values, alone[name].values)
            np.testing.assert_array_equal(lane[name].values, loop[:, columns])


def test_a_trial_at_the_workspace_limit_is_reported_and_the_others_finish():
    gentle, hard = (Pulse(peak=peak, direction_deg=20.0, onset=0.1, duration=1.0) for peak in (10.0, 600.0))
    both = run_experiment([Trial(subject=RELAX, perturbation=pulse) for pulse in (gentle, hard)], ENVIRONMENT)
    alone = run_experiment([Trial(subject=RELAX, perturbation=gentle)], ENVIRONMENT)
    assert np.isnan(both["limit_time"].values[0])
    assert 0.1 < both["limit_time"].values[1] < 0.5
    np.testing.assert_array_equal(both["displacement"].values[0], alone["displacement"].values[0])


def test_what_cannot_be_integrated_is_refused(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    pulse = Pulse(peak=1e300, direction_deg=20.0, onset=0.1, duration=0.3)
    with pytest.raises(RuntimeError, match="trial 0 of subject 'relax' could not be integrated"):
        run_experiment([Trial(subject=RELAX, perturbation=pulse)], ENVIRONMENT)
    assert list(tmp_path.iterdir()) == []  # MuJoCo would leave a log here
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("engine", ["mujoco", "compiled"])
def test_a_trial_too_fast_for_the_step_is_simulated_again_at_a_finer_one(engine):
    # The blow stretches the elbow, which snaps through its singular posture.
    blow = Trial(subject=RELAX, perturbation=Pulse(peak=2000.0, direction_deg=90.0, onset=0.1, duration=0.3))
    gentle = replace(blow, perturbation=replace(blow.perturbation, peak=2.0))
    both, alone, finer = (
        run_experiment(trials, ENVIRONMENT, engine=engine, timestep=timestep)
        for trials, timestep in (([gentle, blow], 2.5e-3), ([blow], 2.5e-3), ([blow], 1.25e-3))
    )
    assert np.isnan(both["limit_time"].values[0])
    assert both["limit_time"].values[1] == alone["limit_time"].item() == pytest.approx(finer["limit_time"].item())
    np.testing.assert_array_equal(both["displacement"].values[1], alone["displacement"].values[0])


def test_noise_is_the_same_at_a_finer_step():
    trial = Trial(
        subject=POSITION,
        perturbation=Multisine.draw(seed=0, rms=5.0, duration=4.0, crested=False),
        noise=HUMAN_NOISE["PT"],
        seed=3,
    )
    coarse, fine = known_ahead(trial, 2.5e-3, 1600), known_ahead(trial, 2.5e-3, 6400, 4)
    np.testing.assert_allclose(fine[1::4, :2], coarse[1 : 1 + len(fine[1::4]), :2], atol=1e-12)
    # Halfway between two steps, by the cubic through four.
    between = (9.0 * (coarse[2:-2, :2] + coarse[3:-1, :2]) - coarse[1:-3, :2] - coarse[4:, :2]) / 16.0
    halfway = fine[7::4, :2][: len(between)]
    assert np.sqrt(np.mean((halfway - between[: len(halfway)]) ** 2)) < 0.02 * between.std()
    # The force starts one step before the first.
    np.testing.assert_allclose(fine[1::4, 2:][:1600], coarse[1:1601, 2:], atol=1e-12)


def test_recording_carries_the_labels_of_its_trials():
    multisine = Multisine.draw(seed=0, rms=1.0, duration=0.2, crested=False)
    trial = Trial(
        subject=POSITION,
        perturbation=MultisineThenPulse.join(multisine, peak=20.0, direction_deg=200.0, tail=0.3),
        condition="PT7.5",
        repetition=1,
        pulse_level=2.0,
    )
    alone = Trial(subject=RELAX, perturbation=Pulse(peak=5.0, direction_deg=20.0, onset=0.05, duration=0.3))
    recording = run_experiment([trial, alone], ENVIRONMENT)
    first, second = (recording.isel(trial=i) for i in range(2))
    assert (first["subject"].item(), first["task"].item(), first["condition"].item()) == ("position", "PT", "PT7.5")
    assert (first["repetition"].item(), first["pulse_level"].item()) == (1, 2.0)
    assert (first["pulse_direction"].item(), first["pulse_onset"].item()) == (200.0, 0.2)
    assert (second["condition"].item(), second["pulse_direction"].item(), second["pulse_onset"].item()) == (
        "RT",
        20,
        0.05,
    )
    assert recording.sizes["time"] == 100
    np.testing.assert_allclose(recording["joint_angle"].values[:, 0], [POSITION.posture, RELAX.posture], rtol=1e-12)
    for name, units in (("perturbation", "N"), ("force", "N"), ("displacement", "m"), ("joint_angle", "rad")):
        assert recording[name].attrs["units"] == units


def test_instruments_disturb_only_what_they_measure_and_by_their_seed():
    trial = Trial(subject=RELAX, perturbation=small_multisine(1.0), seed=5)
    instruments = Instruments(antialias=None)
    ideal = run_experiment([trial], ENVIRONMENT)
    first, again = (run_experiment([trial], ENVIRONMENT, instruments=instruments) for _ in range(2))
    other = run_experiment([replace(trial, seed=6)], ENVIRONMENT, instruments=instruments)
    assert first.identical(again)
    for name in ("force", "shoulder_marker", "emg"):
        assert not first[name].equals(other[name])
    for name in ("perturbation", "joint_angle"):
        assert first[name].equals(ideal[name])
    assert 0 < np.abs(first["displacement"] - ideal["displacement"]).max() < 1e-4


@pytest.mark.slow(reason="lets transients pass")
def test_admittance_behind_the_antialias_filter_is_that_of_theory():
    # Rounding to 17 bits would hide motion that is small enough to keep the arm linear.
    quiet = Instruments(force_noise=0.0, encoder_bits=32, marker_noise=None, emg=None)
    [spectra] = both_axes([POSITION], SETTLED["position"], rms=0.05, instruments=quiet)
    assert_is_theory(spectra, POSITION)


def test_antialias_filter_keeps_out_what_would_fold():
    # 170 Hz sampled at 200 Hz looks like 30 Hz.
    time = np.arange(8000) / 4000
    hum = Sampled(force=np.sin(2 * np.pi * 170 * time)[:, None] * [1.0, 1.0], rate=4000.0)
    trial = Trial(subject=RELAX, perturbation=hum)
    open_, closed = (
        run_experiment([trial], ENVIRONMENT, instruments=Instruments(antialias=antialias, force_noise=0.0, emg=None))
        for antialias in (None, 80.0)
    )
    for name in ("perturbation", "force"):
        # The last second, after the transient of the start; its line 30 is at 30 Hz.
        folded, kept = (
            np.abs(np.fft.rfft(recording[name].values[0, 200:], axis=0)[30]) for recording in (open_, closed)
        )
        assert (kept < 0.05 * folded).all()


@pytest.mark.slow(reason="trials long enough for statistics")
def test_measured_noise_floors_are_the_settings():
    trials = [
        Trial(subject=RELAX, perturbation=Pulse(peak=1e-9, direction_deg=20.0, onset=3.0, duration=4.0), seed=seed)
        for seed in range(2)
    ]
    emg = Emg(noise=7e-3)
    instruments = Instruments(force_noise=0.05, marker_noise=2e-3, emg=emg)
    recording = run_experiment(trials, ENVIRONMENT, instruments=instruments)
    for name, expected in (("force", 0.05), ("shoulder_marker", 2e-3), ("emg", 7e-3)):
        np.testing.assert_allclose(recording[name].values.std(axis=1), expected, rtol=0.1)
    moving = Trial(subject=RELAX, perturbation=Multisine.draw(seed=3, rms=1.0, duration=8.0, crested=False))
    fine, coarse = (
        run_experiment([moving], ENVIRONMENT, instruments=Instruments(encoder_bits=bits, emg=None)) for bits in (32, 17)
    )
    error = (coarse["displacement"] - fine["displacement"]).values[0]
    # Both angles are uniform within a step; the handle is 0.65 m from the first axis and 0.6 m from the second.
    x, y = np.array([0.0, -0.65]), np.array([[-0.325, 0.5044], [-0.325, -0.5044]])
    proximal, distal = np.linalg.norm(x), np.linalg.norm(y[1])
    expected = 2 * np.pi / 2**17 / np.sqrt(12) * np.hypot(proximal, distal)
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) == pytest.approx(expected, rel=0.1)


def noisy_trials():
    """People in both tasks, one seed each, the last with a pulse and one without noise."""
    trials = [
        replace(trial, noise=HUMAN_NOISE[trial.subject.task], seed=100 + number, order=number)
        for number, trial in enumerate(mixed_trials())
    ]
    pulse = Pulse(peak=20.0, direction_deg=200.0, onset=0.1, duration=0.5)
    return [*trials, replace(trials[1], noise=None), replace(trials[0], perturbation=pulse, seed=7)]


@pytest.mark.slow(reason="runs the laboratory twelve times")
def test_whole_laboratory_is_the_same_alone_and_together_at_any_number_of_threads():
    trials, instruments = noisy_trials(), Instruments()
    together = run_experiment(trials, ENVIRONMENT, instruments=instruments, n_threads=1)
    assert run_experiment(trials, ENVIRONMENT, instruments=instruments, n_threads=4).identical(together)
    halves = [run_experiment(part, ENVIRONMENT, instruments=instruments) for part in (trials[:3], trials[3:])]
    alone = [run_experiment([trial], ENVIRONMENT, instruments=instruments) for trial in trials]
    for parts in (halves, alone):
        assert xr.concat(parts, dim="trial", combine_attrs="identical").identical(together)
    assert together["order"].values.tolist() == [trial.order for trial in trials]


def test_a_trial_beside_a_longer_one_begins_the_same():
    trial = noisy_trials()[1]
    longer = replace(trial, perturbation=Multisine.draw(seed=9, rms=1.0, duration=0.7, crested=False))
    alone = run_experiment([trial], ENVIRONMENT, instruments=Instruments())
    beside = run_experiment([trial, longer], ENVIRONMENT, instruments=Instruments())
    n, n_emg = alone.sizes["time"], alone.sizes["emg_time"]
    beside = beside.isel(trial=[0], time=slice(n), emg_time=slice(n_emg))
    for name in ("perturbation", "force", "displacement", "joint_angle", "emg"):
        np.testing.assert_array_equal(beside[name].values, alone[name].values)


def test_noise_at_zero_is_no_noise_to_the_last_bit():
    trials = mixed_trials()
    silent = [replace(trial, noise=HumanNoise(), seed=3) for trial in trials]
    assert run_experiment(silent, ENVIRONMENT).identical(run_experiment(trials, ENVIRONMENT))


@pytest.mark.slow(reason="nineteen experiments")
def test_every_kind_of_noise_moves_the_arm_by_its_seed():
    still = mixed_trials()[1]
    ideal = run_experiment([still], ENVIRONMENT)
    for setting in ("remnant_share", "remnant_floor", "voluntary_share", "fast_share", "spread_k", "spread_kv"):
        noise = HumanNoise(**{setting: 0.5})
        first, again, other = (
            run_experiment([replace(still, noise=noise, seed=seed)], ENVIRONMENT) for seed in (1, 1, 2)
        )
        assert first.identical(again)
        assert not first["displacement"].equals(ideal["displacement"])
        assert not first["displacement"].equals(other["displacement"])
        assert first["perturbation"].equals(ideal["perturbation"])


def test_trials_of_a_person_near_instability_keep_half_of_the_margin():
    noise = HumanNoise(spread_b=0.3, spread_kv=0.3, spread_kp=0.3)
    trial = Trial(subject=POSITION, perturbation=small_multisine(1.0), noise=noise)
    bound = largest_real_pole(POSITION, ENVIRONMENT) / 2
    poles = [largest_real_pole(subject_in(replace(trial, seed=seed), ENVIRONMENT), ENVIRONMENT) for seed in range(200)]
    assert max(poles) <= bound
    assert np.std(poles) > 0


def test_a_person_too_fast_for_the_step_in_one_trial_is_simulated_at_a_smaller_one():
    # Otherwise it would diverge, and be reported as a trial that reached the workspace limit.
    wild = HumanNoise(spread_b=0.6)
    trials = [Trial(subject=POSITION, perturbation=small_multisine(1.0), noise=wild, seed=seed) for seed in range(60)]
    poles = np.array([fastest_pole(subject_in(trial, ENVIRONMENT), ENVIRONMENT) for trial in trials])
    slow, fast = trials[int(np.argmin(poles))], trials[int(np.argmin(np.abs(poles - 1500.0)))]
    assert 1000.0 < fastest_pole(subject_in(fast, ENVIRONMENT), ENVIRONMENT) < 2000.0
    for engine in ("mujoco", "compiled"):
        both = run_experiment([slow, fast], ENVIRONMENT, engine=engine)["displacement"].values
        finer = run_experiment([fast], ENVIRONMENT, timestep=1.25e-3, engine=engine)["displacement"].values[0]
        np.testing.assert_allclose(both[1], finer, rtol=0, atol=1e-4 * np.abs(finer).max())


@pytest.mark.slow(reason="trials of three conditions, and fits of one")
def test_people_are_as_noisy_as_the_thesis_describes():
    person, n = average_person(), 4
    forces = {"PT2.5": 1.2, "PT7.5": 5.4, "RT7.5": 0.9}
    trials = [
        Trial(
            subject=at_level(person.subjects[name[:2]], person.levels.get(name, 1.0)),
            perturbation=Multisine.draw(seed=seed, rms=rms, duration=8.0 + MULTISINE_PERIOD, crested=False),
            seed=seed + 1000 * round(10 * rms),
            noise=HUMAN_NOISE[name[:2]],
        )
        for name, rms in forces.items()
        for seed in range(n)
    ]
    instruments = Instruments(emg=None)
    recording = run_experiment(trials, ENVIRONMENT, timestep=2.5e-3, engine="compiled", instruments=instruments)
    coherence = {}
    for number, name in enumerate(forces):
        spectra = [estimate_spectra(line_spectra(recording.isel(trial=[number * n + i]))) for i in range(n)]
        coherence[name] = np.mean([s.coherence for s in spectra], axis=0)
    slow, middle = spectra[0].frequency < 1.5, (spectra[0].frequency >= 1.5) & (spectra[0].frequency < 10.0)
    # As `HUMAN_NOISE` has it of other multisines; its mean varies by 0.02 between sets of four trials.
    for name, expected in {"PT2.5": (0.84, 0.78), "PT7.5": (0.90, 0.82), "RT7.5": (0.95, 0.84)}.items():
        assert [coherence[name][band].mean() for band in (slow, middle)] == pytest.approx(expected, abs=0.05), name
    # Tables C.12, E.5: 61 and 50 % (SD over trials 10 and 17 %).
    vaf = fit_trials(recording.isel(trial=slice(n, n + 2)), "3b").vaf.mean(axis=0)
    assert vaf[0] == pytest.approx(61.0, abs=2 * 10.0)
    assert vaf[1] == pytest.approx(50.0, abs=2 * 17.0)


@pytest.mark.slow(reason="traces the memory of ten trials")
def test_memory_grows_by_the_recording_not_by_the_steps():
    trials = [replace(noisy_trials()[0], perturbation=small_multisine(3.0), seed=seed) for seed in range(10)]
    run_experiment(trials[:1], ENVIRONMENT, instruments=Instruments())  # what is imported on first use counts not
    tracemalloc.start()
    try:
        run_experiment(trials, ENVIRONMENT, instruments=Instruments())
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # At this, 96 trials of 36 s take 0.7 GB: force and noise held over each step, EMG, and the other signals.
    assert peak / (10 * 3000) < 200


@pytest.mark.parametrize(
    ("trials", "options", "message"),
    [
        ([], {}, "trials is empty"),
        (
            [
                Trial(
                    subject=replace(POSITION, kv_s=60.0),
                    perturbation=Pulse(peak=1, direction_deg=0, onset=0, duration=1),
                )
            ],
            {},
            "'position' and the environment are unstable: largest real part of a pole = .* expected below 0",
        ),
        (
            [
                Trial(
                    subject=RELAX,
                    perturbation=Sampled(
                        force=np.sin(2 * np.pi * 190 / 2000 * np.arange(4000))[:, None] * [1, 1], rate=2000
                    ),
                )
            ],
            {},
            "highest significant frequency = .*; expected at most 180 Hz",
        ),
        (
            [Trial(subject=replace(RELAX, b_h=5000.0), perturbation=small_multisine(1.0))],
            {},
            "fastest pole of arm and environment = .*; expected at most 4000 1/s at a step of 0.000625 s",
        ),
        ([Trial(subject=RELAX, perturbation=Sampled(force=np.ones((3, 2)), rate=1e-4))], {}, "at most 3600"),
        (
            [Trial(subject=RELAX, perturbation=Sampled(force=np.ones((3, 2)), rate=1e6))],
            {},
            "duration .* at least 0.01",
        ),
        (
            mixed_trials()[:1],
            {"rate": 160.0},
            r"rate = 160.0 Hz; expected .* 400 Hz over a whole number \(the option timestep = 0.00208333333333 goes",
        ),
        (mixed_trials()[:1], {"timestep": 0.0}, "timestep = 0.0; expected a finite number above 0"),
        (mixed_trials()[:1], {"timestep": 0.0125, "rate": 80.0}, "expected at most 36 Hz"),
        (mixed_trials()[:1], {"rope": "steel"}, "rope = 'steel'; expected one of ideal, pendulum"),
        ([Trial(subject=replace(RELAX, Td_s=5e-4), perturbation=small_multisine(1.0))], {}, "Td_s = 0.0005; expected"),
        (
            mixed_trials()[:1],
            {"rate": 100.0, "instruments": Instruments()},
            "antialias = 80.0; expected a finite number above 0 and below 50",
        ),
    ],
)
def test_bad_input_is_named(trials, options, message):
    with pytest.raises(ValueError, match=message):
        run_experiment(trials, ENVIRONMENT, **options)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"seed": -1}, ValueError, "Trial: seed = -1; expected a finite number at least 0"),
        ({"seed": "1"}, TypeError, "Trial: seed = '1'; expected a number"),
        ({"order": 1.5}, TypeError, "Trial: order = 1.5; expected a whole number"),
        ({"noise": 0.3}, TypeError, r"Trial: noise = 0.3; expected HumanNoise or None"),
        ({"subject": None}, TypeError, "Trial: subject = None; expected a Subject"),
        ({"perturbation": None}, TypeError, "Trial: perturbation = None; expected a perturbation, e.g. Multisine"),
        ({"condition": np.nan}, TypeError, "Trial: condition = nan; expected a text"),
        ({"condition": "a\nb"}, ValueError, "Trial: condition = .*; expected a text of at most 100 printable"),
        ({"repetition": -1}, ValueError, "Trial: repetition = -1; expected a finite number at least 0"),
        ({"pulse_level": np.nan}, ValueError, "Trial: pulse_level = nan; expected a finite number"),
    ],
)
def test_bad_trials_are_named(change, error, message):
    with pytest.raises(error, match=message):
        replace(mixed_trials()[0], **change)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_threads": -1}, "n_threads = -1; expected a finite number at least 0"),
        ({"n_threads": 1.5}, "n_threads = 1.5; expected a whole number"),
        ({"linear": "yes"}, "linear = 'yes'; expected True or False"),
        ({"environment": 5}, "environment = 5; expected Environment or None"),
        ({"instruments": True}, "instruments = True; expected Instruments or None"),
        ({"strap": 1.0}, "strap = 1.0; expected Strap or None"),
    ],
)
def test_options_of_another_type_are_named(options, message):
    with pytest.raises((TypeError, ValueError), match=f"run_experiment: {message}"):
        run_experiment(mixed_trials()[:1], **options)


def test_trials_come_from_any_iterable_and_are_trials():
    trial = Trial(subject=RELAX, perturbation=small_multisine(1.0))
    expected = run_experiment([trial], linear=True)
    for given in ((each for each in [trial]), trial):
        assert run_experiment(given, linear=True).identical(expected)
    for given, message in ((None, "trials = None; expected Trials"), ([trial, 1], "a trial = 1; expected a Trial")):
        with pytest.raises(TypeError, match=message):
            run_experiment(given)
    with pytest.raises(ValueError, match="trials is empty"):
        run_experiment(iter([]))
