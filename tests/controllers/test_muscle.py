"""The muscle law: each mechanism on its textbook experiment, its limits, its passivity, and bad input."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from tones import PERIOD, Tones

from armperturb.analysis.arm.geometry import mass_matrix
from armperturb.analysis.arm.linear_arm import arm_admittance, environment_admittance, joint_impedance
from armperturb.analysis.arm.state_space import largest_real_pole, require_stable
from armperturb.analysis.response.spectra import line_spectra
from armperturb.controllers.arm_control import ArmControl, stretched
from armperturb.controllers.compiled import spindle_velocity, stretch_all
from armperturb.controllers.remnant import HumanNoise
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.muscle_law import MuscleLaw
from armperturb.perturbations import Multisine, Sampled
from armperturb.subject import POSITION, RELAX, Subject, at_level

DT = 1e-3
BIPHASIC = MuscleLaw(short_range_stiffness=(10.0, 6.0, 8.0), elastic_limit_deg=0.7)
FULL = MuscleLaw(
    short_range_stiffness=(10.0, 6.0, 8.0),
    elastic_limit_deg=(0.3, 0.7, 1.0),
    elastic_limit_spread=0.5,
    elastic_limit_slope=0.01,
    loss_angle_deg=5.0,
    recovery_time=2.0,
    thinning_velocity=0.2,
    spindle_saturation=0.5,
    spindle_direction=0.4,
    spindle_threshold=0.1,
)
# The preset's damping cannot thin: its shoulder group is negative.
STIFF = replace(POSITION, name="stiff", b_s=POSITION.b_se)


def with_law(subject, **changes):
    return replace(subject, muscle=replace(subject.muscle or MuscleLaw(), **changes))


def law_step(control, stretch, velocity):
    """Torque of the elements [Nm], (arm, element), after one more step by hand, which memories go on by."""
    torque = np.zeros((1, *np.shape(stretch)))
    stretch_all(control.table, control.memory, np.asarray(stretch)[None], np.asarray(velocity)[None], torque)
    return torque[0]


def drawn_out(law, stretch, element=0, subject=RELAX, timestep=DT):
    """Torque of one element over an imposed stretch [Nm] and the share of its stiffness that is intact, (time,)."""
    control = ArmControl([replace(subject, muscle=law)], timestep)
    torques, intact = [], []
    motion = np.zeros((len(stretch), 1, 3))
    motion[:, 0, element] = stretch
    for angle, velocity in zip(motion, np.gradient(motion, timestep, axis=0), strict=True):
        torques.append(law_step(control, angle, velocity)[0, element])
        intact.append(control.memory["intact"][0, element])
    whole, _ = stretched([replace(subject, muscle=law)], motion, np.gradient(motion, timestep, axis=0), timestep)
    np.testing.assert_array_equal(whole[:, 0, element], torques)
    return np.array(torques), np.array(intact)


def ramp_and_hold(speed_deg, amplitude_deg, duration=1.0):
    time = np.arange(0.0, duration, DT)
    return np.radians(np.minimum(speed_deg * time, amplitude_deg))


@pytest.mark.parametrize("element", range(3))
def test_a_ramp_is_answered_in_two_phases_that_meet_at_the_elastic_limit(element):
    stiffness, limit = BIPHASIC.short_range_stiffness[element], np.radians(0.7)
    stretch = ramp_and_hold(10.0, 3.0)
    torque, _ = drawn_out(BIPHASIC, stretch, element)
    np.testing.assert_allclose(torque, stiffness * np.minimum(stretch, limit), atol=1e-12)


def test_spread_limits_round_the_knee_but_keep_initial_stiffness_and_yield_torque():
    stretch = ramp_and_hold(10.0, 6.0)
    sharp, _ = drawn_out(BIPHASIC, stretch)
    for spread in (0.3, 0.6, 1.0):
        law = replace(BIPHASIC, elastic_limit_spread=spread)
        torque, _ = drawn_out(law, stretch)
        assert torque[1] == pytest.approx(sharp[1], rel=1e-12)
        assert torque[-1] == pytest.approx(sharp[-1], rel=1e-12)
        knee = np.searchsorted(stretch, np.radians(0.7))
        assert torque[knee] < 0.95 * sharp[knee]
    # As fine as the distribution is meant to be.
    fine, coarse = (drawn_out(replace(law, parts=parts, elastic_limit_spread=0.5), stretch)[0] for parts in (64, 8))
    assert np.abs(fine - coarse).max() < 0.03 * sharp[-1]


@pytest.mark.parametrize("speed", [74.5, 186.2])
def test_the_elastic_limit_grows_with_speed_as_appendix_f_has_it(speed):
    law = replace(BIPHASIC, elastic_limit_deg=0.1, elastic_limit_slope=0.02)
    torque, _ = drawn_out(law, ramp_and_hold(speed, 40.0, 0.2))
    assert torque[150] == pytest.approx(10.0 * np.radians(0.1 + 0.02 * speed), rel=1e-9)


def test_reversal_unloads_along_the_short_range_stiffness_and_closes_a_loop_of_known_area():
    # Masing: a yielded spring turns back on twice its virgin curve; per cycle it takes 4 S L (A - L).
    amplitude, limit = np.radians(3.0), np.radians(0.7)
    stretch = amplitude * np.sin(2 * np.pi * np.arange(0.0, 3.0, DT))
    torque, _ = drawn_out(BIPHASIC, stretch)
    cycle = slice(1000, 2001)
    work = np.trapezoid(torque[cycle], stretch[cycle])
    assert work == pytest.approx(4 * 10.0 * limit * (amplitude - limit), rel=2e-3)


def test_movement_wears_short_range_stiffness_off_and_rest_brings_it_back():
    law = replace(BIPHASIC, elastic_limit_deg=math.inf, loss_angle_deg=5.0, recovery_time=1.0)
    time = np.arange(0.0, 7.0, DT)
    moving = (time >= 0.5) & (time < 1.5)
    stretch = np.where(moving, np.radians(4.0) * np.sin(2 * np.pi * time), 0.0)
    probe, still = np.radians(0.01), np.zeros((1, 3))
    instants = np.array([400, 1550, 2550, 6900])
    control = ArmControl([replace(RELAX, muscle=law)], DT)
    stiffness, intact = [], []
    for step, angle in enumerate(stretch):
        if step in instants:
            # Up and down, as the bonds that a probe breaks let go of the torque that movement has left in them.
            up, down = (
                law_step(copy.deepcopy(control), np.array([[sign * probe, 0.0, 0.0]]), still)[0, 0] for sign in (1, -1)
            )
            stiffness.append((up - down) / (2 * probe))
        law_step(control, np.array([[angle, 0.0, 0.0]]), still)
        intact.append(control.memory["intact"][0, 0])
    intact = np.array(intact)
    assert stiffness[0] == pytest.approx(10.0, rel=5e-3)
    assert stiffness[1] < 0.35 * stiffness[0]
    # Rest: what is lost decays with the recovery time.
    lost = 1.0 - intact[instants[1:]]
    np.testing.assert_allclose(lost[1:] / lost[0], np.exp(-np.array([1.0, 5.35])), rtol=1e-9)
    np.testing.assert_allclose(np.array(stiffness) / 10.0, 1.0 - np.array([0.0, *lost]), rtol=0.01)


def test_movement_without_recovery_leaves_one_over_e_after_the_angle_of_loss():
    law = replace(BIPHASIC, elastic_limit_deg=math.inf, loss_angle_deg=5.0, recovery_time=math.inf)
    _, intact = drawn_out(law, ramp_and_hold(10.0, 5.0))
    assert intact[-1] == pytest.approx(math.exp(-1.0), rel=2e-3)


def test_recovery_changes_no_torque_and_stores_no_energy():
    law = replace(BIPHASIC, loss_angle_deg=2.0)
    torque, intact = drawn_out(law, ramp_and_hold(10.0, 3.0, 4.0))
    held = slice(310, None)
    np.testing.assert_array_equal(torque[held], torque[310])
    assert torque[310] > 0
    assert intact[-1] > 2 * intact[310]


def test_worn_muscle_yields_at_the_same_stretch_and_at_less_torque():
    law = replace(BIPHASIC, loss_angle_deg=5.0)
    torque, intact = drawn_out(law, ramp_and_hold(10.0, 3.0, 0.29))
    yielded = np.radians(0.7) * 10.0 * intact
    # The share intact is that after the step's recovery.
    np.testing.assert_allclose(torque[100:], yielded[100:], rtol=2e-3)
    assert torque[-1] < 0.8 * torque[70]


def test_damping_that_has_thinned_away_leaves_the_undamped_arm():
    # The model's own damper is taken back by a held torque: as large as it is, and not late.
    damped = replace(RELAX, b_s=6.0, b_se=3.0, b_e=6.0)
    thinned = replace(damped, muscle=MuscleLaw(thinning_velocity=1e-7))
    undamped = replace(damped, b_s=0.0, b_se=0.0, b_e=0.0)
    moves = moved([thinned, undamped, damped], duration=1.0)["displacement"].values
    off = np.abs(moves - moves[1]).max(axis=(1, 2)) / np.abs(moves[1]).max()
    assert off[0] < 2e-3
    assert off[2] > 0.5


def test_damping_thins_to_half_at_its_velocity_and_to_a_constant_torque_beyond():
    subject, thinning = replace(RELAX, muscle=MuscleLaw(thinning_velocity=(0.1, 0.2, 0.3))), np.array([0.1, 0.2, 0.3])
    linear = np.array(subject.muscle_groups("b"))
    for speed, share in ((thinning, 0.5), (-thinning, 0.5), (1e6 * thinning, 1e-6), (1e-9 * thinning, 1.0)):
        torque = law_step(ArmControl([subject], DT), np.zeros((1, 3)), speed[None])
        # What is left beside the linear damper of the model.
        np.testing.assert_allclose(torque[0] + linear * speed, share * linear * speed, rtol=1e-5)


def test_spindles_saturate_and_favour_a_direction():
    speed = np.array([-1e6, -0.5, -1e-9, 0.0, 1e-9, 0.5, 1e6])

    def answered(saturation, direction):
        return np.array([spindle_velocity(v, saturation, direction, 0.0) for v in speed])

    np.testing.assert_array_equal(answered(math.inf, 0.0), speed)
    saturated = answered(0.5, 0.0)
    np.testing.assert_allclose(saturated, [-0.5, -0.25, -1e-9, 0.0, 1e-9, 0.25, 0.5], rtol=1e-5)
    np.testing.assert_array_equal(answered(math.inf, 1.0), np.maximum(speed, 0.0))
    one_way = answered(math.inf, -0.4)
    np.testing.assert_allclose(one_way, np.where(speed > 0, 0.6, 1.0) * speed)


def test_a_threshold_makes_a_half_wave_a_dead_zone_or_spindles_that_fire_at_rest():
    speed = np.linspace(-1.0, 1.0, 401)

    def answered(direction, threshold, saturation=math.inf):
        return np.array([spindle_velocity(v, saturation, direction, threshold) for v in speed])

    above = np.maximum(speed - 0.3, 0.0)
    np.testing.assert_allclose(answered(1.0, 0.3), above, atol=1e-15)
    np.testing.assert_allclose(answered(-1.0, 0.3), -above[::-1], atol=1e-15)
    np.testing.assert_allclose(answered(0.0, 0.3), above - above[::-1], atol=1e-15)
    np.testing.assert_allclose(answered(0.5, 0.3), above - 0.5 * above[::-1], atol=1e-15)
    # Saturation is by the speed above the threshold.
    np.testing.assert_allclose(answered(1.0, 0.3, 0.5), above / (1.0 + above / 0.5), atol=1e-15)
    np.testing.assert_allclose(answered(1.0, -0.3), np.maximum(speed, -0.3), atol=1e-15)
    np.testing.assert_allclose(answered(0.0, -1.0), 2.0 * speed, atol=1e-15)


def test_co_contraction_moves_the_threshold_of_spindles():
    law = MuscleLaw(spindle_threshold=(0.3, 0.2, 0.1), spindle_threshold_slope=-0.2, short_range_stiffness=4.0)
    person = at_level(replace(STIFF, muscle=law), 2.0)
    np.testing.assert_allclose(person.muscle.of_elements("spindle_threshold"), (0.1, 0.0, -0.1), atol=1e-15)
    assert person.muscle.of_elements("short_range_stiffness") == (8.0, 8.0, 8.0)
    twice = at_level(person, 1.5).muscle
    for field in ("spindle_threshold", "spindle_threshold_slope"):
        np.testing.assert_allclose(twice.of_elements(field), law.at_level(3.0).of_elements(field), rtol=1e-12)
    assert at_level(person, 1.0) == person


def test_spindles_of_each_muscle_group_answer_its_own_velocity():
    subject = replace(POSITION, muscle=MuscleLaw(spindle_saturation=(0.1, 0.2, 0.3)))
    velocity = np.array([[0.4, -0.3], [0.4, -0.3]])
    control = ArmControl([POSITION, subject], DT)
    control.torque(np.array([POSITION.posture] * 2), velocity)
    linear = POSITION.joint_matrix("kv") @ velocity[0]
    np.testing.assert_allclose(control.memory["excitation"][0], linear, rtol=1e-12)
    s, se, e = subject.muscle_groups("kv")
    shoulder, two, elbow = s * 0.4 / (1 + 4), se * 0.1 / (1 + 0.5), e * -0.3 / (1 + 1)
    np.testing.assert_allclose(control.memory["excitation"][1], [shoulder + two, elbow + two], rtol=1e-12)


@pytest.mark.slow(reason="waits until the arm is at rest, twice")
def test_a_step_of_force_creeps_past_the_limit_only_if_it_is_large_and_leaves_a_set():
    arm = replace(RELAX, muscle=replace(BIPHASIC, short_range_stiffness=(12.0, 8.0, 10.0), elastic_limit_deg=0.5))
    environment = Environment()
    force = np.zeros((1600, 2))
    force[1:800, 0] = 1.0
    sizes = np.array([0.02, 1.0])
    recording = run_experiment(
        [Trial(subject=arm, perturbation=Sampled(force=size * force, rate=100.0)) for size in sizes],
        environment,
        timestep=2.5e-3,  # what is asked of is at rest
    )
    loaded, unloaded = (recording["displacement"].values[:, at, 0] for at in (1590, 3190))
    found = loaded / sizes

    def compliance(subject):
        stiffness = np.linalg.inv(arm_admittance(subject, [1e-6])[0].real)
        stiffness = stiffness + np.linalg.inv(environment_admittance(environment, [1e-6])[0].real)
        return np.linalg.inv(stiffness)[0, 0]

    large, small = arm.linear_arms
    assert found[0] == pytest.approx(compliance(small), rel=0.01)
    assert 1.3 * compliance(small) < found[1] < compliance(large)
    assert abs(unloaded[0]) < 0.001 * loaded[0]
    assert unloaded[1] > 0.1 * loaded[1]


@pytest.mark.slow(reason="lets slow transients of four trials pass")
def test_small_movements_see_short_range_stiffness_as_linear():
    # One with tendon organs, which feel the short-range torque too.
    law = replace(FULL, elastic_limit_deg=2.0, loss_angle_deg=1e6, thinning_velocity=1e4, spindle_saturation=1e4)
    law = replace(law, spindle_direction=0.0, spindle_threshold=0.0)
    people = [replace(RELAX, muscle=law), replace(STIFF, muscle=law.scaled(8.0), kf_s=-0.5, kf_e=-0.4)]
    trials = [
        Trial(subject=subject, perturbation=Tones(rms=2e-3, duration=10.0 + PERIOD, axes=(axis,)))
        for subject in people
        for axis in range(2)
    ]
    recording = run_experiment(trials, timestep=2.5e-3)
    for number, subject in enumerate(people):
        lines = line_spectra(recording.isel(trial=[2 * number, 2 * number + 1]), window_start=10.0, period=PERIOD)
        forces, moves = (np.moveaxis(of, 0, -1) for of in (lines.force, lines.displacement))
        found = moves @ np.linalg.inv(forces)
        low = lines.frequency <= 20.0

        def error(arm, found=found, lines=lines):
            exact = arm_admittance(arm, lines.frequency)
            return np.linalg.norm(found - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))

        large, small = subject.linear_arms
        assert error(small)[low].max() < 0.003
        assert error(large)[low].max() > 0.1


def moved(subjects, n_threads=0, noise=None, duration=0.3):
    trials = [
        Trial(
            subject=subject,
            perturbation=Multisine.draw(seed=1, rms=3.0, duration=duration, crested=False),
            noise=noise,
        )
        for subject in subjects
    ]
    return run_experiment(trials, n_threads=n_threads)


def test_a_law_that_is_off_is_the_linear_muscle_to_the_last_bit():
    # Off by default, and off one by one beside what makes the code run.
    for off in (MuscleLaw(), MuscleLaw(parts=3, elastic_limit_deg=0.0, recovery_time=0.3, loss_angle_deg=1.0)):
        people = [RELAX, STIFF]
        lawful = [replace(subject, muscle=off) for subject in people]
        for noise in (None, HumanNoise(remnant_floor=0.3)):
            linear, found = moved(people, noise=noise), moved(lawful, noise=noise)
            for name in ("force", "displacement", "joint_angle"):
                np.testing.assert_array_equal(found[name].values, linear[name].values)
    assert not moved([with_law(RELAX, thinning_velocity=0.5)]).equals(moved([RELAX]))


def test_trials_are_the_same_to_the_last_bit_alone_and_beside_others():
    people = [
        RELAX,
        replace(RELAX, muscle=replace(FULL, parts=5)),
        STIFF,
        replace(STIFF, muscle=replace(FULL, parts=11), kf_e=-0.3),
        replace(RELAX, muscle=MuscleLaw(spindle_saturation=0.3)),
    ]
    noise = HumanNoise(remnant_floor=0.3)
    together = moved(people, n_threads=1, noise=noise)
    assert moved(people, n_threads=3, noise=noise).identical(together)
    for number, subject in enumerate(people):
        alone = moved([subject], noise=noise)
        for name in ("force", "displacement", "joint_angle"):
            np.testing.assert_array_equal(alone[name].values[0], together[name].values[number])


def random_subject(rng):
    b_se = rng.uniform(0, 5)
    law = MuscleLaw(
        short_range_stiffness=tuple(rng.uniform(0, 50, 3)),
        elastic_limit_deg=tuple(10 ** rng.uniform(-1, 1, 3)),
        elastic_limit_spread=tuple(rng.uniform(0, 1.5, 3)),
        elastic_limit_slope=tuple(rng.uniform(0, 0.05, 3) * rng.integers(0, 2, 3)),
        parts=int(rng.integers(1, 10)),
        loss_angle_deg=tuple(10 ** rng.uniform(-0.5, 2, 3)),
        recovery_time=tuple(10 ** rng.uniform(-2, 1, 3)),
        thinning_velocity=tuple(10 ** rng.uniform(-2, 1, 3)),
    )
    return replace(RELAX, b_s=b_se + rng.uniform(0, 5), b_se=b_se, b_e=b_se + rng.uniform(0, 5), muscle=law)


def of_elements(motion):
    return np.stack([motion[:, 0], motion.sum(axis=1), motion[:, 1]], axis=1)


@pytest.mark.slow(reason="200 people along a long path, in small steps")
def test_intrinsic_muscle_gives_no_energy_whatever_its_parameters_and_path():
    rng = np.random.default_rng(0)
    n, timestep = 200, 4e-4
    subjects = [random_subject(rng) for _ in range(n)]
    control = ArmControl(subjects, timestep)
    memory, stiffness = control.memory, control.table["part_stiffness"]
    damping = np.array([subject.joint_matrix("b") for subject in subjects])
    time = np.arange(0.0, 2.0, timestep)[:, None, None]
    amplitude, frequency = np.radians(10 ** rng.uniform(-1, 1, (4, n, 2))), rng.integers(1, 6, (4, n, 2))
    # From rest, round a loop that closes at 1 s and again at 2 s.
    phase = rng.uniform(0, 2 * np.pi, (4, n, 2))
    angle = sum(
        a * (np.sin(2 * np.pi * f * time + p) - np.sin(p)) for a, f, p in zip(amplitude, frequency, phase, strict=True)
    )
    velocity = np.gradient(angle, timestep, axis=0)
    work, scale = np.zeros(n), np.zeros(n)
    before = None
    for q, q_dot in zip(angle, velocity, strict=True):
        torque = law_step(control, of_elements(q), of_elements(q_dot))
        total = torque[:, ::2] + torque[:, 1:2] + np.einsum("tij,tj->ti", damping, q_dot)
        if before is not None:
            done = np.sum((total + before[0]) / 2 * (q - before[1]), axis=1)
            work, scale = work + done, scale + np.abs(done)
            stored = (stiffness / (2 * memory["intact"]) * (memory["bond"] ** 2).sum(axis=2)).sum(axis=1)
            # The sum over steps is off by the square of a step.
            assert (work - stored >= -1e-4 * scale).all()
        before = total, q
    assert (work > 0).all()


def test_all_muscle_torque_is_in_proportion_to_the_level():
    subject = replace(STIFF, kf_s=-0.4, ka_e=0.3, muscle=FULL)
    frequency = np.array([0.5, 3.0, 11.0])
    inertia = np.multiply.outer((2j * np.pi * frequency) ** 2, mass_matrix(subject))
    one = joint_impedance(subject, frequency) - inertia
    for level in (0.0, 0.4, 1.6):
        found = at_level(subject, level)
        np.testing.assert_allclose(joint_impedance(found, frequency) - inertia, level * one, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.muscle.short_range_stiffness, level * np.array(FULL.short_range_stiffness))
        assert replace(found.muscle, short_range_stiffness=0.0) == replace(FULL, short_range_stiffness=0.0)
    assert at_level(subject, 1.0) == subject
    assert at_level(POSITION, 0.5).muscle is None
    stretch = ramp_and_hold(10.0, 3.0)
    half, whole = (
        drawn_out(at_level(subject, level).muscle, stretch, subject=at_level(subject, level))[0] for level in (0.5, 1.0)
    )
    np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-12)


def test_stability_is_asked_of_small_and_of_large_movements():
    environment = Environment()
    with pytest.raises(ValueError, match="'position' and the environment are unstable"):
        require_stable(with_law(POSITION, short_range_stiffness=150.0, elastic_limit_deg=0.5), environment)
    soft = replace(POSITION, name="soft", k_s=16.0, k_se=11.5, k_e=20.7)
    held = with_law(soft, short_range_stiffness=(40.0, 50.0, 60.0), elastic_limit_deg=0.5)
    assert largest_real_pole(held.linear_arms[1], environment) < 0
    with pytest.raises(ValueError, match="'soft' and the environment are unstable"):
        require_stable(held, environment)
    assert largest_real_pole(POSITION, environment) == largest_real_pole(with_law(POSITION), environment)


def test_stiff_short_range_is_too_fast_for_the_step():
    heavy = with_law(RELAX, short_range_stiffness=3e6)
    with pytest.raises(ValueError, match="fastest pole"):
        moved([heavy])


def test_stiffness_that_differs_between_trials_does_so_in_the_short_range_too():
    drawn = HumanNoise(spread_k=0.3).vary(replace(RELAX, muscle=FULL), np.random.default_rng(1), lambda _: True)
    factor = drawn.k_s / RELAX.k_s
    assert factor != pytest.approx(1.0)
    np.testing.assert_allclose(drawn.muscle.short_range_stiffness, factor * np.array(FULL.short_range_stiffness))


def test_a_file_gives_back_the_law(tmp_path):
    subject = replace(RELAX, muscle=replace(FULL, recovery_time=math.inf))
    subject.save(tmp_path / "s.toml")
    assert Subject.load(tmp_path / "s.toml") == subject
    (tmp_path / "t.toml").write_text(
        (tmp_path / "s.toml").read_text().split("[muscle]")[0] + "[muscle]\nelastic_limit_deg = [1, 2, 3]\n"
    )
    assert Subject.load(tmp_path / "t.toml").muscle == MuscleLaw(elastic_limit_deg=(1.0, 2.0, 3.0))
    assert "muscle" not in RELAX.to_dict()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            {"short_range_stiffness": -1.0},
            ValueError,
            "short_range_stiffness = -1.0; expected a finite number at least 0",
        ),
        ({"short_range_stiffness": math.inf}, ValueError, "short_range_stiffness = inf; expected a finite number"),
        (
            {"elastic_limit_deg": (0.5, -0.1, 0.5)},
            ValueError,
            "elastic_limit_deg = -0.1; expected a finite number at least 0",
        ),
        ({"elastic_limit_deg": math.nan}, ValueError, "elastic_limit_deg = nan; expected"),
        (
            {"elastic_limit_spread": -0.1},
            ValueError,
            "elastic_limit_spread = -0.1; expected a finite number at least 0",
        ),
        ({"elastic_limit_slope": -0.1}, ValueError, "elastic_limit_slope = -0.1; expected a finite number at least 0"),
        ({"parts": 0}, ValueError, "parts = 0; expected a finite number at least 1 and at most 64"),
        ({"parts": 2.5}, TypeError, "parts = 2.5; expected a whole number"),
        ({"loss_angle_deg": 0.0}, ValueError, "loss_angle_deg = 0.0; expected a finite number above 0"),
        ({"recovery_time": -2.0}, ValueError, "recovery_time = -2.0; expected a finite number above 0"),
        ({"thinning_velocity": -0.1}, ValueError, "thinning_velocity = -0.1; expected a finite number above 0"),
        ({"spindle_saturation": 0.0}, ValueError, "spindle_saturation = 0.0; expected a finite number above 0"),
        (
            {"spindle_direction": 1.5},
            ValueError,
            "spindle_direction = 1.5; expected a finite number at least -1 and at most 1",
        ),
        ({"recovery_time": "2"}, TypeError, "recovery_time = '2'; expected a number"),
        (
            {"recovery_time": (1.0, 2.0)},
            TypeError,
            r"recovery_time = \(1.0, 2.0\); expected a number, or three for shoulder",
        ),
    ],
)
def test_bad_laws_are_named(change, error, message):
    with pytest.raises(error, match=f"MuscleLaw: {message}"):
        MuscleLaw(**change)


def test_arrays_are_taken_as_what_they_hold():
    law = MuscleLaw(elastic_limit_deg=np.array([1.0, 2.0, 3.0]), recovery_time=np.array(2.0))
    assert law == MuscleLaw(elastic_limit_deg=(1.0, 2.0, 3.0), recovery_time=2.0)
    with pytest.raises(TypeError, match=r"elastic_limit_deg = \[1.0, 2.0\]; expected a number, or three"):
        MuscleLaw(elastic_limit_deg=np.array([1.0, 2.0]))


def test_bad_subjects_with_a_law_are_named():
    with pytest.raises(ValueError, match=r"b_s = 5.78; expected at least b_se = 8.83 with shear-thinning damping"):
        with_law(POSITION, thinning_velocity=0.2)
    with pytest.raises(TypeError, match="muscle = 3; expected MuscleLaw or None"):
        replace(RELAX, muscle=3)
    with pytest.raises(
        ValueError, match=r"relaxed.toml: MuscleLaw: unknown key 'limit'; expected keys are short_range"
    ):
        Subject.from_dict({**RELAX.to_dict(), "muscle": {"limit": 1.0}}, source="relaxed.toml")
    with pytest.raises(TypeError, match=r"relaxed.toml: MuscleLaw = 3; expected a table"):
        Subject.from_dict({**RELAX.to_dict(), "muscle": 3}, source="relaxed.toml")
    with pytest.raises(ValueError, match=r"at_level: level = -0.1; expected a finite number at least 0"):
        at_level(POSITION, -0.1)
