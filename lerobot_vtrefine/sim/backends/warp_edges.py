"""Where two edges touch: each is tried against the other geom's faces, as MuJoCo does.

mujoco_warp 4.0 tries the first geom's alone (`collision_gjk.multicontact`). An edge of a mesh that crosses a
pad, a few degrees askew, then touches it at one end, and the pad reads a load up to 13 mm from where it is.
"""

import warp as wp
from mujoco_warp._src import collision_convex as convex
from mujoco_warp._src.collision_core import Geom
from mujoco_warp._src.collision_gjk import _feature_dim, _get_face_verts, multicontact
from mujoco_warp._src.types import mat43

EDGE = 2
"""Corners of an edge."""


@wp.func
def _swap(face: wp.vec3i, vert: wp.array[wp.vec3], vert_index: wp.array[int]) -> None:
    """Exchange the geoms' points in a face of the polytope by which their penetration was found."""
    for corner in range(3):
        first = 2 * face[corner]
        point = wp.vec3(vert[first])
        index = int(vert_index[first])
        vert[first] = vert[first + 1]
        vert_index[first] = vert_index[first + 1]
        vert[first + 1] = point
        vert_index[first + 1] = index


@wp.func
def multicontact_of_both(
    polygon: wp.array[wp.vec3],
    clipped: wp.array[wp.vec3],
    plane_normal: wp.array[wp.vec3],
    plane_dist: wp.array[float],
    idx1: wp.array[int],
    idx2: wp.array[int],
    n1: wp.array[wp.vec3],
    n2: wp.array[wp.vec3],
    endvert: wp.array[wp.vec3],
    face1: wp.array[wp.vec3],
    face2: wp.array[wp.vec3],
    vert: wp.array[wp.vec3],
    vert_index: wp.array[int],
    face: int,
    x1: wp.vec3,
    x2: wp.vec3,
    geom1: Geom,
    geom2: Geom,
    type1: int,
    type2: int,
) -> tuple[int, mat43, mat43, wp.vec4]:
    """mujoco_warp's function, of the same arguments; where it finds one contact of two edges it is asked
    again, with the geoms exchanged.
    """
    # fmt: off
    count, witness1, witness2, dists = multicontact(
        polygon, clipped, plane_normal, plane_dist, idx1, idx2, n1, n2, endvert, face1, face2,
        vert, vert_index, face, x1, x2, geom1, geom2, type1, type2,
    )
    corners = _get_face_verts(face)
    dim1, _i1, _v1 = _feature_dim(corners, vert_index, vert, 0)
    dim2, _i2, _v2 = _feature_dim(corners, vert_index, vert, 1)
    if count == 1 and dim1 == EDGE and dim2 == EDGE:
        _swap(corners, vert, vert_index)
        count, witness2, witness1, dists = multicontact(
            polygon, clipped, plane_normal, plane_dist, idx2, idx1, n2, n1, endvert, face2, face1,
            vert, vert_index, face, x2, x1, geom2, geom1, type2, type1,
        )
    # fmt: on
    return count, witness1, witness2, dists


def try_both_edges() -> None:
    """Have mujoco_warp find contacts of edges so, in kernels that are built from now on."""
    setattr(convex, "multicontact", multicontact_of_both)  # noqa: B010  a module's name
