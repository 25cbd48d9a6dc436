"""A run as it goes on: its limits and clock, what is due, what is written and what is shown.

Whatever learns, its loop is

    with Session(folder, settings, limits, schedule) as run:
        while run.goes_on():
            ...
            if run.measures():
                ...
            run.report(metrics, ...)
            if run.saves:
                run.save(state)
"""

import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from goalgan_bt.runs.background import Background, group
from goalgan_bt.runs.clock import Clock
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.ranges import SANE
from goalgan_bt.runs.run_folder import flat, settings_of, write_settings
from goalgan_bt.runs.run_writer import RunWriter
from goalgan_bt.runs.signals import Stop
from goalgan_bt.runs.terminal import Terminal, complain
from goalgan_bt.runs.tracking import Tracker

# Settings on which no result depends.
HARMLESS = frozenset(
    ("resume", "viz", "viz_host", "viz_port", "track", "out", "threads", "report_every")
)


@dataclass(frozen=True)
class Limits:
    """Where a run ends, whichever comes first; None is no limit."""

    total_steps: int | None = None
    iterations: int | None = None
    minutes: float | None = None


@dataclass(frozen=True)
class Schedule:
    """When a run measures and reports.

    Attributes:
        next_measurement: training steps of the measurement after the one at those steps.
        first: iteration before which there is none.
        report_every: iterations between two reports; one with each measurement besides.
    """

    next_measurement: Callable[[int], float]
    first: int = 1
    report_every: int = 1


class Session:
    """One run.

    Args:
        folder: its folder; None for a rank that does not record.
        settings: all of them, to be written into it.
        limits, schedule: when it ends, when it measures.
        title: of the live table; None shows nothing on the terminal.
        state: what `state_dict` gave, to go on from there (see `checked`).
        stop: asked at the end of every iteration whether to end early.
        agreed: makes a number the same on all ranks.
        events: whether TensorBoard gets the metrics too.
        again: whether a run that was there begins once more.

    Attributes:
        iteration: the one under way, from 1 on.
        steps: environment steps so far by purpose: `train`, `label`, `eval`.
        progress: how far this iteration leads towards the first of the limits, 0 to 1 (more in the
            last one, which may pass it); 0 without limits.
        clock: where the time goes; background: what learns beside the main thread.
        row: metrics of this iteration.

    Raises:
        RunError: if the run has reached its limits, or another process trains it.
    """

    def __init__(
        self,
        folder: Path | None,
        settings: Mapping[str, Any],
        limits: Limits,
        schedule: Schedule,
        title: str | None = None,
        *,
        state: Mapping[str, Any] | None = None,
        stop: Stop | None = None,
        agreed: Callable[[float], float] = float,
        events: bool = True,
        again: bool = False,
    ) -> None:
        self.folder, self._limits, self._schedule = folder, limits, schedule
        self._stop, self._agreed = stop, agreed
        self.iteration, self._next = 0, 0.0
        self.steps = {"train": 0, "label": 0, "eval": 0}
        seconds = 0.0
        self.background = Background()
        if state is not None:
            self.background.metrics |= state["metrics"]
            self.iteration, self._next = state["iteration"], state["next_measurement"]
            self.steps, seconds = dict(state["steps"]), state["seconds"]
        self.clock = Clock(seconds)
        if state is not None and self._done() >= 1:
            limit = "--" + self._first_limit().replace("_", "-")
            raise RunError(
                f"{folder} has reached its limits ({self.iteration} iterations, "
                f"{self.steps['train']} steps): ask for more with {limit}"
            )
        self.progress = 0.0
        self.row: dict[str, float] = {}
        self._reached, self._last, self._measures = 0.0, False, False
        self._writer = self._tracker = None
        if folder is not None:
            changes = [] if state is None else changed(folder, settings)
            self._writer = RunWriter(folder, self.iteration, events, again)
            write_settings(folder, dict(settings))
            if changes:
                complain(
                    f"{', '.join(changes)}: what follows is no longer, bit for bit, the run that "
                    "began so",
                    "note",
                )
            try:
                self._tracker = Tracker(folder, settings) if settings.get("track") else None
            except UsageError:
                self._writer.close(None)
                raise
        self._terminal = None if title is None else Terminal(title)

    @property
    def records(self) -> bool:
        """Whether this process writes the run folder."""
        return self._writer is not None

    def goes_on(self) -> bool:
        """Begin the next iteration, unless the last one was the last."""
        if self._last:
            return False
        self.iteration += 1
        self.row = {}
        self.progress = self._agreed(self._done())
        return True

    def count(self, purpose: str, steps: int) -> None:
        """Count environment steps."""
        self.steps[purpose] += steps

    def note(self, name: str, metrics: Mapping[str, float]) -> None:
        """Metrics of this iteration, under a common name."""
        self.row |= group(name, metrics)

    def tally(self, name: str, n: float = 1) -> None:
        """Count what happens now and then: a metric of this iteration by its whole name."""
        self.row[name] = self.row.get(name, 0) + n

    def measures(self) -> bool:
        """Whether this iteration measures what the policy is worth: where that is due, and at the
        end. To be asked once, when everything else of the iteration is done. A run that is stopped
        measures no more than it would without: it can then go on as if it had not been."""
        self._reached = self._agreed(self._done())
        stopped = self._agreed(float(self._stop is not None and self._stop.requested)) > 0
        self._last = self._reached >= 1 or stopped
        steps = self.steps["train"]
        due = self.iteration >= self._schedule.first and steps >= self._next
        self._measures = due or self.complete
        if self._measures:
            self._next = self._schedule.next_measurement(steps)
        return self._measures

    @property
    def complete(self) -> bool:
        """Whether the run has reached the first of its limits."""
        return self._reached >= 1

    @property
    def saves(self) -> bool:
        """Whether the state is saved after this iteration: the first, lest a run that is killed
        early is lost, those that measure, and the last."""
        return self._measures or self._last or self.iteration == 1

    @property
    def reports(self) -> bool:
        """Whether this iteration's report is shown."""
        return self._measures or self.iteration % self._schedule.report_every == 0

    def state_dict(self) -> dict[str, Any]:
        """What a run needs to go on, besides what it has learned."""
        return {
            "iteration": self.iteration,
            "steps": dict(self.steps),
            "seconds": self.clock.total(),
            "next_measurement": self._next,
            "metrics": {name: float(value) for name, value in self.background.metrics.items()},
        }

    def report(
        self,
        metrics: Mapping[str, float],
        frame: Callable[[], Mapping[str, Any]] | None = None,
    ) -> None:
        """Write and show what an iteration gave.

        Args:
            metrics: of the iteration, besides those that were noted.
            frame: gives the arrays of a picture (see `RunWriter.frame`).
        """
        if self._writer is None or self.folder is None:
            return
        self.row = (
            {"iteration": self.iteration}
            | self.row
            | self.background.metrics
            | group("steps", self.steps)
            | group("time", self.clock.metrics(self.steps["train"]))
            | {"memory/resident": resident_mib()}
            | dict(metrics)
        )
        self._writer.metrics(self.row)
        if self._tracker is not None:
            self._tracker.metrics(self.row)
        if self.reports:
            if self._terminal is not None:
                self._terminal.report(self.row, self.left())
            if frame is not None:
                self._writer.frame(self.iteration, **frame())

    def save(
        self,
        state: Mapping[str, Any],
        keep: Callable[[dict[str, Any], Path], None] | None = None,
    ) -> None:
        """Write a checkpoint. After the report, so that all that it goes on from is there.

        Args:
            state: all that learns and remembers.
            keep: told what was saved, and the folder: what shall outlast the next checkpoint.
        """
        if self._writer is None or self.folder is None:
            return
        from goalgan_bt.runs import checkpoint  # torch, which not every learner needs

        self._writer.sync()
        whole = {"run": self.state_dict(), **state}
        checkpoint.save_run(whole, self.folder)
        if keep is not None:
            keep(whole, self.folder)

    def left(self) -> float:
        """Seconds that the run will still take; infinite where nothing tells."""
        if not self._reached:
            return math.inf
        return self.clock.total() * max(1 / self._reached - 1, 0)

    def _done(self) -> float:
        """How far the run is towards the first of its limits: 1 or more at its end."""
        return max(self._shares().values())

    def _first_limit(self) -> str:
        """The limit that comes first."""
        shares = self._shares()
        return max(shares, key=shares.__getitem__)

    def _shares(self) -> dict[str, float]:
        """How far the run is towards each of its limits."""
        limits = self._limits
        minutes = self.clock.total() / 60
        return {
            "total_steps": self.steps["train"] / limits.total_steps if limits.total_steps else 0.0,
            "iterations": self.iteration / limits.iterations if limits.iterations else 0.0,
            "minutes": minutes / limits.minutes if limits.minutes else 0.0,
        }

    def __enter__(self) -> "Session":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.background.close()
        if self._terminal is not None:
            self._terminal.close()
        if self._writer is None:
            return
        saved = self.folder is not None and (self.folder / "checkpoint.pt").is_file()
        early = "stopped early: --resume goes on" if saved else "stopped early"
        how = "complete" if self.complete else early
        self._writer.close(how if error is None else None)
        if self._tracker is not None:
            self._tracker.close()
        if self.folder is not None and isinstance(error, OSError) and not self.folder.exists():
            raise RunError(f"the run folder {self.folder} has vanished: start again") from None


def checked(state: Mapping[str, Any]) -> dict[str, Any]:
    """What `Session.state_dict` gave, read from a file.

    Raises:
        KeyError, TypeError, ValueError, OverflowError: if it is none.
    """
    iteration, steps = int(state["iteration"]), dict[str, int]()
    for name in ("train", "label", "eval"):
        steps[name] = int(state["steps"][name])
    seconds, following = float(state["seconds"]), float(state["next_measurement"])
    if not all(0 <= n < SANE for n in (iteration, seconds, following, *steps.values())):
        raise ValueError("what it says of the run's time cannot be")
    return {
        "iteration": iteration,
        "steps": steps,
        "seconds": seconds,
        "next_measurement": following,
        "metrics": {str(name): float(value) for name, value in state["metrics"].items()},
    }


def changed(folder: Path, settings: Mapping[str, Any]) -> list[str]:
    """What a run that goes on does otherwise than before, of all that its results depend on."""
    old = dict(flat(settings_of(folder)))
    new = dict(flat(json.loads(json.dumps(settings, default=str))))
    flags = {name: "--" + name.replace("_", "-") for name in new}
    changes = [
        f"{flags[name]} was {old[name]} and is {new[name]}"
        for name in new
        if name in old and old[name] != new[name] and name not in HARMLESS
    ]
    clock = [f"{flags['minutes']} goes by the clock"] if new.get("minutes") else []
    return changes + clock


def resident_mib() -> float:
    """Memory that this process has in use, MiB; NaN where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return math.nan
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
