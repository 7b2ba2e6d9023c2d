"""Constraint rows of all worlds, in two parts. Imports warp and mujoco_warp.

What contacts do not enter can be prepared while they are searched for. The same rows, in the same order, as
those of `mujoco_warp.make_constraint` for a dense Jacobian and elliptic cones.
"""

import copy

import mujoco_warp as mjw
import warp as wp
from mujoco_warp._src import constraint

from lerobot_vtrefine.sim.backends import warp_jacobian_kernels as kernels


def rows_without_contacts(model: mjw.Model, data: mjw.Data) -> None:
    """Rows of equalities, dry friction and limits only."""
    without = copy.copy(model)
    without.opt = copy.copy(model.opt)
    without.opt.disableflags = model.opt.disableflags | mjw.DisableBit.CONTACT
    mjw.make_constraint(without, data)


def add_contact_rows(model: mjw.Model, data: mjw.Data) -> None:
    """Rows of the contacts, after the others."""
    contact, efc, opt = data.contact, data.efc, model.opt
    which = [data.nacon, contact.dist, contact.dim, contact.includemargin]
    begin = constraint._efc_contact_init(opt.cone, False, True, model.flg_adhesion)
    tree = [model.body_weldid, model.body_dofnum, model.body_dofadr, model.dof_parentid, model.geom_bodyid]
    where = [contact.adhesion, contact.worldid, contact.geom, contact.type]
    begun = [data.nefc, contact.efc_address, efc.id, efc.jtdaj_adr, efc.jtdaj_nrow, efc.jtdaj_nblock]
    begun += [efc.J_rownnz, efc.J_rowadr, efc.Jqvel, wp.empty(data.nworld, dtype=int)]
    wp.launch(begin, data.naconmax, [*tree, data.njmax, data.njmax_nnz, *which, *where], begun)
    touches, rows = _touches(data), (data.naconmax, int(model.nmaxcondim))
    wp.launch(
        kernels.contact_jacobian, (data.naconmax, model.nv_pad), [touches, _bodies(model, data)], [efc.J]
    )
    wp.launch(kernels.contact_velocity, rows, [touches, efc.J, data.qvel], [efc.Jqvel])
    finish = constraint._efc_contact_update(opt.cone, model.flg_adhesion, False)
    options = [opt.timestep, opt.disableflags, opt.impratio_invsqrt, model.body_invweight0, model.geom_bodyid]
    state = [contact.efc_address, efc.Jqvel, *which, contact.worldid, contact.geom, contact.friction]
    state += [contact.solref, contact.solreffriction, contact.solimp, contact.adhesion, contact.type]
    finished = [efc.type, efc.id, efc.pos, efc.margin, efc.D, efc.vel, efc.aref, efc.frictionloss]
    wp.launch(finish, rows, [*options, *state], finished)


def _touches(data: mjw.Data) -> kernels.Touches:
    touches, contact = kernels.Touches(), data.contact
    touches.kind, touches.world, touches.geoms = contact.type, contact.worldid, contact.geom
    touches.pos, touches.frame, touches.dim = contact.pos, contact.frame, contact.dim
    touches.row, touches.count = contact.efc_address, data.nacon
    return touches


def _bodies(model: mjw.Model, data: mjw.Data) -> kernels.Bodies:
    bodies = kernels.Bodies()
    bodies.of_geom, bodies.root, bodies.moved_by = (
        model.geom_bodyid,
        model.body_rootid,
        model.body_isdofancestor,
    )
    bodies.motion, bodies.centre = data.cdof, data.subtree_com
    return bodies
