"""Imitation of recall traces: maximise sum log pi(a_t | s_t, g) (Recall Traces, equation 3).

The policy sees a goal that the trace reaches by construction: a later place of it, or its end. The
gradient goes through the mean only: actions of unit variance would otherwise blow up the policy's
standard deviation. A bound on the KL from the policy as it was keeps imitation from undoing the
trust-region step before it: `imitate_within`, which serves other agents too.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from goalgan_bt.agent.networks import Linearised
from goalgan_bt.agent.policy import GaussianPolicy, log_prob, mean_kl
from goalgan_bt.agent.trpo import line_search
from goalgan_bt.recall.settings import ImitationConfig
from goalgan_bt.runs import checkpoint, ranks


def faded(max_kl: float, at: float, end: float | None) -> float:
    """A bound on the KL that falls on a line to zero at `end`, from there on nothing is imitated;
    without an end it stays."""
    return max_kl if end is None else max_kl * (1 - min(1.0, at / end))


def imitate_within(
    max_kl: float,
    steps: int,
    read: Callable[[], Tensor],
    put: Callable[[Tensor], None],
    step: Callable[[], None],
    kl: Callable[[], float],
    halvings: int = 0,
) -> tuple[float, int]:
    """Take gradient steps while the policy stays within a bound on the KL from where it was. The
    step that would leave it is undone, or halved until it stays, and no other follows.

    Args:
        max_kl: the bound, nats.
        steps: to take at most.
        read, put: give and set the parameters as a vector, (p,).
        step: takes a step of the optimiser.
        kl: from the policy as it was to the policy as it is, nats.
        halvings: how often a step that is too long is halved before it is undone.

    Returns:
        The KL at the end, and the steps taken, a shortened one included.
    """

    def evaluate(candidate: Tensor) -> tuple[float, float]:
        put(candidate)
        return 1.0, kl()  # any step is taken that is short enough

    reached = 0.0
    for taken in range(steps):
        start = read()
        step()
        half, found = (read() - start) / 2, None
        if torch.isfinite(half).all():
            if (here := kl()) <= max_kl:
                reached = here
                continue
            found = line_search(evaluate, start, half, max_kl, halvings, 0.5)
        if found is None:
            put(start)
            return reached, taken
        return found[2], taken + 1
    return reached, steps


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
        """Take up to `cfg.steps` steps within the bound on the KL (see `imitate_within`); one that
        would leave it is undone: halving it was no better (docs/LOG.md).

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
        losses: list[float] = []

        def step() -> None:
            rows = torch.randint(len(obs), (self.cfg.batch,), generator=self._rng)
            at = Linearised(self.policy.net, obs[rows])
            if not losses:
                losses.append(-log_prob(at.output, old_log_std, actions[rows]).mean().item())
            # The gradient of -log pi(a | s) in the mean.
            u = (at.output - actions[rows]) * torch.exp(-2 * old_log_std) / len(rows)
            params.grad = at.vjp(u)
            self.optimiser.step()

        def put(vector: Tensor) -> None:
            params.data.copy_(vector)

        @torch.no_grad()
        def kl() -> float:
            kls = len(reference) * mean_kl(old_mean, old_log_std, *self.policy(reference))
            return ranks.total(kls).item() / everybodys

        kl_there, taken = imitate_within(
            max_kl,
            self.cfg.steps,
            lambda: params.detach().clone(),
            put,
            step,
            kl,
        )
        loss = losses[0] if losses else float("nan")
        return {"loss": loss, "kl": kl_there, "steps": float(taken)}

    def state_dict(self) -> dict[str, Any]:
        """The optimiser's state."""
        return self.optimiser.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave."""
        checkpoint.restore(self.optimiser, state)
