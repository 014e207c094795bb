"""The level of co-contraction that weighs effort against displacement."""

from dataclasses import replace

import numpy as np
import pytest
from effort import LEVELS, chosen_level, derived_levels, displacement_at_levels, weight_of

from armperturb.cohort import Person
from armperturb.study.protocol import Condition, Protocol
from armperturb.subject import POSITION


@pytest.mark.parametrize("force", [1.2, 5.4, 16.6])
def test_a_spring_is_tensed_with_the_square_root_of_the_force(force):
    # x = F / (k c): x^2 + w c^2 is least at c^4 = F^2 / (k^2 w).
    stiffness, weight = 600.0, 8e-5
    displacement = force / stiffness / np.array(LEVELS)
    assert chosen_level(LEVELS, displacement, weight) == pytest.approx((force / stiffness) ** 0.5 / weight**0.25)


def test_weight_and_level_belong_to_each_other():
    displacement = 0.01 * np.array(LEVELS) ** -0.7 + 0.001
    for level in (0.4, 1.0, 2.0):
        assert chosen_level(LEVELS, displacement, weight_of(LEVELS, displacement, level)) == pytest.approx(
            level, rel=0.002
        )


def test_effort_that_costs_all_or_nothing_ends_at_the_last_level():
    displacement = 0.01 / np.array(LEVELS)
    assert chosen_level(LEVELS, displacement, 1e3) == pytest.approx(LEVELS[0], rel=1e-3)
    assert chosen_level(LEVELS, displacement, 1e-12) == pytest.approx(LEVELS[-1], rel=1e-3)


@pytest.mark.slow(reason="optimises levels in simulations")
def test_more_force_asks_for_more_co_contraction():
    conditions = tuple(
        Condition(name=name, task="PT", rms_displacement=0.0075, published_force=force)
        for name, force in (("PT7.5", 5.4), ("PT22.5", 16.6))
    )
    protocol = Protocol(conditions=conditions, forces="published")
    # Without reflexes more co-contraction always helps, and the cost has one valley.
    silent = {f"{gain}_{joint}": 0.0 for gain in ("kv", "kp") for joint in ("s", "se", "e")}
    person = Person(name="A", height=1.8, mass=75.0, subjects={"PT": replace(POSITION, **silent)})
    levels = derived_levels(person, protocol, protocol.given_forces(), levels=(0.5, 1.0, 2.0))
    assert levels["PT7.5"] < levels["PT22.5"]
    assert levels["PT7.5"] == pytest.approx(1.0, rel=0.02)


@pytest.mark.slow(reason="optimises levels in simulations")
def test_unstable_levels_are_not_tried():
    tried, moved = displacement_at_levels(POSITION, 1.2, levels=(0.5, 1.0, 6.0))
    assert tried.tolist() == [0.5, 1.0]
    assert moved[0] > moved[1] > 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((LEVELS, np.ones(len(LEVELS)), 0.0), "weight = 0.0; expected"),
        (((1.0, 2.0), (1.0, 0.5), 1.0), "at least three"),
        (((1.0, 2.0, 1.5), (1.0, 0.5, 0.7), 1.0), "levels = .*; expected finite numbers above 0 that rise"),
        (((1.0, 2.0, 3.0), (1.0, 0.0, 0.7), 1.0), "displacement = .*; expected finite numbers above 0"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        chosen_level(*arguments)


def test_a_level_at_which_more_effort_moves_further_is_explained_by_no_weight():
    with pytest.raises(ValueError, match="the displacement grows with the level at 1"):
        weight_of((0.5, 1.0, 2.0), (0.01, 0.02, 0.03), 1.0)
