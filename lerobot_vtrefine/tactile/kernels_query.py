"""Warp kernels that evaluate prepared primitives and meshes on the lattice. Shapes and terms as in
`kernels`."""

import warp as wp

from lerobot_vtrefine.tactile.kernels import (
    CLOSEST,
    COLUMN,
    FAR_M,
    KEY_STEPS_PER_M,
    NO_BODY_M,
    TRIANGLE_BITS,
    Bodies,
    Lattice,
    Views,
    column,
    coordinate,
    cylinder_closest,
    cylinder_column,
    end_index,
    first_index,
    ivec2,
    ivec4,
    rate_form,
    sphere_closest,
    sphere_column,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def curved(mode: int, kind: int, p: wp.vec3, e: wp.vec3, extent: wp.vec3) -> wp.vec4:
    """Depth and normal of a cylinder or sphere at p: penetration, or height along e; far below zero
    outside."""
    if mode == COLUMN:
        hit = sphere_column(p, e, extent)
        if kind == 1:
            hit = cylinder_column(p, e, extent)
        return wp.vec4(-hit[0], hit[1], hit[2], hit[3])
    if kind == 1:
        return cylinder_closest(p, extent)
    return sphere_closest(p, extent)


@wp.func
def column_entry(
    first: int, last: int, kept: ivec2, x: float, y: float, forms: wp.array(dtype=wp.vec4)
) -> wp.vec2:
    """Height of a convex solid over (x, y) and the plane it belongs to; NO_BODY_M where the column misses
    it."""
    enter = float(-FAR_M)
    best = int(first)
    for q in range(first, first + kept[0]):
        form = forms[q]
        s = form[0] + form[1] * x + form[2] * y
        if s > enter:
            enter = s
            best = q
    for q in range(last - kept[1], last):
        form = forms[q]
        s = form[0] + form[1] * x + form[2] * y
        if s < enter or s < 0.0:
            return wp.vec2(NO_BODY_M, float(best))
    return wp.vec2(-enter, float(best))


@wp.func
def least_gap(first: int, kept: ivec2, x: float, y: float, forms: wp.array(dtype=wp.vec4)) -> wp.vec2:
    """Penetration into a convex solid at (x, y), negative outside, and the plane that it is measured to."""
    value = float(FAR_M)
    best = int(first)
    for q in range(first, first + kept[0]):
        form = forms[q]
        s = form[0] + form[1] * x + form[2] * y
        if s < value:
            value = s
            best = q
    return wp.vec2(value, float(best))


@wp.func
def eval_rate(form: wp.vec4, x: float, y: float, s: float) -> float:
    """Rate of depth at (x, y) and s along the pad's normal."""
    return form[0] + form[1] * x + form[2] * y + form[3] * s


@wp.func
def query_face(
    lattice: Lattice,
    area: ivec4,
    form: wp.vec4,
    speed: wp.vec4,
    depth: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Column heights where a single plane decides: the usual case of a part held flat."""
    for row in range(area[0], area[1]):
        y = coordinate(row, lattice.pitch, lattice.rows)
        base = form[0] + form[2] * y
        speed_base = speed[0] + speed[2] * y
        for col in range(area[2], area[3]):
            x = coordinate(col, lattice.pitch, lattice.cols)
            value = wp.min(-base - form[1] * x, lattice.reach)
            index = row * lattice.cols + col
            if value > depth[index] and value >= -lattice.reach:
                depth[index] = value
                rate[index] = speed_base + speed[1] * x - speed[3] * value


@wp.func
def query_convex(
    lattice: Lattice,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    k: int,
    area: ivec4,
    depth: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Raise depth and rate on the rows area[0:2] and columns area[2:4] to those of convex primitive k."""
    first = bodies.plane_start[k]
    last = bodies.plane_start[k + 1]
    kept = views.counts[env, pad, k]
    forms = views.forms[env, pad]
    rates = views.rates[env, pad]
    if lattice.mode == COLUMN and kept[0] == 1 and kept[1] == 0:
        query_face(lattice, area, forms[first], rates[first], depth, rate)
        return
    for row in range(area[0], area[1]):
        y = coordinate(row, lattice.pitch, lattice.rows)
        for col in range(area[2], area[3]):
            x = coordinate(col, lattice.pitch, lattice.cols)
            found = wp.vec2(0.0, 0.0)
            if lattice.mode == COLUMN:
                found = column_entry(first, last, kept, x, y, forms)
            else:
                found = least_gap(first, kept, x, y, forms)
            index = row * lattice.cols + col
            if found[0] > depth[index] and found[0] >= -lattice.reach:
                value = wp.min(found[0], lattice.reach)
                depth[index] = value
                rate[index] = eval_rate(rates[wp.int32(found[1])], x, y, -value * float(lattice.mode))


@wp.func
def query_curved(
    lattice: Lattice,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    k: int,
    area: ivec4,
    depth: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """The same for a cylinder or sphere."""
    kind = bodies.kind[k]
    extent = bodies.extent[k]
    origin = views.origin[env, pad, k]
    axes = views.axes[env, pad, k]
    linear = views.linear[env, pad, k]
    angular = views.angular[env, pad, k]
    ex = column(axes, 0)
    ey = column(axes, 1)
    ez = column(axes, 2)
    for row in range(area[0], area[1]):
        y = coordinate(row, lattice.pitch, lattice.rows)
        for col in range(area[2], area[3]):
            x = coordinate(col, lattice.pitch, lattice.cols)
            hit = curved(lattice.mode, kind, origin + x * ex + y * ey, ez, extent)
            index = row * lattice.cols + col
            if hit[0] > depth[index] and hit[0] >= -lattice.reach:
                value = wp.min(hit[0], lattice.reach)
                depth[index] = value
                form = rate_form(lattice.mode, wp.vec3(hit[1], hit[2], hit[3]), axes, linear, angular)
                rate[index] = eval_rate(form, x, y, -value * float(lattice.mode))


@wp.func
def block_of(lattice: Lattice, block: int) -> ivec4:
    """Rows and columns (begin, end, begin, end) that a thread fills."""
    per_row = lattice.cols / lattice.block_cols
    row = (block / per_row) * lattice.block_rows
    col = (block % per_row) * lattice.block_cols
    return ivec4(row, row + lattice.block_rows, col, col + lattice.block_cols)


@wp.func
def overlap(a: ivec4, b: ivec4) -> ivec4:
    """Common rows and columns of two blocks (begin, end, begin, end)."""
    return ivec4(wp.max(a[0], b[0]), wp.min(a[1], b[1]), wp.max(a[2], b[2]), wp.min(a[3], b[3]))


@wp.func
def misses(x: float, radius: float, pitch: float, count: int) -> bool:
    """Whether no lattice index lies within `radius` of x."""
    return first_index(x - radius, pitch, count) >= end_index(x + radius, pitch, count)


@wp.kernel
def query_primitives(
    lattice: Lattice,
    bodies: Bodies,
    views: Views,
    depth: wp.array(dtype=float, ndim=3),
    rate: wp.array(dtype=float, ndim=3),
) -> None:
    """Penetration (CLOSEST) or signed column height (COLUMN) of every lattice point, and its rate [m, m/s].

    Depth must come in holding "nothing there"; a thread fills a block of the lattice: the whole pad on CPU,
    one taxel
    on CUDA.
    """
    env, pad, block = wp.tid()
    mine = block_of(lattice, block)
    for k in range(bodies.kind.shape[0]):
        full = views.window[env, pad, k]
        area = ivec4(
            wp.max(mine[0], full[0]),
            wp.min(mine[1], full[1]),
            wp.max(mine[2], full[2]),
            wp.min(mine[3], full[3]),
        )
        if area[0] >= area[1] or area[2] >= area[3] or bodies.kind[k] == 4:
            continue
        if bodies.plane_start[k] < bodies.plane_start[k + 1]:
            query_convex(lattice, bodies, views, env, pad, k, area, depth[env, pad], rate[env, pad])
        else:
            query_curved(lattice, bodies, views, env, pad, k, area, depth[env, pad], rate[env, pad])


@wp.func
def in_reach(lattice: Lattice, middle: wp.vec3, half: wp.vec3, axes: wp.mat33) -> bool:
    """Whether a box of half-lengths `half` around `middle` (from the pad's origin) can stand over a lattice
    point."""
    ex = column(axes, 0)
    ey = column(axes, 1)
    ez = column(axes, 2)
    above = wp.dot(middle, ez)
    thickness = wp.dot(wp.abs(ez), half)
    if above - thickness > lattice.reach or above + thickness < -lattice.reach:
        return False
    if misses(wp.dot(middle, ex), wp.dot(wp.abs(ex), half), lattice.pitch, lattice.cols):
        return False
    return not misses(wp.dot(middle, ey), wp.dot(wp.abs(ey), half), lattice.pitch, lattice.rows)


@wp.func
def raster_triangle(
    lattice: Lattice, a: wp.vec3, b: wp.vec3, c: wp.vec3, t: int, keys: wp.array(dtype=wp.int64)
) -> None:
    """Offer triangle t, which faces the pad, corners in the pad's frame, to the lattice points under it."""
    row0 = first_index(wp.min(a[1], wp.min(b[1], c[1])), lattice.pitch, lattice.rows)
    row1 = end_index(wp.max(a[1], wp.max(b[1], c[1])), lattice.pitch, lattice.rows)
    col0 = first_index(wp.min(a[0], wp.min(b[0], c[0])), lattice.pitch, lattice.cols)
    col1 = end_index(wp.max(a[0], wp.max(b[0], c[0])), lattice.pitch, lattice.cols)
    if row0 >= row1 or col0 >= col1:
        return
    double_area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if double_area > -1.0e-18:
        return
    inverse = 1.0 / double_area
    for row in range(row0, row1):
        y = coordinate(row, lattice.pitch, lattice.rows)
        for col in range(col0, col1):
            x = coordinate(col, lattice.pitch, lattice.cols)
            wa = ((b[0] - x) * (c[1] - y) - (c[0] - x) * (b[1] - y)) * inverse
            wb = ((c[0] - x) * (a[1] - y) - (a[0] - x) * (c[1] - y)) * inverse
            wc = 1.0 - wa - wb
            # The slack closes the seam between neighbours, which rounding would otherwise leave open.
            if wa >= -1.0e-5 and wb >= -1.0e-5 and wc >= -1.0e-5:
                s = wa * a[2] + wb * b[2] + wc * c[2]
                if wp.abs(s) <= lattice.reach:
                    steps = wp.int64((lattice.reach - s) * KEY_STEPS_PER_M) + wp.int64(1)
                    key = (steps << wp.int64(TRIANGLE_BITS)) | wp.int64(t)
                    wp.atomic_max(keys, row * lattice.cols + col, key)


@wp.kernel
def raster_meshes(
    lattice: Lattice,
    bodies: Bodies,
    views: Views,
    clusters_per_thread: int,
    keys: wp.array(dtype=wp.int64, ndim=3),
) -> None:
    """Project the triangles that face the pad onto the lattice; the lowest over each point wins its key.

    A key holds the height in nanometres above -reach, then the triangle's number: one integer maximum, so
    that the
    result does not depend on the order of threads.
    """
    env, pad, part = wp.tid()
    count = bodies.cluster_owner.shape[0]
    for c in range(part * clusters_per_thread, wp.min((part + 1) * clusters_per_thread, count)):
        k = bodies.cluster_owner[c]
        area = views.window[env, pad, k]
        if area[0] >= area[1]:
            continue
        axes = views.axes[env, pad, k]
        origin = views.origin[env, pad, k]
        if not in_reach(lattice, bodies.cluster_centre[c] - origin, bodies.cluster_half[c], axes):
            continue
        to_pad = wp.transpose(axes)
        ez = column(axes, 2)
        for t in range(bodies.cluster_start[c], bodies.cluster_start[c + 1]):
            if wp.dot(bodies.normals[t], ez) >= 0.0:
                continue
            raster_triangle(
                lattice,
                to_pad * (bodies.corners[3 * t] - origin),
                to_pad * (bodies.corners[3 * t + 1] - origin),
                to_pad * (bodies.corners[3 * t + 2] - origin),
                t,
                keys[env, pad],
            )


@wp.func
def closest_on_mesh(mesh: wp.uint64, p: wp.vec3, height: float, normal: wp.vec3) -> wp.vec4:
    """Distance and outward normal from p inside a closed surface `height` away along the pad's normal."""
    # The nearest point is no farther than the one along the normal.
    query = wp.mesh_query_point_no_sign(mesh, p, 1.01 * height + 1.0e-6)
    if query.result:
        outward = wp.mesh_eval_position(mesh, query.face, query.u, query.v) - p
        distance = wp.length(outward)
        if distance > 1.0e-6:
            return wp.vec4(distance, outward[0] / distance, outward[1] / distance, outward[2] / distance)
        return wp.vec4(distance, normal[0], normal[1], normal[2])
    return wp.vec4(height, normal[0], normal[1], normal[2])


@wp.func
def mesh_area(bodies: Bodies, window: wp.array(dtype=ivec4)) -> ivec4:
    """Smallest block of the lattice that holds all meshes' areas."""
    area = ivec4(1000000, 0, 1000000, 0)
    for k in range(bodies.kind.shape[0]):
        other = window[k]
        if bodies.kind[k] == 4 and other[0] < other[1]:
            area = ivec4(
                wp.min(area[0], other[0]),
                wp.max(area[1], other[1]),
                wp.min(area[2], other[2]),
                wp.max(area[3], other[3]),
            )
    return area


@wp.kernel
def resolve_meshes(
    lattice: Lattice,
    bodies: Bodies,
    views: Views,
    keys: wp.array(dtype=wp.int64, ndim=3),
    depth: wp.array(dtype=float, ndim=3),
    rate: wp.array(dtype=float, ndim=3),
) -> None:
    """Depth and rate of the winning triangles; in CLOSEST mode the distance to the mesh. Clears the keys."""
    env, pad, block = wp.tid()
    mine = overlap(block_of(lattice, block), mesh_area(bodies, views.window[env, pad]))
    k = int(-1)
    axes = wp.identity(n=3, dtype=float)
    linear = wp.vec3(0.0, 0.0, 0.0)
    angular = wp.vec3(0.0, 0.0, 0.0)
    for row in range(mine[0], mine[1]):
        for col in range(mine[2], mine[3]):
            index = row * lattice.cols + col
            key = keys[env, pad, index]
            if key == wp.int64(0):
                continue
            keys[env, pad, index] = wp.int64(0)
            t = wp.int32(key & ((wp.int64(1) << wp.int64(TRIANGLE_BITS)) - wp.int64(1)))
            height = float((key >> wp.int64(TRIANGLE_BITS)) - wp.int64(1)) / KEY_STEPS_PER_M - lattice.reach
            if height <= depth[env, pad, index]:
                continue
            if bodies.triangle_owner[t] != k:
                k = bodies.triangle_owner[t]
                axes = views.axes[env, pad, k]
                linear = views.linear[env, pad, k]
                angular = views.angular[env, pad, k]
            x = coordinate(col, lattice.pitch, lattice.cols)
            y = coordinate(row, lattice.pitch, lattice.rows)
            n = bodies.normals[t]
            hit = wp.vec4(height, n[0], n[1], n[2])
            if lattice.mode == CLOSEST:
                p = views.origin[env, pad, k] + x * column(axes, 0) + y * column(axes, 1)
                hit = closest_on_mesh(bodies.mesh[k], p, height, n)
            if hit[0] > depth[env, pad, index]:
                depth[env, pad, index] = hit[0]
                n = wp.vec3(hit[1], hit[2], hit[3])
                form = rate_form(lattice.mode, n, axes, linear, angular)
                rate[env, pad, index] = eval_rate(form, x, y, -hit[0] * float(lattice.mode))
