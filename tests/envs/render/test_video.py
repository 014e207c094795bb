"""Videos of recorded trials: what is in the file, what is refused, and what is left behind."""

import ctypes.util
import itertools
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import imageio_ffmpeg
import numpy as np
import pytest

from armperturb import cli
from armperturb.analysis.measures.kinematics import hand_position
from armperturb.envs.render import gl, video, viewer
from armperturb.envs.render.camera import DISTURBANCE, REACTION, Camera
from armperturb.envs.render.clip import SMALLEST
from armperturb.envs.render.overlay import StripChart, clock_text, text_size
from armperturb.envs.render.replay import Replay
from armperturb.envs.render.video import Clip, arrow_scale, frame_times, frames, scale_axes, write_video
from armperturb.plots import style
from armperturb.recording import make_recording
from armperturb.recording_files import save_recording
from armperturb.subject import RELAX

pytestmark = pytest.mark.slow(reason="draws pictures and encodes them")

needs_gl = pytest.mark.skipif(
    sys.platform == "linux" and not (ctypes.util.find_library("EGL") or ctypes.util.find_library("GL")),
    reason="no GL library on this machine",
)
RATE = 100.0


def recorded(signals=("joint_angle",), **changed):
    """Two trials of 2 s: the hand goes round, the disturbance is a pulse at 1 s, f is a third of it."""
    time = np.arange(200) / RATE
    angle = np.radians([22.5, 82.3]) + 0.1 * np.column_stack([np.sin(3 * time), 1 - np.cos(3 * time)])
    start = hand_position(np.radians([22.5, 82.3]), 0.33, 0.34)
    d = np.zeros((200, 2))
    d[100:108] = [30.0, 10.0]
    values = {
        "perturbation": d,
        "force": d / 3,
        "displacement": hand_position(angle, 0.33, 0.34) - start,
        "joint_angle": angle,
        "shoulder_marker": np.full((200, 2), 0.01),
    }
    trials = {
        "subject": ["S07", "S07"],
        "task": ["RT", "RT"],
        "condition": ["RT7.5", "RT7.5"],
        "repetition": [0, 1],
        "pulse_level": [1.0, 0.0],
        "pulse_direction": [20.0, np.nan],
        "pulse_onset": [1.0, np.nan],
        "l_h": [0.33, 0.33],
        "l_f": [0.34, 0.34],
        "theta_s_deg": [22.5, 22.5],
        "theta_e_deg": [82.3, 82.3],
        "limit_time": [np.nan, np.nan],
    } | changed
    kept = ("perturbation", "force", "displacement", *signals)
    return make_recording({name: np.stack([values[name]] * 2) for name in kept}, trials, RATE)


@pytest.fixture
def replay():
    return Replay.of_trial(recorded(), 0)


def with_signals(replay, disturbance, reaction, displacement):
    """A replay with other signals, of one sample."""
    signals = {"disturbance": disturbance, "reaction": reaction, "displacement": displacement}
    return replace(replay, **{name: np.array([value]) for name, value in signals.items()})


SMALL = Clip(size=SMALLEST, start=1.0, stop=1.2)


def decoded(path):
    """Frame rate and frames of a file, (frame, height, width, 3), as the encoder itself reads them."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    about = done.stderr.decode()
    width, height = map(int, re.search(r"Video: .*?, (\d+)x(\d+)", about).groups())
    rate = float(re.search(r"([\d.]+) fps", about).group(1))
    return rate, np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)


@needs_gl
@pytest.mark.parametrize(
    ("name", "view", "slow", "shape", "rate"),
    [
        ("a.mp4", "both", 1.0, (6, 360, 640, 3), 30.0),
        ("a.GIF", "oblique", 2.0, (8, 360, 320, 3), 20.0),
    ],
)
def test_a_file_has_the_frames_that_were_asked_for(replay, tmp_path, name, view, slow, shape, rate):
    clip, told = replace(SMALL, view=view, slow=slow), []
    write_video(replay, tmp_path / name, clip, progress=lambda *done: told.append(done))
    found_rate, found = decoded(tmp_path / name)
    assert found.shape == shape
    assert found_rate == rate
    assert told[-1] == (shape[0], shape[0])
    drawn = np.stack(list(frames(replay, clip, frame_times(replay, clip, rate))))
    # A codec loses detail, but no frame is another one, upside down, or in other colours.
    assert np.abs(found.astype(float) - drawn).mean() < 8.0
    assert [path.name for path in tmp_path.iterdir()] == [name]


@needs_gl
def test_both_views_stand_side_by_side_over_the_chart(replay):
    both, top, oblique = (
        next(frames(replay, replace(SMALL, view=view), np.array([1.05]))) for view in ("both", "top", "oblique")
    )
    np.testing.assert_array_equal(both[:240, :320], top[:240])
    # Title and clock stand in the first view alone.
    np.testing.assert_array_equal(both[40:240, 320:], oblique[40:240])
    assert (both[:20, 320:400] != oblique[:20, :80]).any()


def test_frames_are_evenly_spaced_in_the_trial(replay):
    times = frame_times(replay, Clip(slow=4.0, start=0.5, stop=1.5), 30.0)
    np.testing.assert_allclose(times, 0.5 + np.arange(120) / 120.0)
    assert len(frame_times(replay, Clip(), 30.0)) == 60
    assert len(frame_times(replay, Clip(slow=0.5), 30.0)) == 30


def test_a_pulse_that_is_slowed_down_is_shown_alone(replay):
    assert Clip(slow=10.0).window(replay) == pytest.approx((0.8, 2.0))
    assert Clip().window(replay) == pytest.approx((0.0, 2.0))
    assert Clip(slow=10.0, start=0.1).window(replay) == pytest.approx((0.1, 2.0))
    assert Clip(slow=10.0, stop=0.5).window(replay) == pytest.approx((0.0, 0.5))
    no_pulse = Replay.of_trial(recorded(), 1)
    assert Clip(slow=10.0).window(no_pulse) == pytest.approx((0.0, 2.0))
    assert no_pulse.title == "S07, RT7.5"
    assert replay.title == "S07, RT7.5, pulse level 1 at 20°"


@pytest.mark.parametrize("level", [0.0, np.nan])
def test_a_pulse_without_a_level_has_none_in_its_title(level):
    assert Replay.of_trial(recorded(pulse_level=[level, 0.0]), 0).title == "S07, RT7.5, pulse at 20°"


def test_what_follows_the_limit_of_the_workspace_is_not_shown():
    replay = Replay.of_trial(recorded(limit_time=[1.5, 0.5]), 0)
    assert Clip().window(replay) == pytest.approx((0.0, 1.5))
    assert Clip(slow=10.0).window(replay) == pytest.approx((0.8, 1.5))
    assert frame_times(replay, Clip(), 30.0).max() < 1.5
    assert replay.title.endswith("limit at 1.50 s")
    before_its_pulse = Replay.of_trial(recorded(limit_time=[0.5, np.nan]), 0)
    assert Clip(slow=10.0).window(before_its_pulse) == pytest.approx((0.0, 0.5))


@pytest.mark.parametrize("option", ["--start", "--stop"])
def test_refuses_to_show_what_follows_the_limit(tmp_path, capsys, option):
    save_recording(recorded(limit_time=[1.5, np.nan]), tmp_path / "rec.nc")
    found = refused(capsys, "video", tmp_path / "rec.nc", "--trial", 0, "--out", tmp_path / "a.mp4", option, 1.8)
    assert "both in the trial of 2 s, before the limit of the workspace at 1.5 s" in found
    assert os.listdir(tmp_path) == ["rec.nc"]


@pytest.mark.parametrize("signals", [("joint_angle",), (), ("joint_angle", "shoulder_marker"), ("shoulder_marker",)])
def test_poses_are_those_of_the_recording(signals):
    recording = recorded(signals)
    replay = Replay.of_trial(recording, 0)
    angle = recorded()["joint_angle"].values[0]
    shoulder = np.zeros((200, 2))
    if "shoulder_marker" in signals:
        shoulder = replay.qpos[:, :2]
        np.testing.assert_allclose(shoulder, 0.01, rtol=1e-6)
    if "joint_angle" in signals or not signals:
        np.testing.assert_allclose(replay.qpos[:, -4:-2], angle, atol=1e-9)
    else:  # the hand is at the handle, as it moves with the shoulder
        start = hand_position(np.radians([22.5, 82.3]), 0.33, 0.34)
        hand = shoulder + hand_position(replay.qpos[:, -4:-2], 0.33, 0.34)
        np.testing.assert_allclose(hand - start, replay.displacement, atol=1e-9)
    np.testing.assert_array_equal(replay.qpos[:, -2:], recording["displacement"].values[0])
    assert replay.qpos.shape == (200, replay.model.nq)
    np.testing.assert_allclose(replay.at(replay.displacement, 0.005), replay.displacement[:2].mean(axis=0))


@needs_gl
def test_arrows_stay_in_the_picture_and_are_as_long_as_they_can_be(replay):
    with Camera(replay.model, width=160, height=120) as camera:
        for d, f, displacement in (
            ([50.0, 0.0], [0.0, 10.0], [0.0, 0.0]),
            ([0.0, 50.0], [0.0, -60.0], [0.0, 0.34]),
            ([0.0, 0.0], [0.0, 0.0], [0.0, 0.0]),
        ):
            scale = arrow_scale(camera, ("top", "oblique"), with_signals(replay, d, f, displacement))
            assert scale * max(np.linalg.norm(d), np.linalg.norm(f)) <= video.LONGEST_ARROW + 1e-12
            for force in (d, f):
                for view in ("top", "oblique"):
                    column, row = camera.project(camera.handle(displacement) + scale * np.array([*force, 0.0]), view)
                    assert 0 < column < 160
                    assert 0 < row < 120
        alone = with_signals(replay, [9.0, 0.0], [0.0, 0.0], [0.0, 0.0])
        assert arrow_scale(camera, ("top",), alone) == pytest.approx(video.LONGEST_ARROW / 9.0)


@needs_gl
@pytest.mark.parametrize("size", [SMALLEST, (640, 480)])
def test_the_scale_can_be_read_and_is_true(replay, size):
    with Camera(replay.model, width=size[0], height=size[1]) as camera:
        for scale, view in itertools.product((0.3 / 37, 0.3 / 150, 0.05), ("top", "oblique")):
            force, axes = scale_axes(camera, view, scale)
            lengths = np.linalg.norm(axes, axis=1)
            assert lengths.min() > 10.0
            assert lengths.max() < size[1] / 3
            assert f"{force:.6e}"[:8] in ("1.000000", "2.000000", "5.000000")
            for axis, found in zip(np.eye(3)[:2], axes, strict=True):
                ends = camera.project(np.add(camera.handle(), [np.zeros(3), force * scale * axis]), view)
                np.testing.assert_allclose(found, ends[1] - ends[0], atol=1e-9)


@needs_gl
def test_a_frame_shows_forces_while_they_act(replay):
    clip = replace(SMALL, view="top", start=0.5, stop=1.5)
    during, after = frames(replay, clip, np.array([1.04, 1.3]))

    def vermillion(picture):
        red, green, blue = picture[60:240].astype(int).transpose(2, 0, 1)
        return np.count_nonzero((red > 150) & (green > 50) & (green < 140) & (blue < 60))

    assert vermillion(during) > vermillion(after) + 50


@pytest.mark.parametrize(
    ("time", "slow", "text"),
    [
        (12.345, 10.0, "t = 12.35 s, 10 × slower"),
        (0.0, 1.0, "t = 0.00 s"),
        (3.0, 0.5, "t = 3.00 s, 2 × faster"),
    ],
)
def test_clock(time, slow, text):
    assert clock_text(time + 1e-9, slow) == text


@needs_gl
def test_the_clock_is_in_the_frame(replay):
    clip = replace(SMALL, view="top")
    hold = replace(replay, qpos=np.repeat(replay.qpos[:1], 200, axis=0), displacement=np.zeros((200, 2)))
    first, second = frames(hold, clip, np.array([1.15, 1.16]))
    rows, columns = np.nonzero((first[:240] != second[:240]).any(axis=2))
    assert len(rows)
    assert rows.max() < 40, "nothing but the clock goes on"
    assert columns.max() < 160


def test_strip_chart_moves_its_line_and_pales_what_is_to_come(replay):
    time = np.linspace(2.0, 4.0, 201)
    d = np.column_stack([np.sin(9 * time), np.cos(9 * time)])
    shown = replace(replay, time=time, disturbance=d, reaction=0.5 * d, displacement=0.1 * d)
    chart = StripChart(shown, width=640, height=240, unit=16)
    start, middle, end = (chart.at(now).astype(int) for now in (2.0, 3.0, 4.0))
    assert middle.shape == (240, 640, 3)

    def line(picture):
        """Column that is darkest over the height of a panel."""
        return picture[60:80].sum(axis=(0, 2)).argmin()

    columns = [line(picture) for picture in (start, middle, end)]
    assert columns[1] == pytest.approx((columns[0] + columns[2]) / 2, abs=2)
    assert columns[2] - columns[0] > 400
    left, right = slice(columns[0] + 5, columns[1] - 5), slice(columns[1] + 5, columns[2] - 5)
    np.testing.assert_array_equal(middle[:, left], end[:, left])
    np.testing.assert_array_equal(middle[:, right], start[:, right])
    assert (255 - end[40:90, right]).sum() > 2 * (255 - middle[40:90, right]).sum()


@pytest.mark.parametrize(
    ("size", "force", "displacement", "start"),
    [
        (SMALLEST, 1.0, 1.0, 0.0),
        ((SMALLEST[0], 960), 1.0, 1.0, 0.0),
        (SMALLEST, 1e-3, 1e-4, 2.0),  # long labels at ticks
        (SMALLEST, 1e-9, 1e-17, 3000.0),  # powers of ten
    ],
)
def test_nothing_that_is_written_in_the_strip_chart_is_cut_off(replay, size, force, displacement, start):
    time = start + np.linspace(0.0, 0.03, 4)
    path = np.linspace([0.0, -1.0], [1.0, 4.0], 4)
    shown = replace(
        replay, time=time, disturbance=force * path, reaction=-force * path, displacement=0.01 * displacement * path
    )
    chart = StripChart(shown, width=size[0], height=size[1] // 2, unit=text_size(*size)).at(start)
    for edge in (chart[:, 0], chart[:, -1], chart[0], chart[-1]):
        assert (edge == 255).all()


@pytest.mark.parametrize(
    ("largest", "expected"),
    [(54.0, 50.0), (19.9, 10.0), (20.0, 20.0), (0.3, 0.2), (1.0, 1.0), (999.0, 500.0), (999.9999999999999, 1000.0)],
)
def test_forces_of_the_scale_are_round(largest, expected):
    assert style.round_number_below(largest) == pytest.approx(expected)


def test_colours_are_those_of_the_figures():
    assert {DISTURBANCE, REACTION} == set(style.COLOURS.values())


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "rec.nc"
    save_recording(recorded(), path)
    return path


@pytest.fixture
def file(saved, tmp_path):
    return shutil.copy(saved, tmp_path / "rec.nc")


def refused(capsys, *arguments):
    """Run a command that must fail and return its one line."""
    assert cli.main([str(argument) for argument in arguments]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("armperturb: error: ")
    return lines[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--trial", 2), "trial = 2; expected 0 to 1"),
        (("--trial", -1), "trial = -1; expected 0 to 1"),
        (("--size", 641, 480), "width = 641; expected a multiple of 2 pixels"),
        (("--size", 640, 482), "height = 482; expected a multiple of 4 pixels"),
        (("--size", 64, 48), "width = 64; expected a finite number at least 320 and at most 1920"),
        (("--size", 640, 4800), "height = 4800; expected a finite number at least 240 and at most 1440"),
        (("--slow", 0), "slow = 0.0; expected a finite number above 0"),
        (("--slow", -3), "slow = -3.0; expected a finite number above 0"),
        (("--slow", "nan"), "slow = nan; expected a finite number above 0"),
        (("--start", 3), "from 3 s to 2 s; expected a start before the stop, and both in the trial of 2 s"),
        (("--stop", 2.5), "expected a start before the stop, and both in the trial of 2 s"),
        (("--out", "a.avi"), "ending '.avi'; expected .mp4 or .gif"),
        (("--out", "a"), "ending ''; expected .mp4 or .gif"),
        (("--out", "nowhere/a.mp4"), "folder nowhere does not exist"),
        (("--out", "folder.mp4"), "is a folder"),
    ],
)
def test_refusals_of_video(file, capsys, monkeypatch, options, message):
    monkeypatch.chdir(file.parent)
    (file.parent / "folder.mp4").mkdir()
    arguments = {"--trial": (0,), "--out": ("a.mp4",), **{options[0]: options[1:]}}
    assert message in refused(
        capsys, "video", file, *(word for name, values in arguments.items() for word in (name, *values))
    )
    assert sorted(path.name for path in file.parent.iterdir()) == ["folder.mp4", "rec.nc"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"l_h": [np.nan, 0.3]}, "l_h of trial 0 is nan; expected the subject's, to draw it"),
        ({"theta_e_deg": [np.nan, 80.0]}, "theta_e_deg of trial 0 is nan"),
        ({"l_f": [-0.3, 0.3]}, "trial 0: Subject: l_f = -0.3"),
    ],
)
def test_refuses_a_trial_that_does_not_tell_the_arm(tmp_path, capsys, changed, message):
    save_recording(recorded(**changed), tmp_path / "rec.nc")
    found = refused(capsys, "video", tmp_path / "rec.nc", "--trial", 0, "--out", tmp_path / "a.mp4")
    assert message in found
    assert "rec.nc" in found


def test_refuses_a_hand_out_of_reach():
    recording = recorded(())
    recording["displacement"][0, 150] = [0.3, 0.3]
    with pytest.raises(ValueError, match=r"rec: trial 0: the hand is 0\.9\d\d m from the shoulder"):
        Replay.of_trial(recording, 0, "rec")


def test_one_axis_is_no_arm(tmp_path, capsys):
    angle = np.sin(np.arange(200.0))[None, :, None]
    labels = {"subject": "A", "task": "PT", "condition": "PT", "repetition": 0, "pulse_level": 0.0}
    nan = ("pulse_direction", "pulse_onset", "limit_time", "l_h", "l_f", "theta_s_deg", "theta_e_deg")
    trials = {name: [value] for name, value in (labels | dict.fromkeys(nan, np.nan)).items()}
    recording = make_recording({"force": angle, "displacement": angle}, trials, 100.0, servo="position", angular=True)
    save_recording(recording, tmp_path / "rec.nc")
    found = refused(capsys, "video", tmp_path / "rec.nc", "--trial", 0, "--out", tmp_path / "a.mp4")
    assert "rec.nc: a recording of one axis cannot be drawn as an arm; expected one of two axes" in found


def test_without_gl_names_the_package_and_leaves_nothing(file, capsys, monkeypatch):
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    monkeypatch.setitem(sys.modules, "mujoco.osmesa", None)
    monkeypatch.setattr("sys.platform", "linux")
    gl.headless_backend.cache_clear()
    found = refused(capsys, "video", file, "--trial", 0, "--out", file.parent / "a.mp4")
    assert "apt-get install libegl1" in found
    assert os.listdir(file.parent) == ["rec.nc"]


# mediapy leaves the pipes of an encoder that failed to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@needs_gl
def test_a_failing_encoder_leaves_the_old_file(file, capsys, monkeypatch):
    out = file.parent / "a.mp4"
    out.write_bytes(b"old")
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: "/bin/false")
    options = ("--trial", 0, "--out", out, "--size", *SMALLEST, "--stop", 0.2, "--overwrite")
    assert "a.mp4: the encoder failed" in refused(capsys, "video", file, *options)
    assert out.read_bytes() == b"old"
    assert sorted(os.listdir(file.parent)) == ["a.mp4", "rec.nc"]


@needs_gl
def test_command_writes_a_video(file, capsys):
    out = file.parent / "a.MP4"
    options = ("--trial", 0, "--out", out, "--size", *SMALLEST, "--stop", 0.2, "--view", "top")
    assert cli.main([str(word) for word in ("video", file, *options)]) == 0
    assert capsys.readouterr().out == f"video: {out}\n"
    assert decoded(out)[1].shape == (6, 360, 320, 3)


def test_viewer_says_where_there_is_no_display(file, capsys, monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert "no display (DISPLAY and WAYLAND_DISPLAY are not set)" in refused(capsys, "view")
    assert "no display" in refused(capsys, "view", file)


@pytest.fixture
def window(monkeypatch):
    """A window that a user closes after some frames, in place of MuJoCo's; it keeps what it showed."""

    class Window:
        def __init__(self, model, data):
            self.model, self.data, self.shown = model, data, []
            windows.append(self)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def is_running(self):
            return len(self.shown) < 12

        def lock(self):
            return self

        def sync(self):
            self.shown.append((self.data.time, self.data.qpos.copy()))

    windows = []
    monkeypatch.setattr(viewer, "open_window", Window)
    monkeypatch.setattr(viewer, "require_display", lambda: None)
    return windows


def test_viewer_replays_a_trial(file, window, replay):
    assert cli.main(["view", str(file), "--slow", "2"]) == 0
    for time, pose in window[0].shown:
        np.testing.assert_allclose(pose, replay.at(replay.qpos, time))
    assert 0.0 < window[0].shown[-1][0] - window[0].shown[0][0] < 1.0


def test_viewer_simulates_a_person_at_rest(window, tmp_path):
    RELAX.save(tmp_path / "person.toml")
    assert cli.main(["view", "--subject", str(tmp_path / "person.toml")]) == 0
    shown = window[0].shown
    assert shown[-1][0] > shown[0][0]
    np.testing.assert_allclose(shown[-1][1], [*RELAX.posture, 0.0, 0.0], atol=1e-9)


def test_viewer_refuses_what_does_not_go_together(file, window, capsys):
    assert "expected none together with a recording" in refused(capsys, "view", file, "--subject", "a.toml")
    assert "slow = 0.0; expected a finite number above 0" in refused(capsys, "view", file, "--slow", 0)
    assert "trial = 5; expected 0 to 1" in refused(capsys, "view", file, "--trial", 5)


def test_viewer_says_why_a_display_does_not_work(capsys, monkeypatch):
    monkeypatch.setattr(viewer, "has_display", lambda: True)
    monkeypatch.setitem(sys.modules, "glfw", SimpleNamespace(init=lambda: False))
    assert "no window can be opened (GLFW does not start)" in refused(capsys, "view")
