"""Policies in gymnasium-robotics' own environments, unmodified.

    python -m goalgan_bt.study official
    python benchmarks/official.py runs/studies/official --json docs/runs/official.json

Each finished run of the study acts in 100 episodes, with its noise. Its training stands beside it.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from goalgan_bt.learners import evaluation
from goalgan_bt.learners.table import load
from goalgan_bt.runs.command_line import parse, run_command
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.metrics_csv import read_metrics
from goalgan_bt.runs.run_folder import ENDED

IDS = {
    "point_umaze_gym": "PointMaze_UMaze-v3",
    "point_medium_gym": "PointMaze_Medium-v3",
    "point_large_gym": "PointMaze_Large-v3",
    "ant_umaze_gym": "AntMaze_UMaze-v5",
    "ant_medium_gym": "AntMaze_Medium-v5",
    "ant_large_gym": "AntMaze_Large-v5",
}


@dataclass(frozen=True)
class Config:
    """Try the policies of a study in the official environments."""

    runs: tyro.conf.Positional[Path]
    """The study's run folders."""
    episodes: int = 100
    """Episodes of each."""
    json: Path | None = None
    """Where to write the rows."""


def main() -> None:
    """Try them and print.

    Raises:
        UsageError, RunError: saying what is wrong.
    """
    cfg, rows = parse(Config, None, "python benchmarks/official.py"), []
    runs = [(end.parent, load(end.parent)) for end in sorted(cfg.runs.rglob(ENDED))]
    runs = [(run, settings) for run, settings in runs if settings.env in IDS]
    if not runs:
        raise UsageError(
            f"{cfg.runs} holds no finished run in an official maze: python -m goalgan_bt.study "
            "official makes some"
        )
    for run, settings in runs:
        found = evaluation.elsewhere(run, IDS[settings.env], cfg.episodes, False, 0)
        *_, last = read_metrics(run)[1]
        row = {
            "env": IDS[settings.env],
            "seed": settings.seed,
            "training_integrator": settings.integrator,
            "training_steps": int(last["steps/train"]),
            "evaluation_steps": int(last["steps/eval"]),
            "training_seconds": round(float(last["time/total"])),
            "coverage": float(last["eval/coverage"]),
            **{name: found[name] for name in ("episodes", "success", "interval_95", "fell")},
            "seconds_to_goal": found["seconds_to_goal"]["median"],
            "return": found["return"],
        }
        print(json.dumps(row), flush=True)
        rows.append(row)
        if cfg.json is not None:
            cfg.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(run_command(main))
