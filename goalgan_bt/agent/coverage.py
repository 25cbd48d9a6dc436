"""Coverage: the chance to reach a goal drawn uniformly from the free space.

The protocol of Florensa et al. 2018: a few episodes from the start to each test goal (in a maze
the centres of 0.5 m tiles: 112 in the U-maze), coverage is the mean success. Here with the
training horizon and the training's definition of success.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from goalgan_bt.agent.policy import Actor, GaussianPolicy
from goalgan_bt.envs.goal_env import GoalEnv, Ids, Step
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.runs import ranks


class Success(NamedTuple):
    """rate: (K,) share of episodes that reached each goal; steps: environment steps spent."""

    rate: FloatArray
    steps: int


class Coverage(NamedTuple):
    """stochastic, deterministic: (K,) share of episodes of that policy that reached each goal;
    steps: environment steps spent."""

    stochastic: FloatArray
    deterministic: FloatArray
    steps: int


def attempts(
    env: GoalEnv,
    policy: GaussianPolicy,
    goals: FloatArray,
    noise: torch.Generator | None,
    quiet: BoolArray | None = None,
) -> Iterator[tuple[Ids, Step]]:
    """Try goals side by side, once each from the start, until the last episode has ended.

    Args:
        env: simulations for this purpose, at least as many as goals.
        policy: pi.
        goals: (n, goal_dim).
        noise: draws actions; None for the deterministic policy.
        quiet: (n,) which of them the deterministic policy tries; none if None.

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
            if quiet is not None:
                drawn[torch.from_numpy(quiet[active])] = 0.0
        step = env.step(active, act(obs, drawn))
        yield active, step
        going = ~(step.terminated | step.truncated)
        active = active[going]
        obs = env.observations(step.states[going], env.goals[active], step.achieved[going])


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
    nobody = np.zeros(len(goals) * rollouts, dtype=bool)
    reached, steps = _tried(env, policy, np.repeat(goals, rollouts, axis=0), noise, nobody)
    return Success(reached.reshape(len(goals), rollouts).mean(axis=1), steps)


def coverage(
    env: GoalEnv,
    policy: GaussianPolicy,
    goals: FloatArray,
    rollouts: int,
    noise: torch.Generator,
) -> Coverage:
    """Success of the stochastic policy, `rollouts` episodes per goal, and of the deterministic one,
    one each, all side by side. Arguments as those of `success_rate`."""
    quiet = np.tile(np.arange(rollouts + 1) == rollouts, len(goals))
    reached, steps = _tried(env, policy, np.repeat(goals, rollouts + 1, axis=0), noise, quiet)
    by_goal = reached.reshape(len(goals), rollouts + 1)
    return Coverage(by_goal[:, :-1].mean(axis=1), by_goal[:, -1], steps)


def _tried(
    env: GoalEnv,
    policy: GaussianPolicy,
    goals: FloatArray,
    noise: torch.Generator | None,
    quiet: BoolArray,
) -> tuple[FloatArray, int]:
    """Whether each attempt succeeded, (n,), and the environment steps of all."""
    mine = ranks.share(len(goals))
    goals, quiet = goals[mine], quiet[mine]
    reached, steps = np.zeros(len(goals)), 0
    for begin in range(0, len(goals), env.num_envs):
        some = slice(begin, begin + env.num_envs)
        for active, step in attempts(env, policy, goals[some], noise, quiet[some]):
            steps += len(active) * env.action_repeat
            reached[begin + active] = step.rewards
    return ranks.gather(reached), ranks.count(steps)
