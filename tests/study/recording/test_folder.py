"""The study folder: one run at a time, the same settings, and files that are whole or known not to be."""

import hashlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from armperturb import cli
from armperturb.files import checksum
from armperturb.study.recording.folder import open_study
from armperturb.study.results.cache import forget_results

MANIFEST = {"subjects": 2, "seed": 0, "protocol": {"forces": "practice", "conditions": [{"name": "A", "levels": [1]}]}}


def keep(folder, name, content):
    staged = folder.staging / f"{name}.nc"
    staged.write_bytes(content)
    return folder.keep(name, staged, hashlib.sha256(content).hexdigest())


def test_kept_files_are_found_again_and_sha256sum_agrees(tmp_path):
    with open_study(tmp_path / "s", MANIFEST) as folder:
        keep(folder, "S02", b"two")
        keep(folder, "S01", b"one")
    with open_study(tmp_path / "s", MANIFEST) as folder:
        assert folder.check(["S01", "S02", "S03"]) == (["S01", "S02"], [])
    subprocess.run(["sha256sum", "-c", "--quiet", "SHA256SUMS"], cwd=tmp_path / "s" / "recordings", check=True)


@pytest.mark.parametrize("damage", [lambda b: b[:-1], lambda b: b"x" + b[1:], lambda b: b""])
def test_damaged_files_are_set_aside(tmp_path, damage):
    with open_study(tmp_path, MANIFEST) as folder:
        path = keep(folder, "S01", b"content")
        keep(folder, "S02", b"other")
    path.write_bytes(damage(b"content"))
    with open_study(tmp_path, MANIFEST) as folder:
        whole, damaged = folder.check(["S01", "S02"])
    assert whole == ["S02"]
    assert damaged == [tmp_path / "recordings" / "S01.nc.corrupt"]
    assert not path.exists()
    assert damaged[0].read_bytes() == damage(b"content")


def test_a_lost_checksum_costs_its_subject_only(tmp_path):
    with open_study(tmp_path, MANIFEST) as folder:
        keep(folder, "S01", b"one")
        keep(folder, "S02", b"two")
    sums = tmp_path / "recordings" / "SHA256SUMS"
    sums.write_bytes(sums.read_bytes()[:80])  # in the middle of the second line
    with open_study(tmp_path, MANIFEST) as folder:
        whole, damaged = folder.check(["S01", "S02"])
        assert whole == ["S01"]
        assert len(damaged) == 1
        keep(folder, "S02", b"two")
        assert folder.check(["S01", "S02"])[0] == ["S01", "S02"]


def test_a_checksum_without_its_file_is_an_unfinished_subject(tmp_path):
    with open_study(tmp_path, MANIFEST) as folder:
        keep(folder, "S01", b"one").unlink()
        assert folder.check(["S01"]) == ([], [])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"subjects": 3}, "subjects is 2 there and 3 now"),
        ({"protocol": {**MANIFEST["protocol"], "forces": "published"}}, 'protocol.forces is "practice" there and "pub'),
        (
            {"protocol": {"forces": "practice", "conditions": [{"name": "A", "levels": [1, 2]}]}},
            "protocol.conditions[A].levels is [1] there and [1, 2] now",
        ),
        (
            {"protocol": {"forces": "practice", "conditions": [{"name": "B", "levels": list(range(40))}]}},
            'protocol.conditions[A] is {"name": "A", "levels": [1]} there and missing now; protocol.conditions[B] is '
            'missing there and {"name": "B", "levels": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10... now',
        ),
        (
            {"protocol": {"forces": "practice", "conditions": [{"name": "A", "levels": [2]}]}},
            "protocol.conditions[A].levels[0] is 1 there and 2 now",
        ),
        ({"ideal": True}, "ideal is missing there and true now"),
        ({"subjects": 3, "seed": 4}, "subjects is 2 there and 3 now; seed is 0 there and 4 now"),
    ],
)
def test_other_settings_are_refused_by_name(tmp_path, change, message):
    with open_study(tmp_path, MANIFEST) as folder:
        keep(folder, "S01", b"one")
    before = (tmp_path / "manifest.json").read_bytes()
    with (
        pytest.raises(ValueError, match="was made with other settings") as caught,
        open_study(tmp_path, {**MANIFEST, **change}),
    ):
        pass
    assert message in str(caught.value)
    assert (tmp_path / "manifest.json").read_bytes() == before


def test_foreign_and_unreadable_folders_are_refused(tmp_path):
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / "S01.nc").write_bytes(b"somebody's")
    with (
        pytest.raises(ValueError, match=r"holds recordings/S01.nc but no manifest.json"),
        open_study(tmp_path, MANIFEST),
    ):
        pass
    assert (tmp_path / "recordings" / "S01.nc").read_bytes() == b"somebody's"
    (tmp_path / "manifest.json").write_text('{"subjects": 2')
    with pytest.raises(ValueError, match=r"manifest.json: not readable as JSON"), open_study(tmp_path, MANIFEST):
        pass


def test_a_study_that_recorded_nothing_leaves_nothing(tmp_path):
    root = tmp_path / "studies" / "s"
    with pytest.raises(RuntimeError, match="refused"), open_study(root, MANIFEST):
        raise RuntimeError("refused")
    assert not list(tmp_path.iterdir())
    root.mkdir(parents=True)
    (root / "notes.txt").write_text("mine")
    with pytest.raises(RuntimeError, match="refused"), open_study(root, MANIFEST):
        raise RuntimeError("refused")
    assert [path.name for path in root.iterdir()] == ["notes.txt"]


def test_a_pipe_is_no_manifest(tmp_path):
    os.mkfifo(tmp_path / "manifest.json")
    with pytest.raises(ValueError, match=r"manifest\.json: is a folder, a pipe"), open_study(tmp_path, MANIFEST):
        pass


@pytest.mark.parametrize("name", ["manifest.json", "recordings/SHA256SUMS"])
def test_what_others_wrote_is_not_read_beyond_a_size(tmp_path, name):
    (tmp_path / "recordings").mkdir()
    with (tmp_path / name).open("wb") as file:
        file.truncate(2**40)  # takes no space
    with (
        pytest.raises(ValueError, match=rf"{name}: size = 1099511627776 bytes; expected at most"),
        open_study(tmp_path, MANIFEST),
    ):
        pass


def test_a_manifest_without_recordings_is_replaced(tmp_path):
    (tmp_path / "manifest.json").write_text(json.dumps({**MANIFEST, "seed": 4}))
    with open_study(tmp_path, MANIFEST):
        assert json.loads((tmp_path / "manifest.json").read_text()) == MANIFEST
    (tmp_path / "manifest.json").write_text('{"name": "somebody\'s page"}')
    with pytest.raises(ValueError, match="was made with other settings"), open_study(tmp_path, MANIFEST):
        pass
    assert "page" in (tmp_path / "manifest.json").read_text()


def test_the_lock_is_no_link_to_somewhere_else(tmp_path):
    target = tmp_path / "precious.txt"
    target.write_text("mine")
    root = tmp_path / "s"
    root.mkdir()
    (root / ".lock").symlink_to(target)
    with pytest.raises(ValueError, match=r"\.lock: is a link"), open_study(root, MANIFEST):
        pass
    assert target.read_text() == "mine"


@pytest.mark.parametrize("name", ["analysis", "tables", "figures", "score"])
def test_folders_of_results_are_no_links_to_somewhere_else(tmp_path, name, capsys):
    elsewhere, root = tmp_path / "mine", tmp_path / "s"
    for folder in (elsewhere, root / "recordings"):
        folder.mkdir(parents=True)
    kept = elsewhere / "backup.json.gz"
    kept.write_text("mine")
    (root / name).symlink_to(elsewhere)
    for command in (["report"], ["report", "--fresh"], ["score"], ["score", "--fresh"]):
        assert cli.main([command[0], str(root), *command[1:]]) == 1
        assert f"{name}: is a link" in capsys.readouterr().err
    assert kept.read_text() == "mine"


def test_only_kept_results_are_forgotten(tmp_path):
    names = ["S01.json.gz", "backup.tar.gz"]
    (tmp_path / "analysis").mkdir()
    for name in names:
        (tmp_path / "analysis" / name).write_text("mine")
    forget_results(tmp_path)
    assert [path.name for path in (tmp_path / "analysis").iterdir()] == names[1:]


def test_half_written_files_of_a_killed_run_go(tmp_path):
    with open_study(tmp_path, MANIFEST) as folder:
        keep(folder, "S01", b"one")
    left = [
        tmp_path / ".manifest.json.0123456789abcdef.part",
        tmp_path / "recordings" / ".SHA256SUMS.fedcba9876543210.part",
        folder.staging / "S02.nc",
    ]
    folder.staging.mkdir()
    (folder.staging / "run").write_text("process 1 on a computer")
    for path in left:
        path.write_bytes(b"half")
    with open_study(tmp_path, MANIFEST):
        assert not any(path.exists() for path in left)
    assert sorted(p.name for p in tmp_path.rglob("*")) == [
        ".lock",
        "S01.nc",
        "SHA256SUMS",
        "manifest.json",
        "recordings",
    ]


def test_hidden_files_that_no_study_made_stay(tmp_path):
    (tmp_path / ".movie.mkv.part").write_text("mine")
    with open_study(tmp_path, MANIFEST) as folder:
        keep(folder, "S01", b"one")
    assert (tmp_path / ".movie.mkv.part").read_text() == "mine"
    folder.staging.mkdir()
    (folder.staging / "notes").write_text("mine")
    with pytest.raises(ValueError, match="was not made by a study"), open_study(tmp_path, MANIFEST):
        pass
    assert (folder.staging / "notes").read_text() == "mine"


HOLDER = """
import json, sys, time
from pathlib import Path
from armperturb.study.recording.folder import open_study
with open_study(Path(sys.argv[1]), json.loads(sys.argv[2])):
    print("holding", flush=True)
    time.sleep(60)
"""


@pytest.mark.slow(reason="a process of its own")
def test_a_second_run_is_refused_until_the_first_is_killed(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path), json.dumps(MANIFEST)], stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout.readline() == "holding\n"
        message = f"another run is at work in this folder .process {holder.pid} on"
        with pytest.raises(RuntimeError, match=message), open_study(tmp_path, MANIFEST):
            pass
        holder.send_signal(signal.SIGKILL)
    with open_study(tmp_path, MANIFEST):
        pass


def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch):
    with open_study(tmp_path, MANIFEST) as folder:
        keep(folder, "S01", b"one")
        before = {path: checksum(path) for path in tmp_path.rglob("*") if path.is_file()}

        def full(*_):
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            with pytest.raises(OSError, match=r"S02.nc: cannot be written \(No space left on device\)"):
                keep(folder, "S02", b"two")
        (folder.staging / "S02.nc").unlink()
        assert {path: checksum(path) for path in tmp_path.rglob("*") if path.is_file()} == before
        assert folder.check(["S01", "S02"]) == (["S01"], [])


@pytest.mark.parametrize("name", ["mkdir", "open"])
def test_a_read_only_folder_is_told(tmp_path, monkeypatch, name):
    # By hand, as permissions do not bind the administrator, who runs tests in containers.
    def refuse(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, name, refuse)
    with (
        pytest.raises(OSError, match=r"s: cannot be written \(Read-only file system\)"),
        open_study(tmp_path / "s", MANIFEST),
    ):
        pass


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="no folder of this kind")
def test_a_folder_that_takes_no_files_is_told():
    with pytest.raises(OSError, match=r"^/proc/.lock: cannot be written"), open_study(Path("/proc"), MANIFEST):
        pass
