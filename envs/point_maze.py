"""The point mass in a maze: force-driven and undamped (Florensa et al. 2018).

A sphere of 0.1 m and 0.419 kg under a force of at most 2 N per axis (4.77 m/s^2), 0.02 s a step.
Walls stop it dead on the axis that hits them and let it slide along the other: an inelastic,
frictionless contact that holds at any speed.
"""

from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

from goalgan_bt.envs.arrays import Array, namespace, put
from goalgan_bt.envs.goal_env import Ids, observed
from goalgan_bt.envs.maze import BoolArray, FloatArray, Maze
from goalgan_bt.envs.mujoco_env import MazeEnv, add_walls, set_integrator

RADIUS = 0.1  # m


def build_model(maze: Maze, integrator: str) -> mujoco.MjModel:
    """gymnasium-robotics' point body with the original's mass, force, step and walls."""
    # Found, not imported: importing gymnasium-robotics takes a second and prints a notice.
    package = find_spec("gymnasium_robotics")
    assert package is not None and package.origin is not None
    path = Path(package.origin).parent / "envs/assets/point/point.xml"
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.timestep = 0.02
    set_integrator(spec, integrator)
    spec.geom("particle_geom").density = 100.0
    spec.geom("particle_geom").rgba = [0.9, 0.35, 0.15, 1.0]
    for joint in spec.joints:
        joint.damping = np.zeros_like(joint.damping)
    for actuator in spec.actuators:
        actuator.gear[0] = 2.0  # N per unit of action
    add_walls(spec, maze, height=0.4, collide=False)  # `Maze.slide` stops the body
    # The level ground cannot act on a body that moves in its plane: nothing constrains it.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return spec.compile()


class PointMaze(MazeEnv):
    """Reach any point of a maze by pushing; success within 0.3 m.

    State: x, y (m), vx, vy (m/s). Observation: see `goal_env.observed`. Achieved goal: x, y.
    """

    success_radius = 0.3
    act_dim = 2
    model_of = staticmethod(build_model)
    start_state = np.zeros(4)

    def advance(self, ids: Ids, actions: Array) -> None:
        # Views and no indices where everybody moves: with few simulations they are what costs.
        everyone = len(ids) == self.num_envs
        some = slice(None) if everyone else ids
        xp = namespace(self._qpos)
        self._ctrl[some] = put(actions, self._ctrl)
        position = xp.asarray(self._qpos[some], copy=True)
        for _ in range(self.action_repeat):
            self.batch.step(None if everyone else ids)
            position, stopped = self.maze.slide(position, self._qpos[some], RADIUS)
            self._qpos[some] = position
            self._qvel[some] = xp.where(stopped, 0.0, self._qvel[some])

    def observations(self, states: Array, goals: Array, achieved: Array | None = None) -> Array:
        return observed(self, states, goals)

    def valid(self, states: FloatArray) -> BoolArray:
        return self.healthy(states) & self.maze.is_free(states[:, :2])
