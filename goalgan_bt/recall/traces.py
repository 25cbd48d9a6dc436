"""Recall traces: the backtracking model unrolled backward (Recall Traces, section 2.1)."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.recall.backtracking import BacktrackingModel
from goalgan_bt.recall.transitions import Steps
from goalgan_bt.runs.errors import UsageError

Float32 = NDArray[np.float32]


class Traces(NamedTuple):
    """n traces of L steps, the step nearest the goal first.

    states: (L, n, state_dim) s_t; actions: (L, n, act_dim) a_t in [-1, 1], taken in s_t;
    valid: (L, n) False from the first invalid state on; goals: (n, goal_dim) where each ends;
    seeds: (n, state_dim) the states from which they were unrolled.
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

    def survival(self, actions: int) -> float:
        """The share of traces that are still valid so many actions before their goal; NaN where
        they are not that long, or none."""
        known = 0 < actions <= len(self.valid) and self.valid.shape[1] > 0
        return float(self.valid[actions - 1].mean()) if known else math.nan

    def paths(self, env: GoalEnv) -> Float32:
        """Achieved goals along each trace, (L, n, goal_dim), NaN after it stopped."""
        achieved = env.achieved_goals(self.states.reshape(-1, env.state_dim))
        paths = achieved.reshape(*self.valid.shape, env.goal_dim)
        return np.where(self.valid[..., None], paths, np.nan).astype(np.float32)


def recall_traces(
    model: BacktrackingModel,
    seeds: FloatArray,
    length: int,
    goals: FloatArray | None = None,
    *,
    valid: Callable[[FloatArray], BoolArray] | None = None,
    repair: Callable[[FloatArray], FloatArray] | None = None,
) -> Traces:
    """Unroll the model backward from states that stand on goals.

    A trace stops at the first state that is not valid (in a wall, fallen, not finite).

    Args:
        model: the backtracking model.
        seeds: (n, state_dim) full states from which the traces lead back.
        length: L.
        goals: (n, goal_dim) the goals on which they stand, where the model is told goals.
        valid: whether states (n, state_dim) can be, (n,); finite ones if None.
        repair: puts right in states (n, state_dim) what a learned model breaks, such as the length
            of a quaternion; nothing if None.

    Raises:
        UsageError: if seeds or goals do not fit the model.
    """
    seeds = np.asarray(seeds, dtype=float)
    n, (state_dim, act_dim, goal_dim) = len(seeds), model.sizes
    goals = np.empty((n, 0)) if goals is None else np.asarray(goals, dtype=float)
    told = goal_dim if model.cfg.conditioned else goals.shape[-1]
    if seeds.shape != (n, state_dim) or goals.shape != (n, told):
        raise UsageError(
            f"seeds must be rows of {state_dim} numbers, and goals as many of {goal_dim}, "
            f"not arrays of shapes {seeds.shape} and {goals.shape}"
        )
    valid = valid or _finite
    wanted = torch.from_numpy(goals).float()
    states = np.zeros((length, n, state_dim))
    actions = np.zeros((length, n, act_dim))
    alive_at = np.zeros((length, n), dtype=bool)
    current, alive = seeds, np.ones(n, dtype=bool)
    for t in range(length if n else 0):
        previous, action = model.predecessors(torch.from_numpy(current).float(), wanted)
        current = previous.double().numpy()
        current = current if repair is None else repair(current)
        alive = alive & _told(valid(current), n)
        states[t], actions[t], alive_at[t] = current, action.numpy(), alive
        current = np.where(alive[:, None], current, seeds)  # a dead trace stays finite
    return Traces(states, actions, alive_at, goals, seeds)


def _told(valid: BoolArray, n: int) -> BoolArray:
    """What somebody's `valid` says, where that is one answer per state.

    Raises:
        UsageError: if it is not.
    """
    if np.shape(valid) != (n,):
        raise UsageError(f"valid must give one answer for each of {n} states, not {valid!r}")
    return np.asarray(valid, dtype=bool)


def _finite(states: FloatArray) -> BoolArray:
    return np.asarray(np.isfinite(states).all(axis=1))
