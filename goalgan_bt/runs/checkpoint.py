"""Checkpoints: the whole training state in one file, written atomically, read without pickles."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.run_folder import write_atomically


def save(state: dict[str, Any], path: Path) -> None:
    """Write a state; an old one stays in place until the new one is complete.

    Raises:
        OSError: where that fails, as on a full disk.
    """
    try:
        write_atomically(path, lambda file: torch.save(state, file))
    except RuntimeError as error:  # of torch's archive, which hides what stopped it
        raise (error.__context__ or error) from None


def restore(module: Any, state: dict[str, Any]) -> None:
    """Put a state into a network or an optimiser; the latter keeps its learning rate, which a run
    that goes on may have changed."""
    rates = [group["lr"] for group in getattr(module, "param_groups", [])]
    module.load_state_dict(state)
    for group, rate in zip(getattr(module, "param_groups", []), rates, strict=True):
        group["lr"] = rate


@contextmanager
def loaded(path: Path) -> Iterator[Any]:
    """What `save` wrote, while it is taken over.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: for whatever goes wrong while it is read and taken over.
    """
    data = path.read_bytes()
    try:
        yield torch.load(io.BytesIO(data), weights_only=True)
    except Exception as error:  # torch raises many kinds for a damaged file
        why = f"it is damaged or of other settings or another version ({reason(error)})"
        raise ValueError(f"cannot load {path}: {why}") from error


@contextmanager
def saved(folder: Path) -> Iterator[dict[str, Any]]:
    """What `save` wrote; whatever goes wrong while it is read and taken over is a `RunError`."""
    path = folder / "checkpoint.pt"
    if not path.is_file():
        raise RunError(f"{folder} has no checkpoint.pt to resume from: start a new run")
    try:
        yield torch.load(path, weights_only=True)
    except Exception as error:  # torch raises many kinds for a damaged file
        raise RunError(
            f"cannot resume from {path}: it is damaged or of other settings or another version "
            f"({reason(error)})"
        ) from None


def reason(error: Exception) -> str:
    """What went wrong with a file, in a few words: torch's errors have pages."""
    words = (str(error).strip().splitlines() or [""])[0].split(". ")[0][:160]
    return words if len(words.split()) > 1 else f"{type(error).__name__} {words}".strip()
