"""What is wrong with a force balance: faults put into the signals of a known arm on a known manipulator."""

import math
import re

import numpy as np
import pytest
from scipy import signal

from armperturb.analysis.force_balance import Balance
from armperturb.analysis.imbalance import LEAST_DELAY

RATE, N_TRIALS, DURATION = 250.0, 3, 12.0
MASS, DAMPING, STIFFNESS = 3.0 * np.eye(2), 10.0 * np.eye(2), 60.0 * np.eye(2)
ANGLE = math.radians(10.0)
TURNED = np.array([[math.cos(ANGLE), -math.sin(ANGLE)], [math.sin(ANGLE), math.cos(ANGLE)]])


def signals(mass=MASS, noise=1.0, late=(0.0, 0.0, 0.0), seed=0, force=0.02, displacement=1e-5, top=15.0):
    """d, f and x [N, N, m] of a person with reflexes and forces of their own [N], each as late as given [s]."""
    rng = np.random.default_rng(seed)
    n = round((DURATION + 4.0) * RATE)
    frequency = np.fft.rfftfreq(n, 1 / RATE)
    s = (2j * np.pi * frequency)[:, None, None]

    def coloured(low, high, rms, slope):
        used = (frequency >= low) & (frequency <= high)
        size = used / np.maximum(frequency, low) ** slope
        spectrum = rng.normal(size=(N_TRIALS, len(frequency), 2, 2)) @ [1.0, 1j] * size[:, None]
        return spectrum * rms / np.sqrt(np.mean(np.fft.irfft(spectrum, n, axis=1) ** 2))

    d, own = coloured(0.1, top, 5.0, 0.0), coloured(0.2, 8.0, noise, 0.5)
    reflex = np.exp(-0.035 * s) / (1.0 + s / 18.0) ** 2
    damping = np.array([[25.0, 8.0], [8.0, 30.0]]) + reflex * [[22.0, -6.0], [-6.0, 18.0]]
    arm = s**2 * [[1.6, 0.5], [0.5, 2.1]] + s * damping + [[300.0, -90.0], [-90.0, 250.0]]
    held = mass * s**2 + DAMPING * s + STIFFNESS
    x = np.linalg.solve(arm + held, (d + own)[..., None])
    f = (arm @ x)[..., 0] - own
    in_time = [
        np.fft.irfft(each * np.exp(-s[..., 0] * of_clock), n, axis=1)[:, : round(DURATION * RATE)]
        for each, of_clock in zip((d, f, x[..., 0]), late, strict=True)
    ]
    in_time[1] += force * rng.normal(size=in_time[1].shape)
    in_time[2] += displacement * rng.normal(size=in_time[2].shape)
    return in_time


def found(d, f, x):
    return Balance(d, f, x, RATE).imbalance


@pytest.mark.parametrize("noise", [0.0, 1.0, 8.0])
@pytest.mark.parametrize("instruments", [(0.02, 1e-5), (0.2, 5e-5), (0.0, 0.0)])
def test_nothing_is_wrong_where_there_is_but_noise(noise, instruments):
    assert found(*signals(noise=noise, force=instruments[0], displacement=instruments[1], seed=7)) is None


@pytest.mark.parametrize(("displacement", "top"), [(3e-4, 20.0), (1e-4, 30.0), (5e-5, 50.0)])
def test_displacement_as_noisy_as_markers_neither_makes_nor_hides_a_fault(displacement, top):
    d, f, x = signals(displacement=displacement, top=top, force=0.05, seed=8)
    assert found(d, f, x) is None
    assert found(d, 1.15 * f, x).bias == pytest.approx(0.15, rel=0.1)
    assert found(*signals(displacement=displacement, top=top, late=(0.0, 0.006, 0.0))).delay == pytest.approx(
        6e-3, rel=0.1
    )


@pytest.mark.slow(reason="draws many records")
def test_noise_alone_is_hardly_ever_taken_for_a_fault():
    assert [found(*signals(seed=seed, force=0.5)) for seed in range(6)] == [None] * 6


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("factor", [1.15, 1.07, 0.9])
def test_the_gain_of_a_gauge_is_named_with_its_size(factor, noise):
    d, f, x = signals(noise=noise)
    wrong = found(d, factor * f, x)
    assert wrong.kind == "gain"
    assert wrong.bias == pytest.approx(abs(factor - 1.0), rel=0.02)
    assert wrong.share > 0.7
    said = re.search(r"force appears to be ([\d.]+) % too (large|small)", wrong.text)
    assert float(said[1]) == pytest.approx(100.0 * abs(factor - 1.0), rel=0.02)
    assert said[2] == ("large" if factor > 1.0 else "small")
    one = found(d, f * [1.0, factor], x)
    assert one.kind == "gains"
    assert one.bias == pytest.approx(abs(factor - 1.0), rel=0.05)


@pytest.mark.parametrize(("factor", "more"), [(-1.0, ""), (-1.1, " and 10 % too large")])
def test_a_force_of_the_wrong_sign_is_named(factor, more):
    d, f, x = signals()
    wrong = found(d, factor * f, x)
    assert wrong.text.startswith(f"force appears to be of the wrong sign{more} (it must be the force that the handle")
    assert wrong.bias == pytest.approx(1.0 - factor, rel=0.02)
    assert "of the wrong sign in x and " in found(d, f * [-1.0, 1.0], x).text


def test_a_fault_is_named_though_encoders_are_noisy_at_high_frequencies():
    d, f, x = signals(displacement=2e-4)
    wrong = found(d, 1.07 * f, x)
    assert wrong.kind == "gain"
    assert wrong.bias == pytest.approx(0.07, rel=0.1)


def test_friction_follows_no_perturbation_and_is_not_taken_for_a_gain():
    d, f, x = signals()
    assert found(d, f - np.sign(np.gradient(x, axis=1)), x) is None


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_sensor_at_an_angle_is_named_with_the_angle(noise):
    d, f, x = signals(noise=noise)
    wrong = found(d, f @ TURNED.T, x)
    assert wrong.kind == "rotation"
    assert wrong.bias == pytest.approx(ANGLE, rel=0.02)
    said = re.search(r"turned by ([\d.]+)° from x to y \(", wrong.text)
    assert float(said[1]) == pytest.approx(10.0, rel=0.01)
    said = re.search(r"turned by ([\d.]+)° from y to x, and 10 % too small", found(d, 0.9 * f @ TURNED, x).text)
    assert float(said[1]) == pytest.approx(10.0, rel=0.01)


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize(
    ("sensor", "said"),
    [
        ([[1.0, 0.06], [0.0, 1.0]], "x appears to hold 6 % of that along y, and y 0 % of x (crosstalk"),
        ([[1.0, 0.05], [0.05, 1.0]], "x appears to hold 5 % of that along y, and y 5 % of x (crosstalk"),
        ([[1.0, 0.04], [-0.02, 1.0]], "x appears to hold 4 % of that along y, and y -2 % of x (crosstalk"),
        ([[1.2, 0.0], [0.1, 0.9]], "y 10 % of x, and to be 20 % too large in x and 10 % too small in y (crosstalk"),
    ],
)
def test_what_leaks_from_one_axis_of_the_force_into_the_other_is_named(sensor, said, noise):
    d, f, x = signals(noise=noise)
    wrong = found(d, f @ np.array(sensor).T, x)
    assert wrong.kind == "crosstalk"
    assert said in wrong.text
    assert wrong.bias == pytest.approx(np.linalg.norm(sensor - np.eye(2), 2), rel=0.05)


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize(("place", "name"), [(0, "perturbation"), (2, "displacement")])
def test_a_signal_in_axes_that_are_turned_is_named_with_the_angle(place, name, noise):
    three = signals(noise=noise)
    for turn, sense in ((TURNED, "x to y"), (TURNED.T, "y to x"), (np.linalg.matrix_power(TURNED, 4), "x to y")):
        turned = [each @ turn.T if at == place else each for at, each in enumerate(three)]
        wrong = found(*turned)
        assert wrong.kind == f"{name} axes"
        assert wrong.share > 0.95
        said = re.match(
            rf"{name} appears to be turned by ([\d.]+)° from {sense} \(.*: turn x and y of it back", wrong.text
        )
        angle = abs(math.atan2(turn[1, 0], turn[0, 0]))
        assert float(said[1]) == pytest.approx(math.degrees(angle), rel=0.02)
        if place == 2:
            assert wrong.bias == pytest.approx(2.0 * math.sin(0.5 * angle), rel=0.02)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_manipulator_that_is_not_alike_in_all_directions_is_named(noise):
    wrong = found(*signals(mass=np.diag([2.5, 3.5]), noise=noise))
    assert wrong.kind == "load"
    assert "appears to have a mass of 2.5 kg along x, 3.5 kg along y, which explains" in wrong.text
    wrong = found(*signals(mass=np.array([[2.5, 0.8], [0.8, 4.0]]), noise=noise))
    assert wrong.kind == "load"
    assert "a mass of 2.5 kg along x, 4 kg along y and 0.8 kg between them" in wrong.text


@pytest.mark.parametrize(("late", "noise"), [(0.001, 0.0), (0.001, 1.0), (0.003, 1.0), (-0.01, 0.0), (0.025, 1.0)])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_the_signal_that_is_late_is_named_with_its_delay(place, late, noise):
    wrong = found(*signals(late=np.eye(3)[place] * late, noise=noise))
    assert wrong.kind == ("perturbation", "force", "displacement")[place]
    assert wrong.delay == pytest.approx(late, abs=max(4.0 * wrong.standard_error, 1e-6))
    assert wrong.standard_error < 2e-5
    size = f"{1e3 * abs(wrong.delay):.2f} ms {'later' if late > 0.0 else 'earlier'}"
    assert wrong.text.startswith(f"{wrong.kind} is recorded {size} than")


@pytest.mark.slow(reason="repeats estimates on drawn records")
def test_the_standard_error_of_a_delay_is_its_scatter():
    delays = [found(*signals(late=(0.0, 0.002, 0.0), seed=seed, force=0.2)) for seed in range(5)]
    scatter = [(each.delay - 0.002) / each.standard_error for each in delays]
    assert 0.5 < np.sqrt(np.mean(np.square(scatter))) < 1.7


@pytest.mark.slow(reason="draws many records")
def test_a_delay_of_the_force_gives_the_skew_its_sign_and_size():
    for late, expected in (((0.0, 0.003, 0.0), 0.003), ((0.0, 0.0, 0.003), -0.003), ((0.003, 0.0, 0.0), 0.0)):
        balance = Balance(*signals(late=late), RATE)
        skew = balance.skew(*balance.fit())
        assert skew.time == pytest.approx(expected, abs=5e-5)
        assert skew.standard_error < 2e-5


def test_a_filter_that_the_perturbation_does_not_pass_is_hinted_at():
    d, f, x = signals()
    passes = signal.butter(4, 60.0, fs=RATE, output="sos")
    wrong = found(d, *(signal.sosfilt(passes, each, axis=1) for each in (f, x)))
    assert wrong.kind == "perturbation"
    assert wrong.delay == pytest.approx(-2.613 / (2.0 * RATE * math.tan(math.pi * 60.0 / RATE)), rel=0.02)
    assert "as if these two alone passed a low-pass filter or the command were held" in wrong.text
    assert wrong.share > 0.99


def test_what_none_of_these_explains_is_said_to_follow_the_perturbation():
    d, f, x = signals()
    high_pass = signal.butter(2, 1.0, "highpass", fs=RATE, output="sos")  # a gauge of piezo elements
    wrong = found(d, signal.sosfilt(high_pass, f, axis=1), x)
    assert wrong.kind == "unknown"
    assert "follows the perturbation, though no gain, rotation or delay" in wrong.text


def test_what_is_too_small_to_matter_is_not_reported():
    d, f, x = signals(force=0.0, displacement=0.0)
    assert found(d, 1.01 * f, x) is None
    late = signals(late=(0.0, 0.5 * LEAST_DELAY, 0.0), force=0.0, displacement=0.0)
    assert found(*late) is None


@pytest.mark.parametrize("zero", [0, 1, 2])
def test_a_signal_that_is_zero_tells_nothing(zero):
    three = signals()
    three[zero] = 0.0 * three[zero]
    wrong = found(*three)
    assert wrong is None or wrong.kind == "unknown"
