"""Perturbations: what the thesis prescribes (section 2.4), exactness at any rate, and files."""

import dataclasses
import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from armperturb.perturbations import (
    CLUSTERS,
    Multisine,
    MultisineThenPulse,
    Perturbation,
    Pulse,
    Sampled,
    check_bandwidth,
    draw_onset,
    load_perturbation,
    save_perturbation,
)
from armperturb.perturbations.multisine import PERIOD

PULSE = Pulse(peak=100.0, direction_deg=20.0, onset=5.0, duration=10.0)


@pytest.fixture(scope="module")
def multisine() -> Multisine:
    return Multisine.draw(seed=1, rms=8.0)


@pytest.fixture(scope="module")
def multisines(multisine: Multisine) -> list[Multisine]:
    return [multisine, *(Multisine.draw(seed=seed, rms=8.0) for seed in (0, 2, 3, 4, 5, 6, 7))]


@pytest.fixture(scope="module")
def trial(multisine: Multisine) -> MultisineThenPulse:
    return MultisineThenPulse.join(multisine, peak=50.0, direction_deg=200.0)


# --- multisine ---


def test_clusters_are_those_of_the_thesis():
    assert CLUSTERS.shape == (18, 4)
    assert (np.diff(CLUSTERS, axis=1) == 1).all()
    lines = CLUSTERS.ravel()
    full, reduced = lines[lines / PERIOD < 1.6], lines[lines / PERIOD > 1.6]
    assert (len(full), len(reduced)) == (16, 56)
    assert (full[0], full[-1], reduced[0], reduced[-1]) == (5, 30, 37, 819)
    assert full[0] / PERIOD > 0.2
    assert full[-1] / PERIOD < 1.5
    assert reduced[0] / PERIOD > 1.8
    assert reduced[-1] / PERIOD < 40.0


def test_clusters_never_touch():
    assert (CLUSTERS[1:, 0] - CLUSTERS[:-1, -1] >= 2).all()


def test_extra_clusters_lie_on_the_logarithmic_grid_below_7_hz():
    starts = CLUSTERS[4:, 0]
    dense = starts[:9]  # five clusters and the four in between
    assert CLUSTERS[4 + 7, -1] / PERIOD < 7.0
    np.testing.assert_allclose(dense[1::2] / PERIOD, [2.14, 3.02, 4.26, 6.01], atol=0.03)
    np.testing.assert_allclose(dense[1::2], np.sqrt(dense[:-1:2] * dense[2::2]), atol=1.0)


@pytest.mark.parametrize(("reduced", "power_ratio"), [("amplitude", 0.15**2), ("power", 0.15)])
def test_spectrum_and_rms(reduced, power_ratio):
    multisine = Multisine.draw(seed=3, rms=8.0, reduced=reduced, crested=False)
    force = multisine.sample(200.0, 4096)
    np.testing.assert_allclose(np.sqrt(np.mean(force**2, axis=0)), 8.0, rtol=1e-12)
    power = np.abs(np.fft.rfft(force, axis=0)) ** 2
    full, low = power[multisine.lines[:16]], power[multisine.lines[16:]]
    np.testing.assert_allclose(full / full[0], 1.0, rtol=1e-9)
    np.testing.assert_allclose(low / full[0], power_ratio, rtol=1e-9)
    assert np.delete(power, multisine.lines, axis=0).max() < 1e-20 * power.max()


@pytest.mark.slow(reason="lowers the peaks of eight multisines")
def test_axes_and_seeds_are_independent(multisines):
    force = [it.sample(200.0, 4096) for it in multisines]
    correlation = np.corrcoef(np.hstack(force).T)[np.triu_indices(16, 1)]
    assert np.sqrt(np.mean(correlation**2)) < 0.3  # 16 lines hold most of the power: chance gives 1 / sqrt 32 = 0.18
    phases = np.stack([Multisine.draw(seed=seed, rms=1.0, crested=False).phases for seed in range(200)])
    alignment = np.abs(np.mean(np.exp(1j * (phases[:, 0] - phases[:, 1]))))
    assert alignment < 0.03


@pytest.mark.slow(reason="lowers the peaks of multisines")
def test_seed_decides(multisine):
    again = Multisine.draw(seed=1, rms=1.0).phases
    np.testing.assert_array_equal(multisine.phases, again)  # whatever the RMS force
    assert not np.allclose(Multisine.draw(seed=2, rms=1.0, crested=False).phases, again)


@pytest.mark.slow(reason="needs a process of its own")
def test_threads_do_not_change_the_phases(multisine):
    code = (
        "import hashlib; from armperturb.perturbations import Multisine; "
        "print(hashlib.sha256(Multisine.draw(seed=1, rms=1.0).phases.tobytes()).hexdigest())"
    )
    threads = "4" if os.environ["OMP_NUM_THREADS"] == "1" else "1"  # other than here
    answer = subprocess.run(
        [sys.executable, "-c", code],
        env={"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads},
        cwd=Path(__file__).parents[2],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    ).stdout
    assert answer.strip() == hashlib.sha256(multisine.phases.tobytes()).hexdigest()


def crest_factors(multisines: list[Multisine], samples_per_period: int) -> np.ndarray:
    force = np.stack([it.sample(samples_per_period / PERIOD, samples_per_period) for it in multisines])
    return np.abs(force).max(axis=1) / np.sqrt(np.mean(force**2, axis=1))


@pytest.mark.slow(reason="lowers the peaks of eight multisines")
def test_crest_factor_is_low(multisines):
    assert np.median(crest_factors(multisines, 4096)) < 1.70  # over 100 seeds: 1.685
    assert crest_factors(multisines, 4096).max() < 1.72
    assert np.median(crest_factors(multisines, 4 * 4096)) < 1.735
    assert crest_factors(multisines, 4 * 4096).max() < 1.77


@pytest.mark.slow(reason="lowers the peaks of four multisines")
def test_crest_factor_is_low_with_the_other_reduction_too():
    others = [Multisine.draw(seed=seed, rms=8.0, reduced="amplitude") for seed in range(4)]
    assert np.median(crest_factors(others, 4096)) < 1.55
    assert np.median(crest_factors(others, 4 * 4096)) < 1.575


def test_reported_crest_factor_is_that_of_the_samples(multisine):
    for rate, samples in ((200.0, 4096), (800.0, 4 * 4096)):
        np.testing.assert_allclose(multisine.crest_factor(rate), crest_factors([multisine], samples)[0], rtol=1e-9)
    np.testing.assert_array_equal(multisine.crest_factor(), multisine.crest_factor(800.0))


def test_without_cresting_phases_are_those_drawn(multisine):
    plain = Multisine.draw(seed=1, rms=8.0, crested=False)
    assert plain.crest_factor().min() > 2.4 > multisine.crest_factor().max()


def test_fast_path_agrees_with_the_sum(multisine):
    for rate, start in ((1000.0, 0.0005), (200.0, 0.0), (1000.0, -3.3), (100.0, 0.0)):
        times = start + np.arange(3000) / rate
        force = multisine.periodic(rate, 3000, start)
        assert np.abs(force - multisine.sum_at(times)).max() < 1e-12 * np.abs(force).max()


def test_rates_agree_where_they_meet(multisine):
    fine = multisine.sample(1000.0, 34_000)
    for rate in (200.0, 40.0, 1000.0 / 3.0):
        step = round(1000.0 / rate)
        coarse = multisine.sample(rate, len(fine[::step]))
        np.testing.assert_allclose(coarse, fine[::step], atol=1e-11)


def test_multisine_is_extended_and_ends(multisine):
    force = multisine.sample(200.0, 6600, start=-0.5)
    assert not force[:100].any()
    assert not force[6500:].any()
    assert force[[100, 6499]].all()
    np.testing.assert_allclose(force[100 + 4096 : 6500], force[100 : 6500 - 4096], atol=1e-11)


# --- pulse ---


def test_pulse_peak_impulse_and_direction():
    force = PULSE.sample(100_000.0, 1_000_000)
    size = np.hypot(*force.T)
    assert size.max() == pytest.approx(100.0)
    assert size.argmax() == pytest.approx(504_000, abs=1)
    assert size.sum() / 100_000.0 == pytest.approx(2.0 / np.pi * 100.0 * 0.08, rel=1e-6)
    assert np.degrees(np.arctan2(*force[504_000, ::-1])) == pytest.approx(20.0)
    assert np.flatnonzero(size > 1e-9)[[0, -1]].tolist() == [500_001, 507_999]


def test_opposite_direction_is_the_opposite_pulse():
    other = dataclasses.replace(PULSE, direction_deg=200.0)
    np.testing.assert_allclose(other.sample(200.0, 2000), -PULSE.sample(200.0, 2000), atol=1e-12)


def test_highest_frequency_of_a_pulse_holds_its_energy():
    force = PULSE.sample(1000.0, 10_000)
    energy = np.sum(np.abs(np.fft.rfft(force, axis=0)) ** 2, axis=1)
    frequency = np.fft.rfftfreq(10_000, 0.001)
    assert energy[frequency > PULSE.highest_frequency].sum() / energy.sum() == pytest.approx(0.005, abs=0.001)


def test_drawn_onsets_stay_in_range():
    onsets = [draw_onset(seed) for seed in range(200)]
    assert 5.0 <= min(onsets) < 5.5
    assert 19.5 < max(onsets) <= 20.0
    assert draw_onset(3) == draw_onset(np.random.default_rng(3)) == onsets[3]


# --- trial ---


def test_trial_is_multisine_then_pulse_then_nothing(trial, multisine):
    assert trial.duration == 36.0
    force = trial.sample(1000.0, 40_000)
    np.testing.assert_allclose(force[:32_000], multisine.sample(1000.0, 32_000), atol=1e-11)
    np.testing.assert_allclose(force[32_040:], trial.pulse.sample(1000.0, 40_000)[32_040:], atol=1e-12)
    np.testing.assert_allclose(force[32_080:], 0.0, atol=1e-10)


def test_fade_is_half_a_cosine_from_the_onset(trial, multisine):
    times = 32.0 + np.arange(40) / 1000.0
    rest = trial.sample(1000.0, 40, 32.0) - trial.pulse.sample(1000.0, 40, 32.0)
    window = 0.5 + 0.5 * np.cos(np.pi * (times - 32.0) / 0.04)
    np.testing.assert_allclose(rest, window[:, np.newaxis] * multisine.periodic(1000.0, 40, 32.0), atol=1e-10)


def test_trial_is_continuous_around_the_pulse(trial):
    force = trial.sample(20_000.0, 2_400, 31.99)
    assert np.abs(np.diff(force, axis=0)).max() < 0.25  # 50 N and 80 ms: 0.1 N per 50 us


def test_trial_is_zero_outside(trial):
    assert not trial.sample(200.0, 100, -0.5).any()
    assert not trial.sample(200.0, 100, 36.0).any()


def test_onset_of_a_trial_may_be_later_than_the_multisine(multisine):
    late = MultisineThenPulse.join(multisine, peak=50.0, direction_deg=20.0, onset=33.0)
    np.testing.assert_allclose(late.sample(200.0, 6600), multisine.periodic(200.0, 6600), atol=1e-11)
    assert late.duration == 37.0


# --- sampled ---


def test_csv_round_trip(trial, tmp_path):
    path = tmp_path / "trial.csv"
    save_perturbation(trial, path, 200.0)
    loaded = load_perturbation(path)
    assert (loaded.rate, loaded.duration) == (200.0, 36.0)
    np.testing.assert_array_equal(loaded.sample(200.0, 7400), trial.sample(200.0, 7400))
    save_perturbation(loaded, tmp_path / "again.csv", 200.0)
    assert (tmp_path / "again.csv").read_text() == path.read_text()


@pytest.mark.parametrize(
    "text", ["\ufefftime_s,d_x_N,d_y_N\r\n0,1,2\r\n0.1,3,4\r\n", "d_y_N, time_s,d_x_N\n2,0,1\n4,.1,3\n\n"]
)
def test_harmless_variants_of_a_file(text, tmp_path):
    path = tmp_path / "variant.csv"
    path.write_bytes(text.encode())
    loaded = load_perturbation(path)
    assert loaded.rate == 10.0
    np.testing.assert_array_equal(loaded.force, [[1.0, 2.0], [3.0, 4.0]])


HEADER = "time_s,d_x_N,d_y_N\n"
BAD_FILES = {
    "": ": the file is empty; expected the columns time_s,d_x_N,d_y_N",
    "\n\n": ": the file is empty; expected the columns time_s,d_x_N,d_y_N",
    HEADER: ": rows = 0; expected at least 2 below the header",
    HEADER + "0,1,2\n": ": rows = 1; expected at least 2 below the header",
    "time_s,d_x_N\n0,1\n": ", line 1: missing column 'd_y_N'; expected the columns time_s,d_x_N,d_y_N",
    ",".join(f"c{column}" for column in range(100_000)): (
        ", line 1: unknown column 'c0'; expected the columns time_s,d_x_N,d_y_N"
    ),
    "t,d_x_N,d_y_N\n": ", line 1: unknown column 't'; expected the columns time_s,d_x_N,d_y_N",
    "time_s,d_x_N,d_x_N,d_y_N\n": ", line 1: column 'd_x_N' twice; expected the columns time_s,d_x_N,d_y_N",
    HEADER + "0,1,2\n0.1,one,2\n": ", line 3: d_x_N = 'one'; expected a finite number",
    HEADER + "0,1,2\n0.1,1_0,2\n": ", line 3: d_x_N = '1_0'; expected a finite number",
    HEADER + "0,1,2\n0.1,1,nan\n": ", line 3: d_y_N = 'nan'; expected a finite number",
    HEADER + "0,1,2\ninf,1,1\n": ", line 3: time_s = 'inf'; expected a finite number",
    HEADER + "0,1,2\n0.1,1,\n": ", line 3: d_y_N = ''; expected a finite number",
    HEADER + "0,1,2\n0.1,1\n": ", line 3: 2 values; expected 3",
    HEADER + "0,1,2\n\n0.1,1,1\n": ", line 3: 0 values; expected 3",
    HEADER + "0,1,2\n0.1,1,1\n0.1,1,1\n": ", line 4: time_s = 0.1 after 0.1; expected increasing times",
    HEADER + "1,1,2\n1.1,1,1\n1.2,1,1\n": ", line 2: time_s = 1; expected the first time to be 0",
    HEADER + "0,1,2\n10,1,1\n3610,1,1\n": ", line 4: time_s = 3610; expected seconds, at most 3600",
    HEADER + "0,1,2\n0.1,1,1\n0.2,1,1\n0.4,1,1\n0.5,1,1\n": (
        ", line 5: time step = 0.2 s; expected 0.1 s as in the other lines, to 0.1% "
        "(uniform times, with enough decimals)"
    ),
    HEADER + "0,1,2\n0.033,1,1\n0.067,1,1\n0.1,1,1\n": (
        ", line 4: time step = 0.034 s; expected 0.033 s as in the other lines, to 0.1% "
        "(uniform times, with enough decimals)"
    ),
}


@pytest.mark.parametrize(("text", "message"), BAD_FILES.items())
def test_bad_files_are_refused_in_one_line(text, message, tmp_path):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"^{re.escape(str(path) + message)}$"):
        load_perturbation(path)


def test_binary_file_is_refused(tmp_path):
    path = tmp_path / "bad.csv"
    path.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ValueError, match=r"bad\.csv: no readable text .*; expected a CSV file in UTF-8$"):
        load_perturbation(path)


def test_rounded_times_within_tolerance_pass(tmp_path):
    path = tmp_path / "rounded.csv"
    path.write_text(HEADER + "".join(f"{k / 30:.6f},{k},0\n" for k in range(300)))
    assert load_perturbation(path).rate == 30.0


def test_other_rates_are_kept(tmp_path):
    path = tmp_path / "odd.csv"
    save_perturbation(PULSE, path, 250.5)
    assert load_perturbation(path).rate == pytest.approx(250.5, rel=1e-12)


def test_spline_keeps_40_hz_sampled_at_200_hz():
    times = np.arange(400) / 200.0
    wave = np.stack([np.sin(2 * np.pi * 40.0 * times), np.cos(2 * np.pi * 40.0 * times)], axis=1)
    fine_times = 0.2 + np.arange(16_000) / 10_000.0
    truth = np.stack([np.sin(2 * np.pi * 40.0 * fine_times), np.cos(2 * np.pi * 40.0 * fine_times)], axis=1)
    error = Sampled(force=wave, rate=200.0).sample(10_000.0, 16_000, 0.2) - truth
    assert np.abs(error).max() < 1e-3


@pytest.mark.parametrize("n_samples", [2, 3, 4, 5, 6])
def test_short_signals(n_samples):
    ramp = np.outer(np.arange(n_samples), [1.0, -2.0])
    force = Sampled(force=ramp, rate=10.0).sample(100.0, 10 * n_samples)
    expected = np.minimum(np.arange(10 * n_samples) / 10.0, n_samples - 1)  # the last value is held
    np.testing.assert_allclose(force, np.outer(expected, [1.0, -2.0]), atol=1e-9)


def test_highest_frequency_has_little_power_above_it():
    times = np.arange(1000) / 1000.0
    force = np.stack([5.0 + np.sin(2 * np.pi * 10.0 * times), 0.5 * np.sin(2 * np.pi * 300.0 * times)], axis=1)
    sampled = Sampled(force=force, rate=1000.0)
    assert sampled.highest_frequency == pytest.approx(300.0)
    assert Sampled(force=np.ones((5, 2)), rate=10.0).highest_frequency == 0.0


def test_bandwidth_is_checked(multisine, trial):
    fast = np.zeros((2000, 2))
    fast[:, 0] = np.sin(2 * np.pi * 480.0 * np.arange(2000) / 2000.0)
    message = (
        "Sampled: highest significant frequency = 480 Hz; "
        "expected at most 450 Hz, 45% of the simulation rate of 1000 Hz "
        "(the option timestep = 0.0005, or smoother edges)"
    )
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        check_bandwidth(Sampled(force=fast, rate=2000.0), 1000.0)
    check_bandwidth(Sampled(force=fast, rate=2000.0), 2000.0)
    for perturbation in (multisine, trial, PULSE):
        check_bandwidth(perturbation, 1000.0)
    with pytest.raises(ValueError, match=r"^Multisine: highest significant frequency = 39.9902 Hz"):
        check_bandwidth(multisine, 80.0)


# --- all of them ---


def test_every_kind_is_a_perturbation(multisine, trial):
    for it in (multisine, trial, PULSE, Sampled(force=np.ones((5, 2)), rate=10.0)):
        assert isinstance(it, Perturbation)
        assert it.sample(1000.0, 0).shape == (0, 2)
        assert it.sample(333.3, 7, 0.0005).shape == (7, 2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Pulse(peak=1.0, direction_deg=20.0, onset=12.5, duration=10.0),
            "Pulse: onset = 12.5 s; expected between 0 and 9.92 s",
        ),
        (
            lambda: Pulse(peak=0.0, direction_deg=20.0, onset=1.0, duration=10.0),
            "Pulse: peak = 0.0; expected a finite number above 0",
        ),
        (
            lambda: Pulse(peak=1.0, direction_deg=20.0, onset=0.0, duration=0.05),
            "Pulse: width = 0.08 s; expected at most the duration, 0.05 s",
        ),
        (lambda: draw_onset(1, low=5.0, high=4.0), "draw_onset: high = 4.0; expected a finite number at least 5"),
        (lambda: Multisine.draw(seed=1, rms=-1.0), "Multisine: rms = -1.0; expected a finite number above 0"),
        (
            lambda: Multisine.draw(seed=1, rms=1.0, reduced="energy"),
            "Multisine: reduced = 'energy'; expected one of amplitude, power",
        ),
        (
            lambda: Multisine(rms=1.0, phases=np.zeros((2, 70))),
            "Multisine: phases of shape (2, 70); expected finite numbers of shape (2, 72)",
        ),
        (
            lambda: Sampled(force=np.zeros((1, 2)), rate=1.0),
            "Sampled: force of shape (1, 2); expected (n, 2) with at least 2 samples",
        ),
        (
            lambda: Sampled(force=np.array([[0.0, 0.0], [0.0, np.nan]]), rate=1.0),
            "Sampled: force[1, 1] = nan; expected a finite number",
        ),
        (lambda: PULSE.sample(0.0, 5), "sample: rate = 0.0; expected a finite number above 0"),
        (lambda: PULSE.sample(10.0, -1), "sample: n_samples = -1; expected a finite number at least 0"),
        (
            lambda: MultisineThenPulse(multisine=Multisine.draw(seed=1, rms=1.0, crested=False), pulse=PULSE, fade=6.0),
            "MultisineThenPulse: fade = 6.0; expected a finite number above 0 and at most 5",
        ),
        (
            lambda: save_perturbation(PULSE, "unwritten.csv", 0.1),
            "save_perturbation: rate = 0.1 Hz gives 1 sample; expected at least 2",
        ),
    ],
)
def test_bad_values_are_refused(make, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        make()


def test_stored_arrays_are_read_only(multisine):
    for array in (multisine.phases, CLUSTERS, Sampled(force=np.ones((5, 2)), rate=10.0).force):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


@pytest.mark.parametrize("draw", [lambda seed: Multisine.draw(seed=seed, rms=1.0, crested=False), draw_onset])
@pytest.mark.parametrize(("seed", "error"), [(None, TypeError), ("a", TypeError), (1.5, TypeError), (-1, ValueError)])
def test_seeds_are_whole_numbers(draw, seed, error):
    with pytest.raises(error, match=rf"seed = {seed!r}; expected a (whole|finite) number"):
        draw(seed)


@pytest.mark.slow(reason="draws many multisines")
def test_no_phase_depends_on_what_numpy_does_with_errors():
    phases = Multisine.draw(seed=1, rms=1.0).phases
    with np.errstate(all="raise"):
        np.testing.assert_array_equal(Multisine.draw(seed=1, rms=1.0).phases, phases)
