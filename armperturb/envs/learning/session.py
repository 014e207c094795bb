"""Participants on MuJoCo's batch: what the gymnasium environments, single and vectorised, are views of."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armperturb.arrays import Array, Indices
from armperturb.envs.lab.compiled_simulation import CompiledSimulation
from armperturb.envs.lab.simulation import Simulation, silent_simulator
from armperturb.envs.lab.stepping import ANGLE, FORCE, HANDLE, VELOCITY
from armperturb.envs.lab.trial import Trial
from armperturb.envs.learning.participants import START, Participants
from armperturb.envs.learning.task import TaskSettings
from armperturb.models.rig import history_length


class Session:
    """n people in trials of a task, simulated side by side; each has the same bits alone and beside others."""

    def __init__(self, settings: TaskSettings, n: int, n_threads: int = 0) -> None:
        """Compile the arms; `start` everybody's trial before the first `step`.

        Args:
          settings: the task.
          n: how many people.
          n_threads: of the simulation; 0 takes all cores.
        """
        engine = CompiledSimulation if settings.engine == "compiled" else Simulation
        self.simulation = engine(
            [settings.subject] * n,
            settings.environment,
            timestep=settings.timestep,
            n_history=max(history_length(subject, settings.timestep) for subject in settings.people),
            n_threads=n_threads,
        )
        self.people = Participants(settings, self.simulation.control)
        self._diverged = np.zeros(n, dtype=bool)

    def start(self, people: Indices, trials: Sequence[Trial]) -> None:
        """Begin trials at rest; nothing is left of those before.

        Args:
          people: indices of those whose trials begin, in rising order.
          trials: one for each of them.
        """
        self.simulation.replace(people, self.people.start(people, trials))
        self.simulation.start(people, self.people.known(people, 0, START))
        self._diverged[people] = False

    def step(self, actions: ArrayLike) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Everybody's next decision and what follows; see `Participants.decide` and `judge`.

        Args:
          actions: (person, action).

        Returns:
          Rewards, terminations and truncations, (person,) each.

        Raises:
          TypeError: actions are no numbers.
          ValueError: they have the wrong shape, or one of them is refused.
        """
        people, simulation = self.people, self.simulation
        changed, strength = people.decide(actions)
        if len(changed):
            simulation.set_strength(changed, strength)
        with silent_simulator():
            simulation.advance(people.known(people.everybody, START, people.settings.steps_per_decision))
        log = simulation.log
        after = log[:, 1:]
        people.sense(after[..., ANGLE], after[..., VELOCITY], after[..., HANDLE], log[:, :-1, FORCE])
        diverged = self._diverged = simulation.diverged.copy()
        verdict = people.judge(log[:, -1, HANDLE], diverged)
        if diverged.any():
            # MuJoCo has put them back; what is left in their muscles and senses may be infinite.
            lost = np.flatnonzero(diverged)
            simulation.replace(lost, people.rest(lost))
        return verdict

    def truth(self) -> dict[str, NDArray]:
        """What no person knows, copies: name to values, (person, ...).

        `time` of the trial [s], `perturbation` [N], `displacement` [m], `joint_angle` [rad] and `joint_velocity`
        [rad/s] at this moment; `force` [N] at the simulation's last step, as MuJoCo's sensors have it;
        level of `co_contraction` that the muscle groups have reached [-]; whether MuJoCo has put a trial back that had
        `diverged`, as it could not integrate it; and what `Participants.verdict` says.
        """
        people, now = self.people, self.simulation.log[:, -1]
        columns = {"displacement": HANDLE, "joint_angle": ANGLE, "joint_velocity": VELOCITY, "force": FORCE}
        return {
            "time": people.step * people.settings.timestep,
            "perturbation": people.perturbation(),
            **{name: now[:, columns[name]].copy() for name in columns},
            "co_contraction": people.reached.copy(),
            "diverged": self._diverged.copy(),
            **people.verdict(),
        }
