"""The policy and the value function: tanh networks on normalised observations.

As in rllab's TRPO: a Gaussian policy whose mean is an MLP and whose log standard deviation is a
free parameter. Observations already hold the desired goal, so both are goal-conditioned.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn


@dataclass(frozen=True)
class PolicyConfig:
    """The policy network."""

    hidden: tuple[int, ...] = (128, 128)
    """Units of the hidden layers (the original: 64 64)."""
    input_gain: float = 1.0
    """Scale of the first layer's first weights: more lets neighbouring places differ more."""
    init_std: float = 0.6
    """First standard deviation of the actions, in units of the action range [-1, 1]."""
    min_std: float = 0.05
    """The standard deviation never falls below this."""
    final_std: float | None = None
    """If given, the standard deviation is bounded by a line from init_std to this over the run;
    once on the line it follows it."""


@dataclass(frozen=True)
class ValueConfig:
    """The value function."""

    hidden: tuple[int, ...] = (128, 128)
    """Units of the hidden layers."""
    input_gain: float = 1.0
    """As the policy's."""
    learning_rate: float = 1e-3
    """Step size of Adam."""
    epochs: int = 2
    """Passes over the batch per update."""
    minibatch: int = 2048
    """Observations per gradient step."""


def mlp(
    sizes: tuple[int, ...],
    activation: type[nn.Module],
    output_gain: float = 1.0,
    input_gain: float = 1.0,
) -> nn.Module:
    """A fully connected network with orthogonal weights and zero biases.

    Args:
        sizes: units of every layer, the input first.
        activation: between the layers, not after the last.
        output_gain, input_gain: scale of the last and of the first layer's weights.
    """
    layers: list[nn.Module] = []
    for i, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        last = i == len(sizes) - 2
        linear = nn.Linear(fan_in, fan_out)
        gain = output_gain if last else math.sqrt(2)
        nn.init.orthogonal_(linear.weight, gain * (input_gain if i == 0 else 1.0))
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, activation()]
    return nn.Sequential(*layers)


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
        """Take in more observations, (n, dim) (Chan et al.'s parallel variance)."""
        n = len(obs)
        var, mean = torch.var_mean(obs, dim=0, correction=0)
        total = self.count + n
        delta = mean - self.mean
        self.var = (self.var * self.count + var * n + delta**2 * self.count * n / total) / total
        self.mean = self.mean + delta * n / total
        self.count = total

    def forward(self, obs: Tensor) -> Tensor:
        """Normalised observations, (n, dim) -> (n, dim) float32."""
        scale = torch.rsqrt(self.var + 1e-6).float()
        return ((obs - self.mean.float()) * scale).clamp_(-5.0, 5.0)


class MeanNetwork(nn.Module):
    """The policy's mean: an MLP plus a linear map, both of the normalised observation.

    Linear feedback carries much of locomotion (Rajeswaran et al. 2017); beside the MLP it makes
    the Ant learn faster (docs/LOG.md). It starts at zero.
    """

    def __init__(self, sizes: tuple[int, ...], input_gain: float = 1.0) -> None:
        super().__init__()
        self.mlp = mlp(sizes, nn.Tanh, output_gain=0.01, input_gain=input_gain)
        self.linear = nn.Linear(sizes[0], sizes[-1], bias=False)
        nn.init.zeros_(self.linear.weight)

    def forward(self, normalised: Tensor) -> Tensor:
        """(n, obs_dim) -> (n, act_dim)."""
        return torch.as_tensor(self.mlp(normalised) + self.linear(normalised))


class GaussianPolicy(nn.Module):
    """pi(a | s, g): a diagonal Gaussian whose mean is a `MeanNetwork`."""

    max_std: Tensor

    def __init__(self, obs_dim: int, act_dim: int, cfg: PolicyConfig) -> None:
        super().__init__()
        self.normaliser = Normaliser(obs_dim)
        self.net = MeanNetwork((obs_dim, *cfg.hidden, act_dim), cfg.input_gain)
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

    def forward(self, normalised: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (n, act_dim) and log standard deviation (act_dim,) at normalised observations."""
        log_std = self.log_std.clamp(math.log(self.cfg.min_std), math.log(self.max_std.item()))
        return self.net(normalised), log_std

    @torch.inference_mode()
    def act(
        self, obs: NDArray[np.float32], generator: torch.Generator | None
    ) -> NDArray[np.float32]:
        """Actions for raw observations, (n, obs_dim) -> (n, act_dim), not clipped.

        Args:
            obs: as the environment gives them.
            generator: noise of the Gaussian; None acts with the mean (deterministic policy).
        """
        mean, log_std = self(self.normaliser(torch.from_numpy(obs)))
        if generator is not None:
            mean = mean + log_std.exp() * torch.randn(mean.shape, generator=generator)
        return mean.numpy()


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
        self.net = mlp((obs_dim, *cfg.hidden, 1), nn.Tanh, input_gain=cfg.input_gain)
        self.optimiser = torch.optim.Adam(self.net.parameters(), lr=cfg.learning_rate, fused=True)

    def forward(self, normalised: Tensor) -> Tensor:
        """Values at normalised observations, (n, obs_dim) -> (n,)."""
        return self.net(normalised).squeeze(-1)

    def fit(
        self, normalised: Tensor, returns: Tensor, generator: torch.Generator
    ) -> dict[str, float]:
        """Regress on returns: normalised (n, obs_dim), returns (n,). Gives the mean loss."""
        losses = []
        for _ in range(self.cfg.epochs):
            order = torch.randperm(len(returns), generator=generator)
            for rows in order.split(self.cfg.minibatch):
                loss = (self(normalised[rows]) - returns[rows]).square().mean()
                self.optimiser.zero_grad(set_to_none=True)
                loss.backward()
                self.optimiser.step()
                losses.append(loss.item())
        return {"loss": float(np.mean(losses))}
