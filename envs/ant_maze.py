"""The Ant in a maze: the original's physics on the body that gymnasium ships.

One step of 0.02 s per action, torques of at most 150 N m, no reset noise, success when the centre
of mass comes within 1 m of the goal, and an end without reward when the torso leaves 0.3 to 1.0 m
of height (Florensa et al. 2018). Contact-force observations are left out: they are zero or
redundant.
"""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from goalgan_bt.envs.batch import INTEGRATORS, MujocoEnv, add_walls
from goalgan_bt.envs.maze import BoolArray, FloatArray, Maze

TORSO_RADIUS = 0.25  # m
LEG_RADIUS = 0.08  # m
HEALTHY_Z = (0.3, 1.0)  # m, height of the torso
# Where each leg leaves the torso; hips turn about z, ankles about the horizontal normal.
LEGS = 0.2 * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])  # (4, 2) m
# A positive ankle angle lowers the feet 1 and 4 and lifts the feet 2 and 3 (half their length).
ANKLE_LIFT = 0.2 * np.sqrt(2) * np.array([-1.0, 1.0, 1.0, -1.0])  # m


def build_model(maze: Maze, integrator: str = "implicitfast") -> mujoco.MjModel:
    """gymnasium's Ant with the original's step, contacts and walls of 1 m."""
    path = Path(gymnasium.__file__).parent / "envs/mujoco/assets/ant.xml"
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.timestep = 0.02
    spec.option.integrator = INTEGRATORS[integrator]
    add_walls(spec, maze, height=1.0, collide=True)
    for geom in spec.geoms:
        geom.solref[:2] = [0.02, 1.0]
        geom.solimp[:3] = [0.8, 0.8, 0.01]
    # The original's contacts are soft: at full force the torso sinks 5 cm into a wall. A margin
    # makes them act 10 cm early for the torso alone, so that it stays out at any speed reached.
    spec.geom("torso_geom").margin = 0.1
    return spec.compile()


class AntMaze(MujocoEnv):
    """Walk to any point of a maze; success within 1 m.

    State: qpos (15: x, y, z in m, torso quaternion w, x, y, z, joint angles in rad) and qvel
    (14). Observation: the state, the offset from the centre of mass to the desired goal, and the
    same offset in the torso's heading, 33 numbers. Achieved goal: x, y of the centre of mass.
    """

    success_radius = 1.0
    act_dim = 8
    obs_dim = 33
    start_state = np.array([0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1] + [0] * 14, float)

    def __init__(
        self,
        maze: Maze,
        num_envs: int,
        horizon: int,
        action_repeat: int,
        threads: int,
        integrator: str,
    ) -> None:
        self.maze = maze
        self.goal_low, self.goal_high = maze.low, maze.high
        super().__init__(build_model(maze, integrator), num_envs, horizon, action_repeat, threads)
        self._maze = maze
        mass = self.model.body_mass
        first = self.model.body("front_left_leg").id  # upper leg (fixed), lower leg, foot
        self._leg_share, self._foot_share = mass[first + 1 : first + 3] / mass.sum()

    def observations(
        self, states: FloatArray, goals: FloatArray, achieved: FloatArray | None = None
    ) -> NDArray[np.float32]:
        obs = np.empty((len(states), self.obs_dim), dtype=np.float32)
        offset = goals - (self.achieved_goals(states) if achieved is None else achieved)
        forward = _rotation(states[:, 3:7])[0][:, :2]
        forward = forward / (np.linalg.norm(forward, axis=1, keepdims=True) + 1e-9)
        obs[:, :29] = states
        obs[:, 29:31] = offset
        obs[:, 31] = (offset * forward).sum(axis=1)
        obs[:, 32] = offset[:, 1] * forward[:, 0] - offset[:, 0] * forward[:, 1]
        return obs

    def achieved_goals(self, states: FloatArray) -> FloatArray:
        """Centre of mass of the whole Ant, (n, 2): what MuJoCo calls the torso's subtree_com.

        The torso and the upper legs are symmetric. A lower leg d, from hip to knee, has its
        middle at d / 2, the foot below it at d (1 + cos ankle) plus its height.
        """
        hip, ankle = states[:, 7:15:2], states[:, 8:15:2]  # (n, 4) rad
        weight = self._leg_share / 2 + self._foot_share * (1 + np.cos(ankle))
        cos, sin = weight * np.cos(hip), weight * np.sin(hip)
        x = cos @ LEGS[:, 0] - sin @ LEGS[:, 1]
        y = sin @ LEGS[:, 0] + cos @ LEGS[:, 1]
        z = self._foot_share * (np.sin(ankle) @ ANKLE_LIFT)
        along_x, along_y, along_z = _rotation(states[:, 3:7])
        com = along_x * x[:, None] + along_y * y[:, None] + along_z * z[:, None]
        return states[:, :2] + com[:, :2]

    def place(self, states: FloatArray, goals: FloatArray) -> FloatArray:
        moved = states.copy()
        moved[:, :2] += goals - self.achieved_goals(states)
        return moved

    def healthy(self, states: FloatArray) -> BoolArray:
        low, high = HEALTHY_Z
        with np.errstate(invalid="ignore"):
            upright = (states[:, 2] >= low) & (states[:, 2] <= high)
        return np.asarray(upright & np.isfinite(states).all(axis=1))

    def valid(self, states: FloatArray) -> BoolArray:
        """Healthy, the torso a radius away from every wall, no knee or foot inside one."""
        free = self.healthy(states)
        for corner in TORSO_RADIUS * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]):
            free &= self._maze.is_free(states[:, :2] + corner)
        return np.asarray(free & self._maze.is_free(self._joints(states)).all(axis=1))

    def feasible(self, goals: FloatArray) -> BoolArray:
        return self._maze.is_free(goals)

    def test_goals(self) -> FloatArray:
        return self._maze.tiles()

    def repair(self, states: FloatArray) -> FloatArray:
        """The torso's quaternion brought back to length 1."""
        states = states.copy()
        states[:, 3:7] /= np.linalg.norm(states[:, 3:7], axis=1, keepdims=True) + 1e-9
        return states

    def _joints(self, states: FloatArray) -> FloatArray:
        """Where knees and feet are on the map, (n, 8, 2), metres."""
        hip, ankle = states[:, 7:15:2, None], states[:, 8:15:2, None]  # (n, 4, 1) rad
        leg = np.cos(hip) * LEGS + np.sin(hip) * LEGS[:, ::-1] * (-1, 1)  # (n, 4, 2)
        flat = np.concatenate([LEGS + leg, LEGS + leg + 2 * np.cos(ankle) * leg], axis=1)
        lift = 2 * np.sin(ankle[..., 0]) * ANKLE_LIFT
        height = np.concatenate([np.zeros_like(lift), lift], axis=1)
        along_x, along_y, along_z = (axis[:, None, :2] for axis in _rotation(states[:, 3:7]))
        turned = along_x * flat[..., :1] + along_y * flat[..., 1:] + along_z * height[..., None]
        return states[:, None, :2] + turned


def _rotation(quaternion: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where unit quaternions (w, x, y, z), (n, 4), turn the x, y and z axes, each (n, 3)."""
    w, x, y, z = quaternion.T
    along_x = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    along_y = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
    along_z = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    return along_x, along_y, along_z
