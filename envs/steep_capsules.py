"""The friction of mujoco-warp's capsules on a plane, put right to be MuJoCo's. Importing does it.

MuJoCo lays the friction pyramid along a capsule whatever its slope; mujoco-warp 4.0 lays it along
a fixed axis where the capsule stands steeper than 60 degrees, as the Ant's feet often do. Torsos
then are 0.2 m apart after a second of random torques instead of a micrometre (benchmarks/gpu.py).
"""

import warp as wp
from mujoco_warp._src import collision_primitive as primitive
from mujoco_warp._src.collision_primitive_core import mat23f

_original = primitive.plane_capsule


@wp.func  # type: ignore[untyped-decorator]
def plane_capsule(
    plane_normal: wp.vec3,
    plane_pos: wp.vec3,
    capsule_pos: wp.vec3,
    capsule_axis: wp.vec3,
    capsule_radius: float,
    capsule_half_length: float,
) -> tuple[wp.vec2, mat23f, wp.mat33]:
    """mujoco-warp's function of that name, its contact frame along the capsule."""
    dist, pos, frame = _original(
        plane_normal, plane_pos, capsule_pos, capsule_axis, capsule_radius, capsule_half_length
    )
    n = plane_normal
    along = capsule_axis - n * wp.dot(n, capsule_axis)
    if wp.length(along) > 1.0e-6:
        b = wp.normalize(along)
        frame = wp.matrix_from_rows(n, b, wp.cross(n, b))
    return dist, pos, frame


primitive.plane_capsule = plane_capsule
