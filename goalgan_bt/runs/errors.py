"""What can go wrong that its user can mend; every message says what to do."""

import importlib.util


class UsageError(ValueError):
    """A command line or a call that makes no sense; the message says which part of it."""


def require_installed(extra: str, *libraries: str) -> None:
    """See that the libraries of an extra are there, without importing them.

    Raises:
        UsageError: naming the first that is not, and the extra.
    """
    for library in libraries:
        if importlib.util.find_spec(library) is None:
            raise UsageError(f'{library} is missing: pip install "goalgan_bt[{extra}]"')


class RunError(ValueError):
    """A folder that is not the run it should be; the message says what to do."""


class InterruptedRun(ValueError):
    """What ended a run that did no wrong: it can go on from its last checkpoint."""
