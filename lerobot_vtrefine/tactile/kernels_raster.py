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
    make_queue,
    nth_bit,
    pop_queue,
    push_queue,
    share_bits,
    sync_lanes,
)
from lerobot_vtrefine.tactile.kernels_surface import raise_span
from lerobot_vtrefine.tactile.packing import TRIANGLES_PER_CLUSTER

wp.set_module_options({"enable_backward": False})

CLUSTER = wp.constant(TRIANGLES_PER_CLUSTER)
"""Triangles of a cluster, at most half of a warp's lanes."""
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
def edge_bounds(bounds: wp.vec2, at_zero: float, inverse: float) -> wp.vec2:
    """The part of [bounds[0], bounds[1]] in which at_zero + x / inverse >= -SEAM, or (inverse = 0) at_zero
    is; empty as (FAR_M, -FAR_M)."""
    x = (-SEAM - at_zero) * inverse
    if inverse > 0.0:
        return wp.vec2(wp.max(bounds[0], x), bounds[1])
    if inverse < 0.0:
        return wp.vec2(bounds[0], wp.min(bounds[1], x))
    if at_zero < -SEAM:
        return wp.vec2(FAR_M, -FAR_M)
    return bounds


@wp.func
def inverse_slope(slope: float) -> float:
    """1 / slope, 0 where that is out of all proportion."""
    if wp.abs(slope) < 1.0e-9:
        return 0.0
    return 1.0 / slope


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
    inverse_a = inverse_slope(wa[0])
    inverse_b = inverse_slope(wb[0])
    inverse_c = inverse_slope(-wa[0] - wb[0])
    middle = 0.5 * float(lattice.cols - 1)
    highest = wp.max(a[2], wp.max(b[2], c[2]))
    bounds = wp.vec4(-low, -highest, -lowest, lattice.reach)
    for row in range(row0 + part, row1, parts):
        y = coordinate(row, lattice.pitch, lattice.rows)
        at_a = -wa[0] * c[0] + wa[1] * (y - c[1])
        at_b = -wb[0] * c[0] + wb[1] * (y - c[1])
        inside = edge_bounds(wp.vec2(-FAR_M, FAR_M), at_a, inverse_a)
        inside = edge_bounds(inside, at_b, inverse_b)
        inside = edge_bounds(inside, 1.0 - at_a - at_b, inverse_c)
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
def raster_one(
    lattice: Lattice,
    share: Share,
    stride: int,
    low: float,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    k: int,
    t: int,
    part: int,
    parts: int,
    height: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Project triangle t of mesh k, which faces the pad, in row `part` of every `parts`."""
    axes = views.axes[env, pad, k]
    origin = views.origin[env, pad, k]
    to_pad = wp.transpose(axes)
    a = to_pad * (bodies.corners[3 * t] - origin)
    b = to_pad * (bodies.corners[3 * t + 1] - origin)
    c = to_pad * (bodies.corners[3 * t + 2] - origin)
    speed = rate_form(COLUMN, bodies.normals[t], axes, views.linear[env, pad, k], views.angular[env, pad, k])
    raster_triangle(lattice, share, stride, part, parts, low, a, b, c, speed, height, rate)


@wp.func
def stands_there(
    lattice: Lattice, low: float, bodies: Bodies, t: int, origin: wp.vec3, axes: wp.mat33
) -> bool:
    """Whether triangle t faces the pad and may stand over a point of its lattice."""
    if wp.dot(bodies.normals[t], column(axes, 2)) >= 0.0:
        return False
    to_pad = wp.transpose(axes)
    a = to_pad * (bodies.corners[3 * t] - origin)
    b = to_pad * (bodies.corners[3 * t + 1] - origin)
    c = to_pad * (bodies.corners[3 * t + 2] - origin)
    least = wp.min(a, wp.min(b, c))
    most = wp.max(a, wp.max(b, c))
    if least[2] > low or most[2] < -lattice.reach:
        return False
    if first_index(least[0], lattice.pitch, lattice.cols) >= end_index(most[0], lattice.pitch, lattice.cols):
        return False
    return first_index(least[1], lattice.pitch, lattice.rows) < end_index(
        most[1], lattice.pitch, lattice.rows
    )


@wp.func
def candidate(
    lattice: Lattice,
    lane: int,
    low: float,
    bodies: Bodies,
    first: int,
    waiting: int,
    origin: wp.vec3,
    axes: wp.mat33,
) -> int:
    """A lane's triangle of the first two waiting clusters, of which half of the lanes have one each; -1 where
    it is not over the pad."""
    half = lane / CLUSTER
    if half >= count_bits(waiting):
        return -1
    c = first + nth_bit(waiting, half)
    t = bodies.cluster_start[c] + lane % CLUSTER
    if t >= bodies.cluster_start[c + 1]:
        return -1
    if not stands_there(lattice, low, bodies, t, origin, axes):
        return -1
    return t


@wp.func
def raster_in_turn(
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
    """`raster_mesh` by one thread."""
    axes = views.axes[env, pad, k]
    origin = views.origin[env, pad, k]
    ez = column(axes, 2)
    for c in range(bodies.cluster_range[k][0], bodies.cluster_range[k][1]):
        if in_reach(lattice, low, bodies.cluster_centre[c] - origin, bodies.cluster_half[c], axes):
            for t in range(bodies.cluster_start[c], bodies.cluster_start[c + 1]):
                if wp.dot(bodies.normals[t], ez) < 0.0:
                    raster_one(lattice, share, stride, low, bodies, views, env, pad, k, t, 0, 1, height, rate)


@wp.func
def raster_queued(
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
    """`raster_mesh` by many lanes: triangles wait until each lane has one; the last are shared by rows."""
    axes = views.axes[env, pad, k]
    origin = views.origin[env, pad, k]
    end = bodies.cluster_range[k][1]
    base = bodies.cluster_range[k][0]
    queue = make_queue()
    queued = int(0)
    waiting = int(0)
    first = base
    sync_lanes()
    while base < end or waiting != 0 or queued > 0:
        if waiting == 0 and base < end:
            c = base + share.lane
            near = False
            if c < end:
                near = in_reach(lattice, low, bodies.cluster_centre[c] - origin, bodies.cluster_half[c], axes)
            waiting = ballot(near)
            first = base
            base += lanes()
        if waiting != 0:
            t = candidate(lattice, share.lane, low, bodies, first, waiting, origin, axes)
            queued = push_queue(queue, queued, share.lane, t >= 0, t)
            waiting = drop_bit(drop_bit(waiting))
        if queued >= lanes() or (base >= end and waiting == 0):
            bits = share_bits(wp.clamp(queued, 1, lanes()))
            mine = share.lane >> bits
            if mine < queued:
                part = share.lane - (mine << bits)
                t = queue[mine]
                one = alone(share)
                raster_one(
                    lattice, one, stride, low, bodies, views, env, pad, k, t, part, 1 << bits, height, rate
                )
            queued = pop_queue(queue, queued, share.lane)
    sync_lanes()


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
    if lanes() == 1:
        raster_in_turn(lattice, share, stride, low, bodies, views, env, pad, k, height, rate)
    else:
        raster_queued(lattice, share, stride, low, bodies, views, env, pad, k, height, rate)
