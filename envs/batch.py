"""Many simulations of one goal-reaching task, stepped at once.

`GoalEnv` is the contract between the world and the learner; `MujocoEnv` adds MuJoCo's physics
and is the only place that knows `mujoco.batch`; `warp_batch` has its like for GPUs.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from goalgan_bt.envs.arrays import Array, namespace, put
from goalgan_bt.envs.maze import BoolArray, FloatArray, Maze

Ids = NDArray[np.int64]


class PhysicsError(ValueError):
    """Physics that this machine or this environment does not have; the message says what to do."""


class Step(NamedTuple):
    """What one action in n simulations gave; its arrays belong to who asked for it.

    states: (n, state_dim) afterwards.
    achieved: (n, goal_dim) the goals on which they stand.
    actions: (n, act_dim) what the body felt, in [-1, 1] (see `GoalEnv.to_body`).
    rewards: (n,) float32, 1 on reaching the goal, else 0.
    terminated: (n,) bool, the goal was reached or the body failed (an Ant that fell).
    truncated: (n,) bool, the time ran out without either.
    """

    states: FloatArray
    achieved: FloatArray
    actions: FloatArray
    rewards: NDArray[np.float32]
    terminated: BoolArray
    truncated: BoolArray


class GoalEnv:
    """N simulations of one body that must bring its achieved goal to a desired goal.

    The reward is sparse: 1 on coming within `success_radius` of a feasible desired goal, else 0;
    a goal inside a wall is never reached (Florensa et al. 2018, `only_feasible`). An episode ends
    on success, on failure of the body, or after `horizon` steps. Nothing resets by itself.

    A state is one float row that holds all that the physics needs; states can be read
    (`read_states`), written (`reset`) and mapped to observations and achieved goals in batches of
    any size, which the decoder and the backtracking model rely on.

    Attributes:
        name: for example `ant_umaze`.
        num_envs: N.
        horizon: steps of an episode; dt: seconds of a step.
        action_repeat: steps for which each action is held. Success, failure and the end of time
            are checked after each action; all counts are of steps.
        success_radius: metres.
        obs_dim, act_dim, goal_dim, state_dim: sizes of one row.
        start_state: (state_dim,) where episodes begin.
        goal_low, goal_high: (goal_dim,) the box in which goals are proposed, metres.
        maze: the layout, or None where there are no walls.
        goals: (N, goal_dim) the desired goals; elapsed: (N,) steps since the last reset.
    """

    name: str
    dt: float
    success_radius: float
    act_dim: int
    obs_dim: int
    start_state: FloatArray
    goal_low: FloatArray
    goal_high: FloatArray
    maze: Maze | None = None

    def __init__(self, num_envs: int, horizon: int, action_repeat: int) -> None:
        self.num_envs = num_envs
        self.horizon = horizon
        self.action_repeat = action_repeat
        self.goals = np.zeros((num_envs, self.goal_dim))
        self.elapsed = np.zeros(num_envs, dtype=np.int64)
        self._feasible = np.zeros(num_envs, dtype=bool)

    @property
    def goal_dim(self) -> int:
        """Size of a goal."""
        return len(self.goal_low)

    @property
    def state_dim(self) -> int:
        """Size of a state."""
        return len(self.start_state)

    # What a body defines. All take and return rows: (n, state_dim), (n, goal_dim), ... Those that
    # say `Array` compute on numpy arrays and on torch tensors alike, where there are both.

    def read_states(self, ids: Ids) -> FloatArray:
        """A copy of the states of those simulations, (n, state_dim)."""
        raise NotImplementedError

    def write_states(self, ids: Ids, states: FloatArray) -> None:
        """Put those simulations into those states, (n, state_dim)."""
        raise NotImplementedError

    def advance(self, ids: Ids, actions: Array) -> None:
        """Hold actions in [-1, 1], (n, act_dim), for `action_repeat` steps."""
        raise NotImplementedError

    def observations(self, states: Array, goals: Array, achieved: Array | None = None) -> Array:
        """What the policy sees in those states with those desired goals, (n, obs_dim) float32.

        `achieved`, (n, goal_dim), saves computing the achieved goals where they are known.
        """
        raise NotImplementedError

    def achieved_goals(self, states: Array) -> Array:
        """The goal that each state stands on, (n, goal_dim)."""
        raise NotImplementedError

    def place(self, states: FloatArray, goals: FloatArray) -> FloatArray:
        """The same states moved so that they achieve those goals, (n, state_dim)."""
        raise NotImplementedError

    def healthy(self, states: Array) -> Array:
        """Whether an episode may go on in each state, (n,)."""
        raise NotImplementedError

    def valid(self, states: FloatArray) -> BoolArray:
        """Whether each state is healthy and outside the walls, (n,)."""
        raise NotImplementedError

    def feasible(self, goals: Array) -> Array:
        """Whether each goal lies where the body can be, (n,)."""
        raise NotImplementedError

    def test_goals(self) -> FloatArray:
        """The feasible goals over which coverage is measured, (K, goal_dim)."""
        raise NotImplementedError

    def to_body(self, actions: Array, states: Array, goals: Array) -> Array:
        """What a policy's actions, given its observation, mean for the body, (n, act_dim).

        They differ where the observation is told in a frame of its own, as the Ant's is.
        """
        return actions

    def from_body(self, actions: Array, states: Array, goals: Array) -> Array:
        """The inverse of `to_body`: how a policy would have to say what the body did."""
        return actions

    def repair(self, states: FloatArray) -> FloatArray:
        """States with the constraints that a learned model breaks put right, (n, state_dim)."""
        return states

    # What all bodies share.

    def reset(self, ids: Ids, goals: FloatArray, states: FloatArray | None = None) -> None:
        """Begin new episodes in some simulations.

        Args:
            ids: sorted indices of the simulations, (n,).
            goals: their desired goals, (n, goal_dim).
            states: where they begin, (n, state_dim); the start state if None.
        """
        if states is None:
            states = np.broadcast_to(self.start_state, (len(ids), self.state_dim))
        self.write_states(ids, states)
        self.set_goals(ids, goals)

    def set_goals(self, ids: Ids, goals: FloatArray) -> None:
        """New desired goals and a new clock for some simulations, which stay where they are."""
        self.goals[ids] = goals
        self._feasible[ids] = self.feasible(goals)
        self.elapsed[ids] = 0

    def observe(self, ids: Ids) -> NDArray[np.float32]:
        """The present observations of some simulations, (n, obs_dim)."""
        return self.observations(self.read_states(ids), self.goals[ids])

    def step(self, ids: Ids, actions: FloatArray) -> Step:
        """Take one action, `action_repeat` steps long, in some simulations.

        Args:
            ids: sorted indices of the simulations, (n,).
            actions: (n, act_dim), clipped to [-1, 1].
        """
        goals = self.goals[ids]
        actions = self.to_body(np.clip(actions, -1.0, 1.0), self.read_states(ids), goals)
        self.advance(ids, actions)
        self.elapsed[ids] += self.action_repeat
        states = self.read_states(ids)
        return self.judge(states, actions, goals, self._feasible[ids], self.elapsed[ids])

    def reached(self, achieved: Array, goals: Array) -> Array:
        """Whether places are within `success_radius` of goals, both (n, goal_dim), (n,)."""
        squared = namespace(achieved).square(achieved - goals).sum(axis=1)
        return squared < self.success_radius**2

    def judge(
        self, states: Array, actions: Array, goals: Array, feasible: Array, elapsed: Array
    ) -> Step:
        """What an action gave that ended in those states.

        Args:
            states: (n, state_dim).
            actions: (n, act_dim) as the body felt them.
            goals: (n, goal_dim) desired; feasible: (n,) bool, see `feasible`.
            elapsed: (n,) steps since the episodes began.
        """
        xp = namespace(states)
        healthy = self.healthy(states)
        with np.errstate(invalid="ignore"):  # a diverged state is as far as can be
            achieved = self.achieved_goals(states)
            success = healthy & feasible & self.reached(achieved, goals)
        terminated = success | ~healthy
        truncated = ~terminated & (elapsed >= self.horizon)
        rewards = xp.asarray(success, dtype=xp.float32)
        return Step(states, achieved, actions, rewards, terminated, truncated)


class MujocoEnv(GoalEnv):
    """A `GoalEnv` on MuJoCo; the state is qpos and qvel.

    Args:
        model: the compiled model.
        num_envs: N.
        horizon: steps of an episode.
        action_repeat: steps for which each action is held.
        threads: simulation threads, 0 for one per core. Results do not depend on it.
        physics: `mujoco`, or `warp` for mujoco-warp in single precision (extra `gpu`).
        device: of mujoco-warp: `cpu`, `cuda`, `cuda:1`, ...; `auto` is a GPU where there is one.

    Raises:
        PhysicsError: if mujoco-warp, the device or what the model needs of them is missing.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        horizon: int,
        action_repeat: int,
        threads: int,
        physics: str,
        device: str,
    ) -> None:
        super().__init__(num_envs, horizon, action_repeat)
        self.model = model
        self.batch, self._row = _batch(model, num_envs, threads, physics, device)
        self._qpos, self._qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._ctrl = self.batch.bind("ctrl")
        self.dt = model.opt.timestep

    def read_states(self, ids: Ids) -> FloatArray:
        return self._row[ids]

    def write_states(self, ids: Ids, states: FloatArray) -> None:
        # A reset also clears the solver's warm start, so that a state has one future only.
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._row[ids] = states

    def advance(self, ids: Ids, actions: Array) -> None:
        self._ctrl[ids] = put(actions, self._ctrl)
        self.batch.step(ids, nstep=self.action_repeat)


def _batch(
    model: mujoco.MjModel, num_envs: int, threads: int, physics: str, device: str
) -> tuple[Any, Any]:
    """The simulations, and their states as rows of qpos and qvel."""
    if physics == "warp":
        from goalgan_bt.envs.warp_batch import WarpBatch

        warp = WarpBatch(model, num_envs, device)
        return warp, warp.rows
    # A diverged simulation must end its episode, not be put back silently (Warp's never is).
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    batch = Batch(model, num_envs, threads)
    # A state row of MuJoCo is time, qpos, qvel, ...: ours is a slice of it, read in one go.
    rows = batch.state[:, 1 : 1 + model.nq + model.nv]
    assert np.shares_memory(rows[:, : model.nq], batch.bind("qpos"))
    return batch, rows


class MazeEnv(MujocoEnv):
    """A body in a maze, whose goals are places, (x, y) in metres.

    Args:
        maze: the layout.
        integrator: `implicitfast` or `rk4`.
        simulation: num_envs, horizon, action_repeat, threads, physics, device: see `MujocoEnv`.
    """

    maze: Maze
    model_of: Callable[[Maze, str], mujoco.MjModel]  # the body in a maze, with that integrator

    def __init__(self, maze: Maze, integrator: str, *simulation: Any) -> None:
        self.maze = maze
        self.goal_low, self.goal_high = maze.low, maze.high
        super().__init__(self.model_of(maze, integrator), *simulation)

    def feasible(self, goals: Array) -> Array:
        return self.maze.is_free(goals)

    def test_goals(self) -> FloatArray:
        return self.maze.tiles()


INTEGRATORS = {
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
}


def add_walls(spec: mujoco.MjSpec, maze: Maze, height: float, collide: bool) -> None:
    """Put the maze's walls into a model as boxes from the floor up.

    Args:
        spec: the model, changed in place.
        maze: the layout.
        height: of the walls, metres.
        collide: whether MuJoCo's contacts stop bodies at the walls.
    """
    for i, (x0, y0, x1, y1) in enumerate(maze.walls()):
        spec.worldbody.add_geom(
            name=f"wall_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[(x0 + x1) / 2, (y0 + y1) / 2, height / 2],
            size=[(x1 - x0) / 2, (y1 - y0) / 2, height / 2],
            contype=int(collide),
            conaffinity=int(collide),
            rgba=[0.55, 0.58, 0.62, 1.0],
        )
