"""Figures show the numbers that they were given: what is drawn is read back."""

import itertools
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from invented import FEEDBACK, FREQUENCY, LEVELS, SPRINGS, fitted, people_of, renamed, study_of
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.container import ErrorbarContainer
from scipy import stats

from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.measures.kinematics import hand_position
from armperturb.cohort import average_person
from armperturb.environment import Environment
from armperturb.perturbations import Pulse
from armperturb.plots.style import COLOURS, GREY, INK, PUBLISHED, SKELETAL, TRUE, new_figure
from armperturb.recording import make_recording
from armperturb.recording_files import save_recording
from armperturb.study.comparison.effects import AdmittanceEffect, Effects
from armperturb.study.protocol import Protocol
from armperturb.study.published import tables as published
from armperturb.study.report.figures import admittance as admittance_figures
from armperturb.study.report.figures import fit as fit_figures
from armperturb.study.report.figures import parameters as parameter_figures
from armperturb.study.report.figures import perturbation as perturbation_figures
from armperturb.study.report.figures import pulses as pulse_figures
from armperturb.study.report.figures import rig as rig_figures
from armperturb.study.report.figures import trajectories as trajectory_figures
from armperturb.study.report.figures.axes import STARS
from armperturb.study.report.figures.catalogue import drawings
from armperturb.study.report.figures.people import PERSON, draw_people, fit_labels, with_margins
from armperturb.study.report.findings import excess_rows
from armperturb.study.results.recordings import pulse_width
from armperturb.subject import POSITION, RELAX

RATE = 200.0
NOTHING = Effects(admittance={}, parameters={}, levels={}, rows=(), pairs=(), remarks=())


@pytest.fixture(scope="module")
def people():
    return people_of()


@pytest.fixture(scope="module")
def invented(people):
    """Three people of random numbers, in all conditions."""
    return study_of(people)


def whiskers(ax, colour):
    """Mean and half-length of the whiskers of a colour, from left to right; NaN for those without a length."""
    found = []
    for box in ax.containers:
        if isinstance(box, ErrorbarContainer) and box[0].get_color() == colour:
            line, _, (lengths,) = box
            ends = [path.vertices[:, 1] for path in lengths.get_paths()]
            found += [(x, y, (high - low) / 2) for x, y, (low, high) in zip(*line.get_data(), ends, strict=True)]
    return [(mean, half) for _, mean, half in sorted(found)]


def interval(values):
    """Mean over people and half of its 95 % interval."""
    low, high = stats.t.interval(0.95, len(values) - 1, np.mean(values), stats.sem(values))
    return (low + high) / 2, (high - low) / 2


def points(ax, marker):
    """Heights of the points of people, from left to right."""
    drawn = [line for line in ax.lines if line.get_marker() == marker and line.get_linestyle() == "None"]
    found = [
        point
        for line in drawn
        if line.get_color() != INK or line.get_alpha()
        for point in zip(*line.get_data(), strict=True)
    ]
    return [y for _, y in sorted(found)]


def joined(ax):
    """Heights of the lines within people: one list per person and series."""
    (lines,) = zip(
        *[
            (line.get_ydata(),)
            for line in ax.lines
            if line.get_linewidth() == PERSON["linewidth"] and line.get_linestyle() == "-"
        ],
        strict=True,
    )
    return [part[:-1].tolist() for y in lines for part in np.split(y, np.flatnonzero(np.isnan(y)) + 1) if len(part)]


def means_of(study, condition, level, quantity):
    """Each person's mean over the trials of a condition and level whose quantity is finite."""
    values = [
        [quantity(t) for t in one.trials if t.condition == condition and abs(t.pulse_level) == level]
        for one in study.people
    ]
    return [np.mean([value for value in mine if np.isfinite(value)]) for mine in values]


def texts(ax):
    return [text.get_text() for text in ax.texts if text.get_text()]


def test_peak_displacements_are_of_people_beside_table_2_1(invented):
    position, relax = pulse_figures.peak_displacement(invented).axes
    of_people = {
        (condition, level): [100.0 * value for value in means_of(invented, condition, level, lambda t: t.displacement)]
        for condition, levels in LEVELS.items()
        for level in levels
    }
    drawn = np.array(whiskers(position, INK) + whiskers(relax, INK))
    assert drawn == pytest.approx(np.array([interval(values) for values in of_people.values()]))
    largest = {name: values for (name, level), values in of_people.items() if name.startswith("PT") and level == 2.0}
    for k, line in enumerate(sorted(line for line in joined(position) if len(line) == 4)):
        assert line == pytest.approx(sorted([values[i] for values in largest.values()] for i in range(3))[k])
    smallest = [value for (name, level), values in of_people.items() if name == "RT0" for value in sorted(values)]
    assert points(relax, "o")[:3] == pytest.approx(smallest)
    printed = np.array(whiskers(position, PUBLISHED["color"]) + whiskers(relax, PUBLISHED["color"]))
    # Table 2.1 [cm].
    means = [6.20, 13.85, 10.40, 4.78, 9.14, 9.70, 19.38, 19.84, 20.76, 25.01]
    assert printed[:, 0] == pytest.approx(means)
    assert printed[0, 1] == pytest.approx(1.88)
    assert [label.get_text() for label in position.get_xticklabels()] == ["PT0", "PT2.5", "PT7.5", "PT22.5"]


def test_pulse_admittances_are_of_people_with_the_ratio_of_levels(invented):
    position, relax = pulse_figures.pulse_admittance(invented, {"PT0": 0.009, "PT7.5": 0.2}).axes
    expected = {
        (condition, level): interval(means_of(invented, condition, level, lambda t: 1e3 * t.displacement / t.force))
        for condition, levels in LEVELS.items()
        for level in levels
    }
    assert np.array(whiskers(position, INK) + whiskers(relax, INK)) == pytest.approx(np.array(list(expected.values())))
    ratios = [expected[name, 2.0][0] / expected[name, 1.0][0] for name in ("PT0", "PT7.5")]
    assert texts(position) == [
        f"× {ratios[0]:.2f} **",
        "× 1.3 published",
        f"× {ratios[1]:.2f}",
        "× 1.5 published",
    ]


def test_pulses_of_a_third_level_are_neither_beside_the_thesiss_ratio_nor_below_its_maximum(invented):
    more = {1.0: 2.0, 2.0: 3.0}
    people = tuple(
        replace(
            each,
            trials=tuple(
                trial._replace(pulse_level=more[abs(trial.pulse_level)]) if trial.condition == "PT0" else trial
                for trial in each.trials
            ),
        )
        for each in invented.people
    )
    conditions = [
        replace(each, pulse_levels=(2.0, 3.0)) if each.name == "PT0" else each for each in invented.protocol.conditions
    ]
    study = replace(invented, people=people, protocol=replace(invented.protocol, conditions=tuple(conditions)))
    figure = pulse_figures.pulse_admittance(study)
    told = texts(figure.axes[0])
    assert [text for text in told if "published" in text] == ["× 1.5 published"]  # of PT7.5
    assert len(told) == 3
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names[:4] == ["people, PT, level 1", "people, PT, level 2", "people, PT, level 3", "people, RT, level 1"]
    # Names of the thesis's levels are none of other conditions.
    own = pulse_figures.pulse_admittance(renamed(invented, factor=1.0)).legends[0].get_texts()
    assert [text.get_text() for text in own][:2] == ["people, PT, level 1", "people, PT, level 2"]
    of_thesis = pulse_figures.pulse_admittance(invented).legends[0].get_texts()
    assert [text.get_text() for text in of_thesis][:2] == ["people, PT, minimum level", "people, PT, maximum level"]


def test_predictions_leave_out_trials_without_one(invented):
    position, relax = pulse_figures.pulse_prediction(invented).axes
    expected = []
    for condition, levels in LEVELS.items():
        for level in levels if not condition.endswith("T0") else ():
            for model in ("linear", "skeletal"):
                shares = means_of(
                    invented, condition, level, lambda t, m=model: 100 * getattr(t, f"predicted_{m}") / t.displacement
                )
                expected.append(interval(shares))
    assert np.array(whiskers(position, INK) + whiskers(relax, INK)) == pytest.approx(np.array(expected))
    assert [label.get_text() for label in relax.get_xticklabels()] == ["RT2.5\nmin", "RT7.5\nmin", "RT22.5\nmin"]


def test_vaf_counts_trials_that_are_positive_along_both_axes(invented):
    panels = np.array(fit_figures.vaf(invented).axes).reshape(2, 2)
    for axis, row in enumerate(panels):
        expected = []
        for condition in (name for name in LEVELS if not name.endswith("T0")):
            for model in ("vaf_linear", "vaf_skeletal"):
                of_people = []
                for one in invented.people:
                    vaf = np.array([getattr(t, model) for t in one.trials if t.condition == condition])
                    if (positive := (vaf > 0).all(axis=1)).any():
                        of_people.append(vaf[positive][:, axis].mean())
                expected.append(interval(of_people) if len(of_people) > 1 else (of_people[0], math.nan))
        drawn = [heights for ax in row for heights in whiskers(ax, INK)]
        assert np.array(drawn) == pytest.approx(np.array(expected), nan_ok=True)
        printed = [mean for ax in row for mean, _ in whiskers(ax, PUBLISHED["color"])]
        assert printed == pytest.approx(
            [
                published.goodness_of_fit(f"VAF_{'xy'[axis]}", table, model=model, start=start, condition=condition)
                for table, model, start, condition in (
                    ("C.12", "3", "", "PT2.5"),
                    ("E.5", "3b", "vartheta_i5", "PT7.5"),
                    ("C.12", "3", "", "PT22.5"),
                    ("C.22", "1", "", "RT2.5"),
                    ("C.22", "1", "", "RT7.5"),
                    ("C.22", "1", "", "RT22.5"),
                )
            ]
        )


def of_people(study, condition, value, average=interval):
    """Mean over people and half its interval, of means over stable trials."""
    return average(
        [np.mean([value(fit) for fit in one.estimates[condition].fits if fit.stable]) for one in study.people]
    )


@pytest.fixture(scope="module")
def likely(invented):
    """The same people, with maximum likelihood estimates of all joint parameters."""
    rng = np.random.default_rng(2)

    def estimated(case):
        names = SPRINGS + (FEEDBACK if case.condition.task == "PT" else ())
        numbers = {
            kind: dict(zip(names, rng.uniform(1, 100, len(names)), strict=True)) for kind in ("values", "errors")
        }
        fit = SimpleNamespace(values=numbers["values"], standard_error=numbers["errors"])
        return replace(case, identification=SimpleNamespace(**{**vars(case.identification), "fit": fit}))

    return replace(invented, cases=tuple(map(estimated, invented.cases)))


@pytest.mark.slow(reason="draws figures")
def test_joint_parameters_are_by_both_estimators(likely):
    p = {"k_s": 0.002, "kv_se": 0.03, "kp_e": 0.3}
    panels = np.array(parameter_figures.joint_parameters(likely, "PT", p).axes).reshape(4, 2)
    places = [(joint, condition) for joint in ("s", "se", "e") for condition in ("PT2.5", "PT7.5", "PT22.5")]
    for row, quantity in zip(panels, ("b", "k", "kv", "kp"), strict=True):
        names = [(f"{quantity}_{joint}", condition) for joint, condition in places]
        estimates = [[case.identified.fit.values[name] for case in likely.of(condition)] for name, condition in names]
        assert np.array(whiskers(row[0], INK)) == pytest.approx(np.array(list(map(interval, estimates))))
        of_thesis = [of_people(likely, condition, lambda fit, name=name: fit.values[name]) for name, condition in names]
        assert np.array(whiskers(row[0], GREY)) == pytest.approx(np.array(of_thesis))
        # Standard errors have geometric means.
        for colour, errors in (
            (INK, [[case.identified.fit.standard_error[name] for case in likely.of(c)] for name, c in names]),
            (GREY, [of_people(likely, c, lambda fit, name=name: fit.sem[name], list) for name, c in names]),
        ):
            drawn = [mean for mean, _ in whiskers(row[1], colour)]
            assert drawn == pytest.approx([stats.gmean(values) for values in errors])
    # Tables E.3 and E.4, vartheta_i5 [Nm/rad].
    assert whiskers(panels[1, 0], PUBLISHED["color"])[0] == pytest.approx((161.4, 42.2))
    assert whiskers(panels[3, 1], PUBLISHED["color"])[0] == pytest.approx((284.9, 53.1))
    assert [texts(ax) for ax in panels[:, 0]] == [[], ["**"], ["*"], []]
    assert not any(texts(ax) for ax in panels[:, 1])


@pytest.mark.slow(reason="draws figures")
def test_one_joint_muscles_are_joints_less_the_two_joint_muscles(likely):
    figure = parameter_figures.muscle_parameters(likely, {"RT": {"k_e*": 0.001, "k_e": 0.02, "k_s": 0.02}})
    position, relax = np.array(figure.axes).reshape(4, 2).T
    for axes, conditions, quantities in (
        (position, ("PT2.5", "PT7.5", "PT22.5"), ("b", "k", "kv", "kp")),
        (relax, ("RT2.5", "RT7.5", "RT22.5"), ("b", "k")),
    ):
        for ax, q in zip(axes, quantities, strict=False):
            values = (
                lambda fit, q=q: fit.values[f"{q}_s"] - fit.values[f"{q}_se"],
                lambda fit, q=q: fit.values[f"{q}_se"],
                lambda fit, q=q: fit.values[f"{q}_e"] - fit.values[f"{q}_se"],
            )
            of_thesis = [of_people(likely, condition, value) for value in values for condition in conditions]
            assert np.array(whiskers(ax, GREY)) == pytest.approx(np.array(of_thesis))
            likeliest = [
                interval([value(case.identified.fit) for case in likely.of(condition)])
                for value in values
                for condition in conditions
            ]
            assert np.array(whiskers(ax, INK)) == pytest.approx(np.array(likeliest))
    assert [ax.get_visible() for ax in relax] == [True, True, False, False]
    # Table C.16, model 1: means of k_s and k_se are known, but not the SD of their difference.
    k_s, k_se = (published.estimate(name, "C.16", model="1") for name in ("k_s", "k_se"))
    shoulder, *_, two_joint = (whiskers(relax[1], PUBLISHED["color"])[k] for k in (0, 1, 2, 3))
    assert shoulder == pytest.approx((k_s.mean - k_se.mean, math.nan), nan_ok=True)
    assert two_joint == pytest.approx(tuple(k_se))
    assert texts(relax[1]) == ["**"]


def marked(ax):
    """Frequencies with one star and with two, and the height of every star."""
    by_star = [next(line for line in ax.lines if line.get_marker() == star["marker"]) for star in STARS]
    heights = {x: y for line in by_star for x, y in zip(*line.get_data(), strict=True)}
    return [line.get_xdata().tolist() for line in by_star], heights


def test_stars_stand_above_the_gains_that_differ(invented):
    differs = np.arange(18) < 6
    clearly = np.arange(18) < 2
    marks = {(0, 0): (differs, clearly), (0, 1): (np.zeros(18, bool), np.zeros(18, bool))}
    panels = {ax.get_title(): ax for ax in admittance_figures.admittance_by_amplitude(invented, "PT", marks).axes}
    gain_xx, gain_xy, gain_yy = (
        next(ax for title, ax in panels.items() if title.startswith(f"$H_{{{element}}}$"))
        for element in ("xx", "xy", "yy")
    )
    (one, two), heights = marked(gain_xx)
    assert one == FREQUENCY[2:6].tolist()
    assert two == FREQUENCY[:2].tolist()
    drawn = [line for line in gain_xx.lines if len(line.get_xdata()) == 18]
    assert len(drawn) == 3
    for k, frequency in enumerate(FREQUENCY[:6]):
        assert heights[frequency] > max(line.get_ydata()[k] for line in drawn)
    assert marked(gain_xy)[0] == [[], []]
    assert not any(line.get_marker() == star["marker"] for line in gain_yy.lines for star in STARS)


def test_linear_scale_ends_at_10_hz_and_shows_the_published_factors(invented):
    figure = admittance_figures.gain_linear_scale(invented, {"RT": {(1, 1): (FREQUENCY < 1.0, FREQUENCY < 0.0)}})
    position, relax = np.array(figure.axes).reshape(2, 4)
    shown = FREQUENCY <= 10.0
    for row, task, factor in ((position, "PT", 1 / 1.5), (relax, "RT", 3.8)):
        for ax, (i, j) in zip(row, ((0, 0), (1, 1), (0, 1), (1, 0)), strict=True):
            for line, amplitude in zip(ax.lines, ("2.5", "7.5", "22.5"), strict=False):
                gains = [np.abs(case.identified.spectra.arm[shown, i, j]) for case in invented.of(task + amplitude)]
                assert line.get_xdata() == pytest.approx(FREQUENCY[shown])
                assert line.get_ydata() == pytest.approx(1e3 * np.prod(gains, axis=0) ** (1 / 3))
            expected = [line for line in ax.lines if line.get_color() == PUBLISHED["color"]]
            if i == j:
                assert expected[0].get_ydata() == pytest.approx(factor * ax.lines[0].get_ydata()[:2])
            else:
                assert not expected
    assert marked(relax[1])[0][0] == FREQUENCY[FREQUENCY < 1.0].tolist()


def test_penalty_is_drawn_with_the_poles_of_all_fits(invented):
    curve, poles = fit_figures.penalty(invented).axes
    x, y = curve.lines[0].get_data()
    # p = 10 (1e10)^(Re + 0.5) + 1 (eq. C.7).
    assert y == pytest.approx(10.0 * 1e10 ** (x + 0.5) + 1.0)
    for line, task in zip(poles.lines, ("PT", "RT"), strict=True):
        assert line.get_color() == COLOURS[task]
        assert sorted(line.get_xdata()) == 18 * [-1.0] + 9 * [0.1]


def pulsed(subject, condition, angles=None, peak=60.0, onset=1.0, duration=3.0):
    """Trials with a pulse in both directions, as the linear arm moves, or as it is told to."""
    directions = (200.0, 20.0)
    n = round(duration * RATE)
    force = np.array(
        [Pulse(peak=peak, direction_deg=d, onset=onset, duration=duration).sample(RATE, n) for d in directions]
    )
    moved = simulate_linear(subject, Environment(), force, RATE).displacement
    signals = {"perturbation": force, "force": force, "displacement": moved}
    posture = np.array(subject.posture)
    if angles is not None:
        reached = hand_position(posture + angles, subject.l_h, subject.l_f)
        signals["displacement"] = reached - hand_position(posture, subject.l_h, subject.l_f)
        signals["joint_angle"] = posture + angles
    trials = {
        "subject": ["S01"] * 2,
        "task": [subject.task] * 2,
        "condition": [condition] * 2,
        "repetition": [0, 0],
        "pulse_level": [2.0, 2.0] if subject.task == "PT" else [1.0, 1.0],
        "pulse_direction": directions,
        "pulse_onset": [onset] * 2,
        "l_h": [subject.l_h] * 2,
        "l_f": [subject.l_f] * 2,
        "theta_s_deg": [subject.theta_s_deg] * 2,
        "theta_e_deg": [subject.theta_e_deg] * 2,
        "limit_time": [math.nan] * 2,
    }
    return make_recording(signals, trials, RATE)


def estimate_of(subject, stable=(True, True)):
    rng = np.random.default_rng(0)
    fits = tuple(replace(fitted(SPRINGS, rng, one), arm=subject) for one in stable)
    return ThesisEstimate(
        structure="1", subjects=("S01",) * len(fits), environment=Environment(), fits=fits, vaf=np.zeros((len(fits), 2))
    )


@pytest.mark.parametrize(
    ("subject", "condition", "level", "n_dots"), [(POSITION, "PT7.5", 2, 7), (RELAX, "RT7.5", 1, 11)]
)
def test_paths_have_dots_every_50_or_100_ms(subject, condition, level, n_dots):
    step = {"PT": 10, "RT": 20}[subject.task]
    recording = pulsed(subject, condition, peak=20.0)
    (ax,) = trajectory_figures.trajectories(recording, estimate_of(subject), float(level)).axes
    dots = [line for line in ax.lines if line.get_marker() == "o"]
    assert len(dots) == 6  # three lines, two directions
    for trial, first in ((1, 0), (0, 3)):  # 20 degrees first
        recorded, linear, skeletal = (np.transpose(line.get_data()) for line in dots[first : first + 3])
        samples = 200 + step * np.arange(n_dots)
        assert recorded == pytest.approx(100 * recording["displacement"].values[trial, samples])
        # The recording is what this very arm does when linear; the skeletal model differs little as it moves little.
        assert linear == pytest.approx(recorded, abs=1e-9)
        assert np.abs(skeletal - recorded).max() < 0.1 * np.abs(recorded).max()
        assert dots[first + 2].get_color() == SKELETAL["color"]
    tips = [tuple(text.xy) for text in ax.texts]
    farthest = recording["displacement"].values[1, 200 : 200 + step * (n_dots - 1) + 1]
    peak = farthest[np.argmax(np.hypot(*farthest.T))]
    assert tips[0] == pytest.approx(tuple(100 * peak))
    along = np.array(tips[-2:])
    assert np.degrees(np.arctan2(along[:, 1], along[:, 0])) == pytest.approx([20.0, -160.0])


def test_paths_of_unstable_fits_are_not_predicted():
    recording = pulsed(POSITION, "PT7.5")
    estimate = estimate_of(POSITION, stable=(True, False))
    found = trajectory_figures.responses(recording, estimate, 2.0)
    assert {direction: list(paths) for direction, paths in found.items()} == {
        20.0: ["recorded"],
        200.0: ["recorded", "linear", "skeletal"],
    }
    # The same two pulses again, of which the second 20 degrees is predicted: it goes first.
    again = recording.isel(trial=[0, 1, 0, 1])
    again["displacement"] = again["displacement"] * np.array([1, 1, 2, 2])[:, None, None]
    found = trajectory_figures.responses(again, estimate_of(POSITION, (True, False, True, True)), 2.0)
    assert [list(paths) for paths in found.values()] == [["recorded", "linear", "skeletal"]] * 2
    first, second = (paths["recorded"] for paths in found.values())
    assert first == pytest.approx(2 * recording["displacement"].values[1, 200:261])
    assert second == pytest.approx(recording["displacement"].values[0, 200:261])
    assert trajectory_figures.responses(recording, None, 1.0) == {}


def test_joint_rotations_and_their_peaks():
    since = np.arange(600) / RATE - 1.0
    bump = {
        delay: np.where((since > 0) & (since < 2 * delay), np.sin(np.pi * since / (2 * delay)), 0)
        for delay in (0.1, 0.2)
    }
    angles = np.stack([0.1 * bump[0.2], -0.3 * bump[0.1]], axis=-1)
    recording = pulsed(POSITION, "PT0", angles=np.stack([angles, -angles]))
    right, left = trajectory_figures.joint_rotations(recording).axes
    for ax, sign in ((left, 1), (right, -1)):
        drawn = [line for line in ax.lines if line.get_color() != TRUE["color"] and len(line.get_xdata()) > 2]
        assert drawn[0].get_xdata() == pytest.approx(1e3 * since[190:301])
        for line, joint in zip(drawn, range(2), strict=True):
            assert line.get_ydata() == pytest.approx(sign * np.degrees(angles[190:301, joint]), abs=1e-9)
        assert texts(ax) == ["shoulder 200 ms", "elbow 100 ms"]
        # Table F.5, PT0, maximum level [degree].
        printed = {round(abs(mean), 1): round(sd, 1) for mean, sd in whiskers(ax, PUBLISHED["color"])}
        assert printed == {11.7: 3.3, 17.2: 5.0}


def test_peaks_of_joints_are_those_in_the_window_of_the_table():
    since = np.arange(600) / RATE - 1.0
    late = np.where((since > 0) & (since < 0.8), np.sin(np.pi * since / 0.8), 0)
    angles = np.stack([0.1 * late, -0.3 * late], axis=-1)
    for subject, condition, peak in ((POSITION, "PT0", 300), (RELAX, "RT0", 400)):
        recording = pulsed(subject, condition, angles=np.stack([angles, -angles]))
        for ax in trajectory_figures.joint_rotations(recording).axes:
            assert texts(ax) == [f"shoulder {peak} ms", f"elbow {peak} ms"]


def test_a_perturbation_without_a_whole_period_has_no_density():
    recording = pulsed(POSITION, "PT7.5")
    noise = np.random.default_rng(0).standard_normal(recording["perturbation"].shape)
    recording = recording.assign(perturbation=recording["perturbation"].copy(data=noise))
    condition = SimpleNamespace(name="PT7.5")
    for onset, titles in ((math.nan, ["one trial of PT7.5"]), (1.0, ["one trial of PT7.5", "fade (grey) and pulse"])):
        trials = recording.assign_coords(pulse_onset=("trial", [onset, onset]))
        axes = perturbation_figures.perturbation(
            SimpleNamespace(trials=lambda trials=trials: trials, condition=condition)
        ).axes
        assert [ax.get_title() for ax in axes if ax.get_title()] == titles


def test_pulse_is_drawn_along_its_direction():
    whole, zoom = perturbation_figures.pulse_signal(pulsed(POSITION, "PT0").isel(trial=[0])).axes
    time, force = whole.lines[0].get_data()
    assert time[-1] == pytest.approx(3.0 - 1 / RATE)
    assert force.max() == pytest.approx(60.0)
    since, force = zoom.lines[0].get_data()
    inside = (since >= 0) & (since <= 80)
    assert force[inside] == pytest.approx(60.0 * np.sin(np.pi * since[inside] / 80.0), abs=1e-9)
    assert force[~inside] == pytest.approx(0.0)
    assert texts(zoom) == ["80 ms"]


def test_a_pulse_of_a_laboratory_is_as_long_as_it_was():
    trial = pulsed(POSITION, "PT0").isel(trial=[0])
    since = trial["time"].values - float(trial["pulse_onset"].values[0])
    rectangular = np.where((since > -1e-6) & (since < 0.1999), -15.0, 0.0)[None, :, None] * [1.0, 0.0]
    trial = trial.assign(perturbation=trial["perturbation"].copy(data=rectangular))
    _, zoom = perturbation_figures.pulse_signal(trial, is_known=False).axes
    assert texts(zoom) == ["200 ms"]
    assert zoom.get_title() == f"sampled at {RATE:g} Hz"
    assert zoom.get_xlim()[1] > 200.0
    noise = 0.05 * np.random.default_rng(0).standard_normal(rectangular.shape)
    assert pulse_width(trial.assign(perturbation=trial["perturbation"] + noise)) == pytest.approx(0.2, abs=0.011)
    assert math.isnan(pulse_width(trial.assign(perturbation=0.0 * trial["perturbation"])))


def test_directions_are_drawn_from_the_mean_posture():
    straight = replace(POSITION, theta_s_deg=10.0, theta_e_deg=90.0)
    bent = replace(POSITION, theta_s_deg=30.0, theta_e_deg=70.0)
    figure = perturbation_figures.pulse_directions([straight, bent], (20.0, 200.0))
    (ax,) = figure.axes
    hand = np.array([POSITION.l_h * math.cos(math.radians(20)) + POSITION.l_f * math.cos(math.radians(100)), 0])
    hand[1] = POSITION.l_h * math.sin(math.radians(20)) + POSITION.l_f * math.sin(math.radians(100))
    arrows = [text for text in ax.texts if text.arrow_patch is not None]
    assert [text.xyann for text in arrows] == [pytest.approx(tuple(hand))] * 2
    assert [math.degrees(math.atan2(*(np.array(a.xy) - hand)[::-1])) for a in arrows] == pytest.approx([20.0, -160.0])
    said = " ".join(texts(ax))
    assert "= 20.0°" in said
    assert "= 80.0°" in said
    assert "20°, extends the elbow" in said
    assert "200°, flexes the elbow" in said


def test_labels_of_directions_do_not_stand_on_the_axis():
    (ax,) = perturbation_figures.pulse_directions([POSITION], (0.0, 90.0, 180.0)).axes
    labels = {text.get_text().split("°")[0]: text for text in ax.texts if "the elbow" in text.get_text()}
    assert {name: label.get_va() for name, label in labels.items()} == {"0": "bottom", "90": "center", "180": "bottom"}


@pytest.mark.parametrize("direction", [20.0, 110.0, 200.0, 290.0])
def test_an_arrow_of_one_direction_lies_inside(direction):
    figure = perturbation_figures.pulse_directions([POSITION], (direction,))
    (ax,) = figure.axes
    figure.draw_without_rendering()
    (tip,) = (text.xy for text in ax.texts if text.arrow_patch is not None)
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    assert left < tip[0] < right
    assert bottom < tip[1] < top


def test_stills_show_the_recorded_pose_and_the_path_so_far(monkeypatch):
    shown = []

    def fake(model, qpos, camera, *, width, height):
        shown.extend(qpos)
        return np.zeros((len(qpos), height, width, 3), dtype=np.uint8)

    monkeypatch.setattr(rig_figures, "render", fake)
    someone = average_person()
    angles = np.zeros((2, 600, 2))
    angles[:, 200:] = 0.002 * np.arange(400)[:, None] * [1.0, -1.0]
    pulses = [pulsed(someone.subjects[task], f"{task}0", angles=angles).isel(trial=[0]) for task in ("PT", "RT")]
    figure = rig_figures.stills(someone, Environment(), pulses)
    panels = np.array(figure.axes).reshape(2, 5)
    assert [ax.get_title() for ax in panels[0]] == ["onset", "+ 50 ms", "+ 100 ms", "+ 200 ms", "+ 300 ms"]
    assert [ax.get_title() for ax in panels[1]] == ["onset", "+ 100 ms", "+ 300 ms", "+ 600 ms", "+ 1000 ms"]
    samples = [200, 210, 220, 240, 260, 200, 220, 260, 320, 400]
    for k, (ax, qpos, sample) in enumerate(zip(panels.flat, shown, samples, strict=True)):
        trial = pulses[k // 5]
        expected = [*trial["joint_angle"].values[0, sample], *trial["displacement"].values[0, sample]]
        assert qpos == pytest.approx(np.array(expected))
        path = np.transpose(ax.lines[0].get_data())
        assert len(path) == sample - 200 + 1
        subject = someone.subjects["PT"]
        assert path[-1] == pytest.approx(hand_position(qpos[:2], subject.l_h, subject.l_f))


NAMES = {
    *("pulse_directions", "perturbation", "findings", "admittance_by_task", "gain_linear_scale", "coherence"),
    *(f"{n}_{task}" for n in ("admittance_by_amplitude", "admittance", "fit", "prediction") for task in ("PT", "RT")),
    *("vaf", "penalty", "joint_parameters_PT", "joint_parameters_RT", "muscle_parameters"),
    *("peak_displacement", "pulse_admittance", "pulse_prediction"),
}


@pytest.fixture
def recorded(invented, tmp_path):
    """The same people, of whom the first has a recording of pulses alone."""
    since = np.arange(600) / RATE
    angles = 0.01 * np.sin(2 * np.pi * since)[:, None] * np.ones((2, 1, 2))
    save_recording(pulsed(POSITION, "PT0", angles=angles), tmp_path / "S01.nc")
    cases = tuple(replace(case, recording=tmp_path / "S01.nc") for case in invented.cases)
    return replace(invented, cases=cases, recordings={"S01": tmp_path / "S01.nc"})


def test_one_person_has_whole_marks_and_no_interval_in_the_legend(invented):
    for names, label in (({"S01"}, "mean over people"), ({"S01", "S02"}, "mean over people, 95 % interval")):
        people = tuple(person for person in invented.people if person.name in names)
        figure = pulse_figures.peak_displacement(replace(invented, people=people))
        assert label in [text.get_text() for text in figure.legends[0].get_texts()]
    ax = new_figure(3.0).subplots()
    draw_people(ax, {"PT": {"PT2.5": {"S01": 20.0}, "PT7.5": {"S01": 20.1}}}, logarithmic=False)
    with_margins(ax)
    low, high = ax.get_ylim()
    assert high - 20.1 > 0.03 * (high - low)
    assert low < 0.0


@pytest.mark.slow(reason="draws figures")
@pytest.mark.parametrize(
    "names",
    [
        (
            "kurz",
            "lang mit einem sehr langen Namen der Bedingung",
            "lang mit einem sehr langen Namen der Bedingung zwei",
        ),
        ("HandhaltungMitGrosserLast", "HandhaltungMitKleinerLast", "HandhaltungOhneLast"),
        ("hold leise", "hold mittel", "hold groß", "ruhe", "lösen", "hold leise\nmit Puls"),
    ],
)
def test_names_of_conditions_do_not_cover_one_another(names):
    for width in (1, 3):
        figure = new_figure(2.0)
        ax = figure.subplots(1, width, squeeze=False)[0, 0]
        draw_people(ax, {"PT": {name: {"A": 1.0} for name in names}})
        ax.tick_params(axis="x", labelsize=6.5)
        fit_labels(ax)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        labels = ax.get_xticklabels()
        shown = [label.get_text() for label in labels]
        assert [re.sub(r"\s", "", name) for name in names] == [re.sub(r"\s", "", text) for text in shown]
        if not labels[0].get_rotation():
            boxes = [label.get_window_extent(canvas.get_renderer()) for label in labels]
            assert all(left.x1 <= right.x0 for left, right in itertools.pairwise(boxes)), shown


def test_names_of_the_thesis_stand_as_they_are():
    figure = new_figure(2.0)
    ax = figure.subplots(1, 3)[0]
    names = ["PT2.5", "PT7.5", "PT22.5", "RT2.5", "RT7.5", "RT22.5"]
    draw_people(ax, {"PT": {name: {"A": 1.0} for name in names}})
    fit_labels(ax)
    assert [label.get_text() for label in ax.get_xticklabels()] == names


@pytest.mark.slow(reason="draws figures")
def test_registry_holds_what_the_study_allows(recorded):
    everything = drawings(recorded, NOTHING).keys()
    assert everything == NAMES | {"pulse_signal", "joint_rotations"}
    cohort = (replace(average_person(), name="S01"),)
    known = replace(recorded, cohort=cohort)
    assert drawings(known, NOTHING).keys() == NAMES | {"pulse_signal", "joint_rotations", "stills", "rig"}
    of_pulses = {"pulse_signal", "joint_rotations", "stills", "rig"}
    assert drawings(replace(known, cases=(), people=()), NOTHING).keys() == of_pulses
    unpulsed = tuple(replace(c, pulse_levels=()) for c in recorded.protocol.conditions if c.has_multisine)
    without = replace(recorded, protocol=replace(recorded.protocol, conditions=unpulsed))
    assert "pulse_directions" not in drawings(without, NOTHING)
    nobody = replace(recorded, cases=(), people=(), recordings={})
    assert drawings(nobody, NOTHING) == {}
    without_people = drawings(replace(recorded, people=()), NOTHING)
    assert not without_people.keys() & {"vaf", "penalty", "peak_displacement", "joint_parameters_PT"}
    # The figure of the VAF shows trials that are positive along both axes, and there is none.
    poor = [replace(p, trials=tuple(t._replace(vaf_linear=(40.0, -3.0)) for t in p.trials)) for p in recorded.people]
    assert drawings(replace(recorded, people=tuple(poor)), NOTHING).keys() == everything - {"vaf"}


@pytest.mark.slow(reason="draws figures")
def test_conditions_of_ones_own_have_the_same_figures_but_for_what_is_printed(recorded):
    own = renamed(replace(recorded, recordings={}))
    drawn = drawings(own, NOTHING)
    assert drawn.keys() == drawings(replace(recorded, recordings={}), NOTHING).keys()
    for name in ("peak_displacement", "pulse_admittance", "pulse_prediction", "vaf"):
        labels = [label.get_text() for ax in drawn[name]().axes for label in ax.get_xticklabels()]
        assert any(label.startswith("own PT7.5") for label in labels), name
    excess, of_thesis = excess_rows(own), excess_rows(recorded)
    assert [row["mean"] for row in excess] == [row["mean"] for row in of_thesis]
    assert [(row["condition"], row["level"]) for row in excess[:3]] == [
        ("own PT2.5", "3"),
        ("own PT7.5", "1.5"),
        ("own PT7.5", "3"),
    ]


@pytest.mark.slow(reason="draws figures")
def test_registry_draws_one_person_in_one_task(recorded):
    first = recorded.people[0]
    alone = replace(
        first,
        trials=tuple(trial for trial in first.trials if trial.condition == "RT7.5")[:1],
        estimates={"RT7.5": first.estimates["RT7.5"]},
    )
    relaxed = Protocol(conditions=(recorded.protocol.condition("RT7.5"),))
    lonely = replace(recorded, protocol=relaxed, cases=(), people=(alone,), recordings={})
    drawn = drawings(lonely, NOTHING)
    assert {"peak_displacement", "pulse_admittance", "joint_parameters_RT", "muscle_parameters"} <= drawn.keys()
    for name, draw in drawn.items():
        assert len(draw().axes) <= 4, name


@pytest.mark.slow(reason="draws figures")
def test_registry_marks_significant_effects(recorded):
    p = np.full((18, 2, 2), 0.5)
    p[:5] = 0.03
    p[:2] = 0.001
    effects = replace(
        NOTHING,
        admittance={"PT": AdmittanceEffect(FREQUENCY, p, p < 0.05)},
        parameters={("RT", "k_s"): 0.001, ("PT", "k_e"): 0.04, ("RT", "k_e*"): 0.02},
        levels={"PT0": 0.001},
    )
    drawn = drawings(recorded, effects)
    gain = drawn["admittance_by_amplitude_PT"]().axes[0]
    assert marked(gain)[0] == [FREQUENCY[2:5].tolist(), FREQUENCY[:2].tolist()]
    relax = np.array(drawn["joint_parameters_RT"]().axes).reshape(2, 2)
    assert [texts(ax) for ax in relax[:, 0]] == [[], ["**"]]
    muscles = np.array(drawn["muscle_parameters"]().axes).reshape(4, 2)
    assert [texts(ax) for ax in muscles[:2].flat] == [[], [], [], ["*"]]
    assert texts(drawn["pulse_admittance"]().axes[0])[0].endswith("**")
