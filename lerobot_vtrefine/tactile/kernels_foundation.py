"""Device functions of the load-consistent elastic foundation (Winkler): heights, load in; taxel forces out.

Each pad is one thread on CPU and one warp of 32 lanes on CUDA, which share out its columns. Its face gives
way by u = max(0, z + delta + a x + b y) at every lattice point, where z is the column height plus the viscous
lead tau * rate and (x, y) the centre of the point's taxel, in taxel pitches. The three unknowns are solved so
that the forces k u add up to the load and balance at its centre: the minimum of a convex, piecewise quadratic
function, found by Newton's method.

The loops over points are in `kernels_packs`.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import Share, ivec4
from lerobot_vtrefine.tactile.kernels_packs import add_all_lanes, add_forces, add_lanes, raw_sums

wp.set_module_options({"enable_backward": False})

MAX_TILT = wp.constant(3.0)
"""Limit of the two slopes; only reached when the load's centre lies outside what the body can press on."""
NEWTON_STEPS = wp.constant(14)
MAX_LEAD_M = wp.constant(0.05)
NEAR = wp.constant(1.0e-2)
"""How close to the load the search for the offset comes before Newton's method takes over."""
START_M = wp.constant(5.0e-4)
"""How deep the search begins: about what a firm grasp presses."""
TOLERANCE = wp.constant(1.0e-5)
"""Of the balance, in shares of the load (and taxel pitches); the sum itself is then made exact by scaling."""
NOISE = wp.constant(1.0e-6)
"""Relative rounding of sums in single precision, which no step can be asked to beat."""

mat33d = wp.types.matrix(shape=(3, 3), dtype=wp.float64)


@wp.struct
class Pad:
    """One pad's lattice, rows and columns `area` of which may be in contact, and this thread's part of it."""

    rows: int
    cols: int
    subdivision: int
    area: ivec4
    share: Share


@wp.struct
class Balance:
    """Sums over the points in contact for one trial of (delta, a, b)."""

    squares: wp.float64
    sums: wp.vec3d
    hessian: mat33d


@wp.func
def balance(
    pad: Pad, taxel_x: wp.array(dtype=float), lead: wp.array(dtype=float), trial: wp.vec3d
) -> Balance:
    """Sums of u (1, x, y) and (1, x, y)^T (1, x, y)."""
    middle = 0.5 * float(pad.rows / pad.subdivision - 1)
    own = raw_sums(pad.share, pad.area, pad.cols, middle, wp.vec3(trial), taxel_x, lead)
    own = add_all_lanes(own)
    n = wp.float64(own[0])
    x = wp.float64(own[1])
    y = wp.float64(own[2])
    xy = wp.float64(own[4])
    result = Balance()
    result.squares = wp.float64(own[9])
    result.sums = wp.vec3d(wp.float64(own[6]), wp.float64(own[7]), wp.float64(own[8]))
    result.hessian = mat33d(n, x, y, x, wp.float64(own[3]), xy, y, xy, wp.float64(own[5]))
    return result


@wp.func
def offset_for_sum(
    pad: Pad, taxel_x: wp.array(dtype=float), lead: wp.array(dtype=float), tilted: wp.vec3d, total: wp.float64
) -> wp.vec3d:
    """(delta, a, b) with the tilts of `tilted` and delta such that the u add up to about `total`.

    Newton from the side where more points are in contact descends monotonically and ends after finitely many
    steps; its first step leads to that side from anywhere.
    """
    trial = tilted
    for _step in range(32):
        here = balance(pad, taxel_x, lead, trial)
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
    taxel_x: wp.array(dtype=float),
    lead: wp.array(dtype=float),
    start: wp.vec3d,
    target: wp.vec3d,
    limit: wp.float64,
) -> wp.vec3d:
    """(delta, a, b) whose sums meet the target; damped Newton steps on the convex merit sum u^2 / 2 - target
    . trial."""
    trial = start
    here = balance(pad, taxel_x, lead, trial)
    if here.sums[0] < wp.float64(0.1) * target[0]:
        # Too little in contact for a first step that means something.
        trial = offset_for_sum(pad, taxel_x, lead, trial, target[0])
        here = balance(pad, taxel_x, lead, trial)
    for _ in range(NEWTON_STEPS):
        g = here.sums - target
        worst = wp.max(wp.abs(g[0]), wp.max(wp.abs(g[1]), wp.abs(g[2])))
        if worst <= wp.float64(TOLERANCE) * target[0]:
            break
        step = newton_step(here.hessian, g)
        merit = wp.float64(0.5) * here.squares - wp.dot(target, trial)
        slack = wp.float64(NOISE) * (here.squares + wp.abs(wp.dot(target, trial)))
        scale = wp.float64(1.0)
        accepted = int(0)
        for _halving in range(8):
            if accepted == 0:
                candidate = limited(trial + scale * step, limit)
                there = balance(pad, taxel_x, lead, candidate)
                gain = wp.float64(0.5) * there.squares - wp.dot(target, candidate) - merit
                bound = wp.float64(1.0e-4) * wp.min(wp.dot(g, candidate - trial), wp.float64(0.0))
                if gain <= bound + slack:
                    trial = candidate
                    here = there
                    accepted = 1
                scale = scale * wp.float64(0.5)
        if accepted == 0:
            break
    if here.sums[0] < wp.float64(0.9) * target[0]:
        trial = offset_for_sum(pad, taxel_x, lead, trial, target[0])
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
    taxel_x: wp.array(dtype=float),
    lead: wp.array(dtype=float),
    answer: wp.vec3d,
    total: wp.float64,
    force: wp.array(dtype=float),
) -> None:
    """Forces of a solution, scaled by what was left between their sum and the load."""
    cols = pad.cols / pad.subdivision
    middle = 0.5 * float(pad.rows / pad.subdivision - 1)
    own = add_forces(pad.share, pad.area, pad.cols, middle, stiffness, wp.vec3(answer), taxel_x, lead, force)
    factor = wp.float32(total) / add_lanes(own)
    for row in range(pad.area[0] / pad.subdivision, pad.area[1] / pad.subdivision):
        for col in range(
            pad.area[2] / pad.subdivision / pad.share.lanes * pad.share.lanes + pad.share.lane,
            pad.area[3] / pad.subdivision,
            pad.share.lanes,
        ):
            force[row * cols + col] *= factor


@wp.func
def contact_area(rows: int, cols: int, subdivision: int, window: wp.array(dtype=ivec4)) -> ivec4:
    """Smallest block of whole taxels, and of whole packs of columns, that holds all primitives' areas; empty
    (begin >= end) without any."""
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
    step = subdivision
    if cols % 8 == 0 and 8 % subdivision == 0:
        step = 8
    return ivec4(
        area[0] / subdivision * subdivision,
        (area[1] + subdivision - 1) / subdivision * subdivision,
        area[2] / step * step,
        (area[3] + step - 1) / step * step,
    )


@wp.func
def solve_pad(
    pad: Pad,
    pitch: float,
    stiffness: float,
    push: wp.vec3,
    top: float,
    taxel_x: wp.array(dtype=float),
    lead: wp.array(dtype=float),
) -> wp.vec3d:
    """(delta, a, b) of one pad under the load `push` for leads of which the largest is `top`."""
    total = wp.float64(push[0]) / wp.float64(stiffness)
    scale = wp.float64(1.0) / wp.float64(pitch)
    target = wp.vec3d(total, total * wp.float64(push[1]) * scale, total * wp.float64(push[2]) * scale)
    start = wp.vec3d(wp.float64(START_M - top), wp.float64(0.0), wp.float64(0.0))
    return solve_balance(pad, taxel_x, lead, start, target, wp.float64(MAX_TILT * pitch))
