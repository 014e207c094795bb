"""Cells of the published tables from recordings whose values are known, and from simulated people."""

import math
import re

import numpy as np
import pytest

from armperturb.analysis.measures.kinematics import hand_position
from armperturb.recording import make_recording
from armperturb.recording_files import load_recording
from armperturb.study.published import tables as published
from armperturb.study.results.quantities import (
    Cell,
    level_name,
    measure,
    measured_cells,
    multisine_window,
    published_cells,
)

RATE = 200.0
L_H, L_F, START = 0.31, 0.36, np.radians([22.5, 82.3])
ONSET = 30.0


def rotating(condition, rotation, *, force=None, level=1.0, direction=20.0, onset=ONSET, limit=math.nan, subject="A"):
    """One trial whose joints turn as told [rad], (time, joint)."""
    path = hand_position(START + rotation, L_H, L_F) - hand_position(START, L_H, L_F)
    load = np.zeros_like(path) if force is None else force
    labels = {
        **dict(subject=subject, task=condition[:2], condition=condition, repetition=0, order=0, pulse_level=level),
        **dict(pulse_direction=direction, pulse_onset=onset, l_h=L_H, l_f=L_F, limit_time=limit),
        **dict(theta_s_deg=22.5, theta_e_deg=82.3),
    }
    return load, path, labels


def recorded(*trials):
    loads, paths, labels = zip(*trials, strict=True)
    return make_recording(
        {"perturbation": loads, "force": loads, "displacement": paths},
        {name: [one[name] for one in labels] for name in labels[0]},
        RATE,
    )


TIME = np.arange(round(36.0 * RATE)) / RATE
OMEGA = 2 * np.pi * 2.0 * 21 / 20.48 / 2


def swinging(size):
    """Whole periods in the window; the elbow twice as far as the shoulder, against it."""
    return size * np.stack([np.sin(OMEGA * TIME), -2 * np.sin(OMEGA * TIME)], axis=-1)


def bump(height, delay=0.15):
    """A smooth bump that is over before long."""
    shape = np.cos(np.pi * (TIME - ONSET - delay) / (2 * delay)) ** 2 * (np.abs(TIME - ONSET - delay) < delay)
    return np.multiply.outer(shape, height)


def test_there_are_126_published_cells():
    cells = published_cells()
    assert len(cells) == 126
    assert sum(cell.condition.startswith("RT") for cell in cells) == 58
    assert cells[Cell("2.1", "PT0", "peak_displacement_max")] == pytest.approx((0.1385, 0.0372))
    assert cells[Cell("2.1", "RT2.5", "rms_displacement")] == pytest.approx((0.0043, 0.0015))
    assert cells[Cell("F.3", "PT22.5", "peak_velocity_max_e")] == pytest.approx(np.radians([156.2, 37.7]))
    assert cells[Cell("F.6", "RT7.5", "peak_rotation_right_e")] == published.joint_motion(
        "RT7.5", "e", "peak_rotation", "right"
    )
    assert all(value.mean > 0 and value.sd > 0 for value in cells.values())


def test_a_sine_has_the_rms_of_a_sine():
    force = np.stack([3.0 * np.sin(OMEGA * TIME), np.sin(OMEGA * TIME)], axis=-1)
    recording = recorded(rotating("PT2.5", swinging(0.01), force=force, level=0.0, onset=math.nan, direction=math.nan))
    cells = measured_cells(recording)
    assert cells.keys() == {
        cell for cell in published_cells() if cell.condition == "PT2.5" and "_max" not in cell.quantity
    }
    root = math.sqrt(2.0)
    expected = {
        ("2.1", "rms_force"): math.sqrt((9.0 + 1.0) / 4),
        ("F.4", "rms_rotation_s"): 0.01 / root,
        ("F.4", "rms_rotation_e"): 0.02 / root,
        ("F.4", "max_rotation_s"): 0.01,
        ("F.4", "max_rotation_e"): 0.02,
        ("F.2", "rms_velocity_s"): 0.01 * OMEGA / root,
        ("F.2", "max_velocity_e"): 0.02 * OMEGA,
    }
    for (table, quantity), value in expected.items():
        assert cells[Cell(table, "PT2.5", quantity)] == pytest.approx(value, rel=2e-3), quantity
    window = slice(round(8.0 * RATE), round(28.48 * RATE))
    path = recording["displacement"].values[0, window]
    assert cells[Cell("2.1", "PT2.5", "rms_displacement")] == pytest.approx(math.sqrt(np.mean(path**2)))


def test_trials_of_a_condition_are_pooled():
    sizes = (0.01, 0.02)
    trials = [rotating("RT22.5", swinging(size), level=0.0, onset=math.nan, direction=math.nan) for size in sizes]
    cells = measured_cells(recorded(*trials))
    rms = math.sqrt((sizes[0] ** 2 + sizes[1] ** 2) / 2) / math.sqrt(2)
    assert cells[Cell("F.4", "RT22.5", "rms_rotation_s")] == pytest.approx(rms, rel=1e-3)
    assert cells[Cell("F.4", "RT22.5", "max_rotation_s")] == pytest.approx(0.015, rel=1e-3)


def test_levels_pool_directions_and_directions_pool_levels():
    heights = {(1.0, 20.0): 0.10, (1.0, 200.0): -0.14, (2.0, 20.0): 0.20, (2.0, 200.0): -0.26}
    trials = [
        rotating("PT0", bump([0.5 * height, height]), level=level, direction=direction)
        for (level, direction), height in heights.items()
    ]
    cells = measured_cells(recorded(*trials))
    assert {cell for cell in published_cells() if cell.condition == "PT0"} == cells.keys()
    for quantity, value in {"min": 0.12, "max": 0.23}.items():
        assert cells[Cell("F.5", "PT0", f"peak_rotation_{quantity}_e")] == pytest.approx(value, rel=1e-3)
        assert cells[Cell("F.5", "PT0", f"peak_rotation_{quantity}_s")] == pytest.approx(value / 2, rel=1e-3)
        # The slope of a sin^2 that lasts 0.3 s.
        velocity = value * math.pi / 0.3
        assert cells[Cell("F.3", "PT0", f"peak_velocity_{quantity}_e")] == pytest.approx(velocity, rel=0.01)
    for quantity, value in {"left": 0.20, "right": 0.15}.items():
        assert cells[Cell("F.6", "PT0", f"peak_rotation_{quantity}_e")] == pytest.approx(value, rel=1e-3)
    far = [np.linalg.norm(trial[1], axis=1).max() for trial in trials]
    assert cells[Cell("2.1", "PT0", "peak_displacement_min")] == pytest.approx(np.mean(far[:2]))
    assert cells[Cell("2.1", "PT0", "peak_displacement_max")] == pytest.approx(np.mean(far[2:]))
    # However many repetitions there are of each.
    again = measured_cells(recorded(*trials, trials[0], trials[0]))
    assert again == pytest.approx(cells)


def test_windows_are_those_of_the_task():
    late = bump([0.1, 0.1], delay=0.4)  # highest after 0.4 s
    position, relax = (measured_cells(recorded(rotating(name, late))) for name in ("PT0", "RT0"))
    assert relax[Cell("F.5", "RT0", "peak_rotation_min_s")] == pytest.approx(0.1, rel=1e-3)
    at_end = 0.1 * math.sin(math.pi * 0.3 / 0.8) ** 2
    assert position[Cell("F.5", "PT0", "peak_rotation_min_s")] == pytest.approx(at_end, rel=1e-3)


def test_another_level_in_a_condition_of_the_thesis_fills_cells_beside_those_of_the_thesis():
    both = [rotating("PT0", bump([0.1, 0.1]), level=level) for level in (1.0, 2.0)]
    third = rotating("PT0", bump([0.2, 0.2]), level=8.0)
    cells, left_out = measure(recorded(*both, third))
    assert left_out == ()
    thesis = measured_cells(recorded(*both))
    assert Cell("F.6", "PT0", "peak_rotation_right_s") in thesis
    assert {cell: value for cell, value in cells.items() if cell in published_cells()} == thesis
    assert {(cell.table, cell.quantity) for cell in cells.keys() - thesis.keys()} == {
        ("2.1", "peak_displacement_8"),
        *(("F.3", f"peak_velocity_8_{joint}") for joint in "se"),
        *(("F.5", f"peak_rotation_8_{joint}") for joint in "se"),
    }
    # So does a level that the thesis has in other conditions only.
    assert Cell("F.5", "RT0", "peak_rotation_max_s") in measured_cells(
        recorded(rotating("RT0", bump([0.1, 0.1]), level=2.0))
    )


def test_levels_have_names_in_conditions_of_the_thesis_only():
    assert [level_name("PT0", level) for level in (1.0, 2.0, 1.5)] == ["min", "max", "1.5"]
    assert [level_name("own", level) for level in (1.0, 2.0, 1.5)] == ["1", "2", "1.5"]


def test_conditions_of_ones_own_fill_cells_of_their_own():
    load = np.where(TIME[:, None] < ONSET, swinging(1.0), 0.0)

    def trials(name, levels):
        turned = swinging(0.01) + bump([0.1, 0.1])
        kinds = [(level, direction) for level in levels for direction in (20.0, 200.0)]
        return [rotating(name, turned, force=load, level=level, direction=direction) for level, direction in kinds]

    thesis = measure(recorded(*trials("PT7.5", (1.0, 2.0)))).cells
    own, left_out = measure(recorded(*trials("PT5 mine", (1.5, 3.0)), rotating("PTrest", bump([0.2, 0.2]), level=3.0)))
    assert left_out == ()
    names = {"min": "1.5", "max": "3"}
    for cell, value in thesis.items():
        quantity = re.sub("(?<=_)(min|max)", lambda match: names[match[0]], cell.quantity)
        assert own.pop(Cell(cell.table, "PT5 mine", quantity)) == value
    # Without a multisine there is no more than the one pulse.
    assert {(cell.condition, cell.quantity) for cell in own} == {
        ("PTrest", "peak_displacement_3"),
        *(("PTrest", f"peak_{what}_3_{joint}") for what in ("velocity", "rotation") for joint in "se"),
        *(("PTrest", f"peak_rotation_right_{joint}") for joint in "se"),
    }


def test_only_the_directions_of_the_thesis_are_right_and_left():
    heights = {0.0: 0.10, 25.0: 0.12, 90.0: 0.14, 195.0: 0.18, 270.0: 0.30}
    trials = [rotating("RT0", bump([0.1, height]), direction=direction) for direction, height in heights.items()]
    cells = measured_cells(recorded(*trials, trials[0]))
    assert cells[Cell("F.6", "RT0", "peak_rotation_right_e")] == pytest.approx(0.12, rel=1e-3)
    assert cells[Cell("F.6", "RT0", "peak_rotation_left_e")] == pytest.approx(0.18, rel=1e-3)
    # Each direction counts alike.
    mean = np.mean(list(heights.values()))
    assert cells[Cell("F.5", "RT0", "peak_rotation_min_e")] == pytest.approx(mean, rel=1e-3)


def test_a_direction_needs_all_levels():
    trials = [rotating("PT7.5", swinging(0.01) + bump([0.1, 0.1]), direction=direction) for direction in (20.0, 200.0)]
    cells, left_out = measure(recorded(*trials))
    assert not any(cell.table == "F.6" for cell in cells)
    assert Cell("F.5", "PT7.5", "peak_rotation_min_s") in cells
    assert len(left_out) == 4
    assert left_out[0] == "F.6, PT7.5, peak_rotation_left_s: no trial of level max"


def test_the_workspace_limit_ends_what_counts():
    rotation = swinging(0.01) + bump([0.1, 0.1])
    whole = measured_cells(recorded(rotating("PT7.5", rotation)))
    late, left_out = measure(recorded(rotating("PT7.5", rotation, limit=ONSET + 0.1)))
    assert late.keys() == {cell for cell in whole if not cell.quantity.startswith("peak")}
    assert late == pytest.approx({cell: whole[cell] for cell in late}, rel=1e-6)
    assert left_out == (
        "trial 0 reached the workspace limit at 30.100 s, 0.100 s after its pulse began; expected it to stay inside "
        "for 0.3 s (PT7.5, pulse at 20°)",
    )
    early, left_out = measure(recorded(rotating("PT7.5", rotation, limit=20.0)))
    assert early == {}
    assert (
        left_out[0]
        == "trial 0: the workspace limit is reached at 20.000 s, within the multisine's window (PT7.5, pulse at 20°)"
    )


def test_a_handle_out_of_reach_is_told_and_harms_no_other_trial():
    good, bad = rotating("PT0", bump([0.1, 0.1])), rotating("PT0", bump([0.1, 0.1]))
    bad[1][TIME > ONSET + 0.05] = 1.0
    cells, left_out = measure(recorded(good, bad))
    assert cells == measured_cells(recorded(good))
    assert left_out[0] == "trial 1: the handle is out of the arm's reach at 30.055 s (PT0, pulse at 20°)"
    assert "trial 1 reached the workspace limit" in left_out[1]


def test_the_first_sample_out_of_reach_is_found_despite_rounding():
    late = [n for n in range(round(ONSET * RATE), len(TIME)) if n / RATE * RATE > n]
    assert late
    for n in late[:: max(1, len(late) // 5)]:
        trial = rotating("PT0", bump([0.1, 0.1]))
        trial[1][n:] = 1.0
        _, left_out = measure(recorded(trial))
        assert left_out[0] == f"trial 0: the handle is out of the arm's reach at {n / RATE:.3f} s (PT0, pulse at 20°)"


def test_too_short_a_trial_is_told():
    short = recorded(rotating("RT7.5", swinging(0.01))).isel(time=slice(0, round(30.5 * RATE)))
    cells, left_out = measure(short)
    assert {cell.quantity.split("_")[0] for cell in cells} == {"rms", "max"}
    assert left_out == ("trial 0 ends 0.5 s after its pulse began; expected more than 1 s in RT (RT7.5, pulse at 20°)",)
    _, left_out = measure(recorded(rotating("RT7.5", swinging(0.01), onset=20.0)))
    assert left_out == ("trial 0: the multisine ends at 20 s; expected 28.48 s or more (RT7.5, pulse at 20°)",)


def test_refuses_several_people():
    people = [rotating("PT0", bump([0.1, 0.1]), subject=name) for name in ("A", "B")]
    with pytest.raises(ValueError, match="recordings of A, B; expected those of one person"):
        measured_cells(recorded(*people))


def test_simulated_people_fill_the_cells_that_their_protocol_has(study):
    recording = load_recording(study.of("PT7.5")[0].recording)
    cells, left_out = measure(recording)
    # One direction, no window of 1 s after a pulse in RT, no pulse of level 2 in PT0.
    assert {cell.table for cell in cells} == {"2.1", "F.2", "F.3", "F.4", "F.5", "F.6"}
    assert sum("RT" in cell.condition for cell in cells) == 2 * 10
    assert sum("after its pulse began" in line for line in left_out) == 2
    case = study.of("PT7.5")[0]
    assert cells[Cell("2.1", "PT7.5", "rms_force")] == pytest.approx(case.force)
    assert cells[Cell("2.1", "PT7.5", "rms_displacement")] == pytest.approx(case.displacement)
    plain = recording[["perturbation", "force", "displacement"]]
    assert measured_cells(plain) == cells


def test_what_is_left_of_a_filter_before_a_pulse_is_no_multisine():
    push = np.zeros((len(TIME), 2))
    push[(TIME >= ONSET) & (TIME < ONSET + 0.08)] = 50.0
    ripple = 1e-3 * np.sin(2 * np.pi * 90.0 * TIME)[:, None]
    tables = []
    for force in (push, push + ripple, push + 2000.0 * ripple):
        load, path, labels = rotating("tap", bump([0.1, 0.1]), force=force, onset=9.0)
        early = slice(round((ONSET - 9.0) * RATE), None)
        found = measure(recorded((load[early], path[early], {**labels, "task": "PT"})))
        assert not found.left_out
        tables.append({(cell.table, cell.quantity) for cell in found.cells})
    assert tables[0] == tables[1] < tables[2]


def test_a_multisine_of_a_short_period_is_measured_where_there_is_one():
    time = np.arange(round(7.0 * RATE)) / RATE
    force = np.stack([np.sin(2 * np.pi * 2.5 * time), np.cos(2 * np.pi * 2.5 * time)], axis=1)
    force += np.sin(2 * np.pi * 1.5 * time)[:, None]  # together, a period of 2 s
    path = 1e-3 * force
    _, _, labels = rotating("PT own", np.zeros((len(time), 2)), onset=math.nan)
    trial = recorded((force, path, labels))
    assert multisine_window(trial).start == 8 * RATE
    assert multisine_window(trial, may_be_earlier=True) == slice(round(4 * RATE), round(6 * RATE))
    brief = trial.isel(time=slice(round(3.0 * RATE)))
    assert multisine_window(brief, may_be_earlier=True) == slice(0, round(3.0 * RATE))
