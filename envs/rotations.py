"""What bodies and their observations need of rotations, seen from above."""

import numpy as np

from goalgan_bt.envs.arrays import Array, columns, namespace
from goalgan_bt.envs.maze import FloatArray


def axes_on_map(quaternion: Array) -> Array:
    """Where unit quaternions (w, x, y, z), (n, 4), turn the x, y and z axes: the first two
    components of each, (3, n, 2)."""
    w, x, y, z = columns(quaternion)
    axes = namespace(quaternion).empty((3, quaternion.shape[0], 2), device=w.device)
    axes[0, :, 0] = 1 - 2 * (y * y + z * z)
    axes[0, :, 1] = 2 * (x * y + w * z)
    axes[1, :, 0] = 2 * (x * y - w * z)
    axes[1, :, 1] = 1 - 2 * (x * x + z * z)
    axes[2, :, 0] = 2 * (x * z + w * y)
    axes[2, :, 1] = 2 * (y * z - w * x)
    return axes


def uprightness(quaternion: Array) -> Array:
    """The cosine of the angle between the turned z axis and the upward one, (n, 4) -> (n,)."""
    return 1 - 2 * (quaternion[:, 1] ** 2 + quaternion[:, 2] ** 2)


def with_unit_quaternion(states: FloatArray) -> FloatArray:
    """States of free bodies, x, y, z and then a quaternion, with that brought back to length 1."""
    states = states.copy()
    states[:, 3:7] /= np.linalg.norm(states[:, 3:7], axis=1, keepdims=True) + 1e-9
    return states


def unit_on_map(vectors: Array) -> Array:
    """Vectors in the plane of length 1, (n, 2); zero stays zero."""
    length = namespace(vectors).sqrt(vectors[:, :1] ** 2 + vectors[:, 1:] ** 2)
    return vectors / (length + 1e-9)


def ahead_and_left(vector: Array, front: Array) -> tuple[Array, Array]:
    """Components of vectors (n, 2) along fronts (n, 2) and to their left, each (n,)."""
    ahead = vector[:, 0] * front[:, 0] + vector[:, 1] * front[:, 1]
    left = vector[:, 1] * front[:, 0] - vector[:, 0] * front[:, 1]
    return ahead, left
