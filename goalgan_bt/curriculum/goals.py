"""Goals: how hard they are for the present policy, which to keep, which to try next.

A goal is of intermediate difficulty when r_min < p(success | goal) < r_max (Florensa et al. 2018,
section 4.1). One update sees about two episodes per goal, so that counting successes per goal
gives shares of 0, 1/2 or 1; the recent episodes to nearby goals estimate p instead
(`SuccessEstimator`).
"""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from goalgan_bt.curriculum.settings import GoalsConfig
from goalgan_bt.envs.maze import BoolArray, FloatArray

FAR = 1e6  # metres, from where no goal is
TRIES = 5000  # episodes whose failures count


def intermediate(success: FloatArray, r_min: float, r_max: float) -> BoolArray:
    """Whether goals are of intermediate difficulty: r_min < success < r_max, (n,) -> (n,).

    Which policy the labels describe depends on where `success` comes from. From the
    `SuccessEstimator` (the default) it is an average over the policies that made the last
    `episodes` episodes. From fresh rollouts (`label_rollouts`) it is the policy before the last
    of the iteration's updates (the original: after it).
    """
    return (success > r_min) & (success < r_max)


class GoalMemory:
    """Goals, each at some distance from all others.

    One holds the goals that once were of intermediate difficulty: replaying them keeps the policy
    from forgetting (Florensa et al. 2018, section 4.3). Another holds where the agent has been.
    """

    def __init__(self, goal_dim: int, distance: float) -> None:
        self.goals: FloatArray = np.empty((0, goal_dim))
        self.distance = distance

    def __len__(self) -> int:
        return len(self.goals)

    def add(self, goals: FloatArray) -> None:
        """Keep those of the goals (n, goal_dim) that are far enough from all that is kept."""
        if len(self):  # most are near, and looking that up at once is fast
            goals = goals[self.distance_to(goals) > self.distance]
        for goal in goals:
            if (np.linalg.norm(self.goals - goal, axis=1) > self.distance).all():
                self.goals = np.append(self.goals, goal[None], axis=0)

    def distance_to(self, goals: FloatArray) -> FloatArray:
        """From each goal (n, goal_dim) to the nearest one kept, (n,); infinite if none is."""
        return np.asarray(cKDTree(self.goals).query(goals)[0])

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """At most n different goals, (<= n, goal_dim)."""
        return self.goals[rng.permutation(len(self.goals))[:n]]


def goals_of(rows: Tensor, goal_dim: int) -> FloatArray:
    """Goals that were saved, (n, goal_dim).

    Raises:
        ValueError: if they are none.
    """
    goals = rows.numpy().astype(float)
    if goals.shape[1:] != (goal_dim,) or not (np.abs(goals) < FAR).all():
        raise ValueError("goals that it remembers are none")
    return goals


class SuccessEstimator:
    """p(success | goal) from the start: the share of successes among the nearest recent episodes.

    It costs no environment step, uses every episode from the start, follows the policy as fast as
    episodes end, and is a coverage map between evaluations.
    """

    def __init__(self, goal_dim: int, cfg: GoalsConfig) -> None:
        self.cfg = cfg
        self.goals: FloatArray = np.empty((0, goal_dim))
        self.success: FloatArray = np.empty(0)

    def add(self, goals: FloatArray, success: FloatArray | BoolArray) -> None:
        """Remember finished episodes: goals (n, goal_dim) and whether each was reached, (n,)."""
        kept = max(self.cfg.episodes, TRIES)
        self.goals = np.concatenate([self.goals, goals])[-kept:]
        self.success = np.concatenate([self.success, success])[-kept:]

    def state_dict(self) -> dict[str, Tensor]:
        """The episodes that it remembers."""
        return {"goals": torch.from_numpy(self.goals), "success": torch.from_numpy(self.success)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take over what `state_dict` gave."""
        goals = goals_of(state["goals"], self.goals.shape[1])
        success = state["success"].numpy().astype(float)
        if success.shape != (len(goals),) or not ((success >= 0) & (success <= 1)).all():
            raise ValueError("the outcomes of its episodes are none")
        self.goals, self.success = goals, success

    def __call__(self, goals: FloatArray) -> FloatArray:
        """Estimated success, (n, goal_dim) -> (n,) in [0, 1]; NaN while nothing is known."""
        k = self.cfg.neighbours
        tried, success = self.goals[-self.cfg.episodes :], self.success[-self.cfg.episodes :]
        if len(tried) < k:
            return np.full(len(goals), np.nan)
        # The squared distance less |goal|^2, which is the same for all of a row.
        distance = np.square(tried).sum(axis=1) - 2 * goals @ tried.T
        nearest = np.argpartition(distance, k - 1, axis=1)[:, :k]
        return np.asarray(success[nearest].mean(axis=1))

    def hopeless(self, goals: FloatArray) -> BoolArray:
        """Whether the nearest tries of those remembered, as many as `cfg.hopeless`, were within
        `cfg.near` of a goal and failed, (n, goal_dim) -> (n,)."""
        k = self.cfg.hopeless
        if len(self.goals) < k:
            return np.zeros(len(goals), dtype=bool)
        distance, nearest = cKDTree(self.goals).query(goals, range(1, k + 1))
        return np.asarray(
            (distance <= self.cfg.near).all(axis=1) & ~self.success[nearest].any(axis=1)
        )
