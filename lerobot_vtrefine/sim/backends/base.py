"""What the simulation asks of a physics backend.

Shapes: N worlds of which m are addressed by sorted ids, K substeps, nq positions, nv velocities, nu servos.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.scene import Scene

Array = np.ndarray
Tensor = torch.Tensor
LOAD_SIZE = 5
"""What the solver says of a pad: normal force [N], its centre's x and y [m], tangential force on the pad
along x and y [N], in the pad's frame.
"""
TouchReader = Callable[[Array], tuple[tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor], Tensor, Tensor]]
"""ids (m,) -> positions, rotations, velocities of pads, the same of parts, and the two parts of the pads'
loads: normal forces and centres (m, 4, 3), tangential forces (m, 4, 2).
"""


@dataclass(frozen=True)
class Trace:
    """What happened during the substeps of one call; on the worlds' device, valid until the next call."""

    qpos: Array | Tensor
    """(m, K, nq) after each substep."""
    sensors: Array | Tensor
    """(m, K, ns) sensor readings, each one of the state before the substep (as MuJoCo leaves them)."""


class Backend(ABC):
    """N worlds of one model, each with its own state and, where asked, its own model fields."""

    num_envs: int
    device: str = "cpu"
    """Torch device on which sensors are computed."""

    @abstractmethod
    def read(self, ids: Array) -> tuple[Array, Array]:
        """Copies of positions (m, nq) and velocities (m, nv)."""

    def start_read(self, ids: Array) -> Callable[[], tuple[Array, Array]]:
        """Begin `read`, where it takes its time; what is returned waits for it."""
        state = self.read(ids)
        return lambda: state

    @abstractmethod
    def write(self, ids: Array, qpos: Array, qvel: Array) -> None:
        """Restart worlds at time 0 from positions (m, nq) and velocities (m, nv); forgets all else of their
        state.
        """

    @abstractmethod
    def advance(self, ids: Array, controls: Array) -> Trace:
        """Step worlds once per row of `controls` (m, K, nu)."""

    def advance_linearly(self, ids: Array, start: Array, stop: Array, substeps: int) -> Trace:
        """Step worlds with commands that move linearly from `start` to `stop` (m, nu), which the last one
        is.
        """
        return self.advance(ids, ramp(start, stop, substeps))

    @abstractmethod
    def geom_poses(self, ids: Array) -> tuple[Array, Array] | tuple[Tensor, Tensor]:
        """World positions (m, G, 3) and rotations (m, G, 3, 3) of all geoms at the present state; tensors on
        `device` where the worlds live there.
        """

    def touch_reader(self, scene: "Scene") -> TouchReader | None:
        """What reads poses and loads on `device`, where the worlds live there; None: the host has them."""
        return None

    @abstractmethod
    def set_fields(self, ids: Array, fields: dict[str, Array]) -> None:
        """Give worlds their own values (m, ...) of MjModel's fields; derived constants follow."""

    @abstractmethod
    def diverged(self, ids: Array) -> Array:
        """(m,) whether MuJoCo has given up on a world since it was last written."""

    def overflowed(self, ids: Array) -> Array:
        """(m,) whether a world has lost contacts since it was last written, for want of room for them."""
        return np.zeros(len(ids), bool)

    @abstractmethod
    def get_rows(self, ids: Array) -> Array:
        """The complete integration states of worlds, (m, S)."""

    @abstractmethod
    def set_rows(self, ids: Array, rows: Array) -> None:
        """Restore states (m, S) taken by `get_rows`."""

    @abstractmethod
    def instance(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of one world with all derived quantities, for rendering; not live."""


def ramp(start: Array, stop: Array, substeps: int) -> Array:
    """Linear interpolation of commands (m, nu) -> (m, substeps, nu), the last one being `stop`."""
    weight = (np.arange(substeps) + 1.0) / substeps
    return start[:, None] + weight[None, :, None] * (stop - start)[:, None]


BAD_STATE_WARNINGS = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
