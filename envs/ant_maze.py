"""The Ant in a maze: the original's physics on the body that gymnasium ships.

One step of 0.02 s per action, torques of at most 150 N m, no reset noise, success when the centre
of mass comes within 1 m of the goal, and an end without reward when the torso leaves 0.3 to 1.0 m
of height (Florensa et al. 2018). Contact-force observations are left out: they are zero or
redundant.
"""

from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

from goalgan_bt.envs.arrays import Array, columns, like, namespace
from goalgan_bt.envs.maze import BoolArray, FloatArray, Maze
from goalgan_bt.envs.mujoco_env import MazeEnv, add_walls, set_integrator
from goalgan_bt.envs.rotations import (
    ahead_and_left,
    axes_on_map,
    unit_on_map,
    with_unit_quaternion,
)

TORSO_RADIUS = 0.25  # m
LEG_RADIUS = 0.08  # m
HEALTHY_Z = (0.3, 1.0)  # m, height of the torso
# Where each leg leaves the torso; hips turn about z, ankles about the horizontal normal.
LEGS = 0.2 * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])  # (4, 2) m
# A positive ankle angle lowers the feet 1 and 4 and lifts the feet 2 and 3 (half their length).
ANKLE_LIFT = 0.2 * np.sqrt(2) * np.array([-1.0, 1.0, 1.0, -1.0])  # m

# The Ant with its legs renumbered by k quarter turns: joint j (hip, ankle, hip, ...) is the old
# joint JOINT[k, j] times JOINT_SIGN[k, j]. Motors are numbered from leg 4 on.
_LEG = (np.arange(4) + np.arange(4)[:, None]) % 4  # [k, leg]
JOINT = np.stack([2 * _LEG, 2 * _LEG + 1], axis=2).reshape(4, 8)
_SIGN = np.sign(ANKLE_LIFT) * np.sign(ANKLE_LIFT)[_LEG]
JOINT_SIGN = np.stack([np.ones((4, 4)), _SIGN], axis=2).reshape(4, 8)
MOTOR = (np.roll(JOINT, 2, axis=1) + 2) % 8
MOTOR_SIGN = np.roll(JOINT_SIGN, 2, axis=1)


def build_model(maze: Maze, integrator: str) -> mujoco.MjModel:
    """gymnasium's Ant with the original's step, contacts and walls of 1 m."""
    path = Path(gymnasium.__file__).parent / "envs/mujoco/assets/ant.xml"
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.timestep = 0.02
    set_integrator(spec, integrator)
    add_walls(spec, maze, height=1.0, collide=True)
    for geom in spec.geoms:
        geom.solref[:2] = [0.02, 1.0]
        geom.solimp[:3] = [0.8, 0.8, 0.01]
    # The original's contacts are soft: at full force the torso sinks 5 cm into a wall. A margin
    # makes them act 10 cm early for the torso alone, so that it stays out at any speed reached.
    spec.geom("torso_geom").margin = 0.1
    return spec.compile()


class AntMaze(MazeEnv):
    """Walk to any point of a maze; success within 1 m.

    State: qpos (15: x, y, z in m, torso quaternion w, x, y, z, joint angles in rad) and qvel
    (14). Achieved goal: x, y of the centre of mass.

    The Ant looks the same after a quarter turn with its legs renumbered. The policy sees it, and
    moves it, in the one of the four equal numberings whose front points most nearly along the way
    to the goal (at the goal where there is no heading): what it learns about walking one way holds
    for all. Offsets are squashed: the Ant walks towards goals which it has never reached as it does
    to nearer ones.

    Observation with a heading, 29 numbers: height, joint angles, vertical speed, spin and joint
    velocities, so numbered; then along the front and to its left the straight offset from the
    centre of mass to the goal, the offset along the way, the velocity, and the lean of the torso.

    Without one, 39: qpos and qvel so numbered; the straight offset; the front's direction; then
    along the front and to its left the same offset, the velocity and the lean.
    """

    success_radius = 1.0
    act_dim = 8
    model_of = staticmethod(build_model)
    start_state = np.array([0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1] + [0] * 14, float)

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        mass = self.model.body_mass
        first = self.model.body("front_left_leg").id  # upper leg (fixed), lower leg, foot
        nothing = np.empty(0)
        self._seen = nothing, nothing, nothing  # states, goals and turns of the last observations
        self._leg_share, self._foot_share = (mass[first + 1 : first + 3] / mass.sum()).tolist()

    @property
    def obs_dim(self) -> int:
        """Size of an observation."""
        return 39 if self.heading is None else 29

    def observations(self, states: Array, goals: Array, achieved: Array | None = None) -> Array:
        xp = namespace(states)
        achieved = self.achieved_goals(states) if achieved is None else achieved
        along = self.along(achieved, goals)
        turns = self._turns(states, goals, along)
        if isinstance(states, np.ndarray):  # what the policy answers is in the same numbering
            self._seen = states.copy(), goals.copy(), turns
        states = renumbered(states, turns)
        along_x, _, along_z = axes_on_map(states[:, 3:7])
        front = unit_on_map(along_x)
        straight, offset = self.squashed(goals - achieved), self.squashed(along)
        shape = (states.shape[0], self.obs_dim)  # and no len(): that cannot be traced
        obs = xp.empty(shape, dtype=xp.float32, device=states.device)
        if self.heading is None:
            obs[:, :29], obs[:, 29:31], obs[:, 31:33] = states, straight, front
        else:
            obs[:, 0], obs[:, 1:9], obs[:, 9:21] = states[:, 2], states[:, 7:15], states[:, 17:]
            obs[:, 21], obs[:, 22] = ahead_and_left(straight, front)
        obs[:, -6], obs[:, -5] = ahead_and_left(offset, front)
        obs[:, -4], obs[:, -3] = ahead_and_left(states[:, 15:17], front)
        obs[:, -2], obs[:, -1] = ahead_and_left(along_z, front)
        return obs

    def to_body(self, actions: Array, states: Array, goals: Array) -> Array:
        seen = self._seen
        if isinstance(states, np.ndarray) and all(map(np.array_equal, (states, goals), seen[:2])):
            return _renumber_actions(actions, -seen[2])
        return _renumber_actions(actions, -self._turns(states, goals))

    def from_body(self, actions: Array, states: Array, goals: Array) -> Array:
        return _renumber_actions(actions, self._turns(states, goals))

    def _turns(self, states: Array, goals: Array, along: Array | None = None) -> Array:
        """By how many quarter turns to the left each front is off its way, (n,)."""
        if self.heading is None:  # from the torso: no need of the centre of mass
            return quarter_turns(states, goals)
        along = self.along(self.achieved_goals(states), goals) if along is None else along
        return quarter_turns(states, states[:, :2] + along)

    def achieved_goals(self, states: Array) -> Array:
        """Centre of mass of the whole Ant, (n, 2): what MuJoCo calls the torso's subtree_com.

        The torso and the upper legs are symmetric. A lower leg d, from hip to knee, has its
        middle at d / 2, the foot below it at d (1 + cos ankle) plus its height.
        """
        xp = namespace(states)
        legs, lift = like(LEGS, states), like(ANKLE_LIFT, states)
        hip, ankle = states[:, 7:15:2], states[:, 8:15:2]  # (n, 4) rad
        weight = self._leg_share / 2 + self._foot_share * (1 + xp.cos(ankle))
        cos, sin = weight * xp.cos(hip), weight * xp.sin(hip)
        # Sums of products, and no matrix products: those round differently in other batches.
        x = (cos * legs[:, 0] - sin * legs[:, 1]).sum(axis=1)
        y = (sin * legs[:, 0] + cos * legs[:, 1]).sum(axis=1)
        z = self._foot_share * (xp.sin(ankle) * lift).sum(axis=1)
        along_x, along_y, along_z = axes_on_map(states[:, 3:7])
        com = along_x * x[:, None] + along_y * y[:, None] + along_z * z[:, None]
        return states[:, :2] + com

    def place(self, states: FloatArray, goals: FloatArray) -> FloatArray:
        moved = states.copy()
        moved[:, :2] += goals - self.achieved_goals(states)
        return moved

    def healthy(self, states: Array) -> Array:
        low, high = HEALTHY_Z
        with np.errstate(invalid="ignore"):
            upright = (states[:, 2] >= low) & (states[:, 2] <= high)
        return upright & namespace(states).isfinite(states).all(axis=1)

    def valid(self, states: FloatArray) -> BoolArray:
        """Healthy, the torso a radius away from every wall, no knee or foot inside one."""
        free = self.healthy(states) & self.clear(states[:, :2], TORSO_RADIUS)
        return np.asarray(free & self.maze.is_free(self._joints(states)).all(axis=1))

    def repair(self, states: FloatArray) -> FloatArray:
        """The torso's quaternion brought back to length 1."""
        return with_unit_quaternion(states)

    def _joints(self, states: FloatArray) -> FloatArray:
        """Where knees and feet are on the map, (n, 8, 2), metres."""
        hip, ankle = states[:, 7:15:2, None], states[:, 8:15:2, None]  # (n, 4, 1) rad
        leg = np.cos(hip) * LEGS + np.sin(hip) * LEGS[:, ::-1] * (-1, 1)  # (n, 4, 2)
        flat = np.concatenate([LEGS + leg, LEGS + leg + 2 * np.cos(ankle) * leg], axis=1)
        lift = 2 * np.sin(ankle[..., 0]) * ANKLE_LIFT
        height = np.concatenate([np.zeros_like(lift), lift], axis=1)
        along_x, along_y, along_z = axes_on_map(states[:, 3:7])[:, :, None]
        turned = along_x * flat[..., :1] + along_y * flat[..., 1:] + along_z * height[..., None]
        return states[:, None, :2] + turned


def quarter_turns(states: Array, goals: Array) -> Array:
    """By how many quarter turns to the left each Ant's front is off its goal, (n,), 0 to 3."""
    xp = namespace(states)
    w, x, y, z = columns(states[:, 3:7])
    front = xp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z)])  # the x axis on the map
    ahead, left = ahead_and_left(goals - states[:, :2], front.T)
    turns = xp.where(abs(ahead) >= abs(left), 1 - xp.sign(ahead), 2 - xp.sign(left))
    return xp.asarray(turns, dtype=xp.int64)


def renumbered(states: Array, turns: Array) -> Array:
    """The same physical states with the front turned left and the legs renumbered, (n, 29).

    Args:
        states: (n, 29).
        turns: (n,) integers, quarter turns.
    """
    xp = namespace(states)
    angle = turns * (np.pi / 2)
    cos, sin = xp.cos(angle), xp.sin(angle)
    out = xp.asarray(states, copy=True)
    half_cos, half_sin = xp.cos(angle / 2), xp.sin(angle / 2)
    w, x, y, z = states[:, 3:7].T
    out[:, 3] = w * half_cos - z * half_sin  # the quaternion times a turn about z
    out[:, 4] = x * half_cos + y * half_sin
    out[:, 5] = y * half_cos - x * half_sin
    out[:, 6] = z * half_cos + w * half_sin
    out[:, 3:7] *= xp.where(out[:, 3:4] < 0, -1.0, 1.0)  # q and -q are the same rotation
    out[:, 18] = cos * states[:, 18] + sin * states[:, 19]  # spin is told in the torso's frame
    out[:, 19] = cos * states[:, 19] - sin * states[:, 18]
    row, joint = _rows(states), like(JOINT, states)[turns % 4]
    sign = like(JOINT_SIGN, states)[turns % 4]
    out[:, 7:15] = states[row, 7 + joint] * sign
    out[:, 21:29] = states[row, 21 + joint] * sign
    return out


def _renumber_actions(actions: Array, turns: Array) -> Array:
    """Torques for legs renumbered as in `renumbered`, (n, 8)."""
    moved = actions[_rows(actions), like(MOTOR, actions)[turns % 4]]
    return moved * like(MOTOR_SIGN, actions)[turns % 4]


def _rows(array: Array) -> Array:
    """Indices that pick from every row, (n, 1)."""
    return namespace(array).arange(array.shape[0], device=array.device)[:, None]
