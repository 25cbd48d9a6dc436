"""Generalised advantage estimation (Schulman et al. 2016)."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]


def gae(
    rewards: Array,
    values: Array,
    next_values: Array,
    terminated: Mask,
    truncated: Mask,
    discount: float,
    gae_lambda: float,
) -> tuple[Array, Array]:
    """Advantages and returns of T steps in N simulations.

    A_t = delta_t + discount * lambda * A_{t+1}, with
    delta_t = r_t + discount * V(s_{t+1}) - V(s_t).
    A terminated step has no future: its V(s_{t+1}) counts as 0. A truncated step has one that was
    not seen: it bootstraps from V(s_{t+1}). Neither lets A leak in from the next episode.

    Args:
        rewards, values: (T, N), r_t and V(s_t).
        next_values: (T, N), V of the state that followed, also where the episode ended.
        terminated, truncated: (T, N), episode ends.
        discount, gae_lambda: in [0, 1].

    Returns:
        Advantages (T, N), not normalised, and returns (T, N): advantages + values.
    """
    deltas = rewards + discount * next_values * ~terminated - values
    carry = discount * gae_lambda * ~(terminated | truncated)
    advantages = np.empty_like(deltas)
    following = np.zeros_like(deltas[0])
    for t in reversed(range(len(deltas))):
        following = deltas[t] + carry[t] * following
        advantages[t] = following
    return advantages, advantages + values
