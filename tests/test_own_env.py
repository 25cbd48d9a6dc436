"""Environments of one's own: robots in mazes, Gymnasium's goal environments, and their names."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from conftest import call

import goalgan_bt
import goalgan_bt.gym
from goalgan_bt import UsageError, envs
from goalgan_bt.envs import own
from goalgan_bt.envs.goal_env import PhysicsError
from goalgan_bt.envs.gym_goals import gym_goals
from goalgan_bt.envs.maze import MapError, layout
from goalgan_bt.envs.picture import Picture
from goalgan_bt.envs.robot_maze import RobotMaze
from goalgan_bt.learners import maze_config

ANT = Path(gymnasium.__file__).parent / "envs/mujoco/assets/ant.xml"
SMALL = {
    "rollout.num_envs": 16,
    "rollout.steps": 5,
    "goals.new": 20,
    "goals.old": 10,
    "gan.pretrain_steps": 1,
    "coverage.rollouts": 1,
    "coverage.every": 1_000_000,
}


class Spider(RobotMaze):
    """gymnasium's Ant, with its own step, as anybody's robot."""

    healthy_z = (0.3, 1.0)
    upright = 0.2
    usual_horizon = 40

    @classmethod
    def robot(cls):
        return mujoco.MjSpec.from_file(str(ANT))


Spider.preset = {"like": "ant_umaze", "discount": 0.9, **SMALL}

SLEDGE = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="sledge" pos="5 6 0.2">
      <freejoint/>
      <geom type="box" size="0.2 0.2 0.2" mass="1" friction="0.05 0 0"
            priority="1"/>
    </body>
  </worldbody>
  <actuator>
    <general name="push" site="here" gear="1 0 0 0 0 0" ctrlrange="0 4" dyntype="filter"
             dynprm="0.1" gainprm="1"/>
  </actuator>
</mujoco>"""
BALL = '<body><freejoint/><geom size="0.1"/></body ></worldbody>'
SITE = '<site name="here"/></body>'


class Sledge(RobotMaze):
    """An actuator with an activation, whose range is not symmetric."""

    @classmethod
    def robot(cls):
        return mujoco.MjSpec.from_string(SLEDGE.replace("</body>", SITE))


def simulations(body, n=6, **settings):
    settings = {"integrator": "implicitfast", "horizon": 40, "repeat": 1} | settings
    words = settings["integrator"], n, settings["horizon"], settings["repeat"], 1
    return body(layout("umaze"), *words, "mujoco", "auto")


def test_a_state_holds_all_that_a_robot_needs():
    """Written into another simulation it has the same future, activations included."""
    env, rng = simulations(Sledge), np.random.default_rng(0)
    assert env.start_state.tolist() == [0, 0, 0.2, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    some, others = np.arange(3), np.arange(3, 6)
    env.reset(np.arange(6), np.zeros((6, 2)))
    for _ in range(7):
        env.advance(some, rng.uniform(-1, 1, (3, 1)))
    states = env.read_states(some)
    assert states[:, -1].min() > 0.1  # the push that has built up
    env.write_states(some, states)
    env.write_states(others, states)
    actions = rng.uniform(-1, 1, (3, 1))
    env.advance(some, actions)
    env.advance(others, actions)
    assert np.array_equal(env.read_states(some), env.read_states(others))
    assert not np.array_equal(env.read_states(some)[:, 0], states[:, 0])


def test_actions_span_the_range_of_the_controls_and_are_held_for_a_step():
    env = simulations(Sledge, repeat=3)
    env.reset(np.arange(6), np.zeros((6, 2)))
    env.advance(np.arange(3), np.array([[-1.0], [0.0], [1.0]]))
    assert env.batch.bind("ctrl")[:3, 0].tolist() == [0, 2, 4]
    assert env.dt == 0.02
    assert env.batch.bind("time").tolist() == pytest.approx([0.06] * 3 + [0.0] * 3)


def turned(states, angle):
    """The same robots turned about the origin, seen from above."""
    out, c, s = states.copy(), np.cos(angle), np.sin(angle)
    rotate = np.array([[c, -s], [s, c]])
    out[:, :2] = states[:, :2] @ rotate.T
    half_c, half_s = np.cos(angle / 2), np.sin(angle / 2)
    w, x, y, z = states[:, 3:7].T
    out[:, 3], out[:, 4] = half_c * w - half_s * z, half_c * x - half_s * y
    out[:, 5], out[:, 6] = half_c * y + half_s * x, half_c * z + half_s * w
    out[:, 15:17] = states[:, 15:17] @ rotate.T
    return out, rotate


def some_states(env, n=6, seed=0):
    rng = np.random.default_rng(seed)
    states = env.start_state + rng.normal(0, 0.3, (n, env.state_dim))
    return env.repair(states), rng.uniform(-2, 2, (n, 2))


def test_with_a_heading_it_sees_the_same_whichever_way_the_world_is_turned():
    env = simulations(Spider)
    assert not env.heading
    states, goals = some_states(env)
    everything = env.observations(states, goals)
    assert everything.shape == (6, env.obs_dim) and everything.dtype == np.float32
    assert everything[:, -4:-2] == pytest.approx(states[:, :2].astype(np.float32))
    env.heading = lambda places, goals: goals - places
    seen = env.observations(states, goals)
    assert seen.shape == (6, env.obs_dim) and env.obs_dim == everything.shape[1] - 4
    for angle in (0.5, 2.0, 4.0):
        others, rotate = turned(states, angle)
        again = env.observations(others, goals @ rotate.T)
        assert again == pytest.approx(seen, abs=1e-5)
    # Nothing else is lost: of an offset, another offset.
    assert np.abs(env.observations(states, goals + 1.0) - seen).max(axis=1).min() > 1e-3


def test_a_robot_ends_its_episode_where_it_says_so():
    env = simulations(Spider)
    fine, low, fallen, lost = np.tile(env.start_state, (4, 1))
    low[2], lost[7] = 0.1, np.nan
    fallen[3:7] = np.cos(np.pi / 4), np.sin(np.pi / 4), 0, 0  # on its side
    assert env.healthy(np.stack([fine, low, fallen, lost])).tolist() == [True] + [False] * 3
    at_wall = fine.copy()
    at_wall[1] = 0.9
    assert env.valid(np.stack([fine, at_wall])).tolist() == [True, False]
    assert env.achieved_goals(env.place(fine[None], np.array([[1.5, 0.3]]))).tolist() == [
        [1.5, 0.3]
    ]


def test_walls_and_a_floor_hold_it():
    env = simulations(Sledge, n=1)
    env.reset(np.arange(1), np.zeros((1, 2)))
    for _ in range(300):  # 6 s at full push along x, where the wall begins at 5 m
        env.advance(np.arange(1), np.ones((1, 1)))
    x, y, z = env.read_states(np.arange(1))[0, :3]
    assert 2 < x < 5.0 and abs(y) < 1.0 and 0.15 < z < 1.5


def test_a_state_with_activations_is_drawn():
    env = simulations(Sledge, n=1)
    try:
        picture = Picture(env, 64, 48).draw(env.start_state, np.array([2.0, 0.0]))
    except PhysicsError as error:
        pytest.skip(str(error))
    assert picture.shape == (48, 64, 3) and np.ptp(picture) > 50


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (RobotMaze, "failed with NotImplementedError"),
        (lambda *_: 1 / 0, "failed with ZeroDivisionError"),
        (lambda *_: None, "made NoneType, and no GoalEnv"),
        (os.getcwd, "failed with TypeError"),
    ],
)
def test_code_that_fails_says_how(make, problem):
    name = f"failing{len(problem)}_{problem.split()[-1]}"
    goalgan_bt.register_env(name, make, {})
    with pytest.raises(own.OwnEnvError, match=problem):
        envs.make(name, 1)


def robot_of(xml, **says):
    return type(
        "Odd",
        (RobotMaze,),
        {"robot": classmethod(lambda _: mujoco.MjSpec.from_string(xml)), **says},
    )


@pytest.mark.parametrize(
    ("xml", "says", "problem"),
    [
        (SLEDGE.replace("<freejoint/>", '<joint type="slide"/>'), {}, "must be a free joint"),
        (SLEDGE.replace('ctrlrange="0 4"', ""), {}, "must have a ctrlrange"),
        (SLEDGE, {"step_seconds": 0.015}, "must be a multiple of the model's"),
        (SLEDGE.replace("</worldbody>", BALL), {}, "none of the others"),
        (SLEDGE, {"healthy_z": (1.0, 2.0)}, "the pose in which it begins"),
        (SLEDGE, {"success_radius": 0.0}, "must be above 0"),
    ],
)
def test_what_is_no_such_robot_says_why(xml, says, problem):
    with pytest.raises(PhysicsError, match=problem):
        simulations(robot_of(xml.replace("</body>", SITE), **says))


def test_a_registered_robot_is_an_environment(tmp_path):
    goalgan_bt.register_env("spider", Spider)
    cfg = maze_config.preset("spider", "goal_gan")
    assert (cfg.env, cfg.discount, cfg.rollout.num_envs) == ("spider", 0.9, 16)
    assert cfg.places.shaping == 0 and cfg.updates == maze_config.ANT.updates
    assert envs.make("spider", 2).name == "spider_umaze"
    trained = goalgan_bt.train("spider", total_steps=500, out=tmp_path)
    assert trained.folder.name.startswith("spider_umaze-")
    policy = goalgan_bt.load_policy(trained.folder)
    assert policy.act(policy.env.start_state, [1.0, 0.0]).shape == (8,)
    again = goalgan_bt.train(resume=trained.folder, total_steps=1500)
    assert again.folder == trained.folder and again.steps > trained.steps


@pytest.mark.parametrize("name", ["ant_umaze", "hopper", "four_rooms_9", "two words", "a:b", 3])
def test_names_that_are_taken_or_no_words_are_refused(name):
    with pytest.raises(UsageError, match="cannot be an environment's name"):
        goalgan_bt.register_env(name, Spider)


def test_a_name_means_one_thing():
    goalgan_bt.register_env("crawler", Spider)
    goalgan_bt.register_env("crawler", Spider, {"discount": 0.8})
    with pytest.raises(UsageError, match="cannot be an environment's name"):
        goalgan_bt.register_env("crawler", Sledge)
    with pytest.raises(UsageError, match="neither a class nor a function"):
        goalgan_bt.register_env("nothing", 3)
    with pytest.raises(UsageError, match="must be a dictionary"):
        goalgan_bt.register_env("nothing", Spider, "ant_umaze")


@pytest.mark.parametrize(
    ("preset", "problem"),
    [
        ({"like": "ant_moon"}, "like 'ant_moon'"),
        ({"trpo.max_lk": 1}, "max_lk"),
        ({"turbo": 1}, "turbo"),
        ({"no.such": 1}, "no"),
        ({"trpo": {"max_kl": 1}}, "say trpo.NAME"),
        ({"method": "goal_gan"}, "cannot say method"),
    ],
)
def test_a_preset_of_settings_that_there_are_not_says_which(preset, problem):
    goalgan_bt.register_env("odd", Spider, preset)
    with pytest.raises(UsageError, match=problem):
        maze_config.preset("odd")


CODE = f"""
import mujoco
from goalgan_bt.envs.robot_maze import RobotMaze

print("this code ran")

class Walker(RobotMaze):
    preset = {SMALL!r}
    usual_horizon = 40

    @classmethod
    def robot(cls):
        return mujoco.MjSpec.from_file({str(ANT)!r})
"""


def command(name, *words, folder, **variables):
    """`python -m goalgan_bt.<name>` in a folder, where code of one's own lies."""
    argv = [sys.executable, "-m", f"goalgan_bt.{name}", *map(str, words)]
    environment = os.environ | variables
    return subprocess.run(
        argv, capture_output=True, text=True, timeout=120, cwd=folder, env=environment
    )


def test_code_runs_where_the_command_line_names_it_and_never_because_of_a_folder(tmp_path):
    (tmp_path / "mine.py").write_text(CODE)
    (tmp_path / "field.txt").write_text("#####\n#S..#\n#####\n")
    name = "--env", "mine:Walker"
    words = *name, "--viz", "none", "--map", "field.txt"
    done = command("train", *words, "--total-steps", 300, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    (run,) = (tmp_path / "runs").iterdir()
    assert run.name.startswith("walker_field-")

    more = "train", "--resume", run, "--viz", "none", "--total-steps", 900
    refused = command(*more, folder=tmp_path)
    assert refused.returncode == 2 and "this code ran" not in refused.stdout
    assert "GOALGAN_BT_ENVS=mine:Walker" in refused.stderr and refused.stderr.count("\n") == 1
    assert command(*more, *name, folder=tmp_path).returncode == 0
    allowed = {own.VARIABLE: "mine:Walker"}
    seen = command("evaluate", run, "--episodes", 1, folder=tmp_path, **allowed)
    assert seen.returncode == 0 and "success" in seen.stdout, seen.stderr


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("nowhere:Walker", "No module named 'nowhere'"),
        ("broken:Walker", "importing 'broken' failed with ZeroDivisionError"),
        ("mine:Runner", "there is no 'Runner'"),
        ("mine:", "there is no ''"),
        ("sys:nothing", "there is no 'nothing' in sys"),
        ("leaving:Walker", "importing 'leaving' failed with SystemExit"),
    ],
)
def test_what_cannot_be_imported_ends_in_a_line(name, problem, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(CODE)
    (tmp_path / "broken.py").write_text("1 / 0")
    (tmp_path / "leaving.py").write_text("raise SystemExit(0)")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(own.VARIABLE, "")
    done = call("train", "--env", name)
    assert done.returncode == 2 and problem in done.stderr and done.stderr.count("\n") == 1


# Goal environments of Gymnasium's.

POINT = gym_goals("goalgan_bt/PointUMaze-v0", success_radius=0.3, action_repeat=4, horizon=200)


def test_an_adapted_environment_does_what_it_does_alone():
    """Our point through Gymnasium's interface beside the same point as it is."""
    adapted, ours = POINT(3, 50, 1, 1), envs.make("point_umaze", 3, horizon=200, action_repeat=4)
    goals = np.array([[1.0, 0.5], [4.0, 0.0], [0.1, -0.1]])
    ids, rng = np.arange(3), np.random.default_rng(0)
    adapted.reset(ids, goals)
    ours.reset(ids, goals)
    for _ in range(12):
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32).astype(float)
        one, other = adapted.step(ids, actions), ours.step(ids, actions)
        assert np.array_equal(one.states[:, 2:], other.states)
        for name in ("achieved", "rewards", "terminated", "truncated"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name
        if one.terminated.any():
            ids = ids[~one.terminated]
            break
    assert ids.tolist() == [0, 1]  # the goal under its feet was reached at once


def test_gymnasium_robotics_hears_of_the_goals_that_it_is_given():
    told = {"success_radius": 0.45, "continuing_task": False}
    env = gym_goals("gymnasium_robotics:PointMaze_UMaze-v3", **told)(2, 20, 1, 1)
    ids, goals = np.arange(2), env.test_goals()[[3, 8]]
    env.reset(ids, goals)
    step = env.step(ids, np.zeros((2, 2)))
    for copy, goal in zip(env._copies, goals, strict=True):
        assert copy.unwrapped.goal == pytest.approx(goal)
    near = np.linalg.norm(step.achieved - goals, axis=1) <= 0.45
    assert (step.rewards > 0).tolist() == near.tolist()


def test_an_environment_that_does_not_take_goals_is_found_out():
    told = {"success_radius": 0.45, "continuing_task": False, "begin": lambda env, *_: env.reset()}
    env = gym_goals("gymnasium_robotics:PointMaze_UMaze-v3", **told)(1, 20, 1, 1)
    env.reset(np.arange(1), np.array([[1.0, 1.0]]))
    with pytest.raises(PhysicsError, match="does not take the goals"):
        for _ in range(20):
            env.step(np.arange(1), np.zeros((1, 2)))


def test_time_runs_out_and_states_stay_the_environments_own():
    adapted = POINT(1, 3, 1, 1)
    adapted.reset(np.arange(1), np.array([[4.0, 4.0]]))
    late = [bool(adapted.step(np.arange(1), np.zeros((1, 2))).truncated[0]) for _ in range(3)]
    assert late == [False, False, True]
    with pytest.raises(PhysicsError, match="cannot be set"):
        adapted.reset(np.arange(1), np.zeros((1, 2)), np.zeros((1, 6)))


def test_gymnasium_robotics_point_maze_is_trained_end_to_end(tmp_path):
    maze = gym_goals(
        "gymnasium_robotics:PointMaze_UMaze-v3",
        success_radius=0.45,
        continuing_task=False,
        preset=SMALL | {"updates": 2},
    )
    goalgan_bt.register_env("robotics", maze)
    trained = goalgan_bt.train("robotics", total_steps=1500, out=tmp_path)
    assert trained.folder.name.startswith("robotics-") and 0 < trained.value < 1
    policy = goalgan_bt.load_policy(trained.folder)
    assert policy.env.goal_dim == 2 and policy.env.horizon == 300
    assert policy.act(policy.env.start_state, policy.env.test_goals()[0]).shape == (2,)
    with pytest.raises(UsageError, match="cannot be set"):
        goalgan_bt.train("robotics", method="recall_traces_paper", out=tmp_path)
    with pytest.raises(MapError, match="has no maze"):
        goalgan_bt.train("robotics", map="field.txt", out=tmp_path)


@pytest.mark.parametrize(
    ("id", "settings", "problem"),
    [
        ("CartPole-v1", {}, "its observations must be of observation"),
        ("goalgan_bt/PointUMaze-v0", {}, "give --horizon"),
        ("goalgan_bt/PointUMaze-v0", {"max_episode_steps": 50}, "give a success_radius"),
        ("goalgan_bt/Nowhere-v0", {}, "cannot be made: NameNotFound"),
    ],
)
def test_what_is_no_goal_environment_says_why(id, settings, problem):
    with pytest.raises(PhysicsError, match=problem):
        gym_goals(id, **settings)(1, None, 1, 1)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_quadruped_of_the_document_learns_the_field(tmp_path, monkeypatch):
    """Of seed 0 coverage was 0.97 after as many steps."""
    pytest.importorskip("dm_control")
    examples = Path(__file__).parents[1] / "examples"
    monkeypatch.syspath_prepend(examples)
    every = {"coverage.every": 3_300_000}
    settings = {"map": examples / "field.txt", "total_steps": 3_300_000, "out": tmp_path}
    assert goalgan_bt.train("quadruped:Quadruped", **settings, **every).value >= 0.5
