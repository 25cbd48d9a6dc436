"""The forward model on a system that is known, and what it imagines."""

import numpy as np
import pytest
import torch

from goalgan_bt import envs
from goalgan_bt.learners import maze_config
from goalgan_bt.learners.maze_learner import MazeLearner
from goalgan_bt.recall.forward import ForwardModel, imagine
from goalgan_bt.recall.settings import BacktrackingConfig


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2))])
def test_it_recovers_a_linear_system(seed):
    """Its mean everywhere (at one point the fit of a small network wanders), and its noise."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(5000, 3)).astype(np.float32)
    actions = rng.uniform(-1, 1, (5000, 3)).astype(np.float32)
    following = states + 0.5 * actions + rng.normal(0, 0.1, states.shape).astype(np.float32)
    cfg = BacktrackingConfig(steps=2000, batch=256, min_transitions=1)
    model = ForwardModel(3, 3, cfg, torch.Generator().manual_seed(0))
    assert set(model.fit(states, actions, following)) == {"forward_nll"}
    s, a = torch.randn(3000, 3), 2 * torch.rand(3000, 3) - 1
    error = model.successors(s, a) - (s + 0.5 * a)
    assert error.mean(dim=0).abs().max() < 0.03
    assert ((error.std(dim=0) - 0.1).abs() < 0.04).all()


class Perfect:
    """A model that is the simulator."""

    def __init__(self, env):
        self.env = env

    def successors(self, states, actions):
        ids = np.arange(len(states))
        self.env.reset(ids, np.zeros((len(ids), 2)), states.double().numpy())
        self.env.advance(ids, actions.double().numpy())
        return torch.from_numpy(self.env.read_states(ids))


def test_only_imagined_successes_are_kept():
    env = envs.make("point_umaze", 200, threads=1)
    policy = MazeLearner(env, maze_config.preset("point_umaze")).policy
    rng = np.random.default_rng(0)
    goals = rng.uniform(-0.6, 0.6, (200, 2))
    states = np.zeros((200, 4))
    noise = torch.Generator().manual_seed(0)
    steps = imagine(Perfect(env), policy, env, states, goals, 25, noise)
    told = {tuple(goal): steps.states[(steps.goals == goal).all(axis=1)] for goal in steps.goals}
    assert 3 < len(told) < 150  # some wander onto their goal, some do not
    for goal, path in told.items():
        gaps = np.linalg.norm(path[:, :2] - goal, axis=1)
        assert tuple(path[0, :2]) == (0, 0)
        assert gaps[1:].min(initial=1) >= 0.3  # ends when it arrives
        assert gaps[-1] < 1.0
    nothing = imagine(Perfect(env), policy, env, states[:0], goals[:0], 5, noise)
    assert len(nothing.states) == 0
