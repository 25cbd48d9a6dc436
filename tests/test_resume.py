"""A run that was stopped or killed goes on as if it had not been, bit for bit."""

import signal
import subprocess
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import call, started

from goalgan_bt.learners import four_rooms, maze, table
from goalgan_bt.learners.methods import METHODS
from goalgan_bt.runs import checkpoint, run_folder
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import read_metrics
from goalgan_bt.runs.signals import Stop

ITERATIONS = 8
SMALL = (
    "--rollout.num-envs 12 --rollout.steps 20 --threads 1 --coverage.rollouts 1 "
    "--gan.pretrain-steps 20 --gan.steps 5 --backtracking.min-transitions 40 --viz none "
    "--backtracking.buffer 300 --action-repeat 4 --horizon 60 --updates 2 "
    f"--coverage.every 4000 --iterations {ITERATIONS}"
)


class After(Stop):
    """Ctrl-C in an iteration."""

    def __init__(self, iterations):
        super().__init__()
        self._left = iterations

    @property
    def requested(self):
        self._left -= 1
        return self._left <= 0


class Killed(BaseException):
    """Nothing is caught, nothing is said."""


def settings(env, method, *more):
    words = f"--env {env} --method {method} {SMALL}".split()
    return table.from_command_line([*words, *more])


def case(env, method, *more, slow=False):
    """A case with a readable name."""
    marks = pytest.mark.slow if slow else ()
    return pytest.param(env, method, more, id="-".join([env, method, *more]), marks=marks)


def new_folder(place, cfg):
    place.mkdir()
    learner = four_rooms if cfg.env.startswith("four") else maze
    with learner.prepared(cfg) as world:
        run_folder.write_meta(place, world.maze)
    run_folder.write_settings(place, asdict(cfg))
    return place


def same(x, y, where=""):
    """Two states, in every bit."""
    if isinstance(x, torch.Tensor | np.ndarray):
        assert x.dtype == y.dtype and x.shape == y.shape, where
        x, y = np.asarray(x), np.asarray(y)
        assert np.array_equal(x, y, equal_nan=x.dtype.kind == "f"), where
    elif isinstance(x, dict):
        assert x.keys() == y.keys(), where
        for key in x:
            same(x[key], y[key], f"{where}.{key}")
    elif isinstance(x, list | tuple):
        assert len(x) == len(y), where
        for i, (a, b) in enumerate(zip(x, y, strict=True)):
            same(a, b, f"{where}.{i}")
    else:
        assert x == y or (x != x and y != y), where


def rows_of(folder):
    columns, rows = read_metrics(folder)
    timed = "time/", "memory/"
    return [{k: row[k] for k in columns if not k.startswith(timed)} for row in rows]


def assert_same_runs(one, two):
    """Metrics but for times and memory, frames, and all that was learned."""
    same(rows_of(one), rows_of(two), "metrics")
    frames = [[path.name for path in frame_paths(folder)] for folder in (one, two)]
    assert frames[0] == frames[1]
    for ours, theirs in zip(frame_paths(one), frame_paths(two), strict=True):
        same(read_frame(ours), read_frame(theirs), ours.name)
    ours, theirs = (checkpoint.read(folder / checkpoint.NAME) for folder in (one, two))
    for state in (ours, theirs):
        state["run"].pop("seconds")
    same(ours, theirs, "state")


FAST = "recall_traces", "with_traces", "alp_gmm"
CASES = [
    *(case("point_umaze", method, slow=method not in FAST) for method in METHODS),
    case("ant_umaze", "recall_traces"),
    case("ant_umaze", "with_traces", slow=True),
    case("point_nd", "recall_traces"),
    case("point_nd", "goal_gan", "--dim", "4", slow=True),
    case("point_umaze", "recall_traces", "--goals.label-rollouts", "1", "--updates", "1"),
]


@pytest.mark.parametrize(("env", "method", "more"), CASES)
def test_a_stopped_run_goes_on_as_if_it_had_not_been(env, method, more, tmp_path, monkeypatch):
    if method == "alp_gmm":
        pytest.importorskip("sklearn")
    cfg = settings(env, method, *more)
    whole = new_folder(tmp_path / "whole", cfg)
    maze.train(cfg, whole)
    assert len(rows_of(whole)) == ITERATIONS

    stopped = new_folder(tmp_path / "stopped", cfg)
    for iterations in (2, 3):  # twice
        resume = None if iterations == 2 else stopped
        maze.train(replace(cfg, resume=resume), stopped, After(iterations))
    assert len(rows_of(stopped)) == 5
    maze.train(replace(cfg, resume=stopped), stopped)
    assert_same_runs(whole, stopped)

    killed = new_folder(tmp_path / "killed", cfg)
    with monkeypatch.context() as planted, pytest.raises(Killed):
        learn, left = maze.recall, [6]

        def fails(*arguments):
            left[0] -= 1
            if not left[0]:
                raise Killed
            return learn(*arguments)

        planted.setattr(maze, "recall", fails)
        maze.train(cfg, killed)
    assert len(rows_of(killed)) == 5
    saved = checkpoint.read(killed / checkpoint.NAME)["run"]["iteration"]
    maze.train(replace(cfg, resume=killed), killed)
    assert saved < 5  # it had run ahead
    assert_same_runs(whole, killed)


def test_four_rooms_make_the_same_again(tmp_path):
    """They are done again from the start, in seconds."""
    words = ["--env", "four_rooms_11", "--total-steps", "4000", "--viz", "none"]
    cfg = table.from_command_line(words)
    whole, stopped = (new_folder(tmp_path / name, cfg) for name in ("whole", "stopped"))
    four_rooms.train(cfg, whole)
    four_rooms.train(cfg, stopped, After(3))
    assert 0 < len(rows_of(stopped)) < len(rows_of(whole))
    four_rooms.train(replace(cfg, resume=stopped), stopped)
    same(rows_of(whole), rows_of(stopped))
    ours, theirs = (np.load(folder / "visits.npz") for folder in (whole, stopped))
    same(dict(ours), dict(theirs))


def test_a_killed_process_goes_on_as_if_it_had_not_been(tmp_path):
    """SIGKILL, once the run is ahead of its checkpoint, through the commands."""
    words = f"--env point_umaze {SMALL} --iterations 40 --coverage.every 16000".split()
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with started("train", *words, "--out", tmp_path / "killed", **pipes) as process:
        folder = Path(process.stdout.readline().removeprefix("run folder: ").strip())
        while "it 13 " not in process.stdout.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGKILL)
    assert run_folder.ended(folder) is None
    resumed = call("train", "--resume", folder, "--viz", "none")
    assert resumed.returncode == 0
    assert "after it are made again" in resumed.stderr and len(resumed.stderr.splitlines()) == 1
    done = call("train", *words, "--out", tmp_path / "whole")
    assert done.returncode == 0 and not done.stderr
    (whole,) = (tmp_path / "whole").iterdir()
    assert_same_runs(whole, folder)


def test_what_is_no_longer_the_same_is_told(folder):
    flags = "--iterations", 6, "--policy.final-std", 0.2
    done = call("train", "--resume", folder, *flags, "--minutes", 5, "--viz", "none")
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert line.startswith("note: --iterations was 4 and is 6, --minutes was None and is 5.0, ")
    assert "--policy.final-std was 0.3 and is 0.2, --minutes goes by the clock" in line


def test_another_number_of_simulations_begins_new_episodes(folder):
    flags = "--iterations", 5, "--rollout.num-envs", 32
    done = call("train", "--resume", folder, *flags, "--viz", "none")
    assert done.returncode == 0
    assert "note: the simulations begin anew" in done.stderr
