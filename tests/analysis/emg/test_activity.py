"""Whether muscles are relaxed, and co-contraction, of EMG of known levels."""

from dataclasses import replace

import numpy as np
import pytest
from invented_emg import noise, recorded

from armperturb.analysis.emg.activity import activity, holm, relaxation_sentence
from armperturb.analysis.emg.envelope import envelopes

N = 10_000


def person(level, seed=0):
    """One maximal contraction, and four trials at a level of both antagonists [-]."""
    rng = np.random.default_rng(seed)
    levels = np.concatenate([[[1.0, 1.0]], level * np.exp(0.1 * rng.standard_normal((4, 2)))])
    volts = levels[..., None] * noise((5, 2, N), seed) + 5e-3 * rng.standard_normal((5, 2, N))
    return activity(envelopes(recorded(volts, ["MVC"] + ["RT7.5"] * 4))), levels[1:].min(axis=1).mean()


def test_relaxed_and_slightly_active_people_are_told_apart():
    relaxed = [person(0.0, seed)[0].active_muscles("RT7.5") for seed in range(2)]
    active = [person(0.05, seed)[0].active_muscles("RT7.5") for seed in range(2)]
    assert relaxed == [()] * 2
    assert active == [("flexor", "extensor")] * 2


@pytest.mark.parametrize("level", [0.05, 0.2])
def test_index_is_the_level_of_co_contraction(level):
    result, true = person(level)
    index = result.cocontraction.set_index(["condition", "joint"])["index"]["RT7.5", "shoulder"]
    assert index == pytest.approx(true, rel=0.1)


def test_index_is_that_of_a_trial_however_many_relaxed_trials_there_are():
    level = np.array([1.0, 0.0, 0.1, 0.1, *[0.0] * 12])[:, None, None]
    white = 5e-3 * np.random.default_rng(0).standard_normal((len(level), 2, N))
    recording = recorded(level * noise((len(level), 2, N)) + white, ["MVC", "REST", "PT", "PT", *["RT"] * 12])
    for trials in (slice(4), slice(None)):
        index = activity(envelopes(recording.isel(trial=trials))).cocontraction.set_index("condition")["index"]
        assert index["PT"] == pytest.approx(0.1, rel=0.04)
        assert index["MVC"] == pytest.approx(1.0, rel=0.04)


@pytest.mark.parametrize("kind", ["fast", "slow"])
@pytest.mark.parametrize("level", [0.02, 0.1])
def test_index_is_what_both_antagonists_share_while_they_take_turns(kind, level):
    n_trials, rate = 9, 2000.0
    time = np.arange(N) / rate
    spectrum = np.fft.rfft(np.random.default_rng(1).standard_normal((n_trials, N)))
    spectrum[:, np.fft.rfftfreq(N, 1.0 / rate) > 20.0] = 0.0
    fast = np.fft.irfft(spectrum, N)
    turns = {
        "fast": 2.0 * level * fast / fast.std(),
        "slow": np.broadcast_to(3.0 * level * np.sin(2 * np.pi * 0.7 * time), fast.shape),
    }[kind]
    amplitude = level + np.maximum(np.stack([turns, -turns], axis=1), 0.0)
    amplitude[0], amplitude[1] = 1.0, 0.0
    volts = amplitude * noise((n_trials, 2, N)) + 5e-3 * np.random.default_rng(0).standard_normal((n_trials, 2, N))
    result = activity(envelopes(recorded(volts, ["MVC", "REST"] + ["PT7.5"] * (n_trials - 2))))
    index = result.cocontraction.set_index(["condition", "joint"])["index"]["PT7.5", "shoulder"]
    assert index == pytest.approx(level, rel=0.1)


def test_a_muscle_whose_antagonist_is_silent_does_not_co_contract():
    volts = np.array([0.5, 0.0])[:, None] * noise((3, 2, N)) + 1e-3 * np.random.default_rng(0).standard_normal(
        (3, 2, N)
    )
    result = activity(envelopes(recorded(volts, task=["PT"] * 3)))
    assert result.cocontraction["ratio"].item() < 0.1


def test_parts_before_and_during_the_perturbation_are_apart():
    recording = recorded(noise((3, 2, N)))
    recording["perturbation"][:, :400] = 0.0
    assert list(activity(envelopes(recording)).levels["part"].unique()) == ["before", "during"]


def test_holm_is_that_of_the_textbook():
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])


def test_a_result_describes_itself():
    result, _ = person(0.2)
    assert "RT7.5      during             all" in result.summary()
    assert result.to_frame().iloc[-1, -2:].to_dict() == {"condition": "RT7.5", "subject": "A"}
    assert len(result.plot()) == 2


def test_sentence_names_who_did_not_relax():
    relaxed, active = person(0.0)[0], person(0.05)[0]
    limit = "2 % of maximal contraction"
    assert relaxation_sentence([relaxed], ["RT7.5"]) == (
        f"In the relax task, no muscle of A was found active (above {limit}, p < 0.05)."
    )
    assert relaxation_sentence([relaxed] * 3, ["RT7.5"]) == (
        f"In the relax task, no muscle of any of the 3 people was found active (above {limit}, p < 0.05)."
    )
    assert relaxation_sentence([relaxed, active], ["RT7.5"]) == (
        f"In the relax task, 1 of 2 people did not relax (a muscle above {limit}, p < 0.05): A in RT7.5."
    )
    assert "no EMG" in relaxation_sentence([], ["RT7.5"])


def amplifier(shape, seed=0):
    return 5e-3 * np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_the_relax_task_alone_tells_nothing_of_relaxation(level):
    result = activity(envelopes(recorded(level * noise((4, 2, N)) + amplifier((4, 2, N)), ["RT2.5", "RT7.5"] * 2)))
    assert result.levels["p"].isna().all()
    assert not result.levels["is_active"].any()
    assert result.cocontraction.empty
    assert "unknown" in result.summary()
    assert len(result.plot()) == 1
    sentence = relaxation_sentence([result], ["RT2.5", "RT7.5"])
    assert sentence.startswith("Nothing is known of relaxation: no condition was recorded in which muscles were active")
    assert relaxation_sentence([result, person(0.0)[0]], ["RT7.5"]).startswith("In the relax task, no muscle of A was")


def test_a_muscle_that_no_condition_makes_active_is_not_tested():
    volts = np.array([1.0, 0.0])[:, None] * noise((4, 2, N)) + amplifier((4, 2, N))
    volts[2:] = amplifier((2, 2, N), 1)
    recording = recorded(volts, ["PT7.5"] * 2 + ["RT7.5"] * 2, task=["PT"] * 2 + ["RT"] * 2)
    result = activity(envelopes(recording))
    assert result.levels.groupby("muscle")["p"].count().to_dict() == {"flexor": 2, "extensor": 0}
    assert result.active_muscles("PT7.5") == ("flexor",)
    assert any("EMG of extensor: nothing is known of relaxation" in line for line in result.remarks)


@pytest.mark.parametrize(
    ("level", "says"), [(0.1, "Nothing is known"), (0.01, "In the relax task, no muscle of A was")]
)
def test_emg_whose_spectrum_is_white_does_not_pass_for_noise(level, says):
    """Of a muscle that is always active. That it is relaxed is known if noise and muscle are below the limit."""
    volts = np.append(1.0, np.full(3, level))[:, None, None] * np.random.default_rng(0).standard_normal((4, 2, N))
    amplitudes = envelopes(recorded(volts, ["MVC", *["RT7.5"] * 3]))
    result = activity(amplitudes)
    relaxed = result.levels[result.levels["condition"] == "RT7.5"]
    np.testing.assert_allclose(relaxed["amplitude"], level, rtol=0.1)
    assert relaxation_sentence([result], ["RT7.5"]).startswith(says)
    assert any("so that nothing tells the noise of the channel" in line for line in result.remarks)
    index = result.cocontraction.set_index("condition").loc["RT7.5", "index"]
    assert index == pytest.approx(level, rel=0.1)


def test_the_sentence_has_the_limit_of_each_person():
    volts = noise((4, 2, N)) * np.array([1.0, 1.0, 0.0, 0.0])[:, None, None] + amplifier((4, 2, N))
    recording = recorded(volts, ["PT7.5"] * 2 + ["RT7.5"] * 2, task=["PT"] * 2 + ["RT"] * 2)
    other = replace(activity(envelopes(recording)), subject="B")
    assert relaxation_sentence([person(0.0)[0], other], ["RT7.5"]) == (
        "In the relax task, no muscle of any of the 2 people was found active "
        "(above 2 % of maximal contraction in A or 10 % of PT7.5 in B, p < 0.05)."
    )


def test_trials_in_which_a_channel_is_dead_do_not_count():
    amplitudes = envelopes(recorded(noise((4, 2, N)), task=["PT"] * 4))
    power = amplitudes.power.copy()
    power[0, :, 0] = np.nan
    some, whole = activity(replace(amplitudes, power=power)), activity(amplitudes)
    row, other = (result.levels.set_index("muscle").loc[["flexor", "extensor"]] for result in (some, whole))
    assert row["trials"].tolist() == [3, 4]
    assert row.loc["extensor"].drop("p").to_dict() == other.loc["extensor"].drop("p").to_dict()
    level = amplitudes.amplitude_of(amplitudes.power[1:, :, 0].mean(axis=1)[:, None])[:, 0]
    assert row.loc["flexor", "amplitude"] == pytest.approx(np.sqrt(np.mean(level**2)), rel=1e-3)
    assert some.cocontraction["index"].notna().all()
    power[:, :, 0] = np.nan
    none = activity(replace(amplitudes, power=power)).levels.set_index("muscle")
    assert none.loc["flexor"][["amplitude", "p"]].isna().all()
    assert not none.loc["flexor", "is_active"]
    # The only muscle that is tested, so that nothing is adjusted.
    assert none.loc["extensor", "p"] <= other.loc["extensor", "p"]
