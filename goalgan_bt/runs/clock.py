"""Where the wall time of a run goes."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Clock:
    """Wall time, in all and by activity.

    Args:
        before: seconds of the run before it was resumed.
    """

    def __init__(self, before: float) -> None:
        self._before, self._begin = before, time.perf_counter()
        self._spent: defaultdict[str, float] = defaultdict(float)

    def total(self) -> float:
        """Seconds of the whole run, those before a resume included."""
        return self._before + time.perf_counter() - self._begin

    @contextmanager
    def measure(self, activity: str) -> Iterator[None]:
        """Count what happens inside as that activity."""
        begin = time.perf_counter()
        yield
        self._spent[activity] += time.perf_counter() - begin

    def metrics(self, train_steps: int) -> dict[str, float]:
        """total in seconds, fps in training steps per second of the whole run, and the shares
        of this process's time."""
        here = time.perf_counter() - self._begin
        shares = {f"{name}_share": spent / here for name, spent in self._spent.items()}
        return {"total": self.total(), "fps": train_steps / self.total()} | shares
