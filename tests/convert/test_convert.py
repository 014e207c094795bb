"""Laboratories' files become the recordings that they are, whatever their units, axes, formats and faults."""

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from laboratory import (
    COLUMNS,
    LABELS,
    MASS,
    N_TIME,
    N_TRIALS,
    RATE,
    as_text,
    handle,
    laboratory_recording,
    meaning,
    table,
    write,
)
from scipy import signal
from scipy.io import savemat

from armperturb import cli, foreign
from armperturb.analysis.force_balance import Balance
from armperturb.convert.balance import check_balance
from armperturb.convert.exporter import export_recording
from armperturb.convert.importer import import_recording
from armperturb.convert.sidecar import Sidecar
from armperturb.recording import REQUIRED_SIGNALS, Action, HighPass, check_recording, make_recording
from armperturb.recording_files import load_recording, save_recording

D, F, X = slice(2, 4), slice(4, 6), slice(6, 8)


def truth(name, n_trials=N_TRIALS, **options):
    place = REQUIRED_SIGNALS.index(name)
    return np.stack([handle(trial, **options)[place] for trial in range(n_trials)])


def assert_is_the_laboratory(recording, tolerance=1e-12, n_trials=N_TRIALS):
    assert recording.attrs["rate"] == RATE
    for name in REQUIRED_SIGNALS:
        expected = truth(name, n_trials)
        np.testing.assert_allclose(recording[name].values, expected, atol=tolerance * np.abs(expected).max(), rtol=0)
    for name, value in LABELS.items():
        assert recording[name].values.tolist() == [value] * n_trials


@pytest.mark.slow(reason="converts several files")
def test_units_axes_signs_starts_and_dialects_are_turned_into_ours(tmp_path):
    # x points back, y to the left; force in pounds, of the hand on the handle; path in inches from somewhere.
    values = table()
    turn = np.array([[0.0, -1.0], [-1.0, 0.0]])  # lab's x and y of our right and forward
    lab = values.copy()
    lab[:, 1] *= 1e3
    lab[:, D] = values[:, D] @ turn / 1e3
    lab[:, F] = -(values[:, F] @ turn) / 4.4482216152605
    lab[:, X] = values[:, X] @ turn / 0.0254 + [10.0, -3.0]
    sidecar = meaning(
        axes={"x": "backward", "y": "left"},
        time={"channel": "t", "unit": "ms"},
        csv={"delimiter": ";", "decimal": ",", "skip_lines": 2},
        labels={**LABELS, "l_h": "31 cm", "theta_s_deg": f"{np.radians(22.5).item()!r} rad"},
    )
    sidecar["signals"]["perturbation"]["unit"] = "kN"
    sidecar["signals"]["force"] |= {"unit": "lbf", "exerted_by": "hand"}
    sidecar["signals"]["displacement"] |= {"unit": "in", "start": [10.0, -3.0]}
    text = "Laboratory of arms\n;;\n" + as_text(lab, delimiter=";", decimal=",")
    found = import_recording([write(tmp_path, sidecar=sidecar, text=text)])
    assert_is_the_laboratory(found.recording)
    sidecar["signals"]["displacement"]["start"] = "first"
    assert_is_the_laboratory(import_recording([write(tmp_path, sidecar=sidecar, text=text)]).recording)


def test_a_signal_may_have_axes_of_its_own(tmp_path):
    values = table()
    values[:, F] = values[:, [5, 4]]
    sidecar = meaning()
    sidecar["signals"]["force"]["axes"] = {"x": "forward", "y": "right"}
    assert_is_the_laboratory(import_recording([write(tmp_path, values, sidecar)]).recording)


@pytest.mark.parametrize(("force", "length"), [("nt", "meters"), ("Newtons", "metres")])
def test_units_have_the_names_that_laboratories_write(tmp_path, force, length):
    sidecar = meaning()
    for name, unit in zip(REQUIRED_SIGNALS, (force, force, length), strict=True):
        sidecar["signals"][name]["unit"] = unit
    assert_is_the_laboratory(import_recording([write(tmp_path, sidecar=sidecar)]).recording)


def test_one_file_per_trial_with_one_sidecar(tmp_path):
    values = table(3)
    paths = [write(tmp_path, values[values[:, 0] == k], name=f"trial{k}") for k in (1, 2, 3)]
    sidecar = {
        **meaning(),
        "trials": {p.name: {"pulse_level": 1.0, "pulse_onset": f"{k} s"} for k, p in enumerate(paths)},
    }
    del sidecar["trial"]
    (tmp_path / "all.json").write_text(json.dumps(sidecar))
    found = import_recording(paths, sidecar=tmp_path / "all.json").recording
    assert_is_the_laboratory(found, n_trials=3)
    assert found["pulse_onset"].values.tolist() == [0.0, 1.0, 2.0]
    assert found["repetition"].values.tolist() == [0, 1, 2]
    emg = np.random.default_rng(0).normal(size=(3, 12_000, 1))
    for path, volts in zip(paths, emg, strict=True):
        np.savetxt(path.with_name(f"{path.stem}_emg.csv"), volts, header="b", comments="", fmt="%.7g")
    of_emg = {"channels": {"biceps_short_head": "b"}, "unit": "V", "rate": 2000, "file": "*_emg.csv"}
    for file in ("*_emg.csv", "trial1_emg.csv"):
        sidecar["signals"]["emg"] = of_emg | {"file": file}
        (tmp_path / "all.json").write_text(json.dumps(sidecar))
        if "*" in file:
            found = import_recording(paths, sidecar=tmp_path / "all.json").recording
            np.testing.assert_allclose(found["emg"].values, emg, rtol=1e-6)
            continue
        with pytest.raises(ValueError, match=r"trial2.csv has the EMG of .*trial1.csv; expected EMG that was recorded"):
            import_recording(paths, sidecar=tmp_path / "all.json")
    # That file may be written in another way.
    np.savetxt(tmp_path / "trial1_emg.csv", emg[0], header="title\nb", comments="", fmt="%.7g")
    sidecar["signals"]["emg"] = of_emg | {"csv": {"skip_lines": 1}}
    (tmp_path / "all.json").write_text(json.dumps(sidecar))
    found = import_recording(paths[:1], sidecar=tmp_path / "all.json").recording
    np.testing.assert_allclose(found["emg"].values, emg[:1], rtol=1e-6)
    sidecar["signals"]["emg"] = of_emg
    (tmp_path / "all.json").write_text(json.dumps(sidecar))
    emg[0, 2000:2420] = np.nan
    np.savetxt(tmp_path / "trial1_emg.csv", emg[0], header="b", comments="")
    with pytest.raises(
        ValueError, match=r"leaves it out; signals.emg.channels without this channel, or no signals.emg"
    ):
        import_recording(paths[:1], sidecar=tmp_path / "all.json", repair="stretch")


def test_labels_of_trials_and_what_is_left_out(tmp_path):
    sidecar = meaning(trials={"1": {"condition": "PT2.5"}, "2": {"condition": None, "pulse_direction": 20}})
    found = import_recording([write(tmp_path, sidecar=sidecar)]).recording
    assert found["condition"].values.tolist() == ["PT2.5", "PT7.5"]
    assert found["repetition"].values.tolist() == [0, 0]
    np.testing.assert_array_equal(found["pulse_direction"], [np.nan, 20.0])
    np.testing.assert_array_equal(found["pulse_level"], [0.0, 0.0])
    assert np.isnan(found["limit_time"].values).all()


def v73(path, content):
    """A file as MATLAB writes it: HDF5 below a header of 512 bytes, dimensions turned round."""
    with h5py.File(path, "w", userblock_size=512) as file:
        refs = file.create_group("#refs#")
        for name, value in content.items():
            if isinstance(value, dict):
                group = file.create_group(name)
                group.attrs["MATLAB_class"] = np.bytes_("struct")
                for field, parts in value.items():
                    data = group.create_dataset(field, (len(parts), 1), dtype=h5py.ref_dtype)
                    for k, part in enumerate(parts):
                        one = refs.create_dataset(f"{field}{k}", data=part.T)
                        one.attrs["MATLAB_class"] = np.bytes_("double")
                        data[k, 0] = one.ref
            else:
                file.create_dataset(name, data=value.T).attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def in_matlab(form):
    """Content of a MATLAB file, and its channels of d, f and x."""
    trials = [handle(k) for k in range(N_TRIALS)]
    if form == "matrices with a column of trials":
        parts = np.concatenate([np.concatenate(one, axis=1) for one in trials])
        content = {"data": {"all": parts}, "trial": np.repeat(np.arange(1.0, N_TRIALS + 1), N_TIME)[:, None]}
        return content, {name: [f"data.all(time,{2 * i + k})" for k in (1, 2)] for i, name in enumerate("dfx")}
    if form == "time by trial":
        content = {
            f"{n}{k}": np.stack([t[i][:, k] for t in trials], axis=1) for i, n in enumerate("dfx") for k in (0, 1)
        }
        return content, {name: [f"{name}{k}(time,trial)" for k in (0, 1)] for name in "dfx"}
    if form == "structures":
        array = np.empty((1, N_TRIALS), dtype=[(name, object) for name in "dfx"])
        for k, one in enumerate(trials):
            array[0, k] = one
        return {"session": {"trials": array}}, {
            n: [f"session.trials(trial).{n}(time,{k})" for k in (1, 2)] for n in "dfx"
        }
    content = {}
    for i, name in enumerate("dfx"):
        content[name] = np.empty((1, N_TRIALS), dtype=object)
        for k, one in enumerate(trials):
            content[name][0, k] = one[i]
    return content, {name: [f"{name}{{trial}}(time,{k})" for k in (1, 2)] for name in "dfx"}


def matlab_meaning(channels):
    sidecar = meaning()
    for name, of_one in zip(REQUIRED_SIGNALS, channels.values(), strict=True):
        sidecar["signals"][name]["channels"] = dict(zip("xy", of_one, strict=True))
    return sidecar


@pytest.mark.parametrize("form", ["matrices with a column of trials", "time by trial", "structures", "cells"])
def test_matlab_v5_in_every_form(tmp_path, form):
    content, channels = in_matlab(form)
    sidecar = matlab_meaning(channels)
    if "trial" not in content:
        del sidecar["trial"]
    savemat(tmp_path / "lab.mat", content, do_compression=form == "cells")
    (tmp_path / "lab.json").write_text(json.dumps(sidecar))
    assert_is_the_laboratory(import_recording([tmp_path / "lab.mat"]).recording)


@pytest.mark.slow(reason="a child process for each form")
@pytest.mark.parametrize("form", ["time by trial", "structures"])
def test_matlab_v73(tmp_path, form):
    content, channels = in_matlab("time by trial")
    if form == "structures":
        content = {"s": {name: [handle(k)[i] for k in range(N_TRIALS)] for i, name in enumerate("dfx")}}
        channels = {name: [f"s(trial).{name}(time,{k})" for k in (1, 2)] for name in "dfx"}
    sidecar = matlab_meaning(channels)
    del sidecar["trial"]
    v73(tmp_path / "lab.mat", content)
    (tmp_path / "lab.json").write_text(json.dumps(sidecar))
    assert_is_the_laboratory(import_recording([tmp_path / "lab.mat"]).recording)


def write_c3d(path, seed=0, unit="mm"):
    """Marker on the handle at 200 Hz in mm; forces at 1000 Hz, as a robot's converter has them."""
    ezc3d = pytest.importorskip("ezc3d")
    d, f, _ = handle(seed, rate=1000.0)
    _, _, x = handle(seed)
    file = ezc3d.c3d()
    parameters, points = file["parameters"], np.zeros((4, 1, len(x)))
    points[:2, 0] = 1e3 * x.T
    points[3] = 1.0
    for group, rate, labels, units in (
        ("POINT", 200.0, ["HANDLE"], [unit]),
        ("ANALOG", 1000.0, ["Dx", "Dy", "Fx", "Fy"], ["N"] * 4),
    ):
        for name, value in (("RATE", [rate]), ("LABELS", labels), ("UNITS", units)):
            parameters[group][name]["value"] = value
    file["data"]["points"], file["data"]["analogs"] = points, np.concatenate([d, f], axis=1).T[None]
    file.write(str(path))
    sidecar = meaning()
    del sidecar["trial"], sidecar["rate"]
    sidecar["signals"]["displacement"] = {"channels": {"x": "HANDLE.X", "y": "HANDLE.Y"}, "unit": "mm"}
    path.with_suffix(".json").write_text(json.dumps(sidecar))


@pytest.mark.slow(reason="two child processes")
def test_c3d_with_markers_and_converter_at_different_rates(tmp_path):
    write_c3d(tmp_path / "lab.c3d")
    with pytest.raises(
        ValueError, match=r"perturbation at 1000 Hz.*displacement at 200 Hz; expected one rate \(convert --rate"
    ):
        import_recording([tmp_path / "lab.c3d"])
    found = import_recording([tmp_path / "lab.c3d"], rate=200.0).recording
    assert found.sizes["time"] == N_TIME
    inner = slice(100, -100)
    for name in REQUIRED_SIGNALS:  # single precision, and the filter's ripple
        expected = truth(name, 1)[:, inner]
        np.testing.assert_allclose(found[name].values[:, inner], expected, atol=2e-3 * np.abs(expected).max())
    environment, _ = Balance(*(found[name].values for name in REQUIRED_SIGNALS), 200.0).fit()
    assert environment.m_env == pytest.approx(MASS, rel=2e-3)


@pytest.mark.slow(reason="two child processes, and a C3D file written")
def test_the_sidecar_wins_over_the_unit_of_a_c3d_file_with_a_note(tmp_path):
    write_c3d(tmp_path / "lab.c3d")
    right = import_recording([tmp_path / "lab.c3d"], rate=200.0)
    write_c3d(tmp_path / "lab.c3d", unit="cm")
    found = import_recording([tmp_path / "lab.c3d"], rate=200.0)
    assert found.recording.identical(right.recording)
    assert [note for note in found.notes if note not in right.notes] == [
        f"HANDLE.{axis} is in 'cm' by the file; taken as 'mm', as signals.displacement.unit of "
        f"{tmp_path / 'lab.json'} says"
        for axis in "XY"
    ]


def test_without_ezc3d_the_extra_is_named(tmp_path, monkeypatch):
    write_c3d(tmp_path / "lab.c3d")
    monkeypatch.setattr(foreign, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"lab.c3d: C3D needs ezc3d, which .*'armperturb\[c3d\]'"):
        import_recording([tmp_path / "lab.c3d"], rate=200.0)


@pytest.mark.slow(reason="records at 500 Hz, as text")
def test_other_rates_are_resampled_as_asked(tmp_path):
    fine = table(rate=500.0)
    path = write(tmp_path, fine, meaning(rate=500.0))
    assert import_recording([path]).recording.attrs["rate"] == 500.0
    found = import_recording([path], rate=200.0).recording
    inner = slice(100, -100)
    for name in REQUIRED_SIGNALS:
        expected = truth(name)[:, inner]
        np.testing.assert_allclose(found[name].values[:, inner], expected, atol=3e-3 * np.abs(expected).max())


@pytest.mark.slow(reason="converts several files")
def test_netcdf_is_resampled_as_other_files_are(tmp_path):
    fine = table(rate=500.0)
    path = write(tmp_path, fine, meaning(rate=500.0))
    recording = import_recording(path).recording
    emg = np.random.default_rng(0).normal(size=(N_TRIALS, 12000, 1)).astype(np.float32)
    recording = make_recording(
        {name: recording[name] for name in REQUIRED_SIGNALS}
        | {"emg": emg, "shoulder_marker": recording["displacement"]},
        {name: value for name, value in recording.coords.items() if value.dims == ("trial",)},
        500.0,
        emg_rate=2000.0,
        muscles={"biceps": Action("e", 1)},
        laboratory="A",
    )
    save_recording(recording.assign(valve=("time", recording["time"].data)), tmp_path / "r.nc")
    found, notes = import_recording(tmp_path / "r.nc", rate=200.0)
    expected = import_recording(path, rate=200.0).recording
    for name in (*REQUIRED_SIGNALS, "time", *expected["force"].coords):
        np.testing.assert_array_equal(found[name], expected[name])
        assert found[name].attrs == expected[name].attrs
    np.testing.assert_array_equal(found["shoulder_marker"], found["displacement"])
    xr.testing.assert_identical(found["emg"], recording["emg"])
    assert found.attrs == {"rate": 200.0, "emg_rate": 2000.0, "laboratory": "A"}
    source = f"{tmp_path / 'r.nc'}: "
    assert notes == (f"{source}resampled from 500 to 200 Hz", f"{source}not resampled, so left out: valve")
    xr.testing.assert_identical(import_recording(tmp_path / "r.nc", rate=500.0)[0], load_recording(tmp_path / "r.nc"))
    check_recording(found)
    save_recording(recording.isel(time=slice(100)), tmp_path / "r.nc")
    with pytest.raises(ValueError, match=r"r.nc: one sample is left at rate = 1 Hz; expected at least 2"):
        import_recording(tmp_path / "r.nc", rate=1.0)


WRONG = {
    "the sign of force were turned": lambda v: np.hstack([v[:, :4], -v[:, F], v[:, X]]),
    "the sign of displacement were turned": lambda v: np.hstack([v[:, :6], -v[:, X]]),
    "the sign of perturbation were turned": lambda v: np.hstack([v[:, :2], -v[:, D], v[:, 4:]]),
    "x and y of force were swapped": lambda v: v[:, [0, 1, 2, 3, 5, 4, 6, 7]],
    "x and y of displacement were swapped": lambda v: v[:, [0, 1, 2, 3, 4, 5, 7, 6]],
    "x and y of perturbation were swapped": lambda v: v[:, [0, 1, 3, 2, 4, 5, 6, 7]],
    "the sign of x of force were turned": lambda v: v * np.where(np.arange(8) == 4, -1.0, 1.0),
    "the sign of y of displacement were turned": lambda v: v * np.where(np.arange(8) == 7, -1.0, 1.0),
    "force were multiplied by 4.448": lambda v: np.hstack([v[:, :4], v[:, F] / 4.4482216152605, v[:, X]]),
}


def test_rates_far_beyond_that_of_the_file_are_refused(tmp_path):
    path = write(tmp_path, table(), meaning())
    with pytest.raises(ValueError, match=r"rate = 1e\+06 Hz from 200 Hz; expected at most 50 times as many samples"):
        import_recording([path], rate=1e6)


@pytest.mark.parametrize("remedy", WRONG)
def test_what_is_wrong_with_the_balance_is_named(remedy):
    trials = WRONG[remedy](table()).reshape(N_TRIALS, N_TIME, len(COLUMNS))
    with pytest.raises(ValueError, match=re.escape(f"as it would if {remedy}")):
        check_balance(laboratory_recording(*((trial[:, D], trial[:, F], trial[:, X]) for trial in trials)))


@pytest.mark.slow(reason="simulates trials")
def test_a_simulated_arm_passes_and_its_force_turned_is_named(position_recording):
    assert check_balance(position_recording) == []
    with pytest.raises(ValueError, match=r"the sign of force were turned \(signals.force.exerted_by of the"):
        check_balance(position_recording.assign(force=-position_recording["force"]))


MIRROR = [-1.0, 1.0]


@pytest.mark.slow(reason="converts several files")
@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda each: {name: each[name] * MIRROR for name in REQUIRED_SIGNALS}, "with x mirrored"),
        (
            lambda each: {name: each[name].values[..., ::-1] * MIRROR for name in REQUIRED_SIGNALS},
            "with x and y swapped, then y mirrored",
        ),
        (lambda each: {"joint_angle": each["joint_angle"].values[..., ::-1]}, "with shoulder and elbow swapped"),
        (lambda each: {"joint_angle": each["joint_angle"] * MIRROR}, "with the angle of the shoulder negated"),
    ],
)
def test_angles_that_belong_to_other_axes_or_joints_are_refused_with_the_change(
    position_recording, tmp_path, change, named
):
    right = position_recording.isel(trial=[0])
    wrong = right.copy(data={**right.data_vars, **{n: np.asarray(v) for n, v in change(right).items()}})
    save_recording(wrong, tmp_path / "wrong.nc")
    with pytest.raises(ValueError, match=f"wrong.nc: trial 0: joint_angle, l_h and l_f .*{named};"):
        import_recording([tmp_path / "wrong.nc"])
    save_recording(wrong.assign_coords(l_f=wrong["l_f"] * np.nan), tmp_path / "unknown.nc")
    import_recording([tmp_path / "unknown.nc"])  # without lengths angles tell no path


def test_a_mass_that_is_no_handles_is_refused_in_netcdf_too(tmp_path):
    d, f, x = handle(0)
    recording = laboratory_recording((1e-3 * d, 1e-3 * f, x))
    save_recording(recording, tmp_path / "grams.nc")
    with pytest.raises(ValueError, match=r"grams.nc: d - f moves a mass of 0\.003\d* kg; expected 0.1 to 60 kg"):
        import_recording([tmp_path / "grams.nc"])


def turned(values, degrees):
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return values @ np.array([[cosine, sine], [-sine, cosine]])


def filtered(values):
    return signal.sosfilt(signal.butter(4, 20.0, fs=RATE, output="sos"), values, axis=0)


SMALL = {
    r"force appears to be 10 % too large \(": lambda d, f, x: (d, 1.1 * f, x),
    r"force appears to be turned by 5° from x to y \(": lambda d, f, x: (d, turned(f, 5.0), x),
    r"displacement appears to be turned by 5° from x to y \(": lambda d, f, x: (d, f, turned(x, 5.0)),
    r"perturbation appears to be turned by 5° from x to y \(": lambda d, f, x: (turned(d, 5.0), f, x),
    r"force is recorded 5.00 ms later than displacement and perturbation \(": lambda d, f, x: (d, np.roll(f, 1, 0), x),
    r"displacement is recorded 4.99 ms earlier than force and pert": lambda d, f, x: (d, f, np.roll(x, -1, 0)),
}


@pytest.mark.parametrize("said", SMALL)
def test_what_is_wrong_but_not_refused_is_noted_with_its_size(said):
    (note,) = check_balance(laboratory_recording(*(SMALL[said](*handle(seed)) for seed in range(3))))
    assert re.match(said, note)
    assert re.search(r"explains (9\d|100)[.\d]* % of what the force balance leaves", note)


LARGE = {
    "perturbation is recorded 20.00 ms later than force": lambda d, f, x: (np.roll(d, 4, 0), f, x),
    "perturbation is recorded 30.00 ms earlier than force": lambda d, f, x: (np.roll(d, -6, 0), f, x),
    "these two alone passed a low-pass filter": lambda d, f, x: (d, filtered(f), filtered(x)),
    "force is recorded 99.98 ms later than": lambda d, f, x: (d, np.roll(f, 20, 0), x),
    "force appears to be turned by 30° from x to y": lambda d, f, x: (d, turned(f, 30.0), x),
    "displacement appears to be turned by 30° from y to x": lambda d, f, x: (d, f, turned(x, -30.0)),
}


@pytest.mark.parametrize("said", LARGE)
def test_a_refusal_names_delay_filter_or_rotation_where_one_explains_what_is_left(said):
    with pytest.raises(ValueError, match=rf"the handle exerts on the hand, but .*{said}") as caught:
        check_balance(laboratory_recording(*(LARGE[said](*handle(seed)) for seed in range(3))))
    assert "a sensor that failed" not in str(caught.value)


def test_a_refusal_that_nothing_explains_asks_for_the_sensors():
    d, f, x = handle(0)
    with pytest.raises(ValueError, match=r"no change of signs, axes or scale .*\(a sensor that failed"):
        check_balance(laboratory_recording((d, np.where(np.arange(N_TIME)[:, None] < N_TIME // 2, f, -d), x)))


def test_what_noise_leaves_of_the_load_is_noted_with_its_likely_causes():
    trials = [handle(seed) for seed in range(3)]
    noise = np.random.default_rng(0).normal(size=(3, N_TIME, 2))
    (note,) = check_balance(laboratory_recording(*((d, f + n, x) for (d, f, x), n in zip(trials, noise, strict=True))))
    said = r"d - f moves a mass of (2\.9|3)\S* kg, but 0\.0[34]\d* of its power is left unexplained; expected less than"
    assert re.match(rf"{said} 0.02 \(a force sensor that is noisy", note)


def test_one_trial_that_was_turned_is_named_among_others():
    d, f, x = handle(1)
    with pytest.raises(ValueError, match=r"damper in trial 2 \(.*the sign of force were turned"):
        check_balance(laboratory_recording(handle(0), (d, -f, x), *(handle(seed) for seed in range(2, 10))))


def test_a_pulse_at_the_end_tells_the_sign_of_the_perturbation():
    d, f, x = handle(0)
    pulse = np.zeros_like(d)
    pulse[-200:-190] = [20.0, 10.0]
    assert check_balance(laboratory_recording((pulse, f - d + pulse, x))) == []
    with pytest.raises(ValueError, match="the sign of perturbation were turned"):
        check_balance(laboratory_recording((-pulse, f - d + pulse, x)))
    none = laboratory_recording((0.0 * d, f - d, x))
    assert check_balance(none) == [
        "the perturbation is too weak beside other forces: its sign, axes and unit are unchecked"
    ]


@pytest.mark.parametrize("duration", [5.0, 6.0])  # in 5 s the lowest frequencies lie next to a constant
def test_a_force_with_an_offset_that_drifts_balances_and_hides_no_sign(duration):
    trials = [handle(seed, duration=duration) for seed in range(2)]
    offset = np.array([10.0, -3.0]) + np.linspace(0.0, 5.0, len(trials[0][0]))[:, None]
    assert check_balance(laboratory_recording(*((d, f + offset, x) for d, f, x in trials))) == []
    with pytest.raises(ValueError, match=r"as it would if the sign of force were turned \("):
        check_balance(laboratory_recording(*((d, offset - f, x) for d, f, x in trials)))


@pytest.mark.slow(reason="converts several files")
def test_what_comes_after_the_workspace_limit_is_not_held_against_physics():
    d, f, x = (values.copy() for values in handle(0, duration=10.0))
    f[1500:] = 300.0 * np.sin(np.arange(500))[:, None]  # the stop takes the load
    with pytest.raises(ValueError, match="d - f"):
        check_balance(laboratory_recording((d, f, x)))
    assert check_balance(laboratory_recording((d, f, x), limit_time=7.5)) == []


@pytest.mark.slow(reason="converts several files")
def test_a_mass_that_is_no_handles_or_not_the_one_set_to_is_refused(tmp_path):
    values = table()
    millimetres = np.hstack([values[:, :6], values[:, X] * 1e3])
    with pytest.raises(ValueError, match=r"displacement is .* m at .* s; expected at most 0.65 \(a wrong signals"):
        import_recording([write(tmp_path, millimetres)])
    centimetres = np.hstack([values[:, :2], 0.2 * values[:, 2:6], 20.0 * values[:, X]])
    with pytest.raises(ValueError, match=r"moves a mass of 0.03 kg; expected 0.1 to 60 kg"):
        import_recording([write(tmp_path, centimetres)])
    assert import_recording([write(tmp_path, values, meaning(environment={"m_env": "3.1 kg"}))]).notes == ()
    with pytest.raises(ValueError, match=r"moves a mass of 3 kg; expected 4 to 9 kg"):
        import_recording([write(tmp_path, values, meaning(environment={"m_env": 6.0}))])


def test_a_short_recording_cannot_be_held_against_physics_and_says_so(tmp_path):
    found = import_recording([write(tmp_path, table(duration=3.0))])
    assert len(found.notes) == 1
    assert "3 s at 200 Hz are too short" in found.notes[0]


@pytest.mark.slow(reason="records of 20 s, as text")
def test_clocks_of_force_and_displacement_that_differ_or_drift_are_reported(tmp_path):
    found = import_recording([write(tmp_path, table(late=0.004, duration=20.0))])
    assert len(found.notes) == 1
    late = re.match(r"force is recorded ([\d.]+) ms later than displacement", found.notes[0])
    assert float(late[1]) == pytest.approx(4.0, rel=0.05)
    values = table(duration=20.0, late=5e-4 * np.arange(4000) / RATE)  # a clock that loses 10 ms over the trial
    with pytest.raises(ValueError, match=r"force drifts against displacement by .* ms from the first to") as caught:
        import_recording([write(tmp_path, values)])
    drift = re.search(r"by ([-\d.]+) ms", str(caught.value))
    assert float(drift[1]) == pytest.approx(5.0, rel=0.2)


TIMED = {"time": {"channel": "t", "unit": "s"}}


def inner_error(recording, name="displacement"):
    """Largest error away from the ends, over the largest value [-]."""
    n_time = recording.sizes["time"]
    expected = truth(name, recording.sizes["trial"])[:, :n_time]
    return np.abs(recording[name].values - expected)[:, 20:-20].max() / np.abs(expected).max()


@pytest.mark.slow(reason="converts several files")
def test_gaps_are_refused_with_their_time_and_filled_if_asked(tmp_path):
    values = table()
    values[N_TIME + 600 : N_TIME + 605, 6] = np.nan
    path = write(tmp_path, values)
    message = r"lab.csv: trial '2': X \(displacement\) has a gap of 0.025 s at 3 s; .*\(convert --repair gaps"
    with pytest.raises(ValueError, match=message):
        import_recording([path])
    with pytest.raises(ValueError, match=r"--repair gaps"):
        import_recording([path], repair=["drops", "clock", "lengths"])
    found = import_recording([path], repair=["gaps"])
    assert inner_error(found.recording) < 2e-3
    assert "has a gap of 0.025 s at 3 s: repaired" in found.notes[0]
    assert found.recording.attrs["repairs"] == found.notes[0]
    values[N_TIME + 600 : N_TIME + 625, 6] = np.nan
    with pytest.raises(ValueError, match=r"gap of 0.125 s at 3 s.*cannot be repaired \(convert --repair trials"):
        import_recording([write(tmp_path, values)], repair=["gaps"])
    found = import_recording([write(tmp_path, values)], repair=["gaps", "trials"])
    assert found.recording.sizes["trial"] == 1
    assert "trial '2' is left out: X (displacement) has a gap" in found.notes[0]


def test_a_trial_is_cut_to_its_longest_stretch_without_long_gaps(tmp_path):
    values = table()
    values[100:105, 6] = np.nan  # a short one, to be filled
    values[300:380, 6] = values[1000:1100, 4] = np.nan
    values[N_TIME:] = table()[N_TIME:]
    path = write(tmp_path, values[:N_TIME])
    with pytest.raises(ValueError, match=r"gap of 0.5 s at 5 s.*stretch keeps the longest part without gaps"):
        import_recording([path], repair=["gaps"])
    found = import_recording([path], repair=["gaps", "stretch"])
    assert any("cut to 1.9 to 5 s, its longest stretch" in note for note in found.notes)
    assert found.recording.sizes["time"] == 620
    for name in ("perturbation", "displacement"):
        np.testing.assert_allclose(found.recording[name].values[0], truth(name, 1)[0, 380:1000], atol=1e-12)
    values[:N_TIME, 6] = np.nan
    with pytest.raises(ValueError, match="missing everywhere"):
        import_recording([write(tmp_path, values[:N_TIME])], repair=["stretch"])
    whole = import_recording([write(tmp_path, table())], repair=["stretch"])
    assert_is_the_laboratory(whole.recording)


@pytest.mark.slow(reason="converts several files")
@pytest.mark.parametrize(
    ("gap", "onset", "repair", "kept"),
    [
        (slice(1000, 1100), 5.6, "stretch", None),
        (slice(300, 400), 1.0, "stretch", None),
        (slice(300, 400), 3.0, "stretch", 1.0),
        (slice(1000, 1200), 5.6, "lengths", None),
        (slice(1000, 1200), 5.0, "lengths", 5.0),
    ],
)
def test_a_pulse_that_a_cut_leaves_out_has_no_labels_any_more(tmp_path, gap, onset, repair, kept):
    values, sidecar = table(), meaning()
    values[N_TIME:][gap, 2:] = np.nan
    pulse = {"pulse_level": 1, "pulse_direction": 20, "pulse_onset": onset}
    sidecar["trials"] = {"1": {}, "2": pulse} if repair == "stretch" else {"1": pulse, "2": {}}
    found = import_recording([write(tmp_path, values, sidecar)], repair=[repair, "lengths"])
    trial = int(repair == "stretch")
    row = [float(found.recording[name][trial]) for name in pulse]
    assert row == (pytest.approx([1.0, 20.0, kept]) if kept else pytest.approx([0.0, np.nan, np.nan], nan_ok=True))
    notes = [note for note in found.notes if "is cut off: pulse_onset, pulse_level and pulse_direction" in note]
    assert len(notes) == (kept is None)
    export_recording(found.recording, tmp_path / "r.nc")
    import_recording([tmp_path / "r.nc"])


@pytest.mark.slow(reason="converts several files")
@pytest.mark.parametrize("name", ["pulse_onset", "limit_time"])
def test_instants_before_the_trial_are_refused_in_netcdf_too(tmp_path, name):
    recording = laboratory_recording(handle())
    save_recording(recording.assign_coords({name: recording[name].copy(data=[-0.5])}), tmp_path / "r.nc")
    message = f"r.nc: trial 0: {name} = -0.5 s; expected within the trial, which lasts 6 s, or none"
    with pytest.raises(ValueError, match=message):
        import_recording([tmp_path / "r.nc"])
    # Those after its end are of a recording that was cut.
    save_recording(recording.assign_coords({name: recording[name].copy(data=[7.0])}), tmp_path / "cut.nc")
    assert import_recording([tmp_path / "cut.nc"]).recording.sizes["time"] == recording.sizes["time"]


def test_a_workspace_limit_after_a_cut_is_none(tmp_path):
    values, sidecar = table()[:-200], meaning()
    sidecar["trials"] = {"1": {"limit_time": 5.5}, "2": {"limit_time": 4.5}}
    found = import_recording([write(tmp_path, values, sidecar)], repair="lengths").recording
    np.testing.assert_array_equal(found["limit_time"], [np.nan, 4.5])


def test_dropped_samples_are_refused_with_their_time_and_filled_if_asked(tmp_path):
    path = write(tmp_path, np.delete(table(), slice(700, 706), axis=0), meaning(**TIMED))
    with pytest.raises(ValueError, match=r"trial '1': 6 samples are dropped at 3.495 s .*cannot be repaired"):
        import_recording([path], repair=["drops"])
    values = np.delete(table(), slice(700, 705), axis=0)  # 0.025 s, as of gaps
    path = write(tmp_path, values, meaning(**TIMED))
    with pytest.raises(ValueError, match=r"trial '1': 5 samples are dropped at 3.495 s .*\(convert --repair drops"):
        import_recording([path])
    found = import_recording([path], repair=["drops"]).recording
    assert found.sizes["time"] == N_TIME
    assert inner_error(found) < 2e-3


def test_without_times_dropped_samples_that_repeat_the_last_are_seen(tmp_path):
    values = table()
    values[500:504, 2:] = values[499, 2:]
    with pytest.raises(ValueError, match=r"trial '1': all channels hold their value for 0.02 s at 2.495 s"):
        import_recording([write(tmp_path, values)])


@pytest.mark.slow(reason="converts several files")
def test_a_drifting_clock_is_refused_with_its_rate_and_resampled_if_asked(tmp_path):
    true_rate = 199.3
    values = table(rate=true_rate)
    path = write(tmp_path, values, meaning(**TIMED))
    with pytest.raises(ValueError, match=r"time runs at 199.3 Hz: sample \d+ is at .* s, and off by up to 20.99 ms"):
        import_recording([path])
    found = import_recording([path], repair=["clock"]).recording
    assert inner_error(found) < 1e-4
    assert inner_error(found, "force") < 2e-2  # of which 20 Hz is ten samples a period
    alone = meaning(**TIMED)
    del alone["rate"]
    assert import_recording([write(tmp_path, values, alone)]).recording.attrs["rate"] == pytest.approx(199.3)


def test_times_in_whole_milliseconds_are_even(tmp_path):
    values = table()
    values[:, 1] = np.round(values[:, 1] + 1e-4, 3)  # 5 ms steps; and 199.3 Hz would not be
    sidecar = meaning(**TIMED)
    del sidecar["rate"]
    assert_is_the_laboratory(import_recording([write(tmp_path, values, sidecar)]).recording)


def test_unequal_lengths_are_refused_and_cut_if_asked(tmp_path):
    values = table()[:-40]
    path = write(tmp_path, values)
    with pytest.raises(
        ValueError, match=r"trial '2': perturbation lasts 5.8 s, other trials up to 6 s; .*--repair length"
    ):
        import_recording([path])
    found = import_recording([path], repair=["lengths"])
    assert found.recording.sizes["time"] == N_TIME - 40
    assert inner_error(found.recording) < 1e-12
    assert "all are cut to the shortest" in found.notes[0]


@pytest.mark.slow(reason="converts several files")
def test_trials_are_not_cut_to_one_that_broke_off(tmp_path):
    path = write(tmp_path, table(3)[: 2 * N_TIME + 41])
    message = r"trial '3': it lasts 0.205 s, and half of the trials 6 s or longer; .*--repair trials leaves it out"
    for repair in ((), "lengths", ("stretch", "lengths", "gaps")):
        with pytest.raises(ValueError, match=message):
            import_recording([path], repair=repair)
    found = import_recording([path], repair=("lengths", "trials"))
    assert_is_the_laboratory(found.recording)
    assert "trial '3' is left out: it lasts 0.205 s" in found.notes[0]


def test_signals_of_other_rates_are_not_cut_to_one_length(tmp_path):
    d, f, x = handle()
    path = tmp_path / "lab.npz"
    sidecar = {**meaning(), "signals": {}}
    del sidecar["trial"]
    for name, field in meaning()["signals"].items():
        channels = {axis: f"{name}(time,{at})" for at, axis in enumerate("xy", 1)}
        sidecar["signals"][name] = {**field, "channels": channels}
    path.with_suffix(".json").write_text(json.dumps(sidecar))
    said = r"their rates seem to differ by a factor of {} \(resample displacement to the times of {} in the file\)"
    for kept, factor in ((x[::5], "5"), (x[:800], "1.5")):
        np.savez(path, perturbation=d, force=f, displacement=kept, t=np.arange(N_TIME) / RATE)
        message = said.format(factor, "perturbation") + ".*expected one rate of all signals but EMG"
        with pytest.raises(ValueError, match=message) as caught:
            import_recording([path], repair="lengths")
        assert "--repair lengths" not in str(caught.value)
    (tmp_path / "timed.json").write_text(json.dumps(sidecar | TIMED))
    with pytest.raises(ValueError, match=f"has 800 samples and t 1200: {said.format('1.5', 't')}; expected as many"):
        import_recording([path], sidecar=tmp_path / "timed.json")
    np.savez(path, perturbation=d, force=f, displacement=x[:1100])
    assert import_recording([path], repair="lengths").recording.sizes["time"] == 1100


def test_clipped_and_stuck_channels_are_refused_with_their_time(tmp_path):
    values = table()
    clipped, stuck = values.copy(), values.copy()
    limit = 0.6 * np.abs(values[:N_TIME, 6]).max()
    clipped[:N_TIME, 6] = np.clip(values[:N_TIME, 6], -limit, limit)
    stuck[N_TIME:, 5] = 0.3
    first = int(np.flatnonzero(np.abs(values[:N_TIME, 6]) > limit)[0])
    with pytest.raises(ValueError, match=r"trial '1': X \(displacement\) is clipped at .*times in all") as caught:
        import_recording([write(tmp_path, clipped)])
    when = float(re.search(r"s at ([\d.]+) s", str(caught.value))[1])
    assert abs(when - first / RATE) < 3.0  # the first of those that are steep enough to be sure
    with pytest.raises(ValueError, match=r"trial '2': Fy \(force\) is constant at 0.3"):
        import_recording([write(tmp_path, stuck)])
    found = import_recording([write(tmp_path, stuck)], repair=["trials"])
    assert found.recording.sizes["trial"] == 1


@pytest.mark.parametrize(("columns", "n"), [(X, 20), (X, 200), (F, 60), ([6], 60)])
def test_a_sensor_that_stands_still_alone_is_refused_with_its_time(tmp_path, columns, n):
    values = table()
    values[N_TIME + 400 : N_TIME + 400 + n, columns] = values[N_TIME + 400, columns]
    name = r"F[xy] \(force\)" if columns is F else r"X \(displacement\)"
    said = rf"trial '2': {name} holds its value for {n / RATE:g} s at 2 s.*convert --repair trials"
    with pytest.raises(ValueError, match=said):
        import_recording([write(tmp_path, values)])
    assert import_recording([tmp_path / "lab.csv"], repair=["trials"]).recording.sizes["trial"] == 1


def test_lost_markers_that_are_written_as_zeros_are_refused(tmp_path):
    values = table()
    values[:, X] += [0.1, 0.4]
    values[N_TIME + 400 : N_TIME + 460, X] = 0.0
    sidecar = meaning()
    sidecar["signals"]["displacement"]["start"] = "first"
    with pytest.raises(ValueError, match=r"trial '2': X \(displacement\) is clipped at 0 for 0.3 s at 2 s.*left empty"):
        import_recording([write(tmp_path, values, sidecar)])


def test_a_square_perturbation_is_read_and_a_clipped_one_refused(tmp_path):
    values = table(1)
    square = 3.0 * np.sign(np.random.default_rng(4).normal(size=(N_TIME // 10, 2))).repeat(10, axis=0)
    values[:, F] += square - values[:, D]
    values[:, D] = square
    found = import_recording([write(tmp_path, values)])
    np.testing.assert_array_equal(found.recording["perturbation"].values[0], square)
    assert found.notes == ()
    values = table(1)
    values[:, D] = values[:, D].clip(-3.0, 3.0)
    with pytest.raises(ValueError, match=r"Dx \(perturbation\) is clipped at 3 for"):
        import_recording([write(tmp_path, values)])


@pytest.mark.slow(reason="three recordings, as text")
def test_coarse_encoders_and_pulses_are_not_taken_for_clipped(tmp_path):
    for step in (1e-5, 3e-5, 1e-4):
        values = table()
        values[:, X] = step * np.round(values[:, X] / step)
        assert import_recording([write(tmp_path, values)]).recording.sizes["trial"] == 2


@pytest.mark.slow(reason="simulates trials and identifies them twice")
@pytest.mark.usefixtures("without_page", "blank_pictures")
def test_identify_takes_other_formats_and_its_errors_name_them(position_recording, tmp_path, capsys):
    recording = position_recording.isel(trial=slice(2)).drop_dims("emg_time", errors="ignore")
    export_recording(recording, tmp_path / "r.csv")
    save_recording(recording, tmp_path / "r.nc")
    tables = []
    for ending in ("csv", "nc"):
        arguments = [
            "identify",
            tmp_path / f"r.{ending}",
            "--model",
            "3b",
            "--estimator",
            "frequency",
            "--out",
            tmp_path / ending,
        ]
        assert cli.main([str(one) for one in arguments]) == 0
        tables.append((tmp_path / ending / "parameters.csv").read_text())
    assert tables[0] == tables[1]
    capsys.readouterr()


@pytest.mark.slow(reason="five commands, of which three start a child process")
def test_convert_goes_there_and_back_on_the_command_line(tmp_path, capsys):
    path = write(tmp_path)
    assert cli.main(["convert", str(path), "--out", str(tmp_path / "r.nc")]) == 0
    assert_is_the_laboratory(load_recording(tmp_path / "r.nc"))
    assert cli.main(["convert", str(tmp_path / "r.nc"), "--out", str(tmp_path / "back.mat")]) == 0
    assert cli.main(["convert", str(tmp_path / "back.mat"), "--out", str(tmp_path / "r2.nc")]) == 0
    assert "recording: " in capsys.readouterr().out
    assert_is_the_laboratory(load_recording(tmp_path / "r2.nc"))
    values = table()[:-40]
    path = write(tmp_path, values)
    assert (
        cli.main(["convert", str(path), "--out", str(tmp_path / "r.nc"), "--overwrite", "--repair", "lengths", "clock"])
        == 0
    )
    assert "all are cut to the shortest" in capsys.readouterr().out


@pytest.mark.slow(reason="writes and reads several formats")
@pytest.mark.parametrize("ending", ["mat", "csv", "nc"])
def test_exported_and_read_back_a_recording_is_the_same(tmp_path, ending):
    rng = np.random.default_rng(0)
    signals = {name: truth(name) for name in REQUIRED_SIGNALS}
    signals["shoulder_marker"] = 1e-3 * rng.normal(size=(N_TRIALS, N_TIME, 2))
    signals["emg"] = rng.normal(size=(N_TRIALS, 3 * N_TIME, 8)).astype(np.float32)
    labels = {name: [value] * N_TRIALS for name, value in LABELS.items()} | {"repetition": [0, 1], "order": [4, 2]}
    labels |= {"pulse_level": [0.0, 1.0], "pulse_direction": [np.nan, 20.0], "pulse_onset": [np.nan, 4.0]}
    labels |= {"limit_time": [np.nan] * 2}
    recording = make_recording(signals, labels, RATE, emg_rate=3 * RATE, emg_lead=-2e-3, emg_highpass=HighPass(20.0, 2))
    recording.attrs["repairs"] = "a gap: repaired\nall are cut to the shortest"
    export_recording(recording, tmp_path / f"r.{ending}")
    found, notes = import_recording([tmp_path / f"r.{ending}"])
    assert notes == ()
    assert found.attrs["repairs"] == recording.attrs["repairs"]
    for name in (*recording.data_vars, *recording.coords):
        np.testing.assert_array_equal(found[name].values, recording[name].values)
    said = ("lead", "highpass", "highpass_order")
    assert [found["emg"].attrs[name] for name in said] == [-2e-3, 20.0, 2]
    if ending == "csv":  # the trials of both files must be the same
        text = (tmp_path / "r_emg.csv").read_text().replace("\n2,", "\n3,")
        (tmp_path / "r_emg.csv").write_text(text)
        with pytest.raises(ValueError, match=r"r_emg.csv: trials 1, 3; expected 1, 2 as r.csv has"):
            import_recording([tmp_path / "r.csv"])


@pytest.mark.slow(reason="converts several files")
def test_repairs_before_and_after_an_export_are_kept(tmp_path):
    values = table()
    values[600:603, 6] = np.nan
    first = import_recording(write(tmp_path, values), repair="gaps")
    export_recording(first.recording, tmp_path / "r.csv")
    values = (tmp_path / "r.csv").read_text().splitlines()
    (tmp_path / "r.csv").write_text("\n".join(values[:-10]))
    again = import_recording(tmp_path / "r.csv", repair="lengths")
    assert again.recording.attrs["repairs"].splitlines() == [*first.notes, *again.notes]
    assert "has a gap of 0.015 s at 3 s: repaired" in first.notes[0]


def test_the_example_of_the_documentation_is_a_sidecar(tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```json\n(.*?)```", text, flags=re.DOTALL)
    (tmp_path / "example.json").write_text(blocks[0])
    sidecar = Sidecar.load(tmp_path / "example.json")
    assert set(sidecar.signals) >= set(REQUIRED_SIGNALS)


def test_a_single_path_and_a_single_repair_stand_for_themselves(tmp_path):
    path = write(tmp_path)
    assert_is_the_laboratory(import_recording(str(path), repair="gaps").recording)
    for given, options, message in (
        (None, {}, "recordings = None; expected the path of a file, or several"),
        ([3], {}, "recordings: path = 3; expected the path of a file"),
        ([path], {"repair": 3}, "convert: repair = 3; expected some of gaps, drops"),
        ([path], {"repair": "zz"}, "repair = 'zz'; expected one of gaps, drops"),
        ([path], {"optional": 3}, "import_recording: optional = 3; expected some of joint_angle"),
        ([path], {"optional": ["zz"]}, "import_recording: optional has 'zz'; expected some of joint_angle"),
        ([path], {"optional": "zz"}, "import_recording: optional has 'zz'; expected some of joint_angle"),
        ([], {}, "recordings is empty; expected at least one"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            import_recording(given, **options)
    with pytest.raises(ValueError, match="load_recording: optional has 'zz'; expected some of joint_angle"):
        load_recording(path, ["zz"])
