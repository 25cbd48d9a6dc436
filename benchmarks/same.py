"""Whether two revisions compute the same: the same commands in both, on this machine.

    python benchmarks/same.py 2f4786a            # against the working tree
    python benchmarks/same.py REV REV --only ant

Each command runs in both; then every cell of `metrics.csv` must be equal (times and memory aside),
and every tensor that a run leaves behind equal bit for bit, under whatever name it is kept. Silent
where all is equal; a line per difference and exit code 1 otherwise. Floating-point results differ
between machines, so that no figures are stored: only revisions are compared.
"""

import csv
import os
import shlex
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

ROOT = Path(__file__).parents[1]
TINY = (
    "--rollout.num-envs 32 --rollout.steps 40 --horizon 120 --backtracking.min-transitions 200 "
    "--coverage.rollouts 1 --coverage.every 3000 --gan.steps 20 --threads 1 --viz none "
)
POINT = f"--env point_umaze {TINY} --iterations 4 --goals.near 0.7"
ROOMS = "--env four_rooms_11 --total-steps 30000"
HOPPER = "--env hopper --backtracking.min-steps 100 --episodes 1"
ANT = f"--env ant_umaze {TINY} --iterations 2 --goals.near 1.4"
LATE = "--imitation.fade 2"  # in so short a run nothing would be imitated, else
COMMANDS = {  # name -> flags of goalgan_bt.train
    "point": POINT,
    "ant": ANT,
    "point_nd": f"--env point_nd --dim 3 {TINY} --iterations 3",
    **{
        method: f"{POINT} --method {method}"
        for method in (
            "recall_traces_paper", "value_seeds", "goal_gan", "gan_fit_all", "alp_gmm", "oracle",
            "feasible", "uniform", "hindsight", "forward_model",
        )
    },
    "point_imitating": f"{POINT} {LATE}",
    "ant_imitating": f"{ANT} {LATE}",
    "hindsight_imitating": f"{POINT} --method hindsight {LATE}",
    "forward_imitating": f"{POINT} --method forward_model {LATE}",
    **{
        f"rooms_{method}": f"{ROOMS} --method {method}"
        for method in ("actor_critic", "per", "recall_traces", "random_model")
    },
    "trpo": f"{HOPPER} --method trpo --total-steps 12000 --num-envs 2",
    "trpo_forward": f"{HOPPER} --method trpo --total-steps 12000 --backtracking.model forward",
    "sac": f"{HOPPER} --method sac --total-steps 3000",
}  # fmt: skip
RANKS = {"two_ranks": f"{POINT} --rollout.num-envs 64"}


@dataclass(frozen=True)
class SameConfig:
    """Compare what two revisions compute."""

    revisions: tyro.conf.Positional[tuple[str, ...]]
    """One, against the working tree, or two."""
    only: tuple[str, ...] = ()
    """Names of commands; all if none is given."""
    processes: int = 2
    """Runs at a time."""


def main() -> int:
    """The command line; returns the exit code."""
    cfg = tyro.cli(SameConfig)
    if not 1 <= len(cfg.revisions) <= 2:
        print("error: name one revision or two", file=sys.stderr)
        return 2
    commands = {**COMMANDS, **RANKS}
    if unknown := set(cfg.only) - set(commands):
        print(f"error: no such command: {', '.join(unknown)}", file=sys.stderr)
        return 2
    names = [name for name in commands if name in (cfg.only or commands)]
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(cfg.processes) as pool:
        sides = [Path(place) / str(i) for i in range(2)]
        for side, revision in zip(sides, [*cfg.revisions, None], strict=False):
            check_out(revision, side)
        runs = {
            name: [pool.submit(perform, side, name, commands[name]) for side in sides]
            for name in names
        }
        found = [
            f"{name}: {line}"
            for name, sides_of in runs.items()
            for line in differences(*(run.result() for run in sides_of))
        ]
    print("".join(f"{line}\n" for line in found), end="")
    return 1 if found else 0


def check_out(revision: str | None, place: Path) -> None:
    """Put the tracked files of a revision, or of the working tree, into a folder."""
    place.mkdir()
    if revision is None:
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT, capture_output=True, check=True,
        ).stdout  # fmt: skip
        there = b"\0".join(
            name for name in listed.split(b"\0") if name and os.path.lexists(ROOT / name.decode())
        )
        packed = subprocess.run(
            ["tar", "-c", "--null", "-T", "-"], cwd=ROOT, input=there, capture_output=True,
            check=True,
        )  # fmt: skip
    else:
        packed = subprocess.run(
            ["git", "archive", revision], cwd=ROOT, capture_output=True, check=True
        )
    subprocess.run(["tar", "-x", "-C", str(place)], input=packed.stdout, check=True)


def perform(source: Path, name: str, flags: str) -> Path:
    """Train with the code in a folder; the run folder."""
    out = source / "runs" / name
    start = [sys.executable, "-m"]
    if name in RANKS:
        start += ["torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m"]
    done = subprocess.run(
        [*start, "goalgan_bt.train", *shlex.split(flags), "--seed", "3", "--out", str(out)],
        cwd=source,
        env=os.environ | {"PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise SystemExit(f"error: {name} failed in {source.name}: {done.stderr.strip()[-800:]}")
    (folder,) = out.iterdir()
    return folder


def differences(ours: Path, theirs: Path) -> Iterator[str]:
    """What is not the same in two run folders, a line each."""
    a, b = table(ours), table(theirs)
    if len(a) != len(b):
        yield f"{len(a)} rows, {len(b)} rows"
    for i, (x, y) in enumerate(zip(a, b, strict=False), 1):
        wrong = sorted(column for column in {*x, *y} if x.get(column) != y.get(column))
        for column in wrong[:3]:
            yield f"row {i}: {column} is {x.get(column)!r} and {y.get(column)!r}"
    for file in ("checkpoint.pt", "policy.pt", "visits.npz"):
        x, y = ((folder / file).exists() for folder in (ours, theirs))
        if x != y:
            yield f"only one side has a {file}"
        elif x:
            some, other = Counter(tensors(ours / file)), Counter(tensors(theirs / file))
            only = [
                sum((one - another).values()) for one, another in ((some, other), (other, some))
            ]
            if any(only):
                yield f"{file}: {only[0]} and {only[1]} tensors are on one side only"


def table(folder: Path) -> list[dict[str, str]]:
    """The rows of `metrics.csv`, without times, memory and empty cells."""
    with (folder / "metrics.csv").open(newline="") as file:
        return [
            {
                column: cell
                for column, cell in row.items()
                if cell and not column.startswith(("time/", "memory/")) and "seconds" not in column
            }
            for row in csv.DictReader(file)
        ]


def tensors(path: Path) -> Iterator[tuple[str, tuple[int, ...], bytes]]:
    """Every array of a file, of whatever name: kind, shape and bytes."""
    if path.suffix == ".npz":
        with np.load(path) as data:
            for name in data.files:
                yield str(data[name].dtype), data[name].shape, data[name].tobytes()
        return
    yield from _within(torch.load(path, weights_only=True))


def _within(value: Any) -> Iterator[tuple[str, tuple[int, ...], bytes]]:
    if isinstance(value, torch.Tensor):
        array = value.numpy()
        yield str(array.dtype), array.shape, array.tobytes()
    elif isinstance(value, dict):
        for part in value.values():
            yield from _within(part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from _within(part)


if __name__ == "__main__":
    sys.exit(main())
