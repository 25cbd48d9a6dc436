"""Goals: how hard they are for the present policy, which to keep, which to try next.

A goal is of intermediate difficulty when r_min < p(success | goal) < r_max (Florensa et al. 2018,
section 4.1). One update sees about two episodes per goal, so that counting successes per goal
gives shares of 0, 1/2 or 1; a small network fitted to the outcomes of all recent episodes
estimates p instead (`SuccessEstimator`).
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.policy import mlp


@dataclass(frozen=True)
class GoalsConfig:
    """Labels and replay of goals."""

    r_min: float = 0.1
    """Goals reached less often are too hard (Florensa 2018)."""
    r_max: float = 0.9
    """Goals reached more often are mastered (Florensa 2018)."""
    new: int = 200
    """Goals from the GAN per iteration."""
    old: int = 100
    """Goals from the replay per iteration."""
    replay_distance: float = 0.3
    """Replayed goals keep this distance from each other, metres."""
    label_rollouts: int = 0
    """Fresh episodes per goal for its label (the original: 3); 0 takes labels from training."""
    episodes: int = 3000
    """Recent training episodes that the success estimator is fitted to."""
    estimator_steps: int = 60
    """Gradient steps of the success estimator per policy update."""


def intermediate(success: FloatArray, r_min: float, r_max: float) -> BoolArray:
    """Whether goals are of intermediate difficulty: r_min < success < r_max, (n,) -> (n,).

    Which policy the labels describe depends on where `success` comes from. From the
    `SuccessEstimator` (the default) it is an average over the policies that made the last few
    thousand episodes. From fresh rollouts (`label_rollouts`) it is the policy after the
    iteration's updates, as in the original.
    """
    return (success > r_min) & (success < r_max)


class GoalReplay:
    """Goals that once were of intermediate difficulty, each at some distance from all others.

    Replaying them keeps the policy from forgetting (Florensa et al. 2018, section 4.3).
    """

    def __init__(self, goal_dim: int, distance: float) -> None:
        self.goals = np.empty((0, goal_dim))
        self.distance = distance

    def __len__(self) -> int:
        return len(self.goals)

    def add(self, goals: FloatArray) -> None:
        """Keep those of the goals (n, goal_dim) that are far enough from all that is kept."""
        for goal in goals:
            if (np.linalg.norm(self.goals - goal, axis=1) > self.distance).all():
                self.goals = np.append(self.goals, goal[None], axis=0)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """At most n different goals, (<= n, goal_dim)."""
        return self.goals[rng.permutation(len(self.goals))[:n]]


class SuccessEstimator:
    """p(success | goal) from the start, fitted to the outcomes of recent training episodes.

    It costs no environment step, uses every episode, and is a coverage map between evaluations.

    Args:
        low, high: (goal_dim,) the goal box, metres.
        cfg: settings.
        generator: the source of minibatches.
    """

    def __init__(
        self, low: FloatArray, high: FloatArray, cfg: GoalsConfig, generator: torch.Generator
    ) -> None:
        self.low, self.high, self.cfg, self._rng = low, high, cfg, generator
        self.net = mlp((len(low), 64, 64, 1), nn.Tanh)
        self.optimiser = torch.optim.Adam(self.net.parameters(), lr=3e-3, fused=True)
        self.goals = np.empty((0, len(low)))
        self.success = np.empty(0)

    def add(self, goals: FloatArray, success: BoolArray) -> None:
        """Remember finished episodes: goals (n, goal_dim) and whether each was reached, (n,)."""
        self.goals = np.concatenate([self.goals, goals])[-self.cfg.episodes :]
        self.success = np.concatenate([self.success, success])[-self.cfg.episodes :]

    def fit(self) -> dict[str, float]:
        """Take `estimator_steps` gradient steps; gives the mean cross-entropy, nats."""
        if len(self.goals) == 0:
            return {}
        x, y = self._input(self.goals), torch.from_numpy(self.success).float()
        losses = []
        for _ in range(self.cfg.estimator_steps):
            rows = torch.randint(len(x), (256,), generator=self._rng)
            logits = self.net(x[rows]).squeeze(-1)
            loss = nn.functional.binary_cross_entropy_with_logits(logits, y[rows])
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
            self.optimiser.step()
            losses.append(loss.item())
        return {"loss": float(np.mean(losses))}

    @torch.no_grad()
    def __call__(self, goals: FloatArray) -> FloatArray:
        """Estimated success from the start, (n, goal_dim) -> (n,) in [0, 1]."""
        return torch.sigmoid(self.net(self._input(goals)).squeeze(-1)).double().numpy()

    def _input(self, goals: FloatArray) -> Tensor:
        scaled = 2 * (goals - self.low) / (self.high - self.low) - 1
        return torch.from_numpy(scaled).float()
