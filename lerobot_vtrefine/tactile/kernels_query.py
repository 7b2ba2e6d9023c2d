"""Warp kernels that evaluate prepared primitives and meshes on the lattice. Shapes and terms as in `kernels`."""

import warp as wp

from lerobot_vtrefine.tactile.kernels import (
    CLOSEST,
    COLUMN,
    FAR_M,
    KEY_STEPS_PER_M,
    NO_BODY_M,
    STEEPEST,
    TRIANGLE_BITS,
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
    """Depth and normal of a cylinder or sphere at p; in COLUMN mode along e, NO_BODY_M where there is nothing."""
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
    first: int, last: int, enters: int, leaves: int, x: float, y: float, forms: wp.array(dtype=wp.vec4)
) -> wp.vec2:
    """Height of a convex solid over (x, y) and the plane it belongs to; NO_BODY_M where the column misses it."""
    enter = float(-FAR_M)
    best = int(first)
    for q in range(first, first + enters):
        form = forms[q]
        s = form[0] + form[1] * x + form[2] * y
        if s > enter:
            enter = s
            best = q
    for q in range(last - leaves, last):
        form = forms[q]
        s = form[0] + form[1] * x + form[2] * y
        if s < enter or s < 0.0:
            return wp.vec2(NO_BODY_M, float(best))
    return wp.vec2(-enter, float(best))


@wp.func
def least_gap(first: int, enters: int, x: float, y: float, forms: wp.array(dtype=wp.vec4)) -> wp.vec2:
    """Penetration into a convex solid at (x, y), negative outside, and the plane that it is measured to."""
    value = float(FAR_M)
    best = int(first)
    for q in range(first, first + enters):
        form = forms[q]
        s = form[0] + form[1] * x + form[2] * y
        if s < value:
            value = s
            best = q
    return wp.vec2(value, float(best))


@wp.func
def eval_rate(form: wp.vec4, x: float, y: float, s: float) -> float:
    return form[0] + form[1] * x + form[2] * y + form[3] * s


@wp.func
def query_convex(
    mode: int,
    lattice: ivec2,
    pitch: float,
    reach: float,
    area: ivec4,
    first: int,
    last: int,
    kept: ivec2,
    forms: wp.array(dtype=wp.vec4),
    rates: wp.array(dtype=wp.vec4),
    depth: wp.array(dtype=float),
    rate: wp.array(dtype=float),
):
    """Raise depth and rate on the rows area[0:2] and columns area[2:4] to those of one convex solid."""
    for row in range(area[0], area[1]):
        y = coordinate(row, pitch, lattice[0])
        for col in range(area[2], area[3]):
            x = coordinate(col, pitch, lattice[1])
            found = wp.vec2(0.0, 0.0)
            if mode == COLUMN:
                found = column_entry(first, last, kept[0], kept[1], x, y, forms)
            else:
                found = least_gap(first, kept[0], x, y, forms)
            index = row * lattice[1] + col
            if found[0] > depth[index] and found[0] >= -reach:
                value = wp.min(found[0], reach)
                depth[index] = value
                rate[index] = eval_rate(rates[wp.int32(found[1])], x, y, -value * float(mode))


@wp.func
def query_curved(
    mode: int,
    lattice: ivec2,
    pitch: float,
    reach: float,
    area: ivec4,
    kind: int,
    extent: wp.vec3,
    origin: wp.vec3,
    axes: wp.mat33,
    linear: wp.vec3,
    angular: wp.vec3,
    depth: wp.array(dtype=float),
    rate: wp.array(dtype=float),
):
    """The same for a cylinder or sphere."""
    ex = wp.vec3(axes[0, 0], axes[1, 0], axes[2, 0])
    ey = wp.vec3(axes[0, 1], axes[1, 1], axes[2, 1])
    ez = wp.vec3(axes[0, 2], axes[1, 2], axes[2, 2])
    for row in range(area[0], area[1]):
        y = coordinate(row, pitch, lattice[0])
        for col in range(area[2], area[3]):
            x = coordinate(col, pitch, lattice[1])
            hit = curved(mode, kind, origin + x * ex + y * ey, ez, extent)
            index = row * lattice[1] + col
            if hit[0] > depth[index] and hit[0] >= -reach:
                value = wp.min(hit[0], reach)
                depth[index] = value
                n = wp.vec3(hit[1], hit[2], hit[3])
                form = rate_form(mode, n, wp.dot(n, ez), ex, ey, ez, linear, angular)
                rate[index] = eval_rate(form, x, y, -value * float(mode))


@wp.kernel
def query_primitives(
    mode: int,
    rows: int,
    cols: int,
    pitch: float,
    reach: float,
    rows_per_thread: int,
    cols_per_thread: int,
    kind: wp.array(dtype=int),
    extent: wp.array(dtype=wp.vec3),
    plane_start: wp.array(dtype=int),
    origin: wp.array(dtype=wp.vec3, ndim=3),
    axes: wp.array(dtype=wp.mat33, ndim=3),
    linear: wp.array(dtype=wp.vec3, ndim=3),
    angular: wp.array(dtype=wp.vec3, ndim=3),
    window: wp.array(dtype=ivec4, ndim=3),
    counts: wp.array(dtype=ivec2, ndim=3),
    forms: wp.array(dtype=wp.vec4, ndim=3),
    rates: wp.array(dtype=wp.vec4, ndim=3),
    depth: wp.array(dtype=float, ndim=3),
    rate: wp.array(dtype=float, ndim=3),
):
    """Penetration (CLOSEST) or signed column height (COLUMN) of every lattice point, and its rate [m, m/s].

    Depth must come in holding "nothing there"; a thread fills a block of the lattice: the whole pad on CPU, one taxel
    on CUDA.
    """
    env, pad, block = wp.tid()
    blocks_per_row = cols / cols_per_thread
    row_begin = (block / blocks_per_row) * rows_per_thread
    col_begin = (block % blocks_per_row) * cols_per_thread
    pad_depth = depth[env, pad]
    pad_rate = rate[env, pad]
    pad_forms = forms[env, pad]
    pad_rates = rates[env, pad]
    lattice = ivec2(rows, cols)
    for k in range(kind.shape[0]):
        full = window[env, pad, k]
        area = ivec4(
            wp.max(row_begin, full[0]),
            wp.min(row_begin + rows_per_thread, full[1]),
            wp.max(col_begin, full[2]),
            wp.min(col_begin + cols_per_thread, full[3]),
        )
        if area[0] >= area[1] or area[2] >= area[3] or kind[k] == 4:
            continue
        first = plane_start[k]
        last = plane_start[k + 1]
        if last > first:
            kept = counts[env, pad, k]
            query_convex(
                mode,
                lattice,
                pitch,
                reach,
                area,
                first,
                last,
                kept,
                pad_forms,
                pad_rates,
                pad_depth,
                pad_rate,
            )
        else:
            query_curved(
                mode,
                lattice,
                pitch,
                reach,
                area,
                kind[k],
                extent[k],
                origin[env, pad, k],
                axes[env, pad, k],
                linear[env, pad, k],
                angular[env, pad, k],
                pad_depth,
                pad_rate,
            )


@wp.kernel
def raster_meshes(
    rows: int,
    cols: int,
    pitch: float,
    reach: float,
    clusters_per_thread: int,
    cluster_owner: wp.array(dtype=int),
    cluster_start: wp.array(dtype=int),
    cluster_centre: wp.array(dtype=wp.vec3),
    cluster_half: wp.array(dtype=wp.vec3),
    corners: wp.array(dtype=wp.vec3),
    origin: wp.array(dtype=wp.vec3, ndim=3),
    axes: wp.array(dtype=wp.mat33, ndim=3),
    window: wp.array(dtype=ivec4, ndim=3),
    keys: wp.array(dtype=wp.int64, ndim=3),
):
    """Project the triangles that face the pad onto the lattice; the lowest over each point wins its key.

    A key holds the height in nanometres above -reach, then the triangle's number: one integer maximum, so that the
    result does not depend on the order of threads.
    """
    env, pad, part = wp.tid()
    for c in range(
        part * clusters_per_thread, wp.min((part + 1) * clusters_per_thread, cluster_owner.shape[0])
    ):
        k = cluster_owner[c]
        area = window[env, pad, k]
        if area[0] >= area[1]:
            continue
        frame = axes[env, pad, k]
        ex = wp.vec3(frame[0, 0], frame[1, 0], frame[2, 0])
        ey = wp.vec3(frame[0, 1], frame[1, 1], frame[2, 1])
        ez = wp.vec3(frame[0, 2], frame[1, 2], frame[2, 2])
        start = origin[env, pad, k]
        middle = cluster_centre[c] - start
        half = cluster_half[c]
        above = wp.dot(middle, ez)
        thickness = wp.dot(wp.abs(ez), half)
        if above - thickness > reach or above + thickness < -reach:
            continue
        x_mid = wp.dot(middle, ex)
        y_mid = wp.dot(middle, ey)
        x_half = wp.dot(wp.abs(ex), half)
        y_half = wp.dot(wp.abs(ey), half)
        if first_index(x_mid - x_half, pitch, cols) >= end_index(x_mid + x_half, pitch, cols):
            continue
        if first_index(y_mid - y_half, pitch, rows) >= end_index(y_mid + y_half, pitch, rows):
            continue
        for t in range(cluster_start[c], cluster_start[c + 1]):
            a = corners[3 * t] - start
            b = corners[3 * t + 1] - start
            d = corners[3 * t + 2] - start
            ax = wp.dot(a, ex)
            bx = wp.dot(b, ex)
            dx = wp.dot(d, ex)
            ay = wp.dot(a, ey)
            by = wp.dot(b, ey)
            dy = wp.dot(d, ey)
            double_area = (bx - ax) * (dy - ay) - (dx - ax) * (by - ay)
            # Outward winding: a triangle that faces the pad runs clockwise seen from above it.
            if double_area > -1.0e-18:
                continue
            row0 = first_index(wp.min(ay, wp.min(by, dy)), pitch, rows)
            row1 = end_index(wp.max(ay, wp.max(by, dy)), pitch, rows)
            col0 = first_index(wp.min(ax, wp.min(bx, dx)), pitch, cols)
            col1 = end_index(wp.max(ax, wp.max(bx, dx)), pitch, cols)
            for row in range(row0, row1):
                y = coordinate(row, pitch, rows)
                for col in range(col0, col1):
                    x = coordinate(col, pitch, cols)
                    wa = ((bx - x) * (dy - y) - (dx - x) * (by - y)) / double_area
                    wb = ((dx - x) * (ay - y) - (ax - x) * (dy - y)) / double_area
                    wd = 1.0 - wa - wb
                    if wa >= -1.0e-5 and wb >= -1.0e-5 and wd >= -1.0e-5:
                        s = wa * wp.dot(a, ez) + wb * wp.dot(b, ez) + wd * wp.dot(d, ez)
                        if wp.abs(s) <= reach:
                            steps = wp.int64((reach - s) * KEY_STEPS_PER_M) + wp.int64(1)
                            key = (steps << wp.int64(TRIANGLE_BITS)) | wp.int64(t)
                            wp.atomic_max(keys, env, pad, row * cols + col, key)


@wp.kernel
def resolve_meshes(
    mode: int,
    rows: int,
    cols: int,
    pitch: float,
    rows_per_thread: int,
    cols_per_thread: int,
    triangle_owner: wp.array(dtype=int),
    corners: wp.array(dtype=wp.vec3),
    mesh: wp.array(dtype=wp.uint64),
    origin: wp.array(dtype=wp.vec3, ndim=3),
    axes: wp.array(dtype=wp.mat33, ndim=3),
    linear: wp.array(dtype=wp.vec3, ndim=3),
    angular: wp.array(dtype=wp.vec3, ndim=3),
    keys: wp.array(dtype=wp.int64, ndim=3),
    depth: wp.array(dtype=float, ndim=3),
    rate: wp.array(dtype=float, ndim=3),
):
    """Depth and rate of the winning triangles; in CLOSEST mode the exact distance to the surface. Clears the keys."""
    env, pad, block = wp.tid()
    blocks_per_row = cols / cols_per_thread
    row_begin = (block / blocks_per_row) * rows_per_thread
    col_begin = (block % blocks_per_row) * cols_per_thread
    for row in range(row_begin, row_begin + rows_per_thread):
        for col in range(col_begin, col_begin + cols_per_thread):
            index = row * cols + col
            key = keys[env, pad, index]
            if key == wp.int64(0):
                continue
            keys[env, pad, index] = wp.int64(0)
            t = wp.int32(key & ((wp.int64(1) << wp.int64(TRIANGLE_BITS)) - wp.int64(1)))
            k = triangle_owner[t]
            frame = axes[env, pad, k]
            ex = wp.vec3(frame[0, 0], frame[1, 0], frame[2, 0])
            ey = wp.vec3(frame[0, 1], frame[1, 1], frame[2, 1])
            ez = wp.vec3(frame[0, 2], frame[1, 2], frame[2, 2])
            x = coordinate(col, pitch, cols)
            y = coordinate(row, pitch, rows)
            p = origin[env, pad, k] + x * ex + y * ey
            n = wp.normalize(
                wp.cross(corners[3 * t + 1] - corners[3 * t], corners[3 * t + 2] - corners[3 * t])
            )
            value = -wp.dot(n, corners[3 * t] - p) / wp.dot(n, ez)
            s = -value
            if mode == CLOSEST:
                s = 0.0
                if value > 0.0:
                    query = wp.mesh_query_point_no_sign(mesh[k], p, 1.01 * value + 1.0e-6)
                    if query.result:
                        outward = wp.mesh_eval_position(mesh[k], query.face, query.u, query.v) - p
                        value = wp.length(outward)
                        if value > 1.0e-6:
                            n = outward / value
            if value > depth[env, pad, index]:
                depth[env, pad, index] = value
                r = rate_form(mode, n, wp.dot(n, ez), ex, ey, ez, linear[env, pad, k], angular[env, pad, k])
                rate[env, pad, index] = r[0] + r[1] * x + r[2] * y + r[3] * s
