"""Tests of the dm_control face run where it is installed; another process; a thread that stays within a call."""

import pickle
import subprocess
import sys
import threading
from contextlib import contextmanager
from importlib.util import find_spec

import pytest

collect_ignore = (
    [] if find_spec("dm_control") else ["test_dm.py", "test_dm_state.py", "test_dm_task.py", "test_entities.py"]
)


ELSEWHERE = """
import pickle, sys
from importlib.util import find_spec
from tests.envs.learning import test_gym_env, test_state

with open(sys.argv[1], "rb") as file:
    env = pickle.load(file)
found = {"path": test_gym_env.digest(), "onwards": test_state.onwards(env)}
if find_spec("dm_control"):
    from tests.envs.learning import test_dm_task
    found["ends"] = test_dm_task.ends()
with open(sys.argv[2], "wb") as file:
    pickle.dump(found, file)
"""


@pytest.fixture(scope="session")
def elsewhere(once):
    """What another process finds, one for several tests as its start takes longest: a path, ends, and what follows."""

    def run(folder):
        from tests.envs.learning import test_state

        (folder / "env").write_bytes(pickle.dumps(test_state.in_the_middle(test_state.several, "mujoco")))
        command = [sys.executable, "-W", "ignore", "-c", ELSEWHERE, folder / "env", folder / "found"]
        subprocess.run(command, check=True)
        return pickle.loads((folder / "found").read_bytes())

    return once("elsewhere", run)


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
