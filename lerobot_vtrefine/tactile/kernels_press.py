"""The contact models' kernels: poses prepared by `kernels.prepare` and loads in, force per taxel out.

A pad's heights are used as soon as they are known: on CPU all pads share a buffer, which stays in the first
cache; on CUDA they lie in the multiprocessor's own memory (`kernels_surface`).
"""

import warp as wp

from lerobot_vtrefine.tactile.kernels import (
    CLOSEST,
    COLUMN,
    NO_BODY_M,
    STEEPEST,
    Bodies,
    Lattice,
    Views,
    ivec4,
)
from lerobot_vtrefine.tactile.kernels_foundation import (
    MAX_LEAD_M,
    Pad,
    solve_pad,
    spread_load,
    write_forces,
)
from lerobot_vtrefine.tactile.kernels_lanes import BLOCK, lanes, make_share, max_lanes, sync_lanes
from lerobot_vtrefine.tactile.kernels_packs import add_lead, clear, fill_area, penalties
from lerobot_vtrefine.tactile.kernels_query import contact_area, fill_closest, fill_columns
from lerobot_vtrefine.tactile.kernels_surface import lattice_room, row_length, take_in, taxel_room

# CUDA's fast division and root, a few units in the last place off, halve what triangles cost; on CPU nothing
# changes.
wp.set_module_options({"enable_backward": False, "fast_math": True})

PRESS_BLOCKS, PENALTY_BLOCKS = 8, 12
"""Blocks that a multiprocessor of a GPU shall hold at a time, by which the compiler shares out registers."""

SHALLOW_M = wp.constant(1.2e-3)
"""Surfaces this far above the face are looked at first; farther ones only where the solution could reach
them."""


@wp.struct
class Work:
    """The part of a launch that one call does: environments from `first_env` on.

    Scratch starts at `buffer`: one for all pads, or (`own_buffers` = 1) one each.
    """

    first_env: int
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
def fastest_lead(lattice: Lattice, lane: int, views: Views, env: int, pad: int, damping_s: float) -> float:
    """Upper bound of the viscous lead anywhere on the pad [m]."""
    size = lattice.pitch * float(wp.max(lattice.rows, lattice.cols))
    speed = float(0.0)
    for k in range(lane, views.window.shape[2], lanes()):
        area = views.window[env, pad, k]
        if area[0] < area[1]:
            turning = wp.length(views.angular[env, pad, k])
            speed = wp.max(speed, wp.length(views.linear[env, pad, k]) + turning * (size + lattice.reach))
    return wp.min(damping_s * max_lanes(speed) / -STEEPEST, MAX_LEAD_M)


@wp.func
def left_out_matters(
    lattice: Lattice,
    lane: int,
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
    return int(wp.float32(deepest) + fastest_lead(lattice, lane, views, env, side, lead) > low)


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
    """Where one pad's face comes to rest under `push`, if there is any; fills the scratch with heights (and
    plus lead)."""
    damping_s = foundation.damping_s[env]
    pitch = lattice.pitch * float(lattice.subdivision)
    low = float(lattice.reach)
    if filled == 0:
        low = wp.min(SHALLOW_M, lattice.reach)
    found = Settled()
    found.top = NO_BODY_M
    searching = int(push[0] > 0.0)
    while searching == 1:
        if filled == 0:
            fill_area(pad.share, pad.area, pad.stride, NO_BODY_M, heights)
            fill_columns(lattice, pad.share, pad.stride, low, bodies, views, env, side, heights, leads)
        top = max_lanes(add_lead(pad.share, pad.area, pad.stride, damping_s, MAX_LEAD_M, heights, leads))
        found.top = top
        searching = int(low < lattice.reach)
        if top > 0.5 * NO_BODY_M:
            found.face = solve_pad(
                pad, pitch, foundation.stiffness[env], push, top, foundation.taxel_x, leads
            )
            if searching == 1:
                searching = left_out_matters(lattice, pad.share.lane, views, env, side, low, damping_s, found)
        low = lattice.reach
    return found


@wp.kernel(launch_bounds=(BLOCK, PRESS_BLOCKS))
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
    room: wp.array(dtype=float, ndim=2),
    force: wp.array(dtype=float, ndim=3),
    solution: wp.array(dtype=wp.vec3, ndim=2),
) -> None:
    """Forces [N] on all taxels under each pad's `load`: the load-consistent foundation.

    `height` and `rate` are scratch; with `filled` they hold heights and rates to be used instead of the
    bodies'. `room` is scratch on CUDA, a pad each or shared by all. `solution` gets (delta [m], slope x,
    slope y).
    """
    row, side, lane = wp.tid()
    env = work.first_env + row
    out = force[env, side]
    push = load[env, side]
    pad = Pad()
    pad.taxel_rows = lattice.rows / lattice.subdivision
    pad.taxel_cols = lattice.cols / lattice.subdivision
    pad.share = make_share(lattice.subdivision, lane)
    window = views.window[env, side]
    pad.area = contact_area(pad.share, lattice.rows, lattice.cols, lattice.subdivision, window)
    pad.stride = row_length(lattice.cols, pad.area)
    slot = work.buffer + work.own_buffers * (env * load.shape[1] + side)
    spare = room[wp.min(env * load.shape[1] + side, room.shape[0] - 1)]
    heights = lattice_room(pad.area, pad.stride, height[slot], spare)
    leads = lattice_room(pad.area, pad.stride, rate[slot], spare)
    if filled == 1:
        take_in(pad.share, pad.area, pad.stride, lattice.cols, height[slot], rate[slot], heights)
    found = settle(lattice, pad, filled, foundation, bodies, views, env, side, push, heights, leads)
    pitch = lattice.pitch * float(lattice.subdivision)
    if found.top <= 0.5 * NO_BODY_M:
        clear(pad.share, pad.taxel_rows * pad.taxel_cols, out)
        if lane == 0 and push[0] > 0.0:
            spread_load(pad.taxel_rows, pad.taxel_cols, pitch, push, out)
            solution[env, side] = wp.vec3()
        return
    write_forces(pad, foundation.taxel_x, leads, found.face, push[0], out)
    if lane == 0:
        scale = wp.float64(1.0) / wp.float64(pitch)
        solution[env, side] = wp.vec3(wp.vec3d(found.face[0], found.face[1] * scale, found.face[2] * scale))


@wp.func
def penalise_pad(
    mode: int,
    lattice: Lattice,
    work: Work,
    penalty: Penalty,
    bodies: Bodies,
    views: Views,
    rate: wp.array(dtype=float, ndim=2),
    room: wp.array(dtype=float, ndim=2),
    force: wp.array(dtype=float, ndim=3),
    row: int,
    side: int,
    lane: int,
) -> None:
    """One pad's forces; a mode that is known when a kernel is compiled leaves the other one's code out."""
    env = work.first_env + row
    share = make_share(lattice.subdivision, lane)
    out = force[env, side]
    whole = ivec4(0, lattice.rows, 0, lattice.cols)
    area = contact_area(share, lattice.rows, lattice.cols, 1, views.window[env, side])
    stride = row_length(lattice.cols, area)
    depth = taxel_room(area, stride, out, room[wp.min(env * force.shape[1] + side, room.shape[0] - 1)])
    rates = rate[work.buffer]
    # Gaps carry no force: only what lies below the face is looked at.
    if lanes() == 1:
        fill_area(share, whole, stride, 0.0, depth)
    else:
        fill_area(share, area, stride, 0.0, depth)
    if mode == COLUMN:
        fill_columns(lattice, share, stride, 0.0, bodies, views, env, side, depth, rates)
    else:
        fill_closest(lattice, share, stride, bodies, views, env, side, depth, rates)
    sync_lanes()
    stiffness = penalty.stiffness[env]
    damping = penalty.damping[env]
    ceiling = penalty.ceiling[env]
    penalties(share, area, whole, stride, stiffness, damping, ceiling, depth, rates, out)


@wp.kernel(launch_bounds=(BLOCK, PENALTY_BLOCKS))
def penalise_closest(
    lattice: Lattice,
    work: Work,
    penalty: Penalty,
    bodies: Bodies,
    views: Views,
    rate: wp.array(dtype=float, ndim=2),
    room: wp.array(dtype=float, ndim=2),
    force: wp.array(dtype=float, ndim=3),
) -> None:
    """Forces [N] on all taxels by a penalty on penetration and its rate; `rate` and `room` are scratch."""
    row, side, lane = wp.tid()
    penalise_pad(CLOSEST, lattice, work, penalty, bodies, views, rate, room, force, row, side, lane)


@wp.kernel(launch_bounds=(BLOCK, PENALTY_BLOCKS))
def penalise_columns(
    lattice: Lattice,
    work: Work,
    penalty: Penalty,
    bodies: Bodies,
    views: Views,
    rate: wp.array(dtype=float, ndim=2),
    room: wp.array(dtype=float, ndim=2),
    force: wp.array(dtype=float, ndim=3),
) -> None:
    """Forces [N] on all taxels by a penalty on column height and its rate; `rate` and `room` are scratch."""
    row, side, lane = wp.tid()
    penalise_pad(COLUMN, lattice, work, penalty, bodies, views, rate, room, force, row, side, lane)
