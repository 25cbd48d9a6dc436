"""`metrics.csv`: a row per iteration; columns may be added while it grows.

Written by `RunWriter`; read here, whole (`read_metrics`) or as it grows (`Metrics`).
"""

import csv
import io
import math
import os
import re
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.files import LARGE, open_own, read_own, write_atomically

LARGEST = 4 * 2**30  # bytes, of the table of a run of years
COUNT = re.compile(r"[0-9]{1,18},[0-9]{1,18}$")


def write_table(path: Path, columns: Sequence[str], rows: list[dict[str, str]]) -> None:
    """Write rows as CSV, all or nothing; what a row lacks is an empty cell."""

    def write(file: Any) -> None:
        text = io.TextIOWrapper(file, newline="")
        writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        text.flush()
        text.detach()

    write_atomically(path, write)


def read_metrics(folder: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a run's `metrics.csv`, as text; a row cut short is left out.

    Raises:
        RunError: if the folder has none, or it is damaged.
    """
    path = folder / "metrics.csv"
    try:
        text = read_own(path).decode()
    except FileNotFoundError:
        if (folder / "meta.json").exists():
            raise RunError(
                f"{folder} holds no report yet: wait for its first one, "
                "or start it again if it has ended"
            ) from None
        raise RunError(f"{folder} is no run: it has no metrics.csv") from None
    except OSError as error:
        raise RunError(f"cannot read {path}: {error}") from None
    except UnicodeDecodeError as error:
        raise RunError(f"{path} is damaged: {error}") from None
    columns, *lines = list(_cells(text)) or [[]]
    rows = [dict(zip(columns, line, strict=False)) for line in lines if len(line) >= len(columns)]
    counts = [row.get(name, "") for row in rows for name in ("iteration", "steps/train")]
    if max(map(len, lines), default=0) > len(columns) or not all(map(str.isdecimal, counts)):
        raise RunError(
            f"{path} is damaged: each row needs an iteration, steps/train and a cell per column"
        )
    return columns, rows


def sound_rows(folder: Path) -> tuple[list[str], list[dict[str, str]], int]:
    """Columns and rows of a run's `metrics.csv` as far as they are sound, none where there is no
    such table, and how many are not.

    Raises:
        RunError: if there is something that cannot be read, or is too large to be one.
    """
    try:
        text = read_own(folder / "metrics.csv", LARGEST).decode(errors="replace")
    except FileNotFoundError:
        return [], [], 0
    except OSError as error:
        raise RunError(f"{error}: move it away, and the run goes on without it") from None
    columns, *lines = list(_cells(text)) or [[]]
    if not {"iteration", "steps/train"} <= {*columns} or len({*columns}) < len(columns):
        return [], [], len(lines)
    whole = [dict(zip(columns, line, strict=True)) for line in lines if len(line) == len(columns)]
    counted = [row for row in whole if COUNT.match(row["iteration"] + "," + row["steps/train"])]
    rows = {int(row["iteration"]): row for row in counted}
    return columns, [rows[i] for i in sorted(rows)], len(lines) - len(rows)


class Metrics:
    """The columns of a run's table of metrics as it grows: after the first look only what is new
    is read. Its length is the number of rows.

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
            with open_own(self._path) as file:
                status = os.fstat(file.fileno())
                stamp = status.st_ino, status.st_size, status.st_mtime_ns
                if stamp == self._stamp:
                    return False
                if status.st_size > LARGE:  # nothing of ours
                    return False
                header = file.readline()
                same = stamp[0] == self._stamp[0] and header == self._header
                if not same or status.st_size < self._read:  # another table
                    self._forget()
                    self._header = header
                self._stamp, self.changed = stamp, status.st_mtime
                file.seek(self._read)
                new = file.read(max(0, status.st_size - self._read))
        except OSError:  # none yet, or just being replaced
            return False
        whole = new[: new.rfind(b"\n") + 1]
        self._read += len(whole)
        for cells in _cells(whole.decode(errors="replace")):
            if not self._columns:
                self._columns = {name: array("d") for name in cells}
            elif len(cells) == len(self._columns):  # else: cut short and gone on with by a resume
                row = dict(zip(self._columns, map(_number, cells), strict=True))
                if math.isfinite(iteration := row.get("iteration", math.nan)):
                    self._row_of[int(iteration)] = len(self)
                    for name, value in row.items():
                        self._columns[name].append(value)
        return True

    @property
    def names(self) -> list[str]:
        """Of the metrics, in the order of the table."""
        return list(self._columns)

    def column(self, name: str) -> NDArray[np.float64]:
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


def _cells(text: str) -> Iterator[list[str]]:
    """The cells of each line: numbers and names, of which none is quoted."""
    for line in text.split("\n"):
        if line.strip():
            yield line.rstrip("\r").split(",")


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
