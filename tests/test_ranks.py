"""Two real processes on this machine train as one would, and outlive each other's end."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import call
from test_resume import assert_same_runs, new_folder, settings

from goalgan_bt.learners import maze_config, maze_learner, table
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.maze_learner import MazeLearner
from goalgan_bt.runs import ranks

TWO = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
# A GAN amplifies rounding within a hundred steps: two show that it is given the same.
SMALL = (
    "--env point_umaze --viz none --threads 1 --updates 3 --rollout.num-envs 8 "
    "--coverage.rollouts 1 --gan.pretrain-steps 2 --gan.steps 2 --backtracking.min-transitions 50"
)


def start(*arguments, program=("-m", "goalgan_bt.train")):
    words = [*TWO, *program, *map(str, arguments)]
    return subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def saved(out):
    (path,) = Path(out).glob("*/checkpoint.pt")
    return torch.load(path, weights_only=True)


def test_alone_nothing_is_reduced_or_shared():
    x = torch.arange(3.0)
    assert ranks.size() == 1 and ranks.rank() == 0
    assert ranks.total(x) is x and torch.equal(ranks.mean(x), torch.arange(3.0))
    rows = np.arange(4)
    assert ranks.gather(rows) is rows and rows[ranks.share(4)].tolist() == [0, 1, 2, 3]
    assert torch.equal(ranks.mine(x, 10), x) and ranks.agreed(0.1) == 0.1


CHECK = """
import os, sys
import numpy as np, torch
import goalgan_bt.learners.maze
from goalgan_bt import train
from goalgan_bt.runs import ranks
threads = lambda: len(os.listdir("/proc/self/task"))
torch.ones(1)
before = threads()
ranks.begin()
assert threads() > before
r = ranks.rank()
assert ranks.size() == 2
assert ranks.total(torch.full((2,), r + 1.0)).tolist() == [3.0, 3.0]
assert ranks.total(torch.tensor(float(r)), background=True).item() == 1.0
assert ranks.mean(torch.tensor(float(r))).item() == 0.5
assert ranks.gather(np.full((r + 1, 2), r)).tolist() == [[0, 0], [1, 1], [1, 1]]
assert ranks.gather(np.zeros((0, 3), bool)).shape == (0, 3)
assert ranks.gather(np.ones(r, bool)).tolist() == [True]
assert np.arange(5)[ranks.share(5)].tolist() == [[0, 1], [2, 3, 4]][r]
assert ranks.mine(torch.tensor([3, 0, 5, 2]), 3).tolist() == [[0, 2], [0, 2]][r]
assert ranks.agreed(float(r)) == 0.5
x = torch.full((3,), float(r))
ranks.agree([x])
assert x.tolist() == [0.0] * 3
assert train.main(sys.argv[1:]) == 2  # refused; a command leaves the others as it ends
assert ranks.size() == 1
assert threads() == before  # one of gloo's that is left aborts the process now and then
"""


def test_two_ranks_reduce_gather_share_and_must_divide_the_simulations(tmp_path):
    script = tmp_path / "check.py"
    script.write_text(CHECK)
    uneven = *SMALL.split(), "--rollout.num-envs", 9, "--out", tmp_path
    process = start(*uneven, program=[script])
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    lines = [line for line in output.splitlines() if line.startswith("error:")]
    assert lines == ["error: --rollout.num-envs must be a multiple of the 2 ranks, not 9"]


def test_one_and_two_ranks_make_the_same_update(tmp_path):
    """The same seed and batch: parameters differ by rounding only."""
    # Among places closer to each other, rounding changes the place of a body more often.
    steps = ("--iterations", 1, "--rollout.steps", 40, "--places.cell", 0.25)
    process = start(*SMALL.split(), *steps, "--out", tmp_path / "two")
    alone = call("train", *SMALL.split(), *steps, "--out", tmp_path / "one")
    output, _ = process.communicate(timeout=120)
    assert alone.returncode == 0 and process.returncode == 0, output
    assert output.count("run folder") == 1 and output.count("it 1 ") == 1  # one rank speaks
    one, two = saved(tmp_path / "one"), saved(tmp_path / "two")
    assert one["run"]["steps"]["train"] == two["run"]["steps"]["train"] == 4 * 8 * 40 * 4
    one, two = one["learner"], two["learner"]
    gans = one["curriculum"]["gan"], two["curriculum"]["gan"]
    for ours, theirs in (
        (one["policy"], two["policy"]),
        (one["value"], two["value"]),
        *((gans[0][name], gans[1][name]) for name in ("generator", "discriminator")),
    ):
        for key in ours.keys() - {"_extra_state"}:
            assert torch.allclose(ours[key], theirs[key], atol=1e-3, rtol=1e-3), key
    ours, theirs = moves_of(one["places"]), moves_of(two["places"])
    # Rounding puts a body on the other side of a border between two places now and then.
    apart = sum(
        abs(ours.get(move, 0) - theirs.get(move, 0)) for move in ours.keys() | theirs.keys()
    )
    assert len(ours) > 100 and apart < 0.02 * sum(ours.values())
    seen = one["curriculum"]["estimator"], two["curriculum"]["estimator"]
    assert len(seen[0]["goals"]) > 0
    assert torch.allclose(seen[0]["goals"], seen[1]["goals"], atol=1e-3)
    assert torch.equal(seen[0]["success"], seen[1]["success"])
    fresh = MazeLearner(
        make_env(maze_config.preset("point_umaze"), 1), maze_config.preset("point_umaze")
    )
    moved = (one["policy"]["net.flat"] - fresh.policy.net.flat.detach()).abs().max()
    apart = (one["policy"]["net.flat"] - two["policy"]["net.flat"]).abs()
    assert apart.max() < 0.01 * moved


RESUME = """
import sys
from dataclasses import replace
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_resume import After, settings
from goalgan_bt.learners import maze
from goalgan_bt.runs import ranks
ranks.begin()
cfg = settings("point_umaze", "with_traces")
whole, stopped = map(Path, sys.argv[1:])
maze.train(cfg, whole if ranks.rank() == 0 else None)
maze.train(cfg, stopped if ranks.rank() == 0 else None, After(3))
maze.train(replace(cfg, resume=stopped), stopped)
ranks.end()
"""


def test_two_ranks_that_were_stopped_go_on_as_if_they_had_not_been(tmp_path):
    script = tmp_path / "resume.py"
    script.write_text(RESUME.format(tests=str(Path(__file__).parent)))
    whole, stopped = (
        new_folder(tmp_path / name, settings("point_umaze", "with_traces"))
        for name in ("whole", "stopped")
    )
    process = start(whole, stopped, program=[script])
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert_same_runs(whole, stopped)


def moves_of(places):
    """How often each move was made, by the places that it joins."""
    names = places["keys"].tolist()
    ends = zip(places["from"].tolist(), places["to"].tolist(), strict=True)
    return {
        (names[a], names[b]): n for (a, b), n in zip(ends, places["count"].tolist(), strict=True)
    }


@pytest.mark.parametrize("victim", [0, 1])
def test_a_rank_that_dies_ends_the_run_with_a_usable_checkpoint(tmp_path, victim):
    endless = [*SMALL.split(), "--rollout.steps", 20, "--coverage.every", 1, "--out", tmp_path]
    process = start(*endless, "--total-steps", 10**9)
    deadline = time.monotonic() + 90
    while not list(tmp_path.glob("*/checkpoint.pt")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    os.kill(pid_of(victim, tmp_path), signal.SIGKILL)
    output, _ = process.communicate(timeout=100)
    assert process.returncode != 0
    (line,) = [line for line in output.splitlines() if line.startswith("error: rank")]
    assert line.startswith(f"error: rank {1 - victim}: a rank of this training is gone")
    assert output.count("Traceback") == 1  # torchrun's own
    (folder,) = tmp_path.iterdir()
    if victim == 1:
        assert f"--resume {folder}" in line
    cfg = table.load(folder)
    learner = MazeLearner(make_env(cfg, 1), cfg)
    more = maze_learner.load(learner, folder)["steps"]["train"] + 3000
    resumed = call("train", "--resume", folder, "--total-steps", more, "--viz", "none")
    assert resumed.returncode == 0, resumed.stderr


def pid_of(rank, out):
    """The process of a rank that trains into a folder."""
    for proc in Path("/proc").glob("[0-9]*"):
        try:
            command, environment = (proc / "cmdline").read_bytes(), (proc / "environ").read_bytes()
        except OSError:
            continue
        if str(out).encode() in command and f"\0RANK={rank}\0".encode() in environment:
            return int(proc.name)
    raise AssertionError(f"no process of rank {rank}")
