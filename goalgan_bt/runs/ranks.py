"""Data-parallel training: several processes, each with its share of the simulations.

    torchrun --nproc-per-node 2 -m goalgan_bt.train --env ant_umaze

Every rank takes part in each update: what is a mean over the batch is a mean over all ranks'
batches, and finished episodes are told to all, so that goals, labels and the models learned from
them are the same everywhere, as long as all ranks round alike: give them processors of one kind.
Alone, a process has rank 0 of 1 and nothing here does anything.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TypeVar

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from goalgan_bt.runs.errors import InterruptedRun
from goalgan_bt.runs.torchrun import launched

SILENCE = timedelta(minutes=5)  # a rank that says nothing for so long counts as dead

# The value function learns in a thread of its own: what two threads send must not mix.
_background: "dist.ProcessGroup | None" = None

Array = TypeVar("Array", bound=np.ndarray)


def begin() -> None:
    """Join the other ranks, if `torchrun` started this process.

    Raises:
        InterruptedRun: if they cannot be reached.
    """
    global _background
    if not launched() or dist.is_initialized():
        return
    with _clear_errors():
        dist.init_process_group("cpu:gloo", timeout=SILENCE)
        _background = dist.new_group(timeout=SILENCE)


def end() -> None:
    """Leave the other ranks. A process must do so before it ends: gloo's threads, which end with
    the last reference to their group, would else wake in a Python that is gone, and abort."""
    global _background
    if dist.is_initialized():
        dist.destroy_process_group()
        _background = None


def rank() -> int:
    """This process's number; 0 records."""
    return dist.get_rank() if dist.is_initialized() else 0


def size() -> int:
    """How many processes train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def total(x: Tensor, background: bool = False) -> Tensor:
    """The sum over all ranks of a tensor, which is changed in place.

    Args:
        x: of the same shape on every rank.
        background: whether it is the thread in the background that asks.
    """
    if size() > 1:
        with _clear_errors():
            dist.all_reduce(x, group=_background if background else None)
    return x


def count(n: int) -> int:
    """The sum of a number over all ranks."""
    return int(total(torch.tensor(n)))


def mean(x: Tensor) -> Tensor:
    """The mean over all ranks of a tensor, which is changed in place."""
    return total(x).div_(size())


def gather(rows: Array) -> Array:
    """The rows of all ranks, those of rank 0 first: (n, ...) -> (sum of n, ...)."""
    if size() == 1:
        return rows
    counts = total(torch.eye(size(), dtype=torch.int64)[rank()] * len(rows)).tolist()
    mine = torch.from_numpy(np.ascontiguousarray(rows))
    parts = [mine.new_empty((n, *mine.shape[1:])) for n in counts]
    parts[rank()] = mine
    with _clear_errors():
        for source, part in enumerate(parts):
            if part.numel():
                dist.broadcast(part, source)
    return torch.cat(parts).numpy()  # type: ignore[return-value]


def agreed(number: float) -> float:
    """The same number on all ranks, whose clocks differ: their mean."""
    return mean(torch.tensor(number, dtype=torch.float64)).item()


def share(n: int) -> slice:
    """Which of n tasks are this rank's."""
    return slice(n * rank() // size(), n * (rank() + 1) // size())


def mine(rows: Tensor, n: int) -> Tensor:
    """Which of these rows are of this rank, counted from its first.

    Args:
        rows: row numbers in the batch of all ranks, rank 0's first.
        n: rows of each rank.
    """
    if size() == 1:
        return rows
    first = rank() * n
    return rows[(rows >= first) & (rows < first + n)] - first


def agree(tensors: list[Tensor]) -> None:
    """Copy rank 0's tensors to all: different machines round differently."""
    if size() > 1:
        with _clear_errors(), torch.no_grad():
            for tensor in tensors:
                dist.broadcast(tensor, 0)


@contextmanager
def _clear_errors() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:  # gloo has no kind of its own
        words = str(error).strip() or type(error).__name__
        reason = words.splitlines()[0].split("] ")[-1].split(". ")[0]
        raise InterruptedRun(
            f"rank {rank()}: a rank of this training is gone or out of reach ({reason})"
        ) from None
