"""The practice session hits what is intended, whoever practises."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armperturb.analysis.arm.linear_arm import total_admittance
from armperturb.cohort import draw_cohort
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import TIMESTEP, Environment, Strap
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine
from armperturb.seeds import trial_seed
from armperturb.study.protocol import PULSE_UNIT, THESIS
from armperturb.study.recording import practice
from armperturb.study.recording import record as runner
from armperturb.study.recording.practice import (
    MAX_ROUNDS,
    TOLERANCE,
    adjust,
    linear_displacement,
    measured_displacement,
    practice_multisine,
    practise,
)
from armperturb.study.recording.record import record_study
from tests.recorded import PROTOCOL

AS_INTENDED = replace(
    THESIS, conditions=tuple(replace(condition, reached=1.0, reached_spread=0.0) for condition in THESIS.conditions)
)
BOTH = replace(AS_INTENDED, conditions=(AS_INTENDED.condition("PT7.5"), AS_INTENDED.condition("RT7.5")))
SEED = 1
COARSE = 5e-3
"""A step [s] at which what does not depend on it takes seconds."""


@pytest.fixture(scope="module")
def people():
    return draw_cohort(2, SEED, muscles="linear")


@pytest.fixture(scope="module")
def forces(people, once):
    return once("forces", lambda _: practise(people, BOTH, SEED, timestep=COARSE))


def displacement(people, forces, noisy=False, strap=None):
    """What each person's handle does at the practised forces, over what is intended, (person, condition)."""
    trials = [
        Trial(
            subject=person.subjects[condition.task],
            perturbation=replace(practice_multisine(SEED), rms=own[condition.name]),
            seed=trial_seed(SEED, f"practice {person.name} {condition.name}"),
            noise=HUMAN_NOISE[condition.task] if noisy else None,
        )
        for person, own in zip(people, forces, strict=True)
        for condition in BOTH.conditions
    ]
    targets = np.array([condition.rms_displacement for condition in BOTH.conditions])
    return measured_displacement(trials, Environment(), strap=strap, timestep=COARSE).reshape(len(people), -1) / targets


def test_linear_people_move_as_far_as_intended(people, forces):
    assert np.abs(displacement(people, forces) - 1.0).max() < TOLERANCE


@pytest.mark.slow(reason="simulates practice sessions")
def test_noisy_people_move_as_far_as_intended(people):
    found = practise(people[:1], BOTH, SEED, noisy=True, timestep=COARSE)
    assert np.abs(displacement(people[:1], found, noisy=True) - 1.0).max() < TOLERANCE


def test_people_practise_under_the_strap_of_the_protocol(people, forces):
    found = practise(people[:1], replace(BOTH, strap=Strap()), SEED, timestep=COARSE)
    assert np.abs(displacement(people[:1], found, strap=Strap()) - 1.0).max() < TOLERANCE
    assert found[0]["PT7.5"] < 0.98 * forces[0]["PT7.5"]


def drifting(**fields):
    return replace(BOTH, conditions=tuple(replace(condition, **fields) for condition in BOTH.conditions))


@pytest.mark.slow(reason="simulates practice sessions")
def test_people_whose_muscles_yield_move_as_far_as_they_change_before_the_experiment(monkeypatch):
    moved = {}

    def measure(trials, environment, **options):
        found = measured_displacement(trials, environment, **{**options, "timestep": COARSE})
        moved.update({(t.subject, t.perturbation.rms): x for t, x in zip(trials, found, strict=True)})
        return found

    monkeypatch.setattr(practice, "measured_displacement", measure)
    (person,) = draw_cohort(1, SEED)
    lax = replace(person, levels={"PT7.5": 0.5 * person.levels.get("PT7.5", 1.0)})
    protocol = drifting(reached=1.2)
    found = practise((person, lax), protocol, SEED, n_threads=1)
    for one, own in zip((person, lax), found, strict=True):
        for condition in protocol.conditions:
            intended = 1.2 * condition.rms_displacement
            assert moved[condition.subject_of(one), own[condition.name]] == pytest.approx(intended, rel=TOLERANCE)
    assert found[1]["PT7.5"] < 0.9 * found[0]["PT7.5"]
    assert found[1]["RT7.5"] == found[0]["RT7.5"]


@pytest.mark.slow(reason="practice of forty people, twice")
def test_how_far_people_change_is_each_ones_and_each_conditions_own(monkeypatch):
    def measure(trials, environment, **_):
        return np.array([linear_displacement(trial.subject, environment, trial.perturbation) for trial in trials])

    monkeypatch.setattr(practice, "measured_displacement", measure)
    crowd, protocol = draw_cohort(40, SEED, muscles="linear"), drifting(reached=0.8, reached_spread=0.2)
    straight, found = practise(crowd, BOTH, SEED), practise(crowd, protocol, SEED)
    # The arms are linear: forces grow as displacements do.
    reached = np.array(
        [[own[c.name] / on[c.name] for c in BOTH.conditions] for own, on in zip(found, straight, strict=True)]
    )
    assert np.abs(np.log(reached / 0.8)).max() < 2 * 0.2 + TOLERANCE
    assert np.log(reached / 0.8).std() == pytest.approx(0.2, rel=0.2)
    assert np.exp(np.log(reached).mean()) == pytest.approx(0.8, rel=0.08)
    assert abs(np.corrcoef(reached.T)[0, 1]) < 0.4
    assert practise(crowd[7:8], protocol, SEED) == found[7:8]
    assert practise(crowd[7:8], protocol, SEED + 1) != found[7:8]


@pytest.mark.slow(reason="simulates practice sessions")
def test_conditions_that_differ_in_co_contraction_get_forces_of_their_own(people):
    half, whole, same = (
        replace(AS_INTENDED.condition("PT7.5"), name=name, co_contraction=level)
        for name, level in (("half", 0.5), ("whole", 1.0), ("same", 1.0))
    )
    protocol = replace(AS_INTENDED, conditions=(half, whole, same), pulse_unit_condition="whole")
    (found,) = practise(people[:1], protocol, SEED, timestep=COARSE)
    assert found["half"] < 0.8 * found["whole"]
    assert found["same"] == found["whole"]


def test_pulse_unit_is_ten_times_the_force_of_pt7_5(forces):
    for own in forces:
        assert list(own) == ["PT7.5", "RT7.5", PULSE_UNIT]
        assert own[PULSE_UNIT] == pytest.approx(10 * own["PT7.5"], rel=1e-12)
    assert len({own["PT7.5"] for own in forces}) == len(forces)


def test_a_persons_forces_do_not_depend_on_the_others(people, forces):
    assert practise(people[1:2], BOTH, SEED, timestep=COARSE)[0] == forces[1]


def test_published_forces_are_everyones(people):
    found = practise(people, replace(AS_INTENDED, forces="published"), SEED)
    wanted = {"PT2.5": 1.2, "PT7.5": 5.4, "PT22.5": 16.6, "RT2.5": 0.6, "RT7.5": 0.9, "RT22.5": 1.8, PULSE_UNIT: 53.9}
    assert found == (wanted,) * 2


def test_pulses_alone_need_no_practice(people):
    protocol = replace(
        AS_INTENDED, conditions=(AS_INTENDED.condition("RT0"),), pulse_unit_condition="", pulse_unit=40.0
    )
    assert practise(people, protocol, SEED) == ({PULSE_UNIT: 40.0},) * 2


@pytest.mark.slow(reason="simulates practice sessions")
@pytest.mark.parametrize(
    "arm",
    [
        lambda linear: 0.5 * linear,
        lambda linear: 2e-3 * (linear / 2e-3) ** 0.6,  # stiffens, as people who adapt to strong perturbations
        lambda linear: 4e-3 * (linear / 4e-3) ** 1.6,
        lambda linear: linear * (0.4 + linear**2 / (linear**2 + 5e-3**2)),  # gives way, as short-range stiffness does
        lambda linear: np.hypot(linear, 2e-3),  # never rests
        lambda linear: np.where(linear > 0.02, np.inf, 3.0 * linear),  # soft, and leaves the workspace
    ],
    ids=["linear", "stiffening", "softening", "short range", "restless", "workspace"],
)
def test_ten_nonlinear_people_in_six_rounds(monkeypatch, arm):
    """All conditions of all people, one batch a round, on arms that a linear guess does not know."""
    batches = []

    def measure(trials, environment, **_):
        batches.append(len(trials))
        linear = [linear_displacement(trial.subject, environment, trial.perturbation) for trial in trials]
        return arm(np.array(linear))

    monkeypatch.setattr(practice, "measured_displacement", measure)
    crowd = draw_cohort(10, SEED, muscles="linear")
    found = practise(crowd, AS_INTENDED, SEED)
    assert batches[0] == 60
    assert len(batches) <= MAX_ROUNDS
    for person, own in zip(crowd, found, strict=True):
        for condition in AS_INTENDED.conditions:
            if condition.has_multisine:
                perturbation = replace(practice_multisine(SEED), rms=own[condition.name])
                linear = linear_displacement(person.subjects[condition.task], Environment(), perturbation)
                assert arm(linear) == pytest.approx(condition.rms_displacement, rel=TOLERANCE)


@given(
    power=st.floats(0.4, 2.5),
    start=st.floats(0.15, 7.0),
    floor=st.floats(0.0, 0.8),
    target=st.floats(1e-4, 0.1),
)
def test_adjust_reaches_power_laws_from_afar(power, start, floor, target):
    def measure(_, force):
        return target * np.hypot(force**power * np.sqrt(1.0 - floor**2), floor)

    found = adjust(np.array([target]), np.array([start]), measure)
    assert found.displacement[0] == pytest.approx(target, rel=TOLERANCE)
    assert measure(0, found.force)[0] == pytest.approx(found.displacement[0], rel=1e-9)
    assert found.rounds[0] <= MAX_ROUNDS


def test_settled_cells_rest_and_a_linear_one_takes_two_rounds():
    asked = []

    def measure(numbers, force):
        asked.append(numbers.tolist())
        return np.array([2.0, 0.5, 1.0])[numbers] * force

    found = adjust(np.ones(3), np.array([0.5, 1.0, 3.0]), measure)
    assert asked == [[0, 1, 2], [1, 2]]
    np.testing.assert_allclose(found.force, [0.5, 2.0, 1.0])
    assert found.rounds.tolist() == [1, 2, 2]


def test_best_round_is_kept_when_nothing_helps():
    found = adjust(np.array([1.0]), np.array([1.0]), lambda _, force: np.maximum(force, 1.5))
    assert found.rounds[0] == MAX_ROUNDS
    assert found.displacement[0] == 1.5


def test_what_cannot_be_reached_is_named(people, monkeypatch):
    monkeypatch.setattr(practice, "measured_displacement", lambda trials, **_: np.full(len(trials), 9e-3))
    with pytest.raises(
        RuntimeError, match=r"practice of 'S01' in PT7\.5: RMS displacement = 9 mm .* 6 rounds; .* 7\.5 mm"
    ):
        practise(people, BOTH, SEED)


def test_leaving_the_workspace_is_infinitely_far(people):
    trial = Trial(subject=people[0].subjects["RT"], perturbation=replace(practice_multisine(SEED), rms=40.0))
    assert measured_displacement([trial], Environment(), timestep=COARSE).tolist() == [np.inf]


def test_practice_multisine_moves_people_as_realisations_do_on_average():
    """The force is right for the trials to come, although each of them has another realisation."""
    environment, of_practice = Environment(), practice_multisine(SEED)
    rng = np.random.default_rng(0)
    another = replace(of_practice, phases=rng.uniform(-np.pi, np.pi, (2, 72)))
    errors = {"practice": [], "another": []}
    for person in draw_cohort(20, 9, muscles="linear"):
        for subject in person.subjects.values():
            # On average over phases, a line's displacement has the power of both forces' on their own.
            gain = np.sum(np.abs(total_admittance(subject, environment, another.frequencies)) ** 2, axis=(1, 2))
            average = np.sqrt(np.sum(another.amplitudes**2 * gain) / 4.0)
            errors["practice"].append(linear_displacement(subject, environment, of_practice) / average - 1.0)
            errors["another"].append(linear_displacement(subject, environment, another) / average - 1.0)
    rms = {which: np.sqrt(np.mean(np.square(values))) for which, values in errors.items()}
    assert rms["practice"] < 0.02 < rms["another"]
    np.testing.assert_allclose(of_practice.crest_factor(), [1.7, 2.7], atol=0.2)


@pytest.mark.slow(reason="simulates trials")
def test_linear_displacement_is_what_is_measured():
    subject = draw_cohort(1, 4, muscles="linear")[0].subjects["PT"]
    multisine = Multisine.draw(seed=3, rms=2.0, crested=False)
    trial = Trial(subject=subject, perturbation=multisine)
    expected = linear_displacement(subject, Environment(), multisine)
    assert measured_displacement([trial], Environment())[0] == pytest.approx(expected, rel=0.01)


@pytest.mark.slow(reason="simulates practice sessions")
def test_the_step_hardly_matters(monkeypatch):
    """At 1 ms the displacement is the same to within half of what a round may be off."""
    (person,) = draw_cohort(1, 2)
    multisine = Multisine.draw(seed=3, rms=1.0, duration=4.0, crested=False)
    trials = [
        Trial(subject=condition.subject_of(person), perturbation=replace(multisine, rms=condition.published_force))
        for condition in THESIS.conditions
        if condition.has_multisine
    ]
    monkeypatch.setattr(practice, "WINDOW_START", 1.0)
    monkeypatch.setattr(practice, "PERIOD", 3.0)
    quick, fine = (measured_displacement(trials, Environment(), timestep=step) for step in (TIMESTEP, 1e-3))
    np.testing.assert_allclose(quick, fine, rtol=practice.AIM / 2)


def test_a_level_at_which_people_are_unstable_is_refused_before_practice(settings, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "practise", None)
    text = PROTOCOL.replace('"published"', '"practice"').replace('task = "PT"', 'task = "PT"\nco_contraction = 2.5')
    (tmp_path / "strong.toml").write_text(text)
    strong = replace(settings, protocol=tmp_path / "strong.toml")
    expected = (
        r"^condition 'PT2\.5': co_contraction = 2\.5 makes \d of 4 people unstable on the manipulator \(S0.*\); "
        r"expected a level nearer to 1 or other people \(--seed, --muscles\)$"
    )
    with pytest.raises(ValueError, match=expected):
        record_study(strong, tmp_path / "s", show_progress=False)
    assert not (tmp_path / "s").exists()
