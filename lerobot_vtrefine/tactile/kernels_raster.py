"""Device functions that project a mesh's triangles onto a pad's lattice. Shapes and terms as in `kernels`.

On CUDA a pad's lanes share the triangles out, and where these are few, their rows; the surface that a point
keeps (`kernels_surface`) does not depend on their order.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import (
    COLUMN,
    FAR_M,
    Bodies,
    Lattice,
    Views,
    column,
    coordinate,
    end_index,
    first_index,
    rate_form,
)
from lerobot_vtrefine.tactile.kernels_lanes import (
    Share,
    alone,
    ballot,
    count_bits,
    drop_bit,
    lanes,
    nth_bit,
    share_bits,
    sync_lanes,
)
from lerobot_vtrefine.tactile.kernels_surface import raise_span

wp.set_module_options({"enable_backward": False})

SEAM = wp.constant(1.0e-5)
"""Share of a triangle's size by which it is widened: closes the seam between neighbours, which rounding would
otherwise leave open."""


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
    stride: int,
    part: int,
    parts: int,
    low: float,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    speed: wp.vec4,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Raise the lattice points under a triangle that faces the pad, corners in the pad's frame, in row `part`
    of every `parts`."""
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
    for row in range(row0 + part, row1, parts):
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
            start = row * stride
            raise_span(share, height, rate, start, begin, end, middle, lattice.pitch, plane, bounds, along)


@wp.func
def raster_cluster(
    lattice: Lattice,
    share: Share,
    stride: int,
    low: float,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    k: int,
    begin: int,
    end: int,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Project those of mesh k's triangles begin..end that face the pad; lanes have one each, or a part of
    its rows."""
    axes = views.axes[env, pad, k]
    origin = views.origin[env, pad, k]
    ez = column(axes, 2)
    for base in range(begin, end, lanes()):
        t = base + share.lane
        faces = False
        if t < end:
            faces = wp.dot(bodies.normals[t], ez) < 0.0
        facing = ballot(faces)
        count = count_bits(facing)
        bits = share_bits(count)
        mine = share.lane >> bits
        if mine < count:
            t = base + nth_bit(facing, mine)
            speed = rate_form(
                COLUMN, bodies.normals[t], axes, views.linear[env, pad, k], views.angular[env, pad, k]
            )
            to_pad = wp.transpose(axes)
            raster_triangle(
                lattice,
                alone(share),
                stride,
                share.lane - (mine << bits),
                1 << bits,
                low,
                to_pad * (bodies.corners[3 * t] - origin),
                to_pad * (bodies.corners[3 * t + 1] - origin),
                to_pad * (bodies.corners[3 * t + 2] - origin),
                speed,
                height,
                rate,
            )


@wp.func
def raster_mesh(
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
    """Project the triangles of mesh k that face the pad onto the lattice."""
    axes = views.axes[env, pad, k]
    origin = views.origin[env, pad, k]
    end = bodies.cluster_range[k][1]
    sync_lanes()
    for base in range(bodies.cluster_range[k][0], end, lanes()):
        c = base + share.lane
        near = False
        if c < end:
            near = in_reach(lattice, low, bodies.cluster_centre[c] - origin, bodies.cluster_half[c], axes)
        waiting = ballot(near)
        while waiting != 0:
            c = base + nth_bit(waiting, 0)
            waiting = drop_bit(waiting)
            first = bodies.cluster_start[c]
            last = bodies.cluster_start[c + 1]
            raster_cluster(lattice, share, stride, low, bodies, views, env, pad, k, first, last, height, rate)
    sync_lanes()
