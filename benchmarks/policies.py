"""Policies for the environments, how they are judged, and how two methods train them.

Policies are trained by the cross-entropy method (Rubinstein & Kroese 2004, The Cross-Entropy Method): each generation
draws candidates around a mean, lets all meet the same trials, and goes on with mean and spread of the best; and by
proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) as stable-baselines3 has it. Both meet as many
decisions, start from middle levels without torque, and have a seed; a training is one process and one core.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from armperturb.arrays import Array
from armperturb.envs.learning.policy import Policy

DECISIONS = 500
"""In a trial."""

BUDGET = 1_000_000
"""Decisions that a training meets, all people together."""

CURVE = 20
"""Points of a learning curve."""

JUDGED, VALIDATED = range(1000, 1024), range(2000, 2024)
"""Seeds of the trials that policies are judged on at the end, and of those on the way; training has none of them."""

TRAINED = 10_000_000
"""Seeds of training's trials begin here, and for each training as far from those of the one before."""

CANDIDATES, BEST = 40, 8
"""Of a generation of the cross-entropy method; all candidates of one meet the same trial."""

PEOPLE = 64
"""Of proximal policy optimisation, side by side."""

HIDDEN = [32, 32]
"""Units in the layers of its policy."""

Act = Callable[[Array], Array]
"""From observations, (person, 8), to actions, (person, 11)."""


def people(name: str, n: int, **more: Any) -> gym.vector.VectorEnv:
    """Many people of an environment, on one core."""
    return gym.make_vec(name, num_envs=n, engine="compiled", n_threads=1, **more)


def run(name: str, act: Act, seeds: Sequence[int]) -> tuple[Array, Array, Array]:
    """Mean reward per decision and success of each trial, and all that was observed, (decision, trial, 8)."""
    envs = people(name, len(seeds))
    observations, info = envs.reset(seed=list(seeds))
    total, running, success, seen = np.zeros(len(seeds)), np.ones(len(seeds), dtype=bool), 0, []
    for _ in range(DECISIONS):
        seen.append(observations.copy())
        observations, reward, terminated, _, info = envs.step(act(observations))
        total += np.where(running, reward, 0.0)
        running &= ~terminated
        success = np.asarray(info["success"]) & running
    envs.close()
    return total / DECISIONS, success, np.array(seen)


def judge(name: str, act: Act) -> dict[str, Any]:
    """Reward per decision of each trial of `JUDGED`, how many were a success, and SDs of the observations."""
    reward, success, seen = run(name, act, JUDGED)
    spread = seen.reshape(-1, seen.shape[-1]).std(axis=0)
    return {"rewards": reward.tolist(), "success": int(np.sum(success)), "observation_sd": spread.tolist()}


def untrained(name: str) -> dict[str, Act]:
    """Policies that learn nothing."""
    envs = people(name, 1)
    own, low, high = envs.own_action, envs.single_action_space.low, envs.single_action_space.high
    envs.close()
    rng = np.random.default_rng(0)
    return {
        "own action": lambda seen: np.repeat(own[None], len(seen), axis=0),
        "zero": lambda seen: np.zeros((len(seen), len(own)), dtype=np.float32),
        "random": lambda seen: rng.uniform(low, high, (len(seen), len(own))).astype(np.float32),
    }


class Curve:
    """Reward per decision of the policy so far on trials that training does not meet, against decisions."""

    def __init__(self, name: str) -> None:
        """Begin, with the clock of the processor."""
        self._name, self._next, self._judging = name, 0, 0.0
        self._start = time.process_time()
        self.points: list[tuple[int, float]] = []

    def add(self, decisions: int, act: Act, last: bool = False) -> None:
        """Judge the policy if its time has come."""
        if decisions >= self._next or last:
            start = time.process_time()
            self.points.append((decisions, float(run(self._name, act, VALIDATED)[0].mean())))
            self._next += BUDGET // CURVE
            self._judging += time.process_time() - start

    def seconds(self) -> float:
        """Processor time since the beginning, without judging [s]."""
        return time.process_time() - self._start - self._judging


def cross_entropy(name: str, seed: int) -> tuple[Policy, Curve]:
    """A policy of one layer, by the cross-entropy method."""
    rng, curve = np.random.default_rng(seed), Curve(name)
    shape, first, generations = (11, 9), TRAINED * (seed + 1), BUDGET // (CANDIDATES * DECISIONS)
    mean, spread = np.zeros(shape), np.full(shape, 0.02)
    mean[:9, -1], spread[:9, -1] = 0.5, 0.3
    for generation in range(generations):
        curve.add(generation * CANDIDATES * DECISIONS, Policy((mean,)))
        drawn = mean + spread * rng.normal(size=(CANDIDATES, *shape))

        def act(observations: Array, drawn: Array = drawn) -> Array:
            return (np.einsum("pao,po->pa", drawn[..., :-1], observations) + drawn[..., -1]).astype(np.float32)

        reward, _, _ = run(name, act, [first + generation] * CANDIDATES)
        best = drawn[np.argsort(reward)[-BEST:]]
        mean = 0.3 * mean + 0.7 * best.mean(axis=0)
        spread = 0.3 * spread + 0.7 * best.std(axis=0) + 0.003 * 0.9**generation
    curve.add(BUDGET, Policy((mean,)), last=True)
    return Policy((mean,)), curve


def proximal(name: str, seed: int) -> tuple[Policy, Curve]:
    """A policy with two hidden layers, by proximal policy optimisation."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback

    from benchmarks.stable_people import StablePeople

    torch.set_num_threads(1)
    envs = people(name, PEOPLE, autoreset_mode=AutoresetMode.SAME_STEP)
    trained = StablePeople(envs, seed=TRAINED * (seed + 1))
    model = PPO(
        "MlpPolicy",
        trained,
        n_steps=125,
        batch_size=2000,
        n_epochs=5,
        gamma=0.98,
        learning_rate=lambda left: 1e-3 * left,
        policy_kwargs={"net_arch": {"pi": HIDDEN, "vf": [64, 64]}, "log_std_init": -0.7},
        seed=seed,
        device="cpu",
    )
    curve = Curve(name)

    def policy() -> Policy:
        """What the model does without its noise, in the environment's own units."""
        layers = [*model.policy.mlp_extractor.policy_net[::2], model.policy.action_net]
        tables = [
            np.column_stack([layer.weight.detach().numpy(), layer.bias.detach().numpy()]).astype(float)
            for layer in layers
        ]
        tables[-1] *= trained.half[:, None]
        tables[-1][:, -1] += trained.middle
        return Policy(tuple(tables))

    class Judging(BaseCallback):
        """Between the model's rollouts."""

        def _on_rollout_start(self) -> None:
            curve.add(self.num_timesteps, policy())

        def _on_step(self) -> bool:
            return True

    model.learn(BUDGET, callback=Judging())
    curve.add(BUDGET, policy(), last=True)
    envs.close()
    return policy(), curve


METHODS: dict[str, Callable[[str, int], tuple[Policy, Curve]]] = {
    "PPO, network": proximal,
    "CEM, linear": cross_entropy,
}
"""How policies are trained."""
