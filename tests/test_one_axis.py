"""Recordings of one axis: format, import, export, and the errors of bad ones."""

import json

import numpy as np
import pytest

from armperturb.convert.exporter import export_recording
from armperturb.convert.importer import import_recording
from armperturb.recording import ARM_LABELS, check_recording, is_one_axis, make_recording
from armperturb.recording_files import save_recording

RATE = 200.0
INERTIA = 0.01
SIDECAR = {
    "rate": RATE,
    "servo": "position",
    "signals": {
        "displacement": {"channels": {"x": "angle_rad"}, "unit": "rad"},
        "force": {"channels": {"x": "torque_Nm"}, "unit": "Nm", "exerted_by": "hand"},
    },
    "labels": {"subject": "A", "task": "PT", "joint": "ankle"},
}


def ankle():
    """Angle and torque that the limb exerts, of a plain inertia, damper and spring at tones of whole cycles."""
    time = np.arange(round(12 * RATE)) / RATE
    angle, torque = 0.2 + 0 * time, 0 * time
    for f in (1.5, 4.0, 9.0, 17.0, 26.0):
        s, tone = 2j * np.pi * f, 0.01 / f * np.exp(2j * np.pi * f * time + 1j * f)
        angle, torque = angle + tone.real, torque - ((INERTIA * s**2 + 0.6 * s + 40.0) * tone).real
    return angle, torque


def files(folder, angle, torque, *, sidecar=SIDECAR, **more):
    path = folder / "trial.npz"
    np.savez(path, angle_rad=angle, torque_Nm=torque, **more)
    path.with_suffix(".json").write_text(json.dumps(sidecar))
    return path


def changed(**fields):
    content = json.loads(json.dumps(SIDECAR))
    for place, value in fields.items():
        *way, last = place.split("__")
        part = content
        for name in way:
            part = part[name]
        part[last] = value
    return content


def test_a_sidecar_of_one_axis_reads_npz(tmp_path):
    angle, torque = ankle()
    recording = import_recording([files(tmp_path, angle, torque)]).recording
    assert is_one_axis(recording)
    assert recording.attrs["servo"] == "position"
    assert recording.attrs["joint"] == "ankle"
    assert recording["displacement"].attrs["units"] == "rad"
    assert recording["force"].attrs["quantity"] == "torque"
    np.testing.assert_array_equal(recording["displacement"].values[0, :, 0], angle)
    np.testing.assert_array_equal(recording["force"].values[0, :, 0], -torque)


def test_trials_along_a_dimension_of_an_array(tmp_path):
    angle, torque = ankle()
    channels = {"signals__displacement__channels__x": "angle_rad(trial,time)"}
    sidecar = changed(**channels, signals__force__channels__x="torque_Nm(trial,time)")
    path = files(tmp_path, np.stack([angle, angle + 0.01]), np.stack([torque, torque]), sidecar=sidecar)
    assert import_recording([path]).recording.sizes["trial"] == 2


@pytest.mark.parametrize("ending", [".nc", ".csv", ".mat"])
def test_export_and_import_give_the_same(tmp_path, ending):
    recording = import_recording([files(tmp_path, *ankle())]).recording
    target = tmp_path / f"again{ending}"
    export_recording(recording, target)
    again = import_recording([target]).recording
    for name in ("force", "displacement"):
        np.testing.assert_array_equal(again[name].values, recording[name].values)
        assert again[name].attrs["units"] == recording[name].attrs["units"]
    assert (again.attrs["servo"], again.attrs["joint"]) == ("position", "ankle")


def test_angles_in_degrees_are_converted(tmp_path):
    angle, torque = ankle()
    path = files(tmp_path, np.degrees(angle), torque, sidecar=changed(signals__displacement__unit="deg"))
    np.testing.assert_allclose(import_recording([path]).recording["displacement"].values[0, :, 0], angle, rtol=1e-12)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"servo": "force"}, r"signals.perturbation is missing.*servo = position"),
        ({"servo": "velocity"}, r"servo = 'velocity'; expected one of force, position"),
        ({"axes": {"x": "right", "y": "forward"}}, r"axes: unknown field"),
        ({"signals__force__exerted_by": "handle"}, r"inertia comes out at -0.01.*exerted_by"),
        ({"signals__force__unit": "N"}, r"signals.force.unit = 'N'; expected a unit: Nm"),
        ({"signals__displacement__channels__x": "angle"}, r"no channel 'angle'; expected one of 'angle_rad'"),
    ],
)
def test_bad_sidecars_are_named(tmp_path, fields, message):
    path = files(tmp_path, *ankle(), sidecar=changed(**fields))
    with pytest.raises(ValueError, match=message):
        import_recording([path])


def test_degrees_declared_radians_are_named_by_the_inertia(tmp_path):
    angle, torque = ankle()
    with pytest.raises(ValueError, match=r"inertia comes out at 0.000\d+ kg m\^2; expected .*an angle in degrees"):
        import_recording([files(tmp_path, np.degrees(angle), torque)])


def slow(delay):
    """Angle up to 3 Hz and torque that the limb exerts, with a reflex that answers to velocity after a delay."""
    time = np.arange(round(24 * RATE)) / RATE
    angle, torque = 0 * time, 0 * time
    for f in (0.5, 1.0, 1.3, 1.7, 2.1, 2.5, 2.9):
        s, wn = 2j * np.pi * f, 2 * np.pi * 4.0
        reflex = 4.0 * s * np.exp(-s * delay) * wn**2 / (s**2 + 1.5 * wn * s + wn**2)
        tone = 0.01 * np.exp(s * time + 1j * f)
        angle, torque = angle + tone.real, torque - ((0.012 * s**2 + 0.9 * s + 70.0 + reflex) * tone).real
    return angle, torque + 0.005 * np.random.default_rng(3).normal(size=len(time))


@pytest.mark.parametrize("body", ["hand", "handle"])
def test_a_reflex_that_looks_like_inertia_of_the_other_sign_refuses_no_slow_movement(tmp_path, body):
    path = files(tmp_path, *slow(0.045), sidecar=changed(signals__force__exerted_by=body))
    recording, notes = import_recording([path])
    assert recording.sizes["trial"] == 1
    note = next(note for note in notes if "too slow to show the sign of force" in note)
    assert "inertia comes out at " + "-" * (body == "hand") + "0.1" in note
    # A joint resists what moves it, however slow that is.
    assert ("exerted_by the other" in note) == (body == "handle")
    kept = tmp_path / "kept.nc"
    save_recording(recording, kept)
    assert import_recording([kept]).notes == (f"{kept}: {note}",)


@pytest.mark.parametrize("noise", [0.0, 1e-4])
@pytest.mark.parametrize("body", ["hand", "handle"])
def test_a_sine_shows_no_sign_of_force(tmp_path, body, noise):
    time, s = np.arange(round(12 * RATE)) / RATE, 2j * np.pi * 3.0
    tone = 0.05 * np.exp(s * time)
    angle = tone.real + noise * np.random.default_rng(3).normal(size=len(time))
    torque = -((INERTIA * s**2 + 0.6 * s + 40.0) * tone).real
    notes = import_recording([files(tmp_path, angle, torque, sidecar=changed(signals__force__exerted_by=body))]).notes
    assert any("nearly a sine" in note and "unchecked" in note for note in notes)


def test_a_constant_angle_and_a_saturated_torque_are_named(tmp_path):
    angle, torque = ankle()
    with pytest.raises(ValueError, match=r"angle_rad \(displacement\) is constant at 0.1"):
        import_recording([files(tmp_path, np.full_like(angle, 0.1), torque)])
    with pytest.raises(ValueError, match=r"torque_Nm \(force\) is clipped at"):
        import_recording([files(tmp_path, angle, np.clip(torque, None, np.quantile(torque, 0.9)))])


def test_an_imposed_movement_is_no_force_servo(tmp_path):
    sidecar = changed(servo="force")
    sidecar["signals"]["perturbation"] = {"channels": {"x": "d"}, "unit": "Nm"}
    path = files(tmp_path, *ankle(), sidecar=sidecar, d=np.random.default_rng(1).normal(size=2400))
    with pytest.raises(ValueError, match=r"d - f does not move.*servo = position for an imposed movement"):
        import_recording([path])


def test_two_axes_have_no_servo():
    signals = {name: np.random.default_rng(2).normal(size=(1, 50, 2)) for name in ("perturbation", "force")}
    labels = {"subject": ["A"], "task": ["PT"], "condition": ["PT"], "repetition": [0], "pulse_level": [0.0]}
    missing = ("pulse_direction", "pulse_onset", "l_h", "l_f", "theta_s_deg", "theta_e_deg", "limit_time")
    recording = make_recording(
        signals | {"displacement": signals["force"]}, labels | {name: [np.nan] for name in missing}, 50
    )
    with pytest.raises(ValueError, match="servo = 'position' with two axes"):
        check_recording(recording.assign_attrs(servo="position"))


@pytest.mark.parametrize(
    ("said", "unit"),
    [({}, "m"), ({"joint": "ankle"}, "rad"), ({"joint": "ankle", "angular": False}, "m"), ({"angular": True}, "rad")],
)
def test_arrays_of_one_axis_need_no_arm_and_of_a_joint_are_angles(said, unit):
    angle, torque = (signal[None, :, None] for signal in ankle())
    labels = {"subject": ["A"], "task": ["PT"], "condition": ["PT"], "repetition": [0], "pulse_level": [0.0]}
    labels |= {name: [np.nan] for name in ("pulse_direction", "pulse_onset", "limit_time")}
    recording = make_recording({"force": torque, "displacement": angle}, labels, RATE, servo="position", **said)
    assert recording["displacement"].attrs["units"] == unit
    assert np.isnan([recording[name].item() for name in ARM_LABELS]).all()


def test_archives_with_objects_or_false_sizes_are_refused(tmp_path):
    path = files(tmp_path, *ankle())
    np.savez(path, angle_rad=np.array([{}], dtype=object), torque_Nm=np.zeros(4))
    with pytest.raises(ValueError, match="'angle_rad' holds objects; expected numbers"):
        import_recording([path])
    path.write_bytes(b"PK\x03\x04 and nothing more")
    with pytest.raises(ValueError, match="not a readable NPZ file"):
        import_recording([path])
