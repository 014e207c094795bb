"""Tests of the dm_control face run where dm_control is installed; a thread that stays within a call."""

import threading
from contextlib import contextmanager
from importlib.util import find_spec

import pytest

collect_ignore = (
    [] if find_spec("dm_control") else ["test_dm.py", "test_dm_state.py", "test_dm_task.py", "test_entities.py"]
)


@pytest.fixture
def another_thread_within(monkeypatch):
    """Within the block, another thread that has begun a call is in a function that this call comes to."""

    @contextmanager
    def staying(owner, name, call):
        inside, proceed, function = threading.Event(), threading.Event(), getattr(owner, name)

        def wait(*arguments):
            inside.set()
            assert proceed.wait(60)
            return function(*arguments)

        monkeypatch.setattr(owner, name, wait)
        thread = threading.Thread(target=call)
        thread.start()
        assert inside.wait(60)
        try:
            yield
        finally:
            proceed.set()
            thread.join()
            monkeypatch.undo()

    return staying
