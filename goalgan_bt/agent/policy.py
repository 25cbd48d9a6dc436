"""The policy and the value function: tanh networks on normalised observations.

As in rllab's TRPO: a Gaussian policy whose mean is an MLP and whose log standard deviation is a
free parameter. Observations already hold the desired goal, so both are goal-conditioned.
"""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from goalgan_bt.agent.networks import MLP, TANH, Linearised, tanh_
from goalgan_bt.agent.settings import PolicyConfig, ValueConfig
from goalgan_bt.runs import checkpoint, ranks


class Normaliser(nn.Module):
    """Running mean and variance of observations; maps them to about unit scale, within +-5."""

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim, dtype=torch.float64))
        self.register_buffer("var", torch.ones(dim, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def update(self, obs: Tensor) -> None:
        """Take in more observations, (n, dim), as many of each rank (Chan et al.'s parallel
        variance)."""
        n = ranks.size() * len(obs)
        mean = ranks.mean(obs.mean(dim=0))
        var = ranks.mean((obs - mean).square().mean(dim=0))
        total = self.count + n
        delta = mean - self.mean
        self.var = (self.var * self.count + var * n + delta**2 * self.count * n / total) / total
        self.mean = self.mean + delta * n / total
        self.count = total

    def shift_and_scale(self) -> tuple[Tensor, Tensor]:
        """What maps an observation to (obs - shift) * scale, each (dim,) float32."""
        return self.mean.float(), torch.rsqrt(self.var + 1e-6).float()

    def forward(self, obs: Tensor) -> Tensor:
        """Normalised observations, (n, dim) -> (n, dim) float32."""
        return normalise(obs, *self.shift_and_scale())


def normalise(obs: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """(obs - shift) * scale within +-5, (n, dim) -> (n, dim)."""
    return (obs - shift).mul_(scale).clamp_(-5.0, 5.0)


class GaussianPolicy(nn.Module):
    """pi(a | s, g): a diagonal Gaussian whose mean is an MLP plus a linear map.

    Linear feedback carries much of locomotion (Rajeswaran et al. 2017); beside the MLP it makes
    the Ant learn faster (docs/LOG.md).
    """

    max_std: Tensor

    def __init__(self, obs_dim: int, act_dim: int, cfg: PolicyConfig) -> None:
        super().__init__()
        self.normaliser = Normaliser(obs_dim)
        sizes = (obs_dim, *cfg.hidden, act_dim)
        self.net = MLP(sizes, TANH, output_gain=0.01, input_gain=cfg.input_gain, skip=True)
        self.log_std = nn.Parameter(torch.full((act_dim,), math.log(cfg.init_std)))
        self.cfg = cfg
        # A buffer: whoever loads the policy acts with the noise that it had.
        self.register_buffer("max_std", torch.zeros((), dtype=torch.float64))
        self.cap_std(0.0)

    def cap_std(self, progress: float) -> None:
        """Set the bound on the standard deviation for this progress in the run, 0 to 1."""
        first, last = self.cfg.init_std, self.cfg.final_std
        cap = math.inf if last is None else first + min(progress, 1.0) * (last - first)
        self.max_std.fill_(cap)

    def bounded_log_std(self) -> Tensor:
        """Log standard deviation of the actions, (act_dim,)."""
        return self.log_std.clamp(math.log(self.cfg.min_std), math.log(self.max_std.item()))

    def free(self) -> Tensor:
        """1 for each log standard deviation that learns, 0 where a bound holds it, (act_dim,)."""
        return (self.bounded_log_std() == self.log_std).to(self.log_std.dtype)

    def forward(self, normalised: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (n, act_dim) and log standard deviation (act_dim,) at normalised observations."""
        return self.net(normalised), self.bounded_log_std()


class Actor:
    """A policy as it was when this was made, quick to ask.

    Args:
        policy: pi.
    """

    @torch.no_grad()
    def __init__(self, policy: GaussianPolicy) -> None:
        self._shift, self._scale = policy.normaliser.shift_and_scale()
        *layers, skip = policy.net.views(policy.net.flat.clone())
        weights, biases = [weight.T for weight in layers[::2]], layers[1::2]
        *self._hidden, self._output = zip(weights, biases, strict=True)
        self._skip = skip.T
        self._std = policy.bounded_log_std().exp()

    @torch.inference_mode()
    def __call__(self, obs: NDArray[np.float32], noise: Tensor | None) -> NDArray[np.float32]:
        """Actions for raw observations, (n, obs_dim) -> (n, act_dim), not clipped.

        Args:
            obs: as the environment gives them.
            noise: (n, act_dim) standard normal; None acts with the mean (deterministic policy).
        """
        x = normalise(torch.from_numpy(obs), self._shift, self._scale)
        h = x
        for weight, bias in self._hidden:
            h = tanh_(torch.addmm(bias, h, weight))
        weight, bias = self._output
        actions = torch.addmm(bias, h, weight).addmm_(x, self._skip)
        if noise is not None:
            actions.addcmul_(noise, self._std)
        return actions.numpy()


def log_prob(mean: Tensor, log_std: Tensor, actions: Tensor) -> Tensor:
    """Log density of actions under a diagonal Gaussian, (n, act_dim) -> (n,)."""
    z = (actions - mean) * torch.exp(-log_std)
    return -0.5 * (z**2).sum(-1) - log_std.sum() - 0.5 * math.log(2 * math.pi) * mean.shape[-1]


def mean_kl(old_mean: Tensor, old_log_std: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Mean over a batch of KL(old || new) between diagonal Gaussians, a scalar, nats."""
    var_ratio = torch.exp(2 * (old_log_std - log_std))
    shift = ((old_mean - mean) * torch.exp(-log_std)) ** 2
    return (log_std - old_log_std + 0.5 * (var_ratio + shift) - 0.5).sum(-1).mean()


class ValueFunction(nn.Module):
    """V(s, g): the discounted chance to reach the goal, an MLP of the normalised observation."""

    def __init__(self, obs_dim: int, cfg: ValueConfig) -> None:
        super().__init__()
        self.cfg = cfg
        self.net = MLP((obs_dim, *cfg.hidden, 1), TANH, input_gain=cfg.input_gain)
        self.optimiser = torch.optim.Adam(self.net.parameters(), lr=cfg.learning_rate, fused=True)

    def forward(self, normalised: Tensor) -> Tensor:
        """Values at normalised observations, (n, obs_dim) -> (n,)."""
        return self.net(normalised).squeeze(-1)

    def fit(
        self, normalised: Tensor, returns: Tensor, generator: torch.Generator
    ) -> dict[str, float]:
        """Regress on returns: normalised (n, obs_dim), returns (n,). Gives the mean loss."""
        n, losses = len(returns), []
        for _ in range(self.cfg.epochs):
            order = torch.randperm(ranks.size() * n, generator=generator)
            for minibatch in order.split(self.cfg.minibatch):
                rows = ranks.mine(minibatch, n)
                at = Linearised(self.net, normalised[rows])
                error = at.output - returns[rows, None]
                gradient = at.vjp(error * (2 / len(minibatch)))
                self.net.flat.grad = ranks.total(gradient, background=True)
                self.optimiser.step()
                losses.append(error.square().sum() / len(minibatch))
        return {"loss": ranks.total(torch.stack(losses), background=True).mean().item()}

    def get_extra_state(self) -> dict[str, Any]:
        """The optimiser's state, which goes into the `state_dict`."""
        return self.optimiser.state_dict()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over what `get_extra_state` gave."""
        checkpoint.restore(self.optimiser, state)
