"""What a large maze costs: steps/s of training, late in runs in a small one and in a large one.

    python benchmarks/large_maze.py RUN RUN --json docs/runs/large_maze.json

Walls, places and ways are more in a large maze, and places become more while a run learns. So
finished runs go on from where they are, for some iterations each, in turn, in copies. The first
run is the reference.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from goalgan_bt.learners.table import load
from goalgan_bt.runs.command_line import parse, run_command
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.metrics_csv import read_metrics


@dataclass(frozen=True)
class Config:
    """Let finished runs go on, in turn, and compare their steps/s."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders."""
    iterations: int = 12
    """Of each, in each round; the first two and the last do not count."""
    rounds: int = 5
    """How often each has its turn."""
    threads: int = 0
    """Simulation threads; 0 is one per core."""
    json: Path | None = None
    """Where to write the rows."""


def main() -> None:
    """Measure and print.

    Raises:
        UsageError, RunError: saying what is wrong.
    """
    cfg = parse(Config, None, "python benchmarks/large_maze.py")
    if len(cfg.runs) < 2 or cfg.iterations < 5:
        raise UsageError("give two run folders or more, and at least 5 iterations")
    rows: list[dict[str, Any]] = []
    for run in cfg.runs:
        _, reports = read_metrics(run)
        if not reports or "places/known" not in reports[-1]:
            raise UsageError(f"{run} has no report of a maze: name finished runs of mazes")
        known = int(reports[-1]["places/known"])
        rows.append({"env": load(run).env, "places": known, "steps_per_second": []})
    for _ in range(cfg.rounds):
        for run, row in zip(cfg.runs, rows, strict=True):
            row["steps_per_second"].append(round(speed(run, cfg)))
            print(f"{row['env']}: {row['steps_per_second'][-1]:,} steps/s", flush=True)
    reference = np.array(rows[0]["steps_per_second"])
    for row in rows:
        ratios = reference / row["steps_per_second"]  # of times for a step, in the same round
        row["time_of_a_step"] = [round(float(x), 3) for x in np.quantile(ratios, (0.5, 0, 1))]
        middle, low, high = row["time_of_a_step"]
        print(f"{row['env']}, {row['places']} places: {middle:.2f} [{low:.2f}, {high:.2f}]")
    if cfg.json is not None:
        cfg.json.write_text(json.dumps(rows, indent=1) + "\n")


def speed(run: Path, cfg: Config) -> float:
    """Steps/s of a run that goes on, in a copy of its folder."""
    with tempfile.TemporaryDirectory() as directory:
        copy = Path(shutil.copytree(run, Path(directory) / run.name))
        _, before = read_metrics(copy)
        until = len(before) + cfg.iterations
        words = [sys.executable, "-m", "goalgan_bt.train", "--resume", str(copy), "--viz", "none"]
        words += ["--iterations", str(until), "--total-steps", str(10**9)]
        words += ["--threads", str(cfg.threads), "--coverage.every", str(10**8)]
        words += ["--coverage.rollouts", "1"]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode:
            raise UsageError(done.stderr.strip())
        _, rows = read_metrics(copy)
        first, last = (
            {name: float(rows[i][name]) for name in ("steps/train", "time/total")}
            for i in (len(before) + 1, -2)
        )
    return (last["steps/train"] - first["steps/train"]) / (last["time/total"] - first["time/total"])


if __name__ == "__main__":
    sys.exit(run_command(main))
