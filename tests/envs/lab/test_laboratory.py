"""The laboratory around arms that others have modelled."""

import importlib.util
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from foreign_models import DAMPING, MUSCLE_ARM, STIFFNESS, TWO_LINK, two_link_inertia

import armperturb as ap
from armperturb.analysis.fit.own_structures import composed
from armperturb.analysis.measures.kinematics import joint_rotations
from armperturb.envs.lab.posture import lock_joints
from armperturb.envs.lab.stretch_reflex import PlanarReflexes
from armperturb.models.rig import build_arm, build_model

PULSE = ap.Pulse(peak=20.0, direction_deg=30.0, onset=0.1, duration=0.5)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    for name, text in (("two_link", TWO_LINK), ("muscles", MUSCLE_ARM)):
        (folder / f"{name}.xml").write_text(text, encoding="utf-8")
    return folder


def muscle_arm(files, **settings):
    return ap.Laboratory(files / "muscles.xml", "palm", **{"activation": 0.2, "locked": ["wrist"]} | settings)


@pytest.mark.parametrize("subject", [ap.RELAX, ap.POSITION], ids=lambda subject: subject.name)
def test_the_planar_rig_gives_the_recording_of_an_experiment_to_the_last_bit(subject):
    rig = build_model(subject)
    laboratory = ap.Laboratory(
        build_arm(subject),
        "hand",
        controller=PlanarReflexes(subject),
        handle=rig.body("manipulator").pos,
        gravity=True,
        k_h=subject.k_h,
        b_h=subject.b_h,
    )
    instruments = ap.Instruments(emg=None)
    recording = laboratory.record([PULSE], seed=3, task=subject.task, instruments=instruments)
    expected = ap.run_experiment([ap.Trial(subject=subject, perturbation=PULSE, seed=3)], instruments=instruments)
    assert set(recording.data_vars) == set(expected.data_vars)
    for name in expected.data_vars:
        np.testing.assert_array_equal(recording[name].values, expected[name].values)
    for name in ("l_h", "l_f", "theta_s_deg", "theta_e_deg"):
        np.testing.assert_array_equal(recording[name].values, expected[name].values)


@pytest.mark.slow(reason="simulates a trial of 32 s")
def test_the_admittance_is_that_of_the_known_parameters(files):
    laboratory = ap.Laboratory(files / "two_link.xml", "palm")
    assert laboratory.rest.settled == 0.0
    recording = laboratory.record([ap.Multisine.draw(rms=1.0, seed=0, crested=False)])
    estimate = ap.response(recording, "arx")
    s = 2j * np.pi * estimate.frequency[:, None, None]
    joints = s**2 * two_link_inertia() + s * DAMPING + STIFFNESS
    first, both = np.radians([40.0, 125.0])
    fore = 0.34 * np.array([-np.sin(both), np.cos(both)])
    jacobian = np.column_stack([0.31 * np.array([-np.sin(first), np.cos(first)]) + fore, fore])
    grip = np.eye(2) / (ap.RELAX.k_h + s * ap.RELAX.b_h)
    truth = jacobian @ np.linalg.inv(joints) @ jacobian.T + grip
    off = np.abs(estimate.response - truth) / np.linalg.norm(truth, axis=(1, 2), keepdims=True)
    assert np.median(off) < 0.01


@pytest.mark.slow(reason="simulates trials")
def test_the_arm_of_dm_control_is_perturbed():
    package = importlib.util.find_spec("dm_control")  # whose import would take seconds
    if package is None:
        pytest.skip("dm_control is not installed")
    file = Path(package.submodule_search_locations[0]) / "suite" / "reacher.xml"
    with pytest.raises(ValueError, match=r"fastest pole .* \(a smaller timestep, or a softer grip\)"):
        ap.Laboratory(file, "finger", posture_deg={"wrist": 80.0})  # segments of some 40 g on a person's grip
    laboratory = ap.Laboratory(file, "finger", posture_deg={"wrist": 80.0}, timestep=5e-4)
    arm = laboratory.rest.segments
    assert (arm.l_h, arm.l_f, arm.theta_e_deg) == pytest.approx((0.12, 0.12, 80.0))
    recording = laboratory.record([ap.Pulse(peak=2.0, direction_deg=30.0, onset=0.1, duration=0.5)], rate=400.0)
    x, d, f = (recording[name].values[0] for name in ("displacement", "perturbation", "force"))
    load, step = ap.Environment(), 1.0 / 400.0
    acceleration = (x[2:] - 2 * x[1:-1] + x[:-2]) / step**2
    balance = load.m_env * acceleration + load.b_env * np.gradient(x, step, axis=0)[1:-1] + load.k_env * x[1:-1]
    assert np.abs(x).max() > 1e-3
    np.testing.assert_allclose(balance, (d - f)[1:-1], atol=0.02 * np.abs(d).max())


def joint_stiffness(laboratory, data_of, turn=1e-4):
    """Of the muscles [Nm/rad], by turning its joints at the constant activation, (joint, joint)."""
    model = laboratory.model
    columns = []
    for joint in range(2):
        torques = []
        for sign in (1.0, -1.0):
            data = data_of(laboratory)
            data.qpos[joint] += sign * turn
            mujoco.mj_forward(model, data)
            torques.append(data.qfrc_actuator[:2].copy())
        columns.append((torques[1] - torques[0]) / (2 * turn))
    return np.column_stack(columns)


def at_rest(laboratory):
    data = mujoco.MjData(laboratory.model)
    for name, angle in laboratory.rest.posture.items():
        data.qpos[laboratory.model.joint(name).qposadr[0]] = angle
    for name, value in laboratory.rest.activation.items():
        muscle = laboratory.model.actuator(name)
        data.ctrl[muscle.id] = data.act[muscle.actadr[0]] = value
    return data


@pytest.mark.slow(reason="simulates")
def test_muscles_hold_the_posture_and_stiffen_with_their_activation(files):
    for level in (0.1, 0.3):
        laboratory = muscle_arm(files, activation=level, posture_deg={"q1": 10.0, "q2": -20.0})
        data = at_rest(laboratory)
        mujoco.mj_forward(laboratory.model, data)
        assert np.abs(data.qacc).max() < 1e-4
        assert np.hypot(*laboratory.rest.force) < 0.05
        assert laboratory.rest.posture["q2"] == pytest.approx(np.radians(-20.0), abs=1e-3)
        assert np.mean([*laboratory.rest.activation.values()]) == pytest.approx(level, abs=0.03)
    soft, stiff = (
        np.linalg.eigvalsh(joint_stiffness(muscle_arm(files, activation=level), at_rest)) for level in (0.1, 0.3)
    )
    assert soft.min() > 0.0
    np.testing.assert_allclose(stiff / soft, 3.0, rtol=0.02)  # a muscle's force is in proportion to its activation


def test_an_arm_finds_its_rest_under_a_load(files):
    laboratory = ap.Laboratory(files / "two_link.xml", "palm", posture_deg={"q1": 5.0})
    force, arm = laboratory.rest.force, laboratory.rest.segments
    assert laboratory.rest.settled > 0.0
    upper, both = np.radians(arm.theta_s_deg), np.radians(arm.theta_s_deg + arm.theta_e_deg)
    fore = arm.l_f * np.array([-np.sin(both), np.cos(both)])
    jacobian = np.column_stack([arm.l_h * np.array([-np.sin(upper), np.cos(upper)]) + fore, fore])
    angles = np.array([laboratory.rest.posture[name] for name in ("q1", "q2")])
    np.testing.assert_allclose(jacobian.T @ force, STIFFNESS @ angles, rtol=2e-3)  # the grip yields a little
    recording = laboratory.record([ap.Pulse(peak=1e-9, direction_deg=0.0, onset=0.0, duration=1.0)])
    assert np.abs(recording["displacement"].values).max() < 1e-7
    for name in ("perturbation", "force"):
        np.testing.assert_allclose(recording[name].values - force, 0.0, atol=1e-4)


def test_a_left_arm_is_recorded_as_in_a_mirror(tmp_path):
    # The shoulder at 140 deg and the elbow at -85 deg are those of TWO_LINK in a mirror, on springs as stiff.
    left = TWO_LINK.replace('euler="0 0 40"', 'euler="0 0 140"').replace('euler="0 0 85"', 'euler="0 0 -85"')
    (tmp_path / "left.xml").write_text(left)
    (tmp_path / "right.xml").write_text(TWO_LINK)
    recordings = {}
    for side, direction in (("left", 150.0), ("right", 30.0)):
        laboratory = ap.Laboratory(tmp_path / f"{side}.xml", "palm")
        assert ("left arm" in laboratory.rest.summary()) == (side == "left")
        recordings[side] = laboratory.record([replace(PULSE, direction_deg=direction)])
    for name in (
        "perturbation",
        "force",
        "displacement",
        "joint_angle",
        "pulse_direction",
        "theta_s_deg",
        "theta_e_deg",
    ):
        of_left, of_right = (recordings[side][name].values for side in ("left", "right"))
        np.testing.assert_allclose(of_left, of_right, rtol=1e-6, atol=1e-7)


@pytest.mark.slow(reason="simulates and fits trials")
def test_stiffness_of_an_arm_that_is_held_by_a_force_has_the_turning_of_that_force(files):
    """However small the perturbation is beside that force."""
    laboratory = ap.Laboratory(files / "two_link.xml", "palm", posture_deg={"q1": 20.0, "q2": -20.0})
    force = laboratory.rest.force
    assert np.hypot(*force) > 20.0
    multisines = [ap.Multisine.draw(rms=0.2, seed=seed, duration=10.0, crested=False) for seed in range(2)]
    recording = laboratory.record(multisines, instruments=ap.Instruments(emg=None))
    result = ap.identify(recording, composed(reflex="none"), window_start=2.0)
    # Of the hand at l_h (cos a, sin a) + l_f (cos b, sin b), the moment of a force changes with the angles by f . -r.
    body, fit = result.fit.arm, result.fit
    shoulder, elbow = np.deg2rad([body.theta_s_deg, body.theta_s_deg + body.theta_e_deg])
    forearm = body.l_f * np.array([np.cos(elbow), np.sin(elbow)])
    hand = body.l_h * np.array([np.cos(shoulder), np.sin(shoulder)]) + forearm
    (of_shoulder, of_both), (_, of_elbow) = STIFFNESS
    held = {"k_s": of_shoulder + hand @ force, "k_se": of_both + forearm @ force, "k_e": of_elbow + forearm @ force}
    for name, value in held.items():
        assert fit.values[name] == pytest.approx(value, abs=4.0 * fit.standard_error[name], rel=0.01), name
    assert np.all(result.vaf > 99.0)
    assert any("the mean force on the hand, x -51.5 and y 138 N, makes 74.9 of k_s" in each for each in fit.remarks)


def test_reflexes_oppose_a_stretch_after_their_delay(files):
    silent, reflexive = (
        muscle_arm(files, controller=controller).record([PULSE], rate=400.0)
        for controller in (ap.StretchReflex(), ap.StretchReflex(length=2.0, velocity=0.2, delay=0.04))
    )
    plain = muscle_arm(files).record([PULSE], rate=400.0)
    np.testing.assert_array_equal(silent["force"].values, plain["force"].values)
    difference = np.abs(reflexive["force"].values - plain["force"].values)[0].max(axis=1)
    begins = np.flatnonzero(difference > 1e-6)[0] / 400.0
    assert 0.14 <= begins <= 0.16
    late = slice(80, 200)
    assert np.abs(reflexive["displacement"].values[0, late]).max() < np.abs(plain["displacement"].values[0, late]).max()


@pytest.mark.parametrize("frame", ["", '<frame pos="0.01 0 0" euler="0 5 20">'])
def test_a_locked_joint_stays_where_the_posture_has_it(frame):
    body, end = '<body name="hand"', '<site name="palm" pos="0.05 0 0"/>\n        </body>'
    assert end in MUSCLE_ARM
    in_frame = MUSCLE_ARM.replace(body, frame + body).replace(end, end + "</frame>" * bool(frame))
    spec = mujoco.MjSpec.from_string(in_frame)
    posture = {"q1": 0.2, "wrist": -0.7}
    model = spec.compile()
    data = mujoco.MjData(model)
    for name, value in posture.items():
        data.joint(name).qpos = value
    mujoco.mj_forward(model, data)
    locked = lock_joints(spec, ["wri*"], posture).compile()
    again = mujoco.MjData(locked)
    again.joint("q1").qpos = posture["q1"]
    mujoco.mj_forward(locked, again)
    assert locked.nv == 2
    np.testing.assert_allclose(again.site("palm").xpos, data.site("palm").xpos, atol=1e-12)
    np.testing.assert_allclose(again.site("palm").xmat, data.site("palm").xmat, atol=1e-12)


def test_a_turned_laboratory_records_the_same_of_a_turned_arm(files):
    laboratories = [
        ap.Laboratory(files / "two_link.xml", "palm"),
        ap.Laboratory(mujoco.MjSpec.from_string(TWO_LINK.replace("0 0 40", "0 0 160")), "palm", turn_deg=120.0),
    ]
    first, second = (laboratory.record([PULSE]) for laboratory in laboratories)
    for name in ("displacement", "force", "joint_angle"):
        np.testing.assert_allclose(second[name].values, first[name].values, atol=1e-7)
    assert second["theta_s_deg"].values == pytest.approx(40.0)


def test_the_hand_moves_to_the_handle(files):
    laboratory = ap.Laboratory(files / "two_link.xml", "palm", handle=(0.15, 0.27, 1.0))
    data = at_rest(laboratory)
    mujoco.mj_forward(laboratory.model, data)
    np.testing.assert_allclose(data.site("palm").xpos[:2], (0.15, 0.27), atol=2e-3)


def hinges(*ranges, key="", coupled=False):
    """Links of 0.3 m, each on a sprung hinge with a range [rad]; springs are at rest in the keyframe."""
    names = "abc"[: len(ranges)]
    rest = [float(angle) for angle in key.split()] or [0.0] * len(ranges)
    text = '<site name="palm" pos="0.3 0 0"/>'
    for i, (name, (low, high)) in reversed([*enumerate(zip(names, ranges, strict=True))]):
        text = (
            f'<body pos="{0.3 * (i > 0)} 0 0"><joint name="{name}" stiffness="20" damping="1" springref="{rest[i]}" '
            f'range="{low} {high}"/><inertial pos="0.15 0 0" mass="1.5" diaginertia="0.01 0.01 0.01"/>{text}</body>'
        )
    keys = f'<keyframe><key name="home" qpos="{key}"/></keyframe>' if key else ""
    pairs = '<equality><joint joint1="c" joint2="b" polycoef="0 0.5 0 0 0"/></equality>' if coupled else ""
    return mujoco.MjSpec.from_string(
        '<mujoco><compiler angle="radian" autolimits="true"/><option gravity="0 0 0"/><default><joint axis="0 0 1"/>'
        f"</default><worldbody>{text}</worldbody>{pairs}{keys}</mujoco>"
    )


WIDE = (-3.0, 3.0)


@pytest.mark.parametrize("locked", [[], ["c"]])
def test_an_arm_starts_as_its_keyframe_has_it(locked):
    laboratory = ap.Laboratory(hinges(WIDE, WIDE, WIDE, key="0.4 1.2 0.3"), "palm", keyframe="home", locked=locked)
    assert laboratory.rest.posture == pytest.approx({"a": 0.4, "b": 1.2} | ({} if locked else {"c": 0.3}), abs=1e-12)
    assert np.abs(laboratory.rest.force).max() == 0.0
    assert ("the option joints names two" in laboratory.rest.summary()) == (not locked)


def test_coupled_joints_of_a_keyframe_follow_a_posture():
    laboratory = ap.Laboratory(
        hinges(WIDE, WIDE, WIDE, key="0.4 1.2 0.3", coupled=True), "palm", keyframe="home", posture_deg={"b": 60.0}
    )
    taken = laboratory.rest.posture
    assert taken["c"] == pytest.approx(0.5 * taken["b"], abs=0.03)  # in the simulation the coupling is soft


BEND = (0.0, 2.5)


@pytest.mark.parametrize(
    ("key", "turn_deg", "posture_deg"),
    [
        ("2.75 -1.43", 0.0, (22.437, 81.933)),  # a left arm whose upper arm is along x at zero
        ("0 -1.4", 0.0, (180.0, 80.214)),
        ("2.7 -1.4", np.degrees(2.7), (180.0, 80.214)),  # a rounding error below -180
        ("-2.97 1.4", 160.0, (29.832, 80.214)),
    ],
)
def test_recorded_angles_start_at_the_posture_wherever_hinges_have_their_zero(key, turn_deg, posture_deg):
    laboratory = ap.Laboratory(hinges(WIDE, WIDE, key=key), "palm", keyframe="home", turn_deg=turn_deg)
    recording = laboratory.record([PULSE], instruments=ap.Instruments())
    assert (recording["theta_s_deg"], recording["theta_e_deg"]) == pytest.approx(posture_deg, abs=1e-3)
    angle = recording["joint_angle"].values - np.radians(posture_deg)
    np.testing.assert_allclose(angle, joint_rotations(recording), atol=0.02)
    assert not laboratory.rest.segments.refused


def place(shoulder, elbow):
    return (
        *(0.3 * (np.cos(shoulder) + np.cos(shoulder + elbow)), 0.3 * (np.sin(shoulder) + np.sin(shoulder + elbow))),
        0,
    )


@pytest.mark.parametrize("start", [{}, {"a": 60.0, "b": 10.0}, {"a": 80.0, "b": 0.0}, {"b": 140.0}])
def test_joints_reach_the_handle_within_their_ranges(start):
    arm = hinges((-1.0, 1.5), BEND, key="0.2 1.1")
    laboratory = ap.Laboratory(arm, "palm", posture_deg=start, handle=place(0.2, 1.1))
    assert laboratory.rest.posture == pytest.approx({"a": 0.2, "b": 1.1}, abs=1e-5)


@pytest.mark.slow(reason="searches postures")
@pytest.mark.parametrize(("shoulder", "elbow"), [(0.2, 2.9), (2.2, 1.0)])
def test_a_handle_that_only_other_ranges_reach_is_refused(shoulder, elbow):
    with pytest.raises(ValueError, match="expected a point that the hand can reach"):
        ap.Laboratory(hinges((-1.0, 1.5), BEND), "palm", handle=place(shoulder, elbow))
    ap.Laboratory(hinges(WIDE, WIDE), "palm", handle=place(shoulder, elbow))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hand_site": "finger"}, r"hand_site = 'finger'; expected a site of the model \(palm\)"),
        ({"activation": 0.1}, "activation = 0.1 for a model without muscles"),
        ({"activation": 2.0}, "activation = 2.0; expected a finite number at least 0 and at most 1"),
        ({"handle": (2.0, 0.0, 1.0)}, r"handle = \[2.0, 0.0, 1.0\] m; expected a point that the hand can reach"),
        ({"handle": (2.0, 0.0)}, "expected three numbers"),
        ({"posture_deg": {"knee": 3.0}}, r"posture_deg = 'knee'; expected a joint of the model \(q1, q2\)"),
        ({"locked": ["w*"]}, r"lock = 'w\*'; expected some of the model's joints: q1, q2"),
        ({"joints": ("q1", "q9")}, "joints = 'q9'; expected a joint"),
        ({"joints": ("q2", "q1")}, r"joints = \('q2', 'q1'\); expected shoulder and elbow, .* trunk and hand: q1, q2"),
        ({"joints": ("q2", "q2")}, r"joints = \('q2', 'q2'\); expected shoulder and elbow"),
        ({"joints": ("q1",)}, r"joints = \('q1',\); expected two names"),
        ({"joints": ("q1", "q2"), "hand_site": "fore"}, "expected segments of at least 0.01 m .* of 0.31 and 0 m"),
        ({"locked": ["q1"]}, "lock: fixed tendon 's' goes over joint 'q1'; expected joints"),
        ({"keyframe": "home"}, "keyframe = 'home'; expected one of the model"),
        ({"k_h": 0.0}, "k_h = 0.0; expected a finite number above 0"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(files, settings, message):
    with pytest.raises(ValueError, match=message) as refusal:
        ap.Laboratory(files / "two_link.xml", **{"hand_site": "palm"} | settings)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("field", ["joints", "locked"])
def test_a_name_in_the_place_of_names_is_refused(files, field):
    with pytest.raises(TypeError, match=rf"{field} = 'q1'; expected several names, e\.g\. \('q1',\)"):
        ap.Laboratory(files / "two_link.xml", "palm", **{field: "q1"})


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({}, "arm: 0.31 and 0.34 m, shoulder at 40 and elbow at 85 deg"),
        ({"turn_deg": 180.0}, "the shoulder at -90 to 180 deg; the option turn_deg"),
        ({"hand_site": "fore"}, "segments are 0.31 and 0 m long; identify and video need at least 0.01 m"),
        ({"hand_site": "upper"}, "one joint moves the hand; identify and video need two"),
    ],
)
def test_the_summary_says_what_no_analysis_takes(files, settings, line):
    summary = ap.Laboratory(files / "two_link.xml", **{"hand_site": "palm"} | settings).rest.summary()
    assert re.search(line, summary.splitlines()[-1])


def test_files_that_are_no_models_are_refused_in_a_line(tmp_path):
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody>", encoding="utf-8")
    with pytest.raises(ValueError, match=r"broken\.xml: .*; expected a model in MJCF") as refusal:
        ap.Laboratory(broken, "palm")
    assert "\n" not in str(refusal.value)
    with pytest.raises(OSError, match="none"):
        ap.Laboratory(tmp_path / "none.xml", "palm")


def test_reflexes_want_muscles(files):
    with pytest.raises(ValueError, match="the model has no muscles"):
        ap.Laboratory(files / "two_link.xml", "palm", controller=ap.StretchReflex()).record([PULSE])
