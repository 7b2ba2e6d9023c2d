"""The contact models' kernels: poses prepared by `kernels.prepare` and loads in, force per taxel out.

A pad's heights are used as soon as they are known, out of a buffer that on CPU all pads share (it stays in
the first cache), on CUDA each has for itself.
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import (
    NO_BODY_M,
    STEEPEST,
    Bodies,
    Lattice,
    Share,
    Views,
    ivec4,
)
from lerobot_vtrefine.tactile.kernels_foundation import (
    MAX_LEAD_M,
    Pad,
    contact_area,
    solve_pad,
    spread_load,
    write_forces,
)
from lerobot_vtrefine.tactile.kernels_packs import add_lead, fill_area, max_lanes, penalties
from lerobot_vtrefine.tactile.kernels_query import fill_pad

wp.set_module_options({"enable_backward": False})

SHALLOW_M = wp.constant(1.2e-3)
"""Surfaces this far above the face are looked at first; farther ones only where the solution could reach
them."""


@wp.struct
class Work:
    """The part of a launch that one call does: environments from `first_env` on, `lanes` threads a pad.

    Scratch starts at `buffer`: one for all pads, or (`own_buffers` = 1) one each.
    """

    first_env: int
    lanes: int
    buffer: int
    own_buffers: int


@wp.struct
class Foundation:
    """Per environment the `stiffness` of one lattice point [N/m] and `damping_s`; x of every lattice column's
    taxel, in taxel pitches."""

    stiffness: wp.array(dtype=float)
    damping_s: wp.array(dtype=float)
    taxel_x: wp.array(dtype=float)


@wp.struct
class Settled:
    """The highest height plus lead under a pad (NO_BODY_M: nothing), and the face there: (delta, a, b)."""

    top: float
    face: wp.vec3d


@wp.struct
class Penalty:
    """Per environment f = min(max(0, stiffness d + damping d'), ceiling) where d > 0 [N/m, N s/m, N]."""

    stiffness: wp.array(dtype=float)
    damping: wp.array(dtype=float)
    ceiling: wp.array(dtype=float)


@wp.func
def make_share(width: int, lane: int, lanes: int) -> Share:
    """The columns that a thread owns, `width` neighbouring ones at a time."""
    share = Share()
    share.lane = lane
    share.lanes = lanes
    share.width = width
    return share


@wp.func
def fastest_lead(
    lattice: Lattice, bodies: Bodies, views: Views, env: int, pad: int, damping_s: float
) -> float:
    """Upper bound of the viscous lead anywhere on the pad [m]."""
    size = lattice.pitch * float(wp.max(lattice.rows, lattice.cols))
    speed = float(0.0)
    for k in range(bodies.kind.shape[0]):
        area = views.window[env, pad, k]
        if area[0] < area[1]:
            turning = wp.length(views.angular[env, pad, k])
            speed = wp.max(speed, wp.length(views.linear[env, pad, k]) + turning * (size + lattice.reach))
    return wp.min(damping_s * speed / -STEEPEST, MAX_LEAD_M)


@wp.func
def left_out_matters(
    lattice: Lattice,
    bodies: Bodies,
    views: Views,
    env: int,
    side: int,
    low: float,
    lead: float,
    found: Settled,
) -> int:
    """1 where a face could have come down to surfaces more than `low` above it, which were left out."""
    rows = wp.float64(lattice.rows / lattice.subdivision) * wp.float64(0.5)
    cols = wp.float64(lattice.cols / lattice.subdivision) * wp.float64(0.5)
    deepest = found.face[0] + wp.abs(found.face[1]) * cols + wp.abs(found.face[2]) * rows
    return int(wp.float32(deepest) + fastest_lead(lattice, bodies, views, env, side, lead) > low)


@wp.func
def settle(
    lattice: Lattice,
    pad: Pad,
    filled: int,
    foundation: Foundation,
    bodies: Bodies,
    views: Views,
    env: int,
    side: int,
    push: wp.vec3,
    heights: wp.array(dtype=float),
    leads: wp.array(dtype=float),
) -> Settled:
    """Where one pad's face comes to rest under `push`; fills the scratch with heights (and plus lead)."""
    damping_s = foundation.damping_s[env]
    pitch = lattice.pitch * float(lattice.subdivision)
    low = float(lattice.reach)
    if filled == 0:
        low = wp.min(SHALLOW_M, lattice.reach)
    found = Settled()
    searching = int(1)
    while searching == 1:
        if filled == 0:
            fill_area(pad.share, pad.area, lattice.cols, NO_BODY_M, heights)
            fill_pad(lattice, pad.share, low, bodies, views, env, side, heights, leads)
        top = max_lanes(add_lead(pad.share, pad.area, lattice.cols, damping_s, MAX_LEAD_M, heights, leads))
        found.top = top
        searching = int(low < lattice.reach)
        if top > 0.5 * NO_BODY_M:
            found.face = solve_pad(
                pad, pitch, foundation.stiffness[env], push, top, foundation.taxel_x, leads
            )
            if searching == 1:
                searching = left_out_matters(lattice, bodies, views, env, side, low, damping_s, found)
        low = lattice.reach
    return found


@wp.kernel
def press(
    lattice: Lattice,
    work: Work,
    filled: int,
    foundation: Foundation,
    bodies: Bodies,
    views: Views,
    load: wp.array(dtype=wp.vec3, ndim=2),
    height: wp.array(dtype=float, ndim=2),
    rate: wp.array(dtype=float, ndim=2),
    force: wp.array(dtype=float, ndim=3),
    solution: wp.array(dtype=wp.vec3, ndim=2),
) -> None:
    """Forces [N] on all taxels under each pad's `load`: the load-consistent foundation.

    `height` and `rate` are scratch; with `filled` they hold heights and rates to be used instead of the
    bodies'. `solution` gets (delta [m], slope x, slope y).
    """
    row, side, lane = wp.tid()
    env = work.first_env + row
    out = force[env, side]
    whole = ivec4(0, lattice.rows / lattice.subdivision, 0, lattice.cols / lattice.subdivision)
    fill_area(make_share(1, lane, work.lanes), whole, whole[3], 0.0, out)
    push = load[env, side]
    if push[0] <= 0.0:
        return
    pad = Pad()
    pad.rows = lattice.rows
    pad.cols = lattice.cols
    pad.subdivision = lattice.subdivision
    pad.share = make_share(lattice.subdivision, lane, work.lanes)
    pad.area = contact_area(lattice.rows, lattice.cols, lattice.subdivision, views.window[env, side])
    slot = work.buffer + work.own_buffers * (env * load.shape[1] + side)
    leads = rate[slot]
    found = settle(lattice, pad, filled, foundation, bodies, views, env, side, push, height[slot], leads)
    pitch = lattice.pitch * float(lattice.subdivision)
    if found.top <= 0.5 * NO_BODY_M:
        if lane == 0:
            spread_load(whole[1], whole[3], pitch, push, out)
            solution[env, side] = wp.vec3()
        return
    stiffness = foundation.stiffness[env]
    total = wp.float64(push[0]) / wp.float64(stiffness)
    write_forces(pad, stiffness, foundation.taxel_x, leads, found.face, total, out)
    if lane == 0:
        scale = wp.float64(1.0) / wp.float64(pitch)
        solution[env, side] = wp.vec3(wp.vec3d(found.face[0], found.face[1] * scale, found.face[2] * scale))


@wp.kernel
def penalise(
    lattice: Lattice,
    work: Work,
    penalty: Penalty,
    bodies: Bodies,
    views: Views,
    rate: wp.array(dtype=float, ndim=2),
    force: wp.array(dtype=float, ndim=3),
) -> None:
    """Forces [N] on all taxels by a penalty on depth and its rate; `rate` is scratch."""
    row, side, lane = wp.tid()
    env = work.first_env + row
    share = make_share(lattice.subdivision, lane, work.lanes)
    depth = force[env, side]
    rates = rate[work.buffer + work.own_buffers * (env * force.shape[1] + side)]
    # Gaps carry no force: only what lies below the face is looked at.
    whole = ivec4(0, lattice.rows, 0, lattice.cols)
    fill_area(share, whole, lattice.cols, 0.0, depth)
    fill_pad(lattice, share, 0.0, bodies, views, env, side, depth, rates)
    stiffness = penalty.stiffness[env]
    damping = penalty.damping[env]
    ceiling = penalty.ceiling[env]
    penalties(share, whole, lattice.cols, stiffness, damping, ceiling, rates, depth)
