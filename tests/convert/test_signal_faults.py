"""Times that are late, jitter, skip samples or run at another rate, each told from the others."""

import numpy as np
import pytest

from armperturb.convert.faults import Timed, even_times, find_stuck

RATE, N_TIME = 200.0, 1200
EVEN = np.arange(N_TIME) / RATE


def jitter(seed=0):
    return np.random.default_rng(seed).uniform(-0.34, 0.34, N_TIME) / RATE


def wave(time):
    return np.sin(2 * np.pi * 0.7 * time)[:, None]


def read(time, stated=None):
    """Rate, samples dropped at each place, faults of the clock, and the signal on even times."""
    signals, rate, faults = even_times("lab.csv: t", {"force": wave(time)}, time, stated)
    drops = [int(fault.text.split()[0]) for fault in faults if fault.repair == "drops"]
    return rate, drops, [fault.text for fault in faults if fault.repair == "clock"], signals["force"]


@pytest.mark.parametrize("at", [0, 1, 600, N_TIME - 2])
def test_a_late_time_is_no_dropped_sample(at):
    time = EVEN.copy()
    time[at] += 0.6 / RATE
    rate, drops, (clock,), values = read(time)
    assert (rate, drops) == (RATE, [])
    assert f"time does not run evenly: sample {at} is at " in clock
    assert len(values) == N_TIME


@pytest.mark.parametrize("stated", [None, RATE])
def test_jitter_drops_no_samples_and_leaves_the_rate(stated):
    for seed in range(5):
        rate, drops, (clock,), values = read(EVEN + jitter(seed), stated)
        assert (rate, drops) == (RATE, [])
        assert "time does not run evenly" in clock
        np.testing.assert_allclose(values[5:-5], wave(EVEN)[5:-5], atol=0.02)
    waits = np.random.default_rng(1).exponential(0.15, N_TIME).clip(0.0, 0.9) / RATE
    assert read(EVEN + waits, stated)[:2] == (RATE, [])


@pytest.mark.parametrize("times", [EVEN, EVEN + jitter()], ids=["even", "jittered"])
@pytest.mark.parametrize(
    ("gone", "expected"),
    [
        ([700], [1]),
        ([1], [1]),
        ([N_TIME - 3], [1]),
        (range(700, 730), [30]),
        (range(500, 700, 4), [1] * 50),
        ([300, 600, 601, 900], [1, 2, 1]),
    ],
    ids=["one", "first", "last", "thirty", "every fourth", "several"],
)
def test_dropped_samples_are_found_among_even_and_jittered_times(times, gone, expected):
    rate, drops, clock, _ = read(np.delete(times, gone))
    assert (rate, drops) == (RATE, expected)
    assert len(clock) == (times is not EVEN)


def test_a_clock_of_another_rate_is_named_through_jitter():
    time = (EVEN + jitter()) * RATE / 199.3
    _, drops, (clock,), _ = read(time, RATE)
    assert drops == []
    assert "time runs at 199.3" in clock
    assert read(time)[0] == pytest.approx(199.3, rel=1e-4)


def test_a_clock_that_wanders_drops_no_samples():
    steps = 1.0 + 0.03 * np.random.default_rng(1).uniform(-1.7, 1.7, N_TIME)  # of a loop that waits after each sample
    rate, drops, (clock,), _ = read(np.cumsum(steps) / RATE)
    assert rate == pytest.approx(RATE, rel=5e-3)
    assert drops == []
    assert "time does not run evenly" in clock


@pytest.mark.parametrize("pushed", [0.0, 1.0])
def test_displacement_may_be_constant_where_nothing_perturbs(pushed):
    time = EVEN[:400]
    signals = {"perturbation": pushed * wave(time), "force": 5.0 + wave(time), "displacement": np.full((400, 1), 0.002)}
    components = {name: (name,) for name in signals}
    timed = Timed(
        where="MVC",
        labels={},
        signals=signals,
        rates=dict.fromkeys(signals, RATE),
        components=components,
        units=dict.fromkeys(signals, ""),
    )
    said = [fault.text for fault in find_stuck(timed)]
    assert said == ["displacement (displacement) is constant at 0.002"] * (pushed > 0.0)
