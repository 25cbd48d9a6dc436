"""A forward model, the control of the paper's appendix (after Dyna): what may follow, instead of
what may have led here.

    p(ds_t | s_t, a_t),   ds_t = s_{t+1} - s_t

learned from the same transitions as the backtracking model. It imagines what the policy would do
from experienced states; episodes that reach their goal are imitated in the place of recall traces.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from goalgan_bt.agent.networks import MLP, RELU
from goalgan_bt.agent.policy import Actor, GaussianPolicy
from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.recall.backtracking import Scale, learn_gaussian, sample_gaussian
from goalgan_bt.recall.settings import BacktrackingConfig
from goalgan_bt.recall.transitions import Steps
from goalgan_bt.runs import checkpoint


class ForwardModel(nn.Module):
    """p(ds | s, a) with a learned variance, in normalised units.

    Args:
        state_dim, act_dim: sizes of the physical state and of the action.
        cfg: settings; those of the backtracking model, whose place it takes.
        generator: the source of minibatches and samples.
    """

    def __init__(
        self, state_dim: int, act_dim: int, cfg: BacktrackingConfig, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.cfg, self._rng = cfg, generator
        self.net = MLP((state_dim + act_dim, *cfg.hidden, 2 * state_dim), RELU)
        self.state_scale, self.delta_scale = Scale(state_dim), Scale(state_dim)
        self.optimiser = torch.optim.Adam(self.net.parameters(), lr=cfg.learning_rate, fused=True)

    def fit(
        self, states: FloatArray, actions: FloatArray, next_states: FloatArray
    ) -> dict[str, float]:
        """Maximise log p(ds | s, a) for `cfg.steps` steps.

        Args:
            states, next_states: (n, state_dim); actions: (n, act_dim).

        Returns:
            forward_nll, nats per dimension in normalised units.
        """
        size, losses = self.cfg.batch, []
        rows = torch.randint(len(states), (self.cfg.steps * size,), generator=self._rng).numpy()
        before, acted, following = (
            torch.from_numpy(x[rows]).float() for x in (states, actions, next_states)
        )
        deltas = following - before
        self.state_scale.set(before)
        self.delta_scale.set(deltas)
        inputs, targets = self._inputs(before, acted), self.delta_scale.normalise(deltas)
        for x, target in zip(inputs.split(size), targets.split(size), strict=True):
            losses.append(learn_gaussian(self.net, x, target))
            nn.utils.clip_grad_norm_(self.parameters(), 1.0)
            self.optimiser.step()
        return {"forward_nll": float(np.mean(losses))} if losses else {}

    def get_extra_state(self) -> dict[str, Any]:
        """The optimiser's state, which goes into the `state_dict`."""
        return self.optimiser.state_dict()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over what `get_extra_state` gave."""
        checkpoint.restore(self.optimiser, state)

    @torch.no_grad()
    def successors(self, states: Tensor, actions: Tensor) -> Tensor:
        """Sample s_{t+1} given s_t and a_t, (n, state_dim)."""
        delta = sample_gaussian(self.net, self._inputs(states, actions), self._rng)
        return states + self.delta_scale.restore(delta)

    def _inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        return torch.cat([self.state_scale.normalise(states), actions], dim=-1)


def imagine(
    model: ForwardModel,
    policy: GaussianPolicy,
    env: GoalEnv,
    states: FloatArray,
    goals: FloatArray,
    length: int,
    noise: torch.Generator,
) -> Steps:
    """Let the policy act in the model, and keep the steps of imagined episodes that succeed, for
    the goals that they wanted.

    Args:
        model: the forward model.
        policy: pi.
        env: knows what succeeds.
        states: (n, state_dim) where they begin.
        goals: (n, goal_dim) what they want.
        length: actions at most.
        noise: draws actions.
    """
    n = len(states)
    if n == 0:
        return Steps(states, np.empty((0, env.act_dim)), goals)
    act, successful = Actor(policy), np.zeros(n, dtype=bool)
    alive = ~env.reached(env.achieved_goals(states), goals)
    visited = np.zeros((length, n, env.state_dim))
    actions = np.zeros((length, n, env.act_dim))
    taken = np.zeros((length, n), dtype=bool)
    for t in range(length):
        drawn = torch.randn(n, env.act_dim, generator=noise)
        said = np.clip(act(env.observations(states, goals), drawn), -1.0, 1.0)
        visited[t], actions[t] = states, env.to_body(said, states, goals)
        taken[t] = alive
        s, a = (torch.from_numpy(x).float() for x in (states, actions[t]))
        following = env.repair(model.successors(s, a).double().numpy())
        alive = alive & env.valid(following)
        states = np.where(alive[:, None], following, states)
        reached = alive & env.reached(env.achieved_goals(states), goals)
        successful |= reached
        alive &= ~reached
    kept = taken & successful
    spread = np.broadcast_to(goals, (length, n, env.goal_dim))
    return Steps(visited[kept], actions[kept], spread[kept])
