"""The same mathematics on numpy arrays and on torch tensors.

A function says `xp = namespace(x)` and then `xp.where(...)`, as the array API standard has it; what
comes in as tensors on a GPU comes out as such. Numpy's own functions serve numpy's arrays, so that
nothing is paid for it there.
"""

from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

# A numpy array or a torch tensor: a function that takes both gives back what it was given.
Array: TypeAlias = Any


def namespace(array: Array) -> Any:
    """The functions of the array API for arrays of that kind."""
    if isinstance(array, np.ndarray):
        return np
    import array_api_compat.torch

    return array_api_compat.torch


def like(constant: NDArray[Any], array: Array) -> Array:
    """A constant as an array of that kind, in the same place; floats also of the same precision.

    A tensor is made once: no copy to a GPU while it computes.
    """
    if isinstance(array, np.ndarray):
        return constant
    floating = np.issubdtype(constant.dtype, np.floating)
    dtype = array.dtype if floating else None
    return _tensor(constant.tobytes(), constant.dtype.str, constant.shape, dtype, array.device)


@lru_cache(maxsize=256)
def _tensor(data: bytes, kind: str, shape: tuple[int, ...], dtype: Any, device: Any) -> Array:
    import torch

    constant = np.frombuffer(data, kind).reshape(shape).copy()
    return torch.as_tensor(constant, dtype=dtype, device=device)


def put(values: Array, array: Array) -> Array:
    """Values, numpy's or torch's, as an array of that kind, precision and place."""
    if isinstance(array, np.ndarray):
        return values
    import torch

    return torch.as_tensor(values, dtype=array.dtype, device=array.device)


def columns(array: Array) -> Array:
    """The columns of a matrix, to be computed with one by one, (n, k) -> (k, n)."""
    return np.ascontiguousarray(array.T) if isinstance(array, np.ndarray) else array.T
