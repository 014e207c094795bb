"""The study folder: a lock, the manifest, and each subject's recording with its checksum.

| file | |
|---|---|
| `manifest.json` | everything that determines the recordings; written first |
| `recordings/NAME.nc` | one per subject, there whole or not at all |
| `recordings/SHA256SUMS` | a checksum per subject, for `sha256sum -c` |
| `recordings/NAME.nc.corrupt` | a file that did not match its checksum and was set aside |
| `.lock`, `.staging/` | held and used by a run; they mean nothing once it has ended |

A checksum is on disk before its file takes its name. So whenever a run is killed, a file that stands under its name has
a checksum: one that does not match is damaged, and one that is missing was never finished.
"""

import json
import os
import shutil
import socket
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import AcquireReturnProxy, FileLock, Timeout

from armperturb.files import PART, checksum, sync, write_whole
from armperturb.study.protocol.differences import differences

MANIFEST = "manifest.json"
RECORDINGS = "recordings"
SUMS = "SHA256SUMS"
ANALYSIS = "analysis"
"""Folder of kept results, see `results.cache`."""

RESULTS = (ANALYSIS, "tables", "figures", "score")
"""Folders of what an analysis and a report write."""

LOCK = ".lock"
STAGING = ".staging"
HOLDER = "run"
"""File in the staging folder that names the run at work."""

LARGEST_MANIFEST, LARGEST_SUMS, LARGEST_HOLDER = 2**22, 2**24, 2**10
"""Sizes of the manifest, of the checksums (75 bytes each) and of `HOLDER` that are read [byte]."""


class StudyFolder:
    """A study folder that this process alone writes to; made by `open_study`.

    Attributes:
      root: the folder.
      staging: where files of this study grow before `keep` gives them their name; on the same file system.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.staging = root / STAGING
        self._sums = _read_sums(root / RECORDINGS / SUMS)

    def recording(self, name: str) -> Path:
        """Where the recording of a subject lies, or will."""
        return self.root / RECORDINGS / f"{name}.nc"

    def check(self, names: Iterable[str]) -> tuple[list[str], list[Path]]:
        """Which recordings are there; what is damaged is set aside.

        Args:
          names: subjects of the study.

        Returns:
          The subjects whose recording is there and matches its checksum, in the given order, and the damaged files
          under the names that they have been given.

        Raises:
          OSError: a file cannot be read, or not be set aside.
        """
        present = [name for name in names if self.recording(name).is_file()]
        with ThreadPoolExecutor() as pool:  # hashing lets go of the interpreter
            digests = list(pool.map(checksum, map(self.recording, present)))
        whole, damaged = [], []
        for name, digest in zip(present, digests, strict=True):
            if self._sums.get(name) == digest:
                whole.append(name)
                continue
            path = self.recording(name)
            aside = path.with_name(f"{path.name}.corrupt")
            with _naming(path):
                os.replace(path, aside)
            damaged.append(aside)
        return whole, damaged

    def keep(self, name: str, staged: Path, sha256: str) -> Path:
        """Give a finished file its name.

        Args:
          name: the subject.
          staged: the file, complete and on disk, on the same file system.
          sha256: its checksum.

        Returns:
          The path that it has now.

        Raises:
          OSError: the folder cannot be written to; files that were kept before stay as they were.
        """
        path = self.recording(name)
        sums = {**self._sums, name: sha256}
        text = "".join(f"{sums[key]}  {key}.nc\n" for key in sorted(sums))
        with _naming(path):
            write_whole(path.parent / SUMS, text)
            os.replace(staged, path)
            sync(path.parent)
        self._sums = sums
        return path


@contextmanager
def open_study(root: Path, manifest: Mapping[str, Any]) -> Iterator[StudyFolder]:
    """Take a study folder for this process alone, a new one or one that the same study has begun.

    The lock is the operating system's: it goes when the process ends, however it ends.

    Args:
      root: the folder; made if it is not there.
      manifest: everything that determines the study's files, as JSON has it (string keys; no tuples).

    Raises:
      RuntimeError: another run holds the folder.
      ValueError: recordings in the folder were made with another manifest, which the message sets side by side, or
        are of unknown origin; the lock is a link; or the staging folder is not a study's.
      OSError: the folder cannot be written to.
    """
    made = (*reversed(root.parents), root, root / LOCK, root / MANIFEST, root / RECORDINGS)
    new = [path for path in made if not path.exists()]
    with _locked(root):
        try:
            _agree(root, manifest)
            with _naming(root):
                (root / RECORDINGS).mkdir(exist_ok=True)
                _sweep(root)
                (root / STAGING).mkdir()
                holder = f"process {os.getpid()} on {socket.gethostname()}"
                (root / STAGING / HOLDER).write_text(holder, encoding="utf-8")
            yield StudyFolder(root)
        finally:
            _remove_staging(root / STAGING)
            _remove_unused(root, new)


def _remove_unused(root: Path, new: Iterable[Path]) -> None:
    """Remove what a run has made, if nothing was recorded."""
    recordings = root / RECORDINGS
    if recordings.is_dir() and any(recordings.iterdir()):
        return
    for path in reversed(list(new)):  # the folder, the first, holds the others
        with suppress(OSError):  # a folder of the user's holds other files, and stays
            path.rmdir() if path.is_dir() else path.unlink()


def find_recordings(root: Path) -> tuple[list[Path], list[str]]:
    """Recordings that are there and whole, of a study that has ended or not; nothing is changed.

    A folder without checksums, as a laboratory may make one, counts as whole.

    Args:
      root: the folder.

    Returns:
      Their paths in the order of their names, and one line for each that is damaged or has no checksum.

    Raises:
      OSError: there is no recording.
      ValueError: none is whole.
    """
    paths, sums = sorted((root / RECORDINGS).glob("*.nc")), _read_sums(root / RECORDINGS / SUMS)
    if not paths:
        raise FileNotFoundError(
            f"{root}: holds no {RECORDINGS}/*.nc; expected the folder of a study (other recordings: armperturb "
            "identify FILES --out DIR)"
        )
    whole, remarks = [], []
    for path in paths:
        if sums and path.stem not in sums:
            remarks.append(f"{path.name} is not among the checksums of the study ({RECORDINGS}/{SUMS}); it is left out")
        elif sums and sums[path.stem] != checksum(path):
            remarks.append(f"{path.name} does not match its checksum; it is left out")
        else:
            whole.append(path)
    if not whole:
        raise ValueError(f"{root}: no recording matches its checksum; expected one that does")
    return whole, remarks


def require_own_results(root: Path) -> None:
    """Refuse a study whose folders of results are links: what is replaced or removed there would lie elsewhere.

    Raises:
      ValueError: one is.
    """
    for name in RESULTS:
        if (root / name).is_symlink():
            raise ValueError(f"{root / name}: is a link; expected a folder of this study, or none")


def kept_manifest(root: Path) -> dict[str, Any] | None:
    """What the manifest of a folder holds; None without one.

    Args:
      root: the folder.

    Raises:
      ValueError: it is no file, too large, or no table in JSON.
      OSError: it cannot be read.
    """
    path = root / MANIFEST
    if not path.exists():
        return None
    if not path.is_file():
        raise ValueError(f"{path}: is a folder, a pipe or a device; expected what an earlier run wrote")
    text = _text_of(path, LARGEST_MANIFEST)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not readable as JSON ({error}); expected what an earlier run wrote") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds a {type(content).__name__}; expected what an earlier run wrote")
    return content


def _locked(root: Path) -> AcquireReturnProxy:
    try:
        with _naming(root):
            if (root / LOCK).is_symlink():  # the lock would empty the file that it points to
                raise ValueError(f"{root / LOCK}: is a link; expected a file of this study, or none")
            root.mkdir(parents=True, exist_ok=True)
            return FileLock(root / LOCK, timeout=0).acquire()
    except Timeout:
        if not (root / LOCK).exists():  # filelock takes what it cannot make for a file that was there just now
            raise cannot_write(root / LOCK, FileNotFoundError("no file can be made there")) from None
        holder = root / STAGING / HOLDER
        process = _text_of(holder, LARGEST_HOLDER) if holder.is_file() else "unknown"
        raise RuntimeError(
            f"{root}: another run is at work in this folder ({process}); expected it to have ended, or another folder"
        ) from None


def _agree(root: Path, manifest: Mapping[str, Any]) -> None:
    """Write the manifest if nothing is recorded, else compare."""
    path, before = root / MANIFEST, kept_manifest(root)
    recording = next((root / RECORDINGS).glob("*.nc*"), None)
    if before is None and recording is not None:
        raise ValueError(
            f"{root}: holds {recording.relative_to(root)} but no {MANIFEST} that says how it was made; expected an "
            "empty folder, or one with an unfinished study"
        )
    wanted = json.loads(json.dumps(manifest))
    different = [str(each) for each in differences(before, wanted)]
    is_ours = before is None or {"subjects", "protocol"} <= before.keys()
    if different and recording is None and is_ours:
        with _naming(path):
            write_whole(path, json.dumps(manifest, indent=1, ensure_ascii=False) + "\n")
    elif different:
        more = f", and {len(different) - 3} more" if len(different) > 3 else ""
        raise ValueError(
            f"{root}: was made with other settings: {'; '.join(different[:3])}{more}; expected the same settings, or "
            "another folder"
        )


def _sweep(root: Path) -> None:
    """Remove what a killed run has left half-written.

    Raises:
      ValueError: the staging folder holds what no run has put there.
    """
    staging = root / STAGING
    if staging.is_symlink() or (staging.is_dir() and any(staging.iterdir()) and not (staging / HOLDER).is_file()):
        raise ValueError(f"{staging}: was not made by a study; expected another folder for the study (--out)")
    _remove_staging(staging)
    for folder in (root, root / RECORDINGS):
        for path in folder.glob(".*.part"):
            if PART.fullmatch(path.name):
                path.unlink(missing_ok=True)


def _remove_staging(staging: Path) -> None:
    """Remove a run's staging folder; what tells that it is one goes last, as this run may be killed meanwhile."""
    if (staging / HOLDER).is_file():
        for path in staging.iterdir():
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name != HOLDER:
                path.unlink(missing_ok=True)
        (staging / HOLDER).unlink(missing_ok=True)
    with suppress(OSError):
        staging.rmdir()


def _read_sums(path: Path) -> dict[str, str]:
    """Subject to checksum; a line that makes no sense counts as none, and its subject is then done again."""
    if not path.is_file():
        return {}
    sums = {}
    for line in _text_of(path, LARGEST_SUMS).splitlines():
        sha256, _, file = line.partition("  ")
        if len(sha256) == 64 and file.endswith(".nc"):
            sums[file.removesuffix(".nc")] = sha256
    return sums


def _text_of(path: Path, largest: int) -> str:
    """Content of a file, which must not be larger [byte]."""
    with path.open("rb") as file:
        content = file.read(largest + 1)
    if len(content) > largest:
        raise ValueError(f"{path}: size = {path.stat().st_size} bytes; expected at most {largest}")
    return content.decode("utf-8", errors="replace")


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Name the file that could not be written in an operating system's error."""
    try:
        yield
    except OSError as error:
        raise cannot_write(path, error) from error


def cannot_write(path: Path, error: OSError) -> OSError:
    """An error of the operating system of the same class, as a sentence that names the file."""
    explained = type(error)(f"{path}: cannot be written ({error.strerror or error}); what was finished before is kept")
    explained.errno = error.errno
    return explained
