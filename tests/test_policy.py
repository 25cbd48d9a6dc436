import math

import numpy as np
import pytest
import torch
from gymnasium.wrappers.utils import RunningMeanStd

from goalgan_bt.agent.policy import (
    Actor,
    GaussianPolicy,
    Normaliser,
    ValueFunction,
    log_prob,
    mean_kl,
)
from goalgan_bt.agent.settings import PolicyConfig, ValueConfig


def test_the_normaliser_is_gymnasiums():
    rng = np.random.default_rng(0)
    ours, theirs = Normaliser(3), RunningMeanStd(epsilon=0.0, shape=(3,))
    for n in (5, 200, 31):
        batch = rng.normal([1, -2, 100], [1, 5, 0.1], (n, 3))
        ours.update(torch.from_numpy(batch))
        theirs.update(batch)
    assert np.allclose(ours.mean, theirs.mean) and np.allclose(ours.var, theirs.var)
    normalised = ours(torch.tensor([[1.0, -2.0, 1e6]]))
    assert normalised.abs().max() == 5.0  # clipped


def test_log_prob_and_kl_are_torchs():
    torch.manual_seed(0)
    mean, other = torch.randn(50, 3), torch.randn(50, 3)
    log_std, other_log_std = 0.3 * torch.randn(3), 0.3 * torch.randn(3)
    p = torch.distributions.Normal(mean, log_std.exp())
    q = torch.distributions.Normal(other, other_log_std.exp())
    actions = torch.randn(50, 3)
    assert torch.allclose(log_prob(mean, log_std, actions), p.log_prob(actions).sum(-1), atol=1e-4)
    kl = torch.distributions.kl_divergence(p, q).sum(-1).mean()
    assert mean_kl(mean, log_std, other, other_log_std).item() == pytest.approx(kl.item(), rel=1e-5)


def test_the_std_stays_between_its_bounds():
    cfg = PolicyConfig(hidden=(4,), init_std=0.5, final_std=0.1, min_std=0.05)
    policy, obs = GaussianPolicy(2, 1, cfg), torch.zeros(1, 2)
    for progress, std in ((0.0, 0.5), (0.5, 0.3), (1.0, 0.1), (2.0, 0.1)):
        policy.cap_std(progress)
        assert policy(obs)[1].exp().item() == pytest.approx(std)
    policy.log_std.data.fill_(math.log(1e-3))
    assert policy(obs)[1].exp().item() == pytest.approx(0.05)
    free = GaussianPolicy(2, 1, PolicyConfig(hidden=(4,), init_std=0.5))
    free.cap_std(1.0)
    free.log_std.data.fill_(1.0)
    assert free(obs)[1].item() == 1.0


def test_actions_have_the_policys_mean_and_std():
    policy = GaussianPolicy(2, 2, PolicyConfig(hidden=(4,), init_std=0.5))
    obs = np.tile(np.array([[0.3, -1.0]], np.float32), (20_000, 1))
    policy.normaliser.update(torch.randn(100, 2) + 3)
    act = Actor(policy)
    noisy = act(obs, torch.randn(20_000, 2, generator=torch.Generator().manual_seed(0)))
    still = act(obs, None)
    mean, _ = policy(policy.normaliser(torch.from_numpy(obs)))
    assert np.allclose(still, mean.detach(), atol=1e-6)
    assert np.allclose(still, still[0])
    assert np.allclose(noisy.mean(axis=0), still[0], atol=0.02)
    assert np.allclose(noisy.std(axis=0), 0.5, atol=0.02)


def test_values_regress_on_returns():
    torch.manual_seed(0)
    value = ValueFunction(3, ValueConfig(hidden=(32,), epochs=30, minibatch=64))
    obs = torch.randn(512, 3)
    returns = torch.tanh(obs[:, 0] - obs[:, 1])
    generator = torch.Generator().manual_seed(0)
    first = value.fit(obs, returns, generator)["loss"]
    assert value.fit(obs, returns, generator)["loss"] < 0.5 * first
    assert value(obs).shape == (512,)
