"""The one-joint laboratory compared with theory, with a second computation of the reflex, and bad input."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from scipy.interpolate import CubicSpline

from armperturb.analysis.joint.model import JointModel, JointStructure
from armperturb.analysis.joint.signals import TOP, joint_signals
from armperturb.analysis.varying.estimate import FASTEST
from armperturb.anthropometry import anthropometric_body
from armperturb.envs.lab.joint_experiment import JointTrial, at_signal_to_noise, run_joint_experiment
from armperturb.joint_person import JOINT_PEOPLE, JointPerson, Servo, half_wave, servo_of
from armperturb.muscle_law import MuscleLaw
from armperturb.perturbations.one_axis import imposed_movement, random_noise, random_steps
from armperturb.recording_files import load_recording, save_recording

RATE = 1000.0
PERIOD = 2.0
ANKLE = JOINT_PEOPLE["ankle"]


def simulated(person, kind, perturbation, **options):
    """Angle and torque of one trial, (time,) each."""
    trial = JointTrial(person=person, perturbation=perturbation, **options)
    recording = run_joint_experiment([trial], servo_of(person.joint, kind), n_threads=1)
    return recording["displacement"].values[0, :, 0], recording["force"].values[0, :, 0]


def derivatives(angle):
    """Velocity and acceleration of an angle, (time,) each, to fourth order."""
    time = np.arange(len(angle)) / RATE
    spline = CubicSpline(time, angle)
    return spline(time, 1), CubicSpline(time, spline(time, 1))(time, 1)


def impedance(person, s):
    """Of intrinsic and linear reflex path, after the equation of the parallel cascade."""
    omega = 2 * np.pi * person.cutoff
    activation = omega**2 / (s**2 + 2 * person.zeta * omega * s + omega**2)
    reflex = (person.kv * s + person.kp) * np.exp(-s * person.delay) * activation
    return person.inertia * s**2 + person.damping * s + person.stiffness + reflex


@pytest.mark.parametrize(("joint", "kind"), [("ankle", "position"), ("wrist", "force"), ("elbow", "position")])
def test_a_linear_joint_on_its_servo_has_the_closed_form(joint, kind):
    person = replace(JOINT_PEOPLE[joint], kp=0.1 * JOINT_PEOPLE[joint].stiffness)
    servo = servo_of(joint, kind)
    time = np.arange(round(2.5 * PERIOD * RATE)) / RATE
    cycles = np.arange(1, 80, 2)
    tones = np.cos(2 * np.pi * np.outer(time, cycles) / PERIOD + cycles**2).sum(axis=1)
    drive = tones * (1e-3 if kind == "position" else 1e-3 * person.stiffness)
    angle, torque = simulated(person, kind, drive)
    # Before the last samples, where the simulation does not know how the perturbation would go on.
    whole = slice(-round(PERIOD * RATE) - 10, -10)
    q, f, d = (np.fft.rfft(values[whole])[cycles] for values in (angle, torque, drive))
    s = 2j * np.pi * cycles / PERIOD
    limb, device = impedance(person, s), servo.inertia * s**2 + servo.damping * s + servo.stiffness
    driven = servo.stiffness + servo.damping * s if kind == "position" else 1.0
    assert np.abs(f / q - limb).max() < 0.0012 * np.abs(limb).max()
    np.testing.assert_allclose(q / d, driven / (limb + device), rtol=0.002)


@pytest.mark.parametrize("threshold", [0.15, -0.1])
def test_half_wave_spindles_add_the_filtered_rectified_velocity_of_stretch(threshold):
    clock = np.arange(round(4.0 * RATE)) / RATE
    drive = sum(0.01 * np.cos(2 * np.pi * cycles * clock + cycles**2) for cycles in (0.7, 1.9, 4.3, 9.1))
    person = half_wave(replace(ANKLE, kv=3.0), threshold)
    angle, torque = simulated(person, "position", drive)
    velocity, acceleration = derivatives(angle)
    shift = round(person.delay * RATE)
    late = np.concatenate([np.zeros(shift), velocity[:-shift]])
    answered = np.maximum(late, threshold) - max(threshold, 0.0)
    omega, time = 2 * np.pi * person.cutoff, np.arange(len(angle)) / RATE
    activation = [omega**2], [1.0, 2 * person.zeta * omega, omega**2]
    _, reflex, _ = signal.lsim(activation, person.kv * answered, time)
    intrinsic = person.inertia * acceleration + person.damping * velocity + person.stiffness * angle
    inner = slice(100, -5)
    assert np.abs(torque - intrinsic - reflex)[inner].std() < 0.01 * reflex.std()


def test_parameters_follow_their_course_and_the_neutral_angle():
    time = np.arange(round(3.0 * RATE)) / RATE
    factor = 1.0 + 0.5 * np.sin(2 * np.pi * time)
    slow = 0.2 * np.sin(2 * np.pi * 0.4 * time)
    person = replace(ANKLE, kv=0.0)
    drive = slow + 0.01 * np.cos(2 * np.pi * 6.0 * time)
    trial = JointTrial(person=person, perturbation=drive, neutral=slow, stiffness=factor, damping=factor)
    recording = run_joint_experiment([trial], servo_of("ankle", "position"))
    np.testing.assert_array_equal(recording["scheduling"].values[0, :, 0], slow)
    angle, torque = (recording[name].values[0, :, 0] for name in ("displacement", "force"))
    velocity, acceleration = derivatives(angle)
    expected = person.inertia * acceleration
    expected += factor * (person.damping * velocity + person.stiffness * (angle - slow))
    assert np.abs(torque - expected)[100:-5].std() < 0.005 * torque.std()


def test_short_range_stiffness_yields_as_in_the_arm():
    law = MuscleLaw(short_range_stiffness=60.0, elastic_limit_deg=0.5)
    person = replace(ANKLE, kv=0.0, muscle=law)
    ramp = np.clip(np.arange(3000) / RATE - 0.5, 0.0, 1.0) * np.radians(4.0)
    angle, torque = simulated(person, "position", ramp)
    velocity, _ = derivatives(angle)
    intrinsic = ANKLE.damping * velocity + ANKLE.stiffness * angle
    # Elasto-plastic: amid the ramp, beyond the elastic limit, the torque of that limit.
    np.testing.assert_allclose((torque - intrinsic)[1000:1400], 60.0 * np.radians(0.5), rtol=0.01)


def test_contraction_moves_torques_and_thresholds():
    person = half_wave(ANKLE, 0.3, slope=-0.2).at_level(2.0)
    assert person.stiffness == 2 * ANKLE.stiffness
    assert person.inertia == ANKLE.inertia
    assert person.muscle.of_elements("spindle_threshold")[0] == pytest.approx(0.1)


@pytest.mark.slow(reason="simulates")
def test_movement_of_an_ensemble_is_kept_fast_enough_for_the_half_wave():
    person = half_wave(ANKLE, 0.1)
    steps = [random_steps(seed=i, duration=2.6, size=0.06, hold=0.1) for i in range(4)]
    trials = [JointTrial(person=person, perturbation=each) for each in steps]
    recording = run_joint_experiment(trials, servo_of("ankle", "position"), timestep=2.5e-4)
    names = ("inertia", "damping", "stiffness", "kv", "delay", "cutoff", "zeta")
    values = np.array([*(getattr(person, name) for name in names), 0.1])
    shares = []
    for top in (TOP, FASTEST):
        signals = joint_signals(recording, reference=0.0, settle=0.3, shortest=1.0, top=top)
        paths = JointModel(JointStructure(reflex="half-wave", side=1), signals).paths(values)
        left = signals.torque - sum(paths.values())
        frequency = np.fft.rfftfreq(left[:, signals.used].shape[1], 1.0 / signals.rate)
        slow = (frequency > 0.4) & (frequency < 20.0)
        sizes = [
            np.linalg.norm(np.fft.rfft(each[:, signals.used] * np.hanning(left[:, signals.used].shape[1]))[:, slow])
            for each in (left, paths["reflex"])
        ]
        shares.append(sizes[0] / sizes[1])
    assert shares[1] < 0.005
    assert shares[1] < 0.4 * shares[0]


@pytest.mark.parametrize(("natural", "cutoff"), [(5.0, 5.0 * 2**0.5), (40.0, 15.0), (0.0, 1.0)])
def test_an_imposed_movement_is_as_wide_as_the_joint(natural, cutoff):
    angle = imposed_movement(seed=3, duration=400.0, natural_frequency=natural, speed=0.2)
    assert np.sqrt(np.mean(derivatives(angle)[0] ** 2)) == pytest.approx(0.2, rel=0.02)
    frequency, power = signal.welch(angle, RATE, nperseg=8192)
    near = np.abs(frequency - cutoff) < 0.1 * cutoff
    low = (frequency > 0.2) & (frequency < 0.5 * cutoff)
    assert power[near].mean() == pytest.approx(0.5 * power[low].mean(), rel=0.15)
    beyond = np.abs(frequency - 2.0 * cutoff) < 0.1 * cutoff
    assert power[beyond].mean() == pytest.approx(power[low].mean() / 257.0, rel=0.5)  # Butterworth, order 4


@pytest.mark.parametrize("number", [{"natural_frequency": -1.0}, {"natural_frequency": 5.0, "speed": 0.0}])
def test_an_imposed_movement_refuses_numbers_out_of_range(number):
    with pytest.raises(ValueError, match="imposed_movement: "):
        imposed_movement(seed=0, duration=1.0, **number)


@pytest.mark.slow(reason="simulates experiments")
@pytest.mark.parametrize("neutral", [None, np.linspace(0.0, 0.1, 6000)], ids=["still", "moving"])
@pytest.mark.parametrize(("kind", "name"), [("position", "force"), ("force", "displacement")])
def test_noise_has_the_ratio_that_is_asked_for(kind, name, neutral):
    size = {"position": 0.03, "force": 3.0}[kind]
    make = random_steps if kind == "position" else random_noise
    drive = make(seed=1, duration=6.0, **{"size" if kind == "position" else "rms": size})
    servo, trial = servo_of("ankle", kind), JointTrial(person=ANKLE, perturbation=drive, neutral=neutral, seed=5)
    noisy = run_joint_experiment([at_signal_to_noise(trial, servo, 15.0)], servo)[name].values
    clean = run_joint_experiment([trial], servo)[name].values
    assert 20 * np.log10(clean.std() / (noisy - clean).std()) == pytest.approx(15.0, abs=0.3)


@pytest.mark.slow(reason="simulates")
def test_recordings_are_saved_and_repeat(tmp_path):
    trials = [JointTrial(person=ANKLE, perturbation=random_noise(seed=i, duration=1.0)) for i in range(2)]
    recording = run_joint_experiment(trials, servo_of("ankle", "force"), n_threads=2)
    save_recording(recording, tmp_path / "ankle.nc")
    assert load_recording(tmp_path / "ankle.nc").identical(recording)
    alone = run_joint_experiment(trials[1:], servo_of("ankle", "force"))
    np.testing.assert_array_equal(alone["force"].values[0], recording["force"].values[1])


def test_bad_input_is_refused():
    still, servo = np.zeros(100), servo_of("ankle", "position")
    with pytest.raises(ValueError, match=r"stiffness has shape \(3,\); expected finite values \(100,\)"):
        JointTrial(person=ANKLE, perturbation=still, stiffness=[1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match=r"expected one joint and length"):
        run_joint_experiment(
            [JointTrial(person=JOINT_PEOPLE[joint], perturbation=still) for joint in ("ankle", "wrist")], servo
        )
    with pytest.raises(ValueError, match="whole number of steps"):
        run_joint_experiment([JointTrial(person=ANKLE, perturbation=still)], servo, rate=900.0)
    with pytest.raises(ValueError, match=r"delay = 0\.0004 s; expected at least two steps"):
        run_joint_experiment([JointTrial(person=replace(ANKLE, delay=4e-4), perturbation=still)], servo)
    trials = [JointTrial(person=ANKLE, perturbation=still)]
    stiff = Servo(kind="position", inertia=0.05, damping=200.0, stiffness=50000.0)
    with pytest.raises(ValueError, match=r"timestep = 0\.0005 s; expected at most 0\.00025 s with a servo of 50000 "):
        run_joint_experiment(trials, stiff)
    assert run_joint_experiment(trials, stiff, timestep=0.00025).sizes["time"] == 100
    with pytest.raises(ValueError, match=r"JointPerson: inertia = 0\.0; expected a finite number above 0"):
        replace(ANKLE, inertia=0.0)
    with pytest.raises(ValueError, match="kind = 'hand'; expected one of"):
        servo_of("ankle", "hand")
    with pytest.raises(ValueError, match=r"ankle\.toml"):
        JointPerson.from_dict({**ANKLE.to_dict(), "mass": 1.0}, "ankle.toml")
    torque = random_noise(seed=0, duration=4.0, rms=3.0)
    with pytest.raises(RuntimeError, match="expected less feedback"):
        run_joint_experiment(
            [JointTrial(person=replace(ANKLE, kv=12.0), perturbation=torque)], servo_of("ankle", "force")
        )


@pytest.mark.parametrize("person", [*JOINT_PEOPLE.values(), half_wave(ANKLE, 0.1, 0.02)])
def test_people_are_read_back_as_they_were_written(person, tmp_path):
    person.save(tmp_path / "person.toml")
    assert JointPerson.load(tmp_path / "person.toml") == person
    assert JointPerson.load(tmp_path / "person.toml").at_level(2.0).held_torque == 2.0 * person.held_torque


def test_the_elbow_has_the_inertia_of_forearm_and_hand():
    body = anthropometric_body("male", 1.74, 73.0)  # the mean of de Leva's men
    length = body["l_f"]
    inertia = body["m_f"] * ((body["r_f"] * length) ** 2 + (body["c_f"] * length) ** 2)
    assert JOINT_PEOPLE["elbow"].inertia == pytest.approx(inertia, rel=0.1)
