"""What the analysis of EMG reaches: `python -m benchmarks.emg [PEOPLE]`; some minutes of a core per three people.

People are drawn as in a study and do the thesis's protocol with a maximal contraction, under the published forces, with
all noise. Lines that begin with NeuroKit2 need it installed, and are left out otherwise.
"""

import importlib
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
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
from armperturb.envs.lab.emg import Emg, _filters
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.recording import ACTIONS, Action, make_recording
from armperturb.study.protocol import THESIS, Condition, Protocol
from armperturb.subject import POSITION, RELAX, Subject

PEOPLE, SEED = 3, 5
MAXIMAL = Condition(name="MVC", task="PT", contraction=1.0)
PROTOCOL = replace(THESIS, forces="published", conditions=(*THESIS.conditions, MAXIMAL))
HELD = ("PT0", "PT2.5", "PT7.5", "PT22.5")
HOLDING = replace(PROTOCOL, conditions=(*(THESIS.condition(name) for name in HELD), MAXIMAL), pulse_unit_condition="")
SLIGHT = 0.05
"""Co-contraction that has to be noticed [-]."""


def recorded(person: Person, number: int, protocol: Protocol = PROTOCOL) -> tuple[xr.Dataset, np.ndarray]:
    """A person's recording, and the true index of co-contraction of each trial, (trial, joint)."""
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

    trials = protocol.trials(person, protocol.given_forces(), SEED, number)
    options = {"engine": "compiled", "timestep": 2.5e-3, "n_threads": 1}
    with mock.patch.object(Emg, "read", read):
        recording = run_experiment(trials, instruments=Instruments(marker_noise=None), **options)
    return recording, np.array(indices)


def slightly_active(person: Person) -> Person:
    """The person whose relaxed muscles co-contract slightly."""
    share = SLIGHT / Emg().position_activation
    stiffer = {
        f: getattr(RELAX, f) + share * (getattr(POSITION, f) - getattr(RELAX, f)) for f in ("k_s", "k_se", "k_e")
    }
    return replace(person, subjects={**person.subjects, "RT": replace(person.subjects["RT"], muscle=None, **stiffer)})


def known_envelopes() -> Iterator[str]:
    """Modulated noise of known shape, and what NeuroKit2 makes of it."""
    rate, n, n_trials, window = 2000.0, 40_000, 40, 0.1
    at = np.arange(n) / rate
    shape = 0.3 * (1.0 + 0.5 * np.sin(2 * np.pi * 0.5 * at))
    colour, amplifier, _ = (np.asarray(each, dtype=float) for each in _filters(rate, 20.0))
    white = np.random.default_rng(0).standard_normal((n_trials, 2, n))
    volts = signal.sosfilt(amplifier, shape * signal.sosfilt(colour, white))
    volts[:, 1] += 0.2 * volts[:, 0]
    volts += 2e-3 * np.random.default_rng(1).standard_normal(volts.shape)
    still = np.zeros((n_trials, n // 10, 2))
    labels = {name: [np.nan] * n_trials for name in ("pulse_direction", "pulse_onset", "limit_time", "l_h", "l_f")}
    labels |= {name: [np.nan] * n_trials for name in ("theta_s_deg", "theta_e_deg")}
    labels |= {"subject": ["A"] * n_trials, "task": ["RT"] * n_trials, "condition": ["RT"] * n_trials}
    labels |= {"repetition": list(range(n_trials)), "pulse_level": [0.0] * n_trials}
    recording = make_recording(
        {"perturbation": still, "force": still, "displacement": still, "emg": volts.swapaxes(1, 2)},
        labels,
        200.0,
        emg_rate=rate,
        muscles={"flexor": Action("s", 1), "extensor": Action("s", -1)},
    )
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
        target = " (target 0.85 to 1.15)" if whiten else ""
        yield f"variance of the amplitude over the bound, {'' if whiten else 'not '}whitened: {ratio:.2f}{target}"
    yield f"cross-talk of 20 %: {'; '.join(map(str, envelopes(recording).crosstalk))}"
    try:
        neurokit = importlib.import_module("neurokit2")
    except ImportError:
        return
    amplitudes = []
    start = time.process_time()
    for trial in volts[:, 0]:
        cleaned = neurokit.emg_clean(trial, sampling_rate=rate)
        amplitude = np.asarray(neurokit.emg_amplitude(cleaned))
        amplitudes.append(np.sqrt(np.mean(amplitude.reshape(-1, steps) ** 2, axis=1)))
    spent = time.process_time() - start
    yield f"NeuroKit2: variance over the bound {scatter(np.array(amplitudes)) / bound:.2f}, {spent:.1f} CPU s"
    start = time.process_time()
    envelopes(recording.isel(muscle=[0]))
    yield f"here, the same channel: {time.process_time() - start:.1f} CPU s"


def people(n: int) -> Iterator[str]:
    """Relaxation and co-contraction of synthetic people."""
    spent, relaxed, slight, of_conditions, delays, inside, by_phase = 0.0, [], [], [], [], [], []
    only_relaxed = replace(PROTOCOL, conditions=(THESIS.condition("RT7.5"), MAXIMAL), pulse_unit_condition="")
    for number, person in enumerate(draw_cohort(n, SEED)):
        recording, indices = recorded(person, number)
        start = time.process_time()
        amplitudes = envelopes(recording)
        result = activity(amplitudes)
        conditions = trials_by_condition(recording, is_checked=True)
        answers = [reflexes(conditions[name], amplitudes) for name in ("PT2.5", "PT7.5", "PT22.5")]
        spent += time.process_time() - start
        for answer in answers:
            true, frame = person.subjects["PT"].Td_s, answer.responses
            delays += list(frame["delay_s"] - true)
            inside += list((frame["lower_95_s"] <= true) & (true <= frame["upper_95_s"]))
            by_phase += list(frame["delay_by_phase_s"] - true)
        relaxed += [bool(result.active_muscles(name)) for name in ("RT0", "RT2.5", "RT7.5", "RT22.5")]
        of_conditions.append(_indices(result, recording, indices))
        recording, _ = recorded(slightly_active(person), number, only_relaxed)
        slight.append(bool(activity(envelopes(recording)).active_muscles("RT7.5")))
    yield f"relaxed people called active: {sum(relaxed)} of {len(relaxed)} conditions (target at most 5 %)"
    yield f"people with {SLIGHT:.0%} co-contraction noticed: {sum(slight)} of {len(slight)} (target at least 90 %)"
    correlation = [stats.spearmanr(*each.T).statistic for each in of_conditions]
    yield f"rank correlation of the index with the truth over conditions, least: {min(correlation):.3f} (target 0.95)"
    error = np.concatenate([each[:, 0] / each[:, 1] - 1.0 for each in of_conditions])
    yield f"error of the index: mean {error.mean():+.1%}, largest {np.abs(error).max():.1%} (target 10 %)"
    spread = f"SD {1e3 * np.std(delays):.2f} ms"
    yield f"delay from rotation to EMG: bias {1e3 * np.mean(delays):+.2f} ms (target 2), {spread}"
    yield f"its 95 % intervals hold {100.0 * np.mean(inside):.0f} % of {len(inside)} (target 90 to 98)"
    yield f"delay by phase: bias {1e3 * np.mean(by_phase):+.2f} ms, SD {1e3 * np.std(by_phase):.2f} ms"
    yield f"CPU of ten people: {10 * spent / n:.1f} s (target 20 s)"


def pulses(n: int) -> Iterator[str]:
    """Latencies of answers to pulses while holding the position, of nonlinear people and of linear ones."""
    for muscles in ("nonlinear", "linear"):
        errors, inside, spent = [], [], 0.0
        for number, person in enumerate(draw_cohort(n, SEED, muscles=muscles)):
            recording, _ = recorded(person, number, HOLDING)
            conditions = trials_by_condition(recording, is_checked=True)
            start = time.process_time()
            frame = onsets([conditions[name] for name in HELD], envelopes(recording)).latencies.dropna()
            spent += time.process_time() - start
            true = person.subjects["PT"].Td_s
            errors += list(frame["latency_s"] - true)
            inside += list((frame["lower_95_s"] <= true) & (true <= frame["upper_95_s"]))
        spread = f"SD {1e3 * np.std(errors):.2f} ms, {spent / n:.1f} CPU s a person"
        yield f"latency of answers to pulses, {muscles}: bias {1e3 * np.mean(errors):+.2f} ms (target 2), {spread}"
        yield f"its 95 % intervals hold {100.0 * np.mean(inside):.0f} % of {len(inside)} (target 90 to 98)"


def fits(n: int) -> Iterator[str]:
    """Reflexes of linear people in PT7.5 and PT22.5, model 3, each condition by itself, with EMG and without."""
    ratios: dict[str, list[float]] = {}
    errors: dict[str, list[tuple[float, float]]] = {}
    inside: dict[str, list[tuple[bool, bool]]] = {}
    spent = [0.0, 0.0]
    for number, person in enumerate(draw_cohort(n, SEED, muscles="linear")):
        recording, _ = recorded(person, number, HOLDING)
        conditions, amplitudes = trials_by_condition(recording, is_checked=True), envelopes(recording)
        for name in ("PT7.5", "PT22.5"):
            groups = _with_and_without(conditions[name], amplitudes)
            estimates = []
            for place, group in enumerate(groups):
                start = time.process_time()
                estimates.append(estimate([group]))
                spent[place] += time.process_time() - start
            alike = [_alike(group, each) for group, each in zip(groups, estimates, strict=True)]
            for parameter in estimates[0].values:
                quantity = f"{parameter.partition('_')[0]}, {name}"
                if not parameter.startswith(("kv_", "kp_", "Td_", "fact_")):
                    continue
                true = getattr(person.subjects["PT"], parameter)
                ratios.setdefault(quantity, []).append(alike[1][parameter] / alike[0][parameter])
                both = [each.values[parameter] - true for each in estimates]
                errors.setdefault(quantity, []).append((both[0], both[1]))
                limits = [each.interval(parameter) for each in estimates]
                held = [bool(low <= true <= high) for low, high in limits]
                inside.setdefault(quantity, []).append((held[0], held[1]))
    for quantity, of in ratios.items():
        rms = np.sqrt(np.mean(np.square(errors[quantity]), axis=0))
        held = 100.0 * np.mean(inside[quantity], axis=0)
        yield (
            f"{quantity}: standard error with EMG over without, trials alike: median {np.median(of):.2f}, largest "
            f"{max(of):.2f} (target 0.5 of kv and kp); RMS error {rms[0]:.3g} to {rms[1]:.3g}; intervals hold "
            f"{held[0]:.0f} to {held[1]:.0f} % (target 90 to 98)"
        )
    yield f"CPU of a fit: {spent[0] / (2 * n):.1f} s without EMG, {spent[1] / (2 * n):.1f} s with it"


def _with_and_without(trials: ConditionTrials, amplitudes: Envelopes) -> tuple[Group, Group]:
    """Trials for a fit of the movement, and of movement and EMG."""
    group = Group.prepare([trials], structure_of("3", wide=True))
    likelihood = EmgLikelihood(reflex_outputs(trials, amplitudes), ElectromechanicalDelay())
    return group, group.with_emg(likelihood)


def _alike(group: Group, fitted: Estimate) -> dict[str, float]:
    """Standard errors were all trials alike: what people vary from trial to trial is the same with EMG and without."""
    problem = JointLikelihood([group], "record", ())
    values = np.array([fitted.values[name] for name in problem.names])
    problem.weigh(values)
    covariance = np.linalg.inv(problem.normal(values).information)
    return dict(zip(problem.names, np.sqrt(np.diag(covariance)).tolist(), strict=True))


def _indices(result: Activity, recording: xr.Dataset, true: np.ndarray) -> np.ndarray:
    """Estimated and true index of conditions of the position task and joints, (case, 2)."""
    rows = []
    for (condition, _, joint), row in result.cocontraction.set_index(["condition", "part", "joint"]).iterrows():
        if condition.startswith("PT"):
            its = recording["condition"].values == condition
            rows.append((row["index"], true[its, ["shoulder", "elbow"].index(joint)].mean()))
    return np.array(rows)


def main(n: int) -> None:
    """Print every line."""
    for line in known_envelopes():
        print(line, flush=True)
    for part in (people, pulses, fits):
        for line in part(n):
            print(line, flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else PEOPLE)
