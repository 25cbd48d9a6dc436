"""The benchmark of speed: its command end to end, and that it compares like with like."""

import importlib
import json
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from goalgan_bt.envs import mazes
from goalgan_bt.learners import maze_config
from goalgan_bt.learners.maze_config import make_env

ROOT = Path(__file__).parents[1]
NAMES = {
    "raw_batch",
    "make_vec",
    "collection",
    "training",
    "sb3_contrib_trpo",
    "sb3_contrib_trpo_subproc",
    "sb3_contrib_trpo_repeat",
    "sb3_contrib_trpo_repeat_32",
    "gymnasium_robotics",
    "gymnasium_robotics_our_physics",
    "gymnasium_robotics_async",
}


def run(script, *words):
    """Run a benchmark of this checkout, whatever is installed; returns what it printed."""
    done = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / script, *map(str, words)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_one_command_measures_everything(tmp_path):
    file = tmp_path / "speed.json"
    tiny = "--env point_umaze --threads 1 --rounds 1 --seconds 0.05 --train-steps 1"
    tiny += " --num-envs 2 --sb3-steps 16 --json"
    printed = run("speed.py", *tiny.split(), file)
    rows = {row["name"]: row for row in json.loads(file.read_text())}
    assert set(rows) == NAMES | ({"envpool"} if find_spec("envpool") else set())
    for name, row in rows.items():
        assert f"| {name} " in printed
        assert (row["env"], row["threads"]) == ("point_umaze", 1)
        low, high = row["range"]
        assert 0 < low == row["steps_per_second"] == high
        assert row["sim_seconds_per_second"] > 0
        assert row["factor_over_sb3"] > 0
    assert rows["raw_batch"]["share_of_raw"] == 1
    assert rows["gymnasium_robotics"]["factor_over_robotics"] == 1
    training, sb3 = rows["training"], {name: row for name, row in rows.items() if "sb3" in name}
    for names, factor in (
        (["sb3_contrib_trpo", "sb3_contrib_trpo_subproc"], training["factor_over_sb3"]),
        (list(sb3), training["factor_over_sb3_repeat"]),
    ):
        fastest = max(sb3[name]["steps_per_second"] for name in names)
        assert factor == pytest.approx(training["steps_per_second"] / fastest, rel=0.01)


def test_only_what_is_asked_for_is_measured(tmp_path):
    file = tmp_path / "speed.json"
    words = "--env ant_umaze --threads 1 2 --rounds 2 --seconds 0.05 --num-envs 4"
    run("speed.py", *words.split(), "--only", "raw_batch", "--json", file)
    rows = json.loads(file.read_text())
    assert [(row["name"], row["threads"]) for row in rows] == [("raw_batch", 1), ("raw_batch", 2)]
    assert rows[0]["factor_over_one_thread"] == 1


@pytest.fixture
def rivals(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return pytest.importorskip("rivals")


@pytest.mark.parametrize("layout", mazes.LAYOUTS)
def test_a_single_body_slides_as_many_do(rivals, layout):
    maze, rng = mazes.layout(layout), np.random.default_rng(0)
    centres = maze.cell_centres()
    before = centres[rng.integers(len(centres), size=2000)] + rng.uniform(-0.9, 0.9, (2000, 2))
    after = before + rng.uniform(-1, 1, before.shape)
    expected, stopped = maze.slide(before, after, 0.1)
    slide = rivals.Slide(maze, 0.1)
    for i in range(len(before)):
        position, axes = slide(before[i].tolist(), after[i].tolist())
        assert np.array_equal(position, expected[i])
        assert axes == np.flatnonzero(stopped[i]).tolist()


@pytest.mark.parametrize("name", ["point_umaze", "ant_umaze"])
def test_sb3_trains_on_our_physics(rivals, name):
    cfg = maze_config.preset(name)
    single, ours = rivals.SingleMaze(cfg), make_env(cfg, 1)
    obs, _ = single.reset(seed=0)
    assert obs.shape == (ours.obs_dim,) == single.observation_space.shape
    ids, rng = np.arange(1), np.random.default_rng(0)
    ours.reset(ids, np.full((1, 2), 2.0))
    size = ours.model.nq + ours.model.nv
    for _ in range(40):
        action = rng.uniform(-1, 1, (1, ours.act_dim)).astype(np.float32)
        obs, *_ = single.step(action[0])
        ours.advance(ids, action)
        np.testing.assert_allclose(obs[:size], ours.read_states(ids)[0], atol=1e-5)


@pytest.mark.parametrize("name", ["point_umaze", "ant_umaze"])
def test_sb3s_episodes_end_as_ours(rivals, name):
    single, ours = (
        rivals.SingleMaze(maze_config.preset(name)),
        make_env(maze_config.preset(name), 1),
    )
    single.reset(seed=0)
    single._goal = ours.start_state[:2]
    *_, reward, terminated, truncated, _ = single.step(np.zeros(ours.act_dim))
    assert (reward, terminated, truncated) == (1, True, False)
    single.reset(seed=1)
    single._goal = np.full(2, 50.0)
    for elapsed in range(0, ours.horizon, ours.action_repeat):
        assert not truncated, f"too early, after {elapsed} steps"
        *_, reward, terminated, truncated, _ = single.step(np.zeros(ours.act_dim))
    assert (reward, terminated, truncated) == (0, False, True)


def test_the_profile_finds_all_phases_and_most_of_the_time(tmp_path):
    file = tmp_path / "profile.md"
    printed = run("phases.py", "--env", "point_umaze", "--train-steps", 1, "--markdown", file)
    assert file.read_text() in printed
    cells = [line.split("|") for line in file.read_text().splitlines() if line.startswith("| ")]
    rows = {(row[1].strip(), row[2].strip()): row for row in cells[2:]}
    assert ("simulation", "main") in rows and ("value function", "beside") in rows
    shares = [float(row[5].strip(" %")) for (_, thread), row in rows.items() if thread == "main"]
    assert sum(shares) == pytest.approx(100, abs=2)


RANKS = {"env": ("point_umaze",), "threads": (1, 2), "train_steps": 1, "num_envs": 4}


def test_ranks_train_in_the_benchmark_too(rivals, capfd):
    speed = importlib.import_module("speed")
    planned = speed.measurements(speed.Settings(**RANKS, only=("training_ranks",)))
    ready = speed.warm_up(planned)
    assert [(m.name, m.threads) for m in planned] == [("training_ranks", n) for n in (1, 2)]
    assert [(m.name, m.threads) for m in ready] == [("training_ranks", 2)]
    printed, told = capfd.readouterr()
    assert "no training_ranks for point_umaze: one rank is `training`" in printed
    assert re.search(
        r"^warm-up: point_umaze, 2 threads, training_ranks: [1-9]\S* steps/s$", told, re.M
    )


@pytest.mark.slow
def test_ranks_come_into_the_table(tmp_path):
    file = tmp_path / "speed.json"
    words = "--env point_umaze --threads 1 2 --rounds 1 --train-steps 1 --only training_ranks"
    printed = run("speed.py", *words.split(), "--num-envs", 4, "--json", file)
    (row,) = json.loads(file.read_text())
    assert (row["name"], row["threads"]) == ("training_ranks", 2) and row["steps_per_second"] > 0
    assert "no training_ranks for point_umaze: one rank is `training`" in printed
