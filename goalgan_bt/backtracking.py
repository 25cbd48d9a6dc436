"""The backtracking model: what state and action may have led here (Recall Traces, section 2.1).

    q(ds_t, a_t | s_{t+1}) = q(ds_t | a_t, s_{t+1}) q(a_t | s_{t+1}),   ds_t = s_t - s_{t+1}

Two networks, trained by maximum likelihood (equation 2) on the transitions of trajectories that
reached their goal, and unrolled backward from a state: s_t = s_{t+1} + ds_t. The state here is the
body's physical state (positions and velocities), without the goal: physics does not know it.
"""

import math
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from goalgan_bt.envs.batch import GoalEnv
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.mlp import MLP, RELU, TANH, Linearised
from goalgan_bt.settings import BacktrackingConfig

Float32 = NDArray[np.float32]


LOG_VAR = (-10.0, 2.0)  # bounds of the learned log variance, normalised units
CONSTANT = 0.5 * math.log(2 * math.pi)  # of a Gaussian's log density, per dimension
HELD_OUT = 256  # new transitions on which the model is tried before it learns from them


class Steps(NamedTuple):
    """n steps to imitate: states (n, state_dim), actions (n, act_dim) in [-1, 1] as the body felt
    them, goals (n, goal_dim) that they led to."""

    states: FloatArray
    actions: FloatArray
    goals: FloatArray

    def lesson(self, env: GoalEnv) -> tuple[Tensor, Tensor]:
        """Those steps as the policy would see and say them: observations (n, obs_dim), actions
        (n, act_dim)."""
        actions = env.from_body(self.actions, self.states, self.goals)
        obs = env.observations(self.states, self.goals)
        return torch.from_numpy(obs), torch.from_numpy(actions).float()


class Transitions:
    """A ring of transitions (s, a, s') of episodes (see `cfg.experience`), each one's in order.

    Attributes:
        states, next_states: (capacity, state_dim); actions: (capacity, act_dim); goals:
            (capacity, goal_dim) what the episode reached; left: (capacity,) how many more actions
            it took after this one. The first `size` rows count.
        cursor: where the next row goes; added: rows so far.
    """

    COLUMNS = ("states", "actions", "next_states", "goals", "left")

    def __init__(
        self, state_dim: int, act_dim: int, goal_dim: int, cfg: BacktrackingConfig
    ) -> None:
        capacity, self._minimum = cfg.buffer, cfg.min_transitions
        self.states = np.zeros((capacity, state_dim), np.float32)
        self.actions = np.zeros((capacity, act_dim), np.float32)
        self.next_states = np.zeros((capacity, state_dim), np.float32)
        self.goals = np.zeros((capacity, goal_dim), np.float32)
        self.left = np.zeros(capacity, np.int32)
        self.size, self.cursor, self.added = 0, 0, 0

    def add(self, *columns: np.ndarray) -> None:
        """Append rows of all `COLUMNS`; the oldest make room."""
        capacity = len(self.states)
        n = len(columns[0])
        rows = (self.cursor + np.arange(max(0, n - capacity), n)) % capacity
        for name, column in zip(self.COLUMNS, columns, strict=True):
            getattr(self, name)[rows] = column[-capacity:]
        self.cursor = (self.cursor + n) % capacity
        self.size, self.added = min(self.size + n, capacity), self.added + n

    def newest(self, n: int) -> NDArray[np.int64]:
        """Numbers of the last n rows, or of all if there are fewer, the oldest first."""
        return np.arange(self.cursor - min(n, self.size), self.cursor) % len(self.states)

    @property
    def enough(self) -> bool:
        """Whether there are transitions enough to learn from."""
        return self.size >= self._minimum

    def sample(self, n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """At most n random states that the agent has had, (<= n, state_dim), and the goals that
        they led to, (<= n, goal_dim); none too early."""
        rows = rng.permutation(self.size)[:n] if self.enough else np.empty(0, dtype=np.int64)
        return self.next_states[rows].astype(np.float64), self.goals[rows].astype(np.float64)

    def last_steps(
        self, env: GoalEnv, n: int, length: int, relabel: bool, rng: np.random.Generator
    ) -> Steps:
        """At most n random steps of those at most `length` actions before a success; with
        `relabel` each for a random later place of its episode, else for the goal reached."""
        rows = np.flatnonzero(self.left[: self.size] < length) if self.enough else np.arange(0)
        rows = rng.permutation(rows)[:n]
        goals = self.goals[rows].astype(np.float64)
        if relabel:
            later = rng.integers(self.left[rows] + 1) if len(rows) else rows
            ends = self.next_states[(rows + later) % len(self.states)]
            goals = env.achieved_goals(ends.astype(np.float64))
        return Steps(self.states[rows].astype(np.float64), self.actions[rows], goals)


class RecallTraces(NamedTuple):
    """n traces of L steps, the step nearest the goal first.

    states: (L, n, state_dim) s_t; actions: (L, n, act_dim) a_t in [-1, 1], taken in s_t;
    valid: (L, n) False from the first invalid state on; goals: (n, goal_dim) where each ends;
    seeds: (n, state_dim) the decoded states from which they were unrolled.
    """

    states: FloatArray
    actions: FloatArray
    valid: BoolArray
    goals: FloatArray
    seeds: FloatArray

    def steps(self, env: GoalEnv, relabel: bool, rng: np.random.Generator) -> Steps:
        """The valid steps, each for the goal that seeded its trace, or, with `relabel`, for a
        random later place of its trace."""
        goals = np.broadcast_to(self.goals, (*self.valid.shape, env.goal_dim))
        if relabel:
            achieved = env.achieved_goals(self.states.reshape(-1, env.state_dim))
            places = np.concatenate([self.goals[None], achieved.reshape(goals.shape)])
            ages = np.arange(len(self.valid))[:, None]  # what follows step t: places[: t + 1]
            later = rng.integers(ages + 1, size=self.valid.shape)
            goals = places[later, np.arange(len(self.goals))]
        return Steps(self.states[self.valid], self.actions[self.valid], goals[self.valid])

    def paths(self, env: GoalEnv) -> Float32:
        """Achieved goals along each trace, (L, n, goal_dim), NaN after it stopped."""
        achieved = env.achieved_goals(self.states.reshape(-1, env.state_dim))
        paths = achieved.reshape(*self.valid.shape, env.goal_dim)
        return np.where(self.valid[..., None], paths, np.nan).astype(np.float32)


class Scale(nn.Module):
    """Mean and standard deviation of a quantity, set from data; the same in fit and in traces."""

    mean: Tensor
    std: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("std", torch.ones(dim))

    def set(self, data: Tensor) -> None:
        """Statistics of data (n, dim), the standard deviation at least 1e-3."""
        if data.shape[1] == 0:  # goals, where there are none
            return
        std, self.mean = torch.std_mean(data, dim=0)
        self.std = std.clamp(min=1e-3)

    def normalise(self, x: Tensor) -> Tensor:
        """To zero mean and unit variance."""
        return (x - self.mean) / self.std

    def restore(self, x: Tensor) -> Tensor:
        """Back to the quantity's own units."""
        return x * self.std + self.mean


def learn_gaussian(net: MLP, inputs: Tensor, target: Tensor) -> float:
    """-log density of a target (n, k) under the network's Gaussian, whose outputs (n, 2 k) are mean
    and log variance: the mean over batch and dimensions, whose gradient it leaves in the network.
    """
    at = Linearised(net, inputs)
    mean, log_var = at.output.chunk(2, dim=-1)
    bounded = log_var.clamp(*LOG_VAR)
    error, precision = mean - target, torch.exp(-bounded)
    chi = error.square() * precision
    of_log_var = 0.5 * (1 - chi) * (bounded == log_var)
    net.flat.grad = at.vjp(torch.cat([error * precision, of_log_var], dim=-1) / error.numel())
    return 0.5 * (chi + bounded).mean().item() + CONSTANT


def sample_gaussian(net: MLP, inputs: Tensor, generator: torch.Generator) -> Tensor:
    """A draw from the network's Gaussian, (n, k)."""
    mean, log_var = net(inputs).chunk(2, dim=-1)
    noise = torch.randn(mean.shape, generator=generator)
    return mean + torch.exp(0.5 * log_var.clamp(*LOG_VAR)) * noise


class BacktrackingModel(nn.Module):
    """q(a | s') with unit variance and q(ds | a, s') with a learned one, in normalised units; with
    `cfg.conditioned` q(a | s', g).

    Args:
        state_dim, act_dim, goal_dim: sizes of the physical state, of the action and of a goal.
        cfg: settings.
        generator: the source of minibatches and samples.

    Attributes:
        seen: transitions that were there when it last learned.
    """

    def __init__(
        self,
        state_dim: int,
        act_dim: int,
        goal_dim: int,
        cfg: BacktrackingConfig,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.cfg, self._rng = cfg, generator
        told = state_dim + (goal_dim if cfg.conditioned else 0)
        self.action_net = MLP((told, *cfg.hidden, act_dim), TANH)
        self.state_net = MLP((state_dim + act_dim, *cfg.hidden, 2 * state_dim), RELU)
        self.state_scale, self.delta_scale = Scale(state_dim), Scale(state_dim)
        self.action_scale, self.goal_scale = Scale(act_dim), Scale(goal_dim)
        params = [*self.action_net.parameters(), *self.state_net.parameters()]
        self.optimiser = torch.optim.Adam(params, lr=cfg.learning_rate, fused=True)
        self.seen = 0

    def fit(self, data: Transitions) -> dict[str, float]:
        """Maximise log q(ds, a | s') (equation 2) for `cfg.steps` steps; with none, as the control
        of an untrained model has it, only learn the scales.

        Returns:
            action_nll and state_nll, nats per dimension in normalised units (mean over steps), and,
            before those steps, held_out_action_nll and held_out_state_nll of transitions that are
            new since the last call; nothing while the buffer is too small.
        """
        if not data.enough:
            return {}
        new = data.newest(data.added - self.seen)
        new = new[:: max(1, len(new) // HELD_OUT)]
        metrics = {}
        if self.seen and len(new):
            action_nll, state_nll = self.negative_log_likelihood(*self._batch(data, new))
            metrics = {"held_out_action_nll": action_nll, "held_out_state_nll": state_nll}
        self.seen = data.added

        steps, size = self.cfg.steps, self.cfg.batch
        rows = torch.randint(data.size, (max(1, steps) * size,), generator=self._rng).numpy()
        batch = self._batch(data, rows)
        scales = self.state_scale, self.action_scale, self.delta_scale, self.goal_scale
        # Statistics of these rows alone: the whole buffer took longer than the steps.
        for scale, x in zip(scales, batch, strict=True):
            scale.set(x)
        losses = np.zeros((steps, 2))
        parts = [x.split(size) for x in batch]
        for i in range(steps):
            losses[i] = self.negative_log_likelihood(*(part[i] for part in parts))
            nn.utils.clip_grad_norm_(self.parameters(), 1.0)
            self.optimiser.step()
        if steps:
            metrics["action_nll"], metrics["state_nll"] = losses.mean(axis=0)
        return metrics

    @staticmethod
    def _batch(data: Transitions, rows: NDArray[np.int64]) -> tuple[Tensor, ...]:
        """What `negative_log_likelihood` takes, of some transitions."""
        following = torch.from_numpy(data.next_states[rows])
        actions, goals = torch.from_numpy(data.actions[rows]), torch.from_numpy(data.goals[rows])
        return following, actions, torch.from_numpy(data.states[rows]) - following, goals

    @torch.no_grad()
    def negative_log_likelihood(
        self, next_states: Tensor, actions: Tensor, deltas: Tensor, goals: Tensor
    ) -> tuple[float, float]:
        """-log q(a | s') and -log q(ds | a, s'), means over the batch and the dimensions; leaves
        the gradients of their sum in the two networks.

        Args:
            next_states: (n, state_dim); actions: (n, act_dim); deltas: (n, state_dim); goals:
                (n, goal_dim).
        """
        s, a = self.state_scale.normalise(next_states), self.action_scale.normalise(actions)
        acted = Linearised(self.action_net, self._told(s, goals))
        miss = acted.output - a
        self.action_net.flat.grad = acted.vjp(miss / miss.numel())
        delta = self.delta_scale.normalise(deltas)
        state_nll = learn_gaussian(self.state_net, torch.cat([s, a], dim=-1), delta)
        return 0.5 * miss.square().mean().item() + CONSTANT, state_nll

    @torch.no_grad()
    def predecessors(self, next_states: Tensor, goals: Tensor) -> tuple[Tensor, Tensor]:
        """Sample (s_t, a_t) given s_{t+1}, on the way to those goals: (n, state_dim),
        (n, goal_dim) -> (n, state_dim), (n, act_dim)."""
        s = self.state_scale.normalise(next_states)
        a = self.action_net(self._told(s, goals))
        if self.cfg.sample_actions:
            a = a + torch.randn(a.shape, generator=self._rng)
        actions = self.action_scale.restore(a).clamp(-1.0, 1.0)  # the body feels no more
        a = self.action_scale.normalise(actions)
        delta = sample_gaussian(self.state_net, torch.cat([s, a], dim=-1), self._rng)
        return next_states + self.delta_scale.restore(delta), actions

    @torch.no_grad()
    def action_log_density(self, next_states: Tensor, actions: Tensor) -> Tensor:
        """log q(a | s') of a model that is not told goals, (n, state_dim), (n, act_dim) -> (n,)."""
        mean = self.action_net(self.state_scale.normalise(next_states))
        miss = mean - self.action_scale.normalise(actions)
        per_dim = 0.5 * miss.square() + CONSTANT + self.action_scale.std.log()
        return -per_dim.sum(dim=-1)

    def _told(self, s: Tensor, goals: Tensor) -> Tensor:
        """The input of q(a | s') or, where it is conditioned, of q(a | s', g)."""
        if not self.cfg.conditioned:
            return s
        return torch.cat([s, self.goal_scale.normalise(goals)], dim=-1)


class Consistency(NamedTuple):
    """What the simulator says to recall traces.

    gap: (L, n) how far from the trace's next place the simulator arrives, metres, NaN after the
    trace stopped; moved: (L, n) how far that place is from the one before; arrived: (m,) whether
    the actions of the trace, from its far end on, reach the goal, for those m traces that do not
    begin on it; steps: environment steps spent.
    """

    gap: FloatArray
    moved: FloatArray
    arrived: BoolArray
    steps: int

    def metrics(self) -> dict[str, float]:
        """Means over all steps, and over the last ones of the traces; the share that arrived."""
        if not np.isfinite(self.gap).any():
            return {}
        length = np.isfinite(self.gap).sum(axis=0)
        last = self.gap[length - 1, np.arange(len(length))][length > 0]
        return {
            "gap": float(np.nanmean(self.gap)),
            "gap_last": float(last.mean()),
            "moved": float(np.nanmean(self.moved)),
            "arrived": float(self.arrived.mean()) if len(self.arrived) else math.nan,
        }


def consistency(env: GoalEnv, traces: RecallTraces) -> Consistency:
    """Put the simulator into the states of traces and apply their actions.

    Args:
        env: simulations for this purpose; as many traces as it has are looked at.
        traces: recall traces.
    """
    n = min(traces.valid.shape[1], env.num_envs)
    ids, valid = np.arange(n), traces.valid[:, :n]
    goals, length = traces.goals[:n], len(valid)
    gap, moved = np.full((2, length, n), np.nan)
    following, steps = traces.seeds[:n], 0
    for t in range(length):
        some = ids[valid[t]]
        env.reset(some, goals[some], traces.states[t, some])
        env.advance(some, traces.actions[t, some])
        place = env.achieved_goals(following[some])
        gap[t, some] = _distance(env.achieved_goals(env.read_states(some)), place)
        moved[t, some] = _distance(env.achieved_goals(traces.states[t, some]), place)
        following = traces.states[t, :n]
        steps += len(some) * env.action_repeat
    # Now in one go, from the far end to the goal.
    arrived, away = np.zeros((2, n), dtype=bool)
    for t in reversed(range(length)):
        begins = ids[valid[t] & (~valid[t + 1] if t + 1 < length else True)]
        far = env.achieved_goals(traces.states[t, begins])
        away[begins] = ~env.reached(far, goals[begins])
        env.reset(begins, goals[begins], traces.states[t, begins])
        some = ids[valid[t] & ~arrived]
        env.advance(some, traces.actions[t, some])
        here = env.achieved_goals(env.read_states(some))
        arrived[some] = env.reached(here, goals[some])
        steps += len(some) * env.action_repeat
    return Consistency(gap, moved, arrived[away], steps)


def _distance(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(a - b, axis=-1))


class StateSpace(Protocol):
    """What a trace has to know of the world."""

    @property
    def state_dim(self) -> int:
        """Size of a state."""

    @property
    def act_dim(self) -> int:
        """Size of an action."""

    def repair(self, states: FloatArray) -> FloatArray:
        """See `GoalEnv.repair`."""

    def valid(self, states: FloatArray) -> BoolArray:
        """See `GoalEnv.valid`."""


def recall_traces(
    model: BacktrackingModel, env: StateSpace, seeds: FloatArray, goals: FloatArray, length: int
) -> RecallTraces:
    """Unroll the model backward from states that stand on goals.

    A trace stops at the first state that is not valid (in a wall, fallen, not finite).

    Args:
        model: the backtracking model.
        env: knows which states are valid.
        seeds: (n, state_dim) full states, from the decoder.
        goals: (n, goal_dim) the goals on which they stand.
        length: L.
    """
    n = len(seeds)
    wanted = torch.from_numpy(goals).float()
    states = np.zeros((length, n, env.state_dim))
    actions = np.zeros((length, n, env.act_dim))
    valid = np.zeros((length, n), dtype=bool)
    current, alive = seeds, np.ones(n, dtype=bool)
    for t in range(length if n else 0):
        previous, action = model.predecessors(torch.from_numpy(current).float(), wanted)
        current = env.repair(previous.double().numpy())
        alive = alive & env.valid(current)
        states[t], actions[t], valid[t] = current, action.numpy(), alive
        current = np.where(alive[:, None], current, seeds)  # a dead trace stays finite
    return RecallTraces(states, actions, valid, goals, seeds)
