"""A trained policy as one ONNX graph: normaliser, heading and places inside.

From the state of the body and a goal to what the motors do, with the mean of the policy. What
`TrainedPolicy.act` computes with numpy is computed with tensors here, so that it can be traced.
"""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from goalgan_bt.agent.policy import GaussianPolicy
from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.learners.maze_learner import load_policy
from goalgan_bt.learners.trained_policy import world_of
from goalgan_bt.recall.places import AROUND, Places
from goalgan_bt.runs import files
from goalgan_bt.runs.errors import UsageError

OPSET = 20


def unit(vectors: Tensor) -> Tensor:
    """Vectors (n, goal_dim) of length 1; zero stays zero."""
    return vectors / torch.clamp(torch.linalg.vector_norm(vectors, dim=1, keepdim=True), min=1e-9)


class TracedHeading(nn.Module):
    """`Places.heading` with tensors.

    Args:
        places: whose ways are told, as they are now.

    Raises:
        UsageError: if there are too many for a table.
    """

    def __init__(self, places: Places) -> None:
        super().__init__()
        self.straight = places.cfg.way == "straight" or not places.moves.nnz
        self.cell, self.near = places.cfg.cell, places.near
        if not self.straight:
            for name, array in places.tabulated()._asdict().items():
                self.register_buffer(name, torch.from_numpy(array))

    low: Tensor
    high: Tensor
    strides: Tensor
    numbers: Tensor
    ends: Tensor
    places: Tensor
    table: Tensor

    def forward(self, places: Tensor, goals: Tensor) -> Tensor:
        """Offsets along the way, (n, goal_dim)."""
        direct = goals - places
        if self.straight:
            return direct
        straight = torch.linalg.vector_norm(direct, dim=1)
        ends = self.ends[(torch.round(self.on_lattice(goals)).long() * self.strides).sum(dim=1)]
        corners, weights = self.around(places)
        mean = (weights[..., None] * self.table[ends[:, None], corners]).sum(dim=1)
        recalled, last_leg = mean[:, 1] / mean[:, 0].clamp(min=1e-30), goals - self.places[ends]
        left = recalled + torch.linalg.vector_norm(last_leg, dim=1)
        along = recalled[:, None] * unit(mean[:, 2:]) + last_leg
        as_seen = (straight < self.near) & (left < AROUND * straight + 2 * self.cell)
        as_seen |= (recalled < 2 * self.cell) | (straight < self.cell)
        length = torch.where(as_seen, straight, left)
        turned = as_seen | (along.square().sum(dim=1) < 1e-12)
        return length[:, None] * unit(torch.where(turned[:, None], direct, along))

    def on_lattice(self, points: Tensor) -> Tensor:
        """Points (n, goal_dim) in units of the lattice."""
        return (torch.minimum(torch.maximum(points, self.low), self.high) - self.low) / self.cell

    def around(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Numbers and weights of the corners around points, each (n, goal_dim + 1)."""
        x = self.on_lattice(points)
        first = torch.floor(x)
        rest, order = torch.sort(x - first, dim=1, descending=True)
        one = torch.ones_like(rest[:, :1])
        weights = torch.cat([one, rest], dim=1) - torch.cat([rest, 0 * one], dim=1)
        steps = self.strides[order].cumsum(dim=1)
        keys = torch.cat([torch.zeros_like(steps[:, :1]), steps], dim=1)
        return self.numbers[keys + (first.long() * self.strides).sum(dim=1, keepdim=True)], weights


class TracedPolicy(nn.Module):
    """`TrainedPolicy.act` with tensors: state (n, state_dim) and goal (n, goal_dim), float64, to
    action (n, act_dim), float32.

    Args:
        env: simulations, which are not to be used any more.
        policy: pi.
        places: those that the policy takes along; None if it sees no heading.
    """

    def __init__(self, env: GoalEnv, policy: GaussianPolicy, places: Places | None) -> None:
        super().__init__()
        self.policy, self._env = policy, env
        self.heading = None if places is None else TracedHeading(places)
        if self.heading is not None:
            # Tensors all the way.
            env.along = self.heading.forward  # type: ignore[method-assign, assignment]

    def forward(self, state: Tensor, goal: Tensor) -> Tensor:
        """What the motors do."""
        x = self.policy.normaliser(self._env.observations(state, goal))
        *layers, skip = self.policy.net.views()
        h = x
        for weight, bias in zip(layers[:-2:2], layers[1:-2:2], strict=True):
            h = torch.tanh(h @ weight.T + bias)
        mean = h @ layers[-2].T + layers[-1] + x @ skip.T
        action: Tensor = self._env.to_body(mean.clamp(-1.0, 1.0), state, goal)
        return action


def traced(folder: Path) -> tuple[TracedPolicy, GoalEnv]:
    """The policy of a run, ready to be traced, and its environment.

    Raises:
        RunError: if the folder is no run of a maze, or has no checkpoint that can be read.
        UsageError: if its places are too many.
    """
    cfg, env = world_of(folder, 1)
    policy, _ = load_policy(env, cfg, folder)
    # Those that the policy takes along: it has come with them.
    places = None if env.heading is None else env.heading.__self__  # type: ignore[attr-defined]
    return TracedPolicy(env, policy, places).eval(), env


def export(folder: Path, path: Path) -> None:
    """Write the graph: inputs `state` (n, state_dim) and `goal` (n, goal_dim), float64, output
    `action` (n, act_dim) in [-1, 1], float32; n is free.

    Raises:
        RunError, UsageError: as `traced`.
        OSError: if the file cannot be written; an old one is left as it was.
    """
    graph, env = traced(folder)
    state = torch.from_numpy(env.start_state).repeat(2, 1)
    goal = torch.from_numpy(env.test_goals()[:2])
    graph(state, goal)  # makes the constants that arrays.py keeps: traced ones would stay behind
    n = torch.export.Dim("n", min=1)
    program: Any = torch.onnx.export(
        graph,
        (state, goal),
        input_names=["state", "goal"],
        output_names=["action"],
        dynamic_shapes=({0: n}, {0: n}),
        opset_version=OPSET,
        dynamo=True,
        verbose=False,
    )
    if program is None:
        raise UsageError("this version of torch makes no ONNX program")
    data = program.model_proto.SerializeToString()
    files.write_atomically(path, lambda file: file.write(data))
