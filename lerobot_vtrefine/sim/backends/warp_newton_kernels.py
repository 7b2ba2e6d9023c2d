"""Newton's method for the constraint forces, all of it in one kernel. Imports warp and mujoco_warp.

One block of threads per world, from the warm start to the solution: worlds that need many steps do not keep
the others waiting, and nothing waits for launches. Steps, line search and the criteria for stopping are those
of `mujoco_warp.solve` for elliptic cones and a dense Jacobian.

Everything is a plain loop, called from one place: functions that are called twice, and the Cholesky
decomposition of tiles, are unrolled and inlined to twice the machine code, which spills registers. What a
block's threads wait for again and again, the matrix that is eliminated, lies in its own memory.

Shape legend: N worlds, nv velocities, G groups of threads that each take a part of the rows.
"""

import functools

import warp as wp

from lerobot_vtrefine.sim.backends.warp_block_kernels import make_aim, total, wait
from lerobot_vtrefine.sim.backends.warp_rows_kernels import (
    Cones,
    Rows,
    along_line,
    bent,
    is_lone,
    lay,
    push,
)

wp.set_module_options({"enable_backward": False})

ROUNDING = wp.constant(9.5e-7)
"""Sums of a hundred float32 are off by about so much of what they are made of."""
REGISTERS = 128
"""Of a thread on a GPU: eight blocks then run beside each other on a multiprocessor."""
LEAST_SLOPE = wp.constant(1.0e-6)
MIN_TRACE = wp.constant(1.0e-15)


@wp.struct
class Inertia:
    """Mass matrices (N, entries), as mujoco_warp keeps them, and where each entry belongs."""

    values: wp.array(dtype=float, ndim=2)
    row: wp.array(dtype=int)
    col: wp.array(dtype=int)
    first: wp.array(dtype=int)
    """(nv + 1,) where each row's products with a vector begin, in `other` and `entry`."""
    other: wp.array(dtype=int)
    entry: wp.array(dtype=int)


@wp.struct
class Motion:
    """Per world and velocity (N, nv): accelerations and generalised forces."""

    start: wp.array(dtype=float, ndim=2)
    qacc: wp.array(dtype=float, ndim=2)
    inertial: wp.array(dtype=float, ndim=2)
    """M qacc."""
    smooth: wp.array(dtype=float, ndim=2)
    constraint: wp.array(dtype=float, ndim=2)


@wp.struct
class Search:
    """The solver's own memory: gradient, direction and M direction (N, nv), partial sums (N, G, nv) of the
    constraint forces and (N, G, nv, nv) of the Hessian, and the rows that this is the square of.
    """

    gradient: wp.array(dtype=float, ndim=2)
    direction: wp.array(dtype=float, ndim=2)
    pushed: wp.array(dtype=float, ndim=2)
    force: wp.array(dtype=float, ndim=3)
    hessian: wp.array(dtype=float, ndim=4)
    bent: wp.array(dtype=wp.vec4, ndim=3)


@wp.struct
class Limits:
    """When to stop, and (N,) how many steps it took."""

    tolerance: wp.array(dtype=float)
    line_tolerance: wp.array(dtype=float)
    steps: int
    line_steps: int
    count: wp.array(dtype=int)


@wp.func
def product(world: int, dof: int, vector: wp.array(dtype=float, ndim=2), inertia: Inertia) -> float:
    """One element of M times a vector."""
    result = float(0.0)
    for index in range(inertia.first[dof], inertia.first[dof + 1]):
        result += inertia.values[world, inertia.entry[index]] * vector[world, inertia.other[index]]
    return result


@wp.func
def moved(world: int, row: int, vector: wp.array(dtype=float, ndim=2), rows: Rows) -> float:
    """One element of the Jacobian times a vector."""
    result = float(0.0)
    last = vector.shape[1] - 1  # the Jacobian is zero beyond
    for quad in range(rows.quads.shape[2]):
        four = rows.quads[world, row, quad]
        first = 4 * quad
        result += four[0] * vector[world, wp.min(first, last)]
        result += four[1] * vector[world, wp.min(first + 1, last)]
        result += four[2] * vector[world, wp.min(first + 2, last)]
        result += four[3] * vector[world, wp.min(first + 3, last)]
    return result


@wp.func
def begin(
    world: int, lane: int, count: int, motion: Motion, rows: Rows, cones: Cones, inertia: Inertia
) -> float:
    """Accelerations of the last step and their residuals; returns the scale of the criteria, 1 / trace M."""
    lanes = wp.block_dim()
    if lane == 0:
        rows.lones[world] = 0
    wait()
    nv = motion.qacc.shape[1]
    for dof in range(lane, nv, lanes):
        motion.qacc[world, dof] = motion.start[world, dof]
        motion.inertial[world, dof] = product(world, dof, motion.start, inertia)
    for row in range(lane, count, lanes):
        rows.residual[world, row] = moved(world, row, motion.start, rows) - rows.target[world, row]
        if is_lone(world, row, rows, cones):
            rows.lone[world, wp.atomic_add(rows.lones, world, 1)] = row
    trace = float(0.0)
    for entry in range(lane, inertia.row.shape[0], lanes):
        if inertia.row[entry] == inertia.col[entry]:
            trace += inertia.values[world, entry]
    return 1.0 / wp.max(MIN_TRACE, total(wp.vec4(trace, 0.0, 0.0, 0.0))[0])


@wp.func
def slopes(world: int, lane: int, count: int, motion: Motion, search: Search, rows: Rows) -> wp.vec2:
    """How residuals change along the direction; returns first and second derivative of the smooth cost."""
    lanes = wp.block_dim()
    for row in range(lane, count, lanes):
        rows.slope[world, row] = moved(world, row, search.direction, rows)
    sums = wp.vec4(0.0)
    for dof in range(lane, motion.qacc.shape[1], lanes):
        along = search.direction[world, dof]
        unbalanced = motion.inertial[world, dof] - motion.smooth[world, dof]
        sums += wp.vec4(along * unbalanced, along * search.pushed[world, dof], 0.0, 0.0)
    sums = total(sums)
    return wp.vec2(sums[0], sums[1])


@wp.func
def cost(world: int, lane: int, step: float, smooth: wp.vec2, rows: Rows) -> wp.vec4:
    """Cost after a step along the direction: its change, two derivatives, and what the first is a sum of."""
    sums = wp.vec4(0.0)
    for index in range(lane, rows.lones[world], wp.block_dim()):
        mine = along_line(world, index, step, rows)
        sums += wp.vec4(mine[0], mine[1], mine[2], wp.abs(mine[1]))
    rate = smooth[0] + step * smooth[1]
    whole = wp.vec4(step * (smooth[0] + 0.5 * step * smooth[1]), rate, smooth[1], wp.abs(smooth[0]))
    return total(sums) + whole


@wp.func
def line_search(
    world: int, lane: int, flat: float, most: int, smooth: wp.vec2, rows: Rows, cones: Cones
) -> wp.vec2:
    """Where the slope is below `flat`, by Newton's method within a bracket; returns the step and its gain,
    zeros where there is nothing to gain.
    """
    for index in range(lane, rows.lones[world], wp.block_dim()):
        lay(world, index, rows, cones)  # the same thread reads it
    best = wp.vec2(0.0, 0.0)
    least = float(0.0)
    low = float(0.0)
    high = float(-1.0)
    step = float(0.0)
    for index in range(most + 1):
        point = cost(world, lane, step, smooth, rows)
        if index == 0:
            least = ROUNDING * point[3]
        if point[0] < -best[1]:
            best = wp.vec2(step, -point[0])
        if wp.abs(point[1]) < least:
            break
        least = wp.max(least, flat)
        if point[1] < 0.0:
            low = step
        else:
            high = step
        after = step - point[1] / wp.max(point[2], MIN_TRACE)
        if high > 0.0 and (after <= low or after >= high or index % 4 == 0):
            after = 0.5 * (low + high)
        if after == step:
            break
        step = after
    return best


@wp.func
def take(world: int, lane: int, count: int, step: float, motion: Motion, search: Search, rows: Rows) -> None:
    """Go so far along the direction."""
    lanes = wp.block_dim()
    for dof in range(lane, motion.qacc.shape[1], lanes):
        motion.qacc[world, dof] += step * search.direction[world, dof]
        motion.inertial[world, dof] += step * search.pushed[world, dof]
    for row in range(lane, count, lanes):
        rows.residual[world, row] += step * rows.slope[world, row]


@wp.func
def descend(
    world: int, lane: int, count: int, motion: Motion, search: Search, rows: Rows, cones: Cones
) -> float:
    """Forces of all rows, and the gradient; returns its squared length."""
    lanes = wp.block_dim()
    nv = motion.qacc.shape[1]
    groups = search.force.shape[1]
    for index in range(lane, rows.lones[world], lanes):
        push(world, rows.lone[world, index], rows, cones)
    wait()
    for item in range(lane, groups * nv, lanes):
        group = item // nv
        dof = item % nv
        part = float(0.0)
        fours = (count - group + groups - 1) // (4 * groups)
        for four in range(fours):
            for k in range(4):
                row = group + (4 * four + k) * groups
                part += rows.jacobian[world, row, dof] * rows.force[world, row]
        for row in range(group + 4 * groups * fours, count, groups):
            part += rows.jacobian[world, row, dof] * rows.force[world, row]
        search.force[world, group, dof] = part
    wait()
    square = float(0.0)
    for dof in range(lane, nv, lanes):
        force = float(0.0)
        for group in range(groups):
            force += search.force[world, group, dof]
        motion.constraint[world, dof] = force
        slope = motion.inertial[world, dof] - motion.smooth[world, dof] - force
        search.gradient[world, dof] = slope
        square += slope * slope
    return total(wp.vec4(square, 0.0, 0.0, 0.0))[0]


@wp.func
def bend(
    world: int, lane: int, count: int, search: Search, rows: Rows, cones: Cones, inertia: Inertia
) -> None:
    """The Hessian's upper triangle, as G matrices that add up to it.

    First what each row adds, then sums without a branch, four at a time: their loads need not wait for each
    other.
    """
    lanes = wp.block_dim()
    groups = search.hessian.shape[1]
    nv = search.hessian.shape[2]
    quads = rows.quads.shape[2]
    for item in range(lane, count * quads, lanes):
        row = item // quads
        search.bent[world, row, item % quads] = bent(world, row, item % quads, rows, cones)
    wait()
    side = (nv + 3) // 4
    per_group = side * (side + 1) // 2
    for item in range(lane, groups * per_group, lanes):
        group = item // per_group
        column = int(0)
        rest = item % per_group
        while rest > column:
            column += 1
            rest -= column
        sums = wp.mat44(0.0)
        fours = (count - group + groups - 1) // (4 * groups)
        for four in range(fours):
            for k in range(4):
                row = group + (4 * four + k) * groups
                sums += wp.outer(search.bent[world, row, rest], search.bent[world, row, column])
        for row in range(group + 4 * groups * fours, count, groups):
            sums += wp.outer(search.bent[world, row, rest], search.bent[world, row, column])
        i = 4 * rest
        j = 4 * column
        for a in range(4):
            for b in range(4):
                if i + a < nv and j + b < nv:
                    search.hessian[world, group, i + a, j + b] = sums[a, b]
    wait()
    for entry in range(lane, inertia.row.shape[0], lanes):
        search.hessian[world, 0, inertia.col[entry], inertia.row[entry]] += inertia.values[world, entry]
    wait()


def patches(nv: int) -> int:
    """Four by four pieces of a Hessian's upper triangle, each of which one thread sums."""
    side = (nv + 3) // 4
    return side * (side + 1) // 2


@functools.cache
def newton_kernel(nv: int) -> wp.Kernel:
    """The kernel for so many velocities; a block of threads per world."""
    aim = make_aim(nv)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, cuda_max_registers=REGISTERS)
    def newton(
        limits: Limits, motion: Motion, search: Search, rows: Rows, cones: Cones, inertia: Inertia
    ) -> None:
        """All steps; a block of threads per world."""
        world, lane = wp.tid()
        count = wp.min(rows.count[world], rows.residual.shape[1])
        enough = limits.tolerance[world % limits.tolerance.shape[0]]
        line = enough * limits.line_tolerance[world % limits.line_tolerance.shape[0]]
        scale = begin(world, lane, count, motion, rows, cones, inertia)
        done = bool(False)
        length = float(0.0)
        steps = int(0)
        for index in range(limits.steps + 1):
            wait()
            gained = wp.vec2(0.0)
            if index > 0:
                smooth = slopes(world, lane, count, motion, search, rows)
                wait()
                flat = wp.max(line * length / scale, LEAST_SLOPE)
                gained = line_search(world, lane, flat, limits.line_steps, smooth, rows, cones)
                take(world, lane, count, gained[0], motion, search, rows)
                steps = index
                wait()
            square = descend(world, lane, count, motion, search, rows, cones)
            if index > 0:
                gain = scale * gained[1]
                done = gained[0] == 0.0 or (gain > 0.0 and gain < enough) or scale * wp.sqrt(square) < enough
            if done or index == limits.steps:
                break
            bend(world, lane, count, search, rows, cones, inertia)
            aimed = aim(search.hessian[world], search.gradient[world], search.direction[world])
            length = wp.sqrt(aimed[0])
            if index > 0 and scale * 0.5 * aimed[1] < enough:
                break
            for dof in range(lane, motion.qacc.shape[1], wp.block_dim()):
                search.pushed[world, dof] = product(world, dof, search.direction, inertia)
        if lane == 0:
            limits.count[world] = steps

    return newton
