# %% [markdown]
# # Train an agent
#
# In this tutorial an agent learns to hold the handle as a person would: it sets co-contraction, reflex gains and
# joint torque of a simulated arm, and senses with neural delays. The [environment](../environments.md) is the physics
# of the studies; it needs the extra `learn`. The learning method is deliberately small, the cross-entropy method in a
# few lines of NumPy. Any library for gymnasium environments can take its place.
#
# ## The task
#
# A multisine pushes the handle. The reward is minus a cost of squared displacement and effort (`reward="cost"`). Effort
# is made expensive, because otherwise the optimum is simply to be as stiff as possible. Observations are physical.

# %%
import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

import armperturb  # registers the environments

task = {
    "duration": 2.0,  # [s]; 50 decisions per second
    "timestep": 5e-3,
    "senses": "physical",
    "co_contraction": "common",
    "reward": "cost",
    "co_contraction_weight": 3.0,
    "reflex_weight": 1.0,
    "torque_weight": 0.3,
}
env = gym.make("ArmPerturb/Position-v1", **task)
print(f"{env.observation_space.shape[0]} observations, {env.action_space.shape[0]} actions")

# %% [markdown]
# ## A policy of five numbers
#
# The policy holds three levels (co-contraction, velocity feedback, position feedback) and answers the sensed joint
# velocity with a torque at each joint. All candidates try the same trials side by side in one vector environment.


# %%
def act(policies, observations):
    """Actions (person, 9) of policies (person, 5): one co-contraction, 3 + 3 reflex gains, 2 torques."""
    levels = np.repeat(policies[:, :3], (1, 3, 3), axis=1)
    torque = -policies[:, 3:] * observations[:, 2:4]  # at 1 rad/s a gain of 1 asks for the highest torque
    return np.concatenate([np.clip(levels, 0.0, 1.0), np.clip(torque, -1.0, 1.0)], axis=1).astype(np.float32)


def rewards(policies, seeds):
    """Mean reward per decision of each policy in each trial, (policy, trial)."""
    people = np.repeat(policies, len(seeds), axis=0)
    envs = gym.make_vec("ArmPerturb/Position-v1", num_envs=len(people), **task)
    observations, _ = envs.reset(seed=[*seeds] * len(policies))
    total, running = np.zeros(len(people)), np.ones(len(people), dtype=bool)
    for _ in range(100):
        observations, reward, terminated, _, _ = envs.step(act(people, observations))
        total += np.where(running, reward, 0.0)  # who leaves the workspace has been charged for the rest
        running &= ~terminated
    envs.close()
    return total.reshape(len(policies), len(seeds)) / 100


# %% [markdown]
# ## Training
#
# In each generation twelve candidates are drawn around the policy; the mean of the best three becomes the next
# policy. Each generation meets new trials.

# %%
rng = np.random.default_rng(0)
policy, spread = np.array([0.5, 0.5, 0.5, 0.0, 0.0]), np.array([0.3, 0.3, 0.3, 0.2, 0.2])
history = [policy]
for generation in range(8):
    candidates = policy + spread * rng.normal(size=(12, 5))
    candidates[:, :3] = np.clip(candidates[:, :3], 0.0, 1.0)
    score = rewards(candidates, range(4 * generation, 4 * generation + 4)).mean(axis=1)
    policy = candidates[np.argsort(score)[-3:]].mean(axis=0)
    spread = 0.8 * spread
    history.append(policy)
print("co-contraction, velocity and position feedback:", policy[:3].round(2))
print("torque per velocity [Nms/rad], shoulder and elbow:", (10.0 * policy[3:]).round(1))

# %% [markdown]
# ## Did it learn?
#
# The policies are judged on trials that none of them was trained on, together with two references: an arm that does
# nothing, and the learnt levels without torque. All meet the same trials, so a difference has a smaller standard
# error than either mean.

# %% alt="Mean cost per decision against generation"
judged = range(1000, 1012)
still, no_torque = np.zeros(5), policy * [1, 1, 1, 0, 0]
nothing, without, *learning = rewards(np.array([still, no_torque, *history]), judged)
learnt = learning[-1]
for name, result in {
    "does nothing": nothing,
    "before training": learning[0],
    "learnt": learnt,
    "learnt, no torque": without,
}.items():
    print(f"{name:18} {result.mean():8.2f}")
gain = learnt - learning[0]
print(f"learnt - before: {gain.mean():+.2f}, standard error {gain.std(ddof=1) / np.sqrt(len(gain)):.2f}")

figure, axes = plt.subplots(figsize=(7.0, 3.5), layout="constrained")
error = np.std(learning, axis=1, ddof=1) / np.sqrt(len(judged))
axes.errorbar(range(len(learning)), -np.mean(learning, axis=1), error, fmt="ko-", markersize=4)
axes.set(xlabel="generation", ylabel="mean cost per decision", ylim=(0, None))

# %% [markdown]
# `env.unwrapped.own_action` is what the simulated person does in a study, a reference that needs no training. [Effort
# against accuracy](../effort.md) uses the same reward to ask why people's admittance falls with amplitude.
