"""Warp kernel of the load-consistent elastic foundation (Winkler): heights and load in, taxel forces out.

Each pad is one thread on CPU and one warp of 32 lanes on CUDA, which share out its columns. Its face gives
way by u = max(0, z + delta + a x + b y) at every lattice point, where z is the column height plus the viscous
lead tau * rate and (x, y) the centre of the point's taxel, in taxel pitches. The three unknowns are solved so
that the forces k u add up to the load and balance at its centre: the minimum of a convex, piecewise quadratic
function, found by Newton's method.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import coordinate, ivec4

wp.set_module_options({"enable_backward": False})

MAX_TILT = wp.constant(1.0)
"""Limit of the two slopes; only reached when the load's centre lies outside what the body can press on."""
NEWTON_STEPS = wp.constant(14)
MAX_LEAD_M = wp.constant(0.05)
NEAR = wp.constant(1.0e-2)
"""How close to the load the search for the offset comes before Newton's method takes over."""
TOLERANCE = wp.constant(2.0e-6)

vec6 = wp.types.vector(length=6, dtype=wp.float32)
mat33d = wp.types.matrix(shape=(3, 3), dtype=wp.float64)


@wp.struct
class Pad:
    """One pad's lattice, rows and columns `area` of which may be in contact."""

    rows: int
    cols: int
    subdivision: int
    damping_s: float
    area: ivec4
    lane: int
    lanes: int


@wp.struct
class Balance:
    """Sums over the points in contact for one trial of (delta, a, b)."""

    squares: wp.float64
    sums: wp.vec3d
    hessian: mat33d


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int step = 16; step > 0; step >>= 1) x += __shfl_xor_sync(0xffffffffu, x, step);
#endif
return x;
""")
def add_lanes(x: wp.float64) -> wp.float64:
    """Sum over the lanes of a pad, the same bits in each."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int step = 16; step > 0; step >>= 1) x = fmaxf(x, __shfl_xor_sync(0xffffffffu, x, step));
#endif
return x;
""")
def max_lanes(x: wp.float32) -> wp.float32:
    """Maximum over the lanes of a pad."""
    ...


@wp.func
def first_column(pad: Pad) -> int:
    """First of the taxel columns that this lane sums; the others follow at steps of `lanes`."""
    return pad.area[2] / pad.subdivision + pad.lane


@wp.func
def row_sums(
    pad: Pad, stride: int, row: int, base: float, a: float, taxel_cols: int, height: wp.array(dtype=float)
) -> vec6:
    """(n, x, x^2, u, u x, u^2) summed over one row's points in contact.

    In single precision, while rows are added in double: fast, and exact enough for 1e-6 of the load.
    """
    n = float(0.0)
    sx = float(0.0)
    sxx = float(0.0)
    su = float(0.0)
    sux = float(0.0)
    suu = float(0.0)
    half = 0.5 * float(taxel_cols - 1)
    for col in range(first_column(pad), pad.area[3] / pad.subdivision, pad.lanes):
        x = float(col) - half
        offset = base + a * x
        start = row * pad.cols + col * pad.subdivision
        u = wp.max(height[start] + offset, 0.0)
        count = wp.where(u > 0.0, 1.0, 0.0)
        squares = u * u
        # A taxel's points are summed first: shorter chains of dependent additions.
        for index in range(start + stride, start + pad.subdivision, stride):
            other = wp.max(height[index] + offset, 0.0)
            count += wp.where(other > 0.0, 1.0, 0.0)
            u += other
            squares += other * other
        n += count
        sx += count * x
        sxx += count * x * x
        su += u
        sux += u * x
        suu += squares
    return vec6(n, sx, sxx, su, sux, suu)


@wp.func
def balance(pad: Pad, stride: int, height: wp.array(dtype=float), trial: wp.vec3d) -> Balance:
    """Sums of u (1, x, y) and (1, x, y)^T (1, x, y) over every `stride`-th row and column."""
    n = wp.float64(0.0)
    sx = wp.float64(0.0)
    sy = wp.float64(0.0)
    sxx = wp.float64(0.0)
    sxy = wp.float64(0.0)
    syy = wp.float64(0.0)
    su = wp.float64(0.0)
    sux = wp.float64(0.0)
    suy = wp.float64(0.0)
    suu = wp.float64(0.0)
    taxel_rows = pad.rows / pad.subdivision
    taxel_cols = pad.cols / pad.subdivision
    a = wp.float32(trial[1])
    for row in range(pad.area[0], pad.area[1], stride):
        y = coordinate(row / pad.subdivision, 1.0, taxel_rows)
        base = wp.float32(trial[0] + trial[2] * wp.float64(y))
        sums = row_sums(pad, stride, row, base, a, taxel_cols, height)
        if sums[0] > 0.0:
            yd = wp.float64(y)
            nd = wp.float64(sums[0])
            xd = wp.float64(sums[1])
            ud = wp.float64(sums[3])
            n += nd
            sx += xd
            sy += nd * yd
            sxx += wp.float64(sums[2])
            sxy += xd * yd
            syy += nd * yd * yd
            su += ud
            sux += wp.float64(sums[4])
            suy += ud * yd
            suu += wp.float64(sums[5])
    result = Balance()
    result.squares = add_lanes(suu)
    result.sums = wp.vec3d(add_lanes(su), add_lanes(sux), add_lanes(suy))
    n = add_lanes(n)
    sx = add_lanes(sx)
    sy = add_lanes(sy)
    sxy = add_lanes(sxy)
    result.hessian = mat33d(n, sx, sy, sx, add_lanes(sxx), sxy, sy, sxy, add_lanes(syy))
    return result


@wp.func
def offset_for_sum(
    pad: Pad,
    stride: int,
    height: wp.array(dtype=float),
    tilted: wp.vec3d,
    total: wp.float64,
) -> wp.vec3d:
    """(delta, a, b) with the tilts of `tilted` and delta such that the u add up to about `total`.

    Newton from the side where more points are in contact descends monotonically and ends after finitely many
    steps; its first step leads to that side from anywhere.
    """
    trial = tilted
    for _step in range(32):
        here = balance(pad, stride, height, trial)
        if here.hessian[0, 0] < wp.float64(1.0):
            trial[0] = trial[0] + wp.float64(1.0e-3)
        else:
            change = (total - here.sums[0]) / here.hessian[0, 0]
            trial[0] = trial[0] + change
            if wp.abs(change) * here.hessian[0, 0] <= wp.float64(NEAR) * total:
                break
    return trial


@wp.func
def newton_step(h: mat33d, g: wp.vec3d) -> wp.vec3d:
    """-(h + small diagonal)^-1 g by Cholesky; the diagonal keeps points on one line, or one point,
    solvable."""
    small = wp.float64(1.0e-9)
    l00 = wp.sqrt(h[0, 0] + wp.float64(1.0e-30))
    l10 = h[1, 0] / l00
    l20 = h[2, 0] / l00
    l11 = wp.sqrt(wp.max(h[1, 1] - l10 * l10, small * (h[1, 1] + h[0, 0])))
    l21 = (h[2, 1] - l20 * l10) / l11
    l22 = wp.sqrt(wp.max(h[2, 2] - l20 * l20 - l21 * l21, small * (h[2, 2] + h[0, 0])))
    y0 = -g[0] / l00
    y1 = (-g[1] - l10 * y0) / l11
    y2 = (-g[2] - l20 * y0 - l21 * y1) / l22
    x2 = y2 / l22
    x1 = (y1 - l21 * x2) / l11
    x0 = (y0 - l10 * x1 - l20 * x2) / l00
    return wp.vec3d(x0, x1, x2)


@wp.func
def limited(trial: wp.vec3d, limit: wp.float64) -> wp.vec3d:
    """The trial with both tilts within +-limit."""
    return wp.vec3d(trial[0], wp.clamp(trial[1], -limit, limit), wp.clamp(trial[2], -limit, limit))


@wp.func
def solve_balance(
    pad: Pad,
    stride: int,
    height: wp.array(dtype=float),
    start: wp.vec3d,
    target: wp.vec3d,
    limit: wp.float64,
) -> wp.vec3d:
    """(delta, a, b) whose sums meet the target; damped Newton steps on the convex merit sum u^2 / 2 - target
    . trial."""
    trial = start
    here = balance(pad, stride, height, trial)
    if here.sums[0] < wp.float64(0.1) * target[0]:
        # Too little in contact for a first step that means something.
        trial = offset_for_sum(pad, stride, height, trial, target[0])
        here = balance(pad, stride, height, trial)
    for _ in range(NEWTON_STEPS):
        g = here.sums - target
        worst = wp.max(wp.abs(g[0]), wp.max(wp.abs(g[1]), wp.abs(g[2])))
        if worst <= wp.float64(TOLERANCE) * target[0]:
            break
        step = newton_step(here.hessian, g)
        merit = wp.float64(0.5) * here.squares - wp.dot(target, trial)
        scale = wp.float64(1.0)
        accepted = int(0)
        for _halving in range(8):
            if accepted == 0:
                candidate = limited(trial + scale * step, limit)
                there = balance(pad, stride, height, candidate)
                gain = wp.float64(0.5) * there.squares - wp.dot(target, candidate) - merit
                if gain <= wp.float64(1.0e-4) * wp.min(wp.dot(g, candidate - trial), wp.float64(0.0)):
                    trial = candidate
                    here = there
                    accepted = 1
                scale = scale * wp.float64(0.5)
        if accepted == 0:
            break
    if here.sums[0] < wp.float64(0.9) * target[0]:
        trial = offset_for_sum(pad, stride, height, trial, target[0])
    return trial


@wp.func
def spread_load(rows: int, cols: int, pitch: float, load: wp.vec3, force: wp.array(dtype=float)) -> None:
    """Where no body stands over the lattice, share the load among the four taxels next to its centre."""
    x = wp.clamp(load[1] / pitch + 0.5 * float(cols - 1), 0.0, float(cols - 1))
    y = wp.clamp(load[2] / pitch + 0.5 * float(rows - 1), 0.0, float(rows - 1))
    col = wp.min(wp.int32(x), wp.max(cols - 2, 0))
    row = wp.min(wp.int32(y), wp.max(rows - 2, 0))
    wx = x - float(col)
    wy = y - float(row)
    next_col = wp.min(col + 1, cols - 1)
    next_row = wp.min(row + 1, rows - 1)
    force[row * cols + col] += load[0] * (1.0 - wx) * (1.0 - wy)
    force[row * cols + next_col] += load[0] * wx * (1.0 - wy)
    force[next_row * cols + col] += load[0] * (1.0 - wx) * wy
    force[next_row * cols + next_col] += load[0] * wx * wy


@wp.func
def write_forces(
    pad: Pad,
    stiffness: float,
    height: wp.array(dtype=float),
    answer: wp.vec3d,
    total: wp.float64,
    force: wp.array(dtype=float),
) -> None:
    """Forces of a solution, scaled by what was left between their sum and the load."""
    rows = pad.rows / pad.subdivision
    cols = pad.cols / pad.subdivision
    a = wp.float32(answer[1])
    whole = wp.float64(0.0)
    for row in range(pad.area[0] / pad.subdivision, pad.area[1] / pad.subdivision):
        base = wp.float32(answer[0] + answer[2] * wp.float64(coordinate(row, 1.0, rows)))
        row_sum = float(0.0)
        for col in range(first_column(pad), pad.area[3] / pad.subdivision, pad.lanes):
            offset = base + a * coordinate(col, 1.0, cols)
            taxel_sum = float(0.0)
            for line in range(pad.subdivision):
                start = (row * pad.subdivision + line) * pad.cols + col * pad.subdivision
                for index in range(start, start + pad.subdivision):
                    taxel_sum += wp.max(height[index] + offset, 0.0)
            force[row * cols + col] = stiffness * taxel_sum
            row_sum += taxel_sum
        whole += wp.float64(row_sum)
    factor = wp.float32(total / add_lanes(whole))
    for row in range(pad.area[0] / pad.subdivision, pad.area[1] / pad.subdivision):
        for col in range(first_column(pad), pad.area[3] / pad.subdivision, pad.lanes):
            force[row * cols + col] *= factor


@wp.func
def contact_area(rows: int, cols: int, subdivision: int, window: wp.array(dtype=ivec4)) -> ivec4:
    """Smallest block of whole taxels that holds all primitives' areas; empty (begin >= end) without any."""
    area = ivec4(rows, 0, cols, 0)
    for k in range(window.shape[0]):
        other = window[k]
        if other[0] < other[1]:
            area = ivec4(
                wp.min(area[0], other[0]),
                wp.max(area[1], other[1]),
                wp.min(area[2], other[2]),
                wp.max(area[3], other[3]),
            )
    return ivec4(
        area[0] / subdivision * subdivision,
        (area[1] + subdivision - 1) / subdivision * subdivision,
        area[2] / subdivision * subdivision,
        (area[3] + subdivision - 1) / subdivision * subdivision,
    )


@wp.func
def add_lead(pad: Pad, depth: wp.array(dtype=float), rate: wp.array(dtype=float)) -> float:
    """Put height plus viscous lead in place of the rates; returns the largest, -1 m without a body."""
    best = float(-1.0)
    for row in range(pad.area[0], pad.area[1]):
        for col in range(first_column(pad), pad.area[3] / pad.subdivision, pad.lanes):
            start = row * pad.cols + col * pad.subdivision
            for index in range(start, start + pad.subdivision):
                height = depth[index]
                if height > -0.5:
                    height += wp.clamp(pad.damping_s * rate[index], -MAX_LEAD_M, MAX_LEAD_M)
                rate[index] = height
                best = wp.max(best, height)
    return max_lanes(best)


@wp.kernel
def solve_foundation(
    pad_rows: int,
    pad_cols: int,
    subdivision: int,
    lanes: int,
    pitch: float,
    stiffness: wp.array(dtype=float),
    damping_s: wp.array(dtype=float),
    load: wp.array(dtype=wp.vec3, ndim=2),
    window: wp.array(dtype=ivec4, ndim=3),
    depth: wp.array(dtype=float, ndim=3),
    rate: wp.array(dtype=float, ndim=3),
    force: wp.array(dtype=float, ndim=3),
    solution: wp.array(dtype=wp.vec3, ndim=2),
) -> None:
    """Forces [N] on pad_rows x pad_cols taxels from heights on the lattice that is finer by `subdivision`.

    Per environment: `stiffness` of one lattice point [N/m] and `damping_s`. `window` holds the lattice areas
    of the primitives in reach; `rate` is overwritten; `force` and `solution`, which gets (delta [m], slope x,
    slope y), must come in as zero.
    """
    env, side, lane = wp.tid()
    push = load[env, side]
    if push[0] <= 0.0:
        return
    pad = Pad()
    pad.rows = pad_rows * subdivision
    pad.cols = pad_cols * subdivision
    pad.subdivision = subdivision
    pad.damping_s = damping_s[env]
    pad.lane = lane
    pad.lanes = lanes
    pad.area = contact_area(pad.rows, pad.cols, subdivision, window[env, side])
    heights = rate[env, side]
    top = add_lead(pad, depth[env, side], heights)
    if top <= -0.5:
        if lane == 0:
            spread_load(pad_rows, pad_cols, pitch, push, force[env, side])
        return
    total = wp.float64(push[0]) / wp.float64(stiffness[env])
    scale = wp.float64(1.0) / wp.float64(pitch)
    target = wp.vec3d(total, total * wp.float64(push[1]) * scale, total * wp.float64(push[2]) * scale)
    limit = wp.float64(MAX_TILT * pitch)
    answer = wp.vec3d(wp.float64(1.0e-3 - top), wp.float64(0.0), wp.float64(0.0))
    if subdivision > 1:
        # Every taxel's first point alone leads close to the answer at a fraction of the cost.
        share = wp.float64(1.0) / wp.float64(subdivision * subdivision)
        answer = offset_for_sum(pad, subdivision, heights, answer, total * share)
        answer = solve_balance(pad, subdivision, heights, answer, target * share, limit)
    answer = solve_balance(pad, 1, heights, answer, target, limit)
    write_forces(pad, stiffness[env], heights, answer, total, force[env, side])
    if lane == 0:
        solution[env, side] = wp.vec3(wp.vec3d(answer[0], answer[1] * scale, answer[2] * scale))
