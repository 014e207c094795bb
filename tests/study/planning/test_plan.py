"""Experiment design: information against time series and simulated records, optimum against certificates and rivals."""

import csv
import errno
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, signal, stats

from armperturb import cli
from armperturb.analysis.arm.linear_arm import total_admittance
from armperturb.analysis.arm.parameters import PARAMETERS
from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.identify import identify
from armperturb.analysis.fit.likelihood import TAPER
from armperturb.analysis.fit.maximum_likelihood import estimate
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.analysis.fit.truth import at_truth, true_values
from armperturb.analysis.force_balance import EDGE
from armperturb.analysis.results import LINES
from armperturb.analysis.smoother import NoiseLevels
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.muscle_law import MuscleLaw
from armperturb.perturbations import CLUSTERS, Multisine, Sampled, line_spectrum, load_perturbation, save_perturbation
from armperturb.perturbations.line_spectrum import draw_multisine
from armperturb.perturbations.multisine import PERIOD, PERIOD_SAMPLES
from armperturb.plots.style import new_figure
from armperturb.study.planning.information import Experiment, Limits, Noise, effective_duration, optimise
from armperturb.study.planning.plan import cluster_starts, design, displacements
from armperturb.study.planning.report import write_design
from armperturb.study.planning.settings import DesignSettings, noise_levels
from armperturb.study.planning.signals import experiment_at, proposed_signal
from armperturb.study.validation.validate import ValidateSettings
from armperturb.subject import POSITION, RELAX

LIMITS = {"force": 5.4, "displacement": 7.5e-3, "duration": 32.0}
REFLEX = DesignSettings(subject=POSITION, goal="reflex", **LIMITS, trials=2)
LIMIT_OPTIONS = ("--force", "5.4", "--displacement", "0.0075", "--duration", "32")
STRUCTURE = at_truth(STRUCTURES["3b"], POSITION)
RNG = np.random.default_rng(0)


@pytest.fixture(autouse=True, scope="module")
def quick():
    """Phases from one start: peaks are somewhat higher, and that is where the time goes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(line_spectrum, "N_STARTS", 1)
        yield


@pytest.fixture(scope="module")
def plan(once):
    return once("plan", lambda _: design(REFLEX))


def few(n_clusters=4, settings=REFLEX):
    """A small problem: the experiment at a few clusters of the thesis's multisine."""
    lines = CLUSTERS[2 :: 18 // n_clusters][:n_clusters]
    return experiment_at(settings, lines.ravel() / PERIOD), n_clusters


def criterion(experiment, power, names, demand=None):
    columns = [experiment.names.index(name) for name in names]
    return float(np.mean(np.log(experiment.standard_error(experiment.information(power, demand), 32.0)[columns])))


def moved(name, way):
    """The person with a parameter of the structure changed by a small step, and the step."""
    parts = STRUCTURE.mixing[:, STRUCTURE.free.index(name)]
    shares = {part: share for part, share in zip(PARAMETERS, parts, strict=True) if share}
    step = way * 1e-4 * sum(getattr(POSITION, part) for part in shares)
    return replace(POSITION, **{part: getattr(POSITION, part) + share * step for part, share in shares.items()}), step


def test_information_is_that_of_a_time_series_in_white_noise():
    frequency, level, silent = np.array([5, 30, 120, 400]) / PERIOD, 1e-4, np.zeros(4)
    # A useless gauge leaves the encoders' white noise.
    noise = Noise(silent, silent, NoiseLevels(force=1e6, displacement=level), 200.0)
    experiment = Experiment(POSITION, STRUCTURE, Environment(), frequency, noise)
    power = RNG.uniform(0.5, 2.0, (4, 2))
    phasors = np.sqrt(2.0 * power) * np.exp(1j * RNG.uniform(-np.pi, np.pi, (4, 2)))
    turns = np.exp(2j * np.pi * np.outer(np.arange(PERIOD_SAMPLES) / 200.0, frequency))

    def slope(name, way):
        paths = []
        for arm, step in (moved(name, 1.0), moved(name, -1.0)):
            total = total_admittance(arm, Environment(), frequency)
            paths.append((turns @ np.einsum("fij,fj->fi", total, phasors * [1.0, way])).real.ravel() / (2 * step))
        return paths[0] + paths[1]

    expected = np.zeros((13, 13))
    for way in (1.0, -1.0):  # y turned round: what x and y do together is not there on average
        rows = np.array([slope(name, way) for name in STRUCTURE.free])
        expected += 0.5 * rows @ rows.T / level**2
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(experiment.information(power) * PERIOD / scale, expected / scale, atol=1e-6)
    slopes = (turns @ experiment.answer(phasors)[1].reshape(len(frequency), -1)).real
    expected = np.stack([slope(name, 1.0) for name in STRUCTURE.free], axis=1)
    np.testing.assert_allclose(slopes.reshape(-1, 13), expected, atol=1e-7 * np.abs(expected).max())


def test_noise_is_what_a_person_at_rest_and_the_instruments_leave_in_a_record():
    # The handle unperturbed, but for a demand that the floor stands for.
    human = replace(HUMAN_NOISE["PT"], spread_b=0.0, spread_k=0.0, spread_kv=0.0, spread_kp=0.0)
    silence = replace(Multisine.draw(seed=0, rms=1e-9, crested=False), duration=250.0)
    trial = Trial(subject=POSITION, perturbation=silence, noise=human)
    recording = run_experiment([trial], linear=True, n_threads=1)
    frequency, spectrum = signal.csd(
        recording["displacement"].values[0].T[:, None], recording["displacement"].values[0].T[None], 200.0, nperseg=2048
    )
    used = (frequency > 0.5) & (frequency < 6.0)
    floor = human.torque_spectrum(np.zeros(2), 1e-3, frequency[used])[:, 0]
    noise = Noise(floor, np.zeros_like(floor), NoiseLevels(1e6, 1e-12), 200.0)
    experiment = Experiment(POSITION, STRUCTURE, Environment(), frequency[used], noise)
    expected = experiment.noise(np.zeros(2))
    ratio = np.moveaxis(spectrum, -1, 0)[used] / expected.conj()
    for row, column in ((0, 0), (1, 1), (0, 1)):
        assert np.mean(ratio[:, row, column].real) == pytest.approx(1.0, abs=0.06)


def test_torque_spectrum_is_that_of_the_drawn_torque_and_holds_its_power():
    human, demand = HUMAN_NOISE["PT"], np.array([1.0, 3.0])
    torque = human.torque(demand, 1e-2, 400_000, np.random.default_rng(1))
    frequency, spectrum = signal.welch(torque, 100.0, nperseg=2048, axis=0)
    used = (frequency > 0.1) & (frequency < 5.0)
    expected = human.torque_spectrum(demand, 1e-2, frequency[used])
    assert np.mean(spectrum[used] / expected, axis=0) == pytest.approx([1.0, 1.0], abs=0.03)
    fine = np.linspace(0.0, 50.0, 50_001)
    power = human.torque_spectrum(demand, 1e-2, fine)
    assert np.trapezoid(power, fine, axis=0) == pytest.approx(sum(rms**2 for rms in human.rms(demand)), rel=1e-3)


def test_encoders_leave_the_noise_that_their_counts_make():
    path = RNG.uniform(-5e-3, 5e-3, (100_000, 2))
    error = Instruments().read_displacement(path) - path
    assert noise_levels(Instruments()).displacement == pytest.approx(np.sqrt(np.mean(error**2)), rel=0.02)


def test_effective_duration_is_that_of_the_taper():
    rate, duration = 1000.0, 32.0
    n_taper = round(TAPER * rate)
    weights = np.ones(round((duration - EDGE) * rate))
    weights[-n_taper:] = 0.5 + 0.5 * np.cos(np.pi * (np.arange(n_taper) + 0.5) / n_taper)
    expected = np.sum(weights**2) ** 2 / np.sum(weights**4) / rate
    assert effective_duration(duration) == pytest.approx(expected, rel=1e-6)


def test_noise_rises_with_the_demand_as_its_slope_says():
    experiment, _ = few()
    power = RNG.uniform(0.5, 1.0, (16, 2))
    demand = np.array([2.0, 3.0])
    slopes = experiment.slopes(power, demand)
    for joint, step in enumerate(1e-4 * np.eye(2)):
        up, down = (np.einsum("fa,faij->ij", power, experiment.parts(demand + way * step)) for way in (1, -1))
        np.testing.assert_allclose(slopes[joint], (up - down) / 2e-4, rtol=1e-5, atol=1e-9 * np.abs(slopes).max())


@pytest.mark.slow(reason="optimises by a general method")
@pytest.mark.parametrize("held", [np.array([3.0, 2.0]), None], ids=["held", "follows"])
@pytest.mark.parametrize("limits", [Limits(5.4, 1.0), Limits(5.4, 4e-3)], ids=["force", "displacement"])
def test_optimum_is_that_of_a_general_method_and_keeps_the_limits(limits, held):
    experiment, n_clusters = few()
    goal = REFLEX.wanted()
    found = optimise(experiment, n_clusters, goal, limits, 0.0, held)

    def power_of(share):
        return limits.force**2 * np.repeat(share.reshape(2, n_clusters).T / 4.0, 4, axis=0)

    def room(share):
        power = power_of(share)
        parts = [power.sum(axis=0) / limits.force**2, experiment.displacement(power) / limits.displacement**2]
        return 1.0 - np.concatenate(parts + ([] if held is None else [experiment.demand(power) / held]))

    rival = optimize.minimize(
        lambda share: criterion(experiment, power_of(np.maximum(share, 1e-9)), goal, held),
        0.05 * np.random.default_rng(0).dirichlet(np.ones(2 * n_clusters)),
        method="SLSQP",
        bounds=[(0.0, None)] * (2 * n_clusters),
        constraints=[{"type": "ineq", "fun": room}],
        options={"maxiter": 200},
    )
    assert criterion(experiment, found.power, goal, held) == pytest.approx(rival.fun, abs=1e-3)
    assert 0.0 <= found.excess < 1e-3
    assert (found.power.sum(axis=0) <= limits.force**2).all()
    assert (experiment.displacement(found.power) <= limits.displacement**2).all()
    if held is not None:
        assert (experiment.demand(found.power) <= held).all()


def test_each_axis_has_a_hundredth_of_the_power_of_the_other():
    settings = replace(REFLEX, goal="grip", model="1", noise="follows")
    experiment, n_clusters = few(6, settings)
    limits = Limits(settings.force, settings.displacement)
    optimum = optimise(experiment, n_clusters, settings.wanted(), limits, settings.spread)
    force = optimum.power.sum(axis=0)  # without that limit 7.5 mN along x
    assert 0.01 * (1 - 1e-9) <= force.min() / force.max() < 0.0101
    assert 0.0 <= optimum.excess < 1e-4


@pytest.mark.slow(reason="optimises multisines")
def test_no_random_rival_within_the_limits_is_better(plan):
    experiment = experiment_at(REFLEX, plan.optimised.frequency)
    n_clusters = len(cluster_starts())
    assert len(plan.optimised.frequency) == 4 * n_clusters
    usual = experiment_at(REFLEX, CLUSTERS.ravel() / PERIOD)
    held = usual.demand(plan.thesis.power)
    best = optimise(experiment, n_clusters, REFLEX.wanted(), Limits(LIMITS["force"], LIMITS["displacement"]), 0.0, held)
    least = criterion(experiment, best.power, REFLEX.wanted(), held)
    assert 0.0 <= best.excess < 1e-3
    rng = np.random.default_rng(0)
    for _ in range(40):
        rival = np.repeat(rng.dirichlet(np.full(n_clusters, 0.05), 2).T / 4.0, 4, axis=0)
        rival *= LIMITS["force"] ** 2 * rng.uniform(0.2, 1.0, 2)
        rival = 0.5 * rival + 0.5 * best.power * rng.uniform(0.0, 1.0)  # half of them near the optimum
        rival /= max(
            1.0,
            experiment.displacement(rival).max() / LIMITS["displacement"] ** 2,
            rival.sum(axis=0).max() / LIMITS["force"] ** 2,
        )
        assert criterion(experiment, rival, REFLEX.wanted(), held) > least - 1e-3
    # What is spread over the band costs a little.
    assert least < criterion(experiment, plan.optimised.power, REFLEX.wanted(), held) < least + 0.1


@pytest.mark.slow(reason="optimises multisines")
def test_the_plan_banks_on_no_quieter_person(plan):
    usual = experiment_at(REFLEX, CLUSTERS.ravel() / PERIOD)
    best = experiment_at(REFLEX, plan.optimised.frequency)
    demand = usual.demand(plan.thesis.power)
    assert (best.demand(plan.optimised.power) <= demand * (1 + 1e-9)).all()
    expected = best.standard_error(best.information(plan.optimised.power, demand), 32.0, REFLEX.trials)
    np.testing.assert_allclose(plan.optimised.standard_error["held"], expected)
    np.testing.assert_array_equal(plan.thesis.standard_error["held"], plan.thesis.standard_error["follows"])
    banking = design(replace(REFLEX, noise="follows", trials=1))
    assert banking.factor < plan.factors["follows"] <= plan.factors["held"] < banking.factors["held"]
    assert plan.factor == plan.factors["held"]
    assert banking.factor == banking.factors["follows"]
    assert "Remarks" not in plan.summary()
    # The thesis's multisine in the place of the optimised one is worse than that.
    worse = replace(plan, thesis=plan.optimised, optimised=plan.thesis).summary()
    assert "- the optimised multisine is worse than the thesis's if the noise follows" in worse


def test_realisations_keep_the_limits_and_the_spectrum(plan):
    for row in plan.signal_frame().to_dict("records"):
        expected = plan.optimised.displacement["xy".index(row["axis"])]
        assert row["rms_force_N"] <= LIMITS["force"] * (1 + 1e-9)
        assert row["rms_displacement_m"] <= LIMITS["displacement"] * (1 + 1e-9)
        # No realisation is far from the mean over phases.
        assert row["rms_displacement_m"] == pytest.approx(expected, rel=0.02)
        assert row["peak_force_N"] < 2.0 * row["rms_force_N"]
    axis_power = plan.optimised.power.sum(axis=0)
    clusters = plan.optimised.power.reshape(-1, 4, 2).sum(axis=1)
    assert (clusters >= 0.2 * axis_power / len(clusters) * (1 - 1e-9)).all()
    for perturbation in plan.perturbations:
        spectrum = np.fft.rfft(perturbation.force[:PERIOD_SAMPLES], axis=0) / PERIOD_SAMPLES
        power = 2.0 * np.abs(spectrum[np.rint(plan.optimised.frequency * PERIOD).astype(int)]) ** 2
        np.testing.assert_allclose(power, plan.optimised.power, atol=1e-8 * axis_power.max())
    assert not np.allclose(plan.perturbations[0].force, plan.perturbations[1].force, atol=0.1)


@pytest.mark.parametrize("manipulator", [REFLEX.manipulator, (1.0, 20.0, 0.0)])
def test_displacements_are_those_of_the_simulated_arm(plan, manipulator):
    settings, played = replace(REFLEX, manipulator=manipulator), plan.perturbations[0]
    recording = run_experiment(
        [Trial(subject=POSITION, perturbation=played)], settings.environment, linear=True, n_threads=1
    ).sel(time=slice(8.0, 8.0 + PERIOD - 0.001))
    expected = np.sqrt(np.mean(recording["displacement"].values[0] ** 2, axis=0))
    np.testing.assert_allclose(displacements(settings, played), expected, rtol=2e-3)
    on_average = experiment_at(settings, plan.optimised.frequency).displacement(plan.optimised.power)
    np.testing.assert_allclose(np.sqrt(on_average), expected, rtol=0.07)  # mean over phases


@pytest.mark.slow(reason="optimises multisines")
def test_a_limit_of_the_peak_binds_both_signals(plan):
    weak = design(replace(REFLEX, peak=5.0, trials=1))
    assert weak.signal_frame()["peak_force_N"].max() == pytest.approx(5.0)
    for name in ("thesis", "optimised"):
        assert (getattr(weak, name).power.sum(axis=0) < getattr(plan, name).power.sum(axis=0)).all()


@pytest.mark.slow(reason="optimises multisines")
def test_a_plan_under_a_limit_of_the_peak_is_as_good_whatever_force_is_allowed(tmp_path, blank_pictures):
    relaxed = DesignSettings(
        subject=RELAX, goal="intrinsic", force=0.9, displacement=0.01, duration=32.0, trials=1, peak=1.0
    )
    strong, weak = (design(replace(relaxed, force=force)) for force in (0.9, 0.6))
    assert strong.factor < 1.02 * weak.factor
    moved = [each.signal_frame()["rms_displacement_m"].max() for each in (strong, weak)]
    assert min(moved) > 0.98 * relaxed.displacement
    assert 0.0 <= weak.excess < 1e-3  # the force binds, and the peak does not
    assert strong.excess is None
    assert "the limit of the largest force binds" in strong.summary()
    write_design(strong, tmp_path)
    assert json.loads((tmp_path / "settings.json").read_text())["excess"] is None


@pytest.mark.slow(reason="optimises multisines")
def test_simulated_records_hold_the_predicted_information_and_estimates_scatter_by_it(plan):
    """Both signals: the records' own Fisher information, and a chi2 of the estimates' errors."""
    structure = ValidateSettings(model="3b").structure()
    human = replace(HUMAN_NOISE["PT"], spread_b=0.0, spread_k=0.0, spread_kv=0.0, spread_kp=0.0)
    thesis = [Multisine.draw(seed=seed, rms=5.4, duration=32.0, crested=False) for seed in (0, 1)]
    held = []
    for played, lines in ((plan.perturbations, plan.optimised), (thesis, plan.thesis)):
        experiment = experiment_at(REFLEX, lines.frequency)
        predicted = experiment.information(lines.power) * effective_duration(32.0) * 2
        ratios, distance, groups = [], 0.0, 2
        for group in range(groups):
            trials = [
                Trial(subject=POSITION, perturbation=one, repetition=n, seed=10 * group + n, noise=human)
                for n, one in enumerate(played)
            ]
            recording = run_experiment(
                trials, linear=True, instruments=Instruments(marker_noise=None, emg=None), n_threads=1
            )
            prepared = Group.prepare(recording, structure)
            values = structure.parameters("PT", plan.truth)
            (record,) = prepared.records
            record.weigh(values)
            information = record.normal(values, structure.mixing).information
            ratios.append(np.sqrt(np.diag(np.linalg.inv(information))) / lines.standard_error["follows"])
            error = np.array([*estimate([prepared]).values.values()]) - plan.truth
            distance += error @ predicted @ error
        # Two realisations only, whose x and y are not quite orthogonal, and a noise that is estimated from them.
        assert np.mean(ratios, axis=0) == pytest.approx(np.ones(13), abs=0.15)
        held.append(np.mean(ratios, axis=0) * lines.standard_error["follows"])
        low, high = stats.chi2.ppf([1e-3, 1 - 1e-3], 13 * groups)
        assert low < distance < high
    columns = [plan.names.index(name) for name in REFLEX.wanted()]
    assert np.exp(np.mean(np.log(held[0] / held[1])[columns])) == pytest.approx(plan.factors["follows"], rel=0.1)


@pytest.mark.slow(reason="lowers the peaks of multisines")
def test_draw_multisine_refuses_and_repeats():
    lines, power = np.array([5, 6, 7]), np.ones((3, 2))
    first, again = (draw_multisine(lines, power, seed=3, duration=1.0).force for _ in range(2))
    assert np.array_equal(first, again)
    louder = draw_multisine(lines, 4.0 * power, seed=3, duration=1.0).force
    np.testing.assert_allclose(louder, 2.0 * first, atol=1e-12)
    for bad, words in (
        ((np.array([5, 5, 6]), power), "distinct"),
        ((lines / 1.0, power), "whole"),
        ((lines, power[:2]), "shape"),
        ((lines, -power), "at least 0"),
        ((lines, power * [1.0, 0.0]), "axis is zero"),
        ((lines * 200, power), "1 to 1023"),
    ):
        with pytest.raises(ValueError, match=words):
            draw_multisine(*bad, seed=0, duration=1.0)
    with pytest.raises(ValueError, match="duration"):
        draw_multisine(lines, power, seed=0, duration=0.0)
    with pytest.raises(ValueError, match="n_period = 8192"):
        draw_multisine(lines, power, seed=0, duration=1.0, n_period=8192)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"goal": "reflexes"}, "goal = 'reflexes'; expected one of reflex, intrinsic, grip, mass, all"),
        ({"goal": "grip"}, "model 3b leaves none of these"),
        ({"goal": "reflex", "subject": RELAX}, "'relax' no reflexes"),
        ({"force": -5.4, "displacement": 7.5e-3, "duration": 32.0}, "force"),
        ({"force": 5.4, "displacement": 0.0, "duration": 32.0}, "displacement"),
        ({"force": 5.4, "displacement": 7.5, "duration": 32.0}, "at most 0.1"),
        ({"force": 1e300, "displacement": 7.5e-3, "duration": 32.0}, "force.*at most 1000"),
        ({"force": 1e-300}, "force.*at least 0.001"),
        ({"force": 5.4, "displacement": float("nan"), "duration": 32.0}, "displacement"),
        ({"force": 5.4, "displacement": 1e-7, "duration": 32.0}, "displacement.*at least the noise of the encoders"),
        ({"force": 5.4, "displacement": 7.5e-3, "duration": 9.0}, "duration.*at least 9.12"),
        ({"force": 5.4, "displacement": 7.5e-3, "duration": 1e5}, "duration.*at most 3600"),
        ({"model": "7"}, "model = '7'"),
        ({"trials": 0}, "trials = 0"),
        ({"trials": 10**6}, "trials = 1000000"),
        ({"noise": "none"}, "noise = 'none'; expected one of held, follows"),
        (
            {"perturbation": Multisine.draw(seed=0, rms=1.0, duration=5.0, crested=False)},
            "duration of the perturbation.*9.12",
        ),
        ({"peak": 0.0}, "peak.*= 0"),
        ({"spread": 1.5}, "spread = 1.5"),
        ({"seed": -1}, "seed = -1"),
        ({"manipulator": (3.0, 0.5)}, r"manipulator = \(3.0, 0.5\); expected mass, damping and stiffness"),
        ({"manipulator": (0.0, 0.5, 20.0)}, "m_env = 0"),
        ({"subject": replace(POSITION, kv_s=1e3)}, "unstable"),
    ],
)
def test_bad_settings_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        replace(REFLEX, **change)


@pytest.mark.parametrize(("duration", "period"), [(9.12, 5.12), (14.24, 10.24), (24.48, 20.48)])
def test_a_trial_may_be_as_short_as_messages_say(duration, period):
    assert replace(REFLEX, duration=duration).period == period


@pytest.mark.slow(reason="searches for a design")
def test_limits_of_very_different_sizes_are_kept():
    plan = design(replace(REFLEX, trials=1, force=1e3, displacement=1e-5, duration=32.0))
    assert 0.0 <= plan.excess < 1e-3
    assert plan.factor < 1.0


@pytest.mark.parametrize(("duration", "period", "start"), [(10.0, 5.12, 4.88), (21.0, 10.24, 8.0), (60.0, 20.48, 8.0)])
def test_a_period_fits_into_the_duration(duration, period, start):
    settings = replace(REFLEX, force=5.4, displacement=7.5e-3, duration=duration)
    assert (settings.period, settings.start) == (period, pytest.approx(start))
    starts = cluster_starts(period)
    frequency = starts / period
    assert CLUSTERS[0, 0] / PERIOD <= frequency[0] < 0.4
    assert frequency[-1] + 3 / period <= CLUSTERS[-1, -1] / PERIOD
    assert (np.diff(starts) >= 7).all()


@pytest.mark.slow(reason="optimises multisines")
def test_a_short_plan_can_be_identified():
    plan = design(replace(REFLEX, force=5.4, displacement=7.5e-3, duration=10.0, trials=1))
    assert plan.factor < 1.0
    played = plan.perturbations[0]
    assert played.duration == 10.0
    n_period = round(5.12 * 200.0)
    np.testing.assert_allclose(played.force[n_period:], played.force[: len(played.force) - n_period], atol=1e-12)
    recording = run_experiment([Trial(subject=POSITION, perturbation=played)], linear=True, n_threads=1)
    found = identify(recording, "3b", window_start=plan.settings.start, period=plan.settings.period)
    for name in ("k_e", "kv_e"):
        assert found.fit.values[name] == pytest.approx(getattr(POSITION, name), rel=0.02)


@pytest.mark.slow(reason="optimises multisines")
def test_a_proposed_perturbation_is_told_beside(plan):
    """Five phases of the thesis's multisine tell as much as its powers say on average."""
    squares = []
    for seed in range(5):
        # Whole periods, so that its lines are the signal's.
        one = Multisine.draw(seed=seed, rms=5.4, duration=2 * PERIOD, crested=False)
        told = proposed_signal(replace(REFLEX, perturbation=one), np.zeros(2))
        squares.append(told.standard_error["follows"] ** 2)
    share = effective_duration(2 * PERIOD) / effective_duration(32.0)
    expected = plan.thesis.standard_error["follows"] / np.sqrt(share)
    np.testing.assert_allclose(np.sqrt(np.mean(squares, axis=0)), expected, rtol=0.1)


TIME = np.arange(6400) / 200.0


def proposed(force, **changes):
    """What a person who relaxes is told by a force (time, axis), and that force."""
    settings = DesignSettings(subject=RELAX, goal="intrinsic", force=0.9, displacement=7.5e-3, duration=32.0, trials=4)
    played = Sampled(force=force, rate=200.0)
    return proposed_signal(replace(settings, perturbation=played, **changes), np.zeros(2)), played


@pytest.mark.slow(reason="identifies simulated trials")
def test_steps_that_are_held_tell_as_much_as_their_records():
    """The end of the record is no jump back, and the constant force makes the person noisier."""
    steps = 6.0 * np.stack([np.clip((TIME - onset) / 0.1, 0.0, 1.0) for onset in (2.0, 12.0)], axis=1)
    signal, played = proposed(steps)
    assert not signal.refusal
    np.testing.assert_allclose(signal.force, np.sqrt(np.mean(steps**2, axis=0)))
    human = replace(HUMAN_NOISE["RT"], spread_b=0.0, spread_k=0.0)
    trials = [Trial(subject=RELAX, perturbation=played, repetition=n, seed=n, noise=human) for n in range(4)]
    recording = run_experiment(trials, linear=True, instruments=Instruments(marker_noise=None, emg=None), n_threads=1)
    moved = np.sqrt(np.mean(recording["displacement"].values ** 2, axis=(0, 1)))
    np.testing.assert_allclose(signal.displacement, moved, rtol=0.15)  # the person moves as well
    structure = at_truth(STRUCTURES["1"], RELAX)
    values = structure.parameters("RT", true_values(RELAX, structure))
    (record,) = Group.prepare(recording, structure).records
    record.weigh(values)
    of_record = np.sqrt(np.diag(np.linalg.inv(record.normal(values, structure.mixing).information)))
    np.testing.assert_allclose(signal.standard_error["follows"], of_record, rtol=0.35)
    ratio = np.exp(np.mean(np.log(signal.standard_error["follows"] / of_record)))
    assert ratio == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow(reason="plans twice")
def test_what_a_proposal_tells_does_not_depend_on_how_it_would_go_on():
    tones = ((1.0, 3.1), (1.7, 4.3))
    slow = np.stack([sum(np.sin(2 * np.pi * tone * TIME + 0.5) for tone in of_axis) for of_axis in tones], axis=1)
    # Their ends differ by up to 2.6 N from their starts. Longer records tell more, by so little as a second can.
    errors = np.array([proposed(slow[: round(200 * s)])[0].standard_error["follows"] for s in (10.0, 10.5, 11.0, 12.0)])
    ratio = errors[1:] / errors[:-1]
    assert (ratio < 1.01).all()
    assert (ratio > 0.9).all()


@pytest.mark.slow(reason="plans and identifies")
def test_a_proposal_that_identify_refuses_is_remarked_upon(plan):
    rising, _ = proposed(np.outer(TIME / 32.0, [6.0, 3.0]))
    assert "not independent" in rising.refusal
    column = STRUCTURES["1"].free.index("k_e")
    assert rising.standard_error["follows"][column] > RELAX.k_e  # as a record that repeats 2 % of it
    noise = RNG.standard_normal((6400, 1))
    for axes in ([1.0, 0.0], [1.0, 1.0]):
        assert "not independent" in proposed(noise * axes)[0].refusal
    remarks = replace(plan, proposed=plan.thesis._replace(refusal=rising.refusal)).describe().remarks
    assert remarks[0].startswith("identify refuses recordings of the proposed perturbation alone")


def test_a_proposal_that_tells_nothing_is_refused():
    still = Sampled(force=np.zeros((6400, 2)), rate=200.0)
    with pytest.raises(ValueError, match="perturbation: "):
        proposed_signal(replace(REFLEX, perturbation=still), np.ones(2))


def test_a_person_whom_the_model_cannot_be_is_remarked_upon(plan, tmp_path, blank_pictures):
    assert plan.describe().remarks == ()
    person = replace(POSITION, m_h=2.0, k_h=20e3, muscle=MuscleLaw())
    of_other = replace(plan, settings=replace(REFLEX, subject=person))
    write_design(of_other, tmp_path)
    remarks = of_other.describe().remarks
    assert json.loads((tmp_path / "settings.json").read_text())["remarks"] == list(remarks)
    starts = ("model 3b is not exact for 'position': m_h", "identify --model 3b fixes k_h", "no model has the [muscle]")
    assert all(remark.startswith(start) for remark, start in zip(remarks, starts, strict=True))


def test_what_cannot_be_told_is_named():
    # Without gains, delays and cut-offs change nothing.
    with pytest.raises(ValueError, match="Td_s, Td_e, fact_s, fact_e cannot be identified"):
        design(DesignSettings(subject=RELAX, goal="reflex", **LIMITS, model="3"))


@pytest.mark.slow(reason="optimises multisines")
def test_reflexes_that_are_not_there_can_be_looked_for():
    found = design(
        DesignSettings(subject=RELAX, goal="reflex", force=0.9, displacement=0.01, duration=32.0, model="3b", trials=1)
    )
    assert found.factor < 1.0
    assert not found.truth[[found.names.index(name) for name in found.settings.wanted()]].any()


@pytest.mark.slow(reason="optimises multisines")
def test_the_command_writes_what_simulate_plays(tmp_path, capsys):
    POSITION.save(tmp_path / "subject.toml")
    arguments = ["--subject", str(tmp_path / "subject.toml"), "--goal", "reflex", *LIMIT_OPTIONS]
    out = tmp_path / "plan"
    (out / "perturbations").mkdir(parents=True)
    (out / "perturbations" / "trial_09.csv").write_text("of an earlier plan")
    (out / "settings.json").write_text('{"factor_noise_held": 1.0}')
    save_perturbation(Multisine.draw(seed=0, rms=2.0, crested=False), tmp_path / "own.csv", 200.0)
    own = ["--perturbation", str(tmp_path / "own.csv")]
    assert cli.main(["design", *arguments, *own, "--trials", "2", "--out", str(out)]) == 1
    assert "trial_09.csv: exists already" in capsys.readouterr().err
    light = ["--manipulator", "2.5", "0.5", "20"]
    assert cli.main(["design", *arguments, *own, *light, "--trials", "2", "--out", str(out), "--overwrite"]) == 0
    said = capsys.readouterr().out
    assert "manipulator: 2.5 kg, 0.5 Ns/m, 20 N/m" in said
    assert "kv_se" in said
    assert "with the noise held" in said
    assert "proposed: RMS force x, y" in said
    with (out / "tables" / "design.csv").open() as file:
        rows = {row["parameter"]: row for row in csv.DictReader(file)}
    assert set(rows) == set(STRUCTURE.free)
    ratios = [float(row["ratio"]) for row in rows.values() if row["goal"] == "1"]
    made = json.loads((out / "settings.json").read_text())
    assert made["factor"] == pytest.approx(np.exp(np.mean(np.log(ratios))))
    assert made["settings"]["subject"]["kv_s"] == POSITION.kv_s
    assert made["settings"]["manipulator"] == [2.5, 0.5, 20.0]
    assert made["factor"] == made["factor_noise_held"]
    assert all(float(row["sem_proposed"]) > float(row["sem_optimised"]) for row in rows.values())
    assert (out / "figures" / "design.svg").read_text().startswith("<?xml")
    assert sorted(path.name for path in (out / "perturbations").iterdir()) == ["trial_01.csv", "trial_02.csv"]
    played = load_perturbation(out / "perturbations" / "trial_01.csv")
    assert np.sqrt(np.mean(played.force[:PERIOD_SAMPLES] ** 2, axis=0)).max() <= 5.4 * (1 + 1e-9)


def test_perturbations_of_somebody_else_are_neither_replaced_nor_removed(tmp_path, capsys):
    own = tmp_path / "perturbations" / "trial_01.csv"
    own.parent.mkdir()
    own.write_text("of an experiment")
    (tmp_path / "settings.json").write_text("{}")
    POSITION.save(tmp_path / "person.toml")
    options = ["--subject", str(tmp_path / "person.toml"), *LIMIT_OPTIONS, "--goal", "reflex"]
    assert cli.main(["design", *options, "--out", str(tmp_path), "--overwrite"]) == 1
    assert "trial_01.csv: is of no earlier plan" in capsys.readouterr().err
    assert own.read_text() == "of an experiment"


@pytest.mark.slow(reason="optimises multisines")
def test_a_plan_that_fails_leaves_that_of_before(tmp_path, plan, monkeypatch, blank_pictures):
    write_design(plan, tmp_path)
    more = tmp_path / "perturbations" / "trial_99.csv"
    more.write_text("of a plan with more trials")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("armperturb.study.planning.report.save_plot", full)
    with pytest.raises(OSError, match="No space"):
        write_design(plan, tmp_path)
    assert more.exists()


def test_a_plan_reads_as_a_table_and_plots(plan):
    assert len(repr(plan).splitlines()) <= LINES
    frame = plan.to_frame()
    lines = {line.split()[0].rstrip("*"): line for line in plan.summary().splitlines() if line}
    for row in frame.to_dict("records"):
        assert f"{100.0 * row['sem_optimised'] / abs(row['value']):.3g} %" in lines[row["parameter"]]
    assert "<table>" in plan._repr_html_()
    array = plan.to_xarray()
    optimised = array.sel(signal="optimised")
    np.testing.assert_array_equal(optimised["power"].dropna("frequency"), plan.optimised.power)
    np.testing.assert_array_equal(optimised["standard_error"].sel(noise="held"), frame["sem_noise_held"])
    axes = plan.plot(figure=new_figure(1.0))
    assert axes.shape == (2, 2)
    spectrum = axes[1, 0].get_lines()[1]
    shown = plan.optimised.power[:, 0] > 1e-5 * plan.optimised.power[:, 0].max()
    np.testing.assert_allclose(spectrum.get_ydata(), np.sqrt(plan.optimised.power[shown, 0]))
    assert len(plan.spectrum_frame()) == len(plan.thesis.frequency) + len(plan.optimised.frequency)
