"""A simulation as MuJoCo draws it: the body, the walls, start and goal."""

import time
import warnings
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from goalgan_bt.envs.goal_env import GoalEnv, PhysicsError
from goalgan_bt.envs.maze import FloatArray

START, GOAL = (0.2, 0.4, 0.9, 0.5), (0.9, 0.2, 0.2, 0.5)  # RGBA
FLAT = 0.02  # m, half the height of the discs that mark them
HEIGHT = 1.1  # times what the whole map needs: how far the camera stands off
NO_GL = (
    "pictures need OpenGL, which is not to be had here: on a machine without a screen set the "
    "environment variable MUJOCO_GL to egl or osmesa before Python starts"
)


class Picture:
    """Draws states of an environment's body.

    Args:
        env: whose model is drawn.
        width, height: pixels.
    """

    def __init__(self, env: GoalEnv, width: int, height: int) -> None:
        self._env, self._model = env, env.model  # type: ignore[attr-defined]
        self._data = mujoco.MjData(self._model)
        visual = self._model.vis.global_
        visual.offwidth, visual.offheight = (
            max(width, visual.offwidth),
            max(height, visual.offheight),
        )
        self._size = height, width
        self._renderer: Any = None
        self._window: Any = None
        self._due = 0.0  # when the window may show the next state
        self._camera = mujoco.MjvCamera()
        low, high = env.goal_low, env.goal_high
        self._camera.lookat[:2] = (low + high) / 2
        half = max((high - low)[1], (high - low)[0] * height / width) / 2
        self._camera.distance = HEIGHT * half / np.tan(np.radians(visual.fovy / 2))
        self._camera.elevation, self._camera.azimuth = -75.0, 90.0

    def draw(self, state: FloatArray, goal: FloatArray) -> NDArray[np.uint8]:
        """The body in a state, (state_dim,), and its goal, (goal_dim,): (height, width, 3).

        Raises:
            PhysicsError: where there is no OpenGL.
        """
        self._put(state)
        if self._renderer is None:
            try:
                self._renderer = mujoco.Renderer(self._model, *self._size)
            except Exception as error:  # each platform's library has errors of its own
                raise PhysicsError(NO_GL) from error
        self._renderer.update_scene(self._data, self._camera)
        self._mark(self._renderer.scene, goal)
        return np.asarray(self._renderer.render())

    def show(self, state: FloatArray, goal: FloatArray, seconds: float) -> None:
        """The same in a window, at least so long after the last time.

        Raises:
            PhysicsError: where there is no screen.
        """
        self._put(state)
        if self._window is None:
            import glfw
            from mujoco import viewer

            with warnings.catch_warnings(action="ignore"):
                screen = glfw.init()  # where there is none, the viewer would end this process
            if not screen:
                raise PhysicsError("a window needs a screen: use rgb_array instead")
            try:
                self._window = viewer.launch_passive(self._model, self._data)
            except Exception as error:
                raise PhysicsError("a window needs a screen: use rgb_array instead") from error
            self._window.cam.lookat[:] = self._camera.lookat
            self._window.cam.distance = self._camera.distance
            self._window.cam.elevation = self._camera.elevation
            self._window.cam.azimuth = self._camera.azimuth
        if self._window.user_scn is not None:
            self._window.user_scn.ngeom = 0
            self._mark(self._window.user_scn, goal)
        time.sleep(max(0.0, self._due - time.monotonic()))
        self._window.sync()
        self._due = time.monotonic() + seconds

    def close(self) -> None:
        """Let go of what draws."""
        for drawer in (self._renderer, self._window):
            if drawer is not None:
                drawer.close()
        self._renderer = self._window = None

    def _put(self, state: FloatArray) -> None:
        nq, end = self._model.nq, self._model.nq + self._model.nv  # activations may follow
        self._data.qpos[:], self._data.qvel[:] = state[:nq], state[nq:end]
        mujoco.mj_forward(self._model, self._data)

    def _mark(self, scene: Any, goal: FloatArray) -> None:
        """Discs on the floor: where episodes begin, and what counts as the goal."""
        radius = self._env.success_radius
        start = self._env.achieved_goals(self._env.start_state[None])[0]
        for place, size, colour in ((start, radius / 2, START), (goal, radius, GOAL)):
            if scene.ngeom >= scene.maxgeom:
                return
            mujoco.mjv_initGeom(
                scene.geoms[scene.ngeom],
                mujoco.mjtGeom.mjGEOM_CYLINDER,
                np.array([size, size, FLAT]),
                np.array([*place, FLAT]),
                np.eye(3).flatten(),
                np.array(colour, dtype=np.float32),
            )
            scene.ngeom += 1
