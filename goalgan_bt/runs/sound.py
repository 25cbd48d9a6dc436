"""What learns stays finite: one number that is none would else spread through all that is learned
from it, and stay."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from torch import Tensor


def finite(*arrays: "np.ndarray | Tensor") -> bool:
    """Whether all numbers of some arrays are finite."""
    return all(
        bool(x.isfinite().all() if isinstance(x, Tensor) else np.isfinite(x).all()) for x in arrays
    )


def soundly(part: Any, learn: Callable[..., dict[str, float]], *args: Any) -> dict[str, float]:
    """Let a part learn, and put it back to where it was if that leaves a weight that is not finite.

    Args:
        part: has `parameters`, `state_dict` and `load_state_dict`, its optimisers included.
        learn: called with the other arguments; gives metrics.

    Returns:
        Its metrics, and `undone`, 1 if the lesson was undone.
    """
    before = copy.deepcopy(part.state_dict())
    metrics = learn(*args)
    if finite(*part.parameters()):
        return metrics | {"undone": 0.0}
    part.load_state_dict(before)
    return {"undone": 1.0}
