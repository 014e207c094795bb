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


RATE, INERTIA, DAMPING, STIFFNESS = 250.0, 0.003, 0.05, 2.0
DEVICE = 0.002, 0.02, 1.5
"""Inertia, damping and stiffness of the virtual environment."""


def impedance_of(parameters, frequency):
    s = 2j * np.pi * np.asarray(frequency)
    inertia, damping, stiffness = parameters
    return inertia * s**2 + damping * s + stiffness


def repeated(servo, lines, duration, n_trials, seed=0):
    """Trials of a linear limb under a multisine with these lines [Hz], whose torque is noisy, in closed form."""
    rng, n = np.random.default_rng(seed), round(duration * RATE)
    frequency = np.fft.rfftfreq(n, 1.0 / RATE)
    limb, device = (impedance_of(of, frequency) for of in ((INERTIA, DAMPING, STIFFNESS), DEVICE))
    time = np.arange(n) / RATE
    angle = 2.0 * np.pi * (np.asarray(lines)[:, None, None] * time + rng.random((len(lines), n_trials, 1)))
    moved = np.sin(angle).sum(axis=0) / np.sqrt(len(lines))
    noise = np.fft.rfft(rng.standard_normal((n_trials, n))) * 0.05 / (1.0 + frequency / 3.0)
    signals = {}
    if servo == "position":
        displacement = 0.03 * np.fft.rfft(moved)
    else:
        push = 0.5 * np.fft.rfft(moved)
        displacement = (push - noise) / (limb + device)
        signals["perturbation"] = np.fft.irfft(push, n)[..., None]
    signals |= {"displacement": np.fft.irfft(displacement, n)[..., None]}
    signals["force"] = np.fft.irfft(limb * displacement + noise, n)[..., None]
    labels = {"subject": "A", "task": "PT", "condition": "PT", "repetition": 0, "pulse_level": 0.0}
    labels |= dict.fromkeys(("pulse_direction", "pulse_onset", "limit_time"), np.nan)
    trials = {name: [value] * n_trials for name, value in labels.items()} | {"repetition": np.arange(n_trials)}
    return ap.make_recording(signals, trials, RATE, joint="wrist", servo=servo)


@pytest.mark.slow(reason="several records")
@pytest.mark.parametrize("servo", ["force", "position"])
@pytest.mark.parametrize(
    ("lines", "duration", "n_trials"),
    [
        ((0.5, 1.0, 1.5, 2.5, 3.5, 5.5, 8.0, 12.0), 20.0, 3),
        (np.arange(0.5, 15.0, 0.5), 30.0, 2),
        (np.arange(0.2, 12.0, 0.2), 20.0, 1),
        (np.arange(0.5, 12.0, 0.5), 60.0, 1),
        ((2.0,), 12.0, 1),
    ],
    ids=["8 lines", "29 lines", "59 lines", "far apart", "a sine"],
)
def test_an_input_that_repeats_tells_the_response_at_its_lines(servo, lines, duration, n_trials):
    held = []
    for seed in range(3):
        estimate = ap.response(repeated(servo, lines, duration, n_trials, seed))
        apart = np.abs(estimate.frequency[:, None] - np.asarray(lines)).min(axis=1)
        assert apart.max() < 1e-6
        assert len(estimate.frequency) >= min(len(lines), 20)
        limb = impedance_of((INERTIA, DAMPING, STIFFNESS), estimate.frequency)
        true = limb if servo == "position" else 1.0 / limb
        held.append(estimate.covers(true[:, None, None]).mean())
        assert np.median(np.abs(estimate.response[:, 0, 0] / true - 1.0)) < 0.15
        assert "nan" not in estimate.summary()
    assert np.mean(held) > 0.8


def test_responses_of_the_device_are_not_called_those_of_the_limb():
    recording = repeated("force", (0.5, 1.0, 2.5, 5.5), 12.0, 2)
    titles = {what: ap.response(recording, what=what).describe().title for what in ("arm", "environment", "total")}
    assert titles["arm"].startswith("Admittance of A")
    assert titles["environment"].startswith("Admittance of the manipulator of A")
    assert titles["total"].startswith("Admittance of limb and manipulator of A")


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
