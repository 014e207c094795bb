"""What the analysis of EMG reaches: `python -m benchmarks.emg [PEOPLE [SEED [PART]]]`; some 40 s of a core per person.

PART is `linear_people`, a half of it all; or of fits alone `linear_laboratory`, of people whose arms keep the geometry
of their posture, or `without_fast_part`, of people whose remnant is slow.

People are drawn as in a study and do the thesis's protocol with a maximal contraction, under the published forces, with
all noise. Their EMG shows background and reflexes; the last lines are of the same people whose effort (remnant and slow
corrections) shows as well. Each line is a quantity, its target if it has one, and what was measured. Lines of NeuroKit2
need it installed, and are left out otherwise.
"""

import importlib
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import pandas as pd
import xarray as xr
from scipy import signal, stats

from armperturb.analysis.emg.activity import Activity, activity
from armperturb.analysis.emg.envelope import Envelopes, envelopes
from armperturb.analysis.emg.onset import onsets
from armperturb.analysis.emg.outputs import reflex_outputs
from armperturb.analysis.emg.reflex import reflexes
from armperturb.analysis.emg.whitening import band_power
from armperturb.analysis.fit.emg_likelihood import ElectromechanicalDelay, EmgLikelihood
from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.joint_likelihood import JointLikelihood
from armperturb.analysis.fit.maximum_likelihood import Estimate, estimate
from armperturb.analysis.fit.structures import structure_of
from armperturb.analysis.trials import ConditionTrials, trials_by_condition
from armperturb.cohort import Person, draw_cohort
from armperturb.envs.lab.emg import HIGHPASS_ORDER, Emg, _filters
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.recording import ACTIONS, Action, HighPass, make_recording
from armperturb.recording_files import load_recording, save_recording
from armperturb.study.protocol import THESIS, Condition, Protocol
from armperturb.subject import POSITION, RELAX, Subject

PEOPLE, SEED = 10, 5
MAXIMAL = Condition(name="MVC", task="PT", contraction=1.0)
PROTOCOL = replace(THESIS, forces="published", conditions=(*THESIS.conditions, MAXIMAL))
HELD = ("PT0", "PT2.5", "PT7.5", "PT22.5")
MOVED = ("PT2.5", "PT7.5", "PT22.5")
HOLDING = replace(PROTOCOL, conditions=(*(THESIS.condition(name) for name in HELD), MAXIMAL), pulse_unit_condition="")
MOVING = replace(HOLDING, conditions=tuple(each for each in HOLDING.conditions if each.name in (*MOVED, "MVC")))
SLIGHT = 0.05
"""Co-contraction that has to be noticed [-]."""


def recorded(
    person: Person,
    number: int,
    protocol: Protocol = PROTOCOL,
    seed: int = SEED,
    *,
    effort: float = 0.0,
    linear: bool = False,
    fast: bool = True,
) -> tuple[xr.Dataset, np.ndarray]:
    """A person's trials, and the true index of co-contraction of each, (trial, joint).

    Trials that leave the workspace before any pulse are left out.
    """
    indices = []
    original = Emg.read

    def read(emg: Emg, subject: Subject, excitation: np.ndarray, rate: float, *others: Any) -> np.ndarray:
        contraction = others[1] if len(others) > 1 else None
        active = emg.activation(subject, excitation, rate, contraction=contraction)
        groups = {
            (joint, sign): active[[joint in each.joints and each.sign == sign for each in ACTIONS.values()]].mean(
                axis=0
            )
            for joint in "se"
            for sign in (1, -1)
        }
        indices.append([float(np.minimum(groups[joint, 1], groups[joint, -1]).mean()) for joint in "se"])
        return original(emg, subject, excitation, rate, *others)

    trials = protocol.trials(person, protocol.given_forces(), seed, number)
    if not fast:
        trials = [replace(each, noise=each.noise and each.noise.without_fast_part()) for each in trials]
    how: dict[str, Any] = {"linear": True} if linear else {"engine": "compiled", "timestep": 2.5e-3}
    with mock.patch.object(Emg, "read", read):
        instruments = Instruments(marker_noise=None, emg=Emg(effort=effort))
        recording = run_experiment(trials, instruments=instruments, n_threads=1, **how)
    limit, onset = (recording[name].values for name in ("limit_time", "pulse_onset"))
    inside = np.flatnonzero(~(limit < np.where(np.isnan(onset), np.inf, onset)))
    return recording.isel(trial=inside), np.array(indices)[inside]


def slightly_active(person: Person) -> Person:
    """The person whose relaxed muscles co-contract slightly."""
    share = SLIGHT / Emg().position_activation
    stiffer = {
        f: getattr(RELAX, f) + share * (getattr(POSITION, f) - getattr(RELAX, f)) for f in ("k_s", "k_se", "k_e")
    }
    return replace(person, subjects={**person.subjects, "RT": replace(person.subjects["RT"], muscle=None, **stiffer)})


class Line(NamedTuple):
    """A line of the table."""

    quantity: str
    target: str
    measured: str


def optional_neurokit() -> Any:
    """NeuroKit2; None where it is not installed."""
    try:
        return importlib.import_module("neurokit2")
    except ImportError:
        return None


def known_envelopes() -> Iterator[Line]:
    """Modulated noise of known shape, and what NeuroKit2 makes of it."""
    rate, n, n_trials, window = 2000.0, 40_000, 40, 0.1
    at = np.arange(n) / rate
    shape = 0.3 * (1.0 + 0.5 * np.sin(2 * np.pi * 0.5 * at))
    colour, amplifier, _ = (np.asarray(each, dtype=float) for each in _filters(rate, 20.0))
    white = np.random.default_rng(0).standard_normal((n_trials, 2, n))
    volts = signal.sosfilt(amplifier, shape * signal.sosfilt(colour, white))
    volts[:, 1] += 0.2 * volts[:, 0]
    volts += 2e-3 * np.random.default_rng(1).standard_normal(volts.shape)
    recording = one_muscle(volts.swapaxes(1, 2), rate)
    steps = round(window * rate)
    true = np.sqrt(np.mean(shape.reshape(-1, steps) ** 2, axis=1))[1:-1]

    def scatter(amplitude: np.ndarray) -> float:
        relative = amplitude[:, 1:-1] / true
        return float((relative / relative.mean(axis=0)).var(axis=0, ddof=1).mean())

    frequency = np.linspace(0.0, rate / 2, 2001)
    band = float(np.trapezoid(band_power(frequency, 20.0, 900.0), frequency))
    bound = 1.0 / (4.0 * band * window)
    for whiten in (True, False):
        result = envelopes(recording, whiten=whiten)
        power = result.power[..., 0].reshape(n_trials, -1, round(window * 200)).mean(axis=2)
        ratio = scatter(result.amplitude_of(power[..., None])[..., 0]) / bound
        target = "0.85 to 1.15" if whiten else ""
        yield Line(f"variance over the bound, {'' if whiten else 'not '}whitened", target, f"{ratio:.2f}")
    yield Line("cross-talk of 20 %", "named", "; ".join(map(str, envelopes(recording).crosstalk)))
    neurokit = optional_neurokit()
    if neurokit is None:
        return
    amplitudes = []
    start = time.process_time()
    for trial in volts[:, 0]:
        cleaned = neurokit.emg_clean(trial, sampling_rate=rate)
        amplitude = np.asarray(neurokit.emg_amplitude(cleaned))
        amplitudes.append(np.sqrt(np.mean(amplitude.reshape(-1, steps) ** 2, axis=1)))
    spent = time.process_time() - start
    yield Line(
        "variance over the bound, NeuroKit2", "", f"{scatter(np.array(amplitudes)) / bound:.2f}, {spent:.1f} CPU s"
    )
    start = time.process_time()
    envelopes(recording.isel(muscle=[0]))
    yield Line("the same channel here", "", f"{time.process_time() - start:.1f} CPU s")


def lateness() -> Iterator[Line]:
    """How much later than the drive of a muscle an envelope is, for what an amplifier's high-pass does to it."""
    rate, n, n_trials, modulated = 2000.0, 40_000, 30, 20.0
    shape = 0.3 * (1.0 + 0.6 * np.sin(2 * np.pi * modulated * np.arange(n) / rate))
    colour, amplifier, _ = (np.asarray(each, dtype=float) for each in _filters(rate, 20.0))
    driven = shape * signal.sosfilt(colour, np.random.default_rng(0).standard_normal((n_trials, 1, n)))
    electrode = 2e-3 * np.random.default_rng(1).standard_normal(driven.shape)
    passed, known = signal.sosfilt(amplifier, driven), HighPass(20.0, HIGHPASS_ORDER)
    for name, volts, said in (
        ("without", driven, None), ("with", passed, None), ("with, which is known,", passed, known)
    ):  # fmt: skip
        recording = one_muscle((volts + electrode).swapaxes(1, 2), rate, said)
        amplitude = envelopes(recording).amplitude[:, 200:-200, 0]
        phase = 2 * np.pi * modulated * np.arange(200, 200 + amplitude.shape[1]) / 200.0
        answers = (amplitude * np.exp(-1j * phase)).mean(axis=1) / np.mean(np.sin(phase) * np.exp(-1j * phase))
        late = -np.angle(answers) / (2 * np.pi * modulated)
        said = f"{1e3 * late.mean():+.2f} ms, standard error {1e3 * late.std() / np.sqrt(n_trials):.2f} ms"
        yield Line(f"delay of an envelope, {name} the amplifier's high-pass", "", said)


def one_muscle(volts: np.ndarray, rate: float, highpass: HighPass | None = None) -> xr.Dataset:
    """A recording of EMG of a still arm, (trial, time, muscle) in volts."""
    still, n_trials = np.zeros((len(volts), volts.shape[1] // 10, 2)), len(volts)
    labels = {name: [np.nan] * n_trials for name in ("pulse_direction", "pulse_onset", "limit_time", "l_h", "l_f")}
    labels |= {name: [np.nan] * n_trials for name in ("theta_s_deg", "theta_e_deg")}
    labels |= {"subject": ["A"] * n_trials, "task": ["RT"] * n_trials, "condition": ["RT"] * n_trials}
    labels |= {"repetition": list(range(n_trials)), "pulse_level": [0.0] * n_trials}
    muscles = {"flexor": Action("s", 1), "extensor": Action("s", -1)}
    return make_recording(
        {"perturbation": still, "force": still, "displacement": still, "emg": volts},
        labels,
        200.0,
        emg_rate=rate,
        emg_highpass=highpass,
        muscles=dict(list(muscles.items())[: volts.shape[2]]),
    )


def _analysed(recording: xr.Dataset) -> tuple[Activity, list[pd.DataFrame], pd.DataFrame]:
    """A person's activity, responses to rotation by condition, and latencies."""
    conditions, amplitudes = trials_by_condition(recording, is_checked=True), envelopes(recording)
    held = [conditions[name] for name in HELD if name in conditions]  # all trials of one may leave the workspace
    moved = [trials for trials in held if trials.label in MOVED]
    return (
        activity(amplitudes),
        [reflexes(trials, amplitudes).responses for trials in moved],
        onsets(held, amplitudes).latencies,
    )


def _analyse_files(paths: Sequence[Path]) -> tuple[float, float]:
    """When the analysis of recordings began and ended [s]."""
    recordings = [load_recording(path) for path in paths]
    _analysed(recordings[0])  # what is imported or compiled does not count
    start = time.monotonic()
    for recording in recordings:
        _analysed(recording)
    return start, time.monotonic()


def _time_on_two_cores(paths: Sequence[Path]) -> float:
    """Time by the clock in which two processes analyse recordings [s]."""
    shares = [paths[first::2] for first in range(min(2, len(paths)))]
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        starts, ends = zip(*pool.map(_analyse_files, shares), strict=True)
    return float(max(ends) - min(starts))


def nonlinear_people(n: int, seed: int) -> Iterator[Line]:
    """Relaxation, co-contraction, reflex responses and latencies of nonlinear people in the thesis's protocol."""
    spent, relaxed, slight, of_conditions = 0.0, [], [], []
    responses, by_phase, latencies = Intervals(), [], Intervals()
    only_relaxed = replace(PROTOCOL, conditions=(THESIS.condition("RT7.5"), MAXIMAL), pulse_unit_condition="")
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{number}.nc" for number in range(n)]
        for number, person in enumerate(draw_cohort(n, seed)):
            recording, indices = recorded(person, number, seed=seed)
            save_recording(recording, paths[number])
            start = time.process_time()
            result, answers, of_pulses = _analysed(recording)
            spent += time.process_time() - start
            latencies.add(of_pulses, "latency_s", person)
            for answer in answers:
                responses.add(answer, "delay_s", person)
                by_phase += list(answer["delay_by_phase_s"] - person.subjects["PT"].Td_s)
            relaxed += [bool(result.active_muscles(name)) for name in ("RT0", "RT2.5", "RT7.5", "RT22.5")]
            of_conditions.append(_indices(result, recording, indices))
            recording, _ = recorded(slightly_active(person), number, only_relaxed, seed)
            slight.append(bool(activity(envelopes(recording)).active_muscles("RT7.5")))
        some = paths[:PEOPLE]  # as many as fit into memory together
        by_clock = _time_on_two_cores(some) / len(some)
    yield Line("relaxed people called active", "at most 5 %", f"{sum(relaxed)} of {len(relaxed)} conditions")
    yield Line(f"people with {SLIGHT:.0%} co-contraction noticed", "at least 90 %", f"{sum(slight)} of {len(slight)}")
    correlation = min(stats.spearmanr(*each.T).statistic for each in of_conditions)
    yield Line("rank correlation of co-contraction with the truth, least", "0.95", f"{correlation:.3f}")
    error = np.concatenate([each[:, 0] / each[:, 1] - 1.0 for each in of_conditions])
    yield Line("error of the index", "10 %", f"mean {error.mean():+.1%}, largest {np.abs(error).max():.1%}")
    yield from responses.lines("delay from rotation to EMG")
    phase = f"bias {1e3 * np.mean(by_phase):+.2f} ms, SD {1e3 * np.std(by_phase):.2f} ms"
    yield Line("the same by phase", "", phase)
    yield from latencies.lines("latency of answers to pulses, nonlinear people")
    measured = f"{10.0 * by_clock:.1f} s by the clock on two cores, {10.0 * spent / n:.1f} s of one"
    yield Line("ten people, all of these", "20 s", measured)


def linear_people(n: int, seed: int) -> Iterator[Line]:
    """Latencies of linear people, also by NeuroKit2, and reflexes that are identified with EMG and without."""
    latencies, fits, showing, neurokit = Intervals(), Fits(), Fits(), optional_neurokit()
    thresholds, here = [], []
    for number, person in enumerate(draw_cohort(n, seed, muscles="linear")):
        recording, _ = recorded(person, number, HOLDING, seed)
        conditions, amplitudes = trials_by_condition(recording, is_checked=True), envelopes(recording)
        result = onsets([conditions[name] for name in HELD if name in conditions], amplitudes)
        latencies.add(result.latencies, "latency_s", person)
        if neurokit is not None:
            for row in result.latencies.dropna().to_dict("records"):
                latency = _by_threshold(neurokit, recording, row["muscle"], row["direction_deg"])
                thresholds.append(latency - person.subjects["PT"].Td_s)
                here.append(row["latency_s"] - person.subjects["PT"].Td_s)
        fits.add(person, conditions, amplitudes)
        recording, _ = recorded(person, number, MOVING, seed, effort=1.0)
        showing.add(person, trials_by_condition(recording, is_checked=True), envelopes(recording))
    yield from latencies.lines("latency of answers to pulses, linear people")
    if neurokit is not None:
        known = np.isfinite(thresholds)
        late = 1e3 * np.array(thresholds)[known]
        said = f"bias {late.mean():+.1f} ms, SD {late.std():.1f} ms; none in {(~known).sum()} of {len(known)}"
        same = 1e3 * np.array(here)[known]
        yield Line("the same by NeuroKit2, pulses of PT0", "", said)
        yield Line("the same muscles here", "", f"bias {same.mean():+.1f} ms, SD {same.std():.1f} ms")
    yield from fits.lines()
    yield from (line._replace(quantity=f"effort shows: {line.quantity}") for line in showing.lines())


def linear_laboratory(n: int, seed: int) -> Iterator[Line]:
    """The same fits of people whose arms keep the geometry of their posture."""
    yield from _fits_alone("linear laboratory", n, seed, linear=True)


def without_fast_part(n: int, seed: int) -> Iterator[Line]:
    """The same fits of people whose remnant has no fast part."""
    yield from _fits_alone("without the fast part", n, seed, fast=False)


PARTS = {part.__name__: part for part in (linear_people, linear_laboratory, without_fast_part)}


def _fits_alone(label: str, n: int, seed: int, **how: bool) -> Iterator[Line]:
    fits = Fits()
    for number, person in enumerate(draw_cohort(n, seed, muscles="linear")):
        recording, _ = recorded(person, number, MOVING, seed, **how)
        fits.add(person, trials_by_condition(recording, is_checked=True), envelopes(recording))
    yield from (line._replace(quantity=f"{label}: {line.quantity}") for line in fits.lines())


def _by_threshold(neurokit: Any, recording: xr.Dataset, muscle: str, direction: float) -> float:
    """Latency by a threshold, of the mean over pulses of PT0 [s], from when the stretched joints move."""
    chosen = (recording["condition"].values == "PT0") & (recording["pulse_direction"].values == direction)
    rate, action = float(recording.attrs["emg_rate"]), ACTIONS[muscle]
    n, before = round(0.3 * rate), round(0.1 * rate)
    amplitudes, moved = [], []
    for trial in np.flatnonzero(chosen):
        onset = float(recording["pulse_onset"].values[trial])
        cleaned = neurokit.emg_clean(
            recording["emg"].sel(muscle=muscle).values[trial].astype(float), sampling_rate=rate
        )
        first = round(onset * rate) - before
        amplitudes.append(np.asarray(neurokit.emg_amplitude(cleaned))[first : first + n])
        fine = np.arange(first, first + n) / rate
        mechanical = np.arange(recording.sizes["time"]) / float(recording.attrs["rate"])
        lead = float(recording["emg"].attrs.get("lead", 0.0))
        angle = sum(recording["joint_angle"].values[trial, :, "se".index(joint)] for joint in action.joints)
        moved.append(np.interp(fine + lead, mechanical, -action.sign * angle))
    amplitude, stretch = np.mean(amplitudes, axis=0), np.mean(moved, axis=0)
    speed = np.gradient(stretch) * rate

    def first_above(values: np.ndarray) -> float:
        threshold = values[:before].mean() + 3.0 * values[:before].std()
        if not values.max() > threshold:
            return np.nan
        active, _ = neurokit.emg_activation(values, sampling_rate=rate, method="threshold", threshold=threshold)
        place = np.flatnonzero(np.asarray(active["EMG_Activity"])[before:] > 0)
        return place[0] / rate if len(place) else np.nan

    return first_above(amplitude) - first_above(speed)


class Intervals:
    """Errors of delays, and whether their intervals hold the true ones."""

    def __init__(self) -> None:
        self.errors, self.inside = list[float](), list[bool]()

    def add(self, frame: pd.DataFrame, column: str, person: Person) -> None:
        """Add a table with 95 % limits."""
        frame, true = frame.dropna(subset=["lower_95_s", "upper_95_s"]), person.subjects["PT"].Td_s
        self.errors += list(frame[column] - true)
        self.inside += list((frame["lower_95_s"] <= true) & (true <= frame["upper_95_s"]))

    def lines(self, name: str) -> Iterator[Line]:
        """Bias and coverage."""
        spread = f"SD {1e3 * np.std(self.errors):.2f} ms"
        yield Line(name, "bias 2 ms", f"bias {1e3 * np.mean(self.errors):+.2f} ms, {spread}")
        yield Line("its 95 % intervals hold", "90 to 98 %", f"{100 * np.mean(self.inside):.0f} % of {len(self.inside)}")


class Fits:
    """Reflexes of linear people, model 3: each condition by itself without and with EMG, and all with common gains."""

    WAYS = ("alone", "EMG", "EMG, conditions together")
    FITTED = ("PT7.5", "PT22.5")
    RECTIFIED = 2.0
    """By how much it would tell more at most if muscles were outputs one by one, each rectified: the difference between
    antagonists has the noise of both, and while the arm moves one way only one of them answers [-]."""

    def __init__(self) -> None:
        self.rows, self.seconds, self.n = list[dict[str, Any]](), np.zeros(3), 0
        self.suspicious, self.left_out = list[bool](), 0

    def add(self, person: Person, conditions: dict[str, ConditionTrials], amplitudes: Envelopes) -> None:
        """Fit the trials of a person who stays in the workspace."""
        if not {*MOVED} <= {*conditions}:
            self.left_out += 1
            return
        groups = {name: _with_and_without(conditions[name], amplitudes) for name in MOVED}
        ways: list[dict[str, Any]] = []
        for place in (0, 1):
            start = time.process_time()
            ways.append({name: estimate([groups[name][place]]) for name in self.FITTED})
            self.seconds[place] += (time.process_time() - start) / len(self.FITTED)
        start = time.process_time()
        together, share = estimate([each[1] for each in groups.values()], share=["gain"]), ("gain",)
        self.seconds[2] += time.process_time() - start
        self.n += 1
        self.suspicious += [fit.is_suspicious for fit in ways[1].values()]
        of_all = _alike([each[1] for each in groups.values()], together, share)
        for name in self.FITTED:
            moved, active = (ways[place][name] for place in (0, 1))
            alone, with_emg = _alike([groups[name][0]], moved), _alike([groups[name][1]], active)
            rectified = _alike([groups[name][1]], active, emg_times=self.RECTIFIED)
            for parameter in moved.values:
                if not parameter.startswith(("kv_", "kp_", "Td_", "fact_")):
                    continue
                true, label = getattr(person.subjects["PT"], parameter), f"{parameter} [{name}]"
                row: dict[str, Any] = {"quantity": f"{parameter.partition('_')[0]}, {name}"}
                row["EMG"] = with_emg[parameter] / alone[parameter]
                row["rectified"] = rectified[parameter] / alone[parameter]
                row["EMG, conditions together"] = of_all[label] / alone[parameter]
                fitted = (moved, parameter), (active, parameter), (together, label)
                for way, (fit, key) in zip(self.WAYS, fitted, strict=True):
                    low, high = fit.interval(key)
                    row[f"error {way}"], row[f"held {way}"] = fit.values[key] - true, low <= true <= high
                self.rows.append(row)

    def lines(self) -> Iterator[Line]:
        """Medians of ratios, errors and coverage."""
        yield Line("people whose multisines all end at the limit of the workspace", "", str(self.left_out))
        for quantity, of in pd.DataFrame(self.rows).groupby("quantity", sort=False):
            of_gains = quantity.startswith("k")
            beside = f" (rectified outputs at best {of['rectified'].median():.2f})"
            for way in self.WAYS[1:]:
                yield Line(
                    f"{quantity}: standard error over that without EMG, {way}",
                    "0.5" if of_gains else "",
                    f"{of[way].median():.2f}" + (beside if way == "EMG" else ""),
                )
            for way in self.WAYS:
                error = np.sqrt(np.mean(of[f"error {way}"] ** 2))
                target = "90 to 98 %" + ("; 2 ms" if quantity.startswith("Td") else "")
                held = f"intervals hold {100 * of[f'held {way}'].mean():.0f} % of {len(of)}"
                yield Line(f"{quantity}, {way}", target, f"{held}; RMS error {error:.3g}")
        refuted = f"{sum(self.suspicious)} of {len(self.suspicious)}"
        yield Line("fits with EMG of one condition whose lack of fit is told", "", refuted)
        spent = ", ".join(f"{each / self.n:.1f} s" for each in self.seconds)
        yield Line("CPU of a fit without EMG, with it, of three conditions together", "", spent)


def _with_and_without(trials: ConditionTrials, amplitudes: Envelopes) -> tuple[Group, Group]:
    """Trials for a fit of the movement, and of movement and EMG."""
    group = Group.prepare([trials], structure_of("3", wide=True))
    likelihood = EmgLikelihood(reflex_outputs(trials, amplitudes), ElectromechanicalDelay())
    return group, group.with_emg(likelihood)


def _alike(
    groups: Sequence[Group], fitted: Estimate, share: Sequence[str] = (), emg_times: float = 1.0
) -> dict[str, float]:
    """Standard errors were all trials alike: what people vary from trial to trial is the same with EMG and without.

    Args:
      groups: that were fitted.
      fitted: the estimate.
      share: as it was for the estimate.
      emg_times: by how much more EMG tells than it does.
    """
    problem = JointLikelihood([group.under(fitted.law) for group in groups], "record", share)
    values = np.array([fitted.values[name] for name in problem.names])
    problem.weigh(values)
    information = problem.normal(values).information
    if emg_times != 1.0:
        without = JointLikelihood([replace(group, emg=None) for group in groups], "record", ())
        columns = [problem.names.index(name) for name in without.names]
        without.weigh(values[columns])
        of_movement = np.zeros_like(information)
        of_movement[np.ix_(columns, columns)] = without.normal(values[columns]).information
        information = of_movement + emg_times * (information - of_movement)
    return dict(zip(problem.names, np.sqrt(np.diag(np.linalg.inv(information))).tolist(), strict=True))


def _indices(result: Activity, recording: xr.Dataset, true: np.ndarray) -> np.ndarray:
    """Estimated and true index of conditions of the position task and joints, (case, 2)."""
    rows = []
    for (condition, _, joint), row in result.cocontraction.set_index(["condition", "part", "joint"]).iterrows():
        if condition.startswith("PT"):
            its = recording["condition"].values == condition
            rows.append((row["index"], true[its, ["shoulder", "elbow"].index(joint)].mean()))
    return np.array(rows)


def main(n: int, seed: int = SEED, part: str = "") -> None:
    """Print every line, or those of one of `PARTS`."""
    every = (known_envelopes(), lateness(), nonlinear_people(n, seed), linear_people(n, seed))
    for lines in (PARTS[part](n, seed),) if part else every:
        for line in lines:
            print(f"{line.quantity:87}  {line.target:16}  {line.measured}", flush=True)


if __name__ == "__main__":
    main(*([int(each) for each in sys.argv[1:3]] or [PEOPLE]), *sys.argv[3:4])
