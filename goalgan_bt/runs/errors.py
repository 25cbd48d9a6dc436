"""What can go wrong that its user can mend; every message says what to do."""


class UsageError(ValueError):
    """A command line or a call that makes no sense; the message says which part of it."""


class RunError(ValueError):
    """A folder that is not the run it should be; the message says what to do."""


class InterruptedRun(ValueError):
    """What ended a run that did no wrong: it can go on from its last checkpoint."""
