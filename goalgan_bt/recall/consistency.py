"""What the simulator says to recall traces: how well the model knows the world."""

import math
from typing import NamedTuple

import numpy as np

from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.recall.traces import Traces


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


def consistency(env: GoalEnv, traces: Traces) -> Consistency:
    """Put the simulator into the states of traces and apply their actions.

    Args:
        env: simulations for this purpose; as many traces as it has are looked at.
        traces: recall traces.
    """
    n = min(traces.valid.shape[1], env.num_envs)
    ids, valid = np.arange(n), traces.valid[:, :n]
    goals, length = traces.goals[:n], len(valid) if n else 0
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
