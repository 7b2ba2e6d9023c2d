"""Device functions that evaluate prepared primitives and meshes on a pad's lattice, and a kernel of these
alone. Shapes and terms as in `kernels`.

Each pad is one thread on CPU and `lanes` threads of a warp on CUDA, which own whole columns of taxels: no two
ever touch the same lattice point, so that nothing needs to be atomic or depends on their order.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import (
    COLUMN,
    FAR_M,
    MESH,
    NO_BODY_M,
    Bodies,
    Lattice,
    Share,
    Views,
    column,
    coordinate,
    cylinder_closest,
    cylinder_column,
    end_index,
    eval_rate,
    first_index,
    ivec2,
    ivec4,
    own_first,
    own_width,
    rate_form,
    sphere_closest,
    sphere_column,
)
from lerobot_vtrefine.tactile.kernels_grid import query_grid

wp.set_module_options({"enable_backward": False})

SEAM = wp.constant(1.0e-5)
"""Share of a triangle's size by which it is widened: closes the seam between neighbours, which rounding would
otherwise leave open."""


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


@wp.func_native("""
float* heights = height.data + row;
float* rates = rate.data + row;
int c = begin;
#if defined(__CUDA_ARCH__)
int span = share.width * share.lanes;
c = begin / span * span + share.lane * share.width;
#else
typedef float pack __attribute__((ext_vector_type(8)));
pack index = {0.f, 1.f, 2.f, 3.f, 4.f, 5.f, 6.f, 7.f};
for (; c + 8 <= end; c += 8) {
    pack x = (index + ((float)c - middle)) * pitch, h = plane[0] + plane[1] * x, old, oldrate;
    h = __builtin_elementwise_min(__builtin_elementwise_max(h, (pack)bounds[1]), (pack)bounds[2]);
    __builtin_memcpy(&old, heights + c, sizeof(pack));
    __builtin_memcpy(&oldrate, rates + c, sizeof(pack));
    auto wins = (h > old) & (h >= bounds[0]) & (h <= bounds[3]);
    pack r = speed[0] + speed[1] * x - speed[2] * h;
    h = wins ? h : old;
    r = wins ? r : oldrate;
    __builtin_memcpy(heights + c, &h, sizeof(pack));
    __builtin_memcpy(rates + c, &r, sizeof(pack));
}
#endif
while (c < end) {
    float x = ((float)c - middle) * pitch;
    float h = plane[0] + plane[1] * x;
    h = h < bounds[1] ? bounds[1] : h;
    h = h > bounds[2] ? bounds[2] : h;
    if (c >= begin && h > heights[c] && h >= bounds[0] && h <= bounds[3]) {
        heights[c] = h;
        rates[c] = speed[0] + speed[1] * x - speed[2] * h;
    }
    c += 1;
    if (share.lanes > 1 && c % share.width == 0) c += (share.lanes - 1) * share.width;
}
""")
def raise_span(
    share: Share,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
    row: int,
    begin: int,
    end: int,
    middle: float,
    pitch: float,
    plane: wp.vec2,
    bounds: wp.vec4,
    speed: wp.vec3,
) -> None:
    """Raise one row's columns begin..end to a plane: height plane . (1, x), rate speed . (1, x, -height).

    `row` is the row's place in the arrays, `bounds` the lowest height that counts, the two between which the
    plane's is held, and the highest that counts.
    """
    ...


@wp.func
def query_face(
    lattice: Lattice,
    share: Share,
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
    for row in range(area[0], area[1]):
        y = coordinate(row, lattice.pitch, lattice.rows)
        plane = wp.vec2(-form[0] - form[2] * y, -form[1])
        along = wp.vec3(speed[0] + speed[2] * y, speed[1], speed[3])
        start = row * lattice.cols
        raise_span(share, height, rate, start, area[2], area[3], middle, lattice.pitch, plane, bounds, along)


@wp.func
def query_solid(
    lattice: Lattice,
    share: Share,
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
    width = own_width(share, area[2], area[3])
    for row in range(area[0], area[1]):
        y = coordinate(row, lattice.pitch, lattice.rows)
        along = origin + y * column(axes, 1)
        for group in range(own_first(share, area[2]), area[3], width * share.lanes):
            for col in range(wp.max(group, area[2]), wp.min(group + width, area[3])):
                x = coordinate(col, lattice.pitch, lattice.cols)
                index = row * lattice.cols + col
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
                    if value > height[index]:
                        form = rate_form(lattice.mode, wp.vec3(hit[1], hit[2], hit[3]), axes, linear, angular)
                if value > height[index] and value >= -low:
                    height[index] = value
                    rate[index] = eval_rate(form, x, y, -value * float(lattice.mode))


@wp.func
def misses(x: float, radius: float, pitch: float, count: int) -> bool:
    """Whether no lattice index lies within `radius` of x."""
    return first_index(x - radius, pitch, count) >= end_index(x + radius, pitch, count)


@wp.func
def in_reach(lattice: Lattice, low: float, middle: wp.vec3, half: wp.vec3, axes: wp.mat33) -> bool:
    """Whether a box of half-lengths `half` around `middle` (from the pad's origin) can stand over a lattice
    point, between `low` above the face and the reach below it."""
    ez = column(axes, 2)
    above = wp.dot(middle, ez)
    thickness = wp.dot(wp.abs(ez), half)
    if above - thickness > low or above + thickness < -lattice.reach:
        return False
    ex = column(axes, 0)
    if misses(wp.dot(middle, ex), wp.dot(wp.abs(ex), half), lattice.pitch, lattice.cols):
        return False
    ey = column(axes, 1)
    return not misses(wp.dot(middle, ey), wp.dot(wp.abs(ey), half), lattice.pitch, lattice.rows)


@wp.func
def edge_bounds(bounds: wp.vec2, at_zero: float, slope: float) -> wp.vec2:
    """The part of [bounds[0], bounds[1]] in which at_zero + slope x >= -SEAM; empty as (FAR_M, -FAR_M)."""
    if wp.abs(slope) < 1.0e-9:
        if at_zero < -SEAM:
            return wp.vec2(FAR_M, -FAR_M)
        return bounds
    x = (-SEAM - at_zero) / slope
    if slope > 0.0:
        return wp.vec2(wp.max(bounds[0], x), bounds[1])
    return wp.vec2(bounds[0], wp.min(bounds[1], x))


@wp.func
def raster_triangle(
    lattice: Lattice,
    share: Share,
    low: float,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    speed: wp.vec4,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Raise the lattice points under a triangle that faces the pad, corners in the pad's frame."""
    lowest = wp.min(a[2], wp.min(b[2], c[2]))
    row0 = first_index(wp.min(a[1], wp.min(b[1], c[1])), lattice.pitch, lattice.rows)
    row1 = end_index(wp.max(a[1], wp.max(b[1], c[1])), lattice.pitch, lattice.rows)
    double_area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if row0 >= row1 or lowest > low or double_area > -1.0e-18:
        return
    inverse = 1.0 / double_area
    # Barycentric weights of a and b as functions affine in x and y.
    wa = wp.vec2((b[1] - c[1]) * inverse, (c[0] - b[0]) * inverse)
    wb = wp.vec2((c[1] - a[1]) * inverse, (a[0] - c[0]) * inverse)
    middle = 0.5 * float(lattice.cols - 1)
    highest = wp.max(a[2], wp.max(b[2], c[2]))
    bounds = wp.vec4(-low, -highest, -lowest, lattice.reach)
    for row in range(row0, row1):
        y = coordinate(row, lattice.pitch, lattice.rows)
        at_a = -wa[0] * c[0] + wa[1] * (y - c[1])
        at_b = -wb[0] * c[0] + wb[1] * (y - c[1])
        inside = edge_bounds(wp.vec2(-FAR_M, FAR_M), at_a, wa[0])
        inside = edge_bounds(inside, at_b, wb[0])
        inside = edge_bounds(inside, 1.0 - at_a - at_b, -wa[0] - wb[0])
        if inside[0] <= inside[1]:
            begin = first_index(inside[0], lattice.pitch, lattice.cols)
            end = end_index(inside[1], lattice.pitch, lattice.cols)
            # Heights are -z, so that weights enter with the corners' differences to c.
            plane = wp.vec2(
                -c[2] - at_a * (a[2] - c[2]) - at_b * (b[2] - c[2]),
                -wa[0] * (a[2] - c[2]) - wb[0] * (b[2] - c[2]),
            )
            along = wp.vec3(speed[0] + speed[2] * y, speed[1], speed[3])
            start = row * lattice.cols
            raise_span(share, height, rate, start, begin, end, middle, lattice.pitch, plane, bounds, along)


@wp.func
def raster_mesh(
    lattice: Lattice,
    share: Share,
    low: float,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    k: int,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Project the triangles of mesh k that face the pad onto the lattice."""
    axes = views.axes[env, pad, k]
    origin = views.origin[env, pad, k]
    to_pad = wp.transpose(axes)
    ez = column(axes, 2)
    for c in range(bodies.cluster_range[k][0], bodies.cluster_range[k][1]):
        if in_reach(lattice, low, bodies.cluster_centre[c] - origin, bodies.cluster_half[c], axes):
            for t in range(bodies.cluster_start[c], bodies.cluster_start[c + 1]):
                normal = bodies.normals[t]
                if wp.dot(normal, ez) < 0.0:
                    speed = rate_form(
                        COLUMN, normal, axes, views.linear[env, pad, k], views.angular[env, pad, k]
                    )
                    raster_triangle(
                        lattice,
                        share,
                        low,
                        to_pad * (bodies.corners[3 * t] - origin),
                        to_pad * (bodies.corners[3 * t + 1] - origin),
                        to_pad * (bodies.corners[3 * t + 2] - origin),
                        speed,
                        height,
                        rate,
                    )


@wp.func
def fill_pad(
    lattice: Lattice,
    share: Share,
    low: float,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Raise one pad's penetrations (CLOSEST) or column heights (COLUMN), and their rates, to those of all
    bodies.

    Heights must come in holding "nothing there"; those below -low are left out.
    """
    for k in range(bodies.kind.shape[0]):
        area = views.window[env, pad, k]
        if area[0] < area[1]:
            kept = views.counts[env, pad, k]
            first = bodies.plane_start[k]
            if bodies.kind[k] == MESH:
                if lattice.mode == COLUMN:
                    raster_mesh(lattice, share, low, bodies, views, env, pad, k, height, rate)
                else:
                    query_grid(lattice, share, bodies, views, env, pad, k, height, rate)
            elif (
                lattice.mode == COLUMN and kept[0] == 1 and kept[1] == 0 and first < bodies.plane_start[k + 1]
            ):
                form = views.forms[env, pad, first]
                query_face(lattice, share, low, area, form, views.rates[env, pad, first], height, rate)
            else:
                query_solid(lattice, share, low, bodies, views, env, pad, k, height, rate)


@wp.kernel
def query(
    lattice: Lattice,
    lanes: int,
    bodies: Bodies,
    views: Views,
    height: wp.array(dtype=float, ndim=3),
    rate: wp.array(dtype=float, ndim=3),
) -> None:
    """Penetration (CLOSEST) or signed column height (COLUMN) of every lattice point, and its rate [m, m/s].

    Heights must come in holding "nothing there".
    """
    env, pad, lane = wp.tid()
    share = Share()
    share.lane = lane
    share.lanes = lanes
    share.width = lattice.subdivision
    fill_pad(lattice, share, lattice.reach, bodies, views, env, pad, height[env, pad], rate[env, pad])
