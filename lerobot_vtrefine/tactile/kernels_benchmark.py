"""Warp kernel of a peer that the benchmark compares with."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def three_ray_query(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), depth: wp.array(dtype=float)) -> None:
    """Penetration by a closest-point query per taxel, its sign by the vote of three rays."""
    i = wp.tid()
    query = wp.mesh_query_point(mesh, points[i], 0.2)
    if query.result and query.sign < 0.0:
        depth[i] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])
