"""gymnasium-robotics' mazes: ours are theirs, bit for bit."""

import json
import warnings

import numpy as np
import pytest
from conftest import call

from goalgan_bt import envs

IDS = {
    "point_umaze_gym": "PointMaze_UMaze-v3",
    "point_large_gym": "PointMaze_Large-v3",
    "ant_umaze_gym": "AntMaze_UMaze-v5",
    "ant_medium_gym": "AntMaze_Medium-v5",
}


def theirs(name):
    import gymnasium
    import gymnasium_robotics

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gymnasium.register_envs(gymnasium_robotics)
        return gymnasium.make(IDS[name])


@pytest.mark.parametrize("name", IDS)
def test_a_thousand_random_steps_are_the_official_environments_bit_for_bit(name):
    env, steps = theirs(name), 1000
    obs, _ = env.reset(seed=3)
    inner = env.unwrapped
    ours = envs.make(name, 3, threads=1, integrator="own", horizon=10**6)
    state = np.concatenate([inner.data.qpos, inner.data.qvel])
    ids = np.arange(3)
    ours.reset(ids, np.zeros((3, 2)), np.tile(state, (3, 1)))
    rng = np.random.default_rng(0)
    for t in range(steps):
        action = rng.uniform(-1, 1, inner.action_space.shape)
        obs, _, terminated, _, info = inner.step(action)
        assert not terminated
        ours.advance(ids, np.tile(action, (3, 1)))
        now = ours.read_states(ids)
        wanted = np.concatenate([inner.data.qpos, inner.data.qvel])
        assert np.array_equal(now, np.tile(wanted, (3, 1))), t
        assert np.array_equal(ours.achieved_goals(now)[1], obs["achieved_goal"])
        goal = inner.goal[None]
        assert bool(ours.reached(ours.achieved_goals(now[:1]), goal)[0]) == info["success"]
    env.close()


def test_official_physics_are_the_default():
    assert envs.make("ant_umaze_gym", 1).model.opt.integrator == 1  # RK4
    assert envs.make("ant_umaze_gym", 1, integrator="implicitfast").model.opt.integrator == 3
    assert envs.make("point_umaze_gym", 1).model.opt.integrator == 0  # Euler
    assert envs.make("ant_umaze", 1).model.opt.integrator == 3


@pytest.mark.parametrize("name", IDS)
def test_horizons_cells_and_places_are_the_official_ones(name):
    env = theirs(name)
    ours = envs.make(name, 1, threads=1)
    assert ours.horizon == env.spec.max_episode_steps
    official = env.unwrapped.maze
    assert ours.maze.cell_size == official.maze_size_scaling
    free = {tuple(np.round(place, 9)) for place in official.unique_goal_locations}
    assert {tuple(np.round(place, 9)) for place in ours.maze.cell_centres()} == free
    assert ours.feasible(np.array(official.unique_goal_locations)).all()
    assert len(ours.test_goals()) == len(free) * (16 if "ant" in name else 4)
    start = ours.achieved_goals(ours.start_state[None])[0]
    assert tuple(np.round(start, 9)) in free
    inner = env.unwrapped
    assert ours.dt == pytest.approx((inner.ant_env if "ant" in name else inner.point_env).dt)
    env.close()


@pytest.mark.parametrize("name", ["point_umaze_gym", "ant_umaze_gym"])
def test_a_policy_is_tried_in_the_unmodified_environment(name, tmp_path):
    words = "--env", name, "--iterations", 1, "--viz", "none", "--threads", 1, "--out", tmp_path
    small = "--rollout.num-envs", 4, "--rollout.steps", 4, "--horizon", 5, "--updates", 1
    done = call("train", *words, *small, "--coverage.rollouts", 1, "--gan.pretrain-steps", 2)
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.iterdir()
    out = tmp_path / "found.json"
    done = call("evaluate", folder, "--on", IDS[name], "--episodes", 2, "--json", out)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    found = json.loads(out.read_text())
    assert found["world"] == IDS[name] and found["episodes"] == 2
    assert found["return"] >= found["success"]  # 1 for each step within reach
    if name.startswith("ant"):
        done = call("export", folder, "--minari", "ant/official-v0")
        assert done.returncode == 2 and "gymnasium-robotics' own" in done.stderr
