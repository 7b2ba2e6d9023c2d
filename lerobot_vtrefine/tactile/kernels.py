"""Warp kernels of the contact geometry; this module is one source for CPU and CUDA (native snippets are not).

Shape legend: m environments, P pads, B bodies, K primitives, Q planes, N lattice points; float32 [m, m/s].

`prepare` brings every primitive into reach of a pad and reduces convex ones to the few planes that matter
there, as functions affine in the lattice's x and y; `kernels_query` evaluates them, a pad at a time.
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
MESH = wp.constant(4)

ivec2 = wp.types.vector(length=2, dtype=wp.int32)
ivec4 = wp.types.vector(length=4, dtype=wp.int32)


@wp.struct
class Lattice:
    """What is asked: CLOSEST or COLUMN on rows x cols points, `subdivision` per taxel and direction."""

    mode: int
    rows: int
    cols: int
    subdivision: int
    pitch: float
    reach: float
    skip_unloaded: int


@wp.struct
class Poses:
    """Poses and velocities of pads (m, P) and bodies (m, B), and the load on each pad."""

    pad_pos: wp.array(dtype=wp.vec3, ndim=2)
    pad_rot: wp.array(dtype=wp.mat33, ndim=2)
    pad_vel: wp.array(dtype=wp.spatial_vector, ndim=2)
    body_pos: wp.array(dtype=wp.vec3, ndim=2)
    body_rot: wp.array(dtype=wp.mat33, ndim=2)
    body_vel: wp.array(dtype=wp.spatial_vector, ndim=2)
    load: wp.array(dtype=wp.vec3, ndim=2)


@wp.struct
class Grid:
    """A mesh's cells: the first one's place in `cells`, their number per axis, lowest corner, 1 / size."""

    first: int
    count: wp.vec3i
    low: wp.vec3
    inverse: float


@wp.struct
class Bodies:
    """`packing.PackedBodies` on the device, and the meshes' grids (`mesh_grid`)."""

    owner: wp.array(dtype=int)
    kind: wp.array(dtype=int)
    position: wp.array(dtype=wp.vec3)
    rotation: wp.array(dtype=wp.mat33)
    extent: wp.array(dtype=wp.vec3)
    plane_start: wp.array(dtype=int)
    planes: wp.array(dtype=wp.vec4)
    corners: wp.array(dtype=wp.vec3)
    normals: wp.array(dtype=wp.vec3)
    edge_normals: wp.array(dtype=wp.vec3)
    corner_normals: wp.array(dtype=wp.vec3)
    cluster_start: wp.array(dtype=int)
    cluster_range: wp.array(dtype=wp.vec2i)
    cluster_centre: wp.array(dtype=wp.vec3)
    cluster_half: wp.array(dtype=wp.vec3)
    grids: wp.array(dtype=Grid)
    cells: wp.array(dtype=wp.vec2i)
    candidates: wp.array(dtype=int)


@wp.struct
class Views:
    """Every pad as each primitive sees it (m, P, K), and the convex primitives' planes that matter there (m,
    P, Q)."""

    origin: wp.array(dtype=wp.vec3, ndim=3)
    axes: wp.array(dtype=wp.mat33, ndim=3)
    linear: wp.array(dtype=wp.vec3, ndim=3)
    angular: wp.array(dtype=wp.vec3, ndim=3)
    window: wp.array(dtype=ivec4, ndim=3)
    counts: wp.array(dtype=ivec2, ndim=3)
    forms: wp.array(dtype=wp.vec4, ndim=3)
    rates: wp.array(dtype=wp.vec4, ndim=3)


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
    """Where the line p + s e enters a cylinder: (s, normal there); s = FAR_M where it misses or lies behind
    p."""
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
    """Where the line p + s e enters a sphere: (s, normal there); s = FAR_M where it misses or lies behind
    p."""
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
    """Position of a lattice index, from the lattice's centre."""
    return (float(index) - 0.5 * float(count - 1)) * pitch


@wp.func
def plane_form(mode: int, plane: wp.vec4, origin: wp.vec3, ex: wp.vec3, ey: wp.vec3, ez: wp.vec3) -> wp.vec4:
    """A plane as (c0, cx, cy, slope): gap (CLOSEST) or s where a column crosses it (COLUMN) = c0 + cx x + cy
    y."""
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
def column(matrix: wp.mat33, k: int) -> wp.vec3:
    """Column k of a matrix."""
    return wp.vec3(matrix[0, k], matrix[1, k], matrix[2, k])


@wp.func
def rate_form(mode: int, n: wp.vec3, axes: wp.mat33, linear: wp.vec3, angular: wp.vec3) -> wp.vec4:
    """Rate of depth at a surface with normal n, as (r0, rx, ry, rs) for x, y and s."""
    factor = float(-1.0)
    if mode == COLUMN:
        factor = 1.0 / wp.min(wp.dot(n, column(axes, 2)), STEEPEST)
    turned = wp.transpose(axes) * wp.cross(n, angular)
    return factor * wp.vec4(wp.dot(n, linear), turned[0], turned[1], turned[2])


@wp.func
def eval_rate(form: wp.vec4, x: float, y: float, s: float) -> float:
    """Rate of depth at (x, y) and s along the pad's normal."""
    return form[0] + form[1] * x + form[2] * y + form[3] * s


@wp.func
def lattice_window(lattice: Lattice, origin: wp.vec3, axes: wp.mat33, half: wp.vec3) -> ivec4:
    """Rows and columns (begin, end, begin, end) over which a bounding box stands; empty when out of reach."""
    centre = -(wp.transpose(axes) * origin)
    magnitude = wp.transpose(wp.matrix_from_rows(wp.abs(axes[0]), wp.abs(axes[1]), wp.abs(axes[2])))
    radius = magnitude * half
    margin = lattice.reach * float(lattice.mode)
    if centre[2] - radius[2] > margin or centre[2] + radius[2] < 0.0:
        return ivec4(0, 0, 0, 0)
    area = ivec4(
        first_index(centre[1] - radius[1], lattice.pitch, lattice.rows),
        end_index(centre[1] + radius[1], lattice.pitch, lattice.rows),
        first_index(centre[0] - radius[0], lattice.pitch, lattice.cols),
        end_index(centre[0] + radius[0], lattice.pitch, lattice.cols),
    )
    if area[0] >= area[1] or area[2] >= area[3]:
        return ivec4(0, 0, 0, 0)
    return area


@wp.func
def keep_planes(lattice: Lattice, bodies: Bodies, views: Views, env: int, pad: int, k: int) -> None:
    """Store the planes of a convex primitive that can decide the entry (the gap) in its window, or cut it
    off."""
    area = views.window[env, pad, k]
    box = wp.vec4(
        coordinate(area[2], lattice.pitch, lattice.cols),
        coordinate(area[3] - 1, lattice.pitch, lattice.cols),
        coordinate(area[0], lattice.pitch, lattice.rows),
        coordinate(area[1] - 1, lattice.pitch, lattice.rows),
    )
    origin = views.origin[env, pad, k]
    axes = views.axes[env, pad, k]
    ex = column(axes, 0)
    ey = column(axes, 1)
    ez = column(axes, 2)
    first = bodies.plane_start[k]
    last = bodies.plane_start[k + 1]
    enter_low = float(-FAR_M)
    enter_high = float(-FAR_M)
    gap_high = float(FAR_M)
    for q in range(first, last):
        form = plane_form(lattice.mode, bodies.planes[q], origin, ex, ey, ez)
        if lattice.mode == CLOSEST:
            gap_high = wp.min(gap_high, highest(form, box))
        elif form[3] < 0.0:
            enter_low = wp.max(enter_low, lowest(form, box))
            enter_high = wp.max(enter_high, highest(form, box))
    enters = int(0)
    leaves = int(0)
    for q in range(first, last):
        plane = bodies.planes[q]
        form = plane_form(lattice.mode, plane, origin, ex, ey, ez)
        keep = lowest(form, box) <= gap_high
        if lattice.mode == COLUMN:
            keep = form[3] < 0.0 and highest(form, box) >= enter_low
        if keep:
            n = wp.vec3(plane[0], plane[1], plane[2])
            views.forms[env, pad, first + enters] = form
            views.rates[env, pad, first + enters] = rate_form(
                lattice.mode, n, axes, views.linear[env, pad, k], views.angular[env, pad, k]
            )
            enters += 1
        elif lattice.mode == COLUMN and form[3] > 0.0 and lowest(form, box) < wp.max(enter_high, 0.0):
            leaves += 1
            views.forms[env, pad, last - leaves] = form
    views.counts[env, pad, k] = ivec2(enters, leaves)


@wp.func
def far_away(
    lattice: Lattice, bodies: Bodies, k: int, from_body: wp.vec3, body_rot: wp.mat33, pad_rot: wp.mat33
) -> bool:
    """Whether the ball around a primitive is out of reach, as most are of many: nothing else is computed."""
    radius = wp.length(bodies.extent[k])
    centre = wp.transpose(pad_rot) * (body_rot * bodies.position[k] - from_body)
    if centre[2] - radius > lattice.reach * float(lattice.mode) or centre[2] + radius < 0.0:
        return True
    side = radius + 0.5 * lattice.pitch * float(lattice.cols)
    end = radius + 0.5 * lattice.pitch * float(lattice.rows)
    return wp.abs(centre[0]) > side or wp.abs(centre[1]) > end


@wp.kernel
def prepare(lattice: Lattice, poses: Poses, bodies: Bodies, views: Views) -> None:
    """Pad frame and relative velocity in each primitive's frame, its lattice window, and its planes that
    matter."""
    env, pad, k = wp.tid()
    views.window[env, pad, k] = ivec4(0, 0, 0, 0)
    if lattice.skip_unloaded != 0 and poses.load[env, pad][0] <= 0.0:
        return
    body = bodies.owner[k]
    from_body = poses.pad_pos[env, pad] - poses.body_pos[env, body]
    if far_away(lattice, bodies, k, from_body, poses.body_rot[env, body], poses.pad_rot[env, pad]):
        return
    to_body = wp.transpose(poses.body_rot[env, body])
    to_primitive = wp.transpose(bodies.rotation[k])
    to_frame = to_primitive * to_body
    origin = to_primitive * (to_body * from_body - bodies.position[k])
    axes = to_frame * poses.pad_rot[env, pad]
    area = lattice_window(lattice, origin, axes, bodies.extent[k])
    if area[0] >= area[1]:
        return
    body_velocity = poses.body_vel[env, body]
    pad_velocity = poses.pad_vel[env, pad]
    turning = wp.spatial_bottom(body_velocity)
    linear = wp.spatial_top(pad_velocity) - wp.spatial_top(body_velocity) - wp.cross(turning, from_body)
    views.window[env, pad, k] = area
    views.origin[env, pad, k] = origin
    views.axes[env, pad, k] = axes
    views.linear[env, pad, k] = to_frame * linear
    views.angular[env, pad, k] = to_frame * (wp.spatial_bottom(pad_velocity) - turning)
    if bodies.plane_start[k] < bodies.plane_start[k + 1]:
        keep_planes(lattice, bodies, views, env, pad, k)
