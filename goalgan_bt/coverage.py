"""Coverage: the chance to reach a goal drawn uniformly from the free space.

The protocol of Florensa et al. 2018: a few episodes from the start to each test goal (in a maze
the centres of 0.5 m tiles: 112 in the U-maze), coverage is the mean success. Here with the
training horizon and the training's definition of success.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from goalgan_bt import ranks
from goalgan_bt.envs.batch import GoalEnv, Ids, Step
from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.policy import Actor, GaussianPolicy


class Success(NamedTuple):
    """rate: (K,) share of episodes that reached each goal; steps: environment steps spent."""

    rate: FloatArray
    steps: int


def attempts(
    env: GoalEnv, policy: GaussianPolicy, goals: FloatArray, noise: torch.Generator | None
) -> Iterator[tuple[Ids, Step]]:
    """Try goals side by side, once each from the start, until the last episode has ended.

    Args:
        env: simulations for this purpose, at least as many as goals.
        policy: pi.
        goals: (n, goal_dim).
        noise: draws actions; None for the deterministic policy.

    Yields:
        After each action the goals, as indices, whose episodes it moved on, and what it gave.
    """
    active, act = np.arange(len(goals)), Actor(policy)
    env.reset(active, goals)
    obs = env.observe(active)
    while len(active):
        drawn = None
        if noise is not None:
            drawn = torch.randn(len(active), env.act_dim, generator=noise)
        step = env.step(active, act(obs, drawn))
        yield active, step
        going = ~(step.terminated | step.truncated)
        active, obs = active[going], step.obs[going]


def success_rate(
    env: GoalEnv,
    policy: GaussianPolicy,
    goals: FloatArray,
    rollouts: int,
    noise: torch.Generator | None,
) -> Success:
    """Try each goal from the start; several ranks share the work.

    Args:
        env: simulations for this purpose; as many goals at a time as it has.
        policy: pi.
        goals: (K, goal_dim).
        rollouts: episodes per goal.
        noise: draws actions; None for the deterministic policy.
    """
    tried = np.repeat(goals, rollouts, axis=0)[ranks.share(len(goals) * rollouts)]
    reached = np.zeros(len(tried))
    steps = 0
    for begin in range(0, len(tried), env.num_envs):
        for active, step in attempts(env, policy, tried[begin : begin + env.num_envs], noise):
            steps += len(active) * env.action_repeat
            reached[begin + active] = step.rewards
    rate = ranks.gather(reached).reshape(len(goals), rollouts).mean(axis=1)
    return Success(rate, int(ranks.total(torch.tensor(steps))))
