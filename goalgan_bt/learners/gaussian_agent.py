"""An agent of Stable-Baselines3 as recall sees it: a Gaussian policy that imitates, and a critic.

For SAC, whose actions are squashed by a tanh, and for TRPO, PPO and A2C, whose actions are not.
"""

from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.sac.policies import SACPolicy
from torch import Tensor
from torch.distributions import Normal, kl_divergence
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.recall.imitation import imitate_within
from goalgan_bt.recall.settings import RecallConfig

EDGE = 0.999  # of the range of a squashed action, beyond which its inverse is taken as there
KL_SAMPLE = 1024  # states on which the KL of an imitation is bounded
HALVINGS = 10  # of a step that is too long: for a policy as narrow as SAC's nearly each is


class Rows:
    """Observations as rows of numbers: vectors as they are, those of a dictionary, such as an
    observation and a goal, one after the other by name.

    Args:
        space: of the observations.

    Attributes:
        size: numbers of a row.

    Raises:
        TypeError: if they are no vectors.
    """

    def __init__(self, space: spaces.Space[Any]) -> None:
        parts = {**space.spaces} if isinstance(space, spaces.Dict) else {"": space}
        self._names = sorted(parts) if isinstance(space, spaces.Dict) else []
        for part in parts.values():
            if not (isinstance(part, spaces.Box) and len(part.shape) == 1):
                raise TypeError(f"RecallTraces needs observations that are vectors, not {space}")
        sizes = [cast(Any, parts[name]).shape[0] for name in sorted(parts)]
        self._ends = np.cumsum(sizes)
        self.size = int(self._ends[-1])

    def of(self, obs: Any) -> FloatArray:
        """Observations as rows, (..., size)."""
        if not self._names:
            return np.array(obs)
        return np.concatenate([np.asarray(obs[name]) for name in self._names], axis=-1)

    def back(self, rows: Any) -> Any:
        """Rows, (n, size), array or tensor, as observations."""
        if not self._names:
            return rows
        begins = [0, *self._ends[:-1]]
        bounds = zip(self._names, begins, self._ends, strict=True)
        return {name: rows[:, begin:end] for name, begin, end in bounds}


class GaussianAgent:
    """What recall needs of an agent. Observations are as the agent sees them, as rows; actions are
    in [-1, 1] over their range.

    Args:
        model: the agent.

    Attributes:
        model: the agent; actor: the network that acts; squashed: whether a tanh squashes what the
            Gaussian says; rows: how observations become such; sizes: numbers of an observation and
            of an action.

    Raises:
        TypeError: if its policy is no Gaussian (without memory or state-dependent exploration), or
            its observations or actions are not vectors.
    """

    def __init__(self, model: BaseAlgorithm) -> None:
        policy: Any = model.policy
        space, actions = model.observation_space, model.action_space
        known = isinstance(policy, (ActorCriticPolicy, SACPolicy))
        if not known or hasattr(policy, "lstm_actor") or model.use_sde:
            raise TypeError(
                "RecallTraces needs an agent with a Gaussian policy, without memory or "
                "state-dependent exploration: SAC, TRPO, PPO or A2C"
            )
        self.rows = Rows(space)
        if not (isinstance(actions, spaces.Box) and len(actions.shape) == 1):
            raise TypeError(f"RecallTraces needs actions that are vectors of numbers: {actions}")
        if not (actions.high > actions.low).all():
            raise TypeError(f"RecallTraces needs actions that can vary in every number: {actions}")
        self.model = model
        self.squashed = isinstance(policy, SACPolicy)
        self.actor: Any = policy.actor if self.squashed else policy
        self.sizes = self.rows.size, actions.shape[0]
        self._low, self._high = actions.low.astype(float), actions.high.astype(float)

    def in_unit(self, actions: FloatArray) -> FloatArray:
        """Actions of the environment's range in [-1, 1]."""
        return 2 * (actions - self._low) / (self._high - self._low) - 1

    def gaussian(self, obs: Tensor) -> Normal:
        """The policy at observations (n, obs_dim), before it is squashed or clipped."""
        if self.squashed:
            mean, log_std, _ = self.actor.get_action_dist_params(self.rows.back(obs))
            return Normal(mean, log_std.exp())
        found = self.actor.get_distribution(self.rows.back(obs)).distribution
        assert isinstance(found, Normal)
        return found

    @torch.no_grad()
    def sample(self, obs: FloatArray, generator: torch.Generator) -> FloatArray:
        """Actions of the policy at observations (n, obs_dim), (n, act_dim)."""
        found = self.gaussian(self.tensor(obs))
        noise = self.tensor(torch.randn(found.mean.shape, generator=generator).numpy())
        actions = (found.mean + found.stddev * noise).cpu().numpy()
        return np.tanh(actions) if self.squashed else self.in_unit(actions).clip(-1, 1)

    @torch.no_grad()
    def values(self, obs: FloatArray) -> FloatArray:
        """What the critic says of observations (n, obs_dim), (n,)."""
        told, policy = self.rows.back(self.tensor(obs)), cast(Any, self.model.policy)
        if self.squashed:
            judged = policy.critic(told, policy.actor(told, deterministic=True))
            return torch.cat(judged, dim=1).amin(dim=1).cpu().numpy()
        return policy.predict_values(told)[:, 0].cpu().numpy()

    def said(self, actions: FloatArray) -> tuple[Tensor, Tensor]:
        """What the Gaussian would have to say for these actions (n, act_dim), and the logarithm of
        how fast it changes with them, both (n, act_dim)."""
        wanted = self.tensor(actions)
        if self.squashed:
            wanted = torch.atanh(wanted.clamp(-EDGE, EDGE))
            return wanted, -torch.log1p(-torch.tanh(wanted).square())  # the slope of atanh
        half = self.tensor((self._high - self._low) / 2)
        return self.tensor(self._low) + half * (wanted + 1), half.log().expand_as(wanted)

    def tensor(self, array: FloatArray) -> Tensor:
        """An array where the agent's networks are."""
        return torch.as_tensor(array, dtype=torch.float32, device=self.model.device)


class AgentImitation:
    """Gradient steps of an agent's policy towards actions that were recalled.

    Args:
        agent: whose policy changes.
        cfg: settings.
        rng: draws minibatches.
    """

    def __init__(self, agent: GaussianAgent, cfg: RecallConfig, rng: np.random.Generator) -> None:
        self.agent, self.cfg, self._rng = agent, cfg, rng
        self.optimiser = torch.optim.Adam(agent.actor.parameters(), cfg.learning_rate)

    def update(
        self, states: FloatArray, actions: FloatArray, seen: FloatArray, max_kl: float
    ) -> dict[str, float]:
        """Maximise log pi(a | s) of recalled steps. The gradient goes through the mean only; the
        std of SAC's policy, which shares layers with the mean, may follow.

        Args:
            states, actions: (n, obs_dim), (n, act_dim) in [-1, 1].
            seen: (m, obs_dim) states on which the KL is bounded.
            max_kl: the bound, nats.

        Returns:
            loss: -log pi, nats; kl: on those states; log_pi: log pi(a | s) before the imitation,
            nats per step.
        """
        agent = self.agent
        obs, (wanted, slope) = agent.tensor(states), agent.said(actions)
        rows = self._rng.permutation(len(seen))[:KL_SAMPLE]
        reference = agent.tensor(seen[rows])
        with torch.no_grad():
            old, before = agent.gaussian(reference), agent.gaussian(obs)
            log_pi = (before.log_prob(wanted) + slope).sum(dim=1).mean().item()
        params: list[Any] = list(agent.actor.parameters())
        losses: list[float] = []

        def read() -> Tensor:
            return parameters_to_vector(params).detach()

        def put(vector: Tensor) -> None:
            vector_to_parameters(vector, params)

        def step() -> None:
            start = read()
            some = torch.from_numpy(self._rng.integers(len(obs), size=self.cfg.imitation_batch))
            found = agent.gaussian(obs[some])
            std = found.stddev.detach()
            miss = -Normal(found.mean, std).log_prob(wanted[some]).sum(dim=1).mean()
            losses.append(miss.item())
            self.optimiser.zero_grad()
            miss.backward()
            self.optimiser.step()
            put(start + (read() - start))  # a whole step is rounded as a halved one

        @torch.no_grad()
        def kl() -> float:
            return kl_divergence(old, agent.gaussian(reference)).sum(dim=1).mean().item()

        kl_there, _ = imitate_within(
            max_kl, self.cfg.imitation_steps, read, put, step, kl, HALVINGS
        )
        return {"loss": losses[0], "kl": kl_there, "log_pi": log_pi}
