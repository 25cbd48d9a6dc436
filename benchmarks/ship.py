"""The part of a run folder that a demo needs: policy, places, some reports.

    python -m goalgan_bt.train --env ant_umaze --coverage.every 1000000
    python benchmarks/ship.py RUN goalgan_bt/demo/ant_umaze

A whole checkpoint holds all that learns and remembers, some tens of megabytes.
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np

from goalgan_bt.runs import checkpoint
from goalgan_bt.runs.frames import frame_paths
from goalgan_bt.runs.policies import policy_alone

REPORTS = 24  # evenly spread over the run
PRIVATE = "--out", "--map"  # flags that name a path of the machine


def without_paths(words: list[str]) -> list[str]:
    """A command line without the flags that name paths, as `--out X` or `--out=X`."""
    kept = [word for word in words if not word.startswith(tuple(f"{flag}=" for flag in PRIVATE))]
    named = {i for i, word in enumerate(kept) if word in PRIVATE}
    return [word for i, word in enumerate(kept) if not {i, i - 1} & named]


def ship(run: Path, out: Path) -> None:
    out.mkdir(parents=True)
    (out / "frames").mkdir()
    for name in ("metrics.csv", "ended.txt"):
        shutil.copy(run / name, out / name)
    settings = json.loads((run / "config.json").read_text())
    public = settings | {"out": "runs", "map": None}
    (out / "config.json").write_text(json.dumps(public, indent=2) + "\n")
    meta = json.loads((run / "meta.json").read_text())
    if "resumed" in meta:
        sys.exit("a run that was resumed is none that one command makes: ship another")
    meta["argv"] = without_paths(meta["argv"])
    (out / "meta.json").write_text(json.dumps(meta, indent=2) + "\n")
    frames = frame_paths(run)
    for i in np.unique(np.linspace(0, len(frames) - 1, REPORTS).round().astype(int)):
        shutil.copy(frames[i], out / "frames" / frames[i].name)
    with checkpoint.saved(run) as state:
        checkpoint.save(policy_alone(state), out / "checkpoint.pt")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    ship(Path(sys.argv[1]), Path(sys.argv[2]))
