"""What a run writes while it goes on: metrics and frames, in a folder that is its alone."""

import csv
import fcntl
import os
from pathlib import Path
from typing import Any

import numpy as np

from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.files import check_own, open_to_write, write_atomically
from goalgan_bt.runs.frames import frame_paths
from goalgan_bt.runs.metrics_csv import sound_rows, write_table
from goalgan_bt.runs.policies import forget_after
from goalgan_bt.runs.run_folder import ENDED, end_run, note_resumed
from goalgan_bt.runs.terminal import complain


class RunWriter:
    """Writes metrics and frames into a run folder.

    Args:
        folder: the run folder.
        iteration: rows after this one are dropped, for a run that is taken up again.
        events: whether TensorBoard gets the metrics too, if it is installed.
        resumed: whether the run goes on, or begins again, which `meta.json` then tells.

    Raises:
        RunError: if another process trains this run, or it holds links, which lead elsewhere.
    """

    def __init__(
        self, folder: Path, iteration: int = 0, events: bool = True, resumed: bool = False
    ) -> None:
        self.folder = folder
        check_own(folder)
        self._lock = open_to_write(folder / "lock")
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
        self._columns, rows, lost = sound_rows(folder)
        kept = [row for row in rows if int(row["iteration"]) <= iteration]
        if resumed:
            note_resumed(folder)
        (folder / "frames").mkdir(exist_ok=True)
        (folder / ENDED).unlink(missing_ok=True)
        for left in (*folder.glob("*.part"), *(folder / "frames").glob("*.part")):
            left.unlink()  # of a process that was killed while it wrote
        if self._columns:
            self._rewrite(kept)
        if iteration:
            self._tell_gaps(iteration, {int(row["iteration"]) for row in rows}, lost)
        for frame in frame_paths(folder):
            if int(frame.stem) > iteration:
                frame.unlink()
        forget_after(folder, iteration)
        known = int(kept[-1]["steps/train"]) if kept else 0
        self._events = _tensorboard(folder, known) if events else None

    def _tell_gaps(self, iteration: int, known: set[int], lost: int) -> None:
        """Say what is not as the checkpoint of an iteration has it."""
        table = self.folder / "metrics.csv"
        ahead = sum(1 for i in known if i > iteration)
        if ahead:
            complain(
                f"it goes on from the checkpoint of iteration {iteration}: the {ahead} after it "
                "are made again",
                "note",
            )
        gaps = iteration - len(known) + ahead
        if gaps or lost:
            complain(
                f"{table} is damaged: of the {iteration} iterations up to the checkpoint "
                f"{gaps} have no row, so that the curves will have a gap",
                "warning",
            )

    def metrics(self, row: dict[str, float]) -> None:
        """Append a row; a value that is missing or NaN is an empty cell."""
        cells = {k: f"{v:.6g}" if isinstance(v, float) else str(v) for k, v in row.items()}
        cells = {k: "" if v == "nan" else v for k, v in cells.items()}
        new = [name for name in cells if name not in self._columns]
        if new:  # rare: nothing that is written is kept in memory for it
            _, rows, _ = sound_rows(self.folder)
            self._columns += new
            self._rewrite([*rows, cells])
        else:
            with open_to_write(self.folder / "metrics.csv") as file:
                writer = csv.DictWriter(file, self._columns, restval="", lineterminator="\n")
                writer.writerow(cells)
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

    def sync(self) -> None:
        """Let what was written so far outlast a power cut."""
        with (self.folder / "metrics.csv").open("rb") as file:
            os.fsync(file.fileno())

    def _rewrite(self, rows: list[dict[str, str]]) -> None:
        write_table(self.folder / "metrics.csv", self._columns, rows)


def _tensorboard(folder: Path, steps: int) -> Any:
    """A writer of TensorBoard events; those after so many steps, of before a resume, are void."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder), purge_step=steps + 1 if steps else None)
