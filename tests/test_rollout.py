"""Rollouts on the real environment: every value in its slot, every end where it belongs."""

import numpy as np
import pytest
import torch

from goalgan_bt import envs
from goalgan_bt.agent.policy import GaussianPolicy
from goalgan_bt.agent.rollout import Collector
from goalgan_bt.agent.settings import PolicyConfig, RolloutConfig


def make(
    name="point_umaze", n=16, steps=40, chain=0.0, horizon=25, seed=0, keep="successes", patience=0
):
    torch.manual_seed(seed)
    env = envs.make(name, n, threads=1, horizon=horizon)
    policy = GaussianPolicy(env.obs_dim, env.act_dim, PolicyConfig(hidden=(8,), init_std=1.0))
    cfg = RolloutConfig(num_envs=n, steps=steps, chain=chain, patience=patience)
    noise = torch.Generator().manual_seed(seed)
    rng = np.random.default_rng(seed)
    return env, policy, Collector(env, cfg, rng, noise, keep)


NEAR = np.array([[0.35, 0.0], [0.0, 0.4], [-0.4, 0.0]])


@pytest.mark.parametrize("chain", [0.0, 1.0])
def test_observations_follow_from_each_other(chain):
    """obs[t + 1] is what the physics makes of obs[t] and actions[t], unless an episode ended."""
    env, policy, collector = make(chain=chain)
    collector.begin(NEAR)
    rollouts, _ = collector.collect(policy, NEAR)
    ended = rollouts.terminated | rollouts.truncated
    assert ended.any() and not ended.all()
    twin = envs.make("point_umaze", 1, threads=1)
    following = np.concatenate([rollouts.obs[1:], rollouts.last_obs[None]])
    truncated = iter(rollouts.truncated_obs)
    for t, n in np.ndindex(*rollouts.rewards.shape):
        before, goal = rollouts.obs[t, n, :4], rollouts.obs[t, n, :2] + rollouts.obs[t, n, 4:]
        twin.reset(np.array([0]), goal[None].astype(float), before[None].astype(float))
        step = twin.step(np.array([0]), rollouts.actions[t, n][None])
        states = step.states
        expected = twin.observations(states, goal[None])[0]
        if rollouts.truncated[t, n]:
            assert next(truncated) == pytest.approx(expected, abs=1e-4)
        elif not ended[t, n]:
            assert following[t, n] == pytest.approx(expected, abs=1e-4)
        elif not chain:
            assert following[t, n, :4] == pytest.approx(env.start_state)
        else:
            assert following[t, n, :4] == pytest.approx(expected[:4], abs=1e-4)
        assert step.rewards[0] == rollouts.rewards[t, n]


@pytest.mark.parametrize("chain", [0.0, 1.0])
def test_each_action_begins_where_the_last_one_ended_unless_an_episode_did(chain):
    _, policy, collector = make(chain=chain)
    collector.begin(NEAR)
    for _ in range(2):
        rollouts, _ = collector.collect(policy, NEAR)
        places, offsets = rollouts.obs[..., :2], rollouts.obs[..., 4:6]
        assert rollouts.origins == pytest.approx(places, abs=1e-6)
        assert rollouts.goals == pytest.approx(places + offsets, abs=1e-5)
        ended = (rollouts.terminated | rollouts.truncated)[:-1]
        follows = (rollouts.origins[1:] == rollouts.achieved[:-1]).all(axis=2)
        assert follows[~ended].all() and ended.any()
        assert follows[ended].all() == bool(chain)


def test_next_values_put_each_value_into_its_slot():
    _, policy, collector = make()
    collector.begin(NEAR)
    rollouts, _ = collector.collect(policy, NEAR)
    value = lambda obs: obs[..., 0] + 10 * obs[..., 1]  # noqa: E731
    values = value(rollouts.obs)
    following = rollouts.next_values(values, value)
    going = ~(rollouts.terminated | rollouts.truncated)
    assert np.array_equal(following[:-1][going[:-1]], values[1:][going[:-1]])
    assert np.array_equal(following[rollouts.truncated], value(rollouts.truncated_obs))
    assert np.array_equal(following[-1][going[-1]], value(rollouts.last_obs)[going[-1]])


def test_episodes_are_complete_and_their_transitions_real():
    """Across several batches: lengths add up, successes end on their goal, s + a -> s'."""
    env, policy, collector = make(steps=10, horizon=60)
    collector.begin(NEAR)
    total, lengths, found = 0, 0, []
    for _ in range(12):
        rollouts, episodes = collector.collect(policy, NEAR)
        total += rollouts.rewards.size
        lengths += episodes.lengths.sum()
        assert episodes.from_start.all()
        assert len(episodes.states) == episodes.lengths[episodes.success].sum()
        ends = np.cumsum(episodes.lengths[episodes.success]) - 1
        arrived = episodes.next_states[ends, :2]
        gap = np.linalg.norm(arrived - episodes.goals[episodes.success], axis=1)
        assert (gap < env.success_radius + 1e-5).all()
        starts = ends + 1 - episodes.lengths[episodes.success]
        assert np.allclose(episodes.states[starts], env.start_state)
        found.append(episodes)
    assert lengths + env.elapsed.sum() == total  # no step lost, none counted twice
    states, actions, following = (
        np.concatenate([getattr(e, name) for e in found])
        for name in ("states", "actions", "next_states")
    )
    assert len(states) > 100 and np.abs(actions).max() <= 1
    twin = envs.make("point_umaze", len(states), threads=1)
    ids = np.arange(len(states))
    twin.reset(ids, np.zeros((len(ids), 2)), states.astype(float))
    real = twin.step(ids, actions).states
    assert np.allclose(real, following, atol=1e-4)


def test_failures_are_kept_where_they_are_wanted_but_falls_never():
    env, policy, collector = make("ant_umaze", n=32, steps=150, horizon=100, keep="all")
    collector.begin(np.array([[4.0, 4.0]]))
    rollouts, episodes = collector.collect(policy, np.array([[4.0, 4.0]]))
    fell = rollouts.terminated & (rollouts.rewards == 0)
    assert fell.sum() == (~episodes.kept).sum() > 0 and not episodes.success.any()
    assert episodes.kept.sum() == rollouts.truncated.sum() > 0
    lengths = episodes.lengths[episodes.kept]
    assert len(episodes.states) == lengths.sum()
    last = episodes.next_states[np.cumsum(lengths) - 1].astype(float)
    assert np.allclose(env.achieved_goals(last), episodes.ends[episodes.kept], atol=1e-4)


def test_chained_episodes_begin_where_the_last_one_ended():
    _, policy, collector = make(chain=1.0, horizon=10, steps=35)
    far = np.array([[4.0, 4.0]])
    collector.begin(far)
    rollouts, episodes = collector.collect(policy, far)
    assert rollouts.truncated.sum() == 3 * 16
    assert episodes.from_start.sum() == 16  # only the first of each simulation
    assert np.abs(rollouts.obs[11:, :, :2]).max() > 0.01  # nobody was put back


def test_an_episode_that_comes_no_nearer_along_the_way_is_over():
    def longest(heading):
        env, policy, collector = make(n=2, steps=45, horizon=40, patience=10)
        env.heading = heading
        collector.begin(NEAR + 4)
        return collector.collect(policy, NEAR + 4)[1].lengths.max()

    left = iter(range(1000, 0, -1))
    assert longest(None) == 40  # nobody knows a way
    assert longest(lambda places, goals: np.ones_like(places)) == 11  # the first comes nearer
    assert longest(lambda places, goals: np.full_like(places, next(left))) == 40


def test_an_ant_that_fell_is_never_chained():
    env, policy, collector = make("ant_umaze", n=32, steps=150, chain=1.0, horizon=500)
    far = np.array([[4.0, 4.0]])
    collector.begin(far)
    rollouts, _ = collector.collect(policy, far)
    fell = rollouts.terminated & (rollouts.rewards == 0)
    assert fell.any()
    after = np.concatenate([rollouts.obs[1:], rollouts.last_obs[None]])[fell]
    assert np.allclose(after[:, :29], env.start_state, atol=1e-6)


def test_same_seed_same_rollouts():
    results = []
    for seed in (0, 0, 1):
        _, policy, collector = make(seed=seed, chain=0.5)
        collector.begin(NEAR)
        rollouts, _ = collector.collect(policy, NEAR)
        results.append(rollouts.obs.copy())
    assert np.array_equal(results[0], results[1])
    assert not np.array_equal(results[0], results[2])


def test_paths_follow_the_body_and_break_where_an_episode_ends():
    env, policy, collector = make(horizon=10, steps=25)
    collector.begin(np.full((1, 2), 100.0))  # out of reach: episodes end by time alone
    rollouts, _ = collector.collect(policy, np.full((1, 2), 100.0))
    paths = rollouts.paths(3)
    ended = np.isnan(paths).any(axis=2)
    assert paths.shape == (25, 3, 2)
    assert (np.flatnonzero(ended[:, 0]) == [10, 20]).all()
    assert np.allclose(paths[:9, 0], rollouts.obs[1:10, 0, :2], atol=1e-6)
    assert np.allclose(paths[-1, 0], env.read_states(np.arange(3))[0, :2], atol=1e-6)
