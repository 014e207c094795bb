"""The protocol as data: the thesis's, a user's own, and every refusal."""

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

import armperturb.study
from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.arm.linear_arm import arm_admittance, joint_impedance, total_admittance
from armperturb.cohort import draw_cohort
from armperturb.environment import Environment, Strap
from armperturb.perturbations import Multisine, MultisineThenPulse, Pulse
from armperturb.study.protocol import PULSE_UNIT, THESIS, Condition, Protocol, load_protocol
from armperturb.study.published import tables as published
from armperturb.subject import POSITION, RELAX, at_level

THESIS_FILE = Path(armperturb.study.protocol.__file__).parent / "thesis.toml"
FORCES = THESIS.given_forces()
MULTISINE_CONDITIONS = ("PT2.5", "PT7.5", "PT22.5", "RT2.5", "RT7.5", "RT22.5")


@pytest.fixture(scope="module")
def people():
    return draw_cohort(2, 0, muscles="linear")


@pytest.fixture(scope="module")
def multisines():
    """Realisations that need no time for their crest factor."""
    return {
        number: Multisine.draw(seed=number, rms=1.0, crested=False)
        for number, cell in enumerate(THESIS.planned_trials())
        if cell.condition.has_multisine
    }


def test_thesis_is_table_2_1():
    expected = {
        # name: pulse levels, repetitions, trials
        "PT0": ((1, 2), 2, 8),
        "PT2.5": ((2,), 1, 2),
        "PT7.5": ((1, 2), 2, 8),
        "PT22.5": ((2,), 1, 2),
        "RT0": ((1,), 2, 4),
        "RT2.5": ((1,), 1, 2),
        "RT7.5": ((1,), 2, 4),
        "RT22.5": ((1,), 1, 2),
    }
    assert [condition.name for condition in THESIS.conditions] == list(expected)
    trials = Counter(cell.condition.name for cell in THESIS.planned_trials())
    for condition in THESIS.conditions:
        levels, repetitions, count = expected[condition.name]
        assert (condition.pulse_levels, condition.repetitions, trials[condition.name]) == (levels, repetitions, count)
        assert condition.task == condition.name[:2]
        assert condition.rms_displacement == pytest.approx(1e-3 * float(condition.name[2:]))
        if condition.has_multisine:
            assert condition.published_force == pytest.approx(published.applied_force(condition.name).mean)
    assert trials.total() == 32
    assert THESIS.pulse_unit == pytest.approx(published.pulse_unit().mean)
    assert THESIS.pulse_directions_deg == (20.0, 200.0)


def test_session_is_32_trials_of_36_seconds_in_an_order_of_its_own(people, multisines):
    trials = THESIS.trials(people[0], FORCES, 5, 0, multisines=multisines)
    assert [trial.order for trial in trials] == list(range(32))
    cells = [(t.condition, t.repetition, t.pulse_level, _pulse(t).direction_deg) for t in trials]
    wanted = [(t.condition.name, t.repetition, t.level, t.direction_deg) for t in THESIS.planned_trials()]
    assert sorted(cells) == sorted(wanted)
    assert cells != wanted
    assert {trial.perturbation.duration for trial in trials} == {36.0}
    assert {trial.subject for trial in trials} == set(people[0].subjects.values())
    assert all(trial.subject.task == trial.condition[:2] for trial in trials)
    assert len({trial.seed for trial in trials}) == 32


def test_forces_reach_multisines_and_pulses(people, multisines):
    forces = {name: 10.0 + number for number, name in enumerate(MULTISINE_CONDITIONS)} | {PULSE_UNIT: 40.0}
    for trial in THESIS.trials(people[0], forces, 5, 0, multisines=multisines):
        assert _pulse(trial).peak == 40.0 * trial.pulse_level
        if isinstance(trial.perturbation, MultisineThenPulse):
            assert trial.perturbation.multisine.rms == forces[trial.condition]
            assert _pulse(trial).onset == trial.perturbation.multisine.duration == 32.0
        else:
            assert trial.condition in ("PT0", "RT0")
            assert 5.0 <= _pulse(trial).onset <= 20.0


@pytest.mark.slow(reason="lowers the peaks of multisines")
def test_every_trial_has_a_disturbance_of_its_own():
    # Two realisations are enough to see it, as lowering the peaks takes its time.
    conditions = (replace(THESIS.condition("RT2.5"), pulse_levels=(1,)), THESIS.condition("RT0"))
    short = replace(THESIS, conditions=conditions, pulse_unit_condition="")
    drawn = short.draw_multisines(3)
    assert sorted(drawn) == [0, 1]
    assert not np.array_equal(drawn[0].phases, drawn[1].phases)
    assert short.draw_multisines(3)[0] is drawn[0]
    assert not np.array_equal(short.draw_multisines(4)[0].phases, drawn[0].phases)
    onsets = [
        _pulse(trial).onset
        for number, person in enumerate(draw_cohort(2, 0))
        for trial in short.trials(person, FORCES, 3, number)
        if trial.condition == "RT0"
    ]
    assert len(set(onsets)) == len(onsets) == 8


def test_order_and_noise_are_the_persons_the_multisines_everyones(people, multisines):
    first, second = (THESIS.trials(person, FORCES, 5, i, multisines=multisines) for i, person in enumerate(people))
    again = THESIS.trials(people[0], FORCES, 5, 0, multisines=multisines)
    assert [_label(trial) for trial in first] == [_label(trial) for trial in again]
    assert [_label(trial) for trial in first] != [_label(trial) for trial in second]
    assert not {trial.seed for trial in first} & {trial.seed for trial in second}
    of_first, of_second = (
        {_label(t): t.perturbation.multisine.phases.tobytes() for t in ts if t.condition[2:] != "0"}
        for ts in (first, second)
    )
    assert of_first == of_second
    assert len(set(of_first.values())) == len(of_first) == 20
    other_seed = THESIS.trials(people[0], FORCES, 6, 0, multisines=multisines)
    assert [_label(trial) for trial in first] != [_label(trial) for trial in other_seed]


def test_ideal_people_have_no_noise(people, multisines):
    ideal = THESIS.trials(people[0], FORCES, 5, 0, noisy=False, multisines=multisines)
    noisy = THESIS.trials(people[0], FORCES, 5, 0, multisines=multisines)
    assert all(trial.noise is None for trial in ideal)
    assert all(trial.noise is not None for trial in noisy)
    assert [trial.seed for trial in ideal] == [trial.seed for trial in noisy]


@pytest.mark.slow(reason="lowers the peaks of multisines")
def test_multisine_without_pulse_lasts_the_whole_trial(people):
    protocol = Protocol(conditions=(Condition(name="A", task="RT", rms_displacement=0.01, repetitions=2),))
    trials = protocol.trials(people[0], {"A": 1.5, PULSE_UNIT: 1.0}, 0, 0)
    assert [trial.perturbation.duration for trial in trials] == [36.0, 36.0]
    assert [trial.pulse_level for trial in trials] == [0.0, 0.0]
    assert sorted(trial.repetition for trial in trials) == [0, 1]


@pytest.mark.slow(reason="lowers the peaks of three multisines")
def test_co_contraction_of_a_condition_is_that_of_its_trials(people):
    conditions = tuple(
        Condition(name=name, task=name[:2], rms_displacement=0.01, co_contraction=level)
        for name, level in (("PTa", 0.5), ("PTb", 1.0), ("RT", 1.0))
    )
    forces = {"PTa": 1.5, "PTb": 1.5, "RT": 1.5, PULSE_UNIT: 1.0}
    trials = {trial.condition: trial for trial in Protocol(conditions=conditions).trials(people[0], forces, 0, 0)}
    assert trials["PTa"].subject == at_level(people[0].subjects["PT"], 0.5)
    assert trials["PTb"].subject == people[0].subjects["PT"] != trials["PTa"].subject
    assert trials["RT"].subject == people[0].subjects["RT"]


def test_a_persons_level_in_a_condition_is_that_of_its_trials(people, multisines):
    person = replace(people[0], levels={"PT2.5": 0.5, "PT0": 0.4})
    subjects = {t.condition: t.subject for t in THESIS.trials(person, FORCES, 5, 0, multisines=multisines)}
    position, relax = person.subjects["PT"], person.subjects["RT"]
    levels = {condition.name: person.levels.get(condition.name, 1.0) for condition in THESIS.conditions}
    assert subjects == {
        name: at_level(position, level) if name.startswith("PT") else relax for name, level in levels.items()
    }
    # The protocol's level is a multiple of the person's.
    both = replace(THESIS.condition("PT2.5"), co_contraction=3.0)
    assert both.subject_of(person) == at_level(position, 1.5)


def test_people_whose_muscles_yield_come_at_their_own_levels():
    person = draw_cohort(1, 0)[0]
    for name, level in person.levels.items():
        subject = THESIS.condition(name).subject_of(person)
        assert subject == at_level(person.subjects[name[:2]], level)
        assert subject.muscle.short_range_stiffness != person.subjects[name[:2]].muscle.short_range_stiffness


def test_users_protocol_from_a_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        'trial_duration = 12\nonset_window = [2, 8]\npulse_unit = 30\n[[conditions]]\nname = "soft"\ntask = "RT"\n'
        "pulse_levels = [0.5, 1]\nrepetitions = 3\n"
    )
    protocol = load_protocol(path)
    assert len(protocol.planned_trials()) == 12
    trials = protocol.trials(draw_cohort(1, 0)[0], protocol.given_forces(), 0, 0)
    assert {trial.perturbation.peak for trial in trials} == {15.0, 30.0}
    assert all(2.0 <= trial.perturbation.onset <= 8.0 for trial in trials)


def test_a_condition_without_a_published_force_is_named_where_nobody_practises(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('[[conditions]]\nname = "soft"\ntask = "RT"\nrms_displacement = 0.01\n')
    with pytest.raises(ValueError, match=r"condition 'soft': published_force = 0\.0; expected a number above 0"):
        load_protocol(path).given_forces()


def test_a_protocol_survives_its_file(tmp_path):
    path = tmp_path / "again.toml"
    path.write_text(tomli_w.dumps(THESIS.to_dict()))
    assert load_protocol(path) == THESIS == load_protocol(THESIS_FILE)


@pytest.mark.parametrize(
    ("table", "strap"),
    [("", None), ("[strap]", Strap()), ("[strap]\nstiffness = 8000\nmass = 5.5", Strap(stiffness=8000, mass=5.5))],
)
def test_a_strap_is_a_table_of_the_protocol(tmp_path, table, strap):
    path = tmp_path / "strapped.toml"
    path.write_text(f"{THESIS_FILE.read_text()}\n{table}\n")
    protocol = load_protocol(path)
    assert protocol == replace(THESIS, strap=strap)
    path.write_text(tomli_w.dumps(protocol.to_dict()))
    assert load_protocol(path) == protocol


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("trial_duration", "trial_lenght", "unknown key 'trial_lenght'; expected keys are conditions, forces"),
        ('name = "PT0"', 'name = "PT0"\nforce = 3', "condition 1: unknown key 'force'; expected keys are name, task"),
        ('name = "PT0"\n', "", "condition 1: missing key 'name'"),
        ('task = "RT"', 'task = "XT"', "condition 5: condition 'RT0': task = 'XT'; expected one of PT, RT"),
        ('name = "PT2.5"', 'name = "PT7.5"', "conditions holds 'PT7.5' twice"),
        ('name = "PT2.5"', 'name = ""', "name = ''; expected a text"),
        ('name = "PT2.5"', 'name = "pulse_unit"', "expected another"),
        ("published_force = 1.2", "published_force = -1.2", "'PT2.5': published_force = -1.2; expected .* at least 0"),
        ("rms_displacement = 0.0075", "rms_displacement = 7.5", "rms_displacement = 7.5; expected .* at most 0.1"),
        ("rms_displacement = 0.0025", "", "published_force = 1.2; expected 0, as rms_displacement = 0"),
        ("rms_displacement = 0.0025", 'rms_displacement = "2.5 mm"', "rms_displacement = '2.5 mm'; expected a number"),
        ("repetitions = 2", "repetitions = 0", "repetitions = 0; expected a finite number at least 1"),
        ("repetitions = 2", "repetitions = 1.5", "repetitions = 1.5; expected a whole number"),
        ('task = "PT"', 'task = "PT"\nco_contraction = -0.5', "'PT0': co_contraction = -0.5; expected a .* above 0"),
        ('task = "RT"', 'task = "RT"\nco_contraction = 0.5', "'RT0': co_contraction = 0.5; expected 1 in RT"),
        ("repetitions = 2", "repetitions = 2\nreached = 0.05", "'PT0': reached = 0.05; expected .* at least 0.1"),
        ("repetitions = 2", "repetitions = 2\nreached = 11", "'PT0': reached = 11; expected .* at most 10"),
        ("repetitions = 2", "repetitions = 2\nreached = nan", "'PT0': reached = nan; expected a finite number"),
        ("repetitions = 2", "repetitions = 2\nreached_spread = -0.1", "reached_spread = -0.1; expected .* at least 0"),
        ("repetitions = 2", "repetitions = 2\nreached_spread = 1.5", "reached_spread = 1.5; expected .* at most 1"),
        ("pulse_levels = [1, 2]", "pulse_levels = [1, -2]", "pulse_levels = -2.0; expected a finite number above 0"),
        ("pulse_levels = [1, 2]", "pulse_levels = [2, 2]", "pulse_levels holds 2.0 twice"),
        ("pulse_levels = [1, 2]", "pulse_levels = 2", "pulse_levels = 2; expected a list of numbers"),
        ("pulse_levels = [1, 2]", "", "pulse_levels = \\[\\]; expected a multisine, a pulse or both"),
        ("pulse_directions_deg = [20.0, 200.0]", "pulse_directions_deg = []", "expected at least one"),
        ("pulse_directions_deg = [20.0, 200.0]", "pulse_directions_deg = [nan]", "pulse_directions_deg = nan"),
        ("pulse_unit = 53.9", "pulse_unit = -53.9", "pulse_unit = -53.9; expected a finite number above 0"),
        ("pulse_unit_factor = 10.0", "pulse_unit_factor = 0", "pulse_unit_factor = 0; expected"),
        ('pulse_unit_condition = "PT7.5"', 'pulse_unit_condition = "PT5"', "'PT5'; expected a condition with a multis"),
        ('pulse_unit_condition = "PT7.5"', 'pulse_unit_condition = "PT0"', "'PT0'; expected a condition with a multis"),
        ('forces = "practice"', 'forces = "guess"', "forces = 'guess'; expected one of practice, published"),
        ("onset_window = [5.0, 20.0]", "onset_window = [5.0, 36.0]", "onset_window = \\[5.0, 36.0\\]; .*35.92 s"),
        ("onset_window = [5.0, 20.0]", "onset_window = [20.0, 5.0]", "onset_window = \\[20.0, 5.0\\]; expected"),
        ("onset_window = [5.0, 20.0]", "onset_window = [-1.0, 5.0]", "onset_window = \\[-1.0, 5.0\\]; expected"),
        ("onset_window = [5.0, 20.0]", "onset_window = [5.0]", "onset_window = \\[5.0\\]; expected"),
        ("trial_duration = 36.0", "trial_duration = 32.0", "multisine_duration = 32.0; expected at most 31.92 s"),
        ("trial_duration = 36.0", "trial_duration = -1", "trial_duration = -1; expected a finite number above 0"),
        (
            "[[conditions]]",
            "[strap]\nstiff = 1\n[[conditions]]",
            "strap: unknown key 'stiff'; expected keys are stiffness",
        ),
        ("[[conditions]]", "[strap]\nmass = 0\n[[conditions]]", "Strap: mass = 0; expected a finite number above 0"),
        ("[[conditions]]", "strap = 5000\n[[conditions]]", "strap = 5000; expected a table that begins with .strap."),
        ("[[conditions]]", "[conditions", "not a TOML file"),
    ],
)
def test_refusals_name_file_field_value_and_what_was_expected(tmp_path, old, new, message):
    text = THESIS_FILE.read_text()
    assert old in text
    path = tmp_path / "bad.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises((ValueError, TypeError), match=f"bad.toml.*{message}"):
        load_protocol(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "missing key 'conditions'"),
        ("conditions = []", "protocol: conditions = \\[\\]; expected at least one"),
        ("conditions = 3", "conditions = 3; expected tables that begin with \\[\\[conditions\\]\\]"),
        (
            'forces = "published"\n[[conditions]]\nname = "A"\ntask = "PT"\nrms_displacement = 0.01',
            "condition 'A': published_force = 0.0; expected a number above 0",
        ),
    ],
)
def test_protocols_without_what_they_need_are_refused(tmp_path, text, message):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises((ValueError, TypeError), match=f"bad.toml: {message}"):
        load_protocol(path)


def test_missing_condition_and_missing_file_are_named(tmp_path):
    with pytest.raises(KeyError, match="no condition 'PT5'; there are PT0"):
        THESIS.condition("PT5")
    with pytest.raises(FileNotFoundError, match=r"none\.toml"):
        load_protocol(tmp_path / "none.toml")


def test_rms_of_a_vector_would_leave_no_room_for_the_published_rotations():
    """Table 2.1 against F.4: with x = J q, the rotations bound the displacement from below, whatever their correlation.

    A vector's RMS is least where both joints move in step, against each other. This least is convex in the rotations:
    what it is for their means over people is a bound for the mean over people, too.
    """
    arms = [
        replace(POSITION, l_h=l_h, l_f=l_f)
        for l_h in (0.30, 0.32, 0.34, 0.36)
        for l_f in (0.31, 0.33, 0.35, 0.37, 0.39)
    ]
    for condition in MULTISINE_CONDITIONS:
        # Printed to 0.1 mm, too.
        largest = published.rms_displacement(condition).mean + 0.05e-3
        for arm in arms:
            if condition[:2] == "PT":
                assert _least_published(arm, condition) > 1.15 * largest
        assert _least_published(POSITION, condition) > largest
        assert _least_published(POSITION, condition) < math.sqrt(2.0) * largest


def test_linear_arms_move_their_joints_as_published_only_if_rms_is_per_axis():
    """Table 2.1 against F.4 and F.2: rotations and velocities of the mean arms at the published displacement."""
    multisine = Multisine.draw(seed=0, rms=1.0, crested=False)
    frequency, power = multisine.frequencies, multisine.amplitudes**2 / 2
    nearer, ratios = 0, {"axis": [], "vector": []}
    for condition in MULTISINE_CONDITIONS:
        subject = POSITION if condition[:2] == "PT" else RELAX
        total, jacobian = total_admittance(subject, Environment(), frequency), hand_jacobian(subject)
        force = np.linalg.solve(arm_admittance(subject, frequency), total)
        joints = np.linalg.solve(joint_impedance(subject, frequency), jacobian.T @ force)
        vector = math.sqrt(np.einsum("f,foi->", power, np.abs(total) ** 2))
        for quantity, factor in (("rms_rotation", np.ones_like(frequency)), ("rms_velocity", 2 * np.pi * frequency)):
            moved = np.sqrt(np.einsum("f,foi->o", power * factor**2, np.abs(joints) ** 2))
            for joint, value in zip("se", moved, strict=True):
                printed = published.joint_motion(condition, joint, quantity).mean
                of_vector = value / vector * published.rms_displacement(condition).mean / printed
                of_axis = math.sqrt(2.0) * of_vector
                ratios["axis"].append(of_axis)
                ratios["vector"].append(of_vector)
                nearer += abs(math.log(of_axis)) < abs(math.log(of_vector))
    assert nearer == 24
    assert np.median(ratios["axis"]) == pytest.approx(0.80, abs=0.03)
    assert np.median(ratios["vector"]) == pytest.approx(0.57, abs=0.03)


def _least_published(arm, condition):
    """Least RMS of the hand's displacement vector [m] for the published rotations of a condition.

    They are printed to 0.1 degree: the truth lies up to half of that away, on whichever side gives the least.
    """
    rotation = np.array([published.joint_motion(condition, joint, "rms_rotation").mean for joint in ("s", "e")])
    sides = ((-1, -1), (-1, 1), (1, -1), (1, 1))
    return min(_least_displacement(arm, rotation + math.radians(0.05) * np.array(side)) for side in sides)


def _least_displacement(arm, rotation):
    """Least RMS of the hand's displacement vector [m] for RMS rotations of both joints [rad]: both in step."""
    gram = hand_jacobian(arm).T @ hand_jacobian(arm)
    signs = np.array([1.0, -math.copysign(1.0, gram[0, 1])])
    return math.sqrt((signs * rotation) @ gram @ (signs * rotation))


def _pulse(trial):
    return trial.perturbation if isinstance(trial.perturbation, Pulse) else trial.perturbation.pulse


def _label(trial):
    return trial.condition, trial.repetition, trial.pulse_level, _pulse(trial).direction_deg
