"""Trust region policy optimisation (Schulman et al. 2015).

Maximise the surrogate E[ratio * A] subject to mean KL(old || new) <= max_kl: the conjugate
gradient finds the natural gradient F^-1 g, a quadratic model scales it to the bound, and a line
search accepts the longest step whose surrogate rose and whose measured KL keeps the bound.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from goalgan_bt.agent.networks import CHUNK, Linearised
from goalgan_bt.agent.policy import GaussianPolicy, log_prob, mean_kl
from goalgan_bt.agent.settings import TrpoConfig
from goalgan_bt.runs import ranks


def conjugate_gradient(
    product: Callable[[Tensor], Tensor], b: Tensor, iters: int, tolerance: float = 1e-10
) -> Tensor:
    """Solve A x = b for a symmetric positive definite A given as x -> A x, (p,) -> (p,)."""
    x, residual, direction = torch.zeros_like(b), b.clone(), b.clone()
    norm = residual @ residual
    for _ in range(iters):
        image = product(direction)
        curvature = direction @ image
        if not curvature > 0:  # rounding, or not a number: what there is so far is the answer
            break
        step = norm / curvature
        x += step * direction
        residual -= step * image
        new_norm = residual @ residual
        if new_norm < tolerance:
            break
        direction = residual + (new_norm / norm) * direction
        norm = new_norm
    return x


def fisher_vector_product(
    policy: GaussianPolicy, normalised: Tensor, damping: float
) -> Callable[[Tensor], Tensor]:
    """v -> (F + damping) v with F the Hessian of the mean KL at the present policy.

    For a Gaussian whose std does not depend on the state, F = J' diag(1/var) J / n for the mean
    network's parameters, with J the Jacobian of the means, and 2 for each log std.

    Args:
        policy: pi.
        normalised: (n, obs_dim) normalised observations.
        damping: added to the diagonal.
    """
    at = Linearised(policy.net, normalised)
    log_std = policy.bounded_log_std().detach()
    precision = torch.exp(-2 * log_std) / ranks.count(len(normalised))
    free = policy.free()
    split = -len(log_std)

    def product(v: Tensor) -> Tensor:
        net_part = at.vjp(at.jvp(v[:split]).mul_(precision))
        ranks.total(net_part)
        return torch.cat([net_part, 2.0 * free * v[split:]]).add_(v, alpha=damping)

    return product


def line_search(
    evaluate: Callable[[Tensor], tuple[float, float]],
    start: Tensor,
    full_step: Tensor,
    max_kl: float,
    steps: int,
    decay: float,
) -> tuple[Tensor, float, float] | None:
    """The longest of full_step * decay^k with a higher surrogate and KL <= max_kl, or None.

    Args:
        evaluate: parameters (p,) -> (surrogate gain over the start, KL); NaN never passes.
        start, full_step: (p,).
        max_kl, steps, decay: see `TrpoConfig`.

    Returns:
        The accepted parameters, their surrogate gain and their KL.
    """
    for k in range(steps):
        candidate = start + decay**k * full_step
        gain, kl = evaluate(candidate)
        if gain > 0 and kl <= max_kl:
            return candidate, gain, kl
    return None


@torch.no_grad()
def surrogate_gradient(
    policy: GaussianPolicy, normalised: Tensor, actions: Tensor, advantages: Tensor
) -> tuple[Tensor, Tensor]:
    """E[A grad log pi(a | s)], the gradient of E[ratio * A] where the ratio is 1.

    Args:
        policy: pi.
        normalised: (n, obs_dim); actions: (n, act_dim); advantages: (n,).

    Returns:
        The means of the policy, (n, act_dim), and the gradient over all ranks, (p,).
    """
    log_std = policy.bounded_log_std()
    free = policy.free()
    gradients, means = [], []
    columns = (normalised, actions, advantages[:, None] / len(advantages))
    for obs, acts, weight in zip(*(column.split(CHUNK) for column in columns), strict=True):
        at = Linearised(policy.net, obs)
        z = (acts - at.output) * torch.exp(-log_std)
        of_net = at.vjp(weight * z * torch.exp(-log_std))
        of_std = free * (weight * (z * z - 1)).sum(dim=0)
        gradients.append(torch.cat([of_net, of_std]))
        means.append(at.output)
    return torch.cat(means), ranks.mean(torch.stack(gradients).sum(dim=0))


def standardised(advantages: Tensor) -> Tensor:
    """Advantages (n,) with zero mean and unit standard deviation over all ranks, (n,)."""
    centred = advantages - ranks.mean(advantages.mean())
    n = ranks.size() * len(advantages)
    variance = ranks.total(centred.square().sum()) / max(1, n - 1)
    return centred / (variance.sqrt() + 1e-8)


def update(
    policy: GaussianPolicy,
    normalised: Tensor,
    actions: Tensor,
    advantages: Tensor,
    cfg: TrpoConfig,
    generator: torch.Generator | None = None,
) -> dict[str, float]:
    """One trust-region step on a batch that the present policy sampled.

    Args:
        policy: pi, changed in place; not at all if no step was accepted or any was not finite.
        normalised: (n, obs_dim) normalised observations; of several ranks, each brings as many.
        actions: (n, act_dim) as sampled, before clipping.
        advantages: (n,), normalised here.
        cfg: settings.
        generator: picks the subsample of the Fisher matrix.

    Returns:
        surrogate (its gain), kl, gradient_norm, accepted (1 or 0), nonfinite (1 or 0).
    """
    advantages = standardised(advantages)
    old_log_std = policy.bounded_log_std().detach()
    old_mean, gradient = surrogate_gradient(policy, normalised, actions, advantages)
    old_logp = log_prob(old_mean, old_log_std, actions)
    stats = {"surrogate": 0.0, "kl": 0.0, "accepted": 0.0, "nonfinite": 0.0}
    stats["gradient_norm"] = gradient.norm().item()
    if not torch.isfinite(gradient).all():
        return stats | {"nonfinite": 1.0}

    subset = normalised
    if cfg.fisher_fraction < 1:
        everybodys = ranks.size() * len(normalised)
        size = max(1, int(cfg.fisher_fraction * everybodys))
        rows = torch.randperm(everybodys, generator=generator)[:size]
        subset = normalised[ranks.mine(rows, len(normalised))]
    product = fisher_vector_product(policy, subset, cfg.cg_damping)
    direction = conjugate_gradient(product, gradient, cfg.cg_iters)
    curvature = direction @ product(direction)  # g' F^-1 g
    full_step = direction * torch.sqrt(2 * cfg.max_kl / (curvature + 1e-12))
    if not torch.isfinite(full_step).all():
        return stats | {"nonfinite": 1.0}

    params = [policy.net.flat.detach(), policy.log_std.detach()]
    start = torch.cat(params)

    def put(candidate: Tensor) -> None:
        for param, part in zip(params, candidate.split([len(p) for p in params]), strict=True):
            param.copy_(part)

    @torch.no_grad()
    def evaluate(candidate: Tensor) -> tuple[float, float]:
        put(candidate)
        new_mean, new_log_std = policy(normalised)
        new_logp = log_prob(new_mean, new_log_std, actions)
        gain = ((torch.exp(new_logp - old_logp) - 1) * advantages).mean()
        kl = mean_kl(old_mean, old_log_std, new_mean, new_log_std)
        gain, kl = ranks.mean(torch.stack([gain, kl])).tolist()
        return gain, kl

    found = line_search(
        evaluate, start, full_step, cfg.max_kl, cfg.line_search_steps, cfg.line_search_decay
    )
    if found is None:
        put(start)
        return stats
    _, gain, kl = found  # the last evaluation left the accepted parameters in place
    return stats | {"surrogate": gain, "kl": kl, "accepted": 1.0}
