"""The run folder: everything a viewer, a plot or a colleague needs, and nothing to unpickle.

runs/<env>-<time>-s<seed>/
    config.json       the resolved settings
    meta.json         versions, git commit, command line, the maze as text; what it was resumed with
    metrics.csv       a row per iteration; columns may be added while it grows
    frames/000010.npz a report: goals, labels, replay, traces, coverage (see `Record.frame`)
    checkpoint.pt     the whole training state (see `goalgan_bt.checkpoint`)
    policy.pt         of locomotion, in the checkpoint's place when it is finished
    ended.txt         how the run ended; absent while it goes on, or where it was killed
    lock              held by the process that trains
    events.*          TensorBoard, if it is installed (extra `tensorboard`)
"""

import csv
import fcntl
import io
import json
import os
import platform
import subprocess
import sys
import time
import types
import typing
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from goalgan_bt.envs.maze import Maze
from goalgan_bt.progress import complain

T = TypeVar("T")

ENDED = "ended.txt"
PACKAGES = ("goalgan_bt", "mujoco", "numpy", "torch", "gymnasium", "gymnasium-robotics", "tyro")


class RunError(ValueError):
    """A folder that is not the run it should be; the message says what to do."""


def create_folder(out: Path, env: str, seed: int) -> Path:
    """A new, empty run folder `<env>-<time>-s<seed>` in `out`."""
    reason: str | None = "all names are taken"
    name = f"{env}-{time.strftime('%Y%m%d-%H%M%S')}-s{seed}"
    for attempt in range(1, 1000):
        folder = out / (name if attempt == 1 else f"{name}-{attempt}")
        try:
            (folder / "frames").mkdir(parents=True)
            return folder
        except FileExistsError:
            continue
        except OSError as error:
            reason = error.strerror
            break
    raise RunError(f"cannot make a run folder in {out} ({reason}): choose another with --out")


def new_run(
    out: Path, env: str, seed: int, settings: dict[str, Any], maze: Maze | None = None
) -> Path:
    """A new run folder in `out` with its `meta.json` and `config.json`."""
    folder = create_folder(out, env, seed)
    write_meta(folder, maze)
    write_settings(folder, settings)
    return folder


def code_commit(folder: Path) -> str | None:
    """The git commit of the checkout that a folder of code is part of.

    With "-dirty" behind it if the code was changed since: that folder, or what belongs to it
    outside (tables and texts, which studies write, do not count). None if it is part of no
    checkout, such as an installed package, or there is no git.
    """

    def git(*words: str) -> str:
        asked = ["git", *words]
        return subprocess.run(
            asked, cwd=folder, capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        if not git("ls-files", "."):
            return None
        changed = git("status", "--porcelain", "--", ".", ":/envs", ":/viz", ":/pyproject.toml")
        return git("rev-parse", "--verify", "HEAD") + "-dirty" * bool(changed)
    except (OSError, subprocess.CalledProcessError):
        return None


def write_meta(folder: Path, maze: Maze | None) -> None:
    """Write what is needed to know and to draw this run to `meta.json`."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    meta = {
        **_call(),
        "python": platform.python_version(),
        "cores": len(os.sched_getaffinity(0)),
        "versions": versions,
        "maze": None if maze is None else {"rows": maze.rows, "cell_size": maze.cell_size},
    }
    (folder / "meta.json").write_text(json.dumps(meta, indent=2) + "\n")


def _call() -> dict[str, Any]:
    return {"argv": sys.argv[1:], "commit": code_commit(Path(__file__).parent)}


def _note_resumed(folder: Path) -> None:
    """Add to `meta.json` what a run is taken up with: the code may be another by now."""
    meta = read_meta(folder)
    meta["resumed"] = [*meta.get("resumed", []), _call()]
    text = json.dumps(meta, indent=2) + "\n"
    write_atomically(folder / "meta.json", lambda file: file.write(text.encode()))


def commits(folder: Path) -> str:
    """The commits of the code that a run was made with, in order, with "+" between them."""
    meta = read_meta(folder)
    calls = [meta, *meta.get("resumed", [])]
    return "+".join(dict.fromkeys(call["commit"] or "unknown" for call in calls))


def write_settings(folder: Path, settings: dict[str, Any]) -> None:
    """Write the resolved settings to `config.json`."""
    text = json.dumps(settings, indent=2, default=str) + "\n"
    write_atomically(folder / "config.json", lambda file: file.write(text.encode()))


def read_settings(kind: type[T], folder: Path) -> T:
    """The settings in `config.json`, as the dataclass that they were.

    Raises:
        RunError: if the folder is no run, or they cannot be read.
    """
    path = folder / "config.json"
    try:
        return _build(kind, json.loads(path.read_text()))
    except FileNotFoundError:
        raise RunError(f"{folder} is no run: it has no config.json") from None
    except (OSError, ValueError, TypeError) as error:
        raise RunError(f"cannot read {path}: {error}") from None


def _build(kind: type[T], values: Any) -> T:
    """A dataclass from what `asdict` and JSON made of it."""
    if not isinstance(values, dict):
        raise TypeError(f"expected settings, found {values!r}")
    hints = typing.get_type_hints(kind)
    known = {f.name for f in fields(typing.cast(Any, kind))}
    if unknown := set(values) - known:
        raise ValueError(f"unknown settings {', '.join(sorted(unknown))}")
    return kind(**{name: _convert(hints[name], value) for name, value in values.items()})


def _convert(hint: Any, value: Any) -> Any:
    if is_dataclass(hint):
        return _build(typing.cast(type[Any], hint), value)
    if hint in (bool, int, float, str) and (
        not isinstance(value, (hint, int) if hint is float else hint)
        or isinstance(value, bool) != (hint is bool)
    ):
        raise TypeError(f"expected {hint.__name__}, found {value!r}")
    if value is not None and (
        hint is Path or (isinstance(hint, types.UnionType) and Path in typing.get_args(hint))
    ):
        return Path(value)
    return tuple(value) if isinstance(value, list) else value


def env_of(folder: Path) -> str:
    """The environment of a run; none, "", where that cannot be read: who reads all of its settings
    tells why."""
    try:
        return str(json.loads((folder / "config.json").read_text())["env"])
    except (OSError, ValueError, TypeError, KeyError):
        return ""


class Record:
    """Writes metrics and frames into a run folder.

    Args:
        folder: the run folder.
        iteration: rows after this one are dropped, for a run that is taken up again.
        events: whether TensorBoard gets the metrics too, if it is installed.

    Raises:
        RunError: if another process trains this run, or what it holds is damaged.
    """

    def __init__(self, folder: Path, iteration: int = 0, events: bool = True) -> None:
        self.folder = folder
        self._lock = (folder / "lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(f"{folder} is being trained by another process: wait for it") from None
        self._rows: list[dict[str, str]] = []
        self._columns: list[str] = []
        if iteration:
            _note_resumed(folder)
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
        for frame in frames(folder):
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

    def close(self, how: str) -> None:
        """Say how the run ended, and flush what TensorBoard buffers."""
        (self.folder / ENDED).write_text(how + "\n")
        self._lock.close()
        if self._events is not None:
            self._events.close()

    def _rewrite(self) -> None:
        write_table(self.folder / "metrics.csv", self._columns, self._rows)


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


def write_atomically(path: Path, write: Any) -> None:
    """Call `write(binary file)` on a temporary file that then takes `path`'s place."""
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def read_metrics(folder: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a run's `metrics.csv`, as text; a last row cut short is left out.

    Raises:
        RunError: if the folder has none, or it is damaged.
    """
    try:
        with (folder / "metrics.csv").open(newline="") as file:
            reader = csv.DictReader(file)
            rows = [row for row in reader if None not in row.values()]
            columns = list(reader.fieldnames or [])
    except FileNotFoundError:
        if (folder / "meta.json").exists():
            raise RunError(
                f"{folder} holds no report yet: wait for its first one, "
                "or start it again if it has ended"
            ) from None
        raise RunError(f"{folder} is no run: it has no metrics.csv") from None
    except OSError as error:
        raise RunError(f"cannot read {folder / 'metrics.csv'}: {error}") from None
    except (csv.Error, UnicodeDecodeError) as error:
        raise RunError(f"{folder / 'metrics.csv'} is damaged: {error}") from None
    counts = [row.get(name, "") for row in rows for name in ("iteration", "steps/train")]
    if any(None in row for row in rows) or not all(count.isdecimal() for count in counts):
        raise RunError(
            f"{folder / 'metrics.csv'} is damaged: each row needs an iteration, steps/train and a "
            "cell per column"
        )
    return columns, rows


def read_meta(folder: Path) -> dict[str, Any]:
    """A run's `meta.json`.

    Raises:
        RunError: if the folder has none or it cannot be read.
    """
    try:
        meta: dict[str, Any] = json.loads((folder / "meta.json").read_text())
    except FileNotFoundError:
        raise RunError(f"{folder} is no run: it has no meta.json") from None
    except (OSError, ValueError) as error:
        raise RunError(f"cannot read {folder / 'meta.json'}: {error}") from None
    if not isinstance(meta, dict) or "commit" not in meta:
        raise RunError(f"{folder / 'meta.json'} is damaged: it names no commit")
    resumed = meta.get("resumed", [])
    if not isinstance(resumed, list) or not all(
        isinstance(call, dict) and "commit" in call for call in resumed
    ):
        raise RunError(f"{folder / 'meta.json'} is damaged: what it was resumed with")
    return meta


def maze_of(folder: Path) -> Maze | None:
    """The maze of a run, or None for an environment without walls.

    Raises:
        RunError: if the folder is no run.
    """
    meta = read_meta(folder)
    try:
        maze = meta["maze"]
        if maze is None:
            return None
        side = float(maze["cell_size"])
        if not 0 < side < 1e3:
            raise ValueError(f"cells of {side} m")
        return Maze(tuple(maze["rows"]), side)
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{folder / 'meta.json'} is damaged: {error!r}") from None


def frames(folder: Path) -> list[Path]:
    """The frames of a run, oldest first."""
    return sorted(f for f in (folder / "frames").glob("*.npz") if f.stem.isdecimal())


def read_frame(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """The arrays of a frame (see `Record.frame`).

    Raises:
        RunError: if it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: np.asarray(data[name]) for name in data.files}
    except Exception as error:  # a damaged archive raises many kinds
        raise RunError(f"cannot read the frame {path}: {error}") from None
    for name, dims in (("goals", 2), ("test_goals", 2), ("coverage", 1)):
        array = arrays.get(name)
        if array is None or array.dtype.kind not in "fiub" or array.ndim != dims:
            raise RunError(f"{path} is no frame of a run: its {name} are missing or damaged")
    if len(arrays["coverage"]) != len(arrays["test_goals"]) or arrays["test_goals"].shape[1] < 2:
        raise RunError(f"{path} is no frame of a run: coverage and test_goals do not fit")
    return arrays


def _tensorboard(folder: Path, steps: int) -> Any:
    """A writer of TensorBoard events; those after so many steps, of before a resume, are void."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder), purge_step=steps + 1 if steps else None)
