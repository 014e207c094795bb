"""Every speed that this package is held to, beside its target, in one table.

Run `python -m benchmarks --full`; some 20 minutes on two idle cores. Times by the clock are those of this machine.
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np

import armperturb  # noqa: F401 - registers the environments
from armperturb.analysis.arm.linear_arm import total_admittance
from armperturb.analysis.nonlinear.identify import identify_nonlinear
from armperturb.cohort import draw_cohort
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine
from armperturb.perturbations.multisine import PERIOD
from armperturb.recording_files import load_recording
from armperturb.study.recording.record import record_study
from armperturb.study.recording.settings import StudySettings
from armperturb.study.report.report import write_report
from armperturb.study.results.analyse import analyse_study
from armperturb.subject import POSITION, RELAX
from benchmarks.scale_out import cost_alone
from benchmarks.simulation import batch, in_turns, trials_of

SETTLED = 20.0
"""Time after which the slowest of these arms has settled [s]."""

OLD = {1: 230.0, 256: 1900.0}
"""People to the decisions of 10 ms per second of everybody together before the simulation was compiled."""

OLD_DECISION = 0.01
"""Length of those [s]: rates are compared by the time that people live through."""


class Row(NamedTuple):
    """What was measured, and the most that it may be."""

    what: str
    measured: float
    target: float
    unit: str


def admittance() -> Iterator[Row]:
    """Largest error of the simulated admittance, over the presets and drawn linear people."""
    people = [POSITION, RELAX]
    people += [subject for person in draw_cohort(3, 0, muscles="linear") for subject in person.subjects.values()]
    moves = [
        Multisine.draw(seed=seed, rms=2e-3, duration=SETTLED + PERIOD, crested=False) for seed in (4, 5)
    ]  # so small that the arm's geometry stays linear
    recording = run_experiment([Trial(subject=person, perturbation=move) for person in people for move in moves])
    window = slice(round(SETTLED * recording.attrs["rate"]), None)
    d, x = (
        np.fft.rfft(recording[name].values[:, window], axis=1)[:, moves[0].lines]
        .reshape(len(people), 2, -1, 2)
        .transpose(0, 2, 3, 1)
        for name in ("perturbation", "displacement")
    )
    frequency, outcome = moves[0].frequencies, x @ np.linalg.inv(d)
    theory = np.stack([total_admittance(person, Environment(), frequency) for person in people])
    error = 100.0 * (np.linalg.norm(outcome - theory, axis=(2, 3)) / np.linalg.norm(theory, axis=(2, 3))).max(axis=0)
    yield Row("admittance against theory, to 20 Hz", error[frequency <= 20.0].max(), 0.1, "%")
    yield Row("the same to 40 Hz", error.max(), 0.3, "%")


def study() -> Iterator[Row]:
    """The thesis's study with either engine, its analysis and report, and one nonlinear fit per task."""
    with tempfile.TemporaryDirectory() as folder:
        compiled, out = Path(folder) / "compiled", Path(folder) / "mujoco"
        settings = StudySettings(engine="compiled")
        took = seconds(lambda: record_study(settings, compiled, workers=None, show_progress=False))
        recorded = seconds(lambda: record_study(StudySettings(), out, workers=None, show_progress=False))
        yield Row("recording of the thesis's study, MuJoCo", recorded, 35.0, "s")
        yield Row("the same, compiled engine", took, 12.0, "s")
        start = time.perf_counter()
        result = analyse_study(out, show_progress=False)
        analysed = time.perf_counter() - start
        reported = seconds(lambda: write_report(result, out, workers=None, show_progress=False))
        yield Row("analysis of the study", analysed, 40.0, "s")
        yield Row("its report", reported, 15.0, "s")
        yield Row("all of `make run`", recorded + analysed + reported, 90.0, "s")
        trials = load_recording(out / "recordings" / "S01.nc")
        for task, target in (("RT", 10.0), ("PT", 30.0)):
            mine = trials.isel(trial=np.flatnonzero(trials["task"].values == task))
            spent = seconds(lambda mine=mine: identify_nonlinear(mine, pulse_directions_deg=()), time.process_time)
            yield Row(f"one nonlinear fit, {task}", spent, target, "s of a core")


def experiments() -> Iterator[Row]:
    """Eight trials of 32 s, as in the README."""
    trials = [
        Trial(subject=POSITION, perturbation=Multisine.draw(seed=seed, rms=5.4, crested=False)) for seed in range(8)
    ]
    for engine, target in (("mujoco", 2.5), ("compiled", 0.3)):
        run_experiment(trials[:1], engine=engine)
        spent = seconds(lambda engine=engine: run_experiment(trials, engine=engine), time.process_time)
        yield Row(f"`run_experiment`, 8 trials of 32 s, {engine}", spent, target, "s of a core")
    many = trials_of((RELAX, POSITION))
    times = in_turns({"bare": batch(), "ours": lambda: run_experiment(many)})
    ratios = [ours / bare for ours, bare in zip(times["ours"], times["bare"], strict=True)]
    yield Row("`run_experiment` over bare `Batch.step`", float(np.median(ratios)), 1.15, "x")


def environments() -> Iterator[Row]:
    """Time that 10 ms of a person's life take, so that less is better."""
    for people, gain in ((256, 20.0), (1, 10.0)):
        for engine in ("mujoco", "compiled"):
            env = gym.make_vec("ArmPerturb/Pulse-v1", num_envs=people, engine=engine)
            env.reset(seed=0)
            actions = np.tile(env.unwrapped.own_action, (people, 1)).astype(np.float32)
            env.step(actions)
            n_decisions = 60 if people > 1 else 300
            took = seconds(lambda env=env, actions=actions, n=n_decisions: [env.step(actions) for _ in range(n)])
            decision = 1.0 / env.unwrapped.settings.control_rate
            env.close()
            each = 1e6 * took / (n_decisions * people) * OLD_DECISION / decision
            yield Row(f"`Pulse-v1`, {people} people, {engine}", each, 1e6 / (gain * OLD[people]), "us for 10 ms")


def cohort() -> Iterator[Row]:
    """1,000 people who practise, and are simulated and measured."""
    spent = cost_alone(1000)
    yield Row("1,000 people x 32 trials, compiled", spent["wall"], 360.0, "s")
    yield Row("their memory", spent["memory"], 1024.0, "MiB")


def seconds(function: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """How long a call takes."""
    start = clock()
    function()
    return clock() - start


def main() -> None:
    """Print the table as it is measured."""
    print(f"{'':48}{'measured':>10}{'target':>10}")
    # The cohort before the study, whose results this process would still hold.
    for measure in (admittance, experiments, environments, cohort, study):
        for row in measure():
            missed = "" if row.measured <= row.target else "   missed"
            print(f"{row.what:48}{row.measured:10.4g}{row.target:10.4g} {row.unit}{missed}", flush=True)


if __name__ == "__main__":
    main()
