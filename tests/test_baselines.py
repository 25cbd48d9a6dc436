"""What proposes goals instead of the GAN."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from goalgan_bt import envs
from goalgan_bt.curriculum.alp_gmm import AlpGmm
from goalgan_bt.curriculum.baselines import feasible, oracle
from goalgan_bt.curriculum.settings import GoalsConfig
from goalgan_bt.learners import maze_config
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.maze_learner import MazeLearner


def test_feasible_goals_fill_the_free_space_evenly():
    env = envs.make("point_umaze", 1)
    goals = feasible(env, 7000, np.random.default_rng(0))
    assert goals.shape == (7000, 2) and env.maze.is_free(goals).all()
    cells = np.unique(np.round(goals / 2), axis=0, return_counts=True)[1]
    assert len(cells) == 7 and cells.min() > 850 and cells.max() < 1150


def test_the_oracle_keeps_goals_of_intermediate_success():
    env, cfg = envs.make("point_umaze", 64), maze_config.preset("point_umaze")
    learner = MazeLearner(env, cfg)
    goals_cfg = GoalsConfig(source="oracle", new=100, r_min=0.1, r_max=0.9)
    noise = torch.Generator().manual_seed(0)
    goals, steps = oracle(env, learner.policy, goals_cfg, np.random.default_rng(0), noise)
    # A fresh policy wanders about the start: only goals near it are reached now and then.
    assert 0 < len(goals) < 50 and np.median(np.linalg.norm(goals, axis=1)) < 1.5
    assert 100 * 3 * 20 < steps <= 100 * 3 * 200
    never = GoalsConfig(source="oracle", new=50, r_min=0.998, r_max=0.999)
    assert len(oracle(env, learner.policy, never, np.random.default_rng(0), noise)[0]) == 50


def test_alp_gmm_seeks_where_outcomes_change():
    """Success is certain on the left, hopeless on the right, and a coin's toss between."""
    pytest.importorskip("sklearn")
    rng = np.random.default_rng(0)
    teacher = AlpGmm(np.zeros(2), np.ones(2), np.random.default_rng(1))
    first = teacher.sample(2000)
    assert first.mean(axis=0) == pytest.approx([0.5, 0.5], abs=0.03)  # nothing known: uniform
    for _ in range(12):
        goals = teacher.sample(300)
        chance = np.where(goals[:, 0] < 0.4, 1.0, np.where(goals[:, 0] < 0.6, 0.5, 0.0))
        teacher.add(goals, rng.random(300) < chance)
    x = teacher.sample(2000)[:, 0]
    between = ((x > 0.37) & (x < 0.63)).mean()
    assert between > 0.6  # uniform: 0.26; one in five stays uniform
    assert x.min() >= 0 and x.max() <= 1 and (x < 0.3).any() and (x > 0.7).any()


def test_alp_gmm_goes_on_where_it_was_saved():
    pytest.importorskip("sklearn")
    rng = np.random.default_rng(0)
    teacher, heir = (AlpGmm(np.zeros(2), np.ones(2), np.random.default_rng(1)) for _ in range(2))
    for _ in range(3):
        teacher.add(goals := teacher.sample(300), rng.random(300) < goals[:, 0])
    heir._rng.bit_generator.state = teacher._rng.bit_generator.state
    heir.load_state_dict(teacher.state_dict())
    for _ in range(2):
        goals = teacher.sample(300)
        np.testing.assert_array_equal(heir.sample(300), goals)
        for each in (teacher, heir):
            each.add(goals, goals[:, 0] > 0.5)


@pytest.mark.parametrize("source", ["gan", "gan_fit_all", "uniform", "feasible", "alp_gmm"])
def test_every_source_gives_goals_in_the_box(source):
    if source == "alp_gmm":
        pytest.importorskip("sklearn")
    cfg = maze_config.preset("point_umaze")
    cfg = replace(cfg, goals=replace(cfg.goals, source=source))
    env = make_env(cfg, 1)
    goals, steps = MazeLearner(env, cfg).propose(env)
    assert goals.shape == (cfg.goals.new, 2) and steps == 0
    assert (goals >= env.goal_low).all() and (goals <= env.goal_high).all()


def test_a_share_of_the_goals_lies_anywhere():
    """What a GAN knows nothing of is proposed all the same; the rest still comes from it."""
    cfg = maze_config.preset("point_nd")
    assert cfg.goals.anywhere == 0.1 and maze_config.preset("point_umaze").goals.anywhere == 0
    env = make_env(cfg, 1)
    here = np.full((500, 2), [0.3, 3.0])
    found = []
    for share in (0.0, 0.25):
        learner = MazeLearner(env, replace(cfg, goals=replace(cfg.goals, anywhere=share)))
        learner.curriculum.gan.fit(here, np.ones(len(here), dtype=bool), 200)
        goals, _ = learner.propose(env)
        found.append((np.linalg.norm(goals - here[0], axis=1) > 2.0).mean())
    assert found[0] < 0.02 and 0.18 < found[1] < 0.25
