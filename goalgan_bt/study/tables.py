"""The tables of a study: `runs.csv`, a row per report, and `costs.csv`, a row per run."""

import csv
import fcntl
import math
from pathlib import Path

from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.metrics_csv import read_metrics, write_table
from goalgan_bt.runs.run_folder import commits
from goalgan_bt.study.plan import Trial

KEY = ("env", "method", "seed")


COSTS = (*KEY, "flags", "commit", "train", "label", "eval", "seconds")  # of costs.csv


class Tables:
    """`runs.csv` (a row per report) and `costs.csv` (a row per run) of a study.

    Args:
        folder: where they are or shall be.
        measure: what runs are judged by; the name of its column.

    Attributes:
        curves, costs: their rows.
    """

    def __init__(self, folder: Path, measure: str) -> None:
        self.folder, self.measure = folder, measure
        self._columns = (*KEY, "steps", measure)
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = (folder / ".lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(f"{folder} is another study's at work: wait for it") from None
        curves = _read(folder / "runs.csv", self._columns)
        # What is not in both was cut off between the two, or is damaged: it is run again.
        begun = {_key(row) for row in curves}
        self.costs = [row for row in _read(folder / "costs.csv", COSTS) if _key(row) in begun]
        known = {_key(row) for row in self.costs}
        self.curves = [row for row in curves if _key(row) in known]

    def has(self, run: Trial) -> bool:
        """Whether a run is finished.

        Raises:
            UsageError: if it was made with other flags.
        """
        for row in self.costs:
            if _key(row) == run.key:
                if row["flags"] != run.flags:
                    raise UsageError(
                        f"{self.folder} holds {run.method} of {run.env} with the flags "
                        f"{row['flags']!r}, not {run.flags!r}: rename the method or the study"
                    )
                return True
        return False

    def add(self, run: Trial, folder: Path) -> float:
        """Take in a finished run; what it measured last."""
        _, rows = read_metrics(folder)
        key = dict(zip(KEY, run.key, strict=True))
        found = [(row["steps/train"], row.get(f"eval/{self.measure}")) for row in rows]
        reports = [(steps, value) for steps, value in found if value]
        if not reports:
            raise RunError(f"{folder} has measured no {self.measure}: remove it")
        self.curves += [key | {"steps": steps, self.measure: value} for steps, value in reports]
        last = rows[-1]
        self.costs.append(
            key
            | {"flags": run.flags, "commit": commits(folder)}
            | {kind: last[f"steps/{kind}"] for kind in ("train", "label", "eval")}
            | {"seconds": f"{float(last['time/total']):.0f}"}
        )
        write_table(self.folder / "runs.csv", self._columns, self.curves)
        write_table(self.folder / "costs.csv", COSTS, self.costs)
        return float(reports[-1][1])


def _key(row: dict[str, str]) -> tuple[str, ...]:
    return tuple(row[name] for name in KEY)


def _read(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    if not path.exists():
        return []
    numbers = [name for name in columns if name not in ("env", "method", "flags", "commit")]
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        if any(set(row) != set(columns) or None in row.values() for row in rows):
            raise ValueError(f"its columns must be {', '.join(columns)}")
        for row in rows:
            if not all(math.isfinite(float(row[name])) for name in numbers):
                raise ValueError(f"a number in the row of {', '.join(_key(row))} is not finite")
            int(row["seed"])
    except ValueError as error:  # UnicodeDecodeError is one
        raise RunError(f"{path} is damaged: {error}") from None
    return rows
