"""The curriculum around environments of Gymnasium's and agents of Stable-Baselines3."""

import re
import runpy
import warnings
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
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


def test_gymnasiums_vectors_take_it():
    """Episodes that end together may have passed different numbers of places."""
    lengths = 5, 12
    envs = gymnasium.vector.SyncVectorEnv(
        [
            lambda h=h: CurriculumGoals(gymnasium.make("goalgan_bt/PointUMaze-v0", horizon=h))
            for h in lengths
        ]
    )
    envs.reset(seed=0, options={"goal": (4.0, 4.0)})
    told = []
    for _ in range(60):
        info = envs.step(np.zeros((2, 2), np.float32))[4]
        if "goal_tried" in info:
            told += [
                len(visited) for visited in info["goal_tried"]["visited"] if visited is not None
            ]
    assert {1, 2} <= set(told)


def test_goals_of_another_size_are_refused():
    with pytest.raises(UsageError, match="the curriculum's goals have 3 numbers"):
        CurriculumGoals(point(), GoalCurriculum(np.zeros(3), np.ones(3)))
    with pytest.raises(UsageError, match="goals must be rows"):
        CurriculumGoals(point()).queue_goals((1.0, 2.0, 3.0, 4.0))


def test_a_share_of_goals_is_from_anywhere_however_few_are_asked_for():
    """What a GAN that has closed in on mastered goals would never hear of."""
    curriculum = GoalCurriculum(*box(), seed=0)
    curriculum.ask(1)
    at = np.tile((1.0, 1.0), (20, 1))
    curriculum.tell(at, np.ones(20), visited=at)
    asked = np.concatenate([curriculum.ask(1) for _ in range(600)])
    spread = np.linalg.norm(asked - (1.0, 1.0), axis=1) > 3
    assert 0.02 < spread.mean() < 0.3


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
    callback = sb3.GoalGANCallback(curriculum)
    agent.learn(900, callback=callback)
    before = len(curriculum.asked), len(curriculum.heard)
    agent.learn(300, callback=callback, reset_num_timesteps=False)
    envs.close()
    # What was queued before is dropped, so that goals never get older than that.
    new, told = len(curriculum.asked) - before[0], len(curriculum.heard) - before[1]
    assert told > 10 and new == told + 3 * AHEAD
    del curriculum.asked[before[0] :], curriculum.heard[before[1] :]
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
    assert agent.num_timesteps >= 1200 and agent._n_updates > 0
    assert 0 <= example["coverage"](agent) < 0.5


@pytest.mark.parametrize("with_curriculum", [True, False])
def test_the_example_of_ppo_in_one_file_runs_and_measures(with_curriculum):
    example = runpy.run_path(str(Path(__file__).parents[1] / "examples/ppo_goals.py"))
    loop = example["Loop"](0, with_curriculum)
    seen, after, _, rewards, ended, terminated = loop.rollout()
    assert ended.sum() >= 32 and torch.equal(rewards > 0, terminated)
    # What was seen after an action is seen before the next, but where another episode begins.
    moved, anew = ~ended[:-1], ended[:-1] & ~terminated[:-1]
    assert torch.equal(after[:-1][moved], seen[1:][moved])
    assert (after[:-1][anew][:, 4:] != seen[1:][anew][:, 4:]).any(-1).all()  # other goals
    agent = example["train"](2 * 2048, 0, with_curriculum)
    assert 0 <= example["coverage"](agent) < 0.5


def test_one_file_ppo_bootstraps_where_time_is_over_and_nowhere_else():
    example = runpy.run_path(str(Path(__file__).parents[1] / "examples/ppo_goals.py"))
    shape = example["ROLLOUT"], example["ENVS"]
    gamma, lam = example["GAMMA"], example["LAMBDA"]
    agent = SimpleNamespace(value=lambda seen: seen)
    seen, after = torch.full((*shape, 1), 0.5), torch.full((*shape, 1), 2.0)
    ended, terminated = torch.zeros((2, *shape), dtype=torch.bool)
    ended[0] = terminated[2] = ended[2] = True
    gained = example["advantages"](agent, seen, after, torch.ones(shape), ended, terminated)
    on, over = 1 + gamma * 2.0 - 0.5, 1 - 0.5
    assert torch.allclose(gained[0], torch.tensor(on))  # cut short: what would have come counts
    assert torch.allclose(gained[2], torch.tensor(over))
    assert torch.allclose(gained[1], torch.tensor(on + gamma * lam * over))


def test_the_example_of_the_documentation_runs():
    pytest.importorskip("stable_baselines3")
    text = (Path(__file__).parents[1] / "docs/api.md").read_text()
    block = re.search(r"```python\n(from stable_baselines3 import SAC, Her.*?)```", text, re.S)[1]
    made = {}
    exec(block.replace("20_000", "1_100"), made)
    assert made["agent"].num_timesteps >= 1100
