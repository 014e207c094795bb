"""Recordings and studies that several tests read; whichever test process needs one first makes it for all."""

import fcntl
import gc
import os
import pickle
from collections import Counter
from importlib.util import find_spec

import pytest

# Before NumPy is imported, as in the Makefile: two processes with two threads each wait for each other, and take five
# times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")

SLOW_FIXTURES = {
    **dict.fromkeys(("study", "thesis_study", "thesis_report", "ideal"), "simulates and analyses a small study"),
    "estimate": "simulates and fits trials",
    "identified": "identifies two conditions with an estimator",
    "fitted_folder": "analyses a folder several times",
    "explained": "simulates a person with and without each mechanism of the muscle law",
    "forces": "simulates practice sessions",
    "linear": "simulates a candidate of the calibration",
    "moved": "simulates a moving shoulder",
}
"""Fixtures that take seconds, and why: tests that use them are marked as slow."""


def pytest_collection_modifyitems(items):
    slow_tests = Counter()
    for item in items:
        for fixture in SLOW_FIXTURES.keys() & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow(reason=SLOW_FIXTURES[fixture]))
        slow_tests[item.path] += item.get_closest_marker("slow") is not None
    items.sort(key=lambda item: -slow_tests[item.path])  # so that no process ends long after the others


def pytest_collection_finish():
    gc.freeze()  # what was imported for all tests need not be searched for garbage in each
    gc.set_threshold(300_000, 20, 20)  # seldom: a study of small arrays makes little of it


@pytest.fixture(scope="session")
def once(tmp_path_factory):
    """A function `once(name, make)`: what `make(folder)` gives, made in one test process and read by the others.

    All get the same folder, of that name, and must leave what is in it as it is.
    """
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent  # a session's processes have a folder each, in one of their own

    def get(name, make):
        value = root / f"{name}.pickle"
        with (root / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # a process that ends lets go of it
            if not value.exists():
                (root / name).mkdir(exist_ok=True)
                made = pickle.dumps(make(root / name))
                value.with_suffix(".part").write_bytes(made)
                value.with_suffix(".part").rename(value)
        return pickle.loads(value.read_bytes())

    return get


def _compiled(part):
    from armperturb.study.results.compiling import compile_fits, compile_simulations

    return (lambda _: compile_simulations("mujoco")) if part == "simulations" else (lambda _: compile_fits())


@pytest.fixture(scope="session", autouse=True)
def compiled_in_turns(once):
    """After a change of compiled code each of two processes compiles half of what both need, not each of them all."""
    number = os.environ.get("PYTEST_XDIST_WORKER", "").removeprefix("gw")
    if number and find_spec("numba"):
        for part in sorted(("simulations", "fits"), reverse=int(number) % 2 == 0):
            once(f"compiled {part}", _compiled(part))


@pytest.fixture
def without_page(monkeypatch):
    """`identify` writes no page, which takes longer than a quick fit."""
    monkeypatch.setattr("armperturb.analysis.page.page.write_page", lambda *_: None)


@pytest.fixture
def blank_pictures(monkeypatch):
    """Commands write pictures with nothing in them, as most of their time would pass with drawing."""
    for place in ("armperturb.plots.style.svg", "armperturb.pages.page.svg"):
        monkeypatch.setattr(place, lambda _: b"")


@pytest.fixture(scope="session")
def studies():
    """The module `studies`; pytest's first process, which only deals out tests, is spared what it imports."""
    from tests import studies

    return studies


@pytest.fixture(scope="session")
def ideal_recording(studies, once):
    """Four ideal trials of the relaxed preset and four of the one that keeps position, whose arm hardly turns."""
    return once("ideal", lambda _: studies.ideal())


@pytest.fixture(scope="session")
def relax_recording(ideal_recording):
    """Four ideal trials of the relaxed preset."""
    return ideal_recording.isel(trial=slice(4))


@pytest.fixture(scope="session")
def position_recording(ideal_recording):
    """Four ideal trials of the preset that keeps position."""
    return ideal_recording.isel(trial=slice(4, None))


@pytest.fixture(scope="session")
def noisy_relax_recording(studies, once):
    """Six noisy trials of the relaxed preset, in two conditions that differ in name alone."""
    return once("noisy relax", lambda _: studies.noisy_relax())


@pytest.fixture(scope="session")
def short_protocol(studies, tmp_path_factory):
    """A protocol file: two amplitudes of each task, pulses with, without and instead of a multisine, seven trials."""
    path = tmp_path_factory.mktemp("protocol") / "short.toml"
    path.write_text(studies.SHORT)
    return path


@pytest.fixture(scope="session")
def study(studies, short_protocol, once):
    """Two noisy people with linear muscles who went through the short protocol."""
    return once("study", lambda folder: studies.short_study(short_protocol, folder))


@pytest.fixture(scope="session")
def thesis_study(studies, once):
    """Three noisy people with linear muscles in all conditions of the thesis, each pulse once, to one side."""
    return once("thesis study", studies.thesis_study)


@pytest.fixture(scope="session")
def thesis_report(studies, thesis_study, once):
    """The folder of the report on that study; pictures of the rig are plain."""
    return once("thesis report", lambda folder: studies.plain_report(thesis_study, folder))


@pytest.fixture(scope="session")
def explained(studies, once):
    """Somebody with short-range stiffness in RT alone, and one level of co-contraction; with and without it."""
    return once("explained", lambda _: studies.explained())
