"""The backtracking model: what state and action may have led here (Recall Traces, section 2.1).

    q(ds_t, a_t | s_{t+1}) = q(ds_t | a_t, s_{t+1}) q(a_t | s_{t+1}),   ds_t = s_t - s_{t+1}

Two networks, trained by maximum likelihood (equation 2) on transitions of trajectories (the paper:
those that reached their goal; by default all that did not fall), and unrolled backward from a
state: s_t = s_{t+1} + ds_t. The state here is the body's physical state (positions and velocities),
without the goal: physics does not know it.
"""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from goalgan_bt.agent.networks import MLP, RELU, TANH, Linearised, first_weights
from goalgan_bt.recall.settings import BacktrackingConfig
from goalgan_bt.runs import checkpoint
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.ranges import require, require_whole

Array = NDArray[np.floating]

LOG_VAR = (-10.0, 2.0)  # bounds of the learned log variance, normalised units
CONSTANT = 0.5 * math.log(2 * math.pi)  # of a Gaussian's log density, per dimension
HELD_OUT = 256  # new transitions on which the model is tried before it learns from them


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
        if data.shape[1] == 0:  # goals, where there are none
            return
        std, self.mean = torch.std_mean(data, dim=0)
        self.std = std.clamp(min=1e-3)

    def normalise(self, x: Tensor) -> Tensor:
        """To zero mean and unit variance."""
        return (x - self.mean) / self.std

    def restore(self, x: Tensor) -> Tensor:
        """Back to the quantity's own units."""
        return x * self.std + self.mean


def learn_gaussian(net: MLP, inputs: Tensor, target: Tensor) -> float:
    """-log density of a target (n, k) under the network's Gaussian, whose outputs (n, 2 k) are mean
    and log variance: the mean over batch and dimensions, whose gradient it leaves in the network.
    """
    at = Linearised(net, inputs)
    mean, log_var = at.output.chunk(2, dim=-1)
    bounded = log_var.clamp(*LOG_VAR)
    error, precision = mean - target, torch.exp(-bounded)
    chi = error.square() * precision
    of_log_var = 0.5 * (1 - chi) * (bounded == log_var)
    net.flat.grad = at.vjp(torch.cat([error * precision, of_log_var], dim=-1) / error.numel())
    return 0.5 * (chi + bounded).mean().item() + CONSTANT


def sample_gaussian(net: MLP, inputs: Tensor, generator: torch.Generator) -> Tensor:
    """A draw from the network's Gaussian, (n, k)."""
    mean, log_var = net(inputs).chunk(2, dim=-1)
    noise = torch.randn(mean.shape, generator=generator)
    return mean + torch.exp(0.5 * log_var.clamp(*LOG_VAR)) * noise


class BacktrackingModel(nn.Module):
    """q(a | s') with unit variance and q(ds | a, s') with a learned one, in normalised units; with
    `cfg.conditioned` q(a | s', g).

    Args:
        state_dim, act_dim: sizes of a state and of an action, whose numbers are in [-1, 1].
        goal_dim: size of a goal, if the model is told goals.
        cfg: settings.
        seed: of its weights, minibatches and samples.
        generator: the source of minibatches and samples, of a learner that has seeded torch itself;
            the seed then counts for nothing.
    """

    def __init__(
        self,
        state_dim: int,
        act_dim: int,
        goal_dim: int = 0,
        cfg: BacktrackingConfig | None = None,
        *,
        seed: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.cfg = cfg = cfg or BacktrackingConfig()
        require_whole("state_dim", state_dim, 1)
        require_whole("act_dim", act_dim, 1)
        require_whole("goal_dim", goal_dim, 0)
        require(cfg)
        told = state_dim + (goal_dim if cfg.conditioned else 0)
        with first_weights(seed if generator is None else None):
            self.action_net = MLP((told, *cfg.hidden, act_dim), TANH)
            self.state_net = MLP((state_dim + act_dim, *cfg.hidden, 2 * state_dim), RELU)
        self._rng = generator or torch.Generator().manual_seed(seed)
        self.state_scale, self.delta_scale = Scale(state_dim), Scale(state_dim)
        self.action_scale, self.goal_scale = Scale(act_dim), Scale(goal_dim)
        params = [*self.action_net.parameters(), *self.state_net.parameters()]
        self.optimiser = torch.optim.Adam(params, lr=cfg.learning_rate, fused=True)

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of a state, of an action and of a goal."""
        state, action, goal = self.state_scale.mean, self.action_scale.mean, self.goal_scale.mean
        return len(state), len(action), len(goal)

    def fit(
        self,
        states: Array,
        actions: Array,
        next_states: Array,
        goals: Array | None = None,
        *,
        steps: int | None = None,
        unseen: NDArray[np.int64] | None = None,
    ) -> dict[str, float]:
        """Maximise log q(ds, a | s') (equation 2) on minibatches of transitions; with no steps, as
        the control of an untrained model has it, only learn the scales.

        Args:
            states, next_states: (n, state_dim); actions: (n, act_dim) in [-1, 1].
            goals: (n, goal_dim) that the actions led to.
            steps: training steps, `cfg.steps` if None: that is for a call per policy update; for a
                model from data that is all there, give some thousand.
            unseen: rows of which the model knows nothing yet, to try it on.

        Returns:
            action_nll and state_nll, nats per dimension in normalised units (mean over steps), and,
            before those steps, held_out_action_nll and held_out_state_nll of the unseen rows.

        Raises:
            UsageError: if the arrays do not fit each other or the model, or are not finite.
        """
        rows, (state_dim, act_dim, goal_dim) = len(states), self.sizes
        data = states, actions, next_states, np.empty((rows, 0)) if goals is None else goals
        names = "states", "actions", "next_states", "goals"
        for name, array, size in zip(
            names, data, (state_dim, act_dim, state_dim, goal_dim), strict=True
        ):
            if np.shape(array) != (rows, size) or not rows:
                raise UsageError(
                    f"{name} must be {max(rows, 1)} rows of {size} numbers, "
                    f"not an array of shape {np.shape(array)}"
                )
        metrics = {}
        if unseen is not None and len(unseen):
            some = unseen[:: max(1, len(unseen) // HELD_OUT)]
            action_nll, state_nll = self.negative_log_likelihood(*_batch(data, some))
            metrics = {"held_out_action_nll": action_nll, "held_out_state_nll": state_nll}

        steps, size = self.cfg.steps if steps is None else steps, self.cfg.batch
        require_whole("steps", steps, 0)
        drawn = torch.randint(rows, (max(1, steps) * size,), generator=self._rng).numpy()
        batch = _batch(data, drawn)
        if not all(x.isfinite().all() for x in batch):
            raise UsageError("a number in the transitions is not finite: leave those out")
        scales = self.state_scale, self.action_scale, self.delta_scale, self.goal_scale
        # Statistics of these rows alone: the whole buffer took longer than the steps.
        for scale, x in zip(scales, batch, strict=True):
            scale.set(x)
        losses = np.zeros((steps, 2))
        parts = [x.split(size) for x in batch]
        for i in range(steps):
            losses[i] = self.negative_log_likelihood(*(part[i] for part in parts))
            nn.utils.clip_grad_norm_(self.parameters(), 1.0)
            self.optimiser.step()
        if steps:
            metrics["action_nll"], metrics["state_nll"] = losses.mean(axis=0)
        return metrics

    def get_extra_state(self) -> dict[str, Any]:
        """The optimiser's state, which goes into the `state_dict`."""
        return self.optimiser.state_dict()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over what `get_extra_state` gave."""
        checkpoint.restore(self.optimiser, state)

    @torch.no_grad()
    def negative_log_likelihood(
        self, next_states: Tensor, actions: Tensor, deltas: Tensor, goals: Tensor
    ) -> tuple[float, float]:
        """-log q(a | s') and -log q(ds | a, s'), means over the batch and the dimensions; leaves
        the gradients of their sum in the two networks.

        Args:
            next_states: (n, state_dim); actions: (n, act_dim); deltas: (n, state_dim); goals:
                (n, goal_dim).
        """
        s, a = self.state_scale.normalise(next_states), self.action_scale.normalise(actions)
        acted = Linearised(self.action_net, self._told(s, goals))
        miss = acted.output - a
        self.action_net.flat.grad = acted.vjp(miss / miss.numel())
        delta = self.delta_scale.normalise(deltas)
        state_nll = learn_gaussian(self.state_net, torch.cat([s, a], dim=-1), delta)
        return 0.5 * miss.square().mean().item() + CONSTANT, state_nll

    @torch.no_grad()
    def predecessors(self, next_states: Tensor, goals: Tensor) -> tuple[Tensor, Tensor]:
        """Sample (s_t, a_t) given s_{t+1}, on the way to those goals: (n, state_dim),
        (n, goal_dim) -> (n, state_dim), (n, act_dim)."""
        s = self.state_scale.normalise(next_states)
        a = self.action_net(self._told(s, goals))
        if self.cfg.sample_actions:
            a = a + torch.randn(a.shape, generator=self._rng)
        actions = self.action_scale.restore(a).clamp(-1.0, 1.0)  # the body feels no more
        a = self.action_scale.normalise(actions)
        delta = sample_gaussian(self.state_net, torch.cat([s, a], dim=-1), self._rng)
        return next_states + self.delta_scale.restore(delta), actions

    @torch.no_grad()
    def action_log_density(self, next_states: Tensor, actions: Tensor) -> Tensor:
        """log q(a | s') of a model that is not told goals, (n, state_dim), (n, act_dim) -> (n,)."""
        mean = self.action_net(self.state_scale.normalise(next_states))
        miss = mean - self.action_scale.normalise(actions)
        per_dim = 0.5 * miss.square() + CONSTANT + self.action_scale.std.log()
        return -per_dim.sum(dim=-1)

    def _told(self, s: Tensor, goals: Tensor) -> Tensor:
        """The input of q(a | s') or, where it is conditioned, of q(a | s', g)."""
        if not self.cfg.conditioned:
            return s
        return torch.cat([s, self.goal_scale.normalise(goals)], dim=-1)


def _batch(data: tuple[Array, ...], rows: NDArray[np.int64]) -> tuple[Tensor, ...]:
    """What `negative_log_likelihood` takes, of some rows of states, actions, next states, goals."""
    before, actions, following, goals = (
        torch.from_numpy(np.asarray(array)[rows]).float() for array in data
    )
    return following, actions, before - following, goals
