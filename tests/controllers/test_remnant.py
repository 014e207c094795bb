"""What makes people noisy: of the set size and colour, from the seed alone, and off at zero."""

import numpy as np
import pytest

from armperturb.controllers.remnant import HUMAN_NOISE, HumanNoise
from armperturb.subject import POSITION, RELAX

TIMESTEP, N_STEPS = 5e-3, 2**16
SETTLED = 4000
"""Steps, 20 s, after which the slowest low-pass has filled."""


def torque(noise, demand=(0.0, 0.0), seed=0, n_steps=N_STEPS):
    return noise.torque(demand, TIMESTEP, n_steps, np.random.default_rng(seed))


def share_below(frequency, values):
    power = np.sum(np.abs(np.fft.rfft(values, axis=0)) ** 2, axis=1)
    return power[np.fft.rfftfreq(len(values), TIMESTEP) <= frequency].sum() / power.sum()


def test_without_settings_there_is_no_noise():
    assert not torque(HumanNoise(), demand=(3.0, 2.0), n_steps=100).any()
    assert HumanNoise().vary(POSITION, np.random.default_rng(0), lambda _: False) is POSITION


@pytest.mark.parametrize(
    ("noise", "expected"),
    [
        (HumanNoise(remnant_floor=0.3), (0.3, 0.3)),
        (HumanNoise(remnant_share=0.5), (1.5, 2.0)),
        (HumanNoise(remnant_share=0.5, remnant_floor=2.0), (2.5, np.hypot(2.0, 2.0))),
        (HumanNoise(voluntary_share=0.5, voluntary_floor=2.0), (2.5, np.hypot(2.0, 2.0))),
        (HumanNoise(remnant_floor=3.0, voluntary_floor=4.0), (5.0, 5.0)),
        (HumanNoise(fast_share=0.5, remnant_floor=2.0), (2.5, np.hypot(2.0, 2.0))),
        (HumanNoise(fast_share=1.0, remnant_share=0.5, voluntary_floor=4.0).scaled(0.5), (2.61, 3.0)),
    ],
)
def test_torque_has_the_set_rms_at_each_joint(noise, expected):
    # 300 s hold some 200 independent values below 0.3 Hz, for 5 % of one SD; four seeds halve that.
    runs = np.concatenate([torque(noise, (3.0, 4.0), seed)[SETTLED:] for seed in range(4)])
    np.testing.assert_allclose(np.sqrt(np.mean(runs**2, axis=0)), expected, rtol=0.1)
    assert abs(np.corrcoef(runs.T)[0, 1]) < 0.1


def test_corrections_are_slow_and_remnant_is_coloured():
    assert share_below(0.4, torque(HumanNoise(voluntary_floor=1.0))) > 0.95
    remnant = torque(HumanNoise(remnant_floor=1.0, remnant_cutoff=2.0))
    # A second-order Butterworth passes 1 / (1 + (f / f_c)^4): 78 % of its noise lies below f_c.
    assert share_below(2.0, remnant) == pytest.approx(0.78, abs=0.03)


def test_a_longer_trial_begins_the_same_and_other_seeds_differ():
    noise = HUMAN_NOISE["PT"]
    whole, first = torque(noise, (3.0, 2.0)), torque(noise, (3.0, 2.0), n_steps=500)
    np.testing.assert_array_equal(whole[:500], first)
    assert not np.array_equal(first, torque(noise, (3.0, 2.0), seed=1, n_steps=500))


def test_parts_are_switched_off_without_touching_the_others():
    floors = ("remnant_floor", "voluntary_floor", "fast_floor")
    together = torque(HumanNoise(**dict.fromkeys(floors, 1.0)), n_steps=500)
    parts = [torque(HumanNoise(**{floor: 1.0}), n_steps=500) for floor in floors]
    np.testing.assert_allclose(sum(parts), together, rtol=1e-12)


def test_relaxed_people_make_no_slow_corrections():
    assert not any(HUMAN_NOISE["RT"].rms((1.0, 1.0))[1])
    assert all(HUMAN_NOISE["PT"].rms((1.0, 1.0))[1])


def test_parameters_spread_by_one_factor_per_quantity():
    noise = HumanNoise(spread_b=0.1, spread_k=0.2, spread_kp=0.3)
    rng = np.random.default_rng(0)
    drawn = [noise.vary(POSITION, rng, lambda _: True) for _ in range(2000)]
    for quantity, spread in (("b", 0.1), ("k", 0.2), ("kp", 0.3)):
        ratios = np.array([np.divide(s.joint_triple(quantity), POSITION.joint_triple(quantity)) for s in drawn])
        np.testing.assert_allclose(ratios, ratios[:, :1] * np.ones(3), rtol=1e-12)
        assert np.log(ratios[:, 0]).std() == pytest.approx(spread, rel=0.1)
        assert np.log(ratios[:, 0]).mean() == pytest.approx(0.0, abs=0.02)
    assert {s.joint_triple("kv") for s in drawn} == {POSITION.joint_triple("kv")}
    assert {(s.m_h, s.b_h, s.k_h) for s in drawn} == {(POSITION.m_h, POSITION.b_h, POSITION.k_h)}


def test_draws_that_are_not_accepted_are_drawn_again():
    noise = HumanNoise(spread_k=0.2)
    drawn = [noise.vary(RELAX, np.random.default_rng(i), lambda s: s.k_s < RELAX.k_s) for i in range(20)]
    assert all(s.k_s < RELAX.k_s for s in drawn)
    with pytest.raises(RuntimeError, match="no stable variation of subject 'relax' in 1000 draws"):
        noise.vary(RELAX, np.random.default_rng(0), lambda _: False)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"remnant_share": -0.1}, "HumanNoise: remnant_share = -0.1; expected a finite number at least 0"),
        ({"voluntary_floor": np.nan}, "voluntary_floor = nan; expected a finite number at least 0"),
        ({"remnant_cutoff": 0.0}, "remnant_cutoff = 0.0; expected a finite number above 0"),
        ({"spread_kv": 1.5}, "spread_kv = 1.5; expected a finite number at least 0 and at most 1"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        HumanNoise(**change)


def test_a_cutoff_beyond_the_simulation_is_named():
    with pytest.raises(ValueError, match=r"remnant_cutoff = 100.0; expected a finite number above 0 and below 100"):
        torque(HumanNoise(remnant_floor=1.0, remnant_cutoff=100.0), n_steps=10)
