"""A run folder as the view sees it: whatever is there by now, and never an error for what is not.

A run may be live (files grow and appear while they are read), finished, of another version, gone.
"""

import contextlib
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from goalgan_bt.envs.maze import FloatArray, Maze
from goalgan_bt.learners.table import learner_of
from goalgan_bt.runs import run_folder
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import Metrics

Frame = dict[str, NDArray[Any]]
REMEMBERED = 64  # frames kept in memory


class Run:
    """What is known of a run.

    Args:
        folder: the run folder.

    Attributes:
        name, env, maze: from the folder; maze is None where there are no walls.
        task: what is learned: env, or the body and its own map.
        kind: what there is to see: goals in a place, rooms (a table of states), or running.
        settings: the resolved settings as nested dictionaries.
        iterations: of the frames there are, ascending.
        metrics: what `metrics.csv` holds.
        gone: whether the folder has vanished; what was read of it stays.

    Raises:
        RunError: if the folder is no run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.name = folder, folder.resolve().name
        self.maze = run_folder.maze_of(folder)
        self.settings = run_folder.settings_of(folder)
        if "env" not in self.settings:
            raise RunError(f"{folder} is no run: it has no readable config.json")
        self.env, self.task = str(self.settings["env"]), run_folder.task_of(self.settings)
        self.kind = _kind_of(self.env)
        self.iterations: list[int] = []
        self.metrics = Metrics(folder / "metrics.csv")
        self.gone = False
        self._listed = -1  # when the frames had last changed before they were listed
        self._frames: OrderedDict[int, tuple[int, Frame]] = OrderedDict()
        self.refresh()

    def refresh(self) -> bool:
        """Look at the folder again; whether there is anything new in it."""
        self.gone = not self.folder.is_dir()
        if self.gone:
            return False
        before = self.iterations
        with contextlib.suppress(OSError):  # it may vanish just now
            changed = (self.folder / "frames").stat().st_mtime_ns
            # The clock of a file system is coarse: of what has just changed, more may come.
            if changed != self._listed or time.time_ns() - changed < 2e9:
                self.iterations = [int(path.stem) for path in frame_paths(self.folder)]
                self._listed = changed
        return self.metrics.refresh() or self.iterations != before

    def frame(self, iteration: int) -> Frame | None:
        """The frame of that iteration, or None if it cannot be read."""
        path = self.folder / "frames" / f"{iteration:06d}.npz"
        try:
            stamp = path.stat().st_mtime_ns  # a resumed run may write a frame anew
            known = self._frames.get(iteration)
            if known is None or known[0] != stamp:
                self._frames[iteration] = stamp, read_frame(path)
        except (OSError, RunError):
            return self._frames[iteration][1] if iteration in self._frames else None
        self._frames.move_to_end(iteration)
        while len(self._frames) > REMEMBERED:
            self._frames.popitem(last=False)
        return self._frames[iteration][1]

    def box(self) -> FloatArray:
        """The box of its goals, (2, goal_dim), metres."""
        if self.maze is not None:
            return np.stack([self.maze.low, self.maze.high])
        frame = self.frame(self.iterations[0]) if self.iterations else None
        goals = np.zeros((1, 2)) if frame is None else frame["goals"]
        return np.stack([np.minimum(goals.min(axis=0), -5), np.maximum(goals.max(axis=0), 5)])

    def side(self) -> float:
        """The longer side of what is drawn of it, metres."""
        return float(np.ptp(drawn(self.maze, self.box()), axis=0).max())

    def middle(self) -> FloatArray:
        """The middle of what is drawn of it, (2,), metres."""
        return np.asarray(drawn(self.maze, self.box()).mean(axis=0))

    def task_and_method(self) -> str:
        """What tells it from other runs, where its settings say so; otherwise its name."""
        known = [self.settings.get(name) for name in ("method", "seed")]
        return self.name if None in known else "{} {} s{}".format(self.task, *known)

    def ended(self) -> str | None:
        """How the run ended, or None while it goes on (or was killed without a word)."""
        return run_folder.ended(self.folder)


def _kind_of(env: str) -> str:
    """What there is to see of an environment; of one that is not known here, goals."""
    try:
        return learner_of(env).page
    except UsageError:
        return "goals"


def visits(frame: Frame) -> FloatArray:
    """How often training has been at each test goal, (K,): 0 for never, 1 for the most, on a scale
    of logarithms."""
    times = of_goals(frame, "visits", np.zeros(len(frame["test_goals"])))
    logs = np.log1p(np.maximum(np.nan_to_num(times), 0))
    return np.asarray(logs / max(logs.max(initial=0.0), 1e-9))


def floor_of(frame: Frame) -> tuple[FloatArray, str]:
    """What the floor shows per test goal, (K,) from 0 to 1, and what that is, in a word."""
    if "visits" in frame:
        return visits(frame), "visits"
    rate, known = success(frame)
    return rate, "coverage" if known else "estimate"


def success(frame: Frame) -> tuple[FloatArray, bool]:
    """Success per test goal, (K,): measured, and True, or the learner's estimate, and False."""
    measured = np.asarray(frame["coverage"], dtype=float)
    if len(measured) and np.isfinite(measured).all():
        return measured, True
    return of_goals(frame, "estimate", measured), False


def labels(frame: Frame) -> NDArray[np.int64]:
    """-1, 0 or 1 per goal, (n,): too hard, intermediate (or not known), too easy."""
    label = of_goals(frame, "label", np.zeros(len(frame["goals"])))
    return np.clip(np.nan_to_num(label), -1, 1).astype(np.int64)


def of_goals(frame: Frame, name: str, default: FloatArray) -> FloatArray:
    """An array with a number per goal, (n,), or the default where a frame has none that fits."""
    array = frame.get(name)
    fits = array is not None and array.shape == default.shape and array.dtype.kind in "fiub"
    return np.asarray(array if fits else default, dtype=float)


def places(frame: Frame, name: str, dims: int) -> FloatArray:
    """An array of places, (..., goal_dim), or none where a frame has none with so many axes."""
    array = frame.get(name)
    if array is None or array.ndim != dims or array.dtype.kind != "f" or array.shape[-1] < 2:
        return np.empty((0,) * (dims - 1) + (2,))
    return array


def drawn(maze: Maze | None, box: FloatArray) -> FloatArray:
    """The part of a box of goals, (2, goal_dim), that is drawn, (2, 2): of the outer wall only a
    strip, since the map is what one wants to see."""
    hidden = 0.0 if maze is None else 0.75 * maze.cell_size
    return np.asarray(box)[:, :2] + np.array([[hidden], [-hidden]])
