"""The backtracking model on systems whose reverse is known, and its traces in the real mazes."""

import numpy as np
import pytest
import torch
from test_mlp import by_torch

from goalgan_bt import envs
from goalgan_bt.backtracking import (
    BacktrackingConfig,
    BacktrackingModel,
    Transitions,
    recall_traces,
)
from goalgan_bt.decoder import decode


def fitted(states, actions, next_states, steps=1500, **settings):
    torch.manual_seed(0)
    cfg = BacktrackingConfig(steps=steps, hidden=(64, 64), min_transitions=1, **settings)
    dims = states.shape[1], actions.shape[1]
    model = BacktrackingModel(*dims, cfg, torch.Generator().manual_seed(0))
    data = Transitions(*dims, cfg)
    data.add(states, actions, next_states)
    return model, model.fit(data)


def linear_walk(n=20_000, seed=0):
    """s' = s + 0.5 a + noise, with a ~ U(-1, 1) and s ~ N(0, 1)."""
    rng = np.random.default_rng(seed)
    states = rng.normal(0, 1, (n, 2)).astype(np.float32)
    actions = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
    noise = rng.normal(0, 0.1, (n, 2)).astype(np.float32)
    return states, actions, states + 0.5 * actions + noise


def test_it_recovers_the_reverse_of_a_linear_gaussian_walk():
    model, _ = fitted(*linear_walk())
    torch.manual_seed(1)
    following = torch.tensor([[1.0, -0.5]]).repeat(4000, 1)
    before, actions = model.predecessors(following)
    # Given a, s = s' - 0.5 a up to N(0, 0.1^2) (and a slight pull to the prior).
    error = (before - (following - 0.5 * actions)).numpy()
    assert np.abs(error.mean(axis=0)).max() < 0.05
    assert error.std(axis=0) == pytest.approx([0.1, 0.1], rel=0.3)
    # Actions that led to a large s' were more likely positive: E[a | s'] = s' Cov / Var.
    var = 1 + 0.25 / 3 + 0.01
    expected = np.array([1.0, -0.5]) * (0.5 / 3) / var
    assert actions.mean(dim=0).numpy() == pytest.approx(expected, abs=0.08)


def test_likelihood_improves_and_is_a_gaussians():
    short = fitted(*linear_walk(), steps=5)[1]
    long = fitted(*linear_walk(), steps=1500)[1]
    assert long["state_nll"] < short["state_nll"] - 0.3
    # The action's variance is fixed to 1 in normalised units: the floor is 0.5 log(2 pi).
    assert long["action_nll"] > 0.5 * np.log(2 * np.pi)


def test_negative_log_likelihood_by_hand():
    model, _ = fitted(*linear_walk(100), steps=1)
    states, actions, following = (torch.from_numpy(x) for x in linear_walk(50, seed=1))
    s, a = model.state_scale.normalise(following), model.action_scale.normalise(actions)
    nets = model.state_net, model.action_net
    moved = by_torch(nets[0], nets[0].flat, torch.cat([s, a], dim=1))
    mean, log_var = moved.chunk(2, dim=1)
    delta = model.delta_scale.normalise(states - following)
    state = -torch.distributions.Normal(mean, (0.5 * log_var).exp()).log_prob(delta).mean()
    acted = by_torch(nets[1], nets[1].flat, s)
    action = -torch.distributions.Normal(acted, 1.0).log_prob(a).mean()
    ours = model.negative_log_likelihood(following, actions, states - following)
    assert ours == pytest.approx((action.item(), state.item()), rel=1e-5)
    gradients = torch.autograd.grad(action + state, [net.flat for net in nets])
    for net, gradient in zip(nets, gradients, strict=True):
        assert torch.allclose(net.flat.grad, gradient, atol=1e-6)


def test_too_few_transitions_train_nothing():
    cfg = BacktrackingConfig(min_transitions=50)
    data = Transitions(2, 2, cfg)
    model = BacktrackingModel(2, 2, cfg, torch.Generator())
    data.add(*(x[:49] for x in linear_walk(49)))
    assert model.fit(data) == {}
    assert len(data.sample_states(10, np.random.default_rng(0))) == 0
    data.add(*(x[:1] for x in linear_walk(1)))
    assert set(model.fit(data)) == {"action_nll", "state_nll"}


def test_the_ring_keeps_the_newest():
    data = Transitions(1, 1, BacktrackingConfig(buffer=5, min_transitions=1))
    for i in range(0, 8, 2):
        rows = np.array([[i], [i + 1]], dtype=np.float32)
        data.add(rows, rows, rows)
    assert data.size == 5
    assert sorted(data.states[:, 0]) == [3, 4, 5, 6, 7]
    rows = np.arange(20, dtype=np.float32)[:, None]
    data.add(rows, rows, rows)
    assert sorted(data.actions[:, 0]) == [15, 16, 17, 18, 19]


def point_experience(env, n=400, steps=100):
    rng = np.random.default_rng(0)
    ids = np.arange(env.num_envs)
    env.reset(ids, np.full((len(ids), 2), 6.0))
    states, actions, following = [], [], []
    action = rng.uniform(-1, 1, (len(ids), env.act_dim))
    for t in range(steps):
        if t % 20 == 0:
            action = rng.uniform(-1, 1, action.shape)
        states.append(env.read_states(ids))
        after = env.step(ids, action).states
        actions.append(action)
        following.append(after)
    return [np.concatenate(x).astype(np.float32) for x in (states, actions, following)]


def test_traces_lead_to_their_goal_in_the_real_maze():
    """Each step of a trace, put into the simulator, arrives near the next one."""
    env = envs.make("point_umaze", 300, threads=1)
    states, actions, following = point_experience(env)
    model, _ = fitted(states, actions, following, steps=2000, batch=256)
    goals = env.maze.sample_free(100, np.random.default_rng(1))
    goals = goals[np.linalg.norm(goals, axis=1) < 1.5]
    seeds = decode(env, goals, following[::50].astype(float), 0.3, np.random.default_rng(0))
    traces = recall_traces(model, env, *seeds, length=20)
    n = len(seeds.goals)
    assert n > 5 and traces.states.shape == (20, n, 4)
    assert np.allclose(env.achieved_goals(traces.seeds), traces.goals)
    ids = np.arange(n)
    arrives = traces.seeds
    for t in range(20):
        valid = traces.valid[t]
        env.reset(ids, np.zeros((n, 2)), np.where(valid[:, None], traces.states[t], traces.seeds))
        real = env.step(ids, traces.actions[t]).states
        if valid.any():
            gap = np.linalg.norm(real - arrives, axis=1)[valid]
            assert np.median(gap) < 0.05
        arrives = traces.states[t]
    assert traces.valid[0].mean() > 0.8
    # Once invalid, always invalid; and a valid state stands in free space.
    assert not (traces.valid[1:] & ~traces.valid[:-1]).any()
    assert env.maze.is_free(traces.states[traces.valid][:, :2]).all()
    obs, trace_actions = traces.pairs(env)
    assert len(obs) == len(trace_actions) == traces.valid.sum()
    offset = traces.goals - traces.states[0, :, :2]
    first = traces.valid[0].sum()
    assert np.allclose(obs[:first, 4:], offset[traces.valid[0]], atol=1e-5)
    paths = traces.paths(env)
    assert np.isnan(paths[~traces.valid]).all() and np.isfinite(paths[traces.valid]).all()


def test_no_seeds_no_traces():
    env = envs.make("ant_umaze", 1)
    cfg = BacktrackingConfig()
    model = BacktrackingModel(env.state_dim, env.act_dim, cfg, torch.Generator())
    nothing = np.empty((0, env.state_dim)), np.empty((0, 2))
    for length in (0, 5):
        traces = recall_traces(model, env, *nothing, length)
        obs, actions = traces.pairs(env)
        assert obs.shape == (0, env.obs_dim) and actions.shape == (0, env.act_dim)
        assert traces.paths(env).shape == (length, 0, 2)


def test_ant_traces_have_unit_quaternions():
    env = envs.make("ant_umaze", 200, threads=1)
    states, actions, following = point_experience(env, steps=30)
    model, _ = fitted(states, actions, following, steps=50)
    seeds = following[:20].astype(float)
    traces = recall_traces(model, env, seeds, env.achieved_goals(seeds), length=10)
    assert np.allclose(np.linalg.norm(traces.states[..., 3:7], axis=-1), 1.0)
    assert np.abs(traces.actions).max() <= 1.0
