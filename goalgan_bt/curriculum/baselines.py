"""Baselines that know the world: uniform goals in the free space, and the rejection oracle.

Florensa et al. 2018, section 5.
"""

import numpy as np
import torch

from goalgan_bt.agent.coverage import success_rate
from goalgan_bt.agent.policy import GaussianPolicy
from goalgan_bt.curriculum.goals import intermediate
from goalgan_bt.curriculum.settings import GoalsConfig
from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.envs.maze import FloatArray


def feasible(env: GoalEnv, n: int, rng: np.random.Generator) -> FloatArray:
    """Uniform goals in the free space, (n, goal_dim)."""
    goals = np.empty((0, env.goal_dim))
    while len(goals) < n:
        drawn = rng.uniform(env.goal_low, env.goal_high, (4 * n, env.goal_dim))
        goals = np.concatenate([goals, drawn[env.feasible(drawn)]])
    return goals[:n]


def oracle(
    env: GoalEnv,
    policy: GaussianPolicy,
    cfg: GoalsConfig,
    rng: np.random.Generator,
    noise: torch.Generator,
) -> tuple[FloatArray, int]:
    """Uniform free goals of which fresh episodes of the policy show intermediate difficulty.

    Args:
        env: simulations for this purpose.
        policy: pi.
        cfg: how many to try; what intermediate means.
        rng: draws goals.
        noise: draws actions.

    Returns:
        Goals, (n <= cfg.new, goal_dim), all that were tried if none is intermediate; and the
        environment steps spent.
    """
    goals = feasible(env, cfg.new, rng)
    success, steps = success_rate(env, policy, goals, cfg.label_rollouts or 3, noise)
    good = intermediate(success, cfg.r_min, cfg.r_max)
    return goals[good] if good.any() else goals, steps
