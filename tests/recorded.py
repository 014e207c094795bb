"""A study whose trials take a second, compared file by file, and what disturbs it; and a small cohort."""

import hashlib
import threading
import time

from armperturb.recording_files import load_recording
from armperturb.study.experiments.cohort_cells import measure_cohort
from armperturb.study.recording.settings import StudySettings

PROTOCOL = """
forces = "published"
trial_duration = 1.0
multisine_duration = 0.9
onset_window = [0.3, 0.8]

[[conditions]]
name = "PT2.5"
task = "PT"
rms_displacement = 0.0025
published_force = 1.2
pulse_levels = [1]

[[conditions]]
name = "RT0"
task = "RT"
pulse_levels = [1]
"""
N_SUBJECTS, N_TRIALS = 4, 4
PATIENCE = 120.0  # [s]; far more than anything here takes, on however busy a machine


def files(out):
    return {path.name: path.read_bytes() for path in (out / "recordings").iterdir()}


def assert_same_content(out, expected):
    """The same files with the same content, and checksums that fit.

    Bytes nearly always agree too, and then nothing is read; but HDF5 may arrange a file differently.
    """
    found = files(out)
    assert found.keys() == expected.keys()
    for name in found.keys() - {"SHA256SUMS"}:
        if found[name] != expected[name]:
            here, there = (load_recording(write(out, each)) for each in (found[name], expected[name]))
            assert here.identical(there), name
    assert_checksums_fit(found)


def write(out, content):
    path = out.with_name(f"{out.name}-compared.nc")
    path.write_bytes(content)
    return path


def assert_checksums_fit(found):
    sums = dict(reversed(line.split("  ")) for line in found["SHA256SUMS"].decode().splitlines())
    assert sums == {name: hashlib.sha256(found[name]).hexdigest() for name in found if name.endswith(".nc")}


def count(out):
    return len(list((out / "recordings").glob("*.nc")))


def arguments(out, protocol, *options):
    return [
        *("study", "--out", str(out), "--protocol", str(protocol), "--subjects", str(N_SUBJECTS), "--seed", "3"),
        *("--muscles", "linear", "--record-only", *options),
    ]


def wait_for(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def killing(out, victim):
    """A thread that kills a process as soon as the first file is there, and its verdict whether that was on the way."""
    on_the_way = []

    def kill():
        wait_for(lambda: count(out) > 0)
        victim().kill()
        on_the_way.append(count(out) < N_SUBJECTS)

    thread = threading.Thread(target=kill)
    thread.start()
    return thread, on_the_way


COHORT = """
forces = "practice"
pulse_unit = 20.0
multisine_duration = 28.5
trial_duration = 30.0
onset_window = [0.5, 1.0]

[[conditions]]
name = "RT7.5"
task = "RT"
rms_displacement = 0.0075
pulse_levels = [1.0, 2.0]

[[conditions]]
name = "PT0"
task = "PT"
pulse_levels = [1.0]
"""


def cohort(folder):
    """Settings of two people."""
    path = folder / "protocol.toml"
    path.write_text(COHORT)
    return StudySettings(subjects=2, seed=4, protocol=path, engine="compiled")


def cells_of_cohort(folder):
    """The cells of these people, measured by this process alone."""
    return measure_cohort(cohort(folder), workers=1, show_progress=False)
