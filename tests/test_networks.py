"""The written-out derivatives against torch's."""

import pytest
import torch
from torch import nn

from goalgan_bt.agent.networks import CHUNK, LEAKY_RELU, MLP, RELU, TANH, Linearised

TORCHS = {TANH: torch.tanh, RELU: torch.relu, LEAKY_RELU: nn.LeakyReLU(0.1)}


def by_torch(net, flat, x):
    """What the network says at parameters `flat`, in a way that autograd can follow."""
    views = net.views(flat)
    skip = x @ views.pop().T if net.skip else 0
    for weight, bias in zip(views[:-2:2], views[1:-2:2], strict=True):
        inner = x @ weight.T + bias
        x = TORCHS[net.activation](inner)
    return x @ views[-2].T + views[-1] + skip


def make(sizes, activation, skip):
    torch.manual_seed(0)
    net = MLP(sizes, activation, skip=skip).double()
    with torch.no_grad():
        net.flat += 0.3 * torch.randn_like(net.flat)
    return net, torch.randn(11, sizes[0], dtype=torch.float64)


@pytest.mark.parametrize("sizes", [(3, 4, 2), (3, 5, 4, 2), (2, 4, 3, 5, 1)])
@pytest.mark.parametrize("activation", TORCHS)
@pytest.mark.parametrize("skip", [False, True])
def test_outputs_and_jacobians_are_torchs(sizes, activation, skip):
    net, x = make(sizes, activation, skip)
    at, flat = Linearised(net, x.clone()), net.flat.detach()
    assert torch.equal(net(x), at.output)
    x.requires_grad_()
    expected = by_torch(net, net.flat, x)
    assert torch.allclose(at.output, expected)
    u, v = torch.randn_like(expected), torch.randn_like(flat)
    of_flat, of_x = torch.autograd.grad((u * expected).sum(), (net.flat, x))
    assert torch.allclose(at.vjp(u), of_flat)
    if not skip:
        assert torch.allclose(at.input_vjp(u), of_x)
    _, along = torch.func.jvp(lambda f: by_torch(net, f, x.detach()), (flat,), (v,))
    assert torch.allclose(at.jvp(v), along)


def test_first_weights_are_orthogonal_and_scaled():
    torch.manual_seed(0)
    net = MLP((8, 16, 16, 4), TANH, output_gain=0.01, input_gain=3.0, skip=True)
    first, bias, second, _, output, _, skip = net.views()
    assert torch.allclose(first.T @ first, 18 * torch.eye(8), atol=1e-4)
    assert torch.allclose(second.T @ second, 2 * torch.eye(16), atol=1e-5)
    assert torch.allclose(output @ output.T, 1e-4 * torch.eye(4), atol=1e-8)
    assert (bias == 0).all() and (skip == 0).all()


def test_many_rows_are_what_they_are_one_by_one():
    net, _ = make((3, 5, 2), TANH, True)
    x = torch.randn(2 * CHUNK + 7, 3, dtype=torch.float64)
    assert torch.allclose(net(x), torch.cat([net(row[None]) for row in x]))
    assert net(x[:0]).shape == (0, 2)


def test_a_network_of_one_layer_learns_a_line():
    net = MLP((1, 1), TANH)
    optimiser = torch.optim.Adam([net.flat], lr=0.1)
    x = torch.linspace(-1, 1, 50)[:, None]
    for _ in range(300):
        at = Linearised(net, x)
        net.flat.grad = at.vjp((at.output - (2 * x - 1)) / len(x))
        optimiser.step()
    assert net.flat.tolist() == pytest.approx([2.0, -1.0], abs=1e-2)
    assert torch.allclose(net(x), 2 * x - 1, atol=0.03)
