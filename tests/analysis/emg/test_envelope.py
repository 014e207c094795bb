"""Envelopes of EMG of known amplitude, and what is wrong with its channels."""

import numpy as np
import pytest
from invented_emg import EMG_RATE, PAIR, RATE, noise, recorded
from scipy import signal

from armperturb.analysis.emg import whitening
from armperturb.analysis.emg.channels import hum_lines, require_raw
from armperturb.analysis.emg.envelope import envelopes
from armperturb.analysis.emg.matching import rows_of
from armperturb.analysis.trials import prepared
from armperturb.recording import Action

N = 20_000
TIME = np.arange(N) / EMG_RATE
SHAPE = 0.3 * (1.0 + 0.5 * np.sin(2 * np.pi * 0.5 * TIME))
FLOOR = 2e-3


@pytest.fixture(scope="module")
def modulated():
    """Ten trials of modulated noise, and one at rest."""
    active = SHAPE * noise((10, 2, N)) + FLOOR * np.random.default_rng(1).standard_normal((10, 2, N))
    rest = FLOOR * np.random.default_rng(2).standard_normal((1, 2, N))
    return recorded(np.concatenate([active, rest]), ["RT7.5"] * 10 + ["REST"])


def scatter(recording, window=0.1, **options):
    """Variance over trials of amplitudes over what was made, and the largest error of the mean."""
    result, n = envelopes(recording, **options), round(window * RATE)
    power = result.power[:10].reshape(10, -1, n, 2).mean(axis=2)[:, 1:-1]
    true = np.sqrt(np.mean(SHAPE.reshape(-1, n * 10) ** 2, axis=1))[1:-1, None]
    relative = result.amplitude_of(power) / true
    relative /= relative.mean()
    return relative.var(axis=0, ddof=1).mean(), np.abs(relative.mean(axis=0) - 1.0).max(), result


def test_variance_of_an_amplitude_is_at_the_bound_for_the_bandwidth(modulated):
    variance, error, result = scatter(modulated)
    bound = 1.0 / (4.0 * (0.45 * EMG_RATE - 20.0) * 0.1)
    assert 0.85 < variance / bound < 1.15
    assert result.relative_variance(0.1)[:10].mean() == pytest.approx(variance, rel=0.15)
    assert error < 5.0 * np.sqrt(bound / 10)


def test_means_of_intervals_are_those_of_a_signal_that_is_constant_about_each_sample():
    values = np.random.default_rng(5).normal(size=50_000)
    start = np.arange(10_000) / 201.7 - 0.01
    intervals = whitening.Intervals(len(values), 1000.0, start, start + 0.0073)
    means = intervals.mean(values, np.square)
    for place in np.random.default_rng(6).integers(10, 9_990, 50):
        fine = np.linspace(1000.0 * start[place], 1000.0 * start[place] + 7.3, 7301)
        about = values[np.round(0.5 * (fine[1:] + fine[:-1])).astype(int)]
        assert means[place] == pytest.approx(np.mean(about**2), rel=2e-3)


def test_a_long_trial_is_filtered_in_parts_to_the_same_amplitudes(monkeypatch):
    n = 16 * N
    hum = 2.0 * np.sin(2 * np.pi * 50.0 * np.arange(n) / EMG_RATE)
    volts = 0.3 * noise((1, 2, n)) + np.stack([hum, np.zeros(n)])[None]
    recording = recorded(volts, ["RT7.5"])
    whole = envelopes(recording)
    monkeypatch.setattr(whitening, "LONGEST_PART", 5 * N)
    parts = envelopes(recording)
    assert list(parts.hum) == list(whole.hum) == ["flexor"]
    assert parts.remarks == whole.remarks
    smooth = np.ones(20) / 20.0
    for column in range(2):  # nothing is left of hum where parts meet
        a, b = (np.convolve(each.power[0, 200:-200, column], smooth, "valid") for each in (parts, whole))
        assert np.abs(a / b - 1.0).max() < 0.05
    # Of the channel that hums, the number depends on how far the hum leaks beside its notch.
    assert parts.samples_per_second[0, 1] == pytest.approx(whole.samples_per_second[0, 1], rel=0.02)


@pytest.mark.parametrize("least", [0.1, 0.15, 0.2])
def test_noise_is_found_without_a_trial_at_rest(least):
    """Also where a muscle is never much weaker than on average."""
    level = np.linspace(least, 0.3, 9)[:, None, None]
    volts = level * noise((9, 2, N)) + 2e-2 * np.random.default_rng(4).standard_normal((9, 2, N))
    spectra = whitening.Spectra.of(volts.swapaxes(1, 2).astype(np.float32), EMG_RATE, 20.0, ())
    found = whitening.noise_spectra(spectra, (20.0, 900.0), np.zeros(9, dtype=bool))
    silent = 2e-2 * np.random.default_rng(5).standard_normal((20, N, 2)).astype(np.float32)
    true = whitening.Spectra.of(silent, EMG_RATE, 20.0, ()).power.mean(axis=0)
    inside = (spectra.frequency > 30.0) & (spectra.frequency < 800.0)
    np.testing.assert_allclose(found[:, inside].mean(axis=1), true[:, inside].mean(axis=1), rtol=0.15)


def test_without_whitening_it_is_several_times_as_large(modulated):
    assert scatter(modulated, whiten=False)[0] > 3.0 * scatter(modulated)[0]


def test_amplitudes_are_relative_to_the_maximal_contraction_and_above_the_noise():
    level = np.array([1.0, 0.3, 0.05, 0.0])
    volts = level[:, None, None] * noise((4, 2, N)) + 5e-3 * np.random.default_rng(1).standard_normal((4, 2, N))
    result = envelopes(recorded(volts, ["MVC", "PT", "RT", "REST"]))
    frame = result.to_frame().groupby("condition", sort=False)["amplitude"].mean()
    assert result.is_normalised
    assert frame["PT"] == pytest.approx(0.3, rel=0.06)  # the strongest of ten seconds is some 4 % above the mean
    assert frame["RT"] == pytest.approx(0.05, rel=0.08)
    assert frame["REST"] < 0.005
    np.testing.assert_allclose(result.reference_volts, 1.0, rtol=0.08)


def levels_of(level, conditions, **options):
    """Trials of two muscles of given levels, (trial,), of which a silent channel has 5e-3."""
    level = np.array(level)[:, None, None] * np.ones((1, 2, 1))
    volts = level * noise((len(level), 2, N)) + 5e-3 * np.random.default_rng(1).standard_normal((len(level), 2, N))
    return envelopes(recorded(volts, conditions), **options)


@pytest.mark.parametrize(
    ("level", "said"),
    [
        ((1.0, 0.3, 0.3, 0.0), ()),
        ((0.15, 0.3, 0.3, 0.0), ("% of maximal contraction in PT; expected at most 100 %",)),
        ((0.0, 0.3, 0.3, 0.0), ("MVC is hardly above the noise", "% of maximal contraction in PT")),
        ((1.0, 0.3, 0.0, 0.0), ("nothing but noise in trial 2, though it is active in others of PT",)),
        ((1.0, 0.05, 0.05, 0.05), ("the trials of REST have the spectrum of an active muscle",)),
    ],
)
def test_amplitudes_that_are_doubtful_are_named(level, said):
    remarks = levels_of(level, ["MVC", "PT", "PT", "REST"]).doubtful
    for part in said:
        assert any(part in remark for remark in remarks), part
    assert bool(remarks) == bool(said)


def test_envelope_is_in_step_with_signals_that_are_later_or_earlier():
    recording = recorded((0.3 + 0.2 * np.sin(2 * np.pi * 4.0 * TIME)) * noise((10, 2, N)))
    wave = np.exp(-2j * np.pi * 4.0 * np.arange(N // 10) / RATE)
    for lead in (0.0, 0.01, -0.03):
        recording["emg"].attrs["lead"] = lead
        phase = np.angle(1j * wave @ envelopes(recording).power.mean(axis=(0, 2)))
        assert -phase / (2 * np.pi * 4.0) == pytest.approx(lead, abs=1e-3)


@pytest.mark.slow(reason="averages over many trials")
def test_fast_changes_leave_slow_ones_of_the_difference_of_antagonists_as_they_are():
    """The difference of the roots of powers grows by 4 % with such fast ones."""

    def slow(fast):
        push = 0.15 * np.sin(2 * np.pi * TIME) + fast * np.sin(2 * np.pi * 27.0 * TIME)
        drive = 0.1 + np.stack([np.maximum(push, 0.0), np.maximum(-push, 0.0)])
        result = envelopes(recorded(drive * noise((40, 2, N))))
        volts = (result.amplitude * result.reference_volts).mean(axis=0)
        wave = np.exp(-2j * np.pi * np.arange(len(volts)) / RATE)
        return 2.0 * abs(np.mean((volts[:, 0] - volts[:, 1]) * wave))

    found = [slow(fast) for fast in (0.0, 0.2)]
    assert found == pytest.approx([0.15, 0.15], rel=0.01)


def test_the_delay_of_an_amplifier_that_is_known_is_undone():
    within, modulated = slice(100, -100), 20.0
    volts = (0.3 + 0.2 * np.sin(2 * np.pi * modulated * TIME)) * noise((10, 2, N))
    recording = recorded(signal.sosfilt(signal.butter(4, 100.0, "highpass", fs=EMG_RATE, output="sos"), volts))
    wave = np.exp(-2j * np.pi * modulated * np.arange(N // 10)[within] / RATE)

    def late():
        phase = np.angle(1j * wave @ envelopes(recording).amplitude[:, within].mean(axis=(0, 2)))
        return -phase / (2 * np.pi * modulated)

    # A standard error is 0.02 ms.
    assert late() == pytest.approx(0.97e-3, abs=0.1e-3)
    recording["emg"].attrs |= {"highpass": 100.0, "highpass_order": 4}
    assert late() == pytest.approx(0.0, abs=0.1e-3)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda x: x[0, 0, 4000:8000].fill(0.0), "EMG of flexor in trial 0: dead from 2.00 to 4.00 s"),
        (lambda x: np.clip(x[1, 1], -0.5, 0.5, out=x[1, 1]), "EMG of extensor in trial 1: clipped from"),
        (lambda x: x[1, 0].__setitem__(6000, 12.0), "EMG of flexor in trial 1: spike at 2.999 s"),
        (
            lambda x: x[0, 1].__iadd__(40.0 * np.exp(-(((TIME - 6.0) / 0.1) ** 2))),
            "EMG of extensor in trial 0: movement artefact from 5.5",
        ),
        (lambda x: x[:, 0].__iadd__(0.2 * np.sin(2 * np.pi * 50.0 * TIME)), "EMG of flexor hums at 50.0 Hz: cut out"),
        (
            lambda x: x[:, 1].__iadd__(0.2 * x[:, 0]),
            "EMG of flexor and extensor correlates (r = ",
        ),
    ],
    ids=["dead", "clipped", "spike", "movement", "hum", "cross-talk"],
)
def test_what_is_wrong_with_a_channel_is_named_with_its_time(spoil, message):
    volts = 0.3 * noise((2, 2, N))
    spoil(volts)
    remarks = envelopes(recorded(volts)).remarks
    assert len(remarks) == 1
    assert remarks[0].startswith(message)


def test_what_a_coarse_converter_makes_of_rest_is_not_clipped():
    levels = np.round(np.array([0.8, 2.0])[:, None, None] * noise((2, 2, N)))
    levels[1] = np.clip(levels[1], -2.0, 2.0)
    assert [(fault.kind, fault.trial) for fault in envelopes(recorded(levels)).faults] == [("clipped", 1)] * 2


def test_hum_changes_no_amplitude():
    hum = np.sin(2 * np.pi * 50.0 * TIME)
    volts = 0.3 * noise((3, 2, N))
    quiet, humming = (envelopes(recorded(each)).to_frame()["amplitude_V"] for each in (volts, volts + hum))
    np.testing.assert_allclose(humming, quiet, rtol=0.02)


@pytest.mark.parametrize("kind", ["offset", "sine", "line", "wander"])
def test_drifts_and_offsets_change_no_amplitude_and_are_no_artefacts(kind):
    """They are as large as a maximal contraction, and have nothing to do with it within the band."""
    level = np.array([1.0, 0.1, 0.1, 0.0])[:, None, None]
    volts = level * noise((4, 2, N)) + 4e-3 * np.random.default_rng(1).standard_normal((4, 2, N))
    drift = {
        "offset": np.random.default_rng(2).normal(0.0, 20.0, (4, 2, 1)),
        "sine": 2.0 * np.sin(2 * np.pi * 0.05 * TIME + 0.3),
        "line": 2.0 * TIME / TIME[-1],
        "wander": signal.sosfiltfilt(
            signal.butter(4, 0.5, fs=EMG_RATE, output="sos"), np.random.default_rng(3).normal(0.0, 10.0, (4, 2, N))
        ),
    }[kind]
    conditions = ["MVC", "PT", "PT", "REST"]
    clean, drifting = (envelopes(recorded(each, conditions)) for each in (volts, volts + drift))
    known, found = (each.to_frame().set_index("condition")["amplitude"] for each in (clean, drifting))
    np.testing.assert_allclose(found.loc["PT"], known.loc["PT"], rtol=0.02)
    assert (found.loc["REST"] < 0.01).all()
    assert not drifting.faults
    assert not drifting.crosstalk


def test_hum_leaves_nothing_at_the_ends_of_trials():
    hum = np.sin(2 * np.pi * 50.0 * TIME) + 0.3 * np.sin(2 * np.pi * 150.0 * TIME + 1.0)
    quiet = 4e-3 * np.random.default_rng(1).standard_normal((2, 2, N))
    volts = np.array([1.0, 0.0])[:, None, None] * noise((2, 2, N)) + quiet
    clean, humming = (envelopes(recorded(each, ["MVC", "RT"])) for each in (volts, volts + 0.2 * hum))
    assert not humming.crosstalk
    ends = np.r_[: round(RATE), -round(RATE) : 0]
    np.testing.assert_allclose(humming.power[1, ends].mean(axis=0), clean.power[1, ends].mean(axis=0), rtol=0.2)


@pytest.mark.parametrize("size", [5.0, 100.0])
@pytest.mark.parametrize("lasts", [1e9, 0.3], ids=["step", "pop"])
def test_a_jump_is_an_artefact_at_its_time(size, lasts):
    volts = np.array([1.0, 0.2])[:, None, None] * noise((2, 2, N))
    volts[1, 0] += np.where(TIME >= 6.0, size * np.exp(-(TIME - 6.0) / lasts), 0.0)
    (fault,) = [each for each in envelopes(recorded(volts, ["MVC", "PT"])).faults if each.kind != "spike"]
    assert (fault.kind, fault.trial, fault.muscle) == ("movement artefact", 1, "flexor")
    assert fault.start == pytest.approx(5.5, abs=0.05)


@pytest.mark.parametrize("lasts", [0.3, 0.45, 2.0])
def test_a_brief_contraction_is_no_artefact(lasts):
    active = np.clip(0.5 + (0.5 * lasts - np.abs(TIME % 2.5 - 1.25)) / 0.04, 0.01, 1.0)  # it rises in 40 ms
    volts = np.stack([active, np.full(N, 0.2)])[:, None] * noise((2, 2, N))
    found = envelopes(recorded(volts, ["MVC", "PT"])).to_frame().set_index("condition").loc["PT", "amplitude"]
    np.testing.assert_allclose(found, 0.2 / np.sqrt(min(lasts, 1.0)), rtol=0.15)  # mean power of the largest second


def test_an_artefact_is_no_maximal_contraction():
    active = (TIME > 1.0) & (TIME < 5.0)
    volts = np.stack([np.where(active, 1.0, 0.02), np.full(N, 0.1)])[:, None] * noise((2, 2, N))
    known = envelopes(recorded(volts, ["MVC", "PT"])).to_frame().set_index("condition").loc["PT", "amplitude"]
    for length, size in ((100, 20.0), (1, 50.0)):  # a step of a cable, and a spike
        spoiled = volts.copy()
        spoiled[0, :, 16_000 : 16_000 + length] += size
        found = envelopes(recorded(spoiled, ["MVC", "PT"])).to_frame().set_index("condition").loc["PT", "amplitude"]
        np.testing.assert_allclose(found, known, rtol=0.03)


def test_hum_that_contractions_hide_is_cut_out_of_what_is_relaxed():
    volts = np.array([1.0, 0.0, 0.0, 0.0])[:, None, None] * noise((4, 2, N))
    volts += 5e-3 * np.random.default_rng(1).standard_normal(volts.shape) + 5e-3 * np.sin(2 * np.pi * 50.0 * TIME)
    result = envelopes(recorded(volts, ["MVC", *["RT7.5"] * 3]))
    assert list(result.hum) == ["flexor", "extensor"]
    relaxed = result.to_frame().set_index("condition").loc["RT7.5", "amplitude"]
    assert (relaxed < 0.0015).all()  # of the hum alone it is 0.0035


def test_sound_channels_are_not_suspected(modulated):
    assert envelopes(modulated).remarks == ()


def test_a_contraction_that_begins_at_once_is_no_spike():
    """Among starts at all places in a window of 20 ms, some are in its last sample."""
    begins = 4000 + 4 * np.arange(10)[:, None, None]
    volts = np.where(np.arange(N) < begins, 0.005, 0.5) * noise((10, 2, N))
    assert not envelopes(recorded(volts)).faults


def test_unknown_muscles_are_named():
    remarks = envelopes(recorded(noise((1, 2, N)), muscles={"flexor": PAIR["flexor"], "soleus": Action("", 0)})).remarks
    assert remarks == ("EMG of soleus: nobody says what the muscle does; expected signals.emg.muscles in the sidecar",)


def low_passed(emg, cutoff):
    sos = signal.butter(4, cutoff, fs=EMG_RATE, output="sos")
    return emg.copy(data=signal.sosfiltfilt(sos, emg.values, axis=1).astype(np.float32))


@pytest.mark.parametrize("level", [0.0, 0.01])
@pytest.mark.parametrize(("order", "cutoff"), [(4, 450.0), (8, 500.0), (2, 600.0)])
def test_the_low_pass_of_an_amplifier_makes_no_noise_of_a_relaxed_muscle_activity(order, cutoff, level):
    volts = np.array([1.0, *[level] * 4])[:, None, None] * noise((5, 2, N))
    volts += 5e-3 * np.random.default_rng(0).standard_normal(volts.shape)
    sos = signal.butter(order, cutoff, fs=EMG_RATE, output="sos")
    result = envelopes(recorded(signal.sosfilt(sos, volts), ["MVC", *["RT7.5"] * 4])).to_frame()
    relaxed = result[result["condition"] == "RT7.5"]["amplitude"]
    np.testing.assert_allclose(relaxed, level, rtol=0.15, atol=2e-3)


def test_the_band_of_unfiltered_channels_ends_with_the_rate(modulated):
    spectra = whitening.Spectra.of(modulated["emg"].values, EMG_RATE, 20.0, ())
    assert [whitening.passed_band(spectra, low, 900.0) for low in (20.0, 80.0, 460.0)] == [900.0] * 3


def without_mean(emg):
    return emg - emg.mean("emg_time")


def rms(emg):
    """Of 50 ms."""
    window = np.ones((1, 100, 1)) / 100.0
    return emg.copy(data=np.sqrt(abs(signal.fftconvolve(emg.values**2, window, "same", axes=1))).astype(np.float32))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.drop_vars(["emg"]), "EMG is missing: the recording has no variable 'emg'"),
        (lambda r: r.assign_attrs(emg_rate=1000.0), "it lasts 20 s at emg_rate = 1000 Hz, the other signals 10 s"),
        (lambda r: r.sel(time=slice(0, 5)), r"is cut, recording\.sel\(emg_time=slice\(0, 5\.005\)\) as well"),
        (lambda r: r.assign(emg=r["emg"] * 0.0), "all channels are zero; expected voltages"),
        (lambda r: r.assign(emg=abs(r["emg"])), "that of flexor, extensor is rectified or an envelope"),
        (lambda r: r.assign(emg=without_mean(abs(r["emg"]))), "that of flexor, extensor is rectified or an envelope"),
        (
            lambda r: r.assign(emg=low_passed(abs(r["emg"]), 6.0)),
            "that of flexor, extensor is rectified or an envelope",
        ),
        (
            lambda r: r.assign(emg=without_mean(low_passed(abs(r["emg"]), 30.0))),
            "that of flexor, extensor is rectified or an envelope",
        ),
        (
            lambda r: r.assign(emg=rms(r["emg"]) - np.float32(1e-3)),
            "that of flexor, extensor is rectified or an envelope",
        ),
    ],
)
def test_emg_that_cannot_be_used_is_refused_in_one_line(modulated, change, message):
    with pytest.raises(ValueError, match=message):
        envelopes(change(modulated))


def test_an_offset_of_the_amplifier_is_no_rectification(modulated):
    shifted = modulated.assign(emg=modulated["emg"] - modulated["emg"].min())
    found = [envelopes(each).to_frame()["amplitude_V"] for each in (modulated, shifted)]
    np.testing.assert_allclose(*found, rtol=1e-3, atol=FLOOR)
    # Hardly any sample is below zero; bursts, the heart and movement artefacts leave a channel what it is.
    raw = modulated["emg"].values
    beats, bursts = (np.exp(-((((TIME + shift) % 0.8 - 0.4) / width) ** 2)) for shift, width in ((0, 0.01), (0.3, 0.1)))
    beats, bursts = (each[:, None].astype(np.float32) for each in (beats, bursts))
    for channels in (raw + 2.4 * raw.std(), raw * (bursts + 0.02), raw + beats, raw + bursts):
        require_raw(channels, EMG_RATE, ["flexor", "extensor"])
    drift = np.sin(2 * np.pi * 0.3 * TIME)[:, None].astype(np.float32)
    drifting = envelopes(modulated.assign(emg=modulated["emg"] + 20.0 + drift)).to_frame()["amplitude_V"]
    np.testing.assert_allclose(drifting[:2], found[0][:2], rtol=0.1)


def test_a_result_describes_itself_and_becomes_tables(modulated):
    result = envelopes(modulated)
    assert "EMG of A: 2 muscles in 11 trials" in result.summary()
    assert result.to_frame().columns[-2:].tolist() == ["condition", "subject"]
    assert set(result.to_frame()["subject"]) == {"A"}
    assert result.to_xarray()["amplitude"].shape == (11, 2000, 2)
    assert len(result.plot()) == 1


@pytest.mark.parametrize("mains", [49.85, 50.0, 50.12, 59.9])
def test_multiples_of_a_mains_frequency_that_is_off_are_found(mains):
    frequency = np.arange(0.0, 1000.0, 0.05)
    power = np.ones(len(frequency))
    multiples = mains * np.array([1, 3, 5, 9, 11, 15])
    power[np.searchsorted(frequency, multiples)] = 1000.0
    np.testing.assert_allclose(hum_lines(power, frequency, (50.0, 60.0)), multiples, atol=0.05)


def test_all_multiples_of_hum_are_cut_out_of_a_short_trial_and_nothing_of_noise():
    n = 10_000
    odd = np.arange(1, 20, 2)[:, None]
    hum = 0.3 * np.sin(2 * np.pi * 50.13 * odd * np.arange(n) / EMG_RATE + odd).sum(axis=0)
    volts = noise((1, 40, n)).swapaxes(1, 2).astype(np.float32)
    volts[..., 20:] += hum[:, None]
    lines = whitening.Spectra.of(volts, EMG_RATE, 20.0, (50.0, 60.0)).hum
    assert min(lines) >= 20
    for column in range(20, 40):
        multiples = np.array(lines[column]) / 50.13
        np.testing.assert_allclose(multiples, np.round(multiples), atol=0.01)
        assert len(multiples) >= 9


def test_what_comes_after_the_workspace_limit_does_not_count():
    n = 20_000
    size = np.where(np.arange(n) < 10_200, 0.1, 1.0)  # loud once reflexes answer to the limit, at 5 s
    volts = noise((3, 2, n), 3) * np.stack([size, size, np.full(n, 0.1)])[:, None]
    conditions = ["PT22.5", "PT22.5", "PT7.5"]
    limited = dict(limit_time=[5.0, 5.0, np.nan], pulse_onset=[9.0, np.nan, 9.0], pulse_direction=[20.0, np.nan, 20.0])
    found = envelopes(recorded(volts, conditions, **limited))
    amplitude = found.to_frame().set_index(["condition", "muscle"])["amplitude_V"]
    np.testing.assert_allclose(amplitude, 0.1, rtol=0.1)
    assert found.labels["pulse_onset"].notna().tolist() == [False, False, True]


def test_a_muscle_that_is_dead_in_every_maximal_contraction_has_no_amplitude():
    volts = noise((4, 2, 20_000))
    volts[2:, 0] = 0.0
    conditions = ["RT7.5", "RT7.5", "MVC", "MVC"]
    amplitudes = envelopes(recorded(volts, condition=conditions))
    assert amplitudes.reference == "maximal contraction"
    assert np.isnan(amplitudes.power[..., 0]).all()
    assert np.isfinite(amplitudes.power[..., 1]).all()
    assert any("dead in every maximal contraction" in remark for remark in amplitudes.remarks)
    # One of the contractions is enough.
    volts[3, 0] = volts[3, 1]
    amplitudes = envelopes(recorded(volts, condition=conditions))
    assert amplitudes.amplitude_of(amplitudes.mean_power())[0, 0] == pytest.approx(1.0, abs=0.1)
    assert not any("dead in every" in remark for remark in amplitudes.remarks)


def test_emg_of_two_people_and_of_another_person_is_refused():
    recording = recorded(noise((2, 2, 20_000)))
    two = recording.assign_coords(subject=("trial", ["A", "B"]))
    with pytest.raises(ValueError, match=r"envelopes: EMG of A, B; expected one person's"):
        envelopes(two)
    somebody_else = recording.assign_coords(subject=("trial", ["B", "B"]))
    with pytest.raises(ValueError, match=r"it is A's, the other signals B's"):
        rows_of(prepared(somebody_else), envelopes(recording))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda r: r.isel(trial=[2, 1, 0]), r"repetition of trial 0 of RT7\.5 is 0 in the envelopes, 2 in the other"),
        (
            lambda r: r.assign_coords(pulse_direction=("trial", [20.0, 20.0, 20.0])),
            r"pulse_direction of trial 1 of RT7\.5 is nan in the envelopes, 20 in the other signals",
        ),
        (lambda r: r.isel(trial=[0, 2]), r"3 trials of RT7\.5, the other signals 2; expected the same trials in the"),
    ],
)
def test_emg_of_other_trials_of_the_condition_is_refused(change, said):
    recording = recorded(noise((3, 2, 20_000)), repetition=[0, 1, 2], pulse_direction=[20.0, np.nan, 20.0])
    amplitudes, other = envelopes(recording), change(recording)
    assert rows_of(prepared(recording).take([2, 0]), amplitudes).tolist() == [2, 0]
    with pytest.raises(ValueError, match=said):
        rows_of(prepared(other), amplitudes)
    assert len(rows_of(prepared(other), envelopes(other))) == other.sizes["trial"]
    numbered = recording.assign_coords(condition=("trial", [7.5] * 3), subject=("trial", [1] * 3))
    assert rows_of(prepared(numbered), envelopes(numbered)).tolist() == [0, 1, 2]
