"""Trainings that are killed over and over, and go on: is the end the same, bit for bit?

    python benchmarks/kills.py --kills 200

Half of the kills (SIGKILL) come at a random moment, half while a checkpoint is being written. A
process that has imported everything forks the trainings, so that a kill costs no import.
"""

import io
import os
import signal
import sys
import tempfile
import time
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from common import told

from goalgan_bt.learners import maze, table
from goalgan_bt.runs import checkpoint, run_folder
from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import read_metrics

SMALL = (
    "--rollout.num-envs 12 --rollout.steps 20 --threads 1 --coverage.rollouts 1 --viz none "
    "--gan.pretrain-steps 20 --gan.steps 5 --backtracking.min-transitions 40 --updates 2 "
    "--backtracking.buffer 300 --action-repeat 4 --horizon 60 --coverage.every 4000 --iterations 30"
)
RUNS = (
    "--env point_umaze",
    "--env point_umaze --method with_traces",
    "--env ant_umaze",
    "--env point_nd",
)


@dataclass(frozen=True)
class KillsConfig:
    """Kill small trainings, and compare them with ones that nobody killed."""

    kills: int = 200
    """How many in all, over four kinds of runs."""
    seed: int = 0
    """Of the moments."""
    json: Path | None = None
    """Where to write the counts."""


def train(words: str, folder: Path) -> int:
    """Begin or go on with a run in a process of its own, which this returns at once."""
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            cfg = table.from_command_line(f"{words} {SMALL}".split())
            resume = (folder / checkpoint.NAME).exists()
            cfg = replace(cfg, resume=folder if resume else None)
            if not (folder / "config.json").exists():
                with maze.prepared(cfg) as world:
                    run_folder.write_meta(folder, world.maze)
                    run_folder.write_settings(folder, asdict(cfg))
            maze.train(cfg, folder)
        code = 0
    except RunError as error:
        code = 3 if "has reached its limits" in str(error) else 1
    finally:
        os._exit(code)


def killed(words: str, folder: Path, kills: int, rng: np.random.Generator) -> dict[str, int]:
    """Kill a run so often, and let it come to its end: what was seen."""
    seen = {"kills": 0, "while_saving": 0, "unreadable": 0, "lost": 0}
    saved = 0
    while True:
        process, end = train(words, folder), time.monotonic() + rng.uniform(0.05, 1.2)
        saving = seen["kills"] % 2 == 1
        if seen["kills"] < kills:
            part = folder / f"{checkpoint.NAME}.part"
            while time.monotonic() < end or (saving and not part.exists()):
                if os.waitpid(process, os.WNOHANG)[0]:
                    break
                time.sleep(0.0002 if saving else 0.005)
            else:
                seen["kills"] += 1
                seen["while_saving"] += saving
                os.kill(process, signal.SIGKILL)
                os.waitpid(process, 0)
        else:
            _, status = os.waitpid(process, 0)
            if os.waitstatus_to_exitcode(status) not in (0, 3):
                raise SystemExit(f"{words} does not go on after {seen['kills']} kills")
            return seen
        saved = look(folder, saved, seen)
        if run_folder.ended(folder) == "complete":  # once more from the start, until it is enough
            for path in sorted(folder.rglob("*"), reverse=True):
                path.rmdir() if path.is_dir() else path.unlink()
            saved = 0


def look(folder: Path, before: int, seen: dict[str, int]) -> int:
    """Whether what a killed run left can be read, and nothing is lost of what was saved before; the
    iteration that is saved now."""
    now = 0
    for name in (checkpoint.NAME, checkpoint.PREVIOUS):
        if (folder / name).exists():
            try:
                now = max(now, checkpoint.read(folder / name)["run"]["iteration"])
            except (OSError, ValueError):
                seen["unreadable"] += 1
    rows = []
    if (folder / "metrics.csv").exists():
        try:
            rows = [int(row["iteration"]) for row in read_metrics(folder)[1]]
        except RunError:
            seen["unreadable"] += 1
    for path in frame_paths(folder):
        try:
            read_frame(path)
        except RunError:
            seen["unreadable"] += 1
    there = {int(path.stem) for path in frame_paths(folder)}
    lost = now < before or not {*range(1, now + 1)} <= ({*rows} & there)
    seen["lost"] += lost
    return now


def same(one: Path, two: Path) -> bool:
    """Whether two runs are, in all but their times and memory."""
    columns = [name for name in read_metrics(one)[0] if not name.startswith(("time/", "memory/"))]
    tables = [
        [[row[name] for name in columns] for row in read_metrics(folder)[1]]
        for folder in (one, two)
    ]
    frames = [frame_paths(folder) for folder in (one, two)]
    if tables[0] != tables[1] or [p.name for p in frames[0]] != [p.name for p in frames[1]]:
        return False
    pairs = [(read_frame(a), read_frame(b)) for a, b in zip(*frames, strict=True)]
    states = [checkpoint.read(folder / checkpoint.NAME) for folder in (one, two)]
    for state in states:
        state["run"].pop("seconds")
    return all(equal(a, b) for a, b in pairs) and equal(*states)


def equal(x: Any, y: Any) -> bool:
    """Whether two states are, in every bit."""
    if isinstance(x, dict):
        return x.keys() == y.keys() and all(equal(x[key], y[key]) for key in x)
    if isinstance(x, list | tuple):
        return len(x) == len(y) and all(map(equal, x, y))
    if isinstance(x, torch.Tensor | np.ndarray):
        a, b = np.asarray(x), np.asarray(y)
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    return bool(x == y or (x != x and y != y))


def run(cfg: KillsConfig) -> dict[str, int]:
    """All kinds of runs, each with its share of the kills: the counts."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(cfg.seed)
    total = {"runs": 0, "kills": 0, "while_saving": 0, "unreadable": 0, "lost": 0, "different": 0}
    for i, words in enumerate(RUNS):
        share = len(range(i, cfg.kills, len(RUNS)))
        with tempfile.TemporaryDirectory() as place:
            whole, folder = Path(place) / "whole", Path(place) / "killed"
            for each in (whole, folder):
                each.mkdir()
            os.waitpid(train(words, whole), 0)
            seen = killed(words, folder, share, rng)
            total["different"] += not same(whole, folder)
        total["runs"] += 1
        total = {name: n + seen.get(name, 0) for name, n in total.items()}
        print(f"{words}: {seen}", file=sys.stderr, flush=True)
    return total


def main(cfg: KillsConfig) -> None:
    counts = run(cfg)
    told(counts, cfg.json)
    sys.exit(any(counts[name] for name in ("unreadable", "lost", "different")))


if __name__ == "__main__":
    main(tyro.cli(KillsConfig, description=__doc__))
