"""Device functions of the load-consistent elastic foundation (Winkler): heights, load in; taxel forces out.

Each pad is one thread on CPU and one warp of 32 lanes on CUDA, which share out its columns. Its face gives
way by u = max(0, z + delta + a x + b y) at every lattice point, where z is the column height plus the viscous
lead tau * rate and (x, y) the centre of the point's taxel, in taxel pitches. The three unknowns are solved so
that the forces k u add up to the load and balance at its centre: the minimum of a convex, piecewise quadratic
function, found by Newton's method.

The loops over points are in `kernels_packs`.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import ivec4
from lerobot_vtrefine.tactile.kernels_lanes import Share, add_lanes, lanes
from lerobot_vtrefine.tactile.kernels_packs import (
    add_all_lanes,
    add_forces,
    clear,
    raw_sums,
    scale_forces,
    vec10,
)

wp.set_module_options({"enable_backward": False})

MAX_TILT = wp.constant(3.0)
"""Limit of the two slopes; only reached when the load's centre lies outside what the body can press on."""
NEWTON_STEPS = wp.constant(14)
HALVINGS = wp.constant(8)
OFFSET_STEPS = wp.constant(32)
MAX_LEAD_M = wp.constant(0.05)
NEAR = wp.constant(1.0e-2)
"""How close to the load the search for the offset comes before Newton's method takes over."""
START_M = wp.constant(5.0e-4)
"""How deep the search begins: about what a firm grasp presses."""
TOLERANCE = wp.constant(1.0e-5)
"""Of the balance, in shares of the load (and taxel pitches); the sum itself is then made exact by scaling."""
NOISE = wp.constant(1.0e-6)
"""Relative rounding of sums in single precision, which no step can be asked to beat."""

FIRST = wp.constant(0)
"""The start is looked at: is enough in contact there for a first step that means something?"""
AGAIN = wp.constant(1)
"""What the search for an offset led to is looked at, and taken."""
LINE = wp.constant(2)
"""A step of Newton's method is looked at, and taken if it helps, else halved."""
OFFSET = wp.constant(3)
"""The offset alone is moved, until about the load is carried."""
LAST = wp.constant(4)
"""As OFFSET, after which nothing follows."""
DONE = wp.constant(5)


@wp.struct
class Pad:
    """One pad's taxels, the lattice's rows and columns `area` that may be in contact, the length `stride` of
    a row of heights, and this thread's part of it."""

    taxel_rows: int
    taxel_cols: int
    area: ivec4
    stride: int
    share: Share


@wp.func
def balance(pad: Pad, taxel_x: wp.array(dtype=float), lead: wp.array(dtype=float), trial: wp.vec3d) -> vec10:
    """(n, x, y, x^2, x y, y^2, u, u x, u y, u^2) summed over all points in contact for one trial of (delta,
    a, b)."""
    middle = 0.5 * float(pad.taxel_rows - 1)
    return add_all_lanes(raw_sums(pad.share, pad.area, pad.stride, middle, wp.vec3(trial), taxel_x, lead))


@wp.func
def excess(sums: vec10, target: wp.vec3d) -> wp.vec3d:
    """Sums of u (1, x, y), less the target."""
    return wp.vec3d(wp.float64(sums[6]), wp.float64(sums[7]), wp.float64(sums[8])) - target


@wp.func
def merit(sums: vec10, target: wp.vec3d, trial: wp.vec3d) -> wp.float64:
    """The convex function whose gradient is the excess."""
    return wp.float64(0.5) * wp.float64(sums[9]) - wp.dot(target, trial)


@wp.func
def offset_step(sums: vec10, total: wp.float64) -> wp.vec2d:
    """By how much delta changes so that the u add up to about `total`, and (1 or 0) whether that is reached.

    Newton from the side where more points are in contact descends monotonically and ends after finitely many
    steps; its first step leads to that side from anywhere.
    """
    count = wp.float64(sums[0])
    if count < wp.float64(1.0):
        return wp.vec2d(wp.float64(1.0e-3), wp.float64(0.0))
    missing = total - wp.float64(sums[6])
    if wp.abs(missing) <= wp.float64(NEAR) * total:
        return wp.vec2d(missing / count, wp.float64(1.0))
    return wp.vec2d(missing / count, wp.float64(0.0))


@wp.func
def newton_step(sums: vec10, g: wp.vec3d) -> wp.vec3d:
    """-(h + small diagonal)^-1 g for the second derivatives h, by Cholesky; the diagonal keeps points on one
    line, or one point, solvable."""
    small = wp.float64(1.0e-9)
    one = wp.float64(1.0)
    n = wp.float64(sums[0])
    xx = wp.float64(sums[3])
    yy = wp.float64(sums[5])
    r0 = one / wp.sqrt(n + wp.float64(1.0e-30))
    l10 = wp.float64(sums[1]) * r0
    l20 = wp.float64(sums[2]) * r0
    r1 = one / wp.sqrt(wp.max(xx - l10 * l10, small * (xx + n)))
    l21 = (wp.float64(sums[4]) - l20 * l10) * r1
    r2 = one / wp.sqrt(wp.max(yy - l20 * l20 - l21 * l21, small * (yy + n)))
    y0 = -g[0] * r0
    y1 = (-g[1] - l10 * y0) * r1
    y2 = (-g[2] - l20 * y0 - l21 * y1) * r2
    x2 = y2 * r2
    x1 = (y1 - l21 * x2) * r1
    x0 = (y0 - l10 * x1 - l20 * x2) * r0
    return wp.vec3d(x0, x1, x2)


@wp.func
def limited(trial: wp.vec3d, limit: wp.float64) -> wp.vec3d:
    """The trial with both tilts within +-limit."""
    return wp.vec3d(trial[0], wp.clamp(trial[1], -limit, limit), wp.clamp(trial[2], -limit, limit))


@wp.func
def helps(there: vec10, here: vec10, target: wp.vec3d, point: wp.vec3d, trial: wp.vec3d) -> bool:
    """Whether a step from `trial` (sums `here`) to `point` lowers the merit as much as can be expected."""
    gain = merit(there, target, point) - merit(here, target, trial)
    slope = wp.min(wp.dot(excess(here, target), point - trial), wp.float64(0.0))
    slack = wp.float64(here[9]) + wp.abs(wp.dot(target, trial))
    return gain <= wp.float64(1.0e-4) * slope + wp.float64(NOISE) * slack


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
    . trial.

    All looks at a trial go through one place, as the code for it is long.
    """
    point = start
    trial = start
    step = wp.vec3d()
    here = vec10()
    scale = wp.float64(1.0)
    phase = int(FIRST)
    moves = int(0)
    looks = int(0)
    while phase != DONE:
        there = balance(pad, taxel_x, lead, point)
        looks += 1
        if phase == FIRST and wp.float64(there[6]) < wp.float64(0.1) * target[0]:
            phase = OFFSET
            looks = 1
        if phase >= OFFSET:
            change = offset_step(there, target[0])
            point[0] = point[0] + change[0]
            if change[1] > wp.float64(0.5) or looks >= OFFSET_STEPS:
                if phase == LAST:
                    trial = point
                phase = wp.where(phase == LAST, DONE, AGAIN)
        else:
            stuck = False
            taken = True
            if phase == LINE:
                taken = helps(there, here, target, point, trial)
            if taken:
                trial = point
                here = there
                g = excess(here, target)
                worst = wp.max(wp.abs(g[0]), wp.max(wp.abs(g[1]), wp.abs(g[2])))
                stuck = worst <= wp.float64(TOLERANCE) * target[0] or moves >= NEWTON_STEPS
                step = newton_step(here, g)
                scale = wp.float64(1.0)
                moves += 1
                looks = 0
            else:
                scale = scale * wp.float64(0.5)
                stuck = looks >= HALVINGS
            phase = LINE
            point = limited(trial + scale * step, limit)
            if stuck:
                point = trial
                looks = 0
                phase = wp.where(wp.float64(here[6]) < wp.float64(0.9) * target[0], LAST, DONE)
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
    taxel_x: wp.array(dtype=float),
    lead: wp.array(dtype=float),
    answer: wp.vec3d,
    total: float,
    force: wp.array(dtype=float),
) -> None:
    """Forces of a solution on all taxels, scaled so that their sum is `total` [N] exactly."""
    middle = 0.5 * float(pad.taxel_rows - 1)
    face = wp.vec3(answer)
    cols = pad.taxel_cols
    if lanes() == 1:
        clear(pad.share, pad.taxel_rows * cols, force)
    own = add_forces(pad.share, pad.area, pad.stride, cols, middle, face, taxel_x, lead, force)
    factor = total / add_lanes(own)
    scale_forces(
        pad.share,
        pad.area,
        pad.stride,
        pad.taxel_rows,
        cols,
        middle,
        factor,
        face,
        taxel_x,
        lead,
        force,
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
