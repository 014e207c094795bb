"""What a score can reach: replicates drawn at random, and what other printed numbers say of the headline ones."""

import math

import numpy as np
import pytest

from armperturb.study.comparison.ceiling import (
    OF_PRINTED_ARMS,
    amplitude_factors,
    causes,
    contradictions,
    replicate_share,
)
from armperturb.study.published import tables as published


@pytest.mark.parametrize("people", [3, 10])
def test_replicates_of_ten_normal_people_have_the_share_of_students_t(people):
    rng, n = np.random.default_rng(people), 40_000
    printed = rng.standard_normal((n, 10))
    other = rng.standard_normal((n, people)).mean(axis=1)
    z = np.abs(other - printed.mean(axis=1)) / printed.std(axis=1, ddof=1)
    for limit in (0.5, 1.0, 2.0):
        # Four standard errors of the share that is counted.
        assert np.mean(z <= limit) == pytest.approx(replicate_share(limit, people), abs=4 * math.sqrt(0.25 / n))
    assert math.isnan(replicate_share(1.0, 0))


def test_printed_arms_change_less_with_amplitude_than_the_text_says():
    for task in ("PT", "RT"):
        factors = amplitude_factors(task)
        assert factors.shape == (6,)
        assert (factors > 1.0).all()
        assert factors.max() < published.headline(f"admittance_amplitude_factor_{task.lower()}")
    # Stiffness alone: model 1 in RT, whose lowest frequencies lie below the resonance.
    stiffness = [published.estimate("k_s", table, model="1").mean for table in ("C.16", "C.20")]
    assert amplitude_factors("RT")[0] == pytest.approx(stiffness[0] / stiffness[1], rel=0.3)


def test_contradictions_name_headline_numbers_and_quote_the_tables():
    said = contradictions()
    assert list(said) == [
        "admittance_amplitude_factor_pt",
        "admittance_amplitude_factor_rt",
        "pulse_admittance_ratio_max_min_pt0",
        "pulse_admittance_ratio_max_min_pt7.5",
    ]
    for name in said:
        published.headline(name)
    assert "13.85" not in said["pulse_admittance_ratio_max_min_pt0"]
    # 13.85 / 6.20 cm over 1.3.
    assert "2.23 times the displacement" in said["pulse_admittance_ratio_max_min_pt0"]
    assert "1.72-fold" in said["pulse_admittance_ratio_max_min_pt0"]


def test_misses_are_divided_between_people_and_print():
    movements, fitted = causes({"2.1 and F": 0.88, "C": 0.43, "total": 0.5}, 10)
    assert movements.startswith(
        "movements beyond 1 SD: 12 % of computed cells; 5 % would be by the sampling of people alone"
    )
    low, high = OF_PRINTED_ARMS["C"]
    assert fitted.startswith(f"fitted cells beyond 1 SD: C 57 % ({100 - high} to {100 - low} %); in brackets")
    assert causes({"total": 0.5}, 10) == []
