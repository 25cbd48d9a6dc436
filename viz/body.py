"""Bodies in the scene: MuJoCo's own geometry through mjviser, spheres where there is no model."""

import copy

import mujoco
import numpy as np
import viser
from mjviser import ViserMujocoScene

from goalgan_bt.envs.maze import FloatArray

HIDDEN = 3  # a geom group that mjviser does not show


class Bodies:
    """Bodies of one kind, drawn where their states say, any number of them.

    Args:
        server: whose scene it is.
        model: the MuJoCo model, or None: then states begin with the position of a point mass.
        node: name of the node of the point masses.
    """

    def __init__(self, server: viser.ViserServer, model: mujoco.MjModel | None, node: str) -> None:
        self._server, self._node = server, node
        self._model = None if model is None else copy.copy(model)
        if self._model is None:
            return
        self._model.site_group[:] = HIDDEN
        self._data = mujoco.MjData(self._model)
        self._scene = ViserMujocoScene(server, self._model, 1)
        self._scene.camera_tracking_enabled = False  # world coordinates, as all other layers
        self._switch("/fixed_bodies", False)  # walls and floor: `Scene` draws them

    def show(self, visible: bool) -> None:
        """Show or hide the bodies."""
        self._switch("/bodies" if self._model is not None else self._node, visible)

    def draw(self, states: FloatArray) -> None:
        """Put the bodies into these states, (n, state_dim)."""
        if self._model is None:
            points = np.zeros((len(states), 3), dtype=np.float32)
            points[:, :2], points[:, 2] = states[:, :2], 0.1
            self._server.scene.add_point_cloud(
                self._node, points, (230, 90, 40), point_size=0.2, point_shape="circle"
            )
            return
        xpos = np.zeros((len(states), self._model.nbody, 3))
        xmat = np.zeros((len(states), self._model.nbody, 3, 3))
        for i, state in enumerate(states):
            self._data.qpos[:] = state[: self._model.nq]
            mujoco.mj_kinematics(self._model, self._data)
            xpos[i], xmat[i] = self._data.xpos, self._data.xmat.reshape(-1, 3, 3)
        self._scene.update_from_arrays(xpos, xmat)

    def _switch(self, name: str, visible: bool) -> None:
        node = self._server.scene.get_handle_by_name(name)
        if node is not None:
            node.visible = visible
