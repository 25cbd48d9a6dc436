"""TRPO: its linear algebra against torch and finite differences, its step against sb3-contrib."""

import gymnasium
import numpy as np
import pytest
import torch
from sb3_contrib import TRPO
from stable_baselines3.common.logger import configure
from test_networks import by_torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from goalgan_bt.agent import trpo
from goalgan_bt.agent.networks import CHUNK
from goalgan_bt.agent.policy import GaussianPolicy, log_prob, mean_kl
from goalgan_bt.agent.settings import PolicyConfig, TrpoConfig


def make_policy(hidden=(4,), obs_dim=3, act_dim=2, seed=0):
    torch.manual_seed(seed)
    policy = GaussianPolicy(obs_dim, act_dim, PolicyConfig(hidden=hidden, init_std=0.7))
    with torch.no_grad():
        for p in policy.net.parameters():
            p.add_(0.3 * torch.randn_like(p))
    return policy


def make_batch(policy, n=256):
    obs = torch.randn(n, 3)
    mean, log_std = policy(obs)
    actions = (mean + log_std.exp() * torch.randn_like(mean)).detach()
    advantages = actions[:, 0] * obs[:, 1] + 0.1 * torch.randn(n)
    return obs, actions, advantages


def params_of(policy):
    return [*policy.net.parameters(), policy.log_std]


def test_conjugate_gradient_solves():
    torch.manual_seed(0)
    root = torch.randn(12, 12, dtype=torch.float64)
    matrix, b = root @ root.T + torch.eye(12), torch.randn(12, dtype=torch.float64)
    x = trpo.conjugate_gradient(lambda v: matrix @ v, b, iters=30)
    assert torch.allclose(x, torch.linalg.solve(matrix, b), atol=1e-8)


def test_conjugate_gradient_stops_at_a_direction_without_curvature():
    indefinite = torch.diag(torch.tensor([1.0, -1.0]))
    x = trpo.conjugate_gradient(lambda v: indefinite @ v, torch.tensor([1.0, 1.0]), iters=10)
    assert torch.isfinite(x).all()


def test_fisher_vector_product_is_the_hessian_of_the_kl():
    """Against the explicit Hessian and against finite differences of the KL's gradient."""
    policy = make_policy().double()
    obs = torch.randn(20, 3, dtype=torch.float64)
    params = params_of(policy)
    start = parameters_to_vector(params).detach()
    old_mean, old_log_std = (x.detach() for x in policy(obs))

    def kl_of(flat):
        mean, log_std = by_torch(policy.net, flat[:-2], obs), flat[-2:]
        return mean_kl(old_mean, old_log_std, mean, log_std)

    hessian = torch.autograd.functional.hessian(kl_of, start)
    product = trpo.fisher_vector_product(policy, obs, damping=0.0)
    for _ in range(3):
        v = torch.randn_like(start)
        assert torch.allclose(product(v), hessian @ v, atol=1e-9)
        gradient = torch.func.grad(kl_of)
        h = 1e-5
        numeric = (gradient(start + h * v) - gradient(start - h * v)) / (2 * h)
        assert torch.allclose(product(v), numeric, atol=1e-6)
    damped = trpo.fisher_vector_product(policy, obs, damping=0.5)
    assert torch.allclose(damped(v), hessian @ v + 0.5 * v)


def test_a_standard_deviation_on_its_floor_has_no_curvature():
    policy = GaussianPolicy(3, 2, PolicyConfig(hidden=(4,), init_std=0.5, min_std=0.5))
    policy.log_std.data[1] -= 1.0
    product = trpo.fisher_vector_product(policy, torch.randn(8, 3), damping=0.0)
    v = torch.zeros(sum(p.numel() for p in params_of(policy)))
    v[-2:] = 1.0
    assert product(v)[-2:].tolist() == [2.0, 0.0]


def test_the_surrogates_gradient_is_autograds():
    """Over several pieces of the batch, and with one standard deviation held by its bound."""
    torch.manual_seed(0)
    cfg = PolicyConfig(hidden=(5, 4), init_std=0.7, min_std=0.5)
    policy = GaussianPolicy(3, 2, cfg).double()
    with torch.no_grad():
        policy.net.flat += 0.3 * torch.randn_like(policy.net.flat)
        policy.log_std[1] = -3.0
    n = 2 * CHUNK + 7
    obs, actions = torch.randn(n, 3).double(), torch.randn(n, 2).double()
    advantages = torch.randn(n).double()
    means, gradient = trpo.surrogate_gradient(policy, obs, actions, advantages)
    mean, log_std = by_torch(policy.net, policy.net.flat, obs), policy.bounded_log_std()
    logp = log_prob(mean, log_std, actions)
    surrogate = (torch.exp(logp - logp.detach()) * advantages).mean()
    expected = torch.autograd.grad(surrogate, params_of(policy))
    assert torch.allclose(means, mean)
    assert torch.allclose(gradient, torch.cat(expected))
    assert gradient[-1] == 0 and gradient[-2] != 0


@pytest.mark.parametrize("seed", range(5))
def test_update_raises_the_surrogate_within_the_bound(seed):
    policy = make_policy((32, 32), seed=seed)
    obs, actions, advantages = make_batch(policy)
    old_mean, old_log_std = (x.detach().clone() for x in policy(obs))
    old_logp = log_prob(old_mean, old_log_std, actions)
    cfg = TrpoConfig(max_kl=0.02, fisher_fraction=1.0, cg_damping=1e-3)
    stats = trpo.update(policy, obs, actions, advantages, cfg)
    assert stats["accepted"] == 1
    mean, log_std = policy(obs)
    kl = mean_kl(old_mean, old_log_std, mean, log_std).item()
    assert 0.002 < kl <= 0.02 and kl == pytest.approx(stats["kl"])
    scaled = (advantages - advantages.mean()) / advantages.std()
    gain = ((torch.exp(log_prob(mean, log_std, actions) - old_logp) - 1) * scaled).mean().item()
    assert gain > 0 and gain == pytest.approx(stats["surrogate"], rel=1e-3)


def test_a_rejected_update_leaves_every_bit():
    policy = make_policy()
    obs, actions, advantages = make_batch(policy)
    before = parameters_to_vector(params_of(policy)).clone()
    no_steps = TrpoConfig(line_search_steps=0)
    assert trpo.update(policy, obs, actions, advantages, no_steps)["accepted"] == 0
    assert torch.equal(before, parameters_to_vector(params_of(policy)))
    advantages[3] = float("nan")
    stats = trpo.update(policy, obs, actions, advantages, TrpoConfig())
    assert stats["nonfinite"] == 1 and stats["accepted"] == 0
    assert torch.equal(before, parameters_to_vector(params_of(policy)))


def test_line_search_checks_both_gain_and_kl():
    start, step = torch.zeros(1), torch.ones(1)

    def search(evaluate):
        found = trpo.line_search(evaluate, start, step, max_kl=0.1, steps=5, decay=0.5)
        return None if found is None else found[0].item()

    assert search(lambda x: (1.0, 0.05)) == 1.0
    assert search(lambda x: (1.0, 0.4 * x.item())) == 0.25  # KL too large before
    assert search(lambda x: (0.3 - x.item(), 0.0)) == 0.25  # no gain before
    assert search(lambda x: (-1.0, 0.0)) is None
    assert search(lambda x: (float("nan"), float("nan"))) is None


class WithInput(torch.nn.Module):
    """A network's output with its input beside it."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, x):
        return torch.cat([self.net(x), x], dim=1)


class Sum(torch.nn.Module):
    """A layer of what `WithInput` gave first plus a layer of what it put beside it."""

    def __init__(self, head, linear):
        super().__init__()
        self.head, self.linear = head, linear

    def forward(self, x):
        n = self.head.in_features
        return self.head(x[:, :n]) + self.linear(x[:, n:])


def test_same_direction_and_same_step_as_sb3_contrib():
    n, max_kl = 512, 0.01
    spaces = gymnasium.spaces

    class Nothing(gymnasium.Env):
        observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        action_space = spaces.Box(-1, 1, (2,), np.float32)

        def reset(self, **_):
            return np.zeros(3, np.float32), {}

    theirs = TRPO(
        "MlpPolicy",
        Nothing(),
        n_steps=n,
        batch_size=n,
        target_kl=max_kl,
        cg_max_steps=10,
        cg_damping=0.1,
        line_search_shrinking_factor=0.8,
        n_critic_updates=0,
        policy_kwargs={"net_arch": [16, 16]},
        seed=0,
        device="cpu",
    )
    ours = make_policy((16, 16))
    # They have no linear map beside the MLP: it is given to their network.
    body, head = theirs.policy.mlp_extractor.policy_net, theirs.policy.action_net
    theirs.policy.mlp_extractor.policy_net = WithInput(body)
    theirs.policy.action_net = Sum(head, torch.nn.Linear(3, 2, bias=False))
    their_params = [
        *theirs.policy.mlp_extractor.policy_net.parameters(),
        *theirs.policy.action_net.parameters(),
        theirs.policy.log_std,
    ]
    with torch.no_grad():
        vector_to_parameters(parameters_to_vector(params_of(ours)), their_params)
    obs, actions, advantages = make_batch(ours, n)
    mean, log_std = ours(obs)
    buffer = theirs.rollout_buffer
    buffer.reset()
    buffer.observations[:, 0] = obs.numpy()
    buffer.actions[:, 0] = actions.numpy()
    buffer.advantages[:, 0] = advantages.numpy()
    buffer.log_probs[:, 0] = log_prob(mean, log_std, actions).detach().numpy()
    buffer.full = True
    theirs.set_logger(configure(None, []))

    before = parameters_to_vector(params_of(ours)).detach().clone()
    # Their KL is a mean over action dimensions where ours is the sum: twice theirs here.
    cfg = TrpoConfig(
        max_kl=2 * max_kl, cg_iters=10, cg_damping=0.2, fisher_fraction=1.0, line_search_decay=0.8
    )
    stats = trpo.update(ours, obs, actions, advantages, cfg)
    theirs.train()

    step = parameters_to_vector(params_of(ours)).detach() - before
    their_step = parameters_to_vector(their_params).detach() - before
    assert stats["accepted"] == 1
    cosine = torch.nn.functional.cosine_similarity(step, their_step, dim=0).item()
    assert cosine > 0.999
    assert step.norm().item() == pytest.approx(their_step.norm().item(), rel=0.01)
    assert stats["kl"] == pytest.approx(
        2 * theirs.logger.name_to_value["train/kl_divergence_loss"], rel=0.05
    )
