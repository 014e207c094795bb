import functools
import re
from dataclasses import replace

import numpy as np
import pytest

from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.maximum_likelihood import estimate
from armperturb.analysis.fit.profile import profile
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.analysis.manipulator import manipulator_covariance
from armperturb.analysis.trials import ConditionTrials
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine, Sampled
from armperturb.subject import POSITION, RELAX

RMS = {"PT": 5.4, "RT": 0.9}
METHODS = pytest.mark.parametrize("method", ["frequency", "record"])
INSTRUMENTS = Instruments(marker_noise=None, emg=None)


def record(subject, n=4, *, seed=0, noise=1.0, linear=True, instruments=INSTRUMENTS, condition="", force=1.0):
    """Trials of a person who is the same in all of them."""
    spreads = {f"spread_{quantity}": 0.0 for quantity in ("b", "k", "kv", "kp")}
    human = replace(HUMAN_NOISE[subject.task].scaled(noise), **spreads)
    trials = [
        Trial(
            subject=subject,
            perturbation=Multisine.draw(
                seed=1000 * seed + trial, rms=force * RMS[subject.task], duration=30.0, crested=False
            ),
            condition=condition or f"{subject.task}7.5",
            repetition=trial,
            seed=1000 * seed + trial,
            noise=human if noise else None,
        )
        for trial in range(n)
    ]
    return run_experiment(trials, linear=linear, instruments=instruments, engine="compiled")


def group_of(recording, model, **options):
    structure = STRUCTURES[model] if isinstance(model, str) else model
    return Group.prepare(recording, structure, **options)


def true_value(arm, name):
    return arm.m_h + arm.m_f if name == "m_tot" else getattr(arm, name)


@pytest.fixture(scope="module")
def position(once):
    return once("five of position", lambda _: record(POSITION, 5))


@pytest.fixture(scope="module")
def relax(once):
    return once("five of relax", lambda _: record(RELAX, 5))


@pytest.fixture(scope="module")
def position_group(position):
    return group_of(position, "3b")


@pytest.fixture(scope="module")
def relax_group(relax):
    return group_of(relax, "1")


@pytest.fixture(scope="module")
def of_position(position_group):
    """A function: the estimate by a method."""
    return functools.cache(lambda method: estimate([position_group], method))


@pytest.mark.slow(reason="fits six groups of trials, by both methods")
@pytest.mark.parametrize(("subject", "model"), [(POSITION, "3b"), (RELAX, "1")], ids=["PT", "RT"])
def test_intervals_hold_the_truth_as_often_as_they_say(subject, model):
    recording = record(subject, 18, seed=77)
    groups = [group_of(recording.isel(trial=slice(first, first + 3)), model) for first in range(0, 18, 3)]
    of_periods = [estimate([group], "frequency") for group in groups]
    # A search of whole records starts where that of mean periods ends, here or of itself.
    of_records = [estimate([group], initial=found.values) for group, found in zip(groups, of_periods, strict=True)]
    for every in (of_periods, of_records):
        assert all(found.converged and found.stable for found in every)
        pairs = [(found, name) for found in every for name in found.values]
        inside = [
            found.interval(name).lower < true_value(subject, name) < found.interval(name).upper for found, name in pairs
        ]
        assert np.mean(inside) > 0.88
        # Errors of one fit belong together: white, they are as many independent numbers as parameters.
        squares = []
        for found in every:
            deviation = np.array(
                [
                    (value - true_value(subject, name)) / found.standard_error[name]
                    for name, value in found.values.items()
                ]
            )
            squares.append(deviation @ np.linalg.solve(found.correlation, deviation) / len(deviation))
        assert np.sqrt(np.mean(squares)) == pytest.approx(1.0, abs=0.2)
        assert np.mean([found.chi2 / found.dof for found in every]) == pytest.approx(1.0, abs=0.12)


@pytest.fixture(scope="module")
def of_wrong_structures(position_group):
    """A function: estimates by a method of an arm without reflexes, and of one with late ones."""
    late = STRUCTURES["3b"].fixing(Td_s=0.060, Td_e=0.060, m_tot=2.5)
    groups = [position_group.with_structure(structure) for structure in (STRUCTURES["1"], late)]
    of_periods = functools.cache(lambda: [estimate([group], "frequency") for group in groups])

    def found(method):
        if method == "frequency":
            return of_periods()
        # Whose searches end there first.
        return [estimate([group], initial=each.values) for group, each in zip(groups, of_periods(), strict=True)]

    return found


@pytest.mark.slow(reason="fits three structures")
@METHODS
def test_a_right_structure_raises_no_doubt_and_a_wrong_one_does(of_position, of_wrong_structures, method):
    right = of_position(method)
    assert not right.is_suspicious
    assert not any("explains more" in remark for remark in right.remarks)
    without_reflexes, with_late_ones = of_wrong_structures(method)
    for wrong in (without_reflexes, with_late_ones):
        assert wrong.is_suspicious
        assert any("differs from trial to trial" in remark for remark in wrong.remarks)
    # A wrong structure may explain each perturbation in its own way, or all in the same one.
    assert with_late_ones.dispersion > 1.2


@pytest.mark.slow(reason="simulates laboratories and fits by both methods")
@pytest.mark.parametrize("n_trials", [1, 2])
@pytest.mark.parametrize(("subject", "model"), [(POSITION, "3b"), (RELAX, "1")], ids=["PT", "RT"])
def test_ideal_recordings_give_the_arm_back(subject, model, n_trials):
    for linear, instruments, force, error in (
        (True, None, 1.0, 1e-3),
        (True, replace(INSTRUMENTS, antialias=None, force_noise=0.0, encoder_bits=32), 1.0, 0.01),
        (False, None, 0.01, 0.01),
    ):
        if linear or (n_trials == 2 and subject is POSITION):
            recording = record(subject, n_trials, noise=0.0, linear=linear, instruments=instruments, force=force)
            group = group_of(recording, model)
            for found in (estimate([group], "frequency"), estimate([group], "record")):
                assert found.converged
                for name, value in found.values.items():
                    assert value == pytest.approx(true_value(subject, name), rel=error), (name, linear, instruments)


@pytest.mark.slow(reason="five fits of eight trials")
def test_a_shared_mass_is_one_value_and_better_known_than_from_either_condition_alone():
    small = record(POSITION, 4, seed=1, condition="PT7.5")
    stiffer = replace(POSITION, k_s=140.0, k_e=180.0)
    large = record(stiffer, 4, seed=2, condition="PT22.5", force=2.0)
    groups = [group_of(small, "3b"), group_of(large, "3b")]
    together, apart = (estimate(groups, "frequency", share=share) for share in (["mass"], []))
    assert len(together.values) == 25
    assert len(apart.values) == 26
    assert together.arms["PT7.5"].m_f == together.arms["PT22.5"].m_f
    assert together.standard_error["m_tot"] < min(apart.standard_error[f"m_tot [{one.label}]"] for one in groups)
    assert abs(together.values["m_tot"] - 3.38) < 4 * together.standard_error["m_tot"]
    assert together.arms["PT22.5"].k_s == together.values["k_s [PT22.5]"]
    alone = [estimate([group], "frequency") for group in groups]
    for group, one in zip(groups, alone, strict=True):
        for name, value in one.values.items():
            assert apart.values[f"{name} [{group.label}]"] == pytest.approx(value, abs=0.1 * one.standard_error[name])
    started = estimate(groups, share=["m_tot", "velocity"], initial={"m_tot": 4.0, "kv_s": 12.0, "k_e [PT7.5]": 150.0})
    assert started.converged
    assert "kv_s" in started.values


@pytest.mark.slow(reason="simulates and fits two conditions")
def test_what_a_condition_leaves_open_is_known_by_sharing(relax_group):
    wave = 4.0 * np.cos(2 * np.pi * 4.1015625 * np.arange(23 * 200) / 200.0)[:, None]  # a whole number per 10.24 s
    trials = [
        Trial(
            subject=RELAX,
            perturbation=Sampled(force=wave * axes, rate=200.0),
            condition="sine",
            repetition=number,
            seed=number,
            noise=HUMAN_NOISE["RT"],
        )
        for number, axes in enumerate(np.tile(np.eye(2), (2, 1)))
    ]
    sine = group_of(
        run_experiment(trials, linear=True, instruments=INSTRUMENTS, engine="compiled"), "1", window_start=2
    )
    with pytest.raises(ValueError, match=r"sine: the structure cannot be identified: a change of .* m_h"):
        estimate([sine])
    together = estimate([relax_group, sine], share=["mass", "grip"])
    assert together.converged
    for name in ("k_s", "k_e", "b_s", "b_e"):
        error = together.standard_error[f"{name} [sine]"]
        assert abs(together.values[f"{name} [sine]"] - getattr(RELAX, name)) < 4.0 * error, name


@pytest.mark.slow(reason="fits again for each point of a profile")
def test_profile_is_zero_at_the_estimate_and_384_at_the_limits_of_the_interval(position_group, of_position):
    for method, name in (("frequency", "m_tot"), ("record", "k_e")):
        found = of_position(method)
        value, half = found.values[name], 1.96 * found.standard_error[name] / np.sqrt(found.dispersion)
        points = [value - half, value, value + half, value + 2 * half]
        deviance = profile([position_group], found, name, points)
        assert deviance[1] == pytest.approx(0.0, abs=0.01)
        assert deviance[[0, 2]] == pytest.approx(3.84, rel=0.15)
        assert deviance[3] == pytest.approx(4 * 3.84, rel=0.25)


def late_by(remarks):
    """Skew that is remarked upon [ms]."""
    (found,) = [re.search(r"^(?:force|displacement) is recorded ([\d.]+) ms", remark) for remark in remarks]
    return float(found[1])


@pytest.mark.slow(reason="fits a recording")
def test_skew_of_the_clocks_is_remarked_upon(relax, relax_group):
    assert not any("later than" in remark for remark in estimate([relax_group], "frequency").remarks)
    late = relax.copy(deep=True)
    frequency = np.fft.rfftfreq(12000, 1 / 200.0)
    for name in ("force", "perturbation"):
        spectrum = np.fft.rfft(late[name].values, 12000, axis=1)
        spectrum *= np.exp(-2j * np.pi * frequency * 1e-3)[:, None]
        late[name].values[:] = np.fft.irfft(spectrum, 12000, axis=1)[:, : relax.sizes["time"]]
    remarks = estimate([group_of(late, "1")], "frequency").remarks
    assert late_by(remarks) == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow(reason="fits trials")
def test_a_force_of_wrong_scale_is_remarked_upon(relax):
    louder = relax.copy(deep=True)
    louder["force"] *= 1.1
    found = estimate([group_of(louder, "1")], "frequency")
    (imbalance,) = found.imbalance.values()
    assert imbalance.text in found.remarks
    assert "10 % too large" in imbalance.text


@pytest.mark.slow(reason="fits for each direction of the manipulator's errors")
def test_intervals_contain_what_is_unknown_of_the_manipulator():
    """By as much as estimates move if a manipulator is taken that is off by one standard deviation."""
    trials = ConditionTrials.prepare(record(RELAX, 2, noise=0.0))
    environment, noise = trials.instruments
    known = {name: getattr(environment, name) for name in ("m_env", "b_env", "k_env")}

    def fitted(given):
        found = estimate([group_of([replace(trials, given=(Environment(**given), noise))], "1")], "frequency")
        return [np.array([*each.values()]) for each in (found.values, found.standard_error)]

    best, alone = fitted(known)
    moved = []
    for row in np.linalg.cholesky(manipulator_covariance(trials)).T:
        off = {name: value + change for (name, value), change in zip(known.items(), row, strict=True)}
        moved.append(fitted(off)[0] - best)
    errors = np.array([*estimate([group_of([trials], "1")], "frequency").standard_error.values()])
    assert errors == pytest.approx(np.sqrt(alone**2 + np.sum(np.square(moved), axis=0)), rel=0.05)
    assert (errors / alone).max() > 1.5


@pytest.mark.slow(reason="fits records twice")
def test_records_that_start_amid_movement_tell_the_same_arm(position, of_position):
    late = position.isel(time=slice(300, None)).assign_coords(time=position["time"].values[:-300])
    fitted, whole = estimate([group_of(late, "3b")]), of_position("record")
    assert not fitted.is_suspicious
    for name, value in fitted.values.items():
        assert abs(value - true_value(POSITION, name)) < 4 * fitted.standard_error[name]
        assert fitted.standard_error[name] < 1.2 * whole.standard_error[name]


@pytest.fixture(scope="module")
def loud(once):
    return once(
        "loud", lambda _: {subject.task: record(subject, 1, seed=3, noise=5.0) for subject in (POSITION, RELAX)}
    )


LARGE = pytest.mark.slow(reason="fits many parameters to one trial")


@pytest.mark.slow(reason="fits eight structures")
@METHODS
@pytest.mark.parametrize(
    ("task", "model"),
    [
        *(("PT", "1"), ("RT", "1")),
        *(pytest.param("RT", "4", marks=LARGE), pytest.param("PT", "6", marks=LARGE)),
    ],
)
def test_whatever_is_fitted_to_one_loud_trial_ends_with_a_status(loud, task, model, method):
    group = group_of(loud[task], model)
    found = estimate([group], method)
    assert found.message.startswith("converged: " if found.converged else "not converged: ")
    assert found.converged or any(found.message in remark for remark in found.remarks)
    assert np.isfinite(list(found.values.values())).all()
    assert not np.isnan(list(found.standard_error.values())).any()
    assert np.isfinite(found.correlation).all()
    for name, value in found.values.items():
        lower, upper = group.structure.bounds[name]
        assert lower <= value <= upper
        assert (name in found.at_bound) == (min(value - lower, upper - value) <= 1e-6 * (upper - lower))


@pytest.mark.slow(reason="fits an unstable arm")
def test_an_arm_that_cannot_be_stable_is_fitted_and_said_to_be_unstable(relax):
    wild = STRUCTURES["1"].fixing(kv_s=60.0, kv_e=60.0)
    found = estimate([group_of(relax, wild)], "frequency")
    assert not found.stable
    assert found.largest_real_pole > 0
    assert any("unstable" in remark for remark in found.remarks)


@pytest.mark.slow(reason="fits records")
def test_an_unstable_start_is_made_stable(position_group, of_position):
    start = {"kv_s": 100.0, "kv_se": 0.0, "kv_e": 100.0, "b_s": 0.1, "b_e": 0.1}
    arm = replace(POSITION, **start)
    assert largest_real_pole(arm, Environment()) > 0
    found, usual = estimate([position_group], "frequency", initial=start), of_position("frequency")
    assert found.converged
    for name, value in usual.values.items():
        assert found.values[name] == pytest.approx(value, abs=0.1 * usual.standard_error[name])


@pytest.mark.slow(reason="fits trials")
def test_where_even_the_default_start_is_unstable_the_search_begins_with_less_feedback(position):
    one_delay = STRUCTURES["3"].fixing(fact_s=3.5, fact_e=3.5).tying(Td_e={"Td_s": 1.0})
    start = one_delay.arm(POSITION, [*one_delay.initial.values()])
    assert largest_real_pole(start, Environment()) > 0
    found = estimate([group_of(position, one_delay)], "frequency")
    assert found.converged
    assert found.stable
    assert found.p_value > 0.01


@pytest.mark.slow(reason="fits trials")
def test_a_search_that_cannot_make_a_step_has_no_intervals(relax):
    others = {name: value for name, value in STRUCTURES["1"].initial.items() if name != "k_s"}
    wild = STRUCTURES["1"].fixing(kv_s=20.0, kv_e=20.0, **others)
    found = estimate([group_of(relax, wild)], "frequency")
    assert (found.converged, found.stable, found.n_rounds) == (False, False, 1)
    assert np.isnan(found.interval("k_s")).all()
    assert any("not make a single step" in remark for remark in found.remarks)
    assert "not known" in str(found)


@pytest.mark.slow(reason="simulates eight trials")
def test_a_prior_is_weighed_with_the_trials_by_its_width():
    quiet = group_of(record(POSITION, 8, noise=0.5), "3b")  # so that the likelihood is normal over two standard errors
    structure = quiet.structure
    usual = estimate([quiet], "frequency")
    value, error = usual.values["k_s"], usual.standard_error["k_s"] / np.sqrt(usual.dispersion)
    for width in (0.01 * error, error):
        known = replace(quiet, structure=structure.knowing(k_s=(value + 2.0 * error, width)))
        found = estimate([known], "frequency")
        share = error**2 / (error**2 + width**2)
        assert found.converged
        # Of a normal likelihood; the noise is estimated anew, and the model is not linear.
        assert found.values["k_s"] == pytest.approx(value + 2.0 * share * error, abs=0.1 * error)
        assert found.standard_error["k_s"] == pytest.approx(width * np.sqrt(share * found.dispersion), rel=0.05)


@pytest.mark.slow(reason="fits trials")
def test_a_prior_identifies_what_no_trial_does(relax):
    silent = STRUCTURES["1"].freeing(Td_s=(0.02, 0.03, 0.04)).knowing(Td_s=(0.031, 0.002))
    found = estimate([group_of(relax, silent)], "frequency")
    assert found.values["Td_s"] == pytest.approx(0.031, abs=1e-6)
    assert found.standard_error["Td_s"] == pytest.approx(0.002 * np.sqrt(found.dispersion), rel=1e-6)


@pytest.mark.slow(reason="fits trials")
def test_structures_that_no_trial_identifies_are_refused_with_the_direction(relax):
    silent = STRUCTURES["1"].freeing(Td_s=(0.02, 0.03, 0.04))
    with pytest.raises(ValueError, match=r"Td_s cannot be identified: no effect on the movement"):
        estimate([group_of(relax, silent)])
    base = STRUCTURES["1"]
    twice = replace(
        base,
        bounds={name: pair for name, pair in base.bounds.items() if name != "b_s"} | {"b": (0.0, 9.0), "c": (0.0, 9.0)},
        initial={name: value for name, value in base.initial.items() if name != "b_s"} | {"b": 1.0, "c": 1.0},
        tied={"b_s": {"b": 1.0, "c": 0.5}},
    )
    with pytest.raises(ValueError, match=r"a change of [+-]0.5 b [+-]1 c leaves the movement as it is"):
        estimate([group_of(relax, twice)])


@pytest.mark.slow(reason="fits trials")
def test_bad_input_is_refused_in_one_sentence(position, position_group, relax_group, of_position):
    for arguments, options, message in (
        (([],), {}, r"groups is empty; expected the trials of at least one condition"),
        (([position_group], "best"), {}, r"method = 'best'; expected one of frequency, record"),
        (([position_group],), {"initial": {"k": 1.0}}, r"initial: unknown parameter 'k'; expected m_tot, b_s"),
        (([position_group],), {"initial": {"k_s": -1.0}}, r"initial: k_s = -1.0; expected 0 to 1000 Nm/rad"),
        (([position_group],), {"initial": {"k_s": np.nan}}, r"initial: k_s = nan; expected 0 to 1000 Nm/rad"),
        (([position_group],), {"share": ["masses"]}, r"share: 'masses' is no free parameter; expected mass, damping"),
        (([position_group, position_group],), {}, r"condition 'PT7.5' comes twice"),
        (([position_group, relax_group],), {}, r"differ in name \(position, relax\); expected one person"),
    ):
        with pytest.raises(ValueError, match=message):
            estimate(*arguments, **options)
    heavy = group_of(
        position.assign_coords(condition=("trial", ["PT2.5"] * 5)), STRUCTURES["3b"].freeing(m_tot=(9.0, 9.5, 10.0))
    )
    with pytest.raises(ValueError, match=r"bounds of the shared m_tot cross \(9 to 8\)"):
        estimate([position_group, heavy], share=["mass"])
    found = of_position("frequency")
    with pytest.raises(ValueError, match=r"no parameter 'k'; expected one of m_tot"):
        profile([position_group], found, "k", [1.0])
    with pytest.raises(ValueError, match=r"k_s = -1.0; expected 0 to 1000 Nm/rad"):
        profile([position_group], found, "k_s", [-1.0])

    with pytest.raises(ValueError, match=r"l_h has several values"):
        Group.prepare(position.assign_coords(l_h=("trial", np.linspace(0.3, 0.33, 5))), STRUCTURES["3b"])
    broken = position.copy(deep=True)
    broken["force"].values[2, 5, 1] = np.nan
    with pytest.raises(ValueError, match=r"force of trial 2 is nan at sample 5"):
        Group.prepare(broken, STRUCTURES["3b"])
    with pytest.raises(ValueError, match=r"expected a whole period of 20.48 s"):
        group_of(position.isel(time=slice(0, 4000)), "3b", period=20.48)
    with pytest.raises(ValueError, match=r"'frequency': the perturbation of PT7.5 is not periodic"):
        estimate([group_of(position.isel(time=slice(0, 4000)), "3b")], "frequency")
    with pytest.raises(ValueError, match=r"period = 10 s; expected the perturbation's own: that of trial 0 does not"):
        group_of(position, "3b", period=10.0)
    met = position.assign_coords(limit_time=("trial", [np.nan, 3.0] + [np.nan] * 3))
    with pytest.raises(ValueError, match=r"trial 1 reached the workspace limit at 3.000 s"):
        group_of(met, "3b")
    one_way = position.copy(deep=True)
    added = one_way["perturbation"].values[..., 0] - one_way["perturbation"].values[..., 1]
    for name in ("perturbation", "force"):
        one_way[name].values[..., 1] += added
    with pytest.raises(ValueError, match=r"are not independent"):
        group_of(one_way, "3b")
