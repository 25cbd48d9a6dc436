import pytest
import torch
from test_networks import by_torch

from goalgan_bt.agent.policy import GaussianPolicy, log_prob, mean_kl
from goalgan_bt.agent.settings import PolicyConfig
from goalgan_bt.recall.imitation import Imitation, imitate_within
from goalgan_bt.recall.settings import ImitationConfig


def make(**settings):
    torch.manual_seed(0)
    policy = GaussianPolicy(4, 2, PolicyConfig(hidden=(32,)))
    return policy, Imitation(policy, ImitationConfig(**settings), torch.Generator().manual_seed(0))


def test_recalled_actions_become_likelier_and_the_std_stays():
    policy, imitation = make(steps=200, learning_rate=1e-2, max_kl=100.0)
    obs = torch.randn(300, 4)
    actions = torch.stack([obs[:, 0], -obs[:, 1]], dim=1).clamp(-1, 1)
    before = log_prob(*policy(obs), actions).mean().item()
    std = policy.log_std.clone()
    stats = imitation.update(obs, actions, obs, 0.0)
    assert stats["steps"] == 200
    assert -stats["loss"] == pytest.approx(before, abs=0.2)
    assert log_prob(*policy(obs), actions).mean().item() > before + 0.3
    assert torch.equal(std, policy.log_std)


def test_the_kl_bound_holds_and_says_so():
    policy, imitation = make(steps=200, learning_rate=1e-3, max_kl=0.01)
    obs, reference = torch.randn(300, 4), torch.randn(500, 4)
    mean, log_std = (x.detach().clone() for x in policy(reference))
    stats = imitation.update(obs, torch.ones(300, 2), reference, 0.5)
    kl = mean_kl(mean, log_std, *policy(reference)).item()
    assert 0 < stats["steps"] < 200
    assert 0 < kl <= 0.01 and stats["kl"] == pytest.approx(kl)


def test_no_traces_change_nothing():
    policy, imitation = make()
    before = [p.clone() for p in policy.parameters()]
    nothing = torch.empty(0, 4), torch.empty(0, 2), torch.randn(5, 4)
    assert imitation.update(*nothing, 0.0) == {}
    assert all(torch.equal(a, b) for a, b in zip(before, policy.parameters(), strict=True))


def test_the_bound_fades_on_a_line():
    policy, imitation = make(max_kl=0.02, fade=0.4)
    bounds = [imitation.max_kl(progress) for progress in (0.0, 0.1, 0.2, 0.4, 1.5)]
    assert bounds == pytest.approx([0.02, 0.015, 0.01, 0.0, 0.0])
    obs, before = torch.randn(300, 4), policy.net.flat.clone()
    assert imitation.update(obs, torch.ones(300, 2), obs, 0.4) == {}
    assert torch.equal(before, policy.net.flat)
    assert imitation.update(obs, torch.ones(300, 2), obs, 0.3)["kl"] <= 0.005
    assert make(max_kl=0.02)[1].max_kl(0.9) == 0.02


def test_the_gradient_is_that_of_the_likelihood():
    policy, imitation = make(steps=1, learning_rate=1e-3, batch=16)
    imitation.optimiser.param_groups[0]["lr"] = 0.0
    obs, actions = torch.randn(1, 4), torch.rand(1, 2)
    imitation.update(obs, actions, obs, 0.0)
    mean = by_torch(policy.net, policy.net.flat, obs)
    loss = -log_prob(mean, policy.bounded_log_std().detach(), actions).mean()
    (expected,) = torch.autograd.grad(loss, policy.net.flat)
    assert torch.allclose(policy.net.flat.grad, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("size", "steps", "halvings", "end", "taken"),
    [
        (1.0, 5, 10, 0.5, 1),  # too long at once: half of it is not
        (0.2, 5, 10, 0.5, 3),  # 0.2, 0.4, and of the third a half
        (0.2, 5, 0, 0.4, 2),  # the third is undone
        (0.2, 2, 10, 0.4, 2),  # within the bound to the end
        (1e6, 5, 10, 0.0, 0),  # far too long, however often it is halved
        (float("nan"), 5, 10, 0.0, 0),
        (0.2, 0, 10, 0.0, 0),
    ],
)
def test_the_step_that_leaves_the_bound_is_halved_or_undone_and_the_last(
    size, steps, halvings, end, taken
):
    """Along a line on which the KL is the square of the place; the bound is at 0.3."""
    x = torch.zeros(1)
    found = imitate_within(
        0.3, steps, x.clone, x.copy_, lambda: x.add_(size), lambda: x.square().item(), halvings
    )
    assert x.item() == pytest.approx(end) and found[1] == taken
    assert found[0] == pytest.approx(end**2, abs=1e-6)
