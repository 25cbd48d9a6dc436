import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from goalgan_bt.curriculum.curriculum import GoalCurriculum
from goalgan_bt.curriculum.goals import GoalMemory, SuccessEstimator, intermediate
from goalgan_bt.curriculum.settings import GoalsConfig
from goalgan_bt.learners import maze_config
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.maze_learner import MazeLearner
from goalgan_bt.runs.errors import UsageError


def test_label_edges_are_strict():
    success = np.array([0.0, 0.1, 0.1001, 0.5, 0.8999, 0.9, 1.0])
    assert intermediate(success, 0.1, 0.9).tolist() == [
        False,
        False,
        True,
        True,
        True,
        False,
        False,
    ]


points = st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5)), max_size=40)


@settings(deadline=None)
@given(points, points)
def test_replayed_goals_keep_their_distance(first, second):
    replay = GoalMemory(2, 0.3)
    for goals in (first, second):
        replay.add(np.array(goals).reshape(-1, 2))
    kept = replay.goals
    gaps = np.linalg.norm(kept[:, None] - kept, axis=2) + np.eye(len(kept))
    assert (gaps > 0.3).all()
    # Whatever was left out is close to something that was kept.
    for goal in [*first, *second]:
        assert (np.linalg.norm(kept - goal, axis=1) <= 0.3).any()


def test_replay_draws_without_repetition():
    replay = GoalMemory(1, 0.3)
    rng = np.random.default_rng(0)
    assert replay.sample(5, rng).shape == (0, 1)
    replay.add(np.arange(10.0)[:, None])
    assert sorted(replay.sample(100, rng)[:, 0]) == list(range(10))
    assert len(np.unique(replay.sample(4, rng))) == 4


def test_distance_to_what_is_kept():
    memory = GoalMemory(2, 0.3)
    assert np.isinf(memory.distance_to(np.zeros((2, 2)))).all()
    memory.add(np.array([[0.0, 0.0], [3.0, 4.0]]))
    assert memory.distance_to(np.array([[3.0, 3.0], [0.0, -2.0]])).tolist() == [1.0, 2.0]


def test_the_estimator_learns_how_hard_goals_are():
    """Success falls linearly with x: from one episode per goal it finds the share."""
    estimator = SuccessEstimator(2, GoalsConfig(episodes=3000, neighbours=50))
    rng = np.random.default_rng(0)
    goals = rng.uniform(0, 10, (3000, 2))
    estimator.add(goals, rng.random(3000) > goals[:, 0] / 10)
    test = rng.uniform(1, 9, (500, 2))
    assert np.abs(estimator(test) - (1 - test[:, 0] / 10)).mean() < 0.07


def test_the_estimator_by_hand():
    estimator = SuccessEstimator(1, GoalsConfig(neighbours=2))
    estimator.add(np.array([[0.0], [1.0], [5.0]]), np.array([True, False, True]))
    assert estimator(np.array([[0.2], [9.0]])).tolist() == [0.5, 0.5]
    estimator.add(np.array([[5.5]]), np.array([True]))
    assert estimator(np.array([[0.2], [9.0]])).tolist() == [0.5, 1.0]


def test_the_estimator_forgets_old_episodes():
    estimator = SuccessEstimator(2, GoalsConfig(episodes=100))
    estimator.add(np.zeros((300, 2)), np.zeros(300, dtype=bool))
    assert estimator(np.zeros((1, 2))) == 0
    estimator.add(np.zeros((100, 2)), np.ones(100, dtype=bool))
    assert estimator(np.zeros((1, 2))) == 1
    estimator.add(np.zeros((9000, 2)), np.zeros(9000, dtype=bool))
    assert len(estimator.goals) == 5000  # a memory of failures, longer than that of success


def test_a_goal_is_hopeless_once_all_tries_near_it_have_failed():
    estimator = SuccessEstimator(2, GoalsConfig(near=0.4, hopeless=3))
    here, off, far = np.array([[0.0, 0.0]]), np.array([[0.5, 0.0]]), np.array([[9.0, 0.0]])
    everywhere = np.concatenate([here, off, far])
    assert not estimator.hopeless(everywhere).any()
    estimator.add(here.repeat(2, axis=0), np.zeros(2, dtype=bool))
    assert not estimator.hopeless(everywhere).any()  # two are not enough
    estimator.add(here, np.zeros(1, dtype=bool))
    assert estimator.hopeless(everywhere).tolist() == [True, False, False]
    estimator.add(far.repeat(3, axis=0), np.zeros(3, dtype=bool))
    assert estimator.hopeless(far).all()
    estimator.add(np.array([[9.1, 0.0]]), np.ones(1, dtype=bool))  # the nearest three count
    assert estimator.hopeless(np.array([[9.0, 0.0], [9.2, 0.0]])).tolist() == [True, False]


def test_with_a_frontier_goals_are_tried_beyond_what_was_seen_until_they_fail_or_are_mastered():
    cfg = GoalsConfig(near=0.4, frontier=1.4, hopeless=3, neighbours=2)
    curriculum = GoalCurriculum([-5, -5], [5, 5], goals=cfg)
    curriculum.see(np.array([[0.0, 0.0]]))
    goals = np.array([[0.2, 0.0], [1.3, 0.0], [1.5, 0.0]])
    assert curriculum.judge(goals, np.zeros(3)).labels.tolist() == [True, True, False]
    assert curriculum.judge(goals, np.ones(3)).labels.tolist() == [False, False, False]
    assert curriculum.judge(goals, np.full(3, np.nan)).labels.tolist() == [True, True, False]
    curriculum.remember(np.array([[1.3, 0.1]] * 3), np.zeros(3))  # a wall, it seems
    assert curriculum.judge(goals, np.zeros(3)).labels.tolist() == [True, False, False]
    curriculum.remember(np.array([[0.2, 0.0]] * 3), np.ones(3))
    assert curriculum.judge(goals, np.zeros(3)).labels.tolist() == [True, False, False]


def test_of_many_imagined_goals_those_of_intermediate_difficulty_are_proposed():
    def share(imagined):
        cfg = GoalsConfig(near=1.0, imagined=imagined)
        curriculum = GoalCurriculum([-5, -5], [5, 5], goals=cfg)
        curriculum.see(np.array([[0.0, 0.0], [0.9, 0.0]]))
        tried = curriculum.uniform(2000)
        curriculum.remember(tried, curriculum.rng.random(2000) < 0.5)
        goals = curriculum.propose(100)
        assert goals.shape == (100, 2)
        return curriculum.judge(goals, curriculum.estimator(goals)).labels.mean()

    assert share(4) > 1.5 * share(1)


def test_an_estimator_without_episodes_knows_nothing():
    success = SuccessEstimator(2, GoalsConfig())(np.zeros((3, 2)))
    assert np.isnan(success).all()
    assert not intermediate(success, 0.1, 0.9).any()


def test_only_goals_near_visited_places_are_intermediate():
    cfg = maze_config.preset("ant_umaze", "goal_gan")
    curriculum = MazeLearner(make_env(cfg, 1), cfg).curriculum
    curriculum.see(np.array([[0.0, 0.0]]))
    near, far = cfg.goals.near * 0.9, cfg.goals.near * 1.1
    goals = np.array([[near, 0.0], [far, 0.0], [near, 0.0]])
    labels, _ = curriculum.judge(goals, np.array([0.5, 0.5, 1.0]))
    assert labels.tolist() == [True, False, False]
    curriculum.estimator.add(goals.repeat(5, axis=0), np.ones(15, dtype=bool))
    mapped = curriculum.mapped(np.array([[0.9, 0.0], [1.1, 0.0]]), reach=1.0)
    assert mapped.tolist() == [1.0, 0.0]


def test_a_frontier_needs_the_places_visited():
    for near, frontier in ((float("inf"), 1.0), (0.4, 0.3)):
        with pytest.raises(UsageError, match="frontier must not be less than near"):
            GoalCurriculum([0, 0], [1, 1], goals=GoalsConfig(near=near, frontier=frontier))
