"""The backtracking model on systems whose reverse is known, and its traces in the real mazes."""

import numpy as np
import pytest
import torch
from test_networks import by_torch

from goalgan_bt import envs
from goalgan_bt.recall.backtracking import BacktrackingModel
from goalgan_bt.recall.consistency import consistency
from goalgan_bt.recall.decoder import decode
from goalgan_bt.recall.settings import BacktrackingConfig
from goalgan_bt.recall.traces import Traces, recall_traces
from goalgan_bt.recall.transitions import Transitions


def fitted(states, actions, next_states, steps=1500, **settings):
    torch.manual_seed(0)
    cfg = BacktrackingConfig(steps=steps, hidden=(64, 64), min_transitions=1, **settings)
    dims = states.shape[1], actions.shape[1]
    model = BacktrackingModel(*dims, 2, cfg, generator=torch.Generator().manual_seed(0))
    return model, model.fit(states, actions, next_states, np.zeros((len(states), 2)))


def learn(model, data):
    """As the maze learner does."""
    if not data.enough:
        return {}
    rows = slice(data.size)
    parts = data.states[rows], data.actions[rows], data.next_states[rows], data.goals[rows]
    return model.fit(*parts, unseen=data.unseen())


def episode(states, actions, next_states):
    """Those transitions as one episode towards goals of zero."""
    n = len(states)
    return states, actions, next_states, np.zeros((n, 2), np.float32), np.arange(n)[::-1]


def unrolled(model, env, seeds, goals, length):
    return recall_traces(model, seeds, length, goals, valid=env.valid, repair=env.repair)


def linear_walk(n=20_000, seed=0):
    """s' = s + 0.5 a + noise, with a ~ U(-1, 1) and s ~ N(0, 1)."""
    rng = np.random.default_rng(seed)
    states = rng.normal(0, 1, (n, 2)).astype(np.float32)
    actions = rng.uniform(-1, 1, (n, 2)).astype(np.float32)
    noise = rng.normal(0, 0.1, (n, 2)).astype(np.float32)
    return states, actions, states + 0.5 * actions + noise


@pytest.fixture(scope="module")
def walked():
    """A model of that walk, and what its last training told."""
    return fitted(*linear_walk())


def test_it_recovers_the_reverse_of_a_linear_gaussian_walk(walked):
    model, _ = walked
    torch.manual_seed(1)
    following = torch.tensor([[1.0, -0.5]]).repeat(4000, 1)
    before, actions = model.predecessors(following, torch.zeros(4000, 2))
    # Given a, s = s' - 0.5 a up to N(0, 0.1^2) (and a slight pull to the prior).
    error = (before - (following - 0.5 * actions)).numpy()
    assert np.abs(error.mean(axis=0)).max() < 0.05
    assert error.std(axis=0) == pytest.approx([0.1, 0.1], rel=0.3)
    # Actions that led to a large s' were more likely positive: E[a | s'] = s' Cov / Var.
    var = 1 + 0.25 / 3 + 0.01
    expected = np.array([1.0, -0.5]) * (0.5 / 3) / var
    assert actions.mean(dim=0).numpy() == pytest.approx(expected, abs=0.08)


def test_likelihood_improves_and_is_a_gaussians(walked):
    short, long = fitted(*linear_walk(), steps=5)[1], walked[1]
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
    goals = torch.zeros(50, 2)
    ours = model.negative_log_likelihood(following, actions, states - following, goals)
    assert ours == pytest.approx((action.item(), state.item()), rel=1e-5)
    gradients = torch.autograd.grad(action + state, [net.flat for net in nets])
    for net, gradient in zip(nets, gradients, strict=True):
        assert torch.allclose(net.flat.grad, gradient, atol=1e-6)


def test_too_few_transitions_train_nothing():
    cfg = BacktrackingConfig(min_transitions=50)
    data = Transitions(2, 2, 2, cfg)
    model = BacktrackingModel(2, 2, 2, cfg, generator=torch.Generator())
    data.add(*episode(*linear_walk(49)))
    assert learn(model, data) == {}
    assert [len(rows) for rows in data.sample(10, np.random.default_rng(0))] == [0, 0]
    data.add(*episode(*linear_walk(1)))
    assert set(learn(model, data)) == {"action_nll", "state_nll"}


def test_the_ring_keeps_the_newest():
    data = Transitions(1, 1, 1, BacktrackingConfig(buffer=5, min_transitions=1))
    for i in range(0, 8, 2):
        rows = np.array([[i], [i + 1]], dtype=np.float32)
        data.add(rows, rows, rows, rows, rows[:, 0])
    assert data.size == 5 and data.added == 8
    assert sorted(data.states[:, 0]) == [3, 4, 5, 6, 7]
    assert data.states[data.newest(3), 0].tolist() == [5, 6, 7]
    assert data.left[data.newest(9)].tolist() == [3, 4, 5, 6, 7]
    rows = np.arange(20, dtype=np.float32)[:, None]
    data.add(rows, rows, rows, rows, rows[:, 0])
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
    traces = unrolled(model, env, seeds.states, seeds.goals, 20)
    n = len(seeds.goals)
    assert n > 5 and traces.states.shape == (20, n, 4)
    assert np.allclose(env.achieved_goals(traces.seeds), traces.goals)
    found = consistency(env, traces)
    assert np.array_equal(np.isfinite(found.gap), traces.valid)
    assert np.nanmedian(found.gap, axis=1).max() < 0.02
    assert traces.valid.sum() < found.steps <= 2 * traces.valid.sum()
    assert traces.valid[0].mean() > 0.8
    # Once invalid, always invalid; and a valid state stands in free space.
    assert not (traces.valid[1:] & ~traces.valid[:-1]).any()
    assert env.maze.is_free(traces.states[traces.valid][:, :2]).all()
    obs, trace_actions = traces.steps(env, False, np.random.default_rng(0)).lesson(env)
    assert len(obs) == len(trace_actions) == traces.valid.sum()
    offset = traces.goals - traces.states[0, :, :2]
    first = traces.valid[0].sum()
    assert np.allclose(obs[:first, 4:], offset[traces.valid[0]], atol=1e-5)
    paths = traces.paths(env)
    assert np.isnan(paths[~traces.valid]).all() and np.isfinite(paths[traces.valid]).all()


def test_no_seeds_no_traces():
    env = envs.make("ant_umaze", 1)
    cfg = BacktrackingConfig()
    model = BacktrackingModel(env.state_dim, env.act_dim, 2, cfg)
    nothing = np.empty((0, env.state_dim)), np.empty((0, 2))
    for length in (0, 5):
        traces = unrolled(model, env, *nothing, length)
        rng = np.random.default_rng(0)
        for relabel in (False, True):
            obs, actions = traces.steps(env, relabel, rng).lesson(env)
            assert obs.shape == (0, env.obs_dim) and actions.shape == (0, env.act_dim)
        assert consistency(env, traces).metrics() == {}
        obs, actions = traces.steps(env, False, rng).lesson(env)
        assert obs.shape == (0, env.obs_dim) and actions.shape == (0, env.act_dim)
        assert traces.paths(env).shape == (length, 0, 2)


def test_ant_traces_have_unit_quaternions():
    env = envs.make("ant_umaze", 200, threads=1)
    states, actions, following = point_experience(env, steps=30)
    model, _ = fitted(states, actions, following, steps=50)
    seeds = following[:20].astype(float)
    traces = unrolled(model, env, seeds, env.achieved_goals(seeds), 10)
    assert np.allclose(np.linalg.norm(traces.states[..., 3:7], axis=-1), 1.0)
    assert np.abs(traces.actions).max() <= 1.0


def test_consistency_by_hand():
    """A trace made by the simulator itself has no gap and arrives; a shifted one has its shift."""
    env = envs.make("point_umaze", 3, threads=1)
    ids = np.arange(3)
    env.reset(ids, np.zeros((3, 2)))
    states, actions = [env.read_states(ids)], np.full((30, 3, 2), [1.0, 0.0])
    for action in actions:
        env.advance(ids, action)
        states.append(env.read_states(ids))
    states = np.array(states)
    goals = env.achieved_goals(states[-1])
    valid = np.ones((30, 3), bool)
    valid[20:, 1] = False  # a trace that stopped early
    backward = states[-2::-1].copy()
    backward[:, 2, 1] += 0.5  # beside the others: the last step misses the goal by that much
    traces = Traces(backward, actions, valid, goals, states[-1])
    found = consistency(env, traces)
    assert found.gap[:, 0] == pytest.approx(np.zeros(30), abs=1e-9)
    assert np.isnan(found.gap[20:, 1]).all() and found.gap[:20, 1].max() < 1e-9
    assert found.gap[:, 2] == pytest.approx([0.5] + [0] * 29, abs=1e-9)
    assert found.arrived.tolist() == [True, True, False]
    step = np.linalg.norm(states[30] - states[29], axis=1)[0]
    assert found.moved[0, 0] == pytest.approx(step, abs=0.1)
    # A trace that begins on its goal proves nothing.
    near = Traces(backward[:3], actions[:3], valid[:3], goals, states[-1])
    assert len(consistency(env, near).arrived) == 1  # the one beside the others
    metrics = found.metrics()
    assert metrics["arrived"] == pytest.approx(2 / 3)
    assert metrics["gap"] == pytest.approx(0.5 / 80)


def test_relabelled_steps_of_a_trace_lead_to_a_later_place_of_it():
    env = envs.make("point_umaze", 1)
    length, n = 5, 400
    states = np.zeros((length, n, 4))
    states[..., 0] = -np.arange(1, length + 1)[:, None]  # x = -1 just before the goal at 0
    states[..., 1] = np.arange(n)  # tells the traces apart
    goals = np.stack([np.zeros(n), np.arange(n)], axis=1)
    valid = np.ones((length, n), bool)
    traces = Traces(states, np.zeros((length, n, 2)), valid, goals, states[0])
    rng = np.random.default_rng(0)
    plain, later = (traces.steps(env, relabel, rng) for relabel in (False, True))
    assert (plain.goals[:, 0] == 0).all()
    assert np.array_equal(later.goals[:, 1], later.states[:, 1])  # of the same trace
    ahead = later.goals[:, 0] - later.states[:, 0]
    first = later.states[:, 0] == -length
    assert ahead.min() == 1 and set(ahead[first]) == {1, 2, 3, 4, 5}


def test_last_steps_of_real_successes():
    env = envs.make("point_umaze", 1)
    data = Transitions(4, 2, 2, BacktrackingConfig(buffer=12, min_transitions=1))
    for episode_length, goal in ((7, 1.0), (6, 2.0)):  # the first one's head is overwritten
        steps = np.arange(episode_length, dtype=np.float32)
        states = np.stack([steps, np.full_like(steps, goal), 0 * steps, 0 * steps], axis=1)
        after = states + np.array([1, 0, 0, 0])
        goals = np.full((episode_length, 2), [episode_length, goal], np.float32)
        data.add(states, np.zeros((episode_length, 2)), after, goals, steps[::-1])
    rng = np.random.default_rng(0)
    own = data.last_steps(env, 100, 3, False, rng)
    assert sorted(map(tuple, own.states[:, :2])) == [(3, 2), (4, 1), (4, 2), (5, 1), (5, 2), (6, 1)]
    assert set(map(tuple, own.goals)) == {(7, 1), (6, 2)}
    for _ in range(20):
        later = data.last_steps(env, 100, 12, True, rng)
        assert len(later.states) == 12
        ahead = later.goals - later.states[:, :2]
        assert (ahead[:, 1] == 0).all() and ahead[:, 0].min() >= 1
    assert len(data.last_steps(env, 4, 12, True, rng).states) == 4


def test_a_conditioned_model_tells_goals_apart():
    """The action depends on the goal alone: only the conditioned model can know it."""
    rng = np.random.default_rng(0)
    states = rng.normal(size=(4000, 2)).astype(np.float32)
    goals = rng.choice([-1.0, 1.0], size=(4000, 2)).astype(np.float32)
    losses = {}
    for conditioned in (False, True):
        cfg = BacktrackingConfig(steps=600, min_transitions=1, conditioned=conditioned)
        torch.manual_seed(0)
        model = BacktrackingModel(2, 2, 2, cfg, generator=torch.Generator().manual_seed(0))
        fitted = model.fit(states, 0.5 * goals, states + 0.1, goals)
        losses[conditioned] = fitted["action_nll"]
    assert losses[False] > 1.3 and losses[True] < 1.1  # floors: 1.42 and 0.92


def test_held_out_likelihood_is_of_what_is_new():
    states, actions, following = linear_walk(4000)
    cfg = BacktrackingConfig(steps=300, min_transitions=1)
    model = BacktrackingModel(2, 2, 2, cfg, generator=torch.Generator().manual_seed(0))
    data = Transitions(2, 2, 2, cfg)
    data.add(*episode(states, actions, following))
    assert "held_out_state_nll" not in learn(model, data)  # all is new
    assert "held_out_state_nll" not in learn(model, data)  # nothing is
    data.add(*episode(*linear_walk(500, seed=1)))
    alike = learn(model, data)["held_out_state_nll"]
    far = linear_walk(500, seed=2)
    data.add(*episode(far[0] + 3, far[1], far[2] - 3))
    assert learn(model, data)["held_out_state_nll"] > alike + 1


def test_an_untrained_model_only_learns_the_scales():
    states, actions, following = linear_walk(500)
    before, _ = fitted(states, actions, following, steps=0)
    torch.manual_seed(0)
    fresh = BacktrackingModel(2, 2, 2, before.cfg, generator=torch.Generator())
    assert torch.equal(before.state_net.flat, fresh.state_net.flat)
    assert not torch.equal(before.state_scale.std, fresh.state_scale.std)
