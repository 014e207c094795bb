"""Tests of the dm_control face run where dm_control is installed."""

from importlib.util import find_spec

collect_ignore = (
    [] if find_spec("dm_control") else ["test_dm.py", "test_dm_state.py", "test_dm_task.py", "test_entities.py"]
)
