"""mujoco-warp against MuJoCo, on Warp's CPU device; the mathematics on tensors against numpy's."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import TINY, call
from hypothesis import given, settings
from hypothesis import strategies as st

from goalgan_bt import envs
from goalgan_bt.agent.coverage import success_rate
from goalgan_bt.agent.policy import GaussianPolicy
from goalgan_bt.envs import ant_maze
from goalgan_bt.envs import maze as mazes
from goalgan_bt.envs.goal_env import PhysicsError
from goalgan_bt.envs.warp_batch import MAX_CONSTRAINTS
from goalgan_bt.learners import maze_config, table
from goalgan_bt.viz.player import Player

pytest.importorskip("array_api_compat", reason="the extra gpu is not installed")

N = 8
NOWHERE = np.full((N, 2), 99.0)  # infeasible: no episode ends by success
EVERYONE = np.arange(N)


@pytest.fixture(scope="module")
def worlds():
    """One environment per name: the first step of each compiles for some seconds."""
    pytest.importorskip("mujoco_warp", reason="the extra gpu is not installed")
    made = {}

    def world(name):
        if name not in made:
            made[name] = envs.make(name, N, physics="warp", device="cpu", horizon=40)
        return made[name]

    return world


BOTH = pytest.mark.parametrize("name", ["point_umaze", "ant_umaze"])


def moving_states(name):
    """States of bodies in motion, as single precision holds them, and MuJoCo's simulations."""
    env = envs.make(name, N, threads=1, horizon=40)
    rng = np.random.default_rng(0)
    env.reset(EVERYONE, NOWHERE)
    for _ in range(5):
        env.step(EVERYONE, rng.uniform(-0.3, 0.3, (N, env.act_dim)))
    return env, env.read_states(EVERYONE).astype(np.float32).astype(float)


@BOTH
def test_a_short_horizon_agrees_with_mujoco(worlds, name):
    """Torsos within 10 micrometres after 20 steps, on the ground as in the air: rounding alone."""
    warp = worlds(name)
    env, states = moving_states(name)
    rng = np.random.default_rng(1)
    for each in (env, warp):
        each.reset(EVERYONE, NOWHERE, states)
    for _ in range(20):
        actions = rng.uniform(-1, 1, (N, env.act_dim)).astype(np.float32)
        for each in (env, warp):
            each.advance(EVERYONE, actions)
    apart = env.read_states(EVERYONE) - warp.read_states(EVERYONE)
    assert np.linalg.norm(apart[:, :2], axis=1).max() < 1e-5


@BOTH
def test_a_state_has_one_future(worlds, name):
    env = worlds(name)
    _, states = moving_states(name)
    finals = []
    for _ in range(2):
        rng = np.random.default_rng(2)
        env.reset(EVERYONE, NOWHERE, states)
        assert np.array_equal(env.read_states(EVERYONE), states)
        for _ in range(5):
            step = env.step(EVERYONE, rng.uniform(-1, 1, (N, env.act_dim)))
        finals.append(step.states)
    assert np.array_equal(*finals)


@BOTH
def test_one_simulation_does_not_touch_another(worlds, name):
    env = worlds(name)
    _, states = moving_states(name)
    some, others = np.array([1, 3, 4]), np.array([0, 2, 5, 6, 7])
    actions = np.random.default_rng(3).uniform(-1, 1, (N, env.act_dim))
    env.reset(EVERYONE, NOWHERE, states)
    together = env.step(EVERYONE, actions).states
    env.reset(EVERYONE, NOWHERE, states)
    alone = env.step(some, actions[some]).states
    assert np.array_equal(env.read_states(others), states[others])
    assert np.allclose(alone, together[some], atol=1e-6)
    env.reset(some[:1], NOWHERE[:1])
    assert np.allclose(env.read_states(some[:1])[0], env.start_state)
    assert np.array_equal(env.read_states(some[1:]), alone[1:])
    # Those that waited go on as if nothing had been.
    assert np.allclose(env.step(others, actions[others]).states, together[others], atol=1e-6)
    assert env.elapsed.tolist() == [1, 0, 1, 1, 1, 1, 1, 1]


def test_a_diverged_simulation_ends_and_hurts_no_other(worlds):
    env = worlds("ant_umaze")
    states = np.tile(env.start_state, (N, 1))
    states[3, 20] = np.nan
    env.reset(EVERYONE, NOWHERE, states)
    step = env.step(EVERYONE, np.zeros((N, 8)))
    assert step.terminated.tolist() == [i == 3 for i in EVERYONE]
    env.reset(EVERYONE[3:4], NOWHERE[3:4])
    step = env.step(EVERYONE, np.zeros((N, 8)))
    assert np.isfinite(step.states).all() and not step.terminated.any()


def test_no_contact_is_left_out(worlds):
    """Full force in the corner of a cell: the most contacts there are."""
    env = worlds("ant_umaze")
    rng = np.random.default_rng(0)
    states = np.tile(env.start_state, (N, 1))
    states[:, :2] = -0.6
    env.reset(EVERYONE, NOWHERE, states)
    for _ in range(25):
        env.batch.bind("ctrl")[:] = torch.from_numpy(rng.choice([-1.0, 1.0], (N, 8)))
        env.batch.step(nstep=4)
        assert not env.batch.bind("overflow").any()
        assert 0 < env.batch.bind("nefc").max() < MAX_CONSTRAINTS


def test_tensors_share_the_simulations_memory(worlds):
    env = worlds("point_umaze")
    env.reset(EVERYONE, NOWHERE)
    qpos, qvel, ctrl = (env.batch.bind(field) for field in ("qpos", "qvel", "ctrl"))
    qpos[2, 0] = 0.25
    ctrl[:] = torch.tensor([1.0, 0.0])
    assert env.read_states(EVERYONE)[2, 0] == 0.25
    env.batch.step()
    assert (qvel[:, 0] > 0).all() and qpos[2, 0] > 0.25 and (qpos[:, 0] > 0).all()
    assert np.shares_memory(env.batch._data.qpos.numpy(), qpos.numpy())


@BOTH
def test_episodes_on_the_device_are_the_environments(worlds, name, monkeypatch):
    """The same episodes through tensors and through numpy, resets included."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    from device_episodes import DeviceEpisodes

    host = worlds(name)
    device = DeviceEpisodes(envs.make(name, N, physics="warp", device="cpu", horizon=6))
    host.horizon = 6
    rng = np.random.default_rng(4)
    goals = rng.uniform(-1, 1, (N, 2)).astype(np.float32)
    host.reset(EVERYONE, goals)
    device.begin(torch.ones(N, dtype=torch.bool), torch.from_numpy(goals))
    for _ in range(14):
        assert device.observe().dtype == torch.float32
        assert np.allclose(device.observe(), host.observe(EVERYONE), atol=1e-4)
        actions = rng.uniform(-1, 1, (N, host.act_dim)).astype(np.float32)
        there, here = device.step(torch.from_numpy(actions)), host.step(EVERYONE, actions)
        for field in ("actions", "rewards", "terminated", "truncated"):
            assert np.allclose(getattr(there, field), getattr(here, field), atol=1e-6)
        done = here.terminated | here.truncated
        device.begin(torch.from_numpy(done), device.goals)
        if done.any():
            host.reset(np.flatnonzero(done), goals[done])
    host.horizon = 40


def test_coverage_where_fewer_and_fewer_episodes_go_on(worlds):
    env = worlds("point_umaze")
    torch.manual_seed(0)
    policy = GaussianPolicy(env.obs_dim, env.act_dim, maze_config.POINT.policy)
    goals = np.array([[0.2, 0.0], [0.6, 0.0], [3.9, 0.0], [0.0, 0.2]])
    found = [
        success_rate(each, policy, goals, 2, torch.Generator().manual_seed(0))
        for each in (env, envs.make("point_umaze", N, threads=1, horizon=40))
    ]
    assert found[0].steps == found[1].steps
    assert np.array_equal(found[0].rate, found[1].rate)
    assert 0 < found[0].rate.mean() < 1


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_the_ants_mathematics_is_the_same_on_tensors(seed, n):
    env = envs.make("ant_umaze", 1, threads=1)
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(n, 29))
    states[:, 3:7] /= np.linalg.norm(states[:, 3:7], axis=1, keepdims=True)
    goals, actions = rng.uniform(-6, 6, (n, 2)), rng.uniform(-1, 1, (n, 8))
    turns = rng.integers(0, 4, n)
    for function, *arrays in (
        (env.observations, states, goals),
        (env.achieved_goals, states),
        (env.healthy, states),
        (env.to_body, actions, states, goals),
        (env.from_body, actions, states, goals),
        (env.feasible, goals),
        (ant_maze.quarter_turns, states, goals),
        (ant_maze.renumbered, states, turns),
    ):
        mine, theirs = function(*arrays), function(*map(torch.from_numpy, arrays))
        assert torch.is_tensor(theirs)
        # The front, a direction in single precision, may be that of a nearly upright axis.
        assert np.allclose(mine, theirs, atol=1e-4)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["umaze", "large"]))
def test_walls_are_the_same_for_tensors(seed, layout):
    maze = mazes.layout(layout)
    rng = np.random.default_rng(seed)
    before = maze.sample_free(50, rng)
    after = before + rng.normal(size=(50, 2)) * rng.choice([0.01, 0.3])
    after[0] = np.nan
    mine, theirs = (
        maze.slide(*arrays, 0.1)
        for arrays in ((before, after), map(torch.from_numpy, (before, after)))
    )
    assert np.array_equal(mine[0], theirs[0], equal_nan=True)
    assert np.array_equal(mine[1], theirs[1])
    assert np.array_equal(maze.is_free(after), maze.is_free(torch.from_numpy(after)))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_in_single_precision_a_body_slides_along_walls_and_never_enters(seed):
    maze = mazes.layout("large")
    rng = np.random.default_rng(seed)
    cells = maze.cell_centres()
    position = torch.from_numpy(cells[rng.integers(len(cells), size=64)].astype(np.float32))
    push = torch.from_numpy(rng.choice([-0.05, 0.05], (64, 2)).astype(np.float32))
    corners = torch.tensor([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * 0.0999
    stopped_on_both = torch.zeros(64)
    for _ in range(40):
        position, stopped = maze.slide(position, position + push, 0.1)
        assert maze.is_free(position[:, None] + corners).all()
        stopped_on_both += stopped.all(axis=1)
    # Who is stopped on both axes stands in a corner of the maze: on neither side is there a way.
    stuck = stopped_on_both > 2
    for axis in (0, 1):
        ahead = position.clone()
        ahead[:, axis] += push[:, axis].sign() * 0.1002
        assert not maze.is_free(ahead)[stuck].any()


def test_what_cannot_be_is_told_in_one_line(monkeypatch):
    with pytest.raises(PhysicsError, match="no device 'cuda:7' here"):
        envs.make("point_umaze", 1, physics="warp", device="cuda:7")
    with pytest.raises(PhysicsError, match="point_nd is no MuJoCo model"):
        envs.make("point_nd", 1, physics="warp")
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(PhysicsError, match="install the extra `gpu`") as error:
        envs.make("point_umaze", 1, physics="warp")
    assert "\n" not in str(error.value)


def test_rk4_runs_too(worlds):
    env = envs.make("point_umaze", 2, physics="warp", device="cpu", integrator="rk4")
    env.reset(np.arange(2), NOWHERE[:2])
    assert (env.step(np.arange(2), np.ones((2, 2))).states[:, 2:] > 0).all()


def test_training_on_mujoco_warp(worlds, tmp_path):
    worlds("point_umaze")
    tiny = f"{TINY} --iterations 1 --updates 1 --rollout.steps 10 --horizon 40 --viz none"
    done = call("train", *tiny.split(), "--physics", "warp", "--device", "cpu", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    run = next(tmp_path.iterdir())
    assert table.load(run).physics == "warp"
    assert (run / "checkpoint.pt").exists()
    assert Player(run).take_newest()  # the page plays it with MuJoCo


def test_training_without_the_extra_ends_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    words = ["--env", "ant_umaze", "--physics", "warp", "--viz", "none", "--out", tmp_path / "out"]
    done = call("train", *words)
    assert done.returncode == 2 and not (tmp_path / "out").exists()
    assert done.stderr.count("\n") == 1 and "install the extra `gpu`" in done.stderr
