"""The log format: complete, checked, saved whole, loaded the same."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

from armperturb.foreign.program import Refused, parse
from armperturb.joined_recordings import join_recordings
from armperturb.recording import (
    MUSCLES,
    REQUIRED_SIGNALS,
    TRIAL_COORDINATES,
    Action,
    check_recording,
    emg_highpass,
    make_recording,
    muscle_actions,
)
from armperturb.recording_files import load_recording, save_recording

N_TRIALS, N_TIME = 2, 50
ADC_STEP = float(np.float32(5.0 / 2**15))


def signals(names=(*REQUIRED_SIGNALS, "joint_angle")):
    rng = np.random.default_rng(0)
    return {name: rng.normal(size=(N_TRIALS, N_TIME, 2)) for name in names}


def labels():
    return {
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


@pytest.fixture
def recording():
    return make_recording(signals(), labels(), 200.0)


@pytest.fixture
def whole_recording():
    """With all that a laboratory records."""
    counts = np.random.default_rng(1).integers(-(2**15), 2**15, (N_TRIALS, 10 * N_TIME, len(MUSCLES)))
    emg = counts.astype(np.float32) * np.float32(ADC_STEP)
    return make_recording(
        {**signals((*REQUIRED_SIGNALS, "joint_angle", "shoulder_marker")), "emg": emg},
        {**labels(), "order": [7, 3]},
        200.0,
        emg_rate=2000.0,
        adc_step=ADC_STEP,
    )


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


@pytest.mark.slow(reason="writes and reads files")
def test_a_recording_of_lazy_arrays_is_saved_with_its_values(whole_recording, tmp_path):
    pytest.importorskip("dask.array")
    save_recording(whole_recording, tmp_path / "r.nc")
    with xr.open_dataset(tmp_path / "r.nc", chunks={}, decode_timedelta=False) as lazy:
        save_recording(lazy, tmp_path / "r.nc")  # under its name, too
    assert load_recording(tmp_path / "r.nc").equals(whole_recording)
    save_recording(whole_recording.chunk(), tmp_path / "again.nc")
    assert load_recording(tmp_path / "again.nc").identical(whole_recording)


def test_emg_has_its_own_clock_and_muscles(whole_recording):
    assert whole_recording["emg"].dims == ("trial", "emg_time", "muscle")
    assert whole_recording["emg"].attrs["units"] == "V"
    assert whole_recording["shoulder_marker"].attrs["units"] == "m"
    assert whole_recording["emg_time"].values[-1] == pytest.approx((10 * N_TIME - 1) / 2000)
    assert tuple(whole_recording["muscle"].values) == MUSCLES
    assert whole_recording["order"].values.tolist() == [7, 3]


@pytest.mark.slow(reason="simulates a recording")
def test_emg_is_16_bit_on_disk_and_the_same_in_memory(whole_recording, tmp_path):
    save_recording(whole_recording, tmp_path / "r.nc")
    loaded = load_recording(tmp_path / "r.nc")
    assert loaded.identical(whole_recording)
    assert loaded["emg"].dtype == np.float32
    with h5py.File(tmp_path / "r.nc") as file:
        assert file["emg"].dtype == np.int16
        assert file["emg"].attrs["scale_factor"] == pytest.approx(ADC_STEP)
    save_recording(loaded, tmp_path / "again.nc")
    assert (tmp_path / "again.nc").read_bytes() == (tmp_path / "r.nc").read_bytes()


def test_emg_of_a_laboratory_without_16_bits_stays_in_single_precision(tmp_path):
    emg = np.random.default_rng(1).normal(size=(N_TRIALS, 10 * N_TIME, len(MUSCLES)))
    recording = make_recording({**signals(), "emg": emg}, labels(), 200.0, emg_rate=2000.0)
    save_recording(recording, tmp_path / "r.nc")
    assert load_recording(tmp_path / "r.nc").identical(recording)


@pytest.mark.parametrize("value", [0.4 * ADC_STEP, 6.0])
def test_emg_that_16_bits_cannot_hold_is_named(whole_recording, tmp_path, value):
    whole_recording["emg"][1, 30, 2] = value
    with pytest.raises(
        ValueError, match=r"emg of trial 1 is .* at sample 30; expected 16-bit multiples of its adc_step"
    ):
        save_recording(whole_recording, tmp_path / "r.nc")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: r.assign_attrs(emg_rate=1000.0), "emg_time runs at 2000 Hz.*emg_rate = 1000 Hz"),
        (lambda r: r.drop_attrs(deep=False).assign_attrs(rate=200.0), "emg_rate = None; expected the sampling rate"),
        (lambda r: r.drop_vars("muscle"), "dimension 'muscle' is not labelled; expected the names of the muscles"),
        (lambda r: r.isel(muscle=[0, 0]), "muscle 'pectoralis_major_clavicular' comes twice; expected each once"),
        (lambda r: r.assign_coords(muscle_sign=("muscle", [2] * 8), muscle_joints=("muscle", ["s"] * 8)), "sign 2; ex"),
        (lambda r: r.rename(emg_time="t"), r"emg has dims .*; expected \('trial', 'emg_time', 'muscle'\)"),
    ],
)
def test_bad_emg_is_named(whole_recording, damage, message):
    with pytest.raises(ValueError, match=message):
        check_recording(damage(whole_recording))


def test_emg_without_a_rate_is_refused():
    emg = np.zeros((N_TRIALS, 10 * N_TIME, len(MUSCLES)))
    with pytest.raises(ValueError, match="emg_rate = None; expected the sampling rate of the EMG in Hz"):
        make_recording({**signals(), "emg": emg}, labels(), 200.0)


def test_single_trials_can_be_saved_too(recording, tmp_path):
    save_recording(recording.isel(trial=[1]), tmp_path / "r.nc")
    assert load_recording(tmp_path / "r.nc")["subject"].values.tolist() == ["B"]


@pytest.mark.slow(reason="writes and reads files")
def test_a_failed_save_leaves_the_old_file_and_nothing_else(recording, tmp_path, monkeypatch):
    path = tmp_path / "r.nc"
    save_recording(recording, path)
    before = path.read_bytes()

    def fail(self, content):
        with self.open("wb") as file:
            file.write(content[: len(content) // 2])
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="disk full"):
        save_recording(recording, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["r.nc"]


@pytest.mark.slow(reason="writes and reads long recordings")
def test_optional_signals_are_read_where_wanted(whole_recording, tmp_path):
    path = tmp_path / "r.nc"
    save_recording(whole_recording, path)
    names = [*REQUIRED_SIGNALS, "joint_angle"]
    assert load_recording(path, ["joint_angle"]).identical(whole_recording[names])
    assert load_recording(path, ["emg"]).identical(whole_recording[[*REQUIRED_SIGNALS, "emg"]])
    with h5py.File(path, "a") as file:
        file["emg"].attrs["units"] = "mV"
    assert load_recording(path, ["joint_angle"]).identical(whole_recording[names])
    with pytest.raises(ValueError, match="emg has units 'mV'"):
        load_recording(path)


def test_a_recording_may_lack_optional_signals_only(recording, tmp_path):
    path = tmp_path / "r.nc"
    save_recording(recording.drop_vars("joint_angle"), path)
    assert set(load_recording(path, ["joint_angle"]).data_vars) == set(REQUIRED_SIGNALS)
    with h5py.File(path, "a") as file:
        del file["force"]
    with pytest.raises(ValueError, match=r"r.nc: variable 'force' is missing; expected perturbation, force, displace"):
        load_recording(path, ["joint_angle"])
    with pytest.raises(ValueError, match="optional has 'force', 'torque'; expected some of joint_angle, shoulder_mark"):
        load_recording(path, ["force", "emg", "torque"])


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
        (lambda r: r.assign_coords(time=r["time"].where(r["time"] != r["time"][3])), "sample 3 is at nan s"),
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


def test_recordings_join_without_what_not_all_have(recording, whole_recording):
    joined = join_recordings([recording.isel(trial=[0]), whole_recording]).recording
    check_recording(joined)
    assert joined["subject"].values.tolist() == ["A", "A", "B"]
    assert set(joined.data_vars) == set(REQUIRED_SIGNALS)
    assert "order" not in joined
    np.testing.assert_array_equal(joined["force"].values[1:], whole_recording["force"].values)
    assert joined.attrs["rate"] == 200.0
    both = join_recordings([whole_recording, whole_recording]).recording
    assert both["order"].values.tolist() == [7, 3, 7, 3]


def test_recordings_of_different_clocks_do_not_join(recording):
    with pytest.raises(ValueError, match=r"a and b: trials of 0.15 s at 200 Hz and 0.25 s at 200 Hz; expected one"):
        join_recordings([recording, recording.isel(time=slice(30))], "a and b")


def chunks_of(path):
    """Variable to the place of its first chunk in the file."""
    with h5py.File(path) as file:
        written = {name: item for name, item in file.items() if item.chunks is not None}
        return {name: item.id.get_chunk_info(0).byte_offset for name, item in written.items()}


@pytest.mark.slow(reason="writes and reads files")
def test_damage_in_any_array_is_noticed(whole_recording, tmp_path):
    save_recording(whole_recording, tmp_path / "r.nc")
    content, places = (tmp_path / "r.nc").read_bytes(), chunks_of(tmp_path / "r.nc")
    assert set(places) == set(whole_recording.variables)
    for name, place in places.items():
        damaged = bytearray(content)
        damaged[place] ^= 1
        (tmp_path / "r.nc").write_bytes(damaged)
        with pytest.raises(Refused, match="not a readable netCDF4 file"):
            parse(str(tmp_path / "r.nc"), [name], 2**30)


def test_muscles_of_any_name_are_kept_with_what_they_do(whole_recording, tmp_path):
    actions = {"soleus": Action("", 0), "vastus": Action("se", -1), "biceps_short_head": Action("s", 1)}
    labels = {name: whole_recording[name].values for name in TRIAL_COORDINATES if name in whole_recording.coords}
    signals = {name: whole_recording[name].values for name in REQUIRED_SIGNALS}
    signals["emg"] = whole_recording["emg"].values[..., :3]
    made = make_recording(
        signals, labels, 200.0, emg_rate=2000.0, muscles=actions, emg_lead=-5e-3, emg_highpass=(30.0, 4)
    )
    save_recording(made, tmp_path / "r.nc")
    loaded = load_recording(tmp_path / "r.nc")
    assert muscle_actions(loaded) == actions
    assert loaded["emg"].attrs["lead"] == -5e-3
    assert emg_highpass(loaded) == (30.0, 4)


@pytest.mark.parametrize(
    ("name", "said"),
    [("highpass", 0.0), ("highpass", [20.0]), ("highpass", "20 Hz"), ("highpass", np.nan), ("highpass_order", 2.5),
     ("highpass_order", 9), ("highpass_order", "2")],
)  # fmt: skip
def test_a_highpass_that_is_none_is_named(whole_recording, name, said):
    whole_recording["emg"].attrs |= {"highpass": 20.0, name: said}
    with pytest.raises(ValueError, match=f"{name} of emg = .*; expected "):
        check_recording(whole_recording)


def test_text_of_any_alphabet_is_kept(recording, tmp_path):
    recording["subject"] = "trial", ["Jörg", "漢字"]
    save_recording(recording, tmp_path / "r.nc")
    assert load_recording(tmp_path / "r.nc")["subject"].values.tolist() == ["Jörg", "漢字"]


def test_unreadable_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none.nc: no such file, or a folder; expected a recording"):
        load_recording(tmp_path / "none.nc")
    (tmp_path / "text.nc").write_text("not netCDF")
    with pytest.raises(ValueError, match=r"text.nc: no HDF5 file .it begins with .*expected netCDF4"):
        load_recording(tmp_path / "text.nc")


@pytest.mark.slow(reason="writes and reads files")
def test_truncated_files_are_named(recording, tmp_path):
    save_recording(recording, tmp_path / "r.nc")
    whole = (tmp_path / "r.nc").read_bytes()
    (tmp_path / "r.nc").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"r.nc: "):
        load_recording(tmp_path / "r.nc")


def test_emg_joins_whatever_the_order_of_muscles_and_differences_are_named(whole_recording):
    turned = whole_recording.isel(muscle=slice(None, None, -1))
    joined, lost = join_recordings([whole_recording, turned], optional=["emg"])
    assert "emg" not in lost
    np.testing.assert_array_equal(joined["emg"].values, np.concatenate([whole_recording["emg"].values] * 2))
    check_recording(joined)
    slower = whole_recording.isel(emg_time=slice(None, None, 2)).assign_attrs(emg_rate=1000.0)
    fewer = whole_recording.isel(muscle=slice(3))
    for other, difference in (
        (slower, "rates [Hz] 2000 and 1000"),
        (fewer, "muscles "),
        (whole_recording.drop_vars("emg"), "not in all of them"),
    ):
        joined, lost = join_recordings([whole_recording, other], optional=["emg"])
        assert lost["emg"].startswith(difference)
        assert "emg" not in joined
