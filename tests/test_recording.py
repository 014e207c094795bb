"""The log format: complete, checked, saved whole, loaded the same."""

import numpy as np
import pytest
import xarray as xr

from armperturb.recording import REQUIRED_SIGNALS, check_recording, load_recording, make_recording, save_recording

N_TRIALS, N_TIME = 2, 50


@pytest.fixture
def recording():
    rng = np.random.default_rng(0)
    signals = {name: rng.normal(size=(N_TRIALS, N_TIME, 2)) for name in (*REQUIRED_SIGNALS, "joint_angle")}
    trials = {
        "subject": ["A", "B"],
        "task": ["PT", "RT"],
        "condition": ["PT7.5", "RT7.5"],
        "repetition": [0, 1],
        "pulse_level": [0.0, 1.0],
        "pulse_direction": [np.nan, 20.0],
        "pulse_onset": [np.nan, 0.1],
        "l_h": [0.3, 0.31],
        "l_f": [0.3, 0.31],
        "theta_s_deg": [22.5, 22.5],
        "theta_e_deg": [82.3, 82.3],
        "limit_time": [np.nan, np.nan],
    }
    return make_recording(signals, trials, 200.0)


def test_dims_labels_and_units(recording):
    assert recording["force"].dims == ("trial", "time", "axis")
    assert recording["joint_angle"].dims == ("trial", "time", "joint")
    assert list(recording["axis"].values) == ["x", "y"]
    assert list(recording["joint"].values) == ["shoulder", "elbow"]
    assert recording["time"].values[-1] == pytest.approx((N_TIME - 1) / 200)
    units = {name: recording[name].attrs["units"] for name in recording.data_vars}
    assert units == {"perturbation": "N", "force": "N", "displacement": "m", "joint_angle": "rad"}


def test_file_gives_back_the_same_recording(recording, tmp_path):
    save_recording(recording, tmp_path / "r.nc")
    loaded = load_recording(tmp_path / "r.nc")
    assert loaded.identical(recording)
    assert [path.name for path in tmp_path.iterdir()] == ["r.nc"]


def test_single_trials_can_be_saved_too(recording, tmp_path):
    save_recording(recording.isel(trial=[1]), tmp_path / "r.nc")
    assert load_recording(tmp_path / "r.nc")["subject"].values.tolist() == ["B"]


def test_a_failed_save_leaves_the_old_file_and_nothing_else(recording, tmp_path, monkeypatch):
    path = tmp_path / "r.nc"
    save_recording(recording, path)
    before = path.read_bytes()

    def fail(self, target, **options):
        target.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(xr.Dataset, "to_netcdf", fail)
    with pytest.raises(OSError, match="disk full"):
        save_recording(recording, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["r.nc"]


def with_nan(recording):
    changed = recording.copy(deep=True)
    changed["force"][1, 7, 0] = np.nan
    return changed


def with_units(recording):
    changed = recording.copy(deep=True)
    changed["displacement"].attrs["units"] = "mm"
    return changed


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: r.drop_vars("force"), "variable 'force' is missing; expected perturbation, force, displacement"),
        (with_nan, "force of trial 1 is nan at sample 7; expected finite values"),
        (with_units, "displacement has units 'mm'; expected 'm'"),
        (lambda r: r.transpose("time", "trial", ...), r"has dims .*; expected \('trial', 'time', 'axis'\)"),
        (lambda r: r.isel(time=slice(None, None, 4)), "time runs at 50 Hz.*expected even steps .* rate = 200 Hz"),
        (lambda r: r.assign_attrs(rate=100.0), "time runs at 200 Hz.*rate = 100 Hz"),
        (lambda r: r.assign_attrs(rate=-1.0), "rate = -1.0; expected the sampling rate in Hz"),
        (lambda r: r.drop_attrs(deep=False), "rate = None; expected the sampling rate in Hz"),
        (lambda r: r.isel(time=[0, 1, 2, 10, 11]), "sample 3 is at 0.05 s"),
        (lambda r: r.isel(trial=[]), "there are no trials; expected at least one"),
        (lambda r: r.assign(force=r["force"].astype(str)), "force holds values of type .*; expected numbers"),
        (lambda r: r.assign_coords(time=r["time"].astype(str)), "time holds values of type .*; expected numbers"),
        (lambda r: r.assign_coords(l_h=("trial", ["a", "b"])), "l_h holds values of type .*; expected numbers"),
        (lambda r: r.assign_coords(pulse_onset=("trial", [np.inf, 1.0])), "pulse_onset is infinite in a trial"),
        (lambda r: r.drop_vars("pulse_onset"), "coordinate 'pulse_onset' along trial is missing"),
        (lambda r: r.drop_vars("axis"), "dimension 'axis' is not labelled; expected x, y"),
        (lambda r: r.isel(axis=[1, 0]), "dimension 'axis' is not labelled; expected x, y"),
    ],
)
def test_bad_recordings_are_named(recording, damage, message):
    with pytest.raises(ValueError, match=message):
        check_recording(damage(recording), source="r.nc")


def test_unreadable_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none.nc: no such file, or a folder; expected a recording"):
        load_recording(tmp_path / "none.nc")
    (tmp_path / "text.nc").write_text("not netCDF")
    with pytest.raises(ValueError, match=r"text.nc: not a readable netCDF4 file"):
        load_recording(tmp_path / "text.nc")


def test_truncated_files_are_named(recording, tmp_path):
    save_recording(recording, tmp_path / "r.nc")
    whole = (tmp_path / "r.nc").read_bytes()
    (tmp_path / "r.nc").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"r.nc: "):
        load_recording(tmp_path / "r.nc")
