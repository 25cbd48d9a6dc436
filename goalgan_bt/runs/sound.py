"""What learns stays finite: one number that is none would else spread through all that is learned
from it, and stay."""

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from torch import Tensor

from goalgan_bt.runs.checkpoint import tensors_of


def finite(*arrays: "np.ndarray | Tensor") -> bool:
    """Whether all numbers of some arrays are finite."""
    return all(
        bool(x.isfinite().all() if isinstance(x, Tensor) else np.isfinite(x).all()) for x in arrays
    )


def soundly(part: Any, learn: Callable[..., dict[str, float]], *args: Any) -> dict[str, float]:
    """Let a part learn, and put it back to where it was if that leaves a number that is not finite,
    in its weights or its optimiser's moments.

    Args:
        part: has `state_dict` and `load_state_dict`, its optimisers included.
        learn: called with the other arguments; gives metrics.

    Returns:
        Its metrics, and `undone`, 1 if the lesson was undone; the others are then NaN.
    """
    before = copy.deepcopy(part.state_dict())
    metrics = learn(*args)
    if finite(*tensors_of(part.state_dict())):
        return metrics | {"undone": 0.0}
    part.load_state_dict(before)
    return dict.fromkeys(metrics, math.nan) | {"undone": 1.0}
