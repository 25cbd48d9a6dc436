"""Many MuJoCo simulations of one body, stepped at once, and what mazes share.

The only place that knows `mujoco.batch`; `warp_batch` has its like for GPUs.
"""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from goalgan_bt.envs.arrays import Array, namespace, put
from goalgan_bt.envs.goal_env import GoalEnv, Ids, PhysicsError
from goalgan_bt.envs.maze import BoolArray, FloatArray, Maze


class MujocoEnv(GoalEnv):
    """A `GoalEnv` on MuJoCo; the state is qpos, qvel, and activations where there are any.

    Args:
        model: the compiled model.
        num_envs: N.
        horizon: steps of an episode.
        action_repeat: steps for which each action is held.
        threads: simulation threads, 0 for one per core. Results do not depend on it.
        physics: `mujoco`, or `warp` for mujoco-warp in single precision (extra `gpu`).
        device: of mujoco-warp: `cpu`, `cuda`, `cuda:1`, ...; `auto` is a GPU where there is one.

    Attributes:
        substeps: of the model, in each step.

    Raises:
        PhysicsError: if mujoco-warp, the device or what the model needs of them is missing.
    """

    substeps = 1

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

    def read_simulations(self) -> NDArray[np.floating]:
        return np.array(self.batch.state)

    def write_simulations(self, rows: NDArray[np.floating]) -> None:
        self.batch.state[:] = rows

    def advance(self, ids: Ids, actions: Array) -> None:
        self._ctrl[ids] = put(actions, self._ctrl)
        self.batch.step(ids, nstep=self.action_repeat * self.substeps)


def _batch(
    model: mujoco.MjModel, num_envs: int, threads: int, physics: str, device: str
) -> tuple[Any, Any]:
    """The simulations, and their states as rows of qpos, qvel and activations."""
    if physics == "warp":
        if model.na:
            raise PhysicsError("mujoco-warp takes no actuators with activations here")
        from goalgan_bt.envs.warp_batch import WarpBatch

        warp = WarpBatch(model, num_envs, device)
        return warp, warp.rows
    # A diverged simulation must end its episode, not be put back silently (Warp's never is).
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    batch = Batch(model, num_envs, threads)
    # A state row of MuJoCo is time, qpos, qvel, act, ...: ours is a slice of it, read in one go.
    rows = batch.state[:, 1 : 1 + model.nq + model.nv + model.na]
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

    def achieved_goals(self, states: Array) -> Array:
        """x, y, with which the state of most bodies begins, (n, 2)."""
        return states[:, :2]

    def place(self, states: FloatArray, goals: FloatArray) -> FloatArray:
        return np.concatenate([goals, states[:, 2:]], axis=1)

    def healthy(self, states: Array) -> Array:
        """Whether all numbers are finite, (n,): nothing else ends an episode of most bodies."""
        return namespace(states).isfinite(states).all(axis=1)

    def feasible(self, goals: Array) -> Array:
        return self.maze.is_free(goals)

    def free_goals(self, n: int, rng: np.random.Generator) -> FloatArray:
        return self.maze.sample_free(n, rng)

    def test_goals(self) -> FloatArray:
        return self.maze.tiles()

    def clear(self, places: FloatArray, by: float) -> BoolArray:
        """Whether squares of half-width `by` around places, (n, 2) metres, have their corners in
        free cells, (n,)."""
        free = np.ones(len(places), dtype=bool)
        for corner in by * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]):
            free &= self.maze.is_free(places + corner)
        return free


INTEGRATORS = {
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
}


def set_integrator(spec: mujoco.MjSpec, name: str) -> None:
    """Let a model have the integrator of that name; `own`: the one that it has."""
    if name != "own":
        spec.option.integrator = INTEGRATORS[name]


OURS = "goalgan_bt_"  # how the names of what is added to a model begin


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
            name=f"{OURS}wall_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[(x0 + x1) / 2, (y0 + y1) / 2, height / 2],
            size=[(x1 - x0) / 2, (y1 - y0) / 2, height / 2],
            contype=int(collide),
            conaffinity=int(collide),
            rgba=[0.55, 0.58, 0.62, 1.0],
        )
