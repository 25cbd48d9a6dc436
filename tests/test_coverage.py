import numpy as np
import torch

from goalgan_bt import envs
from goalgan_bt.agent.coverage import coverage, success_rate
from goalgan_bt.agent.policy import GaussianPolicy
from goalgan_bt.agent.settings import PolicyConfig


def motionless(env):
    policy = GaussianPolicy(env.obs_dim, env.act_dim, PolicyConfig(hidden=(4,)))
    for p in policy.net.parameters():
        p.data.zero_()
    return policy


def test_the_floor_of_the_protocol():
    """An Ant that does not move covers the 12 of 112 tiles within 1 m; a point none."""
    ant = envs.make("ant_umaze", 112, threads=2, horizon=20)
    rate, steps = success_rate(ant, motionless(ant), ant.test_goals(), 1, None)
    assert rate.sum() == 12
    assert steps == 12 + 100 * 20  # success ends an episode
    point = envs.make("point_umaze", 112, threads=1, horizon=20)
    rate, _ = success_rate(point, motionless(point), point.test_goals(), 2, None)
    assert rate.mean() == 0.0


def test_more_attempts_than_simulations_give_the_same():
    goals = np.array([[0.35, 0.0], [0.0, 0.2], [-0.5, 0.3], [0.1, -0.2], [4.0, 4.0]])
    rates = []
    for n in (5, 2):
        env = envs.make("point_umaze", n, threads=1, horizon=60)
        torch.manual_seed(0)
        policy = GaussianPolicy(env.obs_dim, env.act_dim, PolicyConfig(hidden=(8,)))
        rates.append(success_rate(env, policy, goals, 1, None))
    assert np.array_equal(rates[0].rate, rates[1].rate)
    assert rates[0].steps == rates[1].steps
    assert rates[0].rate[1] == 1 and rates[0].rate[4] == 0


def test_stochastic_attempts_differ_and_are_averaged():
    env = envs.make("point_umaze", 64, threads=1, horizon=60)
    policy = GaussianPolicy(env.obs_dim, env.act_dim, PolicyConfig(hidden=(8,), init_std=1.0))
    noise = torch.Generator().manual_seed(0)
    rate, _ = success_rate(env, policy, np.array([[0.35, 0.0]]), 64, noise)
    assert 0 < rate[0] < 1
    assert np.isclose(rate[0] * 64 % 1, 0)


def test_both_policies_are_measured_side_by_side():
    """The attempts without noise end as those of the deterministic policy alone do."""
    env = envs.make("point_umaze", 8, threads=1, horizon=60)
    torch.manual_seed(0)
    policy = GaussianPolicy(env.obs_dim, env.act_dim, PolicyConfig(hidden=(8,), init_std=1.0))
    goals = np.array([[0.35, 0.0], [0.0, 0.2], [-0.5, 0.3], [0.1, -0.2], [4.0, 4.0]])
    found = coverage(env, policy, goals, 3, torch.Generator().manual_seed(0))
    alone = success_rate(env, policy, goals, 1, None)
    assert np.array_equal(found.deterministic, alone.rate)
    assert found.stochastic.shape == (5,) and found.stochastic[4] == 0
    assert not np.array_equal(found.stochastic, found.deterministic)
    assert set(np.round(3 * found.stochastic, 6)) <= {0.0, 1.0, 2.0, 3.0}
    assert alone.steps < found.steps <= 4 * 5 * 60
