"""The N-dimensional point mass: a box that is thin in most directions (Florensa et al. 2018).

A double integrator in 2 to 6 dimensions. It can move by 1 m along the first axis, 5 m along the
second and 0.3 m along the others, while goals are proposed in the whole cube of 5 m: the more
dimensions, the fewer goals are feasible (20% in two, then 0.06 times that per dimension).
"""

import numpy as np

from goalgan_bt.envs.arrays import Array
from goalgan_bt.envs.goal_env import GoalEnv, Ids, observed
from goalgan_bt.envs.maze import BoolArray, FloatArray

MAX_FORCE = 2.0  # m/s^2 per axis, at action 1
MAX_SPEED = 5.0  # m/s per axis
GOAL_RANGE = 5.0  # m, goals are proposed in +- this on every axis
DT = 0.02  # s


class PointND(GoalEnv):
    """Reach any point of the box; success within 0.3 sqrt(dim / 2) m.

    State: positions (m), velocities (m/s). Observation: see `goal_env.observed`. Achieved goal: the
    position.
    """

    name = "point_nd"
    dt = DT

    def __init__(self, dim: int, num_envs: int, horizon: int, action_repeat: int) -> None:
        self.bound = np.array(([1.0, 5.0] + [0.3] * dim)[:dim])
        self.success_radius = 0.3 * np.sqrt(dim / 2)
        self.act_dim = dim
        self.start_state = np.zeros(2 * dim)
        self.goal_low, self.goal_high = np.full(dim, -GOAL_RANGE), np.full(dim, GOAL_RANGE)
        super().__init__(num_envs, horizon, action_repeat)
        self._states = np.zeros((num_envs, 2 * dim))

    def read_states(self, ids: Ids) -> FloatArray:
        return self._states[ids]

    def write_states(self, ids: Ids, states: FloatArray) -> None:
        self._states[ids] = states

    def advance(self, ids: Ids, actions: FloatArray) -> None:
        position, velocity = np.split(self._states[ids], 2, axis=1)
        for _ in range(self.action_repeat):
            velocity = np.clip(velocity + MAX_FORCE * DT * actions, -MAX_SPEED, MAX_SPEED)
            position = np.clip(position + DT * velocity, -self.bound, self.bound)
        self._states[ids] = np.concatenate([position, velocity], axis=1)

    def observations(self, states: Array, goals: Array, achieved: Array | None = None) -> Array:
        return observed(self, states, goals)

    def achieved_goals(self, states: FloatArray) -> FloatArray:
        return states[:, : self.goal_dim]

    def place(self, states: FloatArray, goals: FloatArray) -> FloatArray:
        return np.concatenate([goals, states[:, self.goal_dim :]], axis=1)

    def healthy(self, states: FloatArray) -> BoolArray:
        return np.asarray(np.isfinite(states).all(axis=1))

    def valid(self, states: FloatArray) -> BoolArray:
        return self.healthy(states) & self.feasible(states[:, : self.goal_dim])

    def feasible(self, goals: FloatArray) -> BoolArray:
        return np.asarray((np.abs(goals) <= self.bound).all(axis=1))

    def free_goals(self, n: int, rng: np.random.Generator) -> FloatArray:
        return rng.uniform(-self.bound, self.bound, (n, self.goal_dim))

    def test_goals(self) -> FloatArray:
        # The original draws 50 anew each time; fixed goals make two measurements comparable.
        return self.free_goals(100, np.random.default_rng(0))
