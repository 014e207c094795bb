"""Square waves of commands and clipped signals, told from one another."""

import numpy as np
import pytest
from laboratory import handle, laboratory_recording

from armperturb.analysis.fit.group import parts_by_condition
from armperturb.analysis.page.data_check import check_data
from armperturb.analysis.plateaus import clipped_stretches, held_stretches

N_TIME = 6000


def random(seed=0):
    return np.random.default_rng(seed)


def multisine():
    frequency, phase = random().uniform(0.3, 20.0, 40), random(1).uniform(0.0, 2 * np.pi, 40)
    return np.sin(2 * np.pi * np.arange(N_TIME)[:, None] / 200.0 * frequency + phase).sum(axis=1) / np.sqrt(20.0)


def steps(hold, levels):
    return random(2).choice(levels, N_TIME // hold + 1).repeat(hold)[:N_TIME]


SQUARE = {
    "two levels": steps(10, [-3.0, 3.0]),
    "one level and zero": steps(10, [0.0, 3.0]),
    "three levels": steps(10, [-3.0, 0.0, 3.0]),
    "nine levels": steps(20, np.linspace(-3.0, 3.0, 9)),
    "ramps of four samples": np.convolve(steps(20, [-3.0, 3.0]), np.ones(4) / 4.0, "same"),
    "rests before and after": np.where(np.abs(np.arange(N_TIME) - 3000) < 1000, steps(10, [-3.0, 3.0]), 0.0),
}


@pytest.mark.parametrize("name", SQUARE)
def test_a_square_command_is_not_clipped(name):
    assert clipped_stretches(SQUARE[name], is_command=True) == []
    assert clipped_stretches(SQUARE[name])


CLIPPED = {
    "both sides": multisine().clip(-1.5, 1.5),
    "one side": multisine().clip(None, 1.0),
    "two thirds of the samples": multisine().clip(-0.45, 0.45),
    "amid rests": np.where(np.abs(np.arange(N_TIME) - 3000) < 1000, multisine().clip(-1.5, 1.5), 0.0),
    "coarse": 0.05 * np.round(20.0 * multisine().clip(-1.5, 1.5)),
    "each value held": np.repeat(multisine()[:1000].clip(-1.5, 1.5), 6),
}


@pytest.mark.parametrize("name", CLIPPED)
def test_a_clipped_command_is_found(name):
    assert len(clipped_stretches(CLIPPED[name], is_command=True)) > 3


def pulsed_path(size, rate):
    """Path after a pulse, from two encoders, which turn by counts of their own, (time,)."""
    time = np.arange(round(4.0 * rate)) / rate
    path = size * np.exp(-(((time - 2.0) / 0.08) ** 2)) + 3e-3 * np.sin(2.0 * np.pi * 0.7 * time + 1e3 * size)
    shoulder, elbow = 7.7e-5 * np.round(path / 1e-4), 7.7e-5 * np.round(path / 1.3e-4)
    return np.sin(0.7 + shoulder) - np.cos(0.9 + elbow)


@pytest.mark.parametrize("rate", [200.0, 500.0])
def test_a_peak_that_encoders_round_is_not_clipped(rate):
    for size in np.linspace(0.01, 0.03, 20):
        path = pulsed_path(size, rate)
        assert clipped_stretches(path) == []
        assert clipped_stretches(np.minimum(path, path[0] + 0.8 * (path.max() - path[0])))


def test_zero_is_a_limit_of_what_cannot_rest_there():
    above = multisine().clip(0.0, None)
    assert clipped_stretches(above)
    assert clipped_stretches(above, is_command=True) == []
    assert clipped_stretches(above, may_rest=True) == []


def rested(force, mass=2.0, friction=1.0):
    """Path of a handle that friction holds wherever it comes to rest and the force is small [m], (time,)."""
    path, at, speed, step = np.zeros(len(force)), 0.0, 0.0, 1.0 / 200.0
    for sample, pushed in enumerate(force):
        net = pushed - 40.0 * at
        if abs(speed) < 1e-4 and abs(net) < friction:
            speed = 0.0
        else:
            last, speed = speed, speed + step / mass * (net - 5.0 * speed - friction * np.sign(speed or net))
            speed = 0.0 if speed * last < 0.0 and abs(net) < friction else speed
        at += step * speed
        path[sample] = at
    return path


DRIVES = {
    "multisine": 3.0 * multisine(),
    "pulses": np.where(np.arange(N_TIME) % 200 < 20, 6.0, 0.0),
    "square": steps(20, [-3, 3]),
}


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("step", [0.0, 1e-5, 1e-4, 1e-3])
def test_friction_and_coarse_steps_are_not_taken_for_a_sensor_that_stopped(drive, step):
    pushed = DRIVES[drive]
    path = rested(pushed)
    path += 1e-5 * random(3).normal(size=N_TIME)
    coarse = step * np.round(path / step) if step else path
    for values in (coarse, rested(pushed), coarse[N_TIME // 2] + 0.0 * coarse):
        assert held_stretches(values, pushed[:, None], 200.0) == []
    assert held_stretches(coarse, 0.0 * pushed[:, None], 200.0) == []


def test_a_sensor_that_stopped_is_found_though_it_is_coarse_or_stops_for_good():
    pushed = 3.0 * multisine()
    path = rested(pushed, friction=0.0) + 1e-6 * random(3).normal(size=N_TIME)
    for step in (1e-6, 1e-4, 1e-3):
        values = step * np.round(path / step)
        values[2000:2100] = values[2000]
        assert [2000 in range(*stretch) for stretch in held_stretches(values, pushed[:, None], 200.0)] == [True]
    path[5900:] = path[5900]
    assert held_stretches(path, pushed[:, None], 200.0) == [(5900, N_TIME)]


def test_the_page_counts_no_square_command_as_clipped():
    d, f, x = handle()
    square = np.stack([steps(10, [-3.0, 3.0])[: len(d)], steps(15, [-3.0, 3.0])[: len(d)]], axis=1)
    (parts,) = parts_by_condition(laboratory_recording((square, f - d + square, x))).values()
    assert check_data(parts, 0.5).clipped == {}
    (parts,) = parts_by_condition(laboratory_recording((d.clip(-3.0, 3.0), f, x))).values()
    assert {*check_data(parts, 0.5).clipped} == {"perturbation x", "perturbation y"}


def test_the_page_says_how_long_a_sensor_stands_still():
    trials = [[values.copy() for values in handle(seed)] for seed in range(4)]
    (parts,) = parts_by_condition(laboratory_recording(*trials)).values()
    assert check_data(parts, 0.5).held == 0.0
    trials[2][1][500:525] = trials[2][1][500]
    (parts,) = parts_by_condition(laboratory_recording(*trials)).values()
    assert check_data(parts, 0.5).held == pytest.approx(0.125)
