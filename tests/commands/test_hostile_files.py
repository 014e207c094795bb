"""Hostile recordings end every command that reads one in a single line, without a signal, a hang or gigabytes."""

import os

import h5py
import pytest
from laboratory import write

from armperturb import cli
from armperturb.convert.importer import import_recording
from armperturb.envs.render import viewer
from armperturb.foreign import read_foreign
from armperturb.recording_files import load_recording, save_recording


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = write(tmp_path_factory.mktemp("lab"))
    save_recording(import_recording([path]).recording, path.with_suffix(".nc"))
    return path.with_suffix(".nc").read_bytes()


def replaced(make):
    """A recording whose force is made anew by a function of file and path."""

    def damage(path):
        with h5py.File(path, "r+") as file:
            del file["force"]
            make(file, path)

    return damage


def virtual(file, path):
    layout = h5py.VirtualLayout((2, 1200, 2), "f8")
    layout[:] = h5py.VirtualSource(path, "force", (2, 1200, 2))
    file.create_virtual_dataset("force", layout)


def on_a_pipe(file, path):
    pipe = path.with_suffix(".pipe")
    os.mkfifo(pipe)
    file.create_dataset("force", (2, 1200, 2), "f8", external=[(str(pipe), 0, h5py.h5f.UNLIMITED)])


def zeroed(path):
    """One sector of a chunk index or a header."""
    content = bytearray(path.read_bytes())
    content[2048:2560] = bytes(512)
    path.write_bytes(content)


def packed(file, path):
    file.create_dataset("force", (30_000, 30_000), "i1", chunks=(3000, 3000), compression="gzip", fillvalue=1)


HOSTILE = {
    "itself": replaced(virtual),
    "pipe": replaced(on_a_pipe),
    "link": replaced(lambda file, path: file.__setitem__("force", h5py.ExternalLink("/etc/passwd", "/"))),
    "compound": replaced(lambda file, path: file.create_dataset("force", (2, 1200, 2), [("a", "f8"), ("b", "f8")])),
    "references": replaced(lambda file, path: file.create_dataset("force", (2, 1200, 2), h5py.ref_dtype)),
    "bytes of any length": replaced(lambda file, path: file.create_dataset("force", (2, 9, 2), h5py.vlen_dtype("u1"))),
    "small numbers that become large": replaced(packed),
    "a zeroed sector": zeroed,
    "half": lambda path: path.write_bytes(path.read_bytes()[:5000]),
}


# All commands read recordings with the same function: one kind of damage shows that.
CASES = [
    *(("convert", name) for name in HOSTILE),
    *((command, "itself") for command in ("identify", "response", "video", "report", "score", "view")),
]


@pytest.mark.slow(reason="a child process each")
@pytest.mark.parametrize(("command", "name"), CASES)
def test_each_ends_in_one_line(whole, tmp_path, capfd, monkeypatch, command, name):
    # What keeps the library busy for ever is given up earlier than users would be patient.
    monkeypatch.setitem(read_foreign.__kwdefaults__, "seconds", 1.0 if name == "a zeroed sector" else 3.0)
    monkeypatch.setattr(viewer, "require_display", lambda: None)
    (tmp_path / "recordings").mkdir()
    path = tmp_path / "recordings" / "S01.nc"
    path.write_bytes(whole)
    HOSTILE[name](path)
    options = {
        "convert": (path, "--out", tmp_path / "o.csv"),
        "identify": (path, "--model", "3b", "--out", tmp_path / "o"),
        "response": (path, "--out", tmp_path / "o"),
        "video": (path, "--trial", "0", "--out", tmp_path / "o.gif"),
        "report": (tmp_path, "--workers", "1"),
        "score": (tmp_path,),
        "view": (path,),
    }[command]
    status = cli.main([command, *map(str, options)])
    assert status == 1
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("armperturb: error: ")
    assert not list(tmp_path.glob("o*"))


@pytest.mark.slow(reason="a child process")
def test_python_is_guarded_as_well(whole, tmp_path):
    path = tmp_path / "S01.nc"
    path.write_bytes(whole)
    HOSTILE["itself"](path)
    with pytest.raises(ValueError, match="refers to values elsewhere"):
        load_recording(path)
