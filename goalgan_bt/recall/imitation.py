"""Imitation of recall traces: maximise sum log pi(a_t | s_t, g) (Recall Traces, equation 3).

The policy sees the goal that seeded the trace, which the trace reaches by construction. The
gradient goes through the mean only: actions of unit variance would otherwise blow up the policy's
standard deviation. A bound on the KL from the policy as it was keeps imitation from undoing the
trust-region step before it.
"""

from typing import Any

import torch
from torch import Tensor

from goalgan_bt.agent.networks import Linearised
from goalgan_bt.agent.policy import GaussianPolicy, log_prob, mean_kl
from goalgan_bt.recall.settings import ImitationConfig
from goalgan_bt.runs import checkpoint, ranks


def faded(max_kl: float, at: float, end: float | None) -> float:
    """A bound on the KL that falls on a line to zero at `end`, from there on nothing is imitated;
    without an end it stays."""
    return max_kl if end is None else max_kl * (1 - min(1.0, at / end))


class Imitation:
    """Gradient steps of a policy towards actions that were recalled."""

    def __init__(
        self, policy: GaussianPolicy, cfg: ImitationConfig, generator: torch.Generator
    ) -> None:
        self.policy, self.cfg, self._rng = policy, cfg, generator
        self.optimiser = torch.optim.Adam(policy.net.parameters(), lr=cfg.learning_rate, fused=True)

    def max_kl(self, progress: float) -> float:
        """The bound on the KL at this progress in the run, 0 to 1."""
        return faded(self.cfg.max_kl, progress, self.cfg.fade)

    def update(
        self, obs: Tensor, actions: Tensor, reference: Tensor, progress: float
    ) -> dict[str, float]:
        """Take up to `cfg.steps` steps, fewer if the KL bound is met.

        Args:
            obs: (n, obs_dim) normalised observations of the traces; none is fine.
            actions: (n, act_dim) recalled actions.
            reference: (m, obs_dim) normalised observations of the last rollouts.
            progress: in the run, 0 to 1.

        Returns:
            loss: -log pi(a | s) at the start, nats; kl: on the reference; steps: those taken.
            Nothing for no traces.
        """
        max_kl = self.max_kl(progress)
        if len(obs) == 0 or max_kl <= 0:
            return {}
        params = self.policy.net.flat
        with torch.no_grad():
            old_mean, old_log_std = self.policy(reference)
        everybodys = ranks.count(len(reference))
        first_loss, kl, taken = float("nan"), 0.0, 0
        for _ in range(self.cfg.steps):
            rows = torch.randint(len(obs), (self.cfg.batch,), generator=self._rng)
            at = Linearised(self.policy.net, obs[rows])
            if taken == 0:
                first_loss = -log_prob(at.output, old_log_std, actions[rows]).mean().item()
            # The gradient of -log pi(a | s) in the mean.
            u = (at.output - actions[rows]) * torch.exp(-2 * old_log_std) / len(rows)
            before = params.detach().clone()
            params.grad = at.vjp(u)
            self.optimiser.step()
            with torch.no_grad():
                kls = len(reference) * mean_kl(old_mean, old_log_std, *self.policy(reference))
                new_kl = ranks.total(kls).item() / everybodys
                if not new_kl <= max_kl:
                    params.copy_(before)
                    break
            kl, taken = new_kl, taken + 1
        return {"loss": first_loss, "kl": kl, "steps": float(taken)}

    def state_dict(self) -> dict[str, Any]:
        """The optimiser's state."""
        return self.optimiser.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave."""
        checkpoint.restore(self.optimiser, state)
