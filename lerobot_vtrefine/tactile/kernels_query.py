"""Device functions that evaluate prepared primitives and meshes on a pad's lattice, and a kernel of these
alone. Shapes and terms as in `kernels`.

Each pad is one thread on CPU and a warp on CUDA. Lanes own lattice points, but of meshes, whose triangles
they share out; results never depend on their order.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import (
    CLOSEST,
    COLUMN,
    FAR_M,
    MESH,
    NO_BODY_M,
    Bodies,
    Lattice,
    Views,
    column,
    coordinate,
    cylinder_closest,
    cylinder_column,
    eval_rate,
    ivec2,
    ivec4,
    rate_form,
    sphere_closest,
    sphere_column,
)
from lerobot_vtrefine.tactile.kernels_grid import query_grid
from lerobot_vtrefine.tactile.kernels_lanes import (
    Share,
    ballot,
    drop_bit,
    lanes,
    make_share,
    most_of_lanes,
    nth_bit,
    own_first,
)
from lerobot_vtrefine.tactile.kernels_raster import raster_mesh
from lerobot_vtrefine.tactile.kernels_surface import (
    give_out,
    height_at,
    put_point,
    raise_span,
    row_length,
    take_in,
    taxel_room,
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
def query_face(
    lattice: Lattice,
    share: Share,
    stride: int,
    low: float,
    area: ivec4,
    form: wp.vec4,
    speed: wp.vec4,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Column heights where a single plane decides: the usual case of a part held flat."""
    middle = 0.5 * float(lattice.cols - 1)
    bounds = wp.vec4(-low, -FAR_M, lattice.reach, FAR_M)
    for row in range(own_first(area[0], share.row, share.rows), area[1], share.rows):
        y = coordinate(row, lattice.pitch, lattice.rows)
        plane = wp.vec2(-form[0] - form[2] * y, -form[1])
        along = wp.vec3(speed[0] + speed[2] * y, speed[1], speed[3])
        start = row * stride
        raise_span(share, height, rate, start, area[2], area[3], middle, lattice.pitch, plane, bounds, along)


@wp.func
def query_solid(
    lattice: Lattice,
    share: Share,
    stride: int,
    low: float,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    k: int,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Raise depths and rates to those of primitive k: convex with kept planes, cylinder or sphere."""
    area = views.window[env, pad, k]
    first = bodies.plane_start[k]
    last = bodies.plane_start[k + 1]
    kept = views.counts[env, pad, k]
    forms = views.forms[env, pad]
    rates = views.rates[env, pad]
    axes = views.axes[env, pad, k]
    origin = views.origin[env, pad, k]
    linear = views.linear[env, pad, k]
    angular = views.angular[env, pad, k]
    kind = bodies.kind[k]
    extent = bodies.extent[k]
    for row in range(own_first(area[0], share.row, share.rows), area[1], share.rows):
        y = coordinate(row, lattice.pitch, lattice.rows)
        along = origin + y * column(axes, 1)
        for col in range(own_first(area[2], share.col, share.cols), area[3], share.cols):
            x = coordinate(col, lattice.pitch, lattice.cols)
            index = row * stride + col
            before = height_at(height, index)
            value = float(0.0)
            form = wp.vec4(0.0, 0.0, 0.0, 0.0)
            if first < last:
                found = wp.vec2(0.0, 0.0)
                if lattice.mode == COLUMN:
                    found = column_entry(first, last, kept, x, y, forms)
                else:
                    found = least_gap(first, kept, x, y, forms)
                value = wp.min(found[0], lattice.reach)
                form = rates[wp.int32(found[1])]
            else:
                hit = curved(lattice.mode, kind, along + x * column(axes, 0), column(axes, 2), extent)
                value = wp.min(hit[0], lattice.reach)
                if value > before:
                    form = rate_form(lattice.mode, wp.vec3(hit[1], hit[2], hit[3]), axes, linear, angular)
            if value > before and value >= -low:
                put_point(height, rate, index, value, eval_rate(form, x, y, -value * float(lattice.mode)))


@wp.func
def fill_columns(
    lattice: Lattice,
    share: Share,
    stride: int,
    low: float,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Raise one pad's column heights and their rates to those of all bodies.

    Heights must come in holding "nothing there"; those below -low are left out.
    """
    fixed = lattice
    fixed.mode = COLUMN
    for base in range(0, bodies.kind.shape[0], lanes()):
        waiting = ballot(stands_over(views, env, pad, base + share.lane))
        while waiting != 0:
            k = base + nth_bit(waiting, 0)
            waiting = drop_bit(waiting)
            kept = views.counts[env, pad, k]
            first = bodies.plane_start[k]
            if bodies.kind[k] == MESH:
                raster_mesh(fixed, share, stride, low, bodies, views, env, pad, k, height, rate)
            elif kept[0] == 1 and kept[1] == 0 and first < bodies.plane_start[k + 1]:
                form = views.forms[env, pad, first]
                speed = views.rates[env, pad, first]
                area = views.window[env, pad, k]
                query_face(fixed, share, stride, low, area, form, speed, height, rate)
            else:
                query_solid(fixed, share, stride, low, bodies, views, env, pad, k, height, rate)


@wp.func
def fill_closest(
    lattice: Lattice,
    share: Share,
    stride: int,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Raise one pad's penetrations and their rates to those of all bodies; they must come in as zero or
    less."""
    fixed = lattice
    fixed.mode = CLOSEST
    for base in range(0, bodies.kind.shape[0], lanes()):
        waiting = ballot(stands_over(views, env, pad, base + share.lane))
        while waiting != 0:
            k = base + nth_bit(waiting, 0)
            waiting = drop_bit(waiting)
            if bodies.kind[k] == MESH:
                query_grid(fixed, share, stride, bodies, views, env, pad, k, height, rate)
            else:
                query_solid(fixed, share, stride, 0.0, bodies, views, env, pad, k, height, rate)


@wp.func
def stands_over(views: Views, env: int, pad: int, k: int) -> bool:
    """Whether primitive k, if there is one of that number, stands over the pad."""
    if k >= views.window.shape[2]:
        return False
    area = views.window[env, pad, k]
    return area[0] < area[1]


@wp.func
def contact_area(
    share: Share, rows: int, cols: int, subdivision: int, window: wp.array(dtype=ivec4)
) -> ivec4:
    """Smallest block of whole taxels, and of whole packs of columns, that holds all primitives' areas; empty
    (begin >= end) without any."""
    area = ivec4(rows, 0, cols, 0)
    for k in range(share.lane, window.shape[0], lanes()):
        other = window[k]
        if other[0] < other[1]:
            area = ivec4(
                wp.min(area[0], other[0]),
                wp.max(area[1], other[1]),
                wp.min(area[2], other[2]),
                wp.max(area[3], other[3]),
            )
    begin_row = -most_of_lanes(-area[0])
    begin_col = -most_of_lanes(-area[2])
    end_row = most_of_lanes(area[1])
    end_col = most_of_lanes(area[3])
    step = subdivision
    if lanes() == 1 and cols % 8 == 0 and 8 % subdivision == 0:
        step = 8
    return ivec4(
        begin_row / subdivision * subdivision,
        (end_row + subdivision - 1) / subdivision * subdivision,
        begin_col / step * step,
        (end_col + step - 1) / step * step,
    )


@wp.kernel
def query(
    lattice: Lattice,
    bodies: Bodies,
    views: Views,
    room: wp.array(dtype=float, ndim=2),
    height: wp.array(dtype=float, ndim=3),
    rate: wp.array(dtype=float, ndim=3),
) -> None:
    """Penetration (CLOSEST) or signed column height (COLUMN) of every lattice point, and its rate [m, m/s].

    Heights must come in holding "nothing there". `room` is scratch, a pad each or shared by all.
    """
    env, pad, lane = wp.tid()
    share = make_share(lattice.subdivision, lane)
    heights = height[env, pad]
    rates = rate[env, pad]
    area = contact_area(share, lattice.rows, lattice.cols, 1, views.window[env, pad])
    stride = row_length(lattice.cols, area)
    spare = room[wp.min(env * height.shape[1] + pad, room.shape[0] - 1)]
    surface = taxel_room(area, stride, heights, spare)
    take_in(share, area, stride, lattice.cols, heights, rates, surface)
    if lattice.mode == COLUMN:
        fill_columns(lattice, share, stride, lattice.reach, bodies, views, env, pad, surface, rates)
    else:
        fill_closest(lattice, share, stride, bodies, views, env, pad, surface, rates)
    give_out(share, area, stride, lattice.cols, surface, heights, rates)
