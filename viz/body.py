"""Bodies in the scene: MuJoCo's own geometry through mjviser, spheres where there is no model."""

import copy

import mujoco
import numpy as np
import viser
from mjviser import ViserMujocoScene

from goalgan_bt.envs.maze import FloatArray

MOVING, FIXED = "/bodies", "/fixed_bodies"  # as mjviser calls them
POINTS = "/points"
HIDDEN = 3  # a geom group that mjviser does not show


class Bodies:
    """Bodies of one kind, drawn where their states say, any number of them.

    Args:
        server: whose scene it is.
        model: the MuJoCo model, or None: then states begin with the position of a point mass.
        offset: (x, y) of their world in the scene, metres; None: the first body is kept in the
            middle, as on a treadmill.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        model: mujoco.MjModel | None,
        offset: tuple[float, float] | None = (0.0, 0.0),
    ) -> None:
        self._server, self._offset, self._middle = server, offset, (0.0, 0.0)
        self._model = None if model is None else copy.copy(model)
        if self._model is None:
            return
        self._model.site_group[:] = HIDDEN
        self._data = mujoco.MjData(self._model)
        self._scene = ViserMujocoScene(server, self._model, 1)
        self._scene.camera_tracking_enabled = False  # world coordinates, as all other layers
        self._switch(FIXED, False)  # walls and floor: `Scene` draws them
        self._move(offset or (0.0, 0.0))

    def show(self, visible: bool) -> None:
        """Show or hide the bodies."""
        self._switch(MOVING if self._model is not None else POINTS, visible)

    def remove(self) -> None:
        """Take them out of the scene."""
        for name in (MOVING, FIXED, POINTS):
            node = self._server.scene.get_handle_by_name(name)
            if node is not None:
                node.remove()

    @property
    def middle(self) -> tuple[float, float]:
        """Where the first body is that is kept in the middle, (x, y) metres."""
        return self._middle

    def draw(self, states: FloatArray) -> None:
        """Put the bodies into these states, (n, state_dim)."""
        if self._model is None:
            points = np.zeros((len(states), 3), dtype=np.float32)
            points[:, :2], points[:, 2] = states[:, :2] + (self._offset or (0, 0)), 0.1
            self._server.scene.add_point_cloud(
                POINTS, points, (230, 90, 40), point_size=0.2, point_shape="circle"
            )
            return
        xpos = np.zeros((len(states), self._model.nbody, 3))
        xmat = np.zeros((len(states), self._model.nbody, 3, 3))
        for i, state in enumerate(states):
            self._data.qpos[:] = state[: self._model.nq]
            mujoco.mj_kinematics(self._model, self._data)
            xpos[i], xmat[i] = self._data.xpos, self._data.xmat.reshape(-1, 3, 3)
        if self._offset is None:
            self._middle = float(xpos[0, 1, 0]), float(xpos[0, 1, 1])  # the root
            xpos[..., :2] -= self._middle
        self._scene.update_from_arrays(xpos, xmat)

    def _move(self, offset: tuple[float, float]) -> None:
        node = self._server.scene.get_handle_by_name(MOVING)
        if node is not None:
            node.position = (*offset, 0.0)

    def _switch(self, name: str, visible: bool) -> None:
        node = self._server.scene.get_handle_by_name(name)
        if node is not None:
            node.visible = visible
