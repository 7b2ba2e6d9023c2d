"""Exact distance to a triangle mesh by a grid of cells, each listing the triangles that can be nearest there.

`refine` makes the lists, level by level; `query_grid` looks them up. Inside and outside are told by the
angle-weighted normal of the nearest face, edge or corner (Baerentzen and Aanaes 2005), which is exact for
closed meshes.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import (
    Bodies,
    Grid,
    Lattice,
    Views,
    column,
    coordinate,
)
from lerobot_vtrefine.tactile.kernels_lanes import (
    Share,
    lanes,
    make_queue,
    pop_queue,
    push_queue,
    sync_lanes,
)
from lerobot_vtrefine.tactile.kernels_surface import height_at, put_point

wp.set_module_options({"enable_backward": False})

TINY_M = wp.constant(1.0e-6)
"""Closer than this, a surface's own normal stands in for the direction to it."""
PLANE_SLACK = wp.constant(0.99999)
DEEP = wp.constant(-1)
"""Marks cells that lie inside, farther from the surface than anything asks."""


@wp.func
def closest_weights(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Barycentric weights of the point of triangle abc nearest to p; exact zeros on its edges and corners.

    Ericson, Real-Time Collision Detection, 5.1.5.
    """
    ab = b - a
    ac = c - a
    ap = p - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.vec3(1.0, 0.0, 0.0)
    bp = p - b
    d3 = wp.dot(ab, bp)
    d4 = wp.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return wp.vec3(0.0, 1.0, 0.0)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        return wp.vec3(1.0 - v, v, 0.0)
    cp = p - c
    d5 = wp.dot(ab, cp)
    d6 = wp.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return wp.vec3(0.0, 0.0, 1.0)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        return wp.vec3(1.0 - w, 0.0, w)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3(0.0, 1.0 - w, w)
    inverse = 1.0 / (va + vb + vc)
    return wp.vec3(va * inverse, vb * inverse, vc * inverse)


@wp.struct
class Nearest:
    """The point of a mesh nearest to another: its triangle, its weights there, and the vector to it."""

    triangle: int
    weights: wp.vec3
    toward: wp.vec3
    distance: float


@wp.func
def on_triangle(t: int, a: wp.vec3, b: wp.vec3, c: wp.vec3, p: wp.vec3) -> Nearest:
    """The point of triangle t nearest to p."""
    found = Nearest()
    found.triangle = t
    found.weights = closest_weights(p, a, b, c)
    # From p, so that nothing is lost to rounding where the two nearly meet.
    found.toward = found.weights[0] * (a - p) + found.weights[1] * (b - p) + found.weights[2] * (c - p)
    found.distance = wp.length(found.toward)
    return found


@wp.func
def nearest_of(
    corners: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    begin: int,
    end: int,
    items: wp.array(dtype=int),
    p: wp.vec3,
) -> Nearest:
    """The nearest to p of the triangles items[begin:end], of which there must be one."""
    t = items[begin]
    best = on_triangle(t, corners[3 * t], corners[3 * t + 1], corners[3 * t + 2], p)
    for i in range(begin + 1, end):
        t = items[i]
        a = corners[3 * t]
        # The slack spares neighbours in the same plane, which only rounding makes seem nearer.
        if wp.abs(wp.dot(normals[t], a - p)) < PLANE_SLACK * best.distance:
            other = on_triangle(t, a, corners[3 * t + 1], corners[3 * t + 2], p)
            if other.distance < best.distance:
                best = other
    return best


@wp.func
def outward_normal(
    found: Nearest,
    normals: wp.array(dtype=wp.vec3),
    edge_normals: wp.array(dtype=wp.vec3),
    corner_normals: wp.array(dtype=wp.vec3),
) -> wp.vec3:
    """Outward normal of the face, edge or corner that the point lies on (not of unit length)."""
    first = 3 * found.triangle
    for i in range(3):
        if found.weights[i] == 1.0:
            return corner_normals[first + i]
    for i in range(3):
        if found.weights[i] == 0.0:
            return edge_normals[first + i]
    return normals[found.triangle]


@wp.kernel
def refine(
    bodies: Bodies,
    count: wp.vec3i,
    low: wp.vec3,
    size: float,
    reach: float,
    parents: wp.array(dtype=wp.vec2i),
    items: wp.array(dtype=int),
    fill: int,
    cells: wp.array(dtype=wp.vec2i),
    kept: wp.array(dtype=int),
) -> None:
    """Candidates of cells of `size`, eight in each parent, from the parents' candidates.

    The first pass (fill = 0) writes how many each cell keeps, DEEP for those deep inside, as (n, n); the
    second writes them to `kept`, for cells that then hold their ranges.
    """
    tid = wp.tid()
    k = tid % count[2]
    j = tid / count[2] % count[1]
    i = tid / (count[2] * count[1])
    parent = parents[(i / 2 * (count[1] / 2) + j / 2) * (count[2] / 2) + k / 2]
    if parent[1] <= parent[0]:
        if fill == 0:
            cells[tid] = wp.vec2i(wp.min(parent[0], 0), wp.min(parent[0], 0))
        return
    centre = low + size * wp.vec3(float(i) + 0.5, float(j) + 0.5, float(k) + 0.5)
    # Half the diagonal, and a little for rounding.
    radius = 0.8661 * size
    found = nearest_of(bodies.corners, bodies.normals, parent[0], parent[1], items, centre)
    normal = outward_normal(found, bodies.normals, bodies.edge_normals, bodies.corner_normals)
    inside = wp.dot(found.toward, normal) > 0.0
    number = int(0)
    if found.distance <= radius or (inside and found.distance <= reach + radius):
        place = cells[tid][0]
        # The centre's nearest comes first: it leaves little to look at of the others.
        number = int(1)
        if fill == 1:
            kept[place] = found.triangle
        for n in range(parent[0], parent[1]):
            t = items[n]
            if t != found.triangle:
                a = bodies.corners[3 * t]
                other = on_triangle(t, a, bodies.corners[3 * t + 1], bodies.corners[3 * t + 2], centre)
                if other.distance <= found.distance + 2.0 * radius:
                    if fill == 1:
                        kept[place + number] = t
                    number += 1
    elif inside:
        number = DEEP
    if fill == 0:
        cells[tid] = wp.vec2i(number, number)


@wp.func
def cell_of(grid: Grid, cells: wp.array(dtype=wp.vec2i), at: wp.vec3) -> wp.vec2i:
    """Range of the candidates at a point, given in cells from the grid's lowest corner; empty outside of
    it."""
    i = wp.int32(wp.floor(at[0]))
    j = wp.int32(wp.floor(at[1]))
    k = wp.int32(wp.floor(at[2]))
    if i < 0 or j < 0 or k < 0 or i >= grid.count[0] or j >= grid.count[1] or k >= grid.count[2]:
        return wp.vec2i(0, 0)
    # Blocks of 2 x 2 x 2 cells lie together (`mesh_grid.in_blocks`), so that neighbours share a cache line.
    block = ((i >> 1) * (grid.count[1] >> 1) + (j >> 1)) * (grid.count[2] >> 1) + (k >> 1)
    return cells[grid.first + 8 * block + 4 * (i & 1) + 2 * (j & 1) + (k & 1)]


@wp.func
def lever_at(lattice: Lattice, views: Views, env: int, pad: int, k: int, row: int, col: int) -> wp.vec3:
    """From the pad's origin to a lattice point, in primitive k's frame [m]."""
    axes = views.axes[env, pad, k]
    x = coordinate(col, lattice.pitch, lattice.cols)
    y = coordinate(row, lattice.pitch, lattice.rows)
    return x * column(axes, 0) + y * column(axes, 1)


@wp.func
def deepen(
    reach: float,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    k: int,
    index: int,
    lever: wp.vec3,
    cell: wp.vec2i,
    depth: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Raise one point's penetration and rate to those of mesh k, whose candidates there are `cell`."""
    p = views.origin[env, pad, k] + lever
    found = nearest_of(bodies.corners, bodies.normals, cell[0], cell[1], bodies.candidates, p)
    normal = outward_normal(found, bodies.normals, bodies.edge_normals, bodies.corner_normals)
    value = wp.min(found.distance, reach)
    if value > height_at(depth, index) and wp.dot(found.toward, normal) > 0.0:
        if found.distance > TINY_M:
            normal = found.toward
        speed = wp.dot(normal, views.linear[env, pad, k] + wp.cross(views.angular[env, pad, k], lever))
        put_point(depth, rate, index, value, -speed / wp.length(normal))


@wp.func
def query_rows(
    lattice: Lattice,
    stride: int,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    k: int,
    depth: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """`query_grid` by one thread."""
    area = views.window[env, pad, k]
    axes = views.axes[env, pad, k]
    grid = bodies.grids[k]
    ex = column(axes, 0)
    ey = column(axes, 1)
    origin = (views.origin[env, pad, k] - grid.low) * grid.inverse
    for row in range(area[0], area[1]):
        from_middle = coordinate(row, lattice.pitch, lattice.rows) * ey
        start = origin + grid.inverse * from_middle
        for col in range(area[2], area[3]):
            x = coordinate(col, lattice.pitch, lattice.cols)
            cell = cell_of(grid, bodies.cells, start + (x * grid.inverse) * ex)
            index = row * stride + col
            if cell[0] < 0:
                put_point(depth, rate, index, lattice.reach, 0.0)
            elif cell[1] > cell[0]:
                lever = from_middle + x * ex
                deepen(lattice.reach, bodies, views, env, pad, k, index, lever, cell, depth, rate)


@wp.func
def query_queued(
    lattice: Lattice,
    share: Share,
    stride: int,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    k: int,
    depth: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """`query_grid` by many lanes: points near the surface, which take long, wait until there are enough."""
    area = views.window[env, pad, k]
    origin = views.origin[env, pad, k]
    grid = bodies.grids[k]
    width = area[3] - area[2]
    number = width * (area[1] - area[0])
    queue = make_queue()
    queued = int(0)
    base = int(0)
    sync_lanes()
    while base < number or queued > 0:
        if base < number:
            i = base + share.lane
            near = False
            if i < number:
                row = area[0] + i / width
                col = area[2] + i % width
                lever = lever_at(lattice, views, env, pad, k, row, col)
                cell = cell_of(grid, bodies.cells, (origin + lever - grid.low) * grid.inverse)
                near = cell[1] > cell[0]
                if cell[0] < 0:
                    put_point(depth, rate, row * stride + col, lattice.reach, 0.0)
            queued = push_queue(queue, queued, share.lane, near, i)
            base += lanes()
        if queued >= lanes() or base >= number:
            if share.lane < queued:
                i = queue[share.lane]
                row = area[0] + i / width
                col = area[2] + i % width
                lever = lever_at(lattice, views, env, pad, k, row, col)
                cell = cell_of(grid, bodies.cells, (origin + lever - grid.low) * grid.inverse)
                deepen(
                    lattice.reach, bodies, views, env, pad, k, row * stride + col, lever, cell, depth, rate
                )
            queued = pop_queue(queue, queued, share.lane)
    sync_lanes()


@wp.func
def query_grid(
    lattice: Lattice,
    share: Share,
    stride: int,
    bodies: Bodies,
    views: Views,
    env: int,
    pad: int,
    k: int,
    depth: wp.array(dtype=float),
    rate: wp.array(dtype=float),
) -> None:
    """Raise penetrations and rates to those of mesh k; deeper than the reach counts as the reach, at rest."""
    if lanes() == 1:
        query_rows(lattice, stride, bodies, views, env, pad, k, depth, rate)
    else:
        query_queued(lattice, share, stride, bodies, views, env, pad, k, depth, rate)
