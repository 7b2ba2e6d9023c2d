"""mujoco_warp's Newton solver, with less work in each of its steps. Imports warp and mujoco_warp.

- The cones' curvature is summed world by world, over contacts that slide: mujoco_warp sums it contact by
  contact, where most stick and contribute nothing.
- Whether a further step is needed is asked before its direction is computed, as far as that can be said; in
  most substeps it is not needed.

All else is `mujoco_warp.solve`, with the same iterations.
"""

import mujoco_warp as mjw
import warp as wp
from mujoco_warp._src import solver

from lerobot_vtrefine.sim.backends import warp_solve_kernels as kernels

SMALLEST_CONE = 3
"""Rows of a contact with friction at least."""


def solve(model: mjw.Model, data: mjw.Data) -> None:
    """Constraint forces and accelerations, as `mujoco_warp.solve` finds them by Newton's method for elliptic
    cones and a dense Jacobian.
    """
    context = solver._create_solver_context(model, data, inplace_cholesky=True)
    begin = solver._solve_init_dof(True, False, model.opt.run_qacc_smooth)
    start = [data.nefc, data.qacc_warmstart, data.qacc_smooth]
    wp.launch(begin, (data.nworld, model.nv), start, [data.qacc, data.qfrc_constraint])
    solver.init_context(model, data, context, grad=False)
    sliding = no_sliding(data)
    _gradient(model, data, context)
    _direction(model, data, context, sliding)
    unsolved = wp.full(1, data.nworld, dtype=int)
    given = {"model": model, "data": data, "context": context, "sliding": sliding, "unsolved": unsolved}
    if model.opt.graph_conditional:
        wp.capture_while(unsolved, _iterate, **given)
    else:
        for _ in range(model.opt.iterations):
            _iterate(**given)


def _iterate(
    model: mjw.Model,
    data: mjw.Data,
    context: solver.SolverContext,
    sliding: kernels.Sliding,
    unsolved: wp.array,
) -> None:
    """One step along the direction, and the next direction in the worlds that need one."""
    solver._linesearch(model, data, context)
    solver._update_constraint(model, data, context)
    _gradient(model, data, context)
    progress = [context.inertia_scale, context.grad_dot, context.improvement, context.alpha]
    limits = [model.opt.tolerance, model.opt.iterations]
    result = [data.solver_niter, data.overflow, sliding.count, unsolved, context.done]
    wp.launch(kernels.finish_by_step, data.nworld, [*limits, *progress], result)
    _direction(model, data, context, sliding)
    expected = [model.opt.tolerance, context.inertia_scale, context.newton_decrement]
    wp.launch(kernels.finish_by_model, data.nworld, expected, [unsolved, context.done])


def _gradient(model: mjw.Model, data: mjw.Data, context: solver.SolverContext) -> None:
    """The cost's gradient at the present accelerations."""
    done = context.done
    cleared = [context.grad_dot, context.newton_decrement, context.grad_scale, context.search_unchanged]
    clear = solver._update_gradient_zero_grad_dot(False)
    wp.launch(clear, data.nworld, [data.nefc, context.alpha, done], cleared)
    forces = [data.qfrc_smooth, data.qfrc_constraint, data.efc.Ma, data.nefc, done]
    gradient = solver._update_gradient_grad(False, False)
    wp.launch(gradient, (data.nworld, model.nv), forces, [context.grad, context.grad_dot])


def _direction(
    model: mjw.Model, data: mjw.Data, context: solver.SolverContext, sliding: kernels.Sliding
) -> None:
    """Newton's direction for the present gradient."""
    worlds, done = data.nworld, context.done
    size = (model.nv_pad, solver.types.TILE_SIZE_JTDAJ_DENSE, data.njmax, model.M_colind.shape[0])
    quadratic = [model.M_colind, model.M_hinit_i, data.nefc, data.M]
    quadratic += [data.efc.J, data.efc.D, data.efc.state, done]
    hessian = solver._update_gradient_JTDAJ_dense_tiled(*size)
    block = model.block_dim.update_gradient_JTDAJ_dense
    wp.launch_tiled(hessian, dim=worlds, inputs=quadratic, outputs=[context.h], block_dim=block)
    rows, cones = _rows(data, context), _cones(model, data)
    wp.launch(kernels.find_sliding, (worlds, data.njmax), [done, rows, cones, sliding])
    entries = [model.dof_tri_row, model.dof_tri_col, done, rows, cones, sliding]
    wp.launch(kernels.add_curvature, (worlds, model.dof_tri_row.size), entries, [context.h])
    solver._cholesky_factorize_solve(model, data, context)


def no_sliding(data: mjw.Data) -> kernels.Sliding:
    """An empty list of sliding contacts, with room for all."""
    sliding = kernels.Sliding()
    sliding.count = wp.zeros(data.nworld, dtype=int)
    sliding.row = wp.empty((data.nworld, data.njmax // SMALLEST_CONE), dtype=int)
    return sliding


def _rows(data: mjw.Data, context: solver.SolverContext) -> kernels.Rows:
    rows = kernels.Rows()
    rows.first, rows.count = data.ne, data.nefc
    rows.contact, rows.state, rows.stiffness = data.efc.id, data.efc.state, data.efc.D
    rows.residual, rows.jacobian = context.Jaref, data.efc.J
    return rows


def _cones(model: mjw.Model, data: mjw.Data) -> kernels.Cones:
    cones = kernels.Cones()
    cones.row, cones.dim, cones.friction = data.contact.efc_address, data.contact.dim, data.contact.friction
    cones.ratio = model.opt.impratio_invsqrt
    return cones
