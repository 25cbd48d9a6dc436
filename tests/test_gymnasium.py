"""The Gymnasium ids: checked by Gymnasium and Stable-Baselines3, one env and many bit for bit."""

import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import goalgan_bt.gym
from goalgan_bt import envs
from goalgan_bt.envs.gymnasium_env import GoalGymEnv
from goalgan_bt.envs.gymnasium_vector import GoalVectorEnv
from goalgan_bt.gym import IDS, env_id

GOALS = [one for one in IDS if "FourRooms" not in one]


def test_the_example_of_the_documentation_runs():
    text = (Path(__file__).parents[1] / "docs/api.md").read_text()
    block = re.search(r"```python\n(import gymnasium\n.*?)```", text, re.S)[1]
    made = {}
    exec(block, made)
    assert made["obs"]["observation"].shape == (64, 29)


def test_every_environment_has_an_id():
    assert len(IDS) == len(envs.NAMES) - len(envs.OFFICIAL) + 1
    assert {env_id("ant_umaze"), env_id("point_spiral"), env_id("point_nd")} == {
        "goalgan_bt/AntUMaze-v0",
        "goalgan_bt/PointSpiral-v0",
        "goalgan_bt/PointND-v0",
    } & set(IDS)
    assert goalgan_bt.gym.register() == IDS  # twice is as good as once


@pytest.mark.parametrize("one", IDS)
@pytest.mark.filterwarnings("error", "ignore:Casting input x to numpy array")
def test_the_checkers_have_nothing_to_say(one, capsys):
    check_env(gymnasium.make(one).unwrapped, skip_render_check=True)
    sb3_check_env(gymnasium.make(one).unwrapped)


def same(ours, theirs, path=""):
    """Whether two results are the same, keys and kinds of arrays included."""
    if isinstance(ours, dict):
        assert set(ours) == set(theirs), path
        for key in ours:
            same(ours[key], theirs[key], f"{path}/{key}")
    elif isinstance(ours, np.ndarray) and ours.dtype == object:
        for one, other in zip(ours, theirs, strict=True):
            assert (one is None) == (other is None), path
            if one is not None:
                same(one, other, path)
    else:
        assert (ours is None) == (theirs is None), path
        assert np.array_equal(ours, theirs), path
        assert np.asarray(ours).dtype == np.asarray(theirs).dtype, path


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(
    ("one", "steps"),
    [("goalgan_bt/AntUMaze-v0", 1700), ("goalgan_bt/PointUMaze-v0", 1700)],
)
def test_one_and_many_agree_bit_for_bit(one, steps, mode):
    """Over 2 x 3 x 1,700 steps of each body, with as many ends of episodes as there may be."""
    short = {"horizon": 40, "action_repeat": 2}
    ours = gymnasium.make_vec(one, 3, autoreset_mode=mode, **short)
    theirs = SyncVectorEnv([lambda: gymnasium.make(one, **short)] * 3, autoreset_mode=mode)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for mine, other in zip(ours.reset(seed=3), theirs.reset(seed=3), strict=True):
        same(mine, other)
    ours.action_space.seed(0)
    ended = 0
    for _ in range(steps):
        action = ours.action_space.sample()
        result = ours.step(action)
        for mine, other in zip(result, theirs.step(action), strict=True):
            same(mine, other)
        ended += int((result[2] | result[3]).sum())
    assert ended > 100


def test_a_vector_that_resets_nothing_by_itself_is_reset_by_mask():
    vector = gymnasium.make_vec(
        "goalgan_bt/PointUMaze-v0", 4, autoreset_mode=AutoresetMode.DISABLED, horizon=3
    )
    vector.reset(seed=0)
    for _ in range(3):
        obs, _, terminated, truncated, _ = vector.step(np.ones((4, 2), np.float32))
    assert (terminated | truncated).all()
    with pytest.raises(ValueError, match=r"simulations \[0, 1, 2, 3\] have ended"):
        vector.step(np.ones((4, 2), np.float32))
    mask = np.array([True, False, True, True])
    goals = np.tile((2.0, 0.0), (4, 1))
    anew, infos = vector.reset(options={"reset_mask": mask, "goal": goals})
    assert np.array_equal(infos["_success"], mask)
    assert np.array_equal(anew["observation"][1], obs["observation"][1])
    assert (anew["observation"][mask] == 0).all()
    assert np.array_equal(anew["desired_goal"][mask], goals[mask])
    with pytest.raises(ValueError, match=r"simulations \[1\] have ended"):
        vector.step(np.ones((4, 2), np.float32))
    for wrong in (np.zeros(4, bool), np.ones(3, bool), np.ones(4)):
        with pytest.raises(ValueError, match="reset_mask has 4 booleans"):
            vector.reset(options={"reset_mask": wrong})
    with pytest.raises(ValueError, match="4 simulations take as many seeds, not 3"):
        vector.reset(seed=[0, 1, 2])


@pytest.mark.parametrize("one", GOALS)
def test_rewards_can_be_computed_anew_for_other_goals(one):
    env = gymnasium.make(one).unwrapped
    rng = np.random.default_rng(0)
    env.action_space.seed(0)
    obs, info = env.reset(seed=1)
    rows = []
    for _ in range(60):
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        args = obs["achieved_goal"], obs["desired_goal"], info
        assert reward == env.compute_reward(*args)
        assert terminated == env.compute_terminated(*args)
        assert not env.compute_truncated(*args)
        rows.append(obs["achieved_goal"])
        if terminated or truncated:
            env.reset()
    achieved = np.array(rows)
    goals = achieved + rng.normal(0, 0.5, achieved.shape)
    many = env.compute_reward(achieved, goals, [{}] * len(goals))
    single = [env.compute_reward(a, g, {}) for a, g in zip(achieved, goals, strict=True)]
    assert np.array_equal(many, single) and 0 < many.mean() < 1
    inside = env.compute_terminated(achieved, goals, [{"healthy": False}] * len(goals))
    assert inside.all()
    assert not env.compute_reward(achieved, goals, [{"healthy": False}] * len(goals)).any()


def test_an_episode_begins_where_and_for_what_one_says():
    env = gymnasium.make("goalgan_bt/AntUMaze-v0").unwrapped
    obs, _ = env.reset(seed=0)
    state = obs["observation"].copy()
    state[:2] = 2.0, 0.0
    obs, _ = env.reset(options={"goal": (4.0, 0.0), "state": state})
    assert np.array_equal(obs["observation"], state)
    assert np.array_equal(obs["desired_goal"], (4.0, 0.0))
    for options, words in (
        ({"goal": (99.0, 0.0)}, "outside of the box"),
        ({"goal": (0.0,)}, "a goal has 2 finite numbers"),
        ({"goal": (0.0, np.nan)}, "a goal has 2 finite numbers"),
        ({"state": np.zeros(29)}, "not healthy or inside a wall"),
        ({"start": 1}, "unknown options"),
    ):
        with pytest.raises(ValueError, match=words):
            env.reset(options=options)


def test_goals_that_nobody_names_are_free_and_not_where_one_stands():
    env = gymnasium.make("goalgan_bt/PointUMaze-v0").unwrapped
    goals = np.array([env.reset(seed=i)[0]["desired_goal"] for i in range(300)])
    assert env.sims.feasible(goals).all()
    assert (np.linalg.norm(goals, axis=1) >= 0.3).all()
    assert len(np.unique(np.rint(goals / 2), axis=0)) == 7  # every cell
    assert np.array_equal(env.reset(seed=5)[0]["desired_goal"], goals[5])


def test_four_rooms_end_in_the_opposite_corner():
    env = gymnasium.make("goalgan_bt/FourRooms-v0", render_mode="ansi").unwrapped
    state, _ = env.reset()
    assert state == env.rooms.start and env.render().count("A") == 1
    way = [2] * 2 + [1] * 8 + [3] * 2 + [2] * 6 + [1] * 2  # through two doors
    for action in way:
        state, reward, terminated, _, info = env.step(action)
    assert terminated and reward == 1 and info["is_success"] and state == env.rooms.goal
    env.reset()
    ends = [env.step(0)[3] for _ in range(200)]
    assert ends == [False] * 199 + [True]
    for action in (-1, 4):
        with pytest.raises(ValueError, match="an action is a number from 0 to 3"):
            env.step(action)
    with pytest.raises(ValueError, match="reset takes a 'state'"):
        env.reset(options={"state": 10_000})


DRAW = """
import gymnasium, goalgan_bt.gym
from goalgan_bt.envs.goal_env import PhysicsError
env = gymnasium.make("goalgan_bt/AntUMaze-v0", render_mode="rgb_array", width=160, height=120)
env.reset(seed=0, options={"goal": (4.0, 0.0)})
try:
    picture = env.render()
except PhysicsError as error:
    print("no picture:", error)
else:
    red = (picture[..., 0] > 1.5 * picture[..., 1]).sum()
    print(picture.shape, picture.dtype, picture.std() > 20, red > 50)
env.close()
"""


def drawn(gl):
    env = os.environ | {"MUJOCO_GL": gl}
    done = subprocess.run(
        [sys.executable, "-c", DRAW], capture_output=True, text=True, env=env, timeout=120
    )
    return done.stdout.strip() or done.stderr


def test_a_picture_shows_the_maze_and_the_goal_or_says_what_is_missing():
    told = drawn("egl")
    if told.startswith("no picture: pictures need OpenGL"):
        pytest.skip("no EGL here")
    assert told == "(120, 160, 3) uint8 True True"
    assert drawn("off").startswith("no picture: pictures need OpenGL")


WINDOW = """
import gymnasium, goalgan_bt.gym
from goalgan_bt.envs.goal_env import PhysicsError
try:
    gymnasium.make("goalgan_bt/PointUMaze-v0", render_mode="human").reset()
except PhysicsError as error:
    print(error)
"""


def test_a_window_without_a_screen_is_refused_and_ends_nothing():
    """The viewer itself would end the process."""
    nowhere = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    words = [sys.executable, "-c", WINDOW]
    done = subprocess.run(words, capture_output=True, text=True, env=nowhere, timeout=120)
    assert done.stdout == "a window needs a screen: use rgb_array instead\n", done.stderr
    assert not done.stderr


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"integrator": "euler"}, "integrator is implicitfast or rk4, not 'euler'"),
        ({"action_repeat": 0}, "action_repeat must be a whole number from 1 on, not 0"),
        ({"horizon": -5}, "horizon must be a whole number from 1 on, not -5"),
        ({"horizon": 2.5}, "horizon must be a whole number from 1 on, not 2.5"),
        ({"width": 0}, "width must be a whole number from 1 on, not 0"),
        ({"render_mode": "ascii"}, "render_mode is rgb_array"),
    ],
)
@pytest.mark.parametrize("make", [GoalGymEnv, partial(GoalVectorEnv, 2)])
def test_settings_that_there_are_not_are_named(make, settings, problem):
    with pytest.raises(ValueError, match=re.escape(problem)):
        make("point_umaze", **settings)


def test_a_map_may_be_named_by_text(tmp_path):
    file = tmp_path / "my.txt"
    file.write_text("#####\n#S..#\n#####\n")
    env = gymnasium.make("goalgan_bt/AntUMaze-v0", map_file=str(file)).unwrapped
    assert len(env.sims.test_goals()) == 3 * 16


def test_a_vector_must_be_reset_first():
    with pytest.raises(gymnasium.error.ResetNeeded):
        GoalVectorEnv(2, "point_umaze").step(np.zeros((2, 2), np.float32))


def test_what_cannot_be_drawn_is_said_when_it_is_made():
    with pytest.raises(ValueError, match="no MuJoCo model"):
        gymnasium.make("goalgan_bt/PointND-v0", render_mode="rgb_array")
