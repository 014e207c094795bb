"""Draws around the presets."""

import numpy as np
import pytest

from armperturb.analysis.arm_model import largest_real_pole
from armperturb.cohort import SPREAD, STABILITY_MARGIN, draw
from armperturb.environment import Environment
from armperturb.study import published
from armperturb.study.tables import true_value
from armperturb.subject import PRESETS


@pytest.mark.parametrize(("preset", "condition"), [("relax", "RT7.5"), ("position", "PT7.5")])
def test_spread_is_the_published_one(preset, condition):
    for name, sd in SPREAD[preset].items():
        assert published.parameter(condition, name).sd == pytest.approx(sd, rel=1e-12)


@pytest.mark.parametrize("preset", PRESETS)
def test_people_are_stable_different_and_near_the_mean(preset):
    people = [draw(preset, seed) for seed in range(60)]
    assert max(largest_real_pole(person, Environment()) for person in people) < -STABILITY_MARGIN
    for name, sd in SPREAD[preset].items():
        values = np.array([true_value(person, name) for person in people])
        assert len(np.unique(values)) == len(people)
        # Redrawing shifts and narrows the distribution, by less than half an SD and half of the spread.
        assert abs(values.mean() - true_value(PRESETS[preset], name)) < 0.5 * sd + 3 * sd / np.sqrt(len(people))
        assert 0.5 * sd < values.std() < 1.4 * sd
        if name[:2] in ("kv", "kp"):
            assert values.min() >= 0


def test_same_seed_same_person():
    assert draw("position", 3, name="A") == draw("position", 3, name="A")
    assert draw("position", 3) != draw("position", 4)


def test_unknown_preset_is_named():
    with pytest.raises(ValueError, match="preset = 'tense'; expected one of relax, position"):
        draw("tense", 0)
