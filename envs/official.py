"""gymnasium-robotics' own mazes, to the letter: AntMaze_UMaze-v5, PointMaze_UMaze-v3 and the like.

Cells of 4 m (Ant) or 1 m (point), success within 0.45 m, steps of 0.01 s with the integrators of
the official models (RK4, Euler), of which the Ant holds an action for five; no fall ends an
episode. Many at once, and bit for bit what the official environment does from the same state.

Two things differ, for learning. Official episodes begin anywhere; here, where the policy shall
learn to reach all places from one, they begin in the first free cell of the map as it is written.
And an official episode goes on after success, while here success ends it.
"""

import importlib.util
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

from goalgan_bt.envs.ant_maze import AntMaze
from goalgan_bt.envs.arrays import Array, namespace, put
from goalgan_bt.envs.goal_env import Ids
from goalgan_bt.envs.maze import FloatArray, Maze
from goalgan_bt.envs.mujoco_env import MazeEnv, set_integrator
from goalgan_bt.envs.point_maze import PointMaze

RADIUS = 0.45  # m, of success
TASKS = {  # layout: its name there, and the steps of an episode
    "umaze": ("U_MAZE", {"ant": 700, "point": 300}),
    "medium": ("MEDIUM_MAZE", {"ant": 1000, "point": 600}),
    "large": ("LARGE_MAZE", {"ant": 1000, "point": 800}),
}
FASTEST = 5.0  # m/s of the point


def layout(name: str, cell_size: float) -> Maze:
    """The official map of that name, with its middle at the origin."""
    home = _package() / "envs/maze/maps.py"
    spec = importlib.util.spec_from_file_location("goalgan_bt_official_maps", home)
    assert spec is not None and spec.loader is not None
    maps = importlib.util.module_from_spec(spec)  # without the package, which takes a second
    spec.loader.exec_module(maps)
    cells = np.array(getattr(maps, TASKS[name][0]))
    first = np.argwhere(cells == 0)[0]
    text = np.where(cells == 1, "#", ".")
    text[tuple(first)] = "S"
    row, column = (first + 0.5) * cell_size
    height, width = np.array(cells.shape) * cell_size / 2
    start = float(column - width), float(height - row)
    return Maze(tuple("".join(line) for line in text), cell_size, start)


def _package() -> Path:
    """Where gymnasium-robotics is."""
    package = importlib.util.find_spec("gymnasium_robotics")
    assert package is not None and package.origin is not None
    return Path(package.origin).parent


def _among_walls(body: Path, maze: Maze, height: float, integrator: str) -> mujoco.MjModel:
    """A body in a maze as the official code makes it: a block for each cell of wall."""
    spec = mujoco.MjSpec.from_file(str(body))
    set_integrator(spec, integrator)
    side = maze.cell_size
    rows, columns = maze.free.shape
    for row in range(rows):
        for column in range(columns):
            if maze.free[rows - 1 - row, column]:  # rows of the map come from above
                continue
            x = (column + 0.5) * side - columns / 2 * side
            y = rows / 2 * side - (row + 0.5) * side
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[x, y, height / 2 * side],
                size=[0.5 * side, 0.5 * side, height / 2 * side],
                contype=1,
                conaffinity=1,
                rgba=[0.7, 0.5, 0.3, 1.0],
            )
    return spec.compile()


class OfficialAnt(AntMaze):
    """The Ant of AntMaze_...-v5: gymnasium's, with all its own physics.

    As `AntMaze`, but that the achieved goal is where the torso is, and that no state ends an
    episode: an Ant on its back is there to stay.
    """

    success_radius = RADIUS
    substeps = 5
    # Those of most bodies, and not the centre of mass, and not the height that ours must keep.
    achieved_goals, place, healthy = MazeEnv.achieved_goals, MazeEnv.place, MazeEnv.healthy

    @staticmethod
    def model_of(maze: Maze, integrator: str) -> mujoco.MjModel:
        """gymnasium's Ant among official walls."""
        body = Path(gymnasium.__file__).parent / "envs/mujoco/assets/ant.xml"
        return _among_walls(body, maze, 0.5, integrator)

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.dt = self.substeps * self.model.opt.timestep
        self.start_state = np.concatenate([self.model.qpos0, np.zeros(self.model.nv)])
        self.start_state[:2] = self.maze.start

    def test_goals(self) -> FloatArray:
        return self.maze.tiles(self.maze.cell_size / 4)  # 16 of a cell, as of one of 2 m


class OfficialPoint(PointMaze):
    """The point of PointMaze_...-v3: at most 5 m/s fast when a step begins, and stopped by MuJoCo's
    contacts."""

    success_radius = RADIUS

    @staticmethod
    def model_of(maze: Maze, integrator: str) -> mujoco.MjModel:
        """gymnasium-robotics' point among official walls."""
        return _among_walls(_package() / "envs/assets/point/point.xml", maze, 0.4, integrator)

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.start_state = np.array([*self.maze.start, 0.0, 0.0])

    def advance(self, ids: Ids, actions: Array) -> None:
        self._ctrl[ids] = put(actions, self._ctrl)
        xp = namespace(self._qvel)
        for _ in range(self.action_repeat):
            self._qvel[ids] = xp.clip(self._qvel[ids], -FASTEST, FASTEST)
            self.batch.step(ids)


def make(
    name: str, maze: Maze | None, integrator: str, num_envs: int, horizon: int | None, *how: Any
) -> MazeEnv:
    """Simulations of an official task.

    Args:
        name: `point_umaze_gym` and the like.
        maze: that of a run, which is the official one; None: that.
        integrator: `own` is the official one.
        num_envs: N.
        horizon: steps of an episode; None: the official number.
        how: action_repeat, threads, physics, device, see `MujocoEnv`.
    """
    body, named, _ = name.split("_")
    kind, side = {"ant": (OfficialAnt, 4.0), "point": (OfficialPoint, 1.0)}[body]
    usual = TASKS[named][1][body]
    env = kind(maze or layout(named, side), integrator, num_envs, horizon or usual, *how)
    env.name = name
    return env
