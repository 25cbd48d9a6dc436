"""Coverage: the chance to reach a goal drawn uniformly from the free space.

The protocol of Florensa et al. 2018: a few episodes from the start to each test goal (in a maze
the centres of 0.5 m tiles: 112 in the U-maze), coverage is the mean success. Here with the
training horizon and the training's definition of success.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from goalgan_bt.envs.batch import GoalEnv
from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.policy import GaussianPolicy


@dataclass(frozen=True)
class CoverageConfig:
    """How coverage is measured."""

    rollouts: int = 3
    """Episodes per test goal with the stochastic policy (the original: 2 point, 3 ant)."""
    every: int = 1_500_000
    """Training steps between two measurements; one more at the end."""


class Success(NamedTuple):
    """rate: (K,) share of episodes that reached each goal; steps: environment steps spent."""

    rate: FloatArray
    steps: int


def success_rate(
    env: GoalEnv,
    policy: GaussianPolicy,
    goals: FloatArray,
    rollouts: int,
    noise: torch.Generator | None,
) -> Success:
    """Try each goal from the start.

    Args:
        env: simulations for this purpose; as many goals at a time as it has.
        policy: pi.
        goals: (K, goal_dim).
        rollouts: episodes per goal.
        noise: draws actions; None for the deterministic policy.
    """
    attempts = np.repeat(np.arange(len(goals)), rollouts)
    reached = np.zeros(len(attempts))
    steps = 0
    for begin in range(0, len(attempts), env.num_envs):
        chunk = attempts[begin : begin + env.num_envs]
        active = np.arange(len(chunk))
        env.reset(active, goals[chunk])
        obs = env.observe(active)
        while len(active):
            step = env.step(active, policy.act(obs, noise))
            steps += len(active) * env.action_repeat
            reached[begin + active] = step.rewards
            going = ~(step.terminated | step.truncated)
            active, obs = active[going], step.obs[going]
    return Success(reached.reshape(len(goals), rollouts).mean(axis=1), steps)
