"""Checkpoints: the whole training state in one file, written atomically, read without pickles."""

from pathlib import Path

import torch

from goalgan_bt.learner import Learner
from goalgan_bt.record import RunError, write_atomically


def save(learner: Learner, folder: Path) -> None:
    """Write `checkpoint.pt`; the old one stays in place until the new one is complete."""
    state = learner.state_dict()
    write_atomically(folder / "checkpoint.pt", lambda file: torch.save(state, file))


def load(learner: Learner, folder: Path) -> None:
    """Put a run's `checkpoint.pt` into a learner of the same settings.

    Raises:
        RunError: if there is none, or it is damaged or of other settings.
    """
    path = folder / "checkpoint.pt"
    if not path.is_file():
        raise RunError(f"{folder} has no checkpoint.pt to resume from: start a new run")
    try:
        learner.load_state_dict(torch.load(path, weights_only=True))
    except Exception as error:  # torch raises many kinds for a damaged file
        words = str(error).strip().splitlines() or [type(error).__name__]
        reason = words[0].split(". ")[0][:160]
        raise RunError(
            f"cannot resume from {path}: it is damaged or of other settings ({reason})"
        ) from None
