"""The run folder: everything a viewer, a plot or a colleague needs, and nothing to unpickle.

runs/<env>-<time>-s<seed>/    (<env>-<method>-<time>-s<seed> where the method is not the usual one)
    config.json       the resolved settings
    meta.json         versions, git commit, command line, the maze as text; what it was resumed with
    metrics.csv       a row per iteration; columns may be added while it grows
    frames/000010.npz a report: goals, labels, replay, traces, coverage (see `RunWriter.frame`)
    policies/000010.pt  policies of some measurements (see `goalgan_bt.runs.policies`)
    checkpoint.pt     the whole training state (see `goalgan_bt.runs.checkpoint`)
    policy.pt         of locomotion; the checkpoint goes when it is finished
    ended.txt         how the run ended; absent while it goes on, or where it was killed
    lock              held by the process that trains
    events.*          TensorBoard, if it is installed (extra `tensorboard`)
    wandb/            Weights & Biases, with --track (extra `wandb`)
"""

import json
import os
import platform
import subprocess
import sys
import time
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, fields, is_dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from goalgan_bt.envs.maze import Maze
from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.files import new_file, read_own, write_json
from goalgan_bt.runs.terminal import complain

T = TypeVar("T")

ENDED = "ended.txt"
SMALL = 2**20  # bytes: no settings of ours are larger
PACKAGES = ("goalgan_bt", "mujoco", "numpy", "torch", "gymnasium", "gymnasium-robotics", "tyro")


def create_folder(out: Path, env: str, seed: int) -> Path:
    """A new, empty run folder `<env>-<time>-s<seed>` in `out`; env may name the method, too."""
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
        "maze": None if maze is None else asdict(maze),
    }
    write_json(folder / "meta.json", meta)


def _call() -> dict[str, Any]:
    return {"argv": sys.argv[1:], "commit": code_commit(Path(__file__).parents[1])}


def note_resumed(folder: Path) -> None:
    """Add to `meta.json` what a run is taken up with: the code may be another by now."""
    meta = read_meta(folder)
    meta["resumed"] = [*meta.get("resumed", []), _call()]
    write_json(folder / "meta.json", meta)


def mend_meta(folder: Path, maze: Maze | None) -> None:
    """Write a `meta.json` that cannot be read anew; it stays as `meta_damaged.json`."""
    try:
        read_meta(folder)
    except RunError as error:
        complain(f"{error}: it is written anew", "warning")
        if (folder / "meta.json").exists():
            (folder / "meta.json").replace(folder / "meta_damaged.json")
        write_meta(folder, maze)


def commits(folder: Path) -> str:
    """The commits of the code that a run was made with, in order, with "+" between them."""
    meta = read_meta(folder)
    calls = [meta, *meta.get("resumed", [])]
    return "+".join(dict.fromkeys(call["commit"] or "unknown" for call in calls))


def write_settings(folder: Path, settings: dict[str, Any]) -> None:
    """Write the resolved settings to `config.json`."""
    write_json(folder / "config.json", settings)


def read_settings(kind: type[T], folder: Path) -> T:
    """The settings in `config.json`, as the dataclass that they were.

    Raises:
        RunError: if the folder is no run, or they cannot be read.
    """
    path = folder / "config.json"
    try:
        return _build(kind, json.loads(read_own(path, SMALL)))
    except FileNotFoundError:
        raise RunError(f"{folder} is no run: it has no config.json{inside(folder)}") from None
    except (OSError, ValueError, TypeError, OverflowError) as error:
        raise RunError(f"cannot read {path}: {error}") from None


def runs_in(folders: Iterable[Path]) -> list[Path]:
    """Run folders: those named themselves, and in the place of any other folder the runs in it and
    in its folders, by name."""
    found: list[Path] = []
    for folder in folders:
        inner = [
            path.parent for deep in ("*", "*/*") for path in folder.glob(deep + "/config.json")
        ]
        alone = (folder / "config.json").exists() or not inner
        found += [folder] if alone else sorted(inner)
    return list(dict.fromkeys(found))


def inside(folder: Path) -> str:
    """What a message adds where a folder of runs was named in a run's place."""
    runs = sorted(path.parent for path in folder.glob("*/config.json"))
    return f"; it holds {len(runs)} runs, of which {runs[-1]} is the last by name" if runs else ""


def settings_of(folder: Path) -> dict[str, Any]:
    """The settings in `config.json` as nested dictionaries; none where it cannot be read."""
    try:
        settings = json.loads(read_own(folder / "config.json", SMALL))
        return settings if isinstance(settings, dict) else {}
    except (OSError, ValueError, RecursionError):
        return {}


def task_of(settings: Mapping[str, Any]) -> str:
    """What is learned with these settings: the environment, or its body and a map of one's own."""
    env, own_map = str(settings["env"]), settings.get("map")
    if env == "point_nd":
        return f"{env} in {settings.get('dim')} dimensions"
    body = env.rpartition(":")[2].split("_")[0].lower()
    return env if own_map is None else f"{body}_{Path(str(own_map)).stem}"


def flat(settings: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Nested settings by name, those of a part as `trpo.max_kl`."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{before}{name}.")
        else:
            yield before + name, value


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


def end_run(folder: Path, how: str) -> None:
    """Say how a run ended."""
    with new_file(folder / ENDED) as file:
        file.write((how + "\n").encode())


def ended(folder: Path) -> str | None:
    """How a run ended; None while it goes on, or where it was killed without a word."""
    try:
        return read_own(folder / ENDED, SMALL).decode()[:200].strip()
    except (OSError, UnicodeDecodeError):
        return None


def env_of(folder: Path) -> str:
    """The environment of a run; none, "", where that cannot be read: who reads all of its settings
    tells why."""
    return str(settings_of(folder).get("env", ""))


def read_meta(folder: Path) -> dict[str, Any]:
    """A run's `meta.json`.

    Raises:
        RunError: if the folder has none or it cannot be read.
    """
    try:
        meta: dict[str, Any] = json.loads(read_own(folder / "meta.json", SMALL))
    except FileNotFoundError:
        raise RunError(f"{folder} is no run: it has no meta.json{inside(folder)}") from None
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
        x, y = map(float, maze.get("start", (0.0, 0.0)))
        if not max(abs(x), abs(y)) < 1e6:
            raise ValueError(f"a start at {x}, {y}")
        return Maze(tuple(maze["rows"]), side, (x, y))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise RunError(f"{folder / 'meta.json'} is damaged: {error!r}") from None
