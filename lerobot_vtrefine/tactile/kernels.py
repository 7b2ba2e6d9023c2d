"""Warp kernels of the contact geometry and of the load-consistent foundation; one source for CPU and CUDA.

Shape legend: m environments, P pads, B bodies, K primitives, N lattice points. Everything is float32 [m, m/s, N]
except the sums of the solver, which are float64.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

CLOSEST = wp.constant(0)
COLUMN = wp.constant(1)
NO_BODY_M = wp.constant(-1.0)
"""Column height where no body stands over the taxel [m]."""
FAR_M = wp.constant(1.0e3)
STEEPEST = wp.constant(-0.2)
"""A column's rate divides by the surface normal's slope; steeper walls than this count as this steep."""


@wp.func
def box_closest(p: wp.vec3, extent: wp.vec3) -> wp.vec4:
    """Penetration and outward normal inside a box; negative penetration means outside."""
    gap = extent - wp.abs(p)
    if gap[0] <= gap[1] and gap[0] <= gap[2]:
        return wp.vec4(gap[0], wp.sign(p[0]), 0.0, 0.0)
    if gap[1] <= gap[2]:
        return wp.vec4(gap[1], 0.0, wp.sign(p[1]), 0.0)
    return wp.vec4(gap[2], 0.0, 0.0, wp.sign(p[2]))


@wp.func
def cylinder_closest(p: wp.vec3, extent: wp.vec3) -> wp.vec4:
    radius = wp.sqrt(p[0] * p[0] + p[1] * p[1])
    side = extent[0] - radius
    cap = extent[2] - wp.abs(p[2])
    if cap <= side:
        return wp.vec4(cap, 0.0, 0.0, wp.sign(p[2]))
    if radius > 0.0:
        return wp.vec4(side, p[0] / radius, p[1] / radius, 0.0)
    return wp.vec4(side, 1.0, 0.0, 0.0)


@wp.func
def sphere_closest(p: wp.vec3, extent: wp.vec3) -> wp.vec4:
    distance = wp.length(p)
    normal = wp.vec3(0.0, 0.0, 1.0)
    if distance > 0.0:
        normal = p / distance
    return wp.vec4(extent[0] - distance, normal[0], normal[1], normal[2])


@wp.func
def hull_closest(p: wp.vec3, first: int, last: int, planes: wp.array(dtype=wp.vec4)) -> wp.vec4:
    depth = float(FAR_M)
    best = int(first)
    for k in range(first, last):
        plane = planes[k]
        gap = plane[3] - (plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2])
        if gap < depth:
            depth = gap
            best = k
            if gap <= 0.0:
                break
    plane = planes[best]
    return wp.vec4(depth, plane[0], plane[1], plane[2])


@wp.func
def mesh_closest(p: wp.vec3, mesh: wp.uint64, reach: float) -> wp.vec4:
    query = wp.mesh_query_point_sign_winding_number(mesh, p, reach)
    if not query.result or query.sign > 0.0:
        return wp.vec4(-1.0, 0.0, 0.0, 1.0)
    outward = wp.mesh_eval_position(mesh, query.face, query.u, query.v) - p
    depth = wp.length(outward)
    normal = wp.mesh_eval_face_normal(mesh, query.face)
    if depth > 1.0e-6:
        normal = outward / depth
    return wp.vec4(depth, normal[0], normal[1], normal[2])


@wp.func
def box_column(p: wp.vec3, e: wp.vec3, extent: wp.vec3) -> wp.vec4:
    """Where the line p + s e enters a convex solid: (s, normal there); s = FAR_M where it misses or lies behind p."""
    enter = float(-FAR_M)
    leave = float(FAR_M)
    normal = wp.vec3(0.0, 0.0, 0.0)
    for k in range(3):
        if wp.abs(e[k]) < 1.0e-7:
            if wp.abs(p[k]) > extent[k]:
                enter = FAR_M
        else:
            toward = wp.sign(e[k])
            near = (-toward * extent[k] - p[k]) / e[k]
            leave = wp.min(leave, (toward * extent[k] - p[k]) / e[k])
            if near > enter:
                enter = near
                normal = wp.vec3(0.0, 0.0, 0.0)
                normal[k] = -toward
    if enter > leave or leave < 0.0:
        enter = FAR_M
    return wp.vec4(enter, normal[0], normal[1], normal[2])


@wp.func
def cylinder_column(p: wp.vec3, e: wp.vec3, extent: wp.vec3) -> wp.vec4:
    enter = float(-FAR_M)
    leave = float(FAR_M)
    normal = wp.vec3(0.0, 0.0, 0.0)
    if wp.abs(e[2]) < 1.0e-7:
        if wp.abs(p[2]) > extent[2]:
            enter = FAR_M
    else:
        toward = wp.sign(e[2])
        enter = (-toward * extent[2] - p[2]) / e[2]
        leave = (toward * extent[2] - p[2]) / e[2]
        normal = wp.vec3(0.0, 0.0, -toward)
    a = e[0] * e[0] + e[1] * e[1]
    c = p[0] * p[0] + p[1] * p[1] - extent[0] * extent[0]
    if a < 1.0e-12:
        if c > 0.0:
            enter = FAR_M
    else:
        b = p[0] * e[0] + p[1] * e[1]
        # The distance from the axis to the line, not b^2 - a c, keeps micrometres when p is far away.
        across = p[0] * e[1] - p[1] * e[0]
        disc = a * extent[0] * extent[0] - across * across
        if disc < 0.0:
            enter = FAR_M
        else:
            root = wp.sqrt(disc)
            near = (-b - root) / a
            leave = wp.min(leave, (-b + root) / a)
            if near > enter:
                enter = near
                normal = wp.vec3(p[0] + near * e[0], p[1] + near * e[1], 0.0) / extent[0]
    if enter > leave or leave < 0.0:
        enter = FAR_M
    return wp.vec4(enter, normal[0], normal[1], normal[2])


@wp.func
def sphere_column(p: wp.vec3, e: wp.vec3, extent: wp.vec3) -> wp.vec4:
    b = wp.dot(p, e)
    across = p - b * e
    disc = extent[0] * extent[0] - wp.dot(across, across)
    if disc < 0.0:
        return wp.vec4(FAR_M, 0.0, 0.0, 0.0)
    root = wp.sqrt(disc)
    if root < b:
        return wp.vec4(FAR_M, 0.0, 0.0, 0.0)
    normal = (across - root * e) / extent[0]
    return wp.vec4(-b - root, normal[0], normal[1], normal[2])


@wp.func
def hull_column(p: wp.vec3, e: wp.vec3, first: int, last: int, planes: wp.array(dtype=wp.vec4)) -> wp.vec4:
    enter = float(-FAR_M)
    leave = float(FAR_M)
    best = int(first)
    for k in range(first, last):
        plane = planes[k]
        n = wp.vec3(plane[0], plane[1], plane[2])
        along = wp.dot(n, e)
        gap = plane[3] - wp.dot(n, p)
        if wp.abs(along) < 1.0e-7:
            if gap < 0.0:
                enter = FAR_M
                break
        elif along < 0.0:
            s = gap / along
            if s > enter:
                enter = s
                best = k
        else:
            leave = wp.min(leave, gap / along)
        if enter > leave:
            break
    if enter > leave or leave < 0.0:
        enter = FAR_M
    plane = planes[best]
    return wp.vec4(enter, plane[0], plane[1], plane[2])


@wp.func
def mesh_column(p: wp.vec3, e: wp.vec3, mesh: wp.uint64, reach: float) -> wp.vec4:
    query = wp.mesh_query_ray(mesh, p - reach * e, e, 2.0 * reach)
    if not query.result:
        return wp.vec4(FAR_M, 0.0, 0.0, 0.0)
    if wp.dot(query.normal, e) > 0.0:
        # The ray started inside: the body reaches deeper than `reach`, unless it ends below the face.
        if query.t < reach:
            return wp.vec4(FAR_M, 0.0, 0.0, 0.0)
        return wp.vec4(-reach, -e[0], -e[1], -e[2])
    return wp.vec4(query.t - reach, query.normal[0], query.normal[1], query.normal[2])


@wp.func
def evaluate(
    mode: int,
    kind: int,
    p: wp.vec3,
    e: wp.vec3,
    extent: wp.vec3,
    first: int,
    last: int,
    planes: wp.array(dtype=wp.vec4),
    mesh: wp.uint64,
    reach: float,
) -> wp.vec4:
    """(penetration, normal) in CLOSEST mode, (entry along e, normal) in COLUMN mode, of one primitive."""
    if mode == COLUMN:
        if kind == 0:
            return box_column(p, e, extent)
        if kind == 1:
            return cylinder_column(p, e, extent)
        if kind == 2:
            return sphere_column(p, e, extent)
        if kind == 3:
            return hull_column(p, e, first, last, planes)
        return mesh_column(p, e, mesh, reach)
    if kind == 0:
        return box_closest(p, extent)
    if kind == 1:
        return cylinder_closest(p, extent)
    if kind == 2:
        return sphere_closest(p, extent)
    if kind == 3:
        return hull_closest(p, first, last, planes)
    return mesh_closest(p, mesh, reach)


@wp.func
def first_index(centre: float, radius: float, pitch: float, count: int) -> int:
    """First lattice index at or after centre - radius."""
    return wp.int32(wp.ceil((centre - radius) / pitch + 0.5 * float(count - 1) - 1.0e-4))


@wp.func
def last_index(centre: float, radius: float, pitch: float, count: int) -> int:
    """One past the last lattice index at or before centre + radius."""
    return wp.int32(wp.floor((centre + radius) / pitch + 0.5 * float(count - 1) + 1.0e-4)) + 1


@wp.kernel
def query_bodies(
    mode: int,
    rows: int,
    cols: int,
    pitch: float,
    reach: float,
    rows_per_thread: int,
    cols_per_thread: int,
    pad_pos: wp.array(dtype=wp.vec3, ndim=2),
    pad_rot: wp.array(dtype=wp.mat33, ndim=2),
    pad_vel: wp.array(dtype=wp.spatial_vector, ndim=2),
    body_pos: wp.array(dtype=wp.vec3, ndim=2),
    body_rot: wp.array(dtype=wp.mat33, ndim=2),
    body_vel: wp.array(dtype=wp.spatial_vector, ndim=2),
    body_start: wp.array(dtype=int),
    kind: wp.array(dtype=int),
    position: wp.array(dtype=wp.vec3),
    rotation: wp.array(dtype=wp.mat33),
    extent: wp.array(dtype=wp.vec3),
    plane_start: wp.array(dtype=int),
    planes: wp.array(dtype=wp.vec4),
    mesh: wp.array(dtype=wp.uint64),
    depth: wp.array(dtype=float, ndim=3),
    rate: wp.array(dtype=float, ndim=3),
):
    """Penetration (CLOSEST) or signed column height (COLUMN) of every lattice point, and its rate [m, m/s].

    A thread fills a block of the lattice: the whole pad on CPU, one taxel on CUDA.
    """
    env, pad, block = wp.tid()
    blocks_per_row = cols / cols_per_thread
    row_begin = (block / blocks_per_row) * rows_per_thread
    col_begin = (block % blocks_per_row) * cols_per_thread
    nothing = float(0.0)
    if mode == COLUMN:
        nothing = NO_BODY_M
    for row in range(row_begin, row_begin + rows_per_thread):
        for col in range(col_begin, col_begin + cols_per_thread):
            depth[env, pad, row * cols + col] = nothing
            rate[env, pad, row * cols + col] = 0.0
    pad_position = pad_pos[env, pad]
    pad_rotation = pad_rot[env, pad]
    pad_linear = wp.spatial_top(pad_vel[env, pad])
    pad_angular = wp.spatial_bottom(pad_vel[env, pad])
    for body in range(body_start.shape[0] - 1):
        to_body = wp.transpose(body_rot[env, body])
        from_body = pad_position - body_pos[env, body]
        body_angular = wp.spatial_bottom(body_vel[env, body])
        linear = pad_linear - wp.spatial_top(body_vel[env, body]) - wp.cross(body_angular, from_body)
        angular = pad_angular - body_angular
        for k in range(body_start[body], body_start[body + 1]):
            to_primitive = wp.transpose(rotation[k])
            origin = to_primitive * (to_body * from_body - position[k])
            to_frame = to_primitive * to_body
            axes = to_frame * pad_rotation
            ex = wp.vec3(axes[0, 0], axes[1, 0], axes[2, 0])
            ey = wp.vec3(axes[0, 1], axes[1, 1], axes[2, 1])
            ez = wp.vec3(axes[0, 2], axes[1, 2], axes[2, 2])
            half = extent[k]
            above = -wp.dot(origin, ez)
            thickness = wp.dot(wp.abs(ez), half)
            margin = float(0.0)
            if mode == COLUMN:
                margin = reach
            if above - thickness > margin or above + thickness < 0.0:
                continue
            centre_x = -wp.dot(origin, ex)
            centre_y = -wp.dot(origin, ey)
            radius_x = wp.dot(wp.abs(ex), half)
            radius_y = wp.dot(wp.abs(ey), half)
            row0 = wp.max(row_begin, first_index(centre_y, radius_y, pitch, rows))
            row1 = wp.min(row_begin + rows_per_thread, last_index(centre_y, radius_y, pitch, rows))
            col0 = wp.max(col_begin, first_index(centre_x, radius_x, pitch, cols))
            col1 = wp.min(col_begin + cols_per_thread, last_index(centre_x, radius_x, pitch, cols))
            linear_here = to_frame * linear
            angular_here = to_frame * angular
            for row in range(row0, row1):
                start = origin + (float(row) - 0.5 * float(rows - 1)) * pitch * ey
                for col in range(col0, col1):
                    p = start + (float(col) - 0.5 * float(cols - 1)) * pitch * ex
                    hit = evaluate(
                        mode, kind[k], p, ez, half, plane_start[k], plane_start[k + 1], planes, mesh[k], reach
                    )
                    value = hit[0]
                    if mode == COLUMN:
                        value = wp.min(-value, reach)
                        if value < -reach:
                            value = NO_BODY_M
                    index = row * cols + col
                    if value > depth[env, pad, index]:
                        depth[env, pad, index] = value
                        normal = wp.vec3(hit[1], hit[2], hit[3])
                        arm = p - origin
                        if mode == COLUMN:
                            arm = arm + hit[0] * ez
                        closing = -wp.dot(normal, linear_here + wp.cross(angular_here, arm))
                        if mode == COLUMN:
                            closing = closing / -wp.min(wp.dot(normal, ez), STEEPEST)
                        rate[env, pad, index] = closing
