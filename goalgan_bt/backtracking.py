"""The backtracking model: what state and action may have led here (Recall Traces, section 2.1).

    q(ds_t, a_t | s_{t+1}) = q(ds_t | a_t, s_{t+1}) q(a_t | s_{t+1}),   ds_t = s_t - s_{t+1}

Two networks, trained by maximum likelihood (equation 2) on the transitions of trajectories that
reached their goal, and unrolled backward from a state: s_t = s_{t+1} + ds_t. The state here is the
body's physical state (positions and velocities), without the goal: physics does not know it.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from goalgan_bt.envs.batch import GoalEnv
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.mlp import MLP, RELU, TANH, Linearised
from goalgan_bt.settings import BacktrackingConfig

Float32 = NDArray[np.float32]


LOG_VAR = (-10.0, 2.0)  # bounds of the learned log variance, normalised units


class Transitions:
    """A ring of transitions (s, a, s') of successful episodes.

    Attributes:
        states, next_states: (capacity, state_dim); actions: (capacity, act_dim); the first
            `size` rows count.
    """

    def __init__(self, state_dim: int, act_dim: int, cfg: BacktrackingConfig) -> None:
        capacity, self._minimum = cfg.buffer, cfg.min_transitions
        self.states = np.zeros((capacity, state_dim), np.float32)
        self.actions = np.zeros((capacity, act_dim), np.float32)
        self.next_states = np.zeros((capacity, state_dim), np.float32)
        self.size, self.cursor = 0, 0

    def add(self, states: Float32, actions: Float32, next_states: Float32) -> None:
        """Append rows; the oldest make room."""
        capacity = len(self.states)
        states, actions, next_states = (x[-capacity:] for x in (states, actions, next_states))
        rows = (self.cursor + np.arange(len(states))) % capacity
        self.states[rows], self.actions[rows] = states, actions
        self.next_states[rows] = next_states
        self.cursor = int((self.cursor + len(states)) % capacity)
        self.size = min(self.size + len(states), capacity)

    @property
    def enough(self) -> bool:
        """Whether there are transitions enough to learn from."""
        return self.size >= self._minimum

    def sample_states(self, n: int, rng: np.random.Generator) -> FloatArray:
        """At most n random states that the agent has had, (<= n, state_dim); none too early."""
        rows = rng.permutation(self.size)[:n] if self.enough else np.empty(0, dtype=np.int64)
        return self.next_states[rows].astype(np.float64)


class RecallTraces(NamedTuple):
    """n traces of L steps, the step nearest the goal first.

    states: (L, n, state_dim) s_t; actions: (L, n, act_dim) a_t in [-1, 1], taken in s_t;
    valid: (L, n) False from the first invalid state on; goals: (n, goal_dim) where each ends;
    seeds: (n, state_dim) the decoded states from which they were unrolled.
    """

    states: FloatArray
    actions: FloatArray
    valid: BoolArray
    goals: FloatArray
    seeds: FloatArray

    def pairs(self, env: GoalEnv) -> tuple[Tensor, Tensor]:
        """What imitation needs of the valid steps: observations with the goal that seeded the
        trace, (m, obs_dim), and the actions that a policy would have to take, (m, act_dim)."""
        goals = np.broadcast_to(self.goals, (*self.valid.shape, env.goal_dim))[self.valid]
        states = self.states[self.valid]
        actions = env.from_body(self.actions[self.valid], states, goals)
        return torch.from_numpy(env.observations(states, goals)), torch.from_numpy(actions).float()

    def paths(self, env: GoalEnv) -> Float32:
        """Achieved goals along each trace, (L, n, goal_dim), NaN after it stopped."""
        achieved = env.achieved_goals(self.states.reshape(-1, env.state_dim))
        paths = achieved.reshape(*self.valid.shape, env.goal_dim)
        return np.where(self.valid[..., None], paths, np.nan).astype(np.float32)


class Scale(nn.Module):
    """Mean and standard deviation of a quantity, set from data; the same in fit and in traces."""

    mean: Tensor
    std: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("std", torch.ones(dim))

    def set(self, data: Tensor) -> None:
        """Statistics of data (n, dim), the standard deviation at least 1e-3."""
        std, self.mean = torch.std_mean(data, dim=0)
        self.std = std.clamp(min=1e-3)

    def normalise(self, x: Tensor) -> Tensor:
        """To zero mean and unit variance."""
        return (x - self.mean) / self.std

    def restore(self, x: Tensor) -> Tensor:
        """Back to the quantity's own units."""
        return x * self.std + self.mean


class BacktrackingModel(nn.Module):
    """q(a | s') with unit variance and q(ds | a, s') with a learned one, in normalised units.

    Args:
        state_dim, act_dim: sizes of the physical state and of the action.
        cfg: settings.
        generator: the source of minibatches and samples.
    """

    def __init__(
        self, state_dim: int, act_dim: int, cfg: BacktrackingConfig, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.cfg, self._rng = cfg, generator
        self.action_net = MLP((state_dim, *cfg.hidden, act_dim), TANH)
        self.state_net = MLP((state_dim + act_dim, *cfg.hidden, 2 * state_dim), RELU)
        self.state_scale, self.delta_scale = Scale(state_dim), Scale(state_dim)
        self.action_scale = Scale(act_dim)
        params = [*self.action_net.parameters(), *self.state_net.parameters()]
        self.optimiser = torch.optim.Adam(params, lr=cfg.learning_rate, fused=True)

    def fit(self, data: Transitions) -> dict[str, float]:
        """Maximise log q(ds, a | s') (equation 2) for `cfg.steps` steps.

        Returns:
            action_nll and state_nll, nats per dimension in normalised units (mean over steps);
            nothing while the buffer is too small, or where no traces are wanted.
        """
        n, steps = data.size, self.cfg.steps
        if not data.enough or steps == 0 or self.cfg.trace_length == 0:
            return {}
        rows = torch.randint(n, (steps * self.cfg.batch,), generator=self._rng).numpy()
        following = torch.from_numpy(data.next_states[rows])
        actions = torch.from_numpy(data.actions[rows])
        deltas = torch.from_numpy(data.states[rows]) - following
        # Statistics of these rows alone: the whole buffer took longer than the steps.
        for scale, x in (
            (self.state_scale, following),
            (self.action_scale, actions),
            (self.delta_scale, deltas),
        ):
            scale.set(x)
        losses = np.zeros((steps, 2))
        batches = (x.split(self.cfg.batch) for x in (following, actions, deltas))
        for i, batch in enumerate(zip(*batches, strict=True)):
            losses[i] = self.negative_log_likelihood(*batch)
            nn.utils.clip_grad_norm_(self.parameters(), 1.0)
            self.optimiser.step()
        action_nll, state_nll = losses.mean(axis=0)
        return {"action_nll": action_nll, "state_nll": state_nll}

    @torch.no_grad()
    def negative_log_likelihood(
        self, next_states: Tensor, actions: Tensor, deltas: Tensor
    ) -> tuple[float, float]:
        """-log q(a | s') and -log q(ds | a, s'), means over the batch and the dimensions; leaves
        the gradients of their sum in the two networks.

        Args:
            next_states: (n, state_dim); actions: (n, act_dim); deltas: (n, state_dim).
        """
        s, a = self.state_scale.normalise(next_states), self.action_scale.normalise(actions)
        constant = 0.5 * math.log(2 * math.pi)
        acted = Linearised(self.action_net, s)
        miss = acted.output - a
        self.action_net.flat.grad = acted.vjp(miss / miss.numel())

        moved = Linearised(self.state_net, torch.cat([s, a], dim=-1))
        mean, log_var = moved.output.chunk(2, dim=-1)
        bounded = log_var.clamp(*LOG_VAR)
        error, precision = mean - self.delta_scale.normalise(deltas), torch.exp(-bounded)
        chi = error.square() * precision
        of_log_var = 0.5 * (1 - chi) * (bounded == log_var)
        u = torch.cat([error * precision, of_log_var], dim=-1) / error.numel()
        self.state_net.flat.grad = moved.vjp(u)
        action_nll = 0.5 * miss.square().mean().item() + constant
        return action_nll, 0.5 * (chi + bounded).mean().item() + constant

    @torch.no_grad()
    def predecessors(self, next_states: Tensor) -> tuple[Tensor, Tensor]:
        """Sample (s_t, a_t) given s_{t+1}: (n, state_dim) -> (n, state_dim), (n, act_dim)."""
        s = self.state_scale.normalise(next_states)
        a = self.action_net(s)
        if self.cfg.sample_actions:
            a = a + torch.randn(a.shape, generator=self._rng)
        actions = self.action_scale.restore(a).clamp(-1.0, 1.0)  # the body feels no more
        a = self.action_scale.normalise(actions)
        mean, log_var = self.state_net(torch.cat([s, a], dim=-1)).chunk(2, dim=-1)
        log_var = log_var.clamp(*LOG_VAR)
        noise = torch.randn(mean.shape, generator=self._rng)
        delta = self.delta_scale.restore(mean + torch.exp(0.5 * log_var) * noise)
        return next_states + delta, actions


def recall_traces(
    model: BacktrackingModel, env: GoalEnv, seeds: FloatArray, goals: FloatArray, length: int
) -> RecallTraces:
    """Unroll the model backward from states that stand on goals.

    A trace stops at the first state that is not valid (in a wall, fallen, not finite).

    Args:
        model: the backtracking model.
        env: knows which states are valid.
        seeds: (n, state_dim) full states, from the decoder.
        goals: (n, goal_dim) the goals on which they stand.
        length: L.
    """
    n = len(seeds)
    states = np.zeros((length, n, env.state_dim))
    actions = np.zeros((length, n, env.act_dim))
    valid = np.zeros((length, n), dtype=bool)
    current, alive = seeds, np.ones(n, dtype=bool)
    for t in range(length if n else 0):
        previous, action = model.predecessors(torch.from_numpy(current).float())
        current = env.repair(previous.double().numpy())
        alive = alive & env.valid(current)
        states[t], actions[t], valid[t] = current, action.numpy(), alive
        current = np.where(alive[:, None], current, seeds)  # a dead trace stays finite
    return RecallTraces(states, actions, valid, goals, seeds)
