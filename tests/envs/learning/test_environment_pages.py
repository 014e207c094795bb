"""The pages of the environments say what the environments are."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from armperturb.envs.learning.participants import SENSES, action_bounds, action_names, own_action
from armperturb.envs.learning.registration import TASKS
from armperturb.envs.learning.task import task_settings
from armperturb.files import packaged_table

DOCS = Path(__file__).parents[3] / "docs"
TASK = pytest.mark.parametrize("task", ["Position", "Relax", "Pulse"])


def rows(task, heading):
    """Cells of the first table below a heading of a task's page."""
    page = (DOCS / "environments" / f"{task.lower()}.md").read_text(encoding="utf-8")
    part = page.split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    table = [line for line in part.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table]


@TASK
def test_actions_and_observations(task):
    settings = task_settings(TASKS[f"ArmPerturb/{task}-v1"])
    low, high = action_bounds(settings)
    names = action_names(settings)
    actions = rows(task, "Actions")
    assert [row[:2] for row in actions] == [[str(i), name] for i, name in enumerate(names)]
    np.testing.assert_array_equal(
        [[float(cell) for cell in row[3:]] for row in actions], np.column_stack([low, high, own_action(settings)])
    )
    observations = rows(task, "Observations")
    assert [row[:2] for row in observations] == [[str(i), name] for i, name in enumerate(SENSES)]
    delays = [1e3 * settings.proprioceptive_delay] * 6 + [1e3 * settings.visual_delay] * 2
    expected = np.column_stack([np.repeat(settings.sense_scales, 2), delays])
    np.testing.assert_allclose([[float(cell) for cell in row[3:5]] for row in observations], expected)


@TASK
def test_rewards_and_settings(task):
    name = f"ArmPerturb/{task}-v1"
    settings = task_settings(TASKS[name])
    weights = np.array([1.0, settings.co_contraction_weight, settings.reflex_weight, settings.torque_weight])
    assert [row[1] for row in rows(task, "Reward")] == [f"{share:.3f}" for share in weights / weights.sum()]
    shown = {row[0].strip("`"): json.loads(row[1].strip("`")) for row in rows(task, "Settings")}
    assert shown == TASKS[name]


@TASK
def test_the_best_policy_is_the_one_that_ships(task):
    policies = {row[0]: row for row in rows(task, "What policies reach")}
    shipped = packaged_table("armperturb.envs.learning", "policies.toml")[f"ArmPerturb/{task}-v1"]
    method, seed = re.fullmatch(r"(.+), seed (\d)", shipped["trained"]).groups()
    assert policies[method][2].split(", ")[int(seed)] == f"{shipped['reward']:.3f}"
    assert next(iter(policies)) == method


@TASK
def test_films_are_small(task):
    assert (DOCS / "environments" / f"agent_{task.lower()}.gif").stat().st_size < 500e3
