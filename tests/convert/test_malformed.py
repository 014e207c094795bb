"""Malformed files: each ends in one clear line and a status, and nothing is written."""

import json
import re
import struct
import zipfile
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from laboratory import COLUMNS, N_TIME, as_text, meaning, table, write
from scipy.io import savemat
from test_convert import v73, write_c3d

from armperturb import cli
from armperturb.convert.importer import import_recording
from armperturb.foreign import LARGEST
from armperturb.foreign.program import parse
from armperturb.recording import MUSCLES
from armperturb.recording_files import encode_recording

VALUES = table()
TEXT = as_text(VALUES)
LINES = TEXT.splitlines()


def edited(function):
    """A file whose values are changed."""
    return lambda folder: write(folder, function(VALUES.copy()))


def retyped(function):
    """A file whose text is changed."""
    return lambda folder: write(folder, text=function(TEXT))


def redefined(function):
    """A file whose sidecar is changed."""

    def make(folder):
        sidecar = meaning()
        function(sidecar)
        return write(folder, sidecar=sidecar, text=TEXT)

    return make


def resaid(function):
    """A file whose sidecar's text is changed."""

    def make(folder):
        path = write(folder, text=TEXT)
        side = path.with_suffix(".json")
        side.write_bytes(function(side.read_bytes()))
        return path

    return make


def put(values, rows, column, value):
    values[rows, COLUMNS.index(column)] = value
    return values


def of_signal(name, **changes):
    return redefined(lambda s: s["signals"][name].update(changes))


def with_time(values):
    return lambda folder: write(folder, values, meaning(time={"channel": "t", "unit": "s"}))


TEXTS = {
    "empty": (retyped(lambda t: ""), "the file is empty"),
    "a million columns": (retyped(lambda t: "," * 2**20), "line 1: 1048576 characters or more; expected lines of a"),
    "only names": (retyped(lambda t: LINES[0] + "\n"), "rows = 0; expected at least 2"),
    "no names": (retyped(lambda t: "\n".join(LINES[1:])), "where the names of the columns are expected"),
    "column missing": (retyped(lambda t: t.replace("Fy", "Fz")), "no channel 'Fy'; expected one of 'trial'"),
    "column twice": (retyped(lambda t: t.replace("Fy", "Fx")), "'Fx' comes 2 times"),
    "text in numbers": (retyped(lambda t: t.replace(LINES[5], LINES[5] + "V")), "line 6: Y = '"),
    "underscore": (retyped(lambda t: t.replace(LINES[5], LINES[5].replace(".", "_"))), "line 6"),
    "decimal commas": (lambda f: write(f, text=as_text(VALUES, decimal=",")), "line 2: 16 values; expected 8"),
    "decimal points where commas are said": (
        lambda f: write(
            f, sidecar=meaning(csv={"delimiter": ";", "decimal": ","}), text=as_text(VALUES, delimiter=";")
        ),
        "expected a number with a decimal ','",
    ),
    "semicolons": (lambda f: write(f, text=as_text(VALUES, delimiter=";")), "no channel 'Dx'"),
    "line too short": (retyped(lambda t: t.replace(LINES[7], LINES[7].rpartition(",")[0])), "line 8: 7 values"),
    "cut off": (retyped(lambda t: t[: -len(LINES[-1]) // 2]), "expected 8 as in the header"),
    "empty line within": (retyped(lambda t: t.replace(LINES[7], "")), "line 8: empty"),
    "header again": (retyped(lambda t: t + t), "line 2402: Dx = 'Dx'; expected a number"),
    "two recordings": (retyped(lambda t: t + "\n".join(LINES[1:]) + "\n"), "trial = 1 again at sample 2400"),
    "latin": (lambda f: latin(f), "no readable text"),
    "UTF-16": (lambda f: utf16(f), "no readable text"),
    "gap": (edited(lambda v: put(v, slice(600, 609), "Fx", np.nan)), "Fx (force) has a gap of 0.045 s at 3 s"),
    "infinite": (edited(lambda v: put(v, 600, "Fx", np.inf)), "Fx (force) has a gap of 0.005 s at 3 s"),
    "all missing": (edited(lambda v: put(v, slice(None), "Fx", np.nan)), "Fx (force) has a gap of 6 s everywhere"),
    "constant": (edited(lambda v: put(v, slice(None), "Fx", 1.5)), "Fx (force) is constant at 1.5"),
    "everything zero": (edited(lambda v: v * [1, 1, 0, 0, 0, 0, 0, 0]), "is constant at 0"),
    "clipped": (
        edited(lambda v: put(v, slice(None), "X", np.clip(v[:, 6], -2e-3, 2e-3))),
        "X (displacement) is clipped",
    ),
    "sign": (edited(lambda v: v * [1, 1, 1, 1, -1, -1, 1, 1]), "the sign of force were turned"),
    "axes swapped": (edited(lambda v: v[:, [0, 1, 2, 3, 4, 5, 7, 6]]), "x and y of displacement were swapped"),
    "axis mirrored": (edited(lambda v: v * [1, 1, 1, 1, 1, 1, 1, -1]), "the sign of y of displacement were turned"),
    "place in a room": (
        edited(lambda v: v + np.array([0, 0, 0, 0, 0, 0, 0.1, 0.4])),
        "expected the path from the start of the trial (for places in a room \"start\": \"first\"",
    ),
    "millimetres": (edited(lambda v: v * [1, 1, 1, 1, 1, 1, 1e3, 1e3]), "displacement is"),
    "centimetres": (edited(lambda v: v * [1, 1, 0.2, 0.2, 0.2, 0.2, 20, 20]), "d - f moves a mass of 0.03 kg"),
    "pounds": (edited(lambda v: v / [1, 1, 1, 1, 4.448, 4.448, 1, 1]), "force were multiplied by 4.448"),
    "huge": (edited(lambda v: put(v, 600, "Fx", 1e300)), "force is 1e+300 at sample 600; expected numbers"),
    "unrelated": (edited(lambda v: put(v, slice(None), "Fx", np.sin(v[:, 1]) + v[:, 1])), "no change of signs"),
    "unequal": (edited(lambda v: v[:-30]), "lasts 5.85 s, other trials up to 6 s"),
    "trial unnumbered": (edited(lambda v: put(v, 3, "trial", np.nan)), "trial of sample 3 is nan"),
    "trials mixed": (edited(lambda v: v[np.argsort(v[:, 1], kind="stable")]), "again at sample"),
    "199.3 Hz": (with_time(table(rate=199.3)), "time runs at 199.3 Hz"),
    "dropped": (with_time(np.delete(VALUES, slice(500, 503), axis=0)), "3 samples are dropped at 2.495 s"),
    "microseconds": (with_time(VALUES * np.where(np.arange(8) == 1, 1e6, 1.0)), "a wrong unit of the times?"),
    "time far away": (with_time(put(VALUES.copy(), -1, "t", 1e12)), "dropped at 5.99 s (time steps by 1e+15"),
    "time backwards": (with_time(put(VALUES.copy(), 700, "t", 0.1)), "time steps back from 3.495 s to 0.1 s"),
    "time stands": (with_time(put(VALUES.copy(), slice(None), "t", 0.0)), "time stands still at 0 s, samples 0 and 1"),
    "time missing": (with_time(put(VALUES.copy(), 700, "t", np.nan)), "the time of sample 700 is missing"),
}  # fmt: skip


def latin(folder):
    path = write(folder, VALUES)
    path.write_bytes("Kraft in µN,".encode("latin-1") + path.read_bytes())
    return path


def utf16(folder):
    path = write(folder, VALUES)
    path.write_text(path.read_text(), encoding="utf-16")
    return path


EMG = {"channels": {name: name for name in MUSCLES}, "unit": "V", "rate": 2000}

SIDECARS = {
    "no sidecar": (lambda f: without(write(f, VALUES)), "no such file, or a folder; expected the sidecar"),
    "empty sidecar": (resaid(lambda b: b""), "no readable JSON"),
    "repairs in a text": (redefined(lambda s: s.update(repairs="all")), "repairs = 'all'; expected a list of texts"),
    "sidecar cut off": (resaid(lambda b: b[: len(b) // 2]), "no readable JSON"),
    "sidecar no text": (resaid(lambda b: b"\xff\xfe\x00" + b), "no readable JSON"),
    "sidecar of brackets": (resaid(lambda b: b"[" * 100_000), "no readable JSON"),
    "sidecar a list": (resaid(lambda b: b"[]"), "the file = []; expected an object"),
    "NaN in sidecar": (resaid(lambda b: b.replace(b"200.0", b"NaN")), "NaN is no number of JSON"),
    "field twice": (resaid(lambda b: b'{"rate": 100, ' + b[1:]), "the field 'rate' comes twice"),
    "sidecar of megabytes": (resaid(lambda b: b + b" " * 2**20), "expected at most"),
    "unknown field": (redefined(lambda s: s.update(frequency=200)), "frequency: unknown field; expected rate"),
    "field missing": (redefined(lambda s: s.pop("axes")), "axes is missing"),
    "signal missing": (redefined(lambda s: s["signals"].pop("force")), "signals.force is missing"),
    "who exerts it": (redefined(lambda s: s["signals"]["force"].pop("exerted_by")), "force.exerted_by is missing"),
    "nobody exerts it": (of_signal("force", exerted_by="robot"), "exerted_by = 'robot'; expected one of handle, hand"),
    "unit unknown": (of_signal("force", unit="kg"), "signals.force.unit = 'kg'; expected a unit: N, "),
    "unit of another": (of_signal("displacement", unit="deg"), "signals.displacement.unit = 'deg'; expected a unit: m"),
    "unit no text": (of_signal("displacement", unit=["m"]), "signals.displacement.unit = ['m']"),
    "one channel for both": (of_signal("force", channels={"x": "Fx", "y": "Fx"}), "= 'Fx' twice"),
    "no y": (of_signal("force", channels={"x": "Fx"}), "signals.force.channels.y is missing"),
    "channel a number": (of_signal("force", channels={"x": 1, "y": 2}), "channels.x = 1; expected text"),
    "axes alike": (redefined(lambda s: s.update(axes={"x": "left", "y": "right"})), "expected a direction across it"),
    "axis up": (redefined(lambda s: s.update(axes={"x": "left", "y": "up"})), "axes.y = 'up'; expected one of right"),
    "start of three": (of_signal("displacement", start=[0, 0, 0]), "start = [0, 0, 0]; expected 'first', or [x, y]"),
    "no rate": (redefined(lambda s: s.pop("rate")), "rate and time are missing"),
    "rate in words": (redefined(lambda s: s.update(rate="fast")), "rate = 'fast'; expected a finite number"),
    "rate negative": (redefined(lambda s: s.update(rate=-200)), "rate = -200.0; expected a finite number at least 1"),
    "rate of a hundred digits": (redefined(lambda s: s.update(rate=10**400)), "rate has more than 50 digits; expected"),
    "sidecar of many fields": (
        resaid(lambda b: json.dumps({f"k{i}": 1 for i in range(50_000)}).encode()),
        "k0: unknown field",
    ),
    "rate of a thousand letters": (redefined(lambda s: s.update(rate="x" * 1000)), "xx; expected a finite number"),
    "channel of a thousand letters": (
        of_signal("force", channels={"x": "x" * 1000, "y": "Fy"}),
        "expected printable text of 1 to 200 characters",
    ),
    "a channel of two signals": (
        of_signal("force", channels={"x": "Dx", "y": "Fy"}),
        "signals.force.channels has 'Dx', as perturbation has",
    ),
    "EMG in a folder": (
        redefined(lambda s: s["signals"].update(emg=EMG | {"file": "../emg.csv"})),
        "file = '../emg.csv'; expected the name of a file",
    ),
    "EMG missing": (
        redefined(lambda s: s["signals"].update(emg=EMG | {"file": "emg.csv"})),
        "emg.csv: no such file, or a folder; expected signals.emg.file",
    ),
    "a high-pass without an order": (
        redefined(lambda s: s["signals"].update(emg=EMG | {"file": "emg.csv", "highpass": {"frequency": "20 Hz"}})),
        "signals.emg.highpass.order is missing; expected the order of the amplifier's high-pass",
    ),
    "a high-pass of half an order": (
        redefined(lambda s: s["signals"].update(emg=EMG | {"highpass": {"frequency": 20, "order": 0.5}})),
        "signals.emg.highpass.order = 0.5; expected",
    ),
    "EMG of another rate in one file": (
        redefined(lambda s: s["signals"].update(emg=EMG)),
        "signals.emg.rate without signals.emg.file",
    ),
    "the dialect of EMG in the same file": (
        redefined(lambda s: s["signals"].update(emg={"channels": {"b": "b"}, "unit": "V", "csv": {"skip_lines": 1}})),
        "signals.emg.csv without signals.emg.file; expected that",
    ),
    "names are skipped": (
        redefined(lambda s: s.update(csv={"skip_lines": 1})),
        "where the names of the columns are expected (skip_lines of csv in the sidecar",
    ),
    "rate true": (redefined(lambda s: s.update(rate=True)), "rate = True; expected a number"),
    "half the rate": (
        redefined(lambda s: s.update(rate=100.0, environment={"m_env": 3.0})),
        "d - f moves a mass of 12 kg; expected 2 to 4.5 kg",
    ),
    "no subject": (redefined(lambda s: s["labels"].pop("subject")), "labels.subject is missing"),
    "task": (redefined(lambda s: s["labels"].update(task="hold")), "labels.task = 'hold'; expected one of PT, RT"),
    "length in cm": (redefined(lambda s: s["labels"].update(l_h=31)), "labels.l_h = 31; expected 0.1 to 0.7 m"),
    "length in litres": (redefined(lambda s: s["labels"].update(l_h="31 l")), "'31 l'; expected a number with a unit"),
    "angle in rad": (redefined(lambda s: s["labels"].update(theta_e_deg=0.4)), "theta_e_deg = 0.4; expected 1 to 179"),
    "half a repetition": (redefined(lambda s: s["labels"].update(repetition=0.5)), "expected a whole number"),
    "name of control characters": (redefined(lambda s: s["labels"].update(subject="a\nb")), "expected printable text"),
    "name of half a character": (redefined(lambda s: s["labels"].update(subject="\ud800")), "expected printable text"),
    "pulse without onset": (redefined(lambda s: s["labels"].update(pulse_level=1)), "without pulse_onset"),
    "pulse after the end": (redefined(lambda s: s["labels"].update(pulse_onset=90)), "expected within the trial"),
    "trial without labels": (redefined(lambda s: s.update(trials={"1": {}})), "trials has no '2'"),
    "delimiter": (redefined(lambda s: s.update(csv={"delimiter": "|"})), "csv.delimiter = '|'; expected one of"),
    "decimal as delimiter": (redefined(lambda s: s.update(csv={"decimal": ","})), "expected another one"),
    "another mass": (redefined(lambda s: s.update(environment={"m_env": 10})), "mass of 3 kg; expected 6.67 to 15"),
}  # fmt: skip


def without(path):
    path.with_suffix(".json").unlink()
    return path


CHANNELS = {name: f"{name}(trial,time,{{}})" for name in ("perturbation", "force", "displacement")}


def matlab(folder, v5=True):
    """A good MATLAB file and its sidecar."""
    parts = VALUES.reshape(2, -1, 8)
    content = {name: parts[:, :, 2 * k + 2 : 2 * k + 4] for k, name in enumerate(CHANNELS)}
    path = folder / "lab.mat"
    if v5:
        savemat(path, content)
    else:
        v73(path, content)
    sidecar = meaning()
    del sidecar["trial"]
    for name, channel in CHANNELS.items():
        sidecar["signals"][name]["channels"] = {"x": channel.format(1), "y": channel.format(2)}
    path.with_suffix(".json").write_text(json.dumps(sidecar))
    return path


def binary(function, **options):
    """A MATLAB file whose bytes are changed."""

    def make(folder):
        path = matlab(folder, **options)
        path.write_bytes(function(path.read_bytes()))
        return path

    return make


def zipped(folder):
    path = matlab(folder)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("a.txt", "data")
    return path


def many_elements(content):
    """The first variable's first dimension says 2^28."""
    at = content.index(struct.pack("<III", 5, 12, 2))
    return content[: at + 8] + struct.pack("<I", 2**28) + content[at + 12 :]


def renamed(**changes):
    def make(folder):
        path = matlab(folder)
        sidecar = json.loads(path.with_suffix(".json").read_text())
        sidecar["signals"]["force"]["channels"] |= changes
        path.with_suffix(".json").write_text(json.dumps(sidecar))
        return path

    return make


@cache
def good_c3d():
    """Content of a good C3D file, and its sidecar's."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "lab.c3d")
        write_c3d(path)
        return path.read_bytes(), path.with_suffix(".json").read_bytes()


def c3d(function):
    def make(folder):
        content, sidecar = good_c3d()
        (folder / "lab.json").write_bytes(sidecar)
        (folder / "lab.c3d").write_bytes(function(content))
        return folder / "lab.c3d"

    return make


@cache
def good_netcdf():
    with TemporaryDirectory() as folder:
        return encode_recording(import_recording([write(Path(folder), text=TEXT)]).recording)


def netcdf(function):
    def make(folder):
        (folder / "r.nc").write_bytes(function(good_netcdf()))
        return folder / "r.nc"

    return make


def rewritten(function):
    """A netCDF file in which something else is written."""

    def make(folder):
        path = netcdf(lambda content: content)(folder)
        with h5py.File(path, "a") as file:
            function(file)
        return path

    return make


def backwards(file):
    file["force"][...] = -file["force"][...]


def text_in_matlab(folder):
    path = matlab(folder)
    savemat(path, {"perturbation": "abc", "force": "abc", "displacement": {"x": 1.0}})
    return path


BINARIES = {
    "zip as .mat": (zipped, "no MATLAB file of v5 or later (a zip archive)"),
    "empty .mat": (binary(lambda b: b""), "the file is empty"),
    "text as .mat": (binary(lambda b: TEXT.encode()), "no MATLAB file of v5 or later (it begins with b'trial"),
    ".mat cut off": (binary(lambda b: b[: len(b) // 2]), "the file is cut off or damaged"),
    ".mat cut off in a tag": (binary(lambda b: b + b"\x0e\0\0"), "no variable at byte"),
    "two .mat in one": (binary(lambda b: b + b), "no variable at byte"),
    ".mat claims 2 GB": (binary(lambda b: b[:132] + struct.pack("<I", 2**31) + b[136:]), "claims 2147483648 bytes"),
    ".mat claims many elements": (binary(many_elements), "elements; expected at most"),
    ".mat of garbage": (binary(lambda b: b[:300] + bytes(reversed(b[300:]))), "no variable at byte"),
    "HDF5 cut off": (binary(lambda b: b[: len(b) // 2], v5=False), "not a readable MATLAB file (Unable to synchronous"),
    "HDF5 of garbage": (binary(lambda b: b[:600] + bytes(len(b) - 600), v5=False), "not a readable MATLAB file"),
    "two netCDF in one": (netcdf(lambda b: b + b), "two files in one?"),
    "netCDF cut off": (netcdf(lambda b: b[: len(b) // 2]), "truncated file"),
    "netCDF empty": (netcdf(lambda b: b""), "no HDF5 file (the file is empty)"),
    "netCDF is text": (netcdf(lambda b: TEXT.encode()), "no HDF5 file (it begins with b'trial"),
    "C3D cut off": (c3d(lambda b: b[: len(b) // 2]), "header claims"),
    "C3D claims 5 GB": (
        c3d(lambda b: b[:2] + struct.pack("<4H", 4000, 4000, 1, 60000) + b[10:]),
        "unpacked = 9600000000 bytes; expected at most 1073741824",
    ),
    "two C3D in one": (c3d(lambda b: b + b), "a second header follows the data"),
    "C3D empty": (c3d(lambda b: b""), "no C3D file (the file is empty)"),
    "C3D is text": (c3d(lambda b: TEXT.encode()), "no C3D file"),
    "C3D without frames": (c3d(lambda b: b[:6] + struct.pack("<2H", 9, 1) + b[10:]), "0 frames; expected at least one"),
    "C3D of garbage": (c3d(lambda b: b[:512] + bytes(reversed(b[512:]))), "expected them (the file is damaged)"),
}  # fmt: skip
"""Refused by the parsers, which run in a child process where they are not tested."""

CONTENTS = {
    "no such variable": (renamed(x="strength(time)"), "no channel 'strength(time)'; expected one of 'perturbation', "),
    "no such column": (renamed(x="force(trial,time,3)"), "has shape"),
    "no dimension of time": (renamed(x="force(1,2)"), "expected a variable or field and its dimensions"),
    "too many dimensions": (renamed(x="force(trial,time,1,1)"), "expected one length"),
    "code as a channel": (renamed(x="__import__('os')"), "expected a variable or field and its dimensions"),
    "text in .mat": (text_in_matlab, "expected an array of numbers"),
    "netCDF with the force turned": (rewritten(backwards), "the sign of force were turned"),
    "netCDF with units of an array": (
        rewritten(lambda f: f["force"].attrs.__setitem__("units", np.arange(3))),
        "force has units array([0, 1, 2]); expected 'N'",
    ),
    "unknown ending": (lambda f: write(f, VALUES).rename(f / "lab.xls"), "ending = '.xls'; expected one of .csv, "),
    "a folder": (lambda f: folder_called(f), "no such file, or a folder"),
}  # fmt: skip


def folder_called(folder):
    (folder / "lab.csv").mkdir()
    return folder / "lab.csv"


def assert_one_clear_line(error, message, folder):
    text = f"{error.value}"
    assert message in text
    assert "\n" not in text
    assert len(text) < 600 + len(str(folder)) * 2


@pytest.mark.parametrize("name", {**TEXTS, **SIDECARS, **CONTENTS})
def test_each_is_refused_in_one_clear_line(name, tmp_path):
    make, message = {**TEXTS, **SIDECARS, **CONTENTS}[name]
    path = make(tmp_path)
    with pytest.raises((ValueError, TypeError, FileNotFoundError)) as error:
        import_recording([path])
    assert_one_clear_line(error, message, tmp_path)
    assert str(error.value).startswith(str(tmp_path))


@pytest.mark.parametrize("name", BINARIES)
def test_each_parser_refuses_in_one_clear_line(name, tmp_path):
    make, message = BINARIES[name]
    path = make(tmp_path)
    with pytest.raises(ValueError, match=r".") as error:
        parse(str(path), None, LARGEST)
    assert_one_clear_line(error, message, tmp_path)


@pytest.mark.parametrize(
    ("cases", "name"),
    [(TEXTS, "empty"), (SIDECARS, "unknown field"), (BINARIES, ".mat cut off"), (CONTENTS, "a folder")],
)
def test_the_command_prints_that_line_and_writes_nothing(cases, name, tmp_path, capsys):
    make, message = cases[name]
    path = make(tmp_path)
    before = sorted(tmp_path.iterdir())
    assert cli.main(["convert", str(path), "--out", str(tmp_path / "out.nc")]) == 1
    captured = capsys.readouterr()
    (line,) = captured.err.strip().splitlines()
    assert line.startswith(f"armperturb: error: {path.parent}")
    assert message in line
    assert captured.out == ""
    assert sorted(tmp_path.iterdir()) == before


def test_no_sidecar_is_written_of_a_million_columns(tmp_path, capsys):
    (tmp_path / "lab.csv").write_text("a\n" + "," * 2**20)
    assert cli.main(["sidecar", str(tmp_path / "lab.csv")]) == 1
    assert "lab.csv, line 2: 1048576 characters or more" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["lab.csv"]


@pytest.mark.slow(reason="converts several files")
def test_what_does_not_go_together_is_refused(tmp_path):
    path = write(tmp_path, VALUES)
    good = netcdf(lambda content: content)(tmp_path)
    for files, options, message in (
        ([path, good], {}, "beside files of other formats; expected only netCDF or none"),
        ([good], {"sidecar": path.with_suffix(".json")}, "expected none with netCDF"),
        ([good], {"repair": "gaps"}, "repair = ['gaps']; expected none with netCDF"),
        ([good], {"rate": 1e6}, "r.nc: rate = 1e+06 Hz from 200 Hz; expected at most 50 times as many samples"),
        ([path, path], {}, "comes twice; expected each recording once"),
        ([path], {"rate": 0.0}, "rate = 0.0; expected a finite number at least 1"),
        (
            [path],
            {"repair": ["holes"]},
            "repair = 'holes'; expected one of gaps, drops, clock, lengths, stretch, trials",
        ),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            import_recording(files, **options)


def test_the_ending_of_what_is_written_is_refused_before_anything_is_read(tmp_path, capsys):
    for out, message in (("o.xls", "ending = '.xls'; expected one of .nc, .csv, .mat"), ("no/o.nc", "does not exist")):
        assert cli.main(["convert", str(tmp_path / "absent.csv"), "--out", str(tmp_path / out)]) == 1
        assert message in capsys.readouterr().err


SHORT = table(1, duration=0.5)[:, [0, 1, 2, 3, 4, 5, 6, 7]]
SHORT_TEXT = as_text(SHORT)

PLACES = st.sampled_from(
    [
        ("rate",), ("time",), ("trial",), ("axes",), ("axes", "x"), ("signals",), ("labels",), ("trials",),
        ("environment",), ("csv",), ("csv", "delimiter"), ("csv", "decimal"), ("csv", "skip_lines"),
        ("signals", "force"), ("signals", "force", "unit"), ("signals", "force", "channels"),
        ("signals", "force", "channels", "x"),
        ("signals", "force", "exerted_by"), ("signals", "displacement", "start"), ("signals", "emg"),
        ("signals", "joint_angle"), ("labels", "subject"), ("labels", "l_h"), ("labels", "task"),
        ("labels", "repetition"), ("labels", "pulse_onset"), ("time", "channel"), ("time", "unit"),
        ("environment", "m_env"),
    ]
)  # fmt: skip

WORDS = st.sampled_from(
    ["t", "Dx", "Fx", "X", "trial", "N", "mm", "s", "ms", "first", "left", "hand", "2 kHz", "1e999 m"]
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | WORDS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS | st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)
SPLICES = st.lists(
    st.tuples(
        st.integers(0, len(SHORT_TEXT)),
        st.integers(0, 60),
        st.text(max_size=6)
        | st.sampled_from(["\n", ",", ";", '"', "nan", "-inf", "1e308", "-1e308", "\r", "\0", "1_0"]),
    ),
    max_size=4,
)


@pytest.mark.slow(reason="reads sixty drawn files")
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=st.lists(st.tuples(PLACES, JSON), max_size=3), splices=SPLICES, repair=st.booleans())
def test_no_text_and_no_sidecar_ends_in_a_traceback(tmp_path, changes, splices, repair):
    sidecar = meaning(time={"channel": "t", "unit": "s"}, csv={}, environment={"m_env": 3})
    for place, value in changes:
        inner = sidecar
        for name in place[:-1]:
            inner = inner.get(name) if isinstance(inner, dict) else None
        if isinstance(inner, dict):
            inner[place[-1]] = value
    text = SHORT_TEXT
    for at, length, new in splices:
        text = text[:at] + new + text[at + length :]
    path = tmp_path / "lab.csv"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    path.with_suffix(".json").write_text(json.dumps(sidecar))
    faults = ("gaps", "drops", "clock", "lengths", "trials") if repair else ()
    try:
        found, error = import_recording([path], repair=faults), None
    except (ValueError, TypeError) as refused:
        found, error = None, str(refused)
    if found is not None:
        assert found.recording.sizes["trial"] >= 1
        return
    # What the command prints is one line that any terminal can show, and names the file.
    assert str(tmp_path) in error
    assert " ".join(error.split()).encode("utf-8")
    assert re.search(r"expected|no readable", error)


def test_the_file_that_is_fuzzed_is_a_good_one(tmp_path):
    path = write(tmp_path, SHORT, meaning(time={"channel": "t", "unit": "s"}, csv={}, environment={"m_env": 3}))
    assert import_recording([path]).recording.sizes["time"] == 100 < N_TIME
