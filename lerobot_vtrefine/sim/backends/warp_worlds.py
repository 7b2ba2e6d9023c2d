"""Worlds of one model on mujoco_warp: step, and nothing else. Imports warp and mujoco_warp.

Shapes: N worlds, K substeps, nq positions, nv velocities, nu servos, ns sensor readings.
"""

import copy
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from mujoco_warp._src import collision_convex as convex

from lerobot_vtrefine.sim.backends import warp_kernels as kernels
from lerobot_vtrefine.sim.backends.warp_edges import try_both_edges
from lerobot_vtrefine.sim.backends.warp_memory import Arena, Recording, record
from lerobot_vtrefine.sim.backends.warp_step import WarpStep
from lerobot_vtrefine.sim.config import WarpConfig
from lerobot_vtrefine.sim.patience import told_if_slow
from lerobot_vtrefine.tactile.contact_query import start_warp

CONTACTS, ROWS, CONVEX = "contacts_per_world", "rows_per_world", "convex_per_world"
OVERFLOWS = {
    mjw.OverflowType.NEFC: ("constraint rows", ROWS),
    mjw.OverflowType.NJMAX_NNZ: ("entries of the constraint Jacobian", ROWS),
    mjw.OverflowType.BROADPHASE: ("pairs of geoms that may touch", CONTACTS),
    mjw.OverflowType.NARROWPHASE: ("contacts", CONTACTS),
    mjw.OverflowType.CCD: ("contacts of convex shapes", CONVEX),
    mjw.OverflowType.CONTACT_MATCH: ("contacts of one contact sensor", ROWS),
    mjw.OverflowType.EPA_HORIZON: ("edges while measuring a penetration", None),
}
"""Buffers that can be too small -> what they hold and the setting that sizes them. mujoco_warp says so of
each world, but of all worlds where they share the buffer (pairs of geoms, contacts).
"""
LOSSES = sum(int(flag) for flag in OVERFLOWS)


LONGEST = 40
"""Substeps in one graph: those of a control step. Launches of their own would leave gaps between them."""
SIMPLEX = 5
"""Vertices with which the search for a penetration begins at most; it adds one an iteration."""
COMPILING = "compiling kernels, once on this machine: a minute or two, about five for parts of meshes"
SHARED = {CONTACTS: 4096, CONVEX: 1024}
"""Least room that worlds share, however few: on average they need little, but each at its worst, and episodes
that start together come to it together. Pushed down its bore, a pin of 00446 makes up to 631 contacts of 175
pairs of pieces; five such worlds fit. All of it takes 9 MB.
"""
LEAST_ROWS = 3
"""Rows of constraints that a contact takes at least: no contact sensor can match more contacts than fit."""


def choose_device(name: str) -> str:
    """Torch device for `WarpConfig.device`.

    Raises:
        ValueError: a GPU is asked for and there is none.
    """
    start_warp()
    if name == "auto":
        return "cuda:0" if wp.is_cuda_available() else "cpu"
    if name != "cpu" and not wp.is_cuda_available():
        raise ValueError(f"warp.device = {name!r}: no CUDA GPU with a driver here; use cpu or auto")
    return str(wp.get_device(name).alias)


def with_shared_room(config: WarpConfig, num_envs: int) -> WarpConfig:
    """Settings with which so many worlds share what `SHARED` says at least."""
    shares = {name: -(-room // num_envs) for name, room in SHARED.items()}
    return replace(config, **{name: max(getattr(config, name), share) for name, share in shares.items()})


class WarpWorlds:
    """N worlds; every array is a torch view of mujoco_warp's own memory.

    Args:
        model: compiled scene.
        num_envs: N.
        config: device and sizes of the buffers.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, config: WarpConfig) -> None:
        self.device = choose_device(config.device)
        self.num_envs = num_envs
        self._config = config = with_shared_room(config, num_envs)
        with wp.ScopedDevice(self.device):
            self.model = mjw.put_model(_with_primitive_boxes(model))
            _set_options(self.model, config)
            try_both_edges()
            _make_room_for_edges(model.opt.ccd_iterations)
            self.data = mjw.make_data(
                model,
                num_envs,
                nconmax=config.contacts_per_world,
                nccdmax=min(config.convex_per_world, config.contacts_per_world),
                njmax=config.rows_per_world,
            )
            self._idle = wp.zeros(num_envs, dtype=int)
            self.idle = wp.to_torch(self._idle)
            self.step: Callable[[], None]
            if config.solver == "stock":
                self.step = partial(mjw.step, self.model, self.data)
            else:
                self.step = WarpStep(model, self.model, self.data, self._idle, wp.get_device().is_cuda)
        data = self.data
        self.qpos, self.qvel = wp.to_torch(data.qpos), wp.to_torch(data.qvel)
        self.warmstart, self.time = wp.to_torch(data.qacc_warmstart), wp.to_torch(data.time)
        self.sensors, self.overflow = wp.to_torch(data.sensordata), wp.to_torch(data.overflow)
        self._diverged = wp.zeros(num_envs, dtype=int, device=self.device)
        self.diverged, self.lost = wp.to_torch(self._diverged), torch.zeros_like(self.overflow)
        self._widths = (model.nq, model.nsensordata, model.nu)
        self._recorded: dict[tuple[str, int], Recording] = {}
        self._arena: Arena | None = None
        self._everyone = torch.arange(num_envs, dtype=torch.int32, device=self.device)
        self._capture = config.graph and _can_capture(self.device)
        self._posed = self._compiled = False
        self._reserve(1)

    def _reserve(self, substeps: int) -> None:
        """Room for the trace and the commands of so many substeps."""
        positions, readings, servos = self._widths
        shape = (self.num_envs, substeps)
        self._trace = kernels.Trace()
        self._trace.cursor = wp.zeros(1, dtype=int, device=self.device)
        self._trace.qpos = wp.zeros((*shape, positions), dtype=float, device=self.device)
        self._trace.sensors = wp.zeros((*shape, readings), dtype=float, device=self.device)
        self.controls = wp.zeros((*shape, servos), dtype=float, device=self.device)
        self._room = substeps
        self._recorded.clear()

    def reserve(self, substeps: int) -> None:
        """Make room for `substeps` where there is less."""
        if substeps > self._room:
            self._reserve(substeps)

    def run(self, substeps: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Step all worlds with `controls`.

        Returns:
            Views of positions (N, K, nq) and readings (N, K, ns), valid until the next call.
        """
        self.moved()
        self._trace.cursor.fill_(-1)
        self.overflow.zero_()
        notice = nullcontext() if self._compiled else told_if_slow(COMPILING)
        with notice, wp.ScopedDevice(self.device):
            self._do("substep", self._substep, substeps)
            self._guard()
        self._compiled = True
        self.lost |= self.overflow & LOSSES
        trace = self._trace
        return wp.to_torch(trace.qpos)[:, :substeps], wp.to_torch(trace.sensors)[:, :substeps]

    def _do(self, what: str, work: Callable[[], None], times: int) -> None:
        """Do some work so many times, by graphs where there can be any."""
        if not self._capture:
            for _ in range(times):
                work()
            return
        longest = LONGEST if wp.get_device(self.device).is_cuda else 1
        for count in [longest] * (times // longest) + [times % longest]:
            if (what, count) in self._recorded:
                self._recorded[what, count].launch()
            elif count:
                recording = record(work, count, wp.get_device(), self._arena)
                self._recorded[what, count], self._arena = recording, recording.arena

    def _substep(self) -> None:
        data, trace = self.data, self._trace
        positions, readings, servos = self._widths
        self._guard()
        commands = [trace.cursor, self.controls]
        wp.launch(kernels.give_controls, (self.num_envs, servos), commands, [data.ctrl])
        self.step()
        kept = [data.qpos, data.sensordata, trace]
        wp.launch(kernels.record, (self.num_envs, positions + readings), kept)

    def _guard(self) -> None:
        data = self.data
        state = [self.model.qpos0, data.qpos, data.qvel, data.qacc_warmstart]
        wp.launch(kernels.guard, self.num_envs, [*state, self._diverged, self._trace.cursor])

    def complaints(self, flags: int) -> list[str]:
        """A line for each bit set of `mjw.OverflowType` that means lost contacts."""
        lines = []
        for flag, (what, setting) in OVERFLOWS.items():
            if flags & int(flag):
                remedy = (
                    f"; raise --env.warp.{setting} (now {getattr(self._config, setting)})" if setting else ""
                )
                lines.append(
                    f"mujoco_warp ran out of room for {what} and lost contacts: the episodes concerned end as"
                    f" failures of the kind 'overflow'{remedy}"
                )
        return lines

    def index(self, ids: np.ndarray) -> torch.Tensor:
        """World numbers (m,), sorted, int32 on the device."""
        if len(ids) == self.num_envs:
            return self._everyone
        return torch.as_tensor(np.ascontiguousarray(ids, np.int32), device=self.device)

    def set_field(self, name: str, ids: torch.Tensor, values: torch.Tensor) -> None:
        """Give worlds their own values (m, ...) of a model field; call `derive` afterwards."""
        view = wp.to_torch(self._own_field(name))
        view[ids] = values.to(view).reshape(len(ids), *view.shape[1:])

    def derive(self) -> None:
        """Recompute the constants that follow from model fields."""
        self.moved()
        with wp.ScopedDevice(self.device):
            for name in DERIVED:
                self._own_field(name)
            mjw.set_const(self.model, self.data, restore=False)

    def _own_field(self, name: str) -> wp.array:
        """A model field with one row per world."""
        shared = getattr(self.model, name)
        if len(shared) == self.num_envs and shared.strides[0] != 0:
            return shared
        with wp.ScopedDevice(self.device):
            own = wp.from_torch(
                wp.to_torch(shared)[:1].repeat(self.num_envs, *[1] * (wp.to_torch(shared).ndim - 1)),
                dtype=shared.dtype,
            )
        setattr(self.model, name, own)
        self._recorded.clear()
        return own

    def moved(self) -> None:
        """Say that the state was changed from outside, so that poses must be computed anew."""
        self._posed = False

    def kinematics(self) -> None:
        """Bring poses and velocities of bodies and geoms up to the present state."""
        if self._posed:
            return
        self._posed = True
        with wp.ScopedDevice(self.device):
            self._do("kinematics", self._kinematics, 1)

    def _kinematics(self) -> None:
        mjw.kinematics(self.model, self.data)
        mjw.com_pos(self.model, self.data)
        mjw.com_vel(self.model, self.data)


DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "geom_aabb", "geom_rbound")
"""Fields that `mjw.set_const` writes and that may differ between worlds."""


def _with_primitive_boxes(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy that makes mujoco_warp collide boxes as MuJoCo does: up to 8 contacts instead of 4.

    With 4 the contacts' centre, and so the pads' reading, lies up to 6 mm elsewhere. mujoco_warp uses the
    flag for nothing else.
    """
    own = copy.copy(model)
    own.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
    return own


def _set_options(model: mjw.Model, config: WarpConfig) -> None:
    model.opt.warn_overflow = 0  # the flags are read after every call; printing would stall a GPU
    model.opt.contact_sensor_maxmatch = config.rows_per_world // LEAST_ROWS
    model.opt.run_qacc_smooth = False  # Newton's method starts from the last step's accelerations anyway
    if wp.get_device().is_cuda:
        model.opt.graph_conditional = wp.is_conditional_graph_supported()


def _make_room_for_edges(iterations: int) -> None:
    """Room for the edges that a new vertex sees: a convex polytope of V vertices has 3 V - 6 edges in all.
    mujoco_warp sets aside 24, which a round plug in its hole has needed more of.
    """
    edges = 3 * (SIMPLEX + iterations) - 6
    setattr(convex, "MJ_MAX_EPAHORIZON", max(convex.MJ_MAX_EPAHORIZON, edges))  # noqa: B010  no literal 24


def _can_capture(device: str) -> bool:
    """Whether substeps can become a graph: allocations inside one of CUDA's need the memory pool."""
    return not wp.get_device(device).is_cuda or wp.is_mempool_enabled(device)
