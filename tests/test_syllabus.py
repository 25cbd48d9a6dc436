"""The curriculum in training loops with Syllabus."""

import time

import gymnasium
import numpy as np
import pytest

import goalgan_bt.gym  # noqa: F401
from goalgan_bt import GoalCurriculum, UsageError

pytest.importorskip("syllabus")

from syllabus.core import GymnasiumSyncWrapper, make_multiprocessing_curriculum
from syllabus.task_space import BoxTaskSpace, DiscreteTaskSpace

from goalgan_bt.syllabus import GoalGANCurriculum, GoalTasks

LOW, HIGH = (-3.0, -3.0), (7.0, 7.0)


class Told(GoalCurriculum):
    """The real curriculum, which writes down what it is told."""

    def __init__(self, *words, **settings):
        super().__init__(*words, **settings)
        self.heard = []

    def tell(self, goals, success, visited=None):
        self.heard += [(*goal, reached) for goal, reached in zip(goals, success, strict=True)]
        return super().tell(goals, success, visited)


class Written:
    def __init__(self):
        self.rows = {}

    def add_scalar(self, name, value, step):
        self.rows[name] = (value, step)


def box(low, high):
    return BoxTaskSpace(gymnasium.spaces.Box(np.array(low), np.array(high), dtype=np.float64))


def test_syllabus_samples_what_was_asked_and_tells_how_it_went():
    tasks = GoalGANCurriculum(GoalCurriculum(LOW, HIGH, seed=0, every=10))
    twin = GoalCurriculum(LOW, HIGH, seed=0, every=10)
    writer, lessons = Written(), {}
    for turn in range(3):
        goals, expected = tasks.sample(8), twin.ask(8)
        assert np.array_equal(goals, expected)
        for goal in goals:
            assert np.array_equal(tasks.task_space.decode(goal), goal)
            reached = bool(np.linalg.norm(goal) < 4)
            tasks.update_on_episode(float(reached), 50, goal, progress=float(reached), env_id=0)
            lessons |= twin.tell(goal[None], [reached])
        logs = tasks.log_metrics(writer, [("mine", 1.0)], step=turn)
    assert lessons and dict(logs) == {
        "mine": 1.0,
        **{f"curriculum/{name}": value for name, value in lessons.items()},
    }
    assert writer.rows["curriculum/intermediate"] == (lessons["intermediate"], 2)
    assert len(tasks.sample()) == 1


def test_a_task_space_must_hold_all_goals():
    curriculum = GoalCurriculum(LOW, HIGH)
    larger = box((-4, -4), (8, 8))
    assert GoalGANCurriculum(curriculum, larger).task_space is larger
    spaces = box((-2, -3), (7, 7)), box((-3,) * 3, (7,) * 3), DiscreteTaskSpace(5), "box"
    for space in spaces:
        with pytest.raises(UsageError, match="that holds the goals from"):
            GoalGANCurriculum(curriculum, space)
    with pytest.raises(UsageError, match="outside of the box"):
        tasks = GoalGANCurriculum(curriculum)
        tasks.sample()
        tasks.update_on_episode(0.0, 50, np.array((9.0, 9.0)), 0.0)


def test_syllabus_own_loop_trains_on_it():
    """Its thread samples goals and hears of episodes; its wrapper brings both to the maze."""
    curriculum = Told((-1, -1), (1, 1), seed=0, every=20)  # some are reached by chance
    tasks = GoalGANCurriculum(curriculum)
    shared = make_multiprocessing_curriculum(tasks, timeout=20)
    try:
        inner = gymnasium.make("goalgan_bt/PointUMaze-v0", horizon=20, action_repeat=4)
        env = GymnasiumSyncWrapper(GoalTasks(inner), tasks.task_space, shared.components)
        env.action_space.seed(0)
        tried = []
        for _ in range(40):
            obs, info = env.reset()
            goal, reached, ended = obs["desired_goal"], False, False
            assert np.array_equal(info["task"], goal)
            while not ended:
                obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
                reached |= reward > 0
                ended = terminated or truncated
                assert info["task_completion"] == reached
            tried.append((*goal, reached))
        deadline = time.monotonic() + 20
        while len(curriculum.heard) < len(tried) and time.monotonic() < deadline:
            time.sleep(0.01)
    finally:
        shared.stop()
    assert curriculum.heard == tried and 0 < sum(reached for *_, reached in tried) < 40
