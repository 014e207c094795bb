"""Where an arm in the laboratory starts, and that it stays there until something pushes."""

import mujoco
import numpy as np
import pytest

import armperturb as ap
from armperturb.envs.lab import settling

MUSCLES = "".join(
    f'<muscle joint="sh" gear="{arm}" force="300" lengthrange="-0.1 0.1" ctrlrange="0 1"/>' for arm in (0.04, -0.04)
)


def arm(rest="", shoulder="", option="", compiler=""):
    """Two links of 0.3 m on springs, at rest with the shoulder at 30 and the elbow at 80 deg."""
    return mujoco.MjSpec.from_string(
        f"""<mujoco><compiler {compiler}/>{option}
        <default><geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/></default>
        <worldbody><body name="upper" euler="0 0 30">
          <joint name="sh" axis="0 0 1" stiffness="40" damping="2" {shoulder}/><geom mass="2"/>
          <body name="fore" pos="0.3 0 0" euler="0 0 80"><joint name="el" axis="0 0 1" stiffness="30" damping="1.5"/>
            <geom mass="1.5"/><site name="palm" pos="0.3 0 0"/></body></body></worldbody>{rest}</mujoco>"""
    )


def with_key(actuators="", **key):
    """What the arm has beside its segments: actuators, and a keyframe "k"."""
    values = " ".join(f'{name}="{value}"' for name, value in key.items())
    return f'<actuator>{actuators}</actuator><keyframe><key name="k" {values}/></keyframe>'


def unpushed(laboratory):
    """Largest displacement of a handle that nothing pushes [m]."""
    recording = laboratory.record([ap.Pulse(peak=1e-9, direction_deg=0.0, onset=0.0, duration=0.5)])
    return np.abs(recording["displacement"].values).max()


def test_actuators_without_names_take_the_keyframe():
    servo = '<position joint="sh" kp="100" kv="5"/>'
    rest = ap.Laboratory(arm(with_key(servo + MUSCLES, qpos="0.3 0.1", ctrl="0.4 0.4 0.2")), "palm", keyframe="k").rest
    assert rest.posture == pytest.approx({"sh": 0.3, "el": 0.1}, abs=0.05)
    assert rest.activation == {"actuator1": 0.4, "actuator2": 0.2}


def test_joints_without_names_take_the_keyframe():
    spec = arm(with_key(qpos="0.3 0.1"))
    named = ap.Laboratory(spec, "palm", keyframe="k").rest
    for joint in spec.joints:
        joint.name = ""
    rest = ap.Laboratory(spec, "palm", keyframe="k").rest
    assert rest.posture == {"joint0": named.posture["sh"], "joint1": named.posture["el"]}
    np.testing.assert_array_equal(rest.force, named.force)
    assert np.hypot(*rest.force) > 10.0
    with pytest.raises(ValueError, match=r"posture_deg = 'el'; expected a joint of the model \(joint0, joint1\)"):
        ap.Laboratory(spec, "palm", posture_deg={"el": 10.0})


def test_a_ball_joint_takes_the_keyframe():
    spec = arm(with_key(qpos="0.924 0 0 0.383 -0.3"), shoulder='type="ball"')
    for joint in spec.joints:
        joint.stiffness[0] = 0.0
    laboratory = ap.Laboratory(spec, "palm", keyframe="k")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    start = laboratory.model.body("lab/manipulator").pos
    np.testing.assert_allclose(start, data.site("palm").xpos, atol=1e-9)


@pytest.mark.parametrize(
    ("actuators", "key"),
    [
        (MUSCLES, {"ctrl": "0.4 0.2"}),
        (MUSCLES, {"ctrl": "0.4 0.2", "act": "0.4 0.2"}),
        ('<position joint="sh" kp="100" kv="5" timeconst="0.1"/>', {"ctrl": "0.2"}),
        ('<general joint="sh" dyntype="filter" dynprm="0.1"/>', {"ctrl": "5"}),
        ('<position joint="sh" kp="100" kv="5" delay="0.05" nsample="30"/>', {"ctrl": "0.2"}),
        ('<motor joint="sh" delay="0.05" nsample="30"/>', {"ctrl": "5"}),
    ],
    ids=["muscles", "active muscles", "slow servo", "filter", "delayed servo", "delayed motor"],
)
def test_an_arm_stays_where_constant_controls_hold_it_until_something_pushes(actuators, key):
    laboratory = ap.Laboratory(arm(with_key(actuators, qpos="0 0", **key)), "palm", keyframe="k")
    assert laboratory.rest.settled > 0.0
    assert np.hypot(*laboratory.rest.force) > 5.0
    assert unpushed(laboratory) < 1e-6


def test_an_arm_that_leaves_its_rest_under_the_force_that_it_bears_is_refused():
    # Pushed together, the arm would buckle: largest real part of a pole -0.1 in the first posture, 5 1/s in the second.
    stable = ap.Laboratory(arm(), "palm", posture_deg={"sh": -30.0})
    assert np.hypot(*stable.rest.force) > 60.0
    with pytest.raises(ValueError, match=r"unstable at rest, with 112 N on the handle .* with 4\.88 1/s\)"):
        ap.Laboratory(arm(), "palm", posture_deg={"sh": -30.0, "el": 30.0})


def test_an_arm_without_springs_is_not_unstable():
    spec = arm()
    for joint in spec.joints:
        joint.stiffness[0] = joint.damping[0] = 0.0
    assert unpushed(ap.Laboratory(spec, "palm")) < 1e-9


def test_only_the_arm_has_weight():
    laboratory = ap.Laboratory(arm(option='<option gravity="0 -9.81 0"/>'), "palm", gravity=True)
    assert np.hypot(*laboratory.rest.force) > 10.0
    assert unpushed(laboratory) < 1e-6


def test_the_total_mass_of_a_compiler_is_that_of_the_arm():
    model = ap.Laboratory(arm(compiler='settotalmass="7"'), "palm").model
    masses = {name: model.body(name).mass[0] for name in ("upper", "fore", "lab/carriage")}
    assert masses == pytest.approx({"upper": 4.0, "fore": 3.0, "lab/carriage": ap.Environment().m_env})


def flagged(*flags):
    return arm(option="<option><flag " + " ".join(f'{name}="disable"' for name in flags) + "/></option>")


def test_options_of_a_model_do_not_switch_the_laboratory_off():
    push = [ap.Pulse(peak=20.0, direction_deg=30.0, onset=0.1, duration=0.5)]
    expected = ap.Laboratory(arm(), "palm").record(push)
    for model in (flagged("sensor", "gravity"), arm(option='<option actuatorgroupdisable="0 1 2 3 4 5 30"/>')):
        recording = ap.Laboratory(model, "palm").record(push)
        for name in ("force", "displacement"):
            np.testing.assert_array_equal(recording[name].values, expected[name].values)
    for name in ("spring", "damper", "actuation", "gravity"):
        with pytest.raises(
            ValueError, match=f'<flag {name}="disable"/> of the model; expected no such flag, for .* to act'
        ):
            ap.Laboratory(flagged(name), "palm", gravity=True)


def test_what_falls_beside_the_arm_is_named_where_nothing_comes_to_rest(monkeypatch):
    monkeypatch.setattr(settling, "SETTLING", 0.5)
    spec = arm()
    ball = spec.worldbody.add_body(name="ball", pos=[1.0, 1.0, 1.0])
    ball.add_freejoint()
    ball.add_geom(size=[0.1, 0.0, 0.0], fromto=[np.nan] * 6, type=mujoco.mjtGeom.mjGEOM_SPHERE)
    assert np.abs(ap.Laboratory(spec, "palm").rest.force).max() == 0.0
    with pytest.raises(ValueError, match="joint 'joint2' of body 'ball' moves; expected a posture"):
        ap.Laboratory(spec, "palm", gravity=True)
    ap.Laboratory(spec, "palm", gravity=True, locked=["joint2"])


def test_joints_that_are_locked_do_not_move_the_hand():
    assert "one joint moves the hand; identify" in ap.Laboratory(arm(), "palm", locked=["sh"]).rest.summary()
    with pytest.raises(ValueError, match=r"joints = 'sh'; expected a joint of the model \(el\)"):
        ap.Laboratory(arm(), "palm", locked=["sh"], joints=("sh", "el"))
    with pytest.raises(ValueError, match="no joint moves the hand; expected at least one"):
        ap.Laboratory(arm(), "palm", locked=["*"])
