"""Warp kernels of the contact geometry; one source for CPU and CUDA.

Shape legend: m environments, P pads, B bodies, K primitives, Q planes, N lattice points; float32 [m, m/s].

`prepare` brings every primitive into reach of a pad and reduces convex ones to the few planes that matter there, as
functions affine in the lattice's x and y; `query_primitives` evaluates them; `raster_meshes` projects triangles on the
lattice and `resolve_meshes` turns the winners into depths.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

CLOSEST = wp.constant(0)
COLUMN = wp.constant(1)
NO_BODY_M = wp.constant(-1.0)
"""Column height where no body stands over the taxel [m]."""
FAR_M = wp.constant(1.0e3)
PARALLEL = wp.constant(1.0e-7)
STEEPEST = wp.constant(-0.2)
"""A column's rate divides by the surface normal's slope; steeper walls than this count as this steep."""
KEY_STEPS_PER_M = wp.constant(1.0e9)
TRIANGLE_BITS = wp.constant(24)

ivec2 = wp.types.vector(length=2, dtype=wp.int32)
ivec4 = wp.types.vector(length=4, dtype=wp.int32)


@wp.func
def cylinder_closest(p: wp.vec3, extent: wp.vec3) -> wp.vec4:
    """Penetration and outward normal inside a cylinder; negative penetration means outside."""
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
    """Penetration and outward normal inside a sphere; negative penetration means outside."""
    distance = wp.length(p)
    normal = wp.vec3(0.0, 0.0, 1.0)
    if distance > 0.0:
        normal = p / distance
    return wp.vec4(extent[0] - distance, normal[0], normal[1], normal[2])


@wp.func
def cylinder_column(p: wp.vec3, e: wp.vec3, extent: wp.vec3) -> wp.vec4:
    """Where the line p + s e enters a cylinder: (s, normal there); s = FAR_M where it misses or lies behind p."""
    enter = float(-FAR_M)
    leave = float(FAR_M)
    normal = wp.vec3(0.0, 0.0, 0.0)
    if wp.abs(e[2]) < PARALLEL:
        if wp.abs(p[2]) > extent[2]:
            enter = FAR_M
    else:
        toward = wp.sign(e[2])
        enter = (-toward * extent[2] - p[2]) / e[2]
        leave = (toward * extent[2] - p[2]) / e[2]
        normal = wp.vec3(0.0, 0.0, -toward)
    a = e[0] * e[0] + e[1] * e[1]
    if a < 1.0e-12:
        if p[0] * p[0] + p[1] * p[1] > extent[0] * extent[0]:
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
    """Where the line p + s e enters a sphere: (s, normal there); s = FAR_M where it misses or lies behind p."""
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
def first_index(x: float, pitch: float, count: int) -> int:
    """First lattice index at or after x."""
    return wp.max(0, wp.int32(wp.ceil(x / pitch + 0.5 * float(count - 1) - 1.0e-4)))


@wp.func
def end_index(x: float, pitch: float, count: int) -> int:
    """One past the last lattice index at or before x."""
    return wp.min(count, wp.int32(wp.floor(x / pitch + 0.5 * float(count - 1) + 1.0e-4)) + 1)


@wp.func
def coordinate(index: int, pitch: float, count: int) -> float:
    return (float(index) - 0.5 * float(count - 1)) * pitch


@wp.func
def plane_form(mode: int, plane: wp.vec4, origin: wp.vec3, ex: wp.vec3, ey: wp.vec3, ez: wp.vec3) -> wp.vec4:
    """A plane as (c0, cx, cy, slope): gap (CLOSEST) or s where a column crosses it (COLUMN) = c0 + cx x + cy y."""
    n = wp.vec3(plane[0], plane[1], plane[2])
    form = wp.vec4(plane[3] - wp.dot(n, origin), -wp.dot(n, ex), -wp.dot(n, ey), wp.dot(n, ez))
    if mode == COLUMN:
        slope = form[3]
        if wp.abs(slope) < PARALLEL:
            slope = -PARALLEL
        form = wp.vec4(form[0] / slope, form[1] / slope, form[2] / slope, slope)
    return form


@wp.func
def lowest(form: wp.vec4, box: wp.vec4) -> float:
    """Minimum of c0 + cx x + cy y over x in box[0:2], y in box[2:4]."""
    return form[0] + wp.min(form[1] * box[0], form[1] * box[1]) + wp.min(form[2] * box[2], form[2] * box[3])


@wp.func
def highest(form: wp.vec4, box: wp.vec4) -> float:
    """Maximum of c0 + cx x + cy y over x in box[0:2], y in box[2:4]."""
    return form[0] + wp.max(form[1] * box[0], form[1] * box[1]) + wp.max(form[2] * box[2], form[2] * box[3])


@wp.func
def rate_form(
    mode: int,
    n: wp.vec3,
    slope: float,
    ex: wp.vec3,
    ey: wp.vec3,
    ez: wp.vec3,
    linear: wp.vec3,
    angular: wp.vec3,
) -> wp.vec4:
    """Rate of depth at a surface with normal n, as (r0, rx, ry, rs) for x, y and s."""
    turned = wp.cross(n, angular)
    factor = float(-1.0)
    if mode == COLUMN:
        factor = -1.0 / -wp.min(slope, STEEPEST)
    return factor * wp.vec4(wp.dot(n, linear), wp.dot(turned, ex), wp.dot(turned, ey), wp.dot(turned, ez))


@wp.kernel
def prepare(
    mode: int,
    rows: int,
    cols: int,
    pitch: float,
    reach: float,
    skip_unloaded: int,
    load: wp.array(dtype=wp.vec3, ndim=2),
    pad_pos: wp.array(dtype=wp.vec3, ndim=2),
    pad_rot: wp.array(dtype=wp.mat33, ndim=2),
    pad_vel: wp.array(dtype=wp.spatial_vector, ndim=2),
    body_pos: wp.array(dtype=wp.vec3, ndim=2),
    body_rot: wp.array(dtype=wp.mat33, ndim=2),
    body_vel: wp.array(dtype=wp.spatial_vector, ndim=2),
    owner: wp.array(dtype=int),
    position: wp.array(dtype=wp.vec3),
    rotation: wp.array(dtype=wp.mat33),
    extent: wp.array(dtype=wp.vec3),
    plane_start: wp.array(dtype=int),
    planes: wp.array(dtype=wp.vec4),
    origin_out: wp.array(dtype=wp.vec3, ndim=3),
    axes_out: wp.array(dtype=wp.mat33, ndim=3),
    linear_out: wp.array(dtype=wp.vec3, ndim=3),
    angular_out: wp.array(dtype=wp.vec3, ndim=3),
    window: wp.array(dtype=ivec4, ndim=3),
    counts: wp.array(dtype=ivec2, ndim=3),
    forms: wp.array(dtype=wp.vec4, ndim=3),
    rates: wp.array(dtype=wp.vec4, ndim=3),
):
    """Pad frame and relative velocity in each primitive's frame, its lattice window, and its planes that matter."""
    env, pad, k = wp.tid()
    window[env, pad, k] = ivec4(0, 0, 0, 0)
    if skip_unloaded != 0:
        if load[env, pad][0] <= 0.0:
            return
    body = owner[k]
    to_body = wp.transpose(body_rot[env, body])
    from_body = pad_pos[env, pad] - body_pos[env, body]
    to_primitive = wp.transpose(rotation[k])
    origin = to_primitive * (to_body * from_body - position[k])
    half = extent[k]
    to_frame = to_primitive * to_body
    axes = to_frame * pad_rot[env, pad]
    ez = wp.vec3(axes[0, 2], axes[1, 2], axes[2, 2])
    above = -wp.dot(origin, ez)
    thickness = wp.dot(wp.abs(ez), half)
    margin = float(0.0)
    if mode == COLUMN:
        margin = reach
    if above - thickness > margin or above + thickness < 0.0:
        return
    ex = wp.vec3(axes[0, 0], axes[1, 0], axes[2, 0])
    ey = wp.vec3(axes[0, 1], axes[1, 1], axes[2, 1])
    centre_x = -wp.dot(origin, ex)
    centre_y = -wp.dot(origin, ey)
    radius_x = wp.dot(wp.abs(ex), half)
    radius_y = wp.dot(wp.abs(ey), half)
    row0 = first_index(centre_y - radius_y, pitch, rows)
    row1 = end_index(centre_y + radius_y, pitch, rows)
    col0 = first_index(centre_x - radius_x, pitch, cols)
    col1 = end_index(centre_x + radius_x, pitch, cols)
    if row0 >= row1 or col0 >= col1:
        return
    body_angular = wp.spatial_bottom(body_vel[env, body])
    pad_linear = wp.spatial_top(pad_vel[env, pad]) - wp.spatial_top(body_vel[env, body])
    linear = to_frame * (pad_linear - wp.cross(body_angular, from_body))
    angular = to_frame * (wp.spatial_bottom(pad_vel[env, pad]) - body_angular)
    window[env, pad, k] = ivec4(row0, row1, col0, col1)
    origin_out[env, pad, k] = origin
    axes_out[env, pad, k] = axes
    linear_out[env, pad, k] = linear
    angular_out[env, pad, k] = angular
    first = plane_start[k]
    last = plane_start[k + 1]
    if first == last:
        return
    box = wp.vec4(
        coordinate(col0, pitch, cols),
        coordinate(col1 - 1, pitch, cols),
        coordinate(row0, pitch, rows),
        coordinate(row1 - 1, pitch, rows),
    )
    # Bounds over the window: only planes that can decide the entry (the gap), or cut it off, are kept.
    enter_low = float(-FAR_M)
    enter_high = float(-FAR_M)
    gap_high = float(FAR_M)
    for q in range(first, last):
        form = plane_form(mode, planes[q], origin, ex, ey, ez)
        if mode == CLOSEST:
            gap_high = wp.min(gap_high, highest(form, box))
        elif form[3] < 0.0:
            enter_low = wp.max(enter_low, lowest(form, box))
            enter_high = wp.max(enter_high, highest(form, box))
    enters = int(0)
    leaves = int(0)
    for q in range(first, last):
        form = plane_form(mode, planes[q], origin, ex, ey, ez)
        n = wp.vec3(planes[q][0], planes[q][1], planes[q][2])
        keep = lowest(form, box) <= gap_high
        if mode == COLUMN:
            keep = form[3] < 0.0 and highest(form, box) >= enter_low
        if keep:
            forms[env, pad, first + enters] = form
            rates[env, pad, first + enters] = rate_form(mode, n, form[3], ex, ey, ez, linear, angular)
            enters += 1
        elif mode == COLUMN and form[3] > 0.0:
            if lowest(form, box) < wp.max(enter_high, 0.0):
                leaves += 1
                forms[env, pad, last - leaves] = form
    counts[env, pad, k] = ivec2(enters, leaves)
