"""How coverage after a budget depends on the length of the longest way: twenty random mazes.

    python benchmarks/random_mazes.py --env point --json docs/runs/random_mazes_point.json
    python benchmarks/random_mazes.py --env ant --json docs/runs/random_mazes_ant.json
    python benchmarks/random_mazes.py --draw docs/pictures/random_mazes.png

Each maze is one run of the default settings, of seed 0, with a fixed budget. The untrained policy
is measured as well: what a body covers that has learned nothing.
"""

import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from goalgan_bt.envs.random_maze import random_maze
from goalgan_bt.runs.metrics_csv import read_metrics

RUNS = Path(__file__).parents[1] / "docs/runs"
ALONE = os.environ | {"OMP_NUM_THREADS": "1"}
# Rooms, with a cell between two of them: 3 x 3 to 9 x 9 cells.
SIZES = (2, 2), (2, 3), (2, 4), (2, 5), (3, 3), (3, 4), (3, 5), (4, 4), (4, 5), (5, 5)


@dataclass(frozen=True)
class RandomConfig:
    """Train in random mazes of 3 x 3 to 9 x 9 cells, walls around them not counted."""

    env: Literal["point", "ant"] = "point"
    """The body."""
    mazes: int = 20
    """How many."""
    steps: int = 1_000_000
    """Environment steps of training in each."""
    processes: int = 0
    """Runs at a time, of one simulation thread each; 0 is one per core."""
    json: Path | None = None
    """Where to write the rows."""
    draw: Path | None = None
    """Instead, draw the rows that are known."""


def main(cfg: RandomConfig) -> None:
    if cfg.draw is not None:
        draw(cfg.draw)
        return
    rows = []
    processes = cfg.processes or len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as directory, ThreadPoolExecutor(processes) as pool:
        for row in pool.map(lambda i: row_of(cfg, i, Path(directory)), range(cfg.mazes)):
            rows.append(row)
            print(json.dumps({name: row[name] for name in row if name != "rows"}), flush=True)
            if cfg.json is not None:
                cfg.json.write_text(json.dumps(rows, indent=1) + "\n")


def row_of(cfg: RandomConfig, i: int, directory: Path) -> dict[str, Any]:
    """What comes of a random maze."""
    maze = random_maze(SIZES[i % len(SIZES)], np.random.default_rng(i))
    path = directory / f"random_{i}.txt"
    path.write_text("\n".join(maze.rows) + "\n")
    known = {"rows": list(maze.rows), "longest_way": maze.longest_way}
    return known | trained(cfg, path, directory / "runs")


def trained(cfg: RandomConfig, maze: Path, out: Path) -> dict[str, float]:
    """Coverage in a maze before and after training, and what that took."""
    words = [sys.executable, "-m", "goalgan_bt.train", "--env", f"{cfg.env}_umaze", "--viz", "none"]
    words += ["--map", str(maze), "--out", str(out), "--threads", "1"]
    words += ["--coverage.every", str(10**9)]
    if cfg.env == "ant":  # its episodes are long
        words += ["--coverage.rollouts", "1"]
    first = ["--iterations", "1", "--trpo.max-kl", "1e-9"]  # learns next to nothing
    found = {}
    for name, more in (("untrained", first), ("trained", ["--total-steps", str(cfg.steps)])):
        done = subprocess.run([*words, *more], capture_output=True, text=True, env=ALONE)
        if done.returncode:
            raise SystemExit(done.stderr)
        folder = Path(done.stdout.splitlines()[0].removeprefix("run folder: "))
        _, table = read_metrics(folder)
        found[name] = float(table[-1]["eval/coverage"])
    found["steps"] = int(table[-1]["steps/train"])
    found["seconds"] = round(float(table[-1]["time/total"]))
    found["floor"] = float(table[-1]["eval/floor"])
    return found


def draw(path: Path) -> None:
    """Coverage over the longest way."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.6), layout="constrained")
    ax = figure.subplots()
    for i, body in enumerate(("point", "ant")):
        known = RUNS / f"random_mazes_{body}.json"
        if not known.exists():
            continue
        rows = json.loads(known.read_text())
        way = [row["longest_way"] for row in rows]
        label = f"{body}, {rows[0]['steps'] / 1e6:.0f} million steps"
        ax.plot(way, [row["trained"] for row in rows], "os"[i], color=f"C{i}", label=label)
        untrained = [row["untrained"] for row in rows]
        ax.plot(
            way, untrained, "os"[i], color=f"C{i}", mfc="none", ms=4, label=f"{body}, untrained"
        )
    ax.set(xlabel="longest way from the start, metres", ylabel="coverage", ylim=(0, 1.02))
    ax.grid(alpha=0.25)
    ax.legend(fontsize=7)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main(tyro.cli(RandomConfig, description=__doc__))
