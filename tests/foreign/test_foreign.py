"""Files that damage or malice has made end in one line, in time; what is whole is read as other readers read it."""

import json
import os
import struct
import subprocess
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import psutil
import pytest
import xarray as xr
from laboratory import handle, laboratory_recording
from scipy.io import loadmat, savemat

from armperturb import foreign
from armperturb.foreign import Refused, read_foreign
from armperturb.foreign.program import parse
from armperturb.recording_files import load_recording, save_recording

HEAD = b"MATLAB 5.0".ljust(124)


def element(kind, data, order="<"):
    return struct.pack(f"{order}II", kind, len(data)) + data + bytes(-len(data) % 8)


def frame(kind, dims, name=b"", order="<"):
    """Flags, dimensions and name of an array of MATLAB's format."""
    parts = (6, struct.pack(f"{order}II", kind, 0)), (5, struct.pack(f"{order}{len(dims)}i", *dims)), (1, name)
    return b"".join(element(*part, order) for part in parts)


def mat5(*matrices, order="<"):
    return HEAD + {"<": b"\x00\x01IM", ">": b"\x01\x00MI"}[order] + b"".join(element(14, m, order) for m in matrices)


def nested_cells(depth):
    """A cell array in a cell array, and so on, around a number."""
    body = element(14, frame(6, (1, 1)) + element(9, bytes(8)))
    head, heads, size = frame(1, (1, 1)), [], len(body)
    for _ in range(depth):
        heads.append(struct.pack("<II", 14, size + len(head)) + head)
        size += len(heads[-1])
    return HEAD + b"\x00\x01IM" + b"".join(reversed(heads)) + body


def zipped(content):
    packed = zlib.compress(content[128:])
    return mat5() + struct.pack("<II", 15, len(packed)) + packed


GIGABYTES = mat5(frame(1, (2**28, 1), b"a"))
"""An empty cell array of a quarter of a billion cells."""

CLAIM = struct.pack("<II", 14, 2**31 - 16) + bytes(64)
"""The beginning of a variable that claims 2 GB."""


def virtual(path):
    with h5py.File(path, "w") as file:
        layout = h5py.VirtualLayout(shape=(100,), dtype=float)
        layout[:] = h5py.VirtualSource(str(path), "a", shape=(100,))
        file.create_virtual_dataset("a", layout)


def external(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("a", shape=(100,), dtype=float, external=[(str(path.with_name("pipe")), 0, 800)])


def linked(path):
    with h5py.File(path, "w") as file:
        file["a"] = h5py.ExternalLink(str(path.with_name("pipe")), "/a")


def referring_to_itself(path):
    with h5py.File(path, "w", userblock_size=512) as file:
        array = file.create_dataset("a", (2, 1), dtype=h5py.ref_dtype)
        array[:, 0] = [array.ref] * 2


def large(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("a", shape=(2**28,), dtype=np.int8, chunks=(2**20,))


CRAFTED = {
    "20,000 nested cells.mat": (nested_cells(20_000), "nested more than 32 deep"),
    "2 GB of cells.mat": (GIGABYTES, "claims 268435456 elements; expected at most 48, its bytes"),
    "2 GB of cells, zipped.mat": (zipped(GIGABYTES), "claims 268435456 elements; expected at most 48, its bytes"),
    "2 GB, zipped.mat": (zipped(HEAD + bytes(4) + CLAIM), "unpacked = 2147483632 bytes; expected at most 1073741824"),
    "an element beyond the end.mat": (mat5(struct.pack("<II", 6, 2**31) + bytes(8)), "element of 2147483648 bytes"),
    "values within themselves.nc": (virtual, "'a' refers to values elsewhere"),
    "values in a pipe.nc": (external, "'a' refers to values elsewhere"),
    "a link to a pipe.nc": (linked, "'a' is a link"),
    "an array of itself.mat": (referring_to_itself, "nested more than 32 deep"),
    "2 GB at 8 bytes each.mat": (large, "'a' unpacked = 2147483648 bytes; expected at most 1073741824"),
}


def crafted(folder, name):
    path, (content, message) = folder / name, CRAFTED[name]
    if hasattr(os, "mkfifo"):
        os.mkfifo(folder / "pipe")
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        content(path)
    return path, message


@pytest.mark.parametrize("name", CRAFTED)
def test_crafted_files_are_refused_before_they_take_memory(tmp_path, name):
    path, message = crafted(tmp_path, name)
    with pytest.raises(Refused) as caught:
        parse(str(path), None, foreign.LARGEST)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow(reason="a child process for each file")
@pytest.mark.parametrize("name", ["20,000 nested cells.mat", "2 GB, zipped.mat", "a link to a pipe.nc"])
def test_the_child_process_says_the_same(tmp_path, name):
    path, message = crafted(tmp_path, name)
    with pytest.raises(Refused) as caught:
        read_foreign(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def recording_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("foreign") / "r.nc"
    save_recording(laboratory_recording(handle(0), handle(1)), path)
    return path


@pytest.mark.slow(reason="a child process for each sector of a file's metadata")
def test_a_recording_with_a_zeroed_sector_is_read_or_refused_in_time(recording_file, tmp_path):
    content, refused = recording_file.read_bytes(), []
    for at in range(0, 512 * 8, 512):
        path = tmp_path / "zeroed.nc"
        path.write_bytes(content[:at] + bytes(512) + content[at + 512 :])
        try:
            read_foreign(path, seconds=1.0)
        except Refused as error:
            refused.append(str(error))
    assert len(refused) >= 4
    assert all(text.startswith(str(path)) and "\n" not in text and len(text) < 500 for text in refused)


@pytest.mark.slow(reason="waits for a child process")
def test_the_child_process_is_stopped_in_time_and_its_limits_named(recording_file, tmp_path, monkeypatch):
    with pytest.raises(Refused, match=r"r.nc: parsing took 0.0001 s; expected an undamaged file"):
        read_foreign(recording_file, seconds=1e-4)
    (tmp_path / "program.py").write_text("import os\nos.abort()")
    monkeypatch.setattr(foreign, "__file__", str(tmp_path / "__init__.py"))
    with pytest.raises(Refused, match=r"r.nc: parsing crashed \(SIGABRT\); expected an undamaged file"):
        read_foreign(recording_file)


def waiting():
    """The process that waits for the next file."""
    return {child.pid for child in psutil.Process().children() if any("program.py" in word for word in child.cmdline())}


@pytest.mark.slow(reason="child processes")
def test_a_child_process_stays_until_it_refuses_or_dies(recording_file, tmp_path, monkeypatch):
    read_foreign(recording_file)
    (first,) = waiting()
    read_foreign(recording_file)
    assert waiting() == {first}
    (tmp_path / "cut.nc").write_bytes(recording_file.read_bytes()[:5000])
    with pytest.raises(Refused, match="not a readable netCDF4 file"):
        read_foreign(tmp_path / "cut.nc")
    assert waiting() == set()
    read_foreign(recording_file)
    (second,) = waiting()
    psutil.Process(second).kill()
    psutil.Process(second).wait()
    assert read_foreign(recording_file)["attrs"]
    assert waiting().isdisjoint({first, second})
    monkeypatch.setattr("armperturb.foreign.LARGE", 1000)
    read_foreign(recording_file)
    assert waiting() == set()


@pytest.mark.slow(reason="a child process for each thread")
def test_threads_read_at_the_same_time(recording_file):
    with ThreadPoolExecutor(3) as pool:
        contents = list(pool.map(read_foreign, [recording_file] * 4))
    forces = [content["variables"]["force"]["values"] for content in contents]
    assert all(np.array_equal(force, forces[0]) for force in forces)
    assert len(waiting()) == 1


def in_program(path, largest, *lines):
    """The child process, run with other limits and after other lines of Python."""
    script = Path(foreign.__file__).with_name("program.py")
    request = {"path": str(path), "names": None, "largest": largest, "seconds": 30, "without": []}
    code = "\n".join(("import runpy, sys", *lines, f"runpy.run_path({str(script)!r}, None, '__main__')"))
    asked = json.dumps(request).encode()
    return subprocess.run([sys.executable, "-c", code], input=asked, capture_output=True, check=False)


@pytest.mark.slow(reason="three child processes")
def test_memory_is_limited_where_the_system_can(recording_file):
    pytest.importorskip("resource")
    assert in_program(recording_file, foreign.LARGEST).stdout.startswith(b'{"content": {"fields": {"attrs"')
    little = in_program(recording_file, 2**24).stdout  # 64 MiB of addresses, less than the libraries take
    assert b"content" not in little
    assert in_program(recording_file, 2**24, "sys.modules['resource'] = None").stdout.startswith(
        b'{"content": {"fields": {"attrs"'
    )


def test_a_recording_comes_through_the_child_process_as_it_is(recording_file):
    xr.testing.assert_identical(load_recording(recording_file), xr.load_dataset(recording_file))
    content = read_foreign(recording_file, ["force"])
    assert content["variables"]["perturbation"]["values"] is None
    assert content["variables"]["force"]["dims"] == ["trial", "time", "axis"]


def test_matlab_files_are_read_as_scipy_reads_them(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {f"x_{kind}": (100 * rng.random((5, 2, 3))).astype(kind) for kind in ("f8", "f4", "i1", "u2", "i4", "u8")}
    arrays |= {"logical": rng.random((4, 3)) > 0.5, "complex": rng.random((4, 3)) + 1j * rng.random((4, 3))}
    arrays |= {"row": np.arange(4.0)[None], "scalar": np.array(3.5), "words": "böse Wörter"}
    structures = np.zeros((1, 3), dtype=[("a", object), ("b", object)])
    cells = np.empty((1, 2), dtype=object)
    for k in range(3):
        structures[0, k] = (np.arange(k + 2.0), {"c": "text"})
    cells[0, :] = [arrays["row"], "text"]
    for compressed in (False, True):
        path = tmp_path / f"{compressed}.mat"
        savemat(path, {**arrays, "s": structures, "one": {"a": 1.0, "b": {"c": cells}}}, do_compression=compressed)
        content, expected = parse(str(path), None, foreign.LARGEST), loadmat(path, squeeze_me=True)
        for name in arrays:
            np.testing.assert_array_equal(content[name], expected[name])
            assert name == "words" or content[name].dtype == np.asarray(expected[name]).dtype
        assert [part.tolist() for part in content["s"]["a"]] == [[0, 1], [0, 1, 2], [0, 1, 2, 3]]
        assert content["s"]["b"] == [{"c": "text"}] * 3
        assert content["one"]["a"] == 1.0
        assert content["one"]["b"]["c"][0].tolist() == [0, 1, 2, 3]
        assert content["one"]["b"]["c"][1] == "text"
        some = parse(str(path), ["row"], foreign.LARGEST)
        assert set(some) == set(content)
        assert [name for name, value in some.items() if value is not None] == ["row"]


def test_the_other_order_of_bytes(tmp_path):
    body = frame(6, (2, 1), b"big", ">") + element(3, struct.pack(">2h", 256, -2), ">")
    (tmp_path / "big.mat").write_bytes(mat5(body, order=">"))
    assert parse(str(tmp_path / "big.mat"), None, foreign.LARGEST)["big"].tolist() == [256.0, -2.0]


@pytest.mark.slow(reason="four child processes")
def test_c3d_frames_that_are_stated_wrongly_and_markers_without_forces(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = ["A"]
    file["data"]["points"] = np.ones((4, 1, 50))
    path = tmp_path / "markers.c3d"
    file.write(str(path))
    whole = path.read_bytes()
    for n_frames in (50, 60):  # in the header; POINT:FRAMES says 50
        path.write_bytes(whole[:8] + struct.pack("<H", n_frames) + whole[10:])
        content = read_foreign(path)
        assert set(content) == {"A.X", "A.Y", "A.Z"}
        assert len(content["A.X"]["values"]) == 50
    path.write_bytes(whole[:-400])
    with pytest.raises(ValueError, match="cut off or damaged"):
        read_foreign(path)


def test_c3d_channels_of_one_label_are_refused_where_they_are_wanted(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["ANALOG"]["RATE"]["value"] = [100.0]
    file["parameters"]["ANALOG"]["LABELS"]["value"] = ["Fx", "Fy", "Fx"]
    file["data"]["points"] = np.empty((4, 0, 50))
    file["data"]["analogs"] = np.arange(150.0).reshape(1, 3, 50)
    path = tmp_path / "plates.c3d"
    file.write(str(path))
    with pytest.raises(Refused, match=r"the channel 'Fx' comes twice; expected it once"):
        parse(str(path), ["Fx", "Fy"], foreign.LARGEST)
    assert parse(str(path), ["Fy"], foreign.LARGEST)["Fy"]["values"].tolist() == list(range(50, 100))
