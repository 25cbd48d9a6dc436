"""What a run writes while it goes on: metrics and frames, in a folder that is its alone."""

import csv
import fcntl
from pathlib import Path
from typing import Any

import numpy as np

from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.frames import frame_paths
from goalgan_bt.runs.metrics_csv import read_metrics, write_table
from goalgan_bt.runs.run_folder import ENDED, end_run, note_resumed, write_atomically
from goalgan_bt.runs.terminal import complain


class RunWriter:
    """Writes metrics and frames into a run folder.

    Args:
        folder: the run folder.
        iteration: rows after this one are dropped, for a run that is taken up again.
        events: whether TensorBoard gets the metrics too, if it is installed.
        resumed: whether the run goes on, or begins again, which `meta.json` then tells.

    Raises:
        RunError: if another process trains this run, or what it holds is damaged.
    """

    def __init__(
        self, folder: Path, iteration: int = 0, events: bool = True, resumed: bool = False
    ) -> None:
        self.folder = folder
        self._lock = (folder / "lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise RunError(f"{folder} is being trained by another process: wait for it") from None
        try:
            self._take_up(iteration, events, resumed or iteration > 0)
        except BaseException:
            self._lock.close()
            raise

    def _take_up(self, iteration: int, events: bool, resumed: bool) -> None:
        """Keep what the folder holds up to an iteration."""
        folder = self.folder
        self._rows: list[dict[str, str]] = []
        self._columns: list[str] = []
        if resumed:
            note_resumed(folder)
        (folder / "frames").mkdir(exist_ok=True)
        (folder / ENDED).unlink(missing_ok=True)
        if (folder / "metrics.csv").exists():
            self._columns, rows = read_metrics(folder)
            self._rows = [row for row in rows if int(row["iteration"]) <= iteration]
            self._rewrite()
        if iteration and not (self._rows and int(self._rows[-1]["iteration"]) == iteration):
            complain(
                f"{folder / 'metrics.csv'} has no row of iteration {iteration}, whose checkpoint "
                "it goes on from: the curves will have a gap"
            )
        for frame in frame_paths(folder):
            if int(frame.stem) > iteration:
                frame.unlink()
        known = int(self._rows[-1]["steps/train"]) if self._rows else 0
        self._events = _tensorboard(folder, known) if events else None

    def metrics(self, row: dict[str, float]) -> None:
        """Append a row; a value that is missing or NaN is an empty cell."""
        cells = {k: f"{v:.6g}" if isinstance(v, float) else str(v) for k, v in row.items()}
        cells = {k: "" if v == "nan" else v for k, v in cells.items()}
        self._rows.append(cells)
        new = [name for name in cells if name not in self._columns]
        if new:
            self._columns += new
            self._rewrite()
        else:
            with (self.folder / "metrics.csv").open("a", newline="") as file:
                csv.DictWriter(file, self._columns, restval="").writerow(cells)
        if self._events is not None:
            for name, value in row.items():
                if cells[name] and name != "iteration":
                    self._events.add_scalar(name, value, int(row["steps/train"]))

    def frame(self, iteration: int, **arrays: Any) -> None:
        """Write one report's arrays to `frames/<iteration>.npz`.

        Args:
            iteration: names the file.
            arrays: goals (n, goal_dim), success (n,) estimated, label (n,) -1 too hard,
                0 intermediate, 1 too easy, replayed (n,) bool; replay (m, goal_dim);
                traces (L, k, goal_dim) with NaN after a trace stopped, trace_goals (k, goal_dim);
                paths (T, n, goal_dim) where simulations went, NaN where another episode began;
                test_goals (K, goal_dim), estimate (K,) of their success, and coverage (K,)
                measured, NaN where this report has none.
        """
        path = self.folder / "frames" / f"{iteration:06d}.npz"
        write_atomically(path, lambda file: np.savez_compressed(file, **arrays))

    def close(self, how: str | None) -> None:
        """Say how the run ended, unless that is None, let go of the folder, and flush what
        TensorBoard buffers."""
        if how is not None:
            end_run(self.folder, how)
        self._lock.close()
        if self._events is not None:
            self._events.close()

    def _rewrite(self) -> None:
        write_table(self.folder / "metrics.csv", self._columns, self._rows)


def _tensorboard(folder: Path, steps: int) -> Any:
    """A writer of TensorBoard events; those after so many steps, of before a resume, are void."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder), purge_step=steps + 1 if steps else None)
