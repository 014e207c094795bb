"""Trials of people whose nervous system is an agent, as the instruments of the laboratory record them."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from armperturb.arrays import Array
from armperturb.envs.lab.experiment import recorded
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.setup import Setup, Truth, flushed
from armperturb.envs.lab.stepping import ANGLE, EXCITATION, FORCE, HANDLE
from armperturb.envs.lab.trial import Trial, subject_in
from armperturb.envs.learning.registration import TASKS
from armperturb.envs.learning.session import Session
from armperturb.envs.learning.task import task_settings
from armperturb.models.rig import KNOWN
from armperturb.validation import require_one_of

Agent = Callable[[NDArray[np.float32]], ArrayLike]
"""From observations, (trial, sense), to actions, (trial, action)."""


def record_agent(
    name: str,
    agent: Agent,
    trials: Sequence[Trial],
    *,
    rate: float = 200.0,
    instruments: Instruments | None = None,
    **settings: Any,
) -> xr.Dataset:
    """Trials of an agent in an environment, as a recording that `response`, `identify` and `video` read as any other.

    With the person's own action it is the recording of `run_experiment`, to the last bit. Trials end with their last
    whole decision.

    Args:
      name: of the environment, e.g. "ArmPerturb/Position-v1".
      agent: from observations, (trial, sense), to actions, (trial, action), as of the environment.
      trials: people of the environment's task, each with a perturbation; all take equally long.
      rate: of the recording [Hz].
      instruments: what the signals pass on their way into the recording, without an EMG; None records the truth.
      **settings: of `TaskSettings` that differ from those of the name.

    Raises:
      TypeError: a setting is unknown, or an argument has the wrong type.
      ValueError: the name is unknown, trials are missing, differ in duration or do not fit to the environment, or a
        value is out of its range.
    """
    require_one_of("record_agent", "name", name, tuple(TASKS))
    task = task_settings({**TASKS[name], **settings})
    if not trials:
        raise ValueError("record_agent: trials = (); expected at least one trial")
    for trial in trials:
        task.checked(trial, "record_agent")
    durations = {trial.perturbation.duration for trial in trials}
    if len(durations) > 1:
        raise ValueError(f"record_agent: trials of {min(durations):g} to {max(durations):g} s; expected one duration")
    if instruments is not None and instruments.emg is not None:
        raise ValueError("record_agent: instruments have an EMG; expected Instruments(emg=None), as agents have none")
    setup = Setup(
        environment=task.environment,
        timestep=task.timestep,
        rate=rate,
        engine=task.engine,
        instruments=instruments,
        owner="record_agent",
    )
    subjects = [subject_in(trial, task.environment) for trial in trials]
    _ = setup.lowpass  # whose cut-off may be too high
    session = Session(task, len(trials))
    session.start(session.people.everybody, trials)
    return recorded(trials, subjects, setup, _truth(session, agent, np.array([s.posture for s in subjects]), setup))


def _truth(session: Session, agent: Agent, posture: Array, setup: Setup) -> Truth:
    """What happens while the agent decides, from a posture at rest [rad], (trial, joint)."""
    people = session.people
    n_steps = int(people.n_steps[0])
    push = people.known(people.everybody, 1, n_steps)[..., len(KNOWN) - 2 :]
    logs, diverged = [], np.full(len(posture), np.inf)
    while people.step[0] < n_steps:
        start = float(people.step[0] * setup.timestep)
        session.step(agent(people.observe()))
        logs.append(session.simulation.log[:, :-1].copy())
        diverged = np.where(session.simulation.diverged, np.minimum(diverged, start), diverged)
    log = np.nan_to_num(np.concatenate(logs, axis=1))
    rest = np.zeros((len(log), log.shape[2]))
    rest[:, ANGLE] = posture
    farthest = np.max(np.abs(log[:, :: setup.decimation, HANDLE]), axis=2)
    reached = np.array([next(iter(np.flatnonzero(far)), np.inf) for far in farthest >= setup.environment.workspace])
    limit_time = np.minimum(reached / setup.rate, diverged)
    signals = np.stack([setup.sampled(*of_trial) for of_trial in zip(log, rest, strict=True)])
    return Truth(
        perturbation=np.stack([setup.sampled(of_trial) for of_trial in push]),
        displacement=signals[..., HANDLE],
        joint_angle=signals[..., ANGLE],
        force=signals[..., FORCE],
        excitation=flushed(log[:, :0, EXCITATION]),
        limit_time=np.where(np.isfinite(limit_time), limit_time, np.nan),
    )
