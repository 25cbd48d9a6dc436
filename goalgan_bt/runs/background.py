"""Work in the background: networks that the policy does not need while it acts learn meanwhile."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any


def group(name: str, values: Mapping[str, float]) -> dict[str, float]:
    """Metrics under a common name: `name/key`."""
    return {f"{name}/{key}": value for key, value in values.items()}


class Background:
    """A thread beside the main one: what learns there may go on during the next rollouts.

    Attributes:
        metrics: the last ones of all that was waited for; of lessons that were `undone` all.
    """

    def __init__(self) -> None:
        self.metrics: dict[str, float] = {}
        self._thread = ThreadPoolExecutor(1)
        self._running: dict[str, Future[dict[str, float]]] = {}

    def close(self) -> None:
        """Drop what has not begun, and wait for what has."""
        self._thread.shutdown(cancel_futures=True)

    def start(self, name: str, fit: Callable[..., dict[str, float]], *args: Any) -> None:
        """Call fit(*args), which gives metrics, after what was started before."""
        self._running[name] = self._thread.submit(fit, *args)

    def finish(self) -> None:
        """Until all have ended."""
        self.wait(*self._running)

    def wait(self, *names: str) -> None:
        """Until these have ended, if they were started."""
        for name in names:
            if name in self._running:
                told = self._running.pop(name).result()
                if "undone" in told:  # rare, and thus counted over the run (see `soundly`)
                    told["undone"] += self.metrics.get(f"{name}/undone", 0.0)
                self.metrics |= group(name, told)
