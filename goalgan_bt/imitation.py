"""Imitation of recall traces: maximise sum log pi(a_t | s_t, g) (Recall Traces, equation 3).

The policy sees the goal that seeded the trace, which the trace reaches by construction. The
gradient goes through the mean only: actions of unit variance would otherwise blow up the policy's
standard deviation. A bound on the KL from the policy as it was keeps imitation from undoing the
trust-region step before it.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from goalgan_bt.policy import GaussianPolicy, log_prob, mean_kl


@dataclass(frozen=True)
class ImitationConfig:
    """Imitation of recall traces."""

    steps: int = 20
    """Gradient steps per iteration."""
    batch: int = 512
    """(state, action) pairs per step."""
    learning_rate: float = 1e-4
    """Step size of Adam, an optimiser of its own."""
    max_kl: float = 0.005
    """Imitation stops where the mean KL on the last rollouts passes this, nats."""


class Imitation:
    """Gradient steps of a policy towards actions that were recalled."""

    def __init__(
        self, policy: GaussianPolicy, cfg: ImitationConfig, generator: torch.Generator
    ) -> None:
        self.policy, self.cfg, self._rng = policy, cfg, generator
        self.optimiser = torch.optim.Adam(policy.net.parameters(), lr=cfg.learning_rate, fused=True)

    def update(self, obs: Tensor, actions: Tensor, reference: Tensor) -> dict[str, float]:
        """Take up to `cfg.steps` steps, fewer if the KL bound is met.

        Args:
            obs: (n, obs_dim) normalised observations of the traces; none is fine.
            actions: (n, act_dim) recalled actions.
            reference: (m, obs_dim) normalised observations of the last rollouts.

        Returns:
            loss: -log pi(a | s) at the start, nats; kl: on the reference; steps: those taken.
            Nothing for no traces.
        """
        if len(obs) == 0:
            return {}
        params = list(self.policy.net.parameters())
        with torch.no_grad():
            old_mean, old_log_std = self.policy(reference)
        first_loss, kl, taken = float("nan"), 0.0, 0
        for _ in range(self.cfg.steps):
            rows = torch.randint(len(obs), (self.cfg.batch,), generator=self._rng)
            mean, log_std = self.policy(obs[rows])
            loss = -log_prob(mean, log_std.detach(), actions[rows]).mean()
            if taken == 0:
                first_loss = loss.item()
            before = [p.detach().clone() for p in params]
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
            self.optimiser.step()
            with torch.no_grad():
                new_kl = mean_kl(old_mean, old_log_std, *self.policy(reference)).item()
                if not new_kl <= self.cfg.max_kl:
                    for p, old in zip(params, before, strict=True):
                        p.copy_(old)
                    break
            kl, taken = new_kl, taken + 1
        return {"loss": first_loss, "kl": kl, "steps": float(taken)}
