"""Fully connected networks with their derivatives written out.

Networks of a hundred units on some hundred rows spend most of their time in autograd's
bookkeeping: written out, a training step takes a third of it. All parameters lie in one vector, as
trust-region steps want them and as an optimiser updates them fastest.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CHUNK = 1024  # rows whose activations stay in a CPU core's cache


class Activation(NamedTuple):
    """apply: in place, on a layer's sums; slope: its derivative, told from its output."""

    apply: Callable[[Tensor], Tensor]
    slope: Callable[[Tensor], Tensor]


def tanh_(z: Tensor) -> Tensor:
    """tanh in place, to 2e-7, from the sigmoid, which torch computes four times as fast."""
    return z.mul_(2).sigmoid_().mul_(2).sub_(1)


TANH = Activation(tanh_, lambda h: 1 - h * h)
RELU = Activation(torch.relu_, torch.sign)
LEAKY_RELU = Activation(  # slope 0.1 below zero
    lambda z: F.leaky_relu_(z, 0.1), lambda h: torch.sign(h).mul_(0.45).add_(0.55)
)


def first_weights(seed: int | None) -> AbstractContextManager[None]:
    """Inside, first weights come from a seed and leave torch's own random numbers alone; from those
    if it is None, as a learner wants it that has seeded torch itself."""
    return nullcontext() if seed is None else _seeded(seed)


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


class MLP(nn.Module):
    """A fully connected network with orthogonal weights and zero biases.

    Args:
        sizes: units of every layer, the input first.
        activation: between the layers, not after the last.
        output_gain, input_gain: scale of the last and of the first layer's first weights.
        skip: add a linear map from the input to the output, which starts at zero.

    Attributes:
        flat: (p,) all parameters: weight (out, in) and bias (out,) of each layer, then the skip's
            weight.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        activation: Activation,
        output_gain: float = 1.0,
        input_gain: float = 1.0,
        skip: bool = False,
    ) -> None:
        super().__init__()
        self.activation, self.skip = activation, skip
        self.shapes = [
            shape for fan_in, out in pairwise(sizes) for shape in ((out, fan_in), (out,))
        ]
        if skip:
            self.shapes.append((sizes[-1], sizes[0]))
        self._numbers = [math.prod(shape) for shape in self.shapes]
        self.flat = nn.Parameter(torch.zeros(sum(self._numbers)))
        weights = self.views()[: 2 * len(sizes) - 2 : 2]
        for i, weight in enumerate(weights):
            gain = output_gain if i == len(weights) - 1 else math.sqrt(2)
            nn.init.orthogonal_(weight, gain * (input_gain if i == 0 else 1.0))

    def views(self, flat: Tensor | None = None) -> list[Tensor]:
        """The parameters, or another vector (p,), in their shapes; they share its memory."""
        parts = (self.flat.detach() if flat is None else flat).split(self._numbers)
        return [part.view(shape) for part, shape in zip(parts, self.shapes, strict=True)]

    def forward(self, x: Tensor) -> Tensor:
        """(n, in) -> (n, out), without autograd."""
        if len(x) <= CHUNK or x.device.type != "cpu":
            return Linearised(self, x).output
        return torch.cat([Linearised(self, chunk).output for chunk in x.split(CHUNK)])


class Linearised:
    """A network at one batch of inputs: its output, and its Jacobian J there.

    Args:
        net: the network; its parameters must not change while this is used.
        x: (n, in), without autograd.

    Attributes:
        output: (n, out).
    """

    def __init__(self, net: MLP, x: Tensor) -> None:
        self._net = net
        views = net.views()
        if net.skip:
            *views, skip = views
        self._weights, biases = views[::2], views[1::2]
        self._inputs = [x]  # of each layer
        for weight, bias in zip(self._weights[:-1], biases[:-1], strict=True):
            z = torch.addmm(bias, self._inputs[-1], weight.T)
            self._inputs.append(net.activation.apply(z))
        self.output = torch.addmm(biases[-1], self._inputs[-1], self._weights[-1].T)
        if net.skip:
            self.output.addmm_(x, skip.T)
        self._slopes: list[Tensor] = []

    def jvp(self, v: Tensor) -> Tensor:
        """J v: how the output changes along parameters v, (p,) -> (n, out)."""
        views, slopes = self._net.views(v), self._hidden_slopes()
        change = torch.addmm(views[1], self._inputs[0], views[0].T)
        for i in range(1, len(self._inputs)):
            change.mul_(slopes[i - 1])
            following = torch.addmm(views[2 * i + 1], self._inputs[i], views[2 * i].T)
            change = following.addmm_(change, self._weights[i].T)
        return change.addmm_(self._inputs[0], views[-1].T) if self._net.skip else change

    def vjp(self, u: Tensor) -> Tensor:
        """J' u: the gradient of sum(u * output) in the parameters, (n, out) -> (p,)."""
        flat = torch.empty_like(self._net.flat)
        views = self._net.views(flat)
        if self._net.skip:
            torch.mm(u.T, self._inputs[0], out=views[-1])
        for i, gradient in self._backward(u):
            torch.mm(gradient.T, self._inputs[i], out=views[2 * i])
            torch.sum(gradient, dim=0, out=views[2 * i + 1])
        return flat

    def input_vjp(self, u: Tensor) -> Tensor:
        """The gradient of sum(u * output) in the inputs, (n, out) -> (n, in); no skip in it."""
        *_, (_, gradient) = self._backward(u)
        return gradient @ self._weights[0]

    def _backward(self, u: Tensor) -> Iterator[tuple[int, Tensor]]:
        """Each layer, the last first, with the gradient in its sums."""
        slopes = self._hidden_slopes()
        for i in reversed(range(len(self._inputs))):
            yield i, u
            if i > 0:
                u = (u @ self._weights[i]).mul_(slopes[i - 1])

    def _hidden_slopes(self) -> list[Tensor]:
        if not self._slopes:
            self._slopes = [self._net.activation.slope(h) for h in self._inputs[1:]]
        return self._slopes
