"""A shoulder that moves: the strap against statics, linear theory, the fixed shoulder, and bad input."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import xarray as xr
from scipy import linalg

from armperturb.analysis.arm.state_space import fastest_pole, largest_real_pole, state_space, strapped_dynamics
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment, Strap
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import MARKER, Trial
from armperturb.models import rig
from armperturb.models.rig import build_model
from armperturb.muscle_law import MuscleLaw
from armperturb.perturbations import Pulse, Sampled
from armperturb.subject import POSITION, RELAX, Subject

ENVIRONMENT = Environment()
STRAP = Strap()
LEVELS = (53.9, 107.8)
"""Peak forces of pulse levels 1 and 2 [N] (table 2.1)."""
DIRECTIONS = (20.0, 200.0)
PASSIVE = replace(POSITION, kv_s=0.0, kv_se=0.0, kv_e=0.0, kp_s=0.0, kp_se=0.0, kp_e=0.0)
SENSING = replace(POSITION, name="sensing", ka_s=0.02, ka_e=0.01, kf_s=-0.3, kf_e=-0.2)
YIELDING = replace(
    POSITION,
    name="yielding",
    b_s=9.0,
    muscle=MuscleLaw(
        short_range_stiffness=20.0,
        elastic_limit_deg=0.5,
        elastic_limit_spread=0.5,
        loss_angle_deg=2.0,
        thinning_velocity=2.0,
        spindle_saturation=1.0,
    ),
)


def pulse(peak: float, direction_deg: float, duration: float = 0.7) -> Pulse:
    return Pulse(peak=peak, direction_deg=direction_deg, onset=0.1, duration=duration)


def pulsed(subject: Subject, strap: Strap | None, peak: float = LEVELS[1], direction: float = 20.0, **options):
    trial = Trial(subject=subject, perturbation=pulse(peak, direction))
    return run_experiment([trial], ENVIRONMENT, strap=strap, **options).isel(trial=0)


def content(model: mujoco.MjModel) -> bytes:
    buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def farthest(path: xr.DataArray) -> float:
    return float(np.linalg.norm(path.values, axis=-1).max())


@pytest.mark.parametrize("visual", [True, False])
@pytest.mark.parametrize("rope", rig.ROPES)
def test_without_a_strap_the_model_is_that_of_files_without_its_slides(monkeypatch, rope, visual):
    built = build_model(POSITION, rope=rope, visual=visual)
    arm, n_slides = re.subn(r' *<joint class="strap".*/>\n', "", rig.ARM_XML.read_text())
    assert n_slides == 2
    files = {"arm.xml": arm.encode(), "manipulator.xml": rig.MANIPULATOR_XML.read_bytes()}
    spec = mujoco.MjSpec.from_string(rig.RIG_XML.read_text(), files)
    monkeypatch.setattr(rig, "_parsed_rig", lambda: spec)
    monkeypatch.setattr(rig, "_set_strap", lambda *_: None)
    assert content(built) == content(build_model(POSITION, rope=rope, visual=visual))


def test_without_a_strap_the_marker_shows_the_cameras_noise_and_the_truth_has_none():
    trial = Trial(subject=RELAX, perturbation=pulse(20.0, 20.0), seed=4)
    assert "shoulder_marker" not in run_experiment([trial], ENVIRONMENT)
    marker = run_experiment([trial], ENVIRONMENT, instruments=Instruments(emg=None))["shoulder_marker"].values[0]
    np.testing.assert_array_equal(marker, 1e-3 * trial.generator(MARKER).standard_normal(marker.shape))


@pytest.mark.parametrize("subject", [RELAX, POSITION], ids=lambda subject: subject.name)
@pytest.mark.parametrize("rope", rig.ROPES)
def test_stands_in_equilibrium_at_the_start_posture(subject, rope):
    model = build_model(subject, ENVIRONMENT, rope=rope, strap=STRAP)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start = {
        **dict(zip(rig.JOINTS, subject.posture, strict=True)),
        **dict.fromkeys(rig.STRAP + rig.SLIDES, 0.0),
    }
    for name, value in start.items():
        assert data.joint(name).qpos[0] == value
    np.testing.assert_allclose(data.qacc, 0.0, atol=1e-9)
    mujoco.mj_step(model, data, 200)
    np.testing.assert_allclose([data.joint(name).qpos[0] for name in start], list(start.values()), atol=1e-12)


@pytest.mark.parametrize("force", [(15.0, 0.0), (0.0, -10.0)])
def test_constant_force_moves_the_shoulder_by_force_over_stiffness(force):
    rise = 0.5 - 0.5 * np.cos(np.pi * np.clip(np.arange(1600) / 200.0, 0.0, 1.0))
    trial = Trial(subject=POSITION, perturbation=Sampled(force=rise[:, None] * force, rate=200.0))
    strap = Strap(stiffness=2500.0, damping=300.0, mass=10.0)
    last = run_experiment([trial], ENVIRONMENT, strap=strap).isel(trial=0, time=-1)
    # The manipulator's spring takes its share, the arm hands on the rest.
    through_arm = np.array(force) - ENVIRONMENT.k_env * last["displacement"].values
    np.testing.assert_allclose(last["shoulder_marker"].values, through_arm / 2500.0, rtol=1e-4, atol=1e-7)


def passive_matrices(subject: Subject) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass, damping and stiffness at the start posture as MuJoCo has them, by differences of its passive forces."""
    model = build_model(subject, ENVIRONMENT, strap=STRAP)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    slopes = {}
    for field in ("qvel", "qpos"):
        columns = []
        for joint in range(model.nv):
            forces = []
            for step in (1e-6, -1e-6):
                mujoco.mj_resetData(model, data)
                getattr(data, field)[joint] += step
                mujoco.mj_forward(model, data)
                forces.append(data.qfrc_passive.copy())
            columns.append((forces[1] - forces[0]) / 2e-6)
        slopes[field] = np.column_stack(columns)
    return mass, slopes["qvel"], slopes["qpos"]


def test_poles_without_reflexes_are_those_of_the_compiled_model():
    mass, damping, stiffness = passive_matrices(PASSIVE)
    n = len(mass)
    a = np.block([[-np.linalg.solve(mass, damping), -np.linalg.solve(mass, stiffness)], [np.eye(n), np.zeros((n, n))]])
    poles = np.linalg.eigvals(a)
    assert fastest_pole(PASSIVE, ENVIRONMENT, STRAP) == pytest.approx(np.abs(poles).max(), rel=1e-5)
    assert largest_real_pole(PASSIVE, ENVIRONMENT, STRAP) == pytest.approx(poles.real.max(), rel=1e-4)


@pytest.mark.parametrize("subject", [POSITION, SENSING], ids=lambda subject: subject.name)
def test_small_movements_are_those_of_the_linear_dynamics_with_reflexes(subject):
    trial = Trial(subject=subject, perturbation=pulse(0.1, 50.0, duration=1.5))
    recording = run_experiment([trial], ENVIRONMENT, strap=STRAP, rate=1000.0, timestep=1e-3).isel(trial=0)
    a = strapped_dynamics(subject, ENVIRONMENT, STRAP)
    b = np.vstack([state_space(subject, ENVIRONMENT).b, np.zeros((4, 2))])
    n = len(a)
    step = linalg.expm(np.block([[a, b], [np.zeros((2, n + 2))]]) * 1e-3)[:n]
    middle = trial.perturbation.sample(1000.0, recording.sizes["time"], 0.5e-3)
    states = np.zeros((recording.sizes["time"], n))
    for i in range(1, len(states)):
        states[i] = step @ np.concatenate([states[i - 1], middle[i - 1]])
    for path, expected in (
        (recording["displacement"].values, states[:, 6:8]),
        (recording["shoulder_marker"].values, states[:, 20:22]),
        (recording["joint_angle"].values - subject.posture, states[:, 2:4]),
    ):
        assert np.abs(path - expected).max() < 0.01 * np.abs(expected).max()


def test_stability_is_asked_of_the_arm_on_its_strap():
    springy = Strap(damping=0.0)
    assert largest_real_pole(POSITION, ENVIRONMENT) < 0 < largest_real_pole(POSITION, ENVIRONMENT, springy)
    with pytest.raises(ValueError, match=r"'position', the environment and the strap are unstable: .* below 0"):
        pulsed(POSITION, springy)
    # A belt's damping can also steady an arm that would be unstable at a fixed shoulder.
    eager = replace(POSITION, kv_s=POSITION.kv_s + 6.0)
    assert largest_real_pole(eager, ENVIRONMENT, STRAP) < 0 < largest_real_pole(eager, ENVIRONMENT)
    recording = run_experiment(
        [Trial(subject=eager, perturbation=pulse(20.0, 20.0, duration=6.0))], ENVIRONMENT, strap=STRAP
    ).isel(trial=0)
    late = recording["displacement"].sel(time=slice(5.0, None))
    assert farthest(late) < 1e-3 * farthest(recording["displacement"])


@pytest.mark.slow(reason="pulses on four straps for each of six cases")
@pytest.mark.parametrize("subject", [POSITION, RELAX, YIELDING], ids=lambda subject: subject.name)
@pytest.mark.parametrize("rope", rig.ROPES)
def test_a_very_stiff_strap_is_a_fixed_shoulder(subject, rope):
    fixed = pulsed(subject, None, rope=rope, timestep=1e-3)
    off = []
    for stiffness in (1e5, 1e6, 4e6):
        strap = Strap(stiffness=stiffness, damping=0.4 * 2 * np.sqrt(8.0 * stiffness))
        held = pulsed(subject, strap, rope=rope, timestep=1e-3)
        off.append([np.abs(held[name] - fixed[name]).max() for name in ("displacement", "joint_angle", "force")])
    scale = [
        np.abs(path).max() for path in (fixed["displacement"], fixed["joint_angle"] - subject.posture, fixed["force"])
    ]
    assert (np.array(off[-1]) < 2e-3 * np.array(scale)).all()
    # In proportion to the compliance.
    np.testing.assert_allclose(np.array(off[1]) / off[2], 4.0, rtol=0.2)
    assert (np.array(off[0]) > 4.0 * np.array(off[1])).all()


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("subject", [POSITION, YIELDING], ids=lambda subject: subject.name)
def test_the_shoulder_moves_further_under_larger_pulses_and_less_in_relaxed_people(subject, direction):
    small, large = (farthest(pulsed(subject, STRAP, peak, direction)["shoulder_marker"]) for peak in LEVELS)
    relaxed = farthest(pulsed(RELAX, STRAP, LEVELS[0], direction)["shoulder_marker"])
    assert 1.8 * small < large < 2.2 * small
    assert 0.01 < large < 0.02
    assert relaxed < 0.6 * small


def test_the_marker_is_the_shoulder_and_the_cameras_noise():
    trial = Trial(subject=POSITION, perturbation=pulse(LEVELS[1], 20.0), seed=7)
    truth = run_experiment([trial], ENVIRONMENT, strap=STRAP)
    assert truth["shoulder_marker"].attrs["units"] == "m"
    for antialias in (None, 80.0):
        instruments = Instruments(antialias=antialias, marker_noise=2e-3, emg=None)
        seen = run_experiment([trial], ENVIRONMENT, strap=STRAP, instruments=instruments)
        noise = 2e-3 * trial.generator(MARKER).standard_normal(seen["shoulder_marker"].shape[1:])
        # The low-pass makes the shoulder as late as the handle, by a sample or so.
        tolerance = 1e-15 if antialias is None else 0.1 * farthest(truth["shoulder_marker"])
        np.testing.assert_allclose(seen["shoulder_marker"][0] - noise, truth["shoulder_marker"][0], atol=tolerance)
    blind = Instruments(marker_noise=None, emg=None)
    assert "shoulder_marker" not in run_experiment([trial], ENVIRONMENT, strap=STRAP, instruments=blind)


@pytest.mark.slow(reason="the same trials several times")
def test_a_trial_is_the_same_alone_and_together_at_any_number_of_threads():
    trials = [
        Trial(subject=subject, perturbation=pulse(30.0, 20.0), seed=number, noise=HUMAN_NOISE[subject.task])
        for number, subject in enumerate((POSITION, YIELDING, RELAX, SENSING))
    ]
    options = {"strap": STRAP, "instruments": Instruments()}
    together = run_experiment(trials, ENVIRONMENT, n_threads=1, **options)
    assert run_experiment(trials, ENVIRONMENT, n_threads=3, **options).identical(together)
    alone = [run_experiment([trial], ENVIRONMENT, **options) for trial in trials]
    assert xr.concat(alone, dim="trial", combine_attrs="identical").identical(together)


def rotations(recording: xr.Dataset, path: xr.DataArray) -> np.ndarray:
    """Joint rotations [rad], (time, joint), that a laboratory computes from the hand's path [m] about the acromion."""
    l_h, l_f = float(recording["l_h"]), float(recording["l_f"])
    s, e = np.radians([float(recording[f"theta_{joint}_deg"]) for joint in "se"])
    hand = l_h * np.exp(1j * s) + l_f * np.exp(1j * (s + e)) + path.values @ [1.0, 1j]
    elbow = np.pi - np.arccos((l_h**2 + l_f**2 - np.abs(hand) ** 2) / (2 * l_h * l_f))
    return np.column_stack([np.angle(hand / (l_h + l_f * np.exp(1j * elbow))), elbow]) - [s, e]


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("peak", LEVELS)
def test_joint_rotations_from_a_fixed_acromion_are_wrong_where_the_shoulder_moves(peak, direction):
    """Position task. The shoulder gives way with the push, and inverse kinematics take that for turning of the joints.

    Where the handle is farthest the shoulder's rotation is underestimated, as the thesis says of joint rotations
    (chapter 4); the elbow's, here the smaller ones, are overestimated twofold.
    """

    def truth_of(recording):
        return recording["joint_angle"].values - POSITION.posture

    def off(computed, recording):
        return np.abs(computed - truth_of(recording)).max(axis=0)

    fixed, moving = (pulsed(POSITION, strap, peak, direction) for strap in (None, STRAP))
    handle, shoulder = moving["displacement"], moving["shoulder_marker"]
    computed, true = rotations(moving, handle), truth_of(moving)
    at = np.argmax(np.linalg.norm(handle.values, axis=1))
    assert handle.values[at] @ shoulder.values[at] > 0
    assert 0.7 < computed[at, 0] / true[at, 0] < 0.95
    assert 1.8 < np.abs(computed[:, 1]).max() / np.abs(true[:, 1]).max() < 2.5
    # The marker puts it right, but for the deflection of the grip, which is there at a fixed shoulder too.
    of_grip = off(rotations(fixed, fixed["displacement"]), fixed)
    put_right = off(rotations(moving, handle - shoulder), moving)
    assert (put_right < of_grip).all()
    assert (off(computed, moving) > 3.0 * put_right).all()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"stiffness": -1.0}, ValueError, r"Strap: stiffness = -1\.0; expected a finite number above 0"),
        ({"stiffness": 0.0}, ValueError, r"Strap: stiffness = 0\.0; expected a finite number above 0"),
        ({"stiffness": np.nan}, ValueError, "Strap: stiffness = nan; expected a finite number above 0"),
        ({"damping": -1.0}, ValueError, r"Strap: damping = -1\.0; expected a finite number at least 0"),
        ({"damping": np.inf}, ValueError, "Strap: damping = inf; expected a finite number"),
        ({"mass": 0.0}, ValueError, r"Strap: mass = 0\.0; expected a finite number above 0"),
        ({"mass": "8 kg"}, TypeError, "Strap: mass = '8 kg'; expected a number"),
    ],
)
def test_bad_straps_are_named(change, error, message):
    with pytest.raises(error, match=message):
        Strap(**change)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"strap": STRAP, "linear": True}, ValueError, r"strap = Strap\(.*\); expected None, as the linear arm's"),
        ({"strap": 5000.0}, TypeError, r"strap = 5000\.0; expected Strap or None"),
        (
            {"strap": Strap(stiffness=1e9)},
            ValueError,
            "fastest pole of arm, environment and strap = .*; expected at most 4000 1/s at a step of 0.000625 s",
        ),
    ],
)
def test_bad_input_is_named(options, error, message):
    with pytest.raises(error, match=message):
        run_experiment([Trial(subject=POSITION, perturbation=pulse(10.0, 20.0))], ENVIRONMENT, **options)
