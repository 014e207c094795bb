"""Sidecars of one axis that are written from names and numbers."""

import json

import numpy as np
import pytest
from scipy.io import savemat
from test_one_axis import RATE, ankle, files, slow

from armperturb.convert.importer import import_recording
from armperturb.convert.template import write_sidecar

INERTIA = 0.01


def as_text(names, *columns):
    return "\n".join(
        [",".join(names), *(",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))]
    )


def written(path):
    template = write_sidecar(path)
    return json.loads(template.path.read_text()), template.notes


def time():
    return np.arange(len(ankle()[0])) / RATE


@pytest.mark.parametrize(
    ("names", "angle_unit", "factor", "by_hand"),
    [
        (("t", "angle_rad", "torque_Nm"), "rad", 1.0, True),
        (("time [s]", "ankle angle", "ankle torque"), "deg", np.degrees(1.0), False),
        (("timestamp", "position [deg]", "moment"), "deg", np.degrees(1.0), True),
    ],
)
def test_a_table_of_angle_and_torque_is_read_as_it_is(tmp_path, names, angle_unit, factor, by_hand):
    angle, torque = ankle()
    path = tmp_path / "S3.csv"
    path.write_text(as_text(names, time(), factor * angle, torque if by_hand else -torque))
    sidecar, notes = written(path)
    assert sidecar["servo"] == "position"
    assert sidecar["signals"]["displacement"] == {"channels": {"x": names[1]}, "unit": angle_unit}
    assert sidecar["signals"]["force"]["exerted_by"] == ("hand" if by_hand else "handle")
    assert sidecar["labels"].get("joint") == ("ankle" if "ankle" in names[1] else None)
    assert {"servo", "labels.subject", "labels.task"} <= {*sidecar["guessed"]}
    assert any("physics agrees" in note for note in notes)
    recording = import_recording([path]).recording
    np.testing.assert_allclose(recording["displacement"].values[0, :, 0], angle, atol=1e-6)
    np.testing.assert_allclose(recording["force"].values[0, :, 0], -torque, atol=1e-6)


def test_units_below_the_names_are_read(tmp_path):
    angle, torque = ankle()
    path = tmp_path / "S3.csv"
    header, rest = as_text(("t", "angle", "torque"), 1e3 * time(), np.degrees(angle), -torque).split("\n", 1)
    path.write_text(f"Ankle,,\n{header}\nms,deg,Nm\n{rest}")
    sidecar, _ = written(path)
    assert sidecar["time"] == {"channel": "t", "unit": "ms"}
    assert sidecar["signals"]["displacement"] == {"channels": {"x": "angle"}, "unit": "deg"}
    assert not [field for field in sidecar["guessed"] if field.endswith("unit")]
    np.testing.assert_allclose(import_recording([path]).recording["force"].values[0, :, 0], -torque, atol=1e-6)


def test_arrays_with_their_rate(tmp_path):
    angle, torque = ankle()
    path = files(tmp_path, angle, torque, rate_hz=np.array(RATE))
    path.with_suffix(".json").unlink()
    sidecar, _ = written(path)
    assert sidecar["rate"] == RATE
    assert import_recording([path]).recording.sizes["trial"] == 1
    path = tmp_path / "elbow.mat"
    savemat(path, {"fs": RATE, "theta": np.stack([angle] * 5), "torque": np.stack([torque] * 5)})
    sidecar, _ = written(path)
    assert sidecar["signals"]["displacement"]["channels"] == {"x": "theta(trial,time)"}
    assert sidecar["labels"]["joint"] == "elbow"


@pytest.mark.parametrize("n_trials", [2, 3, 5])
def test_columns_of_an_angle_and_a_torque_are_trials_however_few(tmp_path, n_trials):
    angle, torque = ankle()
    path = tmp_path / "ankle.mat"
    trials = [np.stack([signal * (1.0 + 0.1 * n) for n in range(n_trials)], axis=1) for signal in (angle, torque)]
    savemat(path, {"Fs": RATE, "ANG": trials[0], "TRQ": trials[1]})
    sidecar, _ = written(path)
    assert sidecar["signals"]["displacement"]["channels"] == {"x": "ANG(time,trial)"}
    force = import_recording([path]).recording["force"].values
    np.testing.assert_allclose(np.abs(force[:, :, 0]), np.abs(trials[1].T), atol=1e-12)


def test_forces_and_displacements_of_one_direction(tmp_path):
    angle, torque = ankle()
    path = tmp_path / "push.csv"
    # A kilogram where the joint has a hundredth of it; millimetres without a unit.
    path.write_text(as_text(("t", "pos", "force"), time(), 1e3 * (angle - 0.2), -100.0 * torque))
    sidecar, notes = written(path)
    assert sidecar["signals"]["displacement"]["unit"] == "mm"
    assert sidecar["signals"]["force"] == {"channels": {"x": "force"}, "unit": "N", "exerted_by": "handle"}
    assert {"signals.displacement.unit", "signals.force.unit"} <= {*sidecar["guessed"]}
    assert any("kg" in note for note in notes)


def test_a_perturbation_that_moves_an_environment_means_a_force_servo(tmp_path):
    angle, torque = ankle()
    t = time()
    acceleration = np.gradient(np.gradient(angle, t), t)
    path = tmp_path / "servo.csv"
    load = -torque + 0.02 * acceleration + 0.1 * np.gradient(angle, t) + 5.0 * angle
    for name in ("disturbance_Nm", "motor_torque_Nm", "motor_Nm", "tau_motor"):
        path.write_text(as_text(("t", name, "angle_rad", "wrist_torque_Nm"), t, load, angle, torque))
        path.with_suffix(".json").unlink(missing_ok=True)
        sidecar, _ = written(path)
        assert sidecar["servo"] == "force"
        assert sidecar["signals"]["perturbation"]["channels"] == {"x": name}
        assert sidecar["signals"]["force"]["channels"] == {"x": "wrist_torque_Nm"}
    # What a motor exerts is what is measured where nothing else is.
    path.write_text(as_text(("t", "angle_rad", "motor_torque_Nm"), t, angle, torque))
    path.with_suffix(".json").unlink()
    sidecar, _ = written(path)
    assert (sidecar["servo"], sidecar["signals"]["force"]["channels"]["x"]) == ("position", "motor_torque_Nm")
    path = tmp_path / "imposed.csv"
    command = np.random.default_rng(1).normal(size=len(t))
    path.write_text(as_text(("t", "command", "angle_rad", "torque_Nm"), t, command, angle, torque))
    sidecar, notes = written(path)
    assert sidecar["servo"] == "position"
    assert "perturbation" not in sidecar["signals"]
    assert any("command moves no virtual environment" in note for note in notes)


def test_an_angle_that_shows_nothing_leaves_guesses(tmp_path):
    path = tmp_path / "short.csv"
    path.write_text(as_text(("t", "angle", "torque"), np.arange(50) / RATE, np.linspace(0, 0.1, 50), np.ones(50)))
    sidecar, notes = written(path)
    assert "signals.force.exerted_by" in sidecar["guessed"]
    assert any("unchecked" in note for note in notes)


def test_a_movement_too_slow_to_show_the_sign_of_force_leaves_it_to_the_person(tmp_path):
    angle, torque = slow(0.045)
    path = tmp_path / "slow.csv"
    path.write_text(as_text(("t", "angle_rad", "torque_Nm"), np.arange(len(angle)) / RATE, angle, torque))
    sidecar, notes = written(path)
    assert "signals.force.exerted_by" in sidecar["guessed"]
    assert not any("physics agrees" in note for note in notes)


def test_a_second_channel_of_a_joint_is_named(tmp_path):
    angle, torque = ankle()
    path = tmp_path / "two.csv"
    path.write_text(as_text(("t", "angle_a", "angle_b", "torque_Nm"), time(), angle, angle, torque))
    sidecar, _ = written(path)
    assert sidecar["signals"]["displacement"]["channels"] == {"x": "angle_a"}
    assert sidecar["guessed"]["signals.displacement.channels.x"] == (
        "one axis is taken; or angle_b, or two axes in place of servo"
    )


def test_a_file_whose_names_show_nothing_is_told_of_the_sidecar_of_one_axis(tmp_path):
    angle, torque = ankle()
    path = tmp_path / "knoechel.csv"
    path.write_text(as_text(("t", "Winkel", "Kraftmoment"), time(), angle, torque))
    sidecar, notes = written(path)
    assert sidecar["signals"]["force"]["channels"] == {"x": "?", "y": "?"}
    assert any("a recording of one axis" in note and "servo in place of axes" in note for note in notes)
