"""Metrics of a run for Weights & Biases too, with `--track` (extra `wandb`).

Offline unless `WANDB_MODE` says otherwise: what is written lies in the run folder, and
`wandb sync` sends it whenever one likes.
"""

import os
import re
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from goalgan_bt.runs.errors import UsageError


def require_wandb() -> None:
    """See that it is there, before a run is made.

    Raises:
        UsageError: if it is not.
    """
    if find_spec("wandb") is None:
        raise UsageError("--track needs Weights & Biases: pip install 'goalgan_bt[wandb]'")


class Tracker:
    """One run's metrics.

    Args:
        folder: the run folder, whose name is the run's.
        settings: of the run.

    Raises:
        UsageError: if it does not begin.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        import wandb

        mode: Any = os.environ.get("WANDB_MODE", "offline")
        try:
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "goalgan_bt"),
                id=re.sub(r"[:;,#?/']", "-", folder.name),
                name=folder.name,
                reinit="create_new",  # a program's own run goes on beside it
                dir=folder,
                config=dict(settings),
                resume="allow",
                settings=wandb.Settings(mode=mode, console="off", silent=True),
            )
        except Exception as error:  # of the settings, the account, the network
            raise UsageError(f"--track: {str(error).splitlines()[0]}") from None
        self._run.define_metric("*", step_metric="steps/train")

    def metrics(self, row: Mapping[str, float]) -> None:
        """Take in one iteration's; a value that is not a number is left out."""
        self._run.log({name: value for name, value in row.items() if value == value})

    def close(self) -> None:
        """Write what is left."""
        self._run.finish()
