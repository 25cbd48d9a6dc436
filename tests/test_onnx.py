"""`python -m goalgan_bt.export`: the policy as an ONNX graph acts as the policy does."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import TINY, call

from goalgan_bt.envs import arrays
from goalgan_bt.envs.ant_maze import AntMaze
from goalgan_bt.learners import onnx_policy, table
from goalgan_bt.learners.maze import train
from goalgan_bt.learners.trained_policy import TrainedPolicy
from goalgan_bt.recall.places import Places
from goalgan_bt.runs import run_folder

onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")

EXAMPLE = Path(__file__).parents[1] / "examples/run_onnx.py"


def passed(policy, n):
    """States along episodes of a policy with noise, and their goals."""
    env, one = policy.env, np.arange(1)
    rng = np.random.default_rng(0)
    states, goals = [], []
    while len(states) < n:
        goal = rng.uniform(env.goal_low, env.goal_high)[None]
        env.reset(one, goal)
        for _ in range(60):
            state = env.read_states(one)
            states.append(state[0])
            goals.append(goal[0])
            step = env.step_body(one, policy.act(state, goal, deterministic=False))
            if (step.terminated | step.truncated).any():
                break
    return np.array(states[:n]), np.array(goals[:n])


def made(tmp_path, words):
    folder = tmp_path / "run"
    folder.mkdir()
    cfg = table.from_command_line(f"{TINY} {words}".split())
    run_folder.write_meta(folder, None)
    train(cfg, folder)
    return folder


@pytest.mark.parametrize(
    "words",
    [
        "",
        "--env ant_umaze",
        "--env ant_umaze --method goal_gan",
        "--env point_nd --dim 3",
        "--method goal_gan",
    ],
)
def test_it_acts_as_the_policy_does(tmp_path, words):
    folder, path = made(tmp_path, words), tmp_path / "policy.onnx"
    done = call("export", folder, "--onnx", path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(path)) and len(done.stdout.splitlines()) == 1
    policy = TrainedPolicy(folder)
    # A policy that has learned more than a few iterations' worth: what it does differs by state.
    states, goals = passed(policy, 1000)
    session = onnxruntime.InferenceSession(path)
    (actions,) = session.run(None, {"state": states, "goal": goals})
    wanted = policy.act(states, goals)
    assert wanted.std(axis=0).min() > 1e-3
    different = np.abs(actions - wanted).max(axis=1) > 1e-5
    assert different.mean() <= (0.005 if isinstance(policy.env, AntMaze) else 0.0)
    one = session.run(None, {"state": states[:1], "goal": goals[:1]})[0]
    assert np.allclose(one, actions[:1], atol=1e-6)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_the_traced_heading_is_that_of_the_places(dim):
    rng = np.random.default_rng(dim)
    places = Places(np.zeros(dim), np.full(dim, 4.0), 0.3)
    corners = 4.0 * np.eye(dim)[[0, -1]].cumsum(axis=0)  # along the first axis, then the last
    around = np.concatenate([np.zeros((1, dim)), corners, corners[1:] - corners[:1]])
    walk = np.concatenate([np.linspace(*ends, 60) for ends in pairwise(around)])
    walk = np.clip(np.stack([walk, walk[::-1]]) + rng.normal(0, 0.05, (2, 180, dim)), 0, 4)
    places.learn(walk[:, :-1], walk[:, 1:])
    places.refresh()
    at, goals = rng.uniform(-0.5, 4.5, (2, 3000, dim))
    traced = onnx_policy.TracedHeading(places)(torch.from_numpy(at), torch.from_numpy(goals))
    assert np.allclose(traced.numpy(), places.heading(at, goals), atol=1e-5)
    assert (np.abs(traced.numpy() - (goals - at)).max(axis=1) > 0.1).mean() > 0.02 or dim == 1


def test_two_exports_in_one_process_and_what_comes_after_them(tmp_path):
    """Nothing of a trace stays behind in the constants that environments keep."""
    folder = made(tmp_path, "--env ant_umaze")
    for name in ("a.onnx", "b.onnx"):
        arrays._tensor.cache_clear()
        onnx_policy.export(folder, tmp_path / name)
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()
    env = TrainedPolicy(folder).env
    state = torch.from_numpy(env.start_state)[None]
    assert np.allclose(env.achieved_goals(state).numpy(), env.achieved_goals(state.numpy()))


def test_places_that_never_moved_and_straight_ones_are_straight():
    traced = onnx_policy.TracedHeading(Places((0, 0), (4, 4), 0.3))
    at, goals = torch.rand(2, 10, 2, dtype=torch.float64)
    assert torch.equal(traced(at, goals), goals - at)


def test_the_example_runs_it_without_torch(folder, tmp_path):
    path = tmp_path / "policy.onnx"
    assert call("export", folder, "--onnx", path).returncode == 0
    code = f"import sys, runpy; sys.modules['torch'] = None; runpy.run_path({str(EXAMPLE)!r})"
    words = [sys.executable, "-c", code, path, "goalgan_bt/PointUMaze-v0", "0.2", "0.4"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(("reached after ", "not reached after "))


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ("--onnx x.pt", "its name must end in .onnx"),
        ("--onnx /nowhere/x.onnx", "choose a file in a folder that can be written"),
        ("", "--onnx"),
    ],
)
def test_bad_words_end_in_one_line(folder, tmp_path, monkeypatch, words, problem):
    monkeypatch.chdir(tmp_path)
    done = call("export", folder, *words.split())
    assert done.returncode == 2 and problem in done.stderr
    assert len(done.stderr.splitlines()) == 1
