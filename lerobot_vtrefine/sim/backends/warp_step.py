"""One physics step on mujoco_warp, in an order that suits a GPU. Imports warp and mujoco_warp.

The same functions in the same roles as `mujoco_warp.step`, so the same physics, but
- what does not depend on each other runs on streams of its own: other forces, inertia and constraints beside
  the search for contacts, which needs the bodies' poses only, and the integrator's matrix beside the solver.
  A step of a thousand worlds is some eighty small kernels, which wait for each other longer than they work:
  the longest chain of them is half of that;
- worlds that nobody steps have no contacts, nor room in the lists of those that may be, which worlds share;
- pairs of geoms that a face of a box separates are dropped before the general convex collision, two thirds of
  them while a round plug is in its hole (at a thousand worlds on an H200 this neither gains nor costs);
- contact sensors are summed contact by contact, and nothing is computed that this package does not read
  (cameras, lights, energies, other sensors).
"""

import dataclasses
from collections.abc import Generator
from contextlib import contextmanager

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp._src import collision_driver, forward, smooth
from mujoco_warp._src.math import upper_trid_index
from mujoco_warp._src.types import CollisionType

from lerobot_vtrefine.sim.backends import warp_contact_kernels as kernels
from lerobot_vtrefine.sim.backends.warp_constraint import add_contact_rows, rows_without_contacts
from lerobot_vtrefine.sim.backends.warp_solve import solve

APART = 32
"""Threads of a warp."""
WARPS = 2048
"""Which share the pairs for the general convex collision. Parts of meshes have thirty pairs a world, in two
thirds of the time that one pair for each warp takes, whose registers leave room for few warps at once."""
NET_FORCE = 3
DATA = 1 | 2 | 4 | 16
"""found, force, torque, position of mjtConDataField."""


class WarpStep:
    """Steps all worlds of `data` by one substep.

    Args:
        host: the model as MuJoCo has it.
        model, data: the same on the device.
        idle: (N,) int, 1 where a world's state does not matter.
        concurrent: whether to use several streams; only a GPU has them.

    Raises:
        ValueError: sensors other than net forces of contacts between geoms and bodies; servos or tendons on
            anything but joints.
    """

    def __init__(
        self, host: mujoco.MjModel, model: mjw.Model, data: mjw.Data, idle: wp.array, concurrent: bool
    ) -> None:
        self._model, self._data, self._idle = model, data, idle
        names = ("bias", "forces", "rows", "convex") if concurrent else ()
        self._streams = {name: wp.Stream(wp.get_device()) for name in names}
        own, other = _sides(host)
        _check_servos(host)
        self._heavy_tendons = any(
            item.numpy().any() for item in (model.tendon_armature, model.actuator_armature)
        )
        self._own, self._other = wp.array(own, dtype=int), wp.array(other, dtype=int)
        self._addresses = wp.array(host.sensor_adr.astype(np.int32), dtype=int)
        shape = (data.nworld, host.nsensor)
        self._sums = kernels.Sums()
        for name, dtype in SUMS.items():
            setattr(self._sums, name, wp.zeros(shape, dtype=dtype))
        self._derivative = wp.zeros((data.nworld, model.nC), dtype=float)
        kinds = 1 + max(int(kind) for pair in KINDS for kind in pair)
        general = np.zeros((kinds, kinds), np.int32)
        general[tuple(np.transpose(CONVEX))] = 1
        self._general = wp.array(general, dtype=int)
        self._apart = wp.zeros(data.geom_xpos.shape, dtype=wp.vec3)
        self._has_convex = any(_count(model, pair) for pair in CONVEX)
        box = int(np.flatnonzero(host.geom_type == mujoco.mjtGeom.mjGEOM_BOX)[0])
        self._box = wp.vec2i(box, box)  # no pair for the general collision
        spread = collision_driver.create_collision_context(data.naconmax)
        self._spread = _pairs(spread, wp.zeros(2, dtype=int))
        self._warps = max(1, min(WARPS, data.naconmax // APART))
        self._left = _pairs(collision_driver.create_collision_context(data.naconmax), wp.zeros(1, dtype=int))

    def __call__(self) -> None:
        """Launch the step's kernels on the present device."""
        model, data = self._model, self._data
        with self._beside("convex"):
            self._clear_pairs()
        with self._beside("rows"):
            mjw.tendon(model, data)
            with self._beside("forces"):
                self._transmit()
        mjw.kinematics(model, data)
        with self._beside("rows"):
            mjw.com_pos(model, data)
            with self._beside("bias"):
                self._bias()
            with self._beside("forces"):
                self._smooth_forces()
            mjw.crb(model, data)
            if self._heavy_tendons:
                smooth.tendon_armature(model, data)
            rows_without_contacts(model, data)
        self._join("convex")
        self._collide()
        self._join("rows")
        add_contact_rows(model, data)
        self._join("forces")
        with self._beside("forces"):
            self._differentiate()
        solve(model, data)
        with self._beside("rows"):
            self._read_contacts()
        self._join("forces")
        self._integrate()
        self._join("rows")

    @contextmanager
    def _beside(self, name: str) -> Generator[None]:
        """Work on a stream of this name, from here on and until `_join`."""
        if not self._streams:
            yield
            return
        with wp.ScopedStream(self._streams[name], sync_enter=True):
            yield

    def _join(self, name: str) -> None:
        if self._streams:
            wp.wait_stream(self._streams[name])

    def _transmit(self) -> None:
        """Lengths and velocities of servos and tendons."""
        model, data = self._model, self._data
        mjw.transmission(model, data)
        servos = [data.qvel, data.moment_rownnz, data.moment_rowadr, data.moment_colind, data.actuator_moment]
        dim = (data.nworld, model.nactuator)
        wp.launch(forward._actuator_velocity, dim, servos, [data.actuator_velocity])
        tendons = [model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind, data.qvel, data.ten_J]
        wp.launch(forward._tendon_velocity, (data.nworld, model.ntendon), tendons, [data.ten_velocity])

    def _bias(self) -> None:
        """Velocities of bodies, and the forces that follow from them and from gravity."""
        model, data = self._model, self._data
        mjw.com_vel(model, data)
        mjw.rne(model, data)
        if self._heavy_tendons:
            smooth.tendon_bias(model, data, data.qfrc_bias)

    def _smooth_forces(self) -> None:
        """All forces but those of constraints."""
        model, data = self._model, self._data
        mjw.passive(model, data)
        mjw.fwd_actuation(model, data)
        self._join("bias")
        mjw.fwd_acceleration(model, data)

    def _differentiate(self) -> None:
        """What the integrator solves with: inertia, and how forces change with velocities."""
        model, data = self._model, self._data
        mjw.deriv_smooth_vel(model, data, self._derivative)
        free = [model.body_dofadr, model.M_rownnz, model.M_rowadr, model.body_freeadr, data.M]
        count = (data.nworld, model.body_freeadr.size)
        wp.launch(forward._implicit_free_body_reset_m, count, free, [self._derivative])

    def _clear_pairs(self) -> None:
        """Before the search for contacts."""
        for count in (self._data.ncollision, self._data.nacon, self._left.count, self._spread.count):
            count.zero_()
        if self._has_convex:
            self._spread.geoms.fill_(self._box)

    def _collide(self) -> None:
        """Contacts, as `mujoco_warp.collision` finds them."""
        model, data = self._model, self._data
        context = collision_driver.create_collision_context(data.naconmax)
        wp.launch(
            kernels.take_apart, self._apart.shape, [model.geom_type, self._idle, data.geom_xpos, self._apart]
        )
        mjw.nxn_broadphase(model, dataclasses.replace(data, geom_xpos=self._apart), context)
        left = self._left
        given = [_shapes(model), data.geom_xpos, data.geom_xmat, _pairs(context, data.ncollision)]
        wp.launch(kernels.drop_separated, data.naconmax, [*given, left])
        with self._beside("convex"):
            if self._has_convex:
                self._collide_convex(context)
        counted = dataclasses.replace(data, ncollision=left.count)
        collision_driver.primitive_narrowphase(model, counted, _context(context, left), PRIMITIVE)
        self._join("convex")

    def _collide_convex(self, context: collision_driver.CollisionContext) -> None:
        """The general collision, which takes one thread a quarter of a millisecond: few share a warp."""
        model, data, spread = self._model, self._data, self._spread
        given = [self._left, model.geom_type, self._general, APART, self._warps, spread]
        wp.launch(kernels.spread_general, data.naconmax, given)
        counted = dataclasses.replace(data, ncollision=spread.count)
        collision_driver.convex_narrowphase(model, counted, _context(context, spread), CONVEX)

    def _read_contacts(self) -> None:
        """Contact sensors, as `mujoco_warp.sensor_acc` reads them."""
        data, contacts = self._data, kernels.Contacts()
        for name, field in CONTACTS.items():
            setattr(contacts, name, getattr(data.contact, field))
        contacts.force, contacts.count = data.efc.force, data.nacon
        wp.launch(kernels.add_forces, data.naconmax, [contacts, self._own, self._other, self._sums])
        dim = (data.nworld, self._addresses.size)
        wp.launch(kernels.finish_forces, dim, [self._sums, self._addresses, data.sensordata])

    def _integrate(self) -> None:
        """`mujoco_warp.implicit` with the derivative that `_differentiate` has prepared."""
        model, data = self._model, self._data
        factor, diagonal = wp.empty_like(data.qLD), wp.empty((data.nworld, model.nv), dtype=float)
        qacc = wp.empty((data.nworld, model.nv), dtype=float)
        smooth.factor_solve_i(model, data, self._derivative, factor, diagonal, qacc, data.efc.Ma)
        forward.implicit_free_body(model, data, data.efc.Ma, qacc, solve=True)
        forward._advance(model, data, qacc)


KINDS = collision_driver.MJ_COLLISION_TABLE | {(mjw.GeomType.BOX, mjw.GeomType.BOX): CollisionType.PRIMITIVE}
CONVEX = [pair for pair, kind in KINDS.items() if kind == CollisionType.CONVEX]
PRIMITIVE = [pair for pair, kind in KINDS.items() if kind == CollisionType.PRIMITIVE]
"""Kinds of geoms for the general convex collision and for closed forms: boxes as `WarpWorlds` wants them."""

SUMS = {"found": float, "weight": float, "force": wp.vec3, "torque": wp.vec3, "pos": wp.vec3}
CONTACTS = {
    "kind": "type",
    "world": "worldid",
    "geoms": "geom",
    "frame": "frame",
    "pos": "pos",
    "dim": "dim",
    "row": "efc_address",
}
"""Fields of `kernels.Contacts` by their names in mujoco_warp."""


def _context(
    context: collision_driver.CollisionContext, pairs: kernels.Pairs
) -> collision_driver.CollisionContext:
    own = {"collision_pair": pairs.geoms, "collision_pairid": pairs.ids, "collision_worldid": pairs.world}
    return dataclasses.replace(context, **own)


def _pairs(context: collision_driver.CollisionContext, count: wp.array) -> kernels.Pairs:
    pairs = kernels.Pairs()
    pairs.geoms, pairs.ids = context.collision_pair, context.collision_pairid
    pairs.world, pairs.count = context.collision_worldid, count
    return pairs


def _shapes(model: mjw.Model) -> kernels.Shapes:
    shapes = kernels.Shapes()
    shapes.kind, shapes.size, shapes.margin = model.geom_type, model.geom_size, model.geom_margin
    shapes.mesh, shapes.vertices = model.geom_dataid, model.mesh_vert
    shapes.mesh_first, shapes.mesh_count = model.mesh_vertadr, model.mesh_vertnum
    return shapes


def _sides(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Which geoms the two sides of each contact sensor are: (S, G) int32 of 0 and 1 each."""
    own, other = np.zeros((2, model.nsensor, model.ngeom), np.int32)
    for sensor in range(model.nsensor):
        spec = tuple(model.sensor_intprm[sensor][:3])
        if model.sensor_type[sensor] != mujoco.mjtSensor.mjSENS_CONTACT or spec != (DATA, NET_FORCE, 1):
            raise ValueError(f"sensor {model.sensor(sensor).name!r} is not a net force of contacts")
        own[sensor] = _geoms(model, model.sensor_objtype[sensor], model.sensor_objid[sensor])
        other[sensor] = _geoms(model, model.sensor_reftype[sensor], model.sensor_refid[sensor])
    return own, other


def _check_servos(model: mujoco.MjModel) -> None:
    """What moves by joints alone is known before the bodies' poses are."""
    kinds = {int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_TENDON)}
    if not kinds.issuperset(model.actuator_trntype) or (model.wrap_type != mujoco.mjtWrap.mjWRAP_JOINT).any():
        raise ValueError("servos and tendons must act on joints")


def _count(model: mjw.Model, pair: tuple[int, int]) -> int:
    """How many pairs of geoms of these two kinds may touch."""
    return model.geom_pair_type_count[upper_trid_index(len(mjw.GeomType), *map(int, pair))]


def _geoms(model: mujoco.MjModel, kind: int, number: int) -> np.ndarray:
    """Which geoms (G,) an object is; all for none."""
    if kind == mujoco.mjtObj.mjOBJ_UNKNOWN:
        return np.ones(model.ngeom, bool)
    if kind == mujoco.mjtObj.mjOBJ_GEOM:
        return np.arange(model.ngeom) == number
    if kind == mujoco.mjtObj.mjOBJ_BODY:
        return model.geom_bodyid == number
    raise ValueError(f"contact sensors between {mujoco.mjtObj(kind).name} are not supported")
