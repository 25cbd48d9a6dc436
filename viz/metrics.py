"""`metrics.csv` as it grows: after the first look only what is new is read."""

import math
import os
from array import array
from pathlib import Path

import numpy as np

from goalgan_bt.envs.maze import FloatArray


class Metrics:
    """The columns of a run's table of metrics; its length is the number of rows.

    Args:
        path: the file, which may not exist yet, end in the middle of a line, or be replaced.

    Attributes:
        changed: when it last changed, seconds since the epoch; minus infinity before it exists.
    """

    _columns: dict[str, "array[float]"]
    _row_of: dict[int, int]  # the last one of an iteration
    _header: bytes
    _read: int  # bytes
    _stamp: tuple[int, int, int]  # of the file: inode, size, time

    def __init__(self, path: Path) -> None:
        self._path = path
        self.changed = -math.inf
        self._forget()

    def __len__(self) -> int:
        return len(self._columns.get("iteration", ()))

    def refresh(self) -> bool:
        """Read what is new; whether the file has changed."""
        try:
            with self._path.open("rb") as file:
                status = os.fstat(file.fileno())
                stamp = status.st_ino, status.st_size, status.st_mtime_ns
                if stamp == self._stamp:
                    return False
                header = file.readline()
                same = stamp[0] == self._stamp[0] and header == self._header
                if not same or status.st_size < self._read:  # another table
                    self._forget()
                    self._header = header
                self._stamp, self.changed = stamp, status.st_mtime
                file.seek(self._read)
                new = file.read()
        except OSError:  # none yet, or just being replaced
            return False
        whole = new[: new.rfind(b"\n") + 1]
        self._read += len(whole)
        for line in whole.decode(errors="replace").split("\n")[:-1]:
            cells = line.rstrip("\r").split(",")  # numbers and names: nothing is quoted
            if not self._columns:
                self._columns = {name: array("d") for name in cells}
            elif len(cells) == len(self._columns):  # else: cut short and gone on with by a resume
                row = dict(zip(self._columns, map(_number, cells), strict=True))
                if math.isfinite(iteration := row.get("iteration", math.nan)):
                    self._row_of[int(iteration)] = len(self)
                    for name, value in row.items():
                        self._columns[name].append(value)
        return True

    def column(self, name: str) -> FloatArray:
        """A metric over the rows, (n,), NaN where it is missing or no number."""
        return np.array(self._columns.get(name, [math.nan] * len(self)), dtype=float)

    def last(self, name: str) -> float:
        """The last value of a metric that is known, NaN if none is."""
        return next((x for x in reversed(self._columns.get(name, array("d"))) if x == x), math.nan)

    def at(self, iteration: int, name: str) -> float:
        """A metric of an iteration, NaN if it is not known."""
        row = self._row_of.get(iteration)
        return math.nan if row is None or name not in self._columns else self._columns[name][row]

    def _forget(self) -> None:
        self._columns, self._row_of = {}, {}
        self._header, self._read, self._stamp = b"", 0, (0, 0, 0)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
