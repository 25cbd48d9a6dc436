"""What torchrun tells its processes, known before torch is imported and all have met."""

import os

from goalgan_bt.runs.errors import UsageError


def launched() -> bool:
    """Whether torchrun started this process; other launchers set similar variables."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def records() -> bool:
    """Whether this is the process that writes the run folder: alone, or the first of all."""
    return not launched() or os.environ.get("RANK", "0") == "0"


def speaks() -> bool:
    """Whether this is the process that talks to people on this machine."""
    return not launched() or os.environ.get("LOCAL_RANK", "0") == "0"


def refuse_company(env: str) -> None:
    """Refuse to learn in several processes what one alone learns.

    Raises:
        UsageError: if torchrun started more than one.
    """
    if launched() and int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise UsageError(f"{env} is learned by one process: start it without torchrun")
