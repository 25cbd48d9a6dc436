"""The curriculum around environments of Gymnasium's and agents of Stable-Baselines3."""

import runpy
import warnings
from collections import Counter
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import goalgan_bt.gym  # noqa: F401
from goalgan_bt import CurriculumGoals, GoalCurriculum, UsageError

HOW = {"horizon": 20, "action_repeat": 4}


def point():
    return gymnasium.make("goalgan_bt/PointUMaze-v0", **HOW)


def box():
    sims = point().unwrapped.sims
    return sims.goal_low, sims.goal_high


class Told(GoalCurriculum):
    """The real curriculum, which writes down what it is asked and told."""

    def __init__(self, *words, **settings):
        super().__init__(*words, **settings)
        self.asked, self.heard = [], []

    def ask(self, n):
        goals = super().ask(n)
        self.asked += [*goals]
        return goals

    def tell(self, goals, success, visited=None):
        self.heard += [*zip(np.asarray(goals), success, strict=True)]
        return super().tell(goals, success, visited)


def test_a_loop_of_ones_own_tries_what_was_asked_and_tells_how_it_went():
    curriculum = Told(*box(), seed=0, every=10)
    env = CurriculumGoals(point(), curriculum)
    env.action_space.seed(0)
    tried = []
    for _ in range(60):
        obs, _ = env.reset()
        goal, reached, ended = obs["desired_goal"], False, False
        while not ended:
            obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
            assert np.array_equal(obs["desired_goal"], goal)  # one goal for an episode
            reached |= reward > 0
            ended = terminated or truncated
            assert ("goal_tried" in info) == ended
        tried.append((goal, reached))
        assert np.array_equal(info["goal_tried"]["visited"][-1], obs["achieved_goal"])
    assert np.array_equal(curriculum.asked, [goal for goal, _ in tried])
    assert [(tuple(g), s) for g, s in curriculum.heard] == [(tuple(g), s) for g, s in tried]
    assert len(curriculum.visited) > 0 and 0 < sum(s for _, s in tried) < 60


def test_what_one_says_at_reset_counts_more():
    env = CurriculumGoals(point(), GoalCurriculum(*box(), seed=0))
    obs, _ = env.reset(options={"goal": (4.0, 0.0)})
    assert np.array_equal(obs["desired_goal"], (4.0, 0.0))
    queue = CurriculumGoals(point())
    queue.queue_goals([(1.0, 0.0), (2.0, 0.0)])
    goals = [queue.reset()[0]["desired_goal"] for _ in range(3)]
    assert np.array_equal(goals[:2], [(1.0, 0.0), (2.0, 0.0)])
    assert queue.unwrapped.sims.feasible(goals[2][None])  # none left: one of its own


def test_gymnasium_has_nothing_to_say_about_it():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that it is wrapped
        check_env(CurriculumGoals(point()), skip_render_check=True)


def test_an_environment_without_goals_is_refused():
    with pytest.raises(UsageError, match="an achieved_goal and a desired_goal"):
        CurriculumGoals(gymnasium.make("CartPole-v1"))


def test_gymnasium_robotics_mazes_take_the_goals_too():
    robotics = pytest.importorskip("gymnasium_robotics")
    sb3 = pytest.importorskip("goalgan_bt.sb3")
    gymnasium.register_envs(robotics)
    env = CurriculumGoals(
        gymnasium.make("PointMaze_UMaze-v3", continuing_task=False), begin=sb3.goal_as_attribute
    )
    obs, _ = env.reset(seed=0)
    goal = obs["achieved_goal"] + (0.3, 0.2)
    env.queue_goals(goal)
    obs, _ = env.reset(seed=0)
    assert np.allclose(obs["desired_goal"], goal)
    obs, reward, terminated, _, info = env.step(np.zeros(2))
    assert np.allclose(obs["desired_goal"], goal)
    assert (reward, terminated) == (1.0, True)  # within its 0.45 m
    assert info["goal_tried"]["success"]


@pytest.mark.parametrize("processes", [False, True])
def test_agents_of_stable_baselines_try_the_curriculums_goals(processes, tmp_path):
    sb3 = pytest.importorskip("goalgan_bt.sb3")
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    from goalgan_bt.learners.curriculum_callback import AHEAD

    curriculum = Told(*box(), seed=0, every=20)
    envs = make_vec_env(
        point,
        3,
        seed=0,
        wrapper_class=CurriculumGoals,
        vec_env_cls=SubprocVecEnv if processes else DummyVecEnv,
    )
    agent = PPO("MultiInputPolicy", envs, n_steps=50, batch_size=50, seed=0, device="cpu")
    agent.learn(900, callback=sb3.GoalGANCallback(curriculum))
    envs.close()
    asked = Counter(tuple(goal) for goal in curriculum.asked)
    heard = Counter(tuple(goal) for goal, _ in curriculum.heard)
    # Those of the first episodes are the environments' own: they began before it was asked.
    assert heard.total() > 100 and (heard - asked).total() == 3
    assert asked.total() == heard.total() + 3 * AHEAD  # two are queued in each, always
    curriculum.save(tmp_path / "curriculum.pt")
    again = GoalCurriculum.load(tmp_path / "curriculum.pt")
    assert np.array_equal(again.ask(5), curriculum.ask(5))


def test_environments_that_are_not_wrapped_are_named():
    sb3 = pytest.importorskip("goalgan_bt.sb3")
    from stable_baselines3 import PPO

    agent = PPO("MultiInputPolicy", point(), n_steps=16, batch_size=16, device="cpu")
    with pytest.raises(TypeError, match=r"put each environment into goalgan_bt\.CurriculumGoals"):
        agent.learn(16, callback=sb3.GoalGANCallback(GoalCurriculum(*box())))


def test_the_example_runs_and_measures():
    pytest.importorskip("stable_baselines3")
    example = runpy.run_path(str(Path(__file__).parents[1] / "examples/sb3_goals.py"))
    agent = example["train"](1200, 0, True)
    assert agent.num_timesteps >= 1200 and 0 <= example["coverage"](agent) < 0.5
