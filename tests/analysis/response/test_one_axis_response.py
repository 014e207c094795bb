"""Response of one axis, by Python and by the command, against the closed form of independent simulated people."""

import csv

import numpy as np
import one_joint
import pytest
from scipy import signal
from test_cli import refused, run

import armperturb as ap
from armperturb.recording_files import save_recording


def truth(person, frequency, servo):
    impedance = one_joint.impedance(person, frequency)
    return (impedance if servo == "position" else 1.0 / impedance)[:, None, None]


@pytest.fixture(scope="module")
def recordings():
    """Servo and reflex to a recording and its person."""
    made = {}
    for servo in ("position", "force"):
        for reflex in ("linear", "half-wave"):
            person = one_joint.person("ankle", 9, reflex)
            made[servo, reflex] = one_joint.recording(person, 9, servo, duration=40.0, decibel=17.0), person
    return made


@pytest.mark.slow(reason="four simulated people")
@pytest.mark.parametrize(
    ("servo", "kind", "units"), [("position", "impedance", "Nm/rad"), ("force", "admittance", "rad/Nm")]
)
def test_bands_hold_the_true_response(recordings, servo, kind, units):
    recording, person = recordings[servo, "linear"]
    estimate = ap.response(recording, window_start=1.0)
    assert (estimate.kind, estimate.units) == (kind, units)
    assert np.mean(estimate.covers(truth(person, estimate.frequency, servo))) > 0.8
    error = np.abs(estimate.response - truth(person, estimate.frequency, servo)) / np.abs(estimate.response)
    assert np.median(error) < 0.1
    names = ("displacement", "force") if servo == "position" else ("perturbation", "displacement")
    signals = [recording[name].values[0, 1000:, 0] for name in names]
    frequency, welch = signal.coherence(*signals, fs=one_joint.RATE, nperseg=4096)
    # Where the response bends within the band of an average, Welch's coherence is too low.
    assert np.median(estimate.coherence - np.interp(estimate.frequency, frequency, welch)) == pytest.approx(
        0.0, abs=0.03
    )


@pytest.mark.slow(reason="shares the people above")
@pytest.mark.parametrize("servo", ["position", "force"])
def test_a_one_sided_reflex_is_distortion_and_a_linear_one_is_none(recordings, servo):
    linear, one_sided = (
        ap.response(recordings[servo, reflex][0], window_start=1.0) for reflex in ("linear", "half-wave")
    )
    assert linear.p_linear > 0.01
    assert one_sided.p_linear < 1e-4
    assert np.mean(linear.distortion > linear.distortion_limit) < 0.2
    assert np.mean(one_sided.distortion > one_sided.distortion_limit) > 0.3


@pytest.mark.slow(reason="draws a figure")
def test_the_command_writes_table_and_figure(recordings, tmp_path, capsys):
    save_recording(recordings["position", "linear"][0], tmp_path / "ankle.nc")
    assert run("response", tmp_path / "ankle.nc", "--out", tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert "Impedance of S" in said
    assert "distortion that follows the modulus of the velocity" in said
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"response.csv", "response.svg"}
    with (tmp_path / "out" / "response.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert set(rows[0]) >= {"frequency_hz", "gain", "radius_95", "coherence", "distortion", "unit", "condition"}
    assert {(row["unit"], row["subject"], row["joint"]) for row in rows} == {("Nm/rad", "S", "ankle")}
    for options, message in (
        (("--method", "arx"), "method = 'arx'"),
        (("--what", "total"), "what = 'total' on a position servo"),
        (("--period", "4"), "period = 4; expected none of one axis"),
    ):
        line = refused(capsys, "response", tmp_path / "ankle.nc", "--out", tmp_path / "other", *options)
        assert message in line


def test_a_constant_angle_is_named():
    recording = one_joint.recording(one_joint.person("ankle", 3), 3, duration=5.0)
    recording["displacement"][:] = 0.0
    with pytest.raises(ValueError, match=r"displacement.* constant"):
        ap.response(recording)


def test_what_follows_the_workspace_limit_does_not_count():
    recording = one_joint.recording(one_joint.person("ankle", 3, "none"), 3, duration=12.0)
    spoiled = recording.assign_coords(limit_time=("trial", [9.0], recording["limit_time"].attrs)).copy(deep=True)
    spoiled["force"][:, 9000:] = 50.0
    until, cut = (ap.response(each, frequency=[2.0, 5.0]) for each in (spoiled, recording.isel(time=slice(0, 9000))))
    np.testing.assert_array_equal(until.response, cut.response)
    assert "are used up to the first time that one did: 9 s" in until.summary()
    assert not cut.remarks


def test_a_sine_is_named():
    recording = one_joint.recording(one_joint.person("ankle", 3, "none"), 3, duration=12.0)
    tone = 0.05 * np.sin(2.0 * np.pi * 2.0 * recording["time"].values)
    with pytest.raises(ValueError, match=r"the movement has power at too few frequencies near .* expected a band"):
        ap.response(recording.assign(displacement=recording["displacement"].copy(data=tone[None, :, None])))


@pytest.mark.slow(reason="identifies many arms")
def test_circles_hold_the_mean_over_trials_that_differ():
    held, high = [], []
    for seed in range(6):
        joint = one_joint.person("ankle", seed, "none")
        found = ap.response(one_joint.trials(joint, seed, 0.08, n_trials=6, duration=10.0))
        expected = truth(joint, found.frequency, "position")
        held.append(found.covers(expected).mean())
        high.append(found.covers(expected)[found.frequency > 3.0].mean())
    # Of noise alone, circles would hold a half of them, and a fifth above 3 Hz.
    assert np.mean(held) > 0.88
    assert np.mean(high) > 0.85
