"""A robot of one's own in a maze: derive from `RobotMaze` and say what the robot is.

    class Quadruped(RobotMaze):
        healthy_z = (0.3, 1.5)

        @classmethod
        def robot(cls):
            return mujoco.MjSpec.from_file("quadruped.xml")

    python -m goalgan_bt.train --env my_robot:Quadruped

`docs/custom_env.md` adds a robot from start to finish.
"""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np

from goalgan_bt.envs.arrays import Array, like, namespace
from goalgan_bt.envs.goal_env import Ids, PhysicsError
from goalgan_bt.envs.maze import BoolArray, FloatArray, Maze
from goalgan_bt.envs.mujoco_env import OURS, MazeEnv, add_walls, set_integrator
from goalgan_bt.envs.rotations import (
    ahead_and_left,
    axes_on_map,
    unit_on_map,
    uprightness,
    with_unit_quaternion,
)


class RobotMaze(MazeEnv):
    """Walk, roll or fly a robot to any point of a maze.

    The robot is a MuJoCo model whose first joint is a free one; the body that it moves is called
    the torso here. State: qpos, qvel, and the activations of actuators that have any. Achieved
    goal: x, y of the torso. Actions: -1 to 1 is the range of each actuator's control.

    Observation: height and uprightness of the torso, joint angles, vertical speed, spin, joint
    velocities, activations; then along the robot's front and to its left the squashed straight
    offset to the goal and that along the way, the velocity, and the lean of the torso. Without a
    heading also where it is, and where its front points.

    What a robot says, as attributes of its class:
        healthy_z: metres, between which heights of the torso an episode goes on.
        upright: the least cosine of the torso's lean with which it does; -1 lets it lie.
        success_radius: metres from the goal to the torso at which it is reached.
        clearance: metres that the torso keeps from walls where a state is judged valid.
        wall_height: metres.
        step_seconds: of an environment step, a multiple of the model's own.
        usual_horizon: steps of an episode in the U-maze; in longer mazes it grows with the way.
        preset: settings by name; `like` names the environment whose preset holds otherwise.
    """

    healthy_z: tuple[float, float] = (0.0, math.inf)
    upright: float = -1.0
    success_radius: float = 1.0
    clearance: float = 0.25
    wall_height: float = 1.0
    step_seconds: float = 0.02
    usual_horizon: int = 500
    preset: ClassVar[Mapping[str, Any]] = {"like": "ant_umaze"}

    @classmethod
    def robot(cls) -> mujoco.MjSpec:
        """The robot's model, without a maze. It may have a floor, and must have nothing else that
        moves."""
        raise NotImplementedError

    @classmethod
    def model_of(cls, maze: Maze, integrator: str) -> mujoco.MjModel:
        """The robot among walls, on a floor if it brings none.

        Raises:
            PhysicsError: for a model that cannot be such a robot.
        """
        spec = cls.robot()
        set_integrator(spec, integrator)
        add_walls(spec, maze, height=cls.wall_height, collide=True)
        floors = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD
        if not any(geom.type in floors for geom in spec.worldbody.geoms):
            spec.worldbody.add_geom(
                name=f"{OURS}floor",
                type=mujoco.mjtGeom.mjGEOM_PLANE,
                size=[40, 40, 1],
                contype=1,
                conaffinity=1,
            )
        model = spec.compile()
        name = cls.__name__
        free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
        if not free.any() or not free[0] or free[1:].any():
            raise PhysicsError(
                f"{name}: the first joint of its model must be a free joint, and none of the others"
            )
        if not model.nu or not model.actuator_ctrllimited.all():
            raise PhysicsError(f"{name}: each of its actuators must have a ctrlrange")
        many = cls.step_seconds / model.opt.timestep
        if round(many) < 1 or abs(many - round(many)) > 1e-6:
            raise PhysicsError(
                f"{name}: its step of {cls.step_seconds} s must be a multiple of the model's, "
                f"{model.opt.timestep} s"
            )
        return model

    def __init__(self, maze: Maze, integrator: str, *simulation: Any) -> None:
        super().__init__(maze, integrator, *simulation)
        model = self.model
        self.act_dim = model.nu
        self.substeps = round(self.step_seconds / model.opt.timestep)
        self.dt = self.substeps * model.opt.timestep
        low, high = model.actuator_ctrlrange.T
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        pose = self.pose(model)
        pose[:2] = 0.0
        self.start_state = np.concatenate([pose, np.zeros(model.nv + model.na)])
        self._joints = slice(7, model.nq)
        name = type(self).__name__
        if not self.success_radius > 0:
            raise PhysicsError(f"{name}: its success_radius must be above 0")
        if not self.healthy(self.start_state[None]).all():
            raise PhysicsError(
                f"{name}: the pose in which it begins ends an episode: see healthy_z, upright, pose"
            )

    def pose(self, model: mujoco.MjModel) -> FloatArray:
        """qpos in which episodes begin, (nq,), but for where: that of the model's first keyframe,
        or of the model itself where it has none."""
        return np.array(model.key_qpos[0] if model.nkey else model.qpos0)

    def controls(self, actions: Array) -> Array:
        """What actions in [-1, 1], (n, nu), are as controls of the actuators."""
        return actions * like(self._half, actions) + like(self._middle, actions)

    def advance(self, ids: Ids, actions: Array) -> None:
        super().advance(ids, self.controls(actions))

    @property
    def obs_dim(self) -> int:
        """Size of an observation."""
        return self.state_dim + 1 + (4 if self.heading is None else 0)

    def observations(self, states: Array, goals: Array, achieved: Array | None = None) -> Array:
        xp, qvel = namespace(states), self.model.nq
        achieved = self.achieved_goals(states) if achieved is None else achieved
        along_x, _, along_z = axes_on_map(states[:, 3:7])
        front = unit_on_map(along_x)
        seen = [
            states[:, 2],
            uprightness(states[:, 3:7]),
            *states[:, self._joints].T,
            *states[:, qvel + 2 :].T,
        ]
        for vector in (
            self.squashed(goals - achieved),
            self.squashed(self.along(achieved, goals)),
            states[:, qvel : qvel + 2],
            along_z,
        ):
            seen += ahead_and_left(vector, front)
        if self.heading is None:
            seen += [*states[:, :2].T, *front.T]
        return xp.asarray(xp.stack(seen, axis=1), dtype=xp.float32)

    def healthy(self, states: Array) -> Array:
        low, high = self.healthy_z
        with np.errstate(invalid="ignore"):
            fine = (states[:, 2] >= low) & (states[:, 2] <= high)
            fine &= uprightness(states[:, 3:7]) >= self.upright
        return fine & namespace(states).isfinite(states).all(axis=1)

    def valid(self, states: FloatArray) -> BoolArray:
        """Healthy, and the torso away from every wall."""
        return np.asarray(self.healthy(states) & self.clear(states[:, :2], self.clearance))

    def repair(self, states: FloatArray) -> FloatArray:
        """The torso's quaternion brought back to length 1."""
        return with_unit_quaternion(states)
