"""Constraint forces of all worlds: mujoco_warp's arrays, Newton's method. Imports warp and mujoco_warp."""

import mujoco_warp as mjw
import warp as wp

from lerobot_vtrefine.sim.backends import warp_newton_kernels as newton
from lerobot_vtrefine.sim.backends.warp_rows_kernels import Cones, Rows

THREADS = 64
"""Of a block, which solves one world; on a GPU."""


def solve(model: mjw.Model, data: mjw.Data) -> None:
    """Constraint forces and accelerations, as `mujoco_warp.solve` finds them by Newton's method for elliptic
    cones and a dense Jacobian.
    """
    threads = THREADS if wp.get_device().is_cuda or wp.config.enable_cpu_blocks else 1
    groups = max(1, threads // newton.patches(model.nv))
    given = [_limits(model, data), _motion(data), _search(data, model.nv, groups), _rows(data)]
    given += [_cones(model, data), _inertia(model, data)]
    wp.launch_tiled(newton.newton_kernel(model.nv), dim=data.nworld, inputs=given, block_dim=threads)


def _limits(model: mjw.Model, data: mjw.Data) -> newton.Limits:
    limits = newton.Limits()
    limits.tolerance, limits.line_tolerance = model.opt.tolerance, model.opt.ls_tolerance
    limits.steps, limits.line_steps = model.opt.iterations, model.opt.ls_iterations
    limits.count = data.solver_niter
    return limits


def _motion(data: mjw.Data) -> newton.Motion:
    motion = newton.Motion()
    motion.start, motion.qacc, motion.inertial = data.qacc_warmstart, data.qacc, data.efc.Ma
    motion.smooth, motion.constraint = data.qfrc_smooth, data.qfrc_constraint
    return motion


def _search(data: mjw.Data, nv: int, groups: int) -> newton.Search:
    search, worlds = newton.Search(), data.nworld
    for name in ("gradient", "direction", "pushed"):
        setattr(search, name, wp.empty((worlds, nv), dtype=float))
    search.force = wp.empty((worlds, groups, nv), dtype=float)
    search.hessian = wp.empty((worlds, groups, nv, nv), dtype=float)
    search.bent = wp.empty((worlds, data.njmax, data.efc.J.shape[2] // 4), dtype=wp.vec4)
    return search


def _rows(data: mjw.Data) -> Rows:
    rows, efc = Rows(), data.efc
    rows.equalities, rows.frictions, rows.count = data.ne, data.nf, data.nefc
    rows.kind, rows.contact, rows.loss, rows.target = efc.type, efc.id, efc.frictionloss, efc.aref
    rows.stiffness, rows.jacobian, rows.force, rows.state = efc.D, efc.J, efc.force, efc.state
    for name in ("residual", "slope"):
        setattr(rows, name, wp.empty((data.nworld, data.njmax), dtype=float))
    rows.lone, rows.lones = wp.empty((data.nworld, data.njmax), dtype=int), wp.empty(data.nworld, dtype=int)
    worlds, room, wide = efc.J.shape
    rows.line = wp.empty((worlds, room, 3), dtype=wp.vec4)
    rows.quads = wp.array(
        ptr=efc.J.ptr, dtype=wp.vec4, shape=(worlds, room, wide // 4), device=efc.J.device, copy=False
    )
    return rows


def _cones(model: mjw.Model, data: mjw.Data) -> Cones:
    cones, friction = Cones(), data.contact.friction
    cones.row, cones.dim = data.contact.efc_address, data.contact.dim
    shape = (friction.shape[0], 5)
    cones.friction = wp.array(ptr=friction.ptr, dtype=float, shape=shape, device=friction.device, copy=False)
    cones.ratio = model.opt.impratio_invsqrt
    return cones


def _inertia(model: mjw.Model, data: mjw.Data) -> newton.Inertia:
    inertia = newton.Inertia()
    inertia.values, inertia.row, inertia.col = data.M, model.M_hinit_i, model.M_colind
    inertia.first, inertia.other = model.M_mulm_rowadr, model.M_mulm_col
    inertia.entry = model.M_mulm_madr
    return inertia
