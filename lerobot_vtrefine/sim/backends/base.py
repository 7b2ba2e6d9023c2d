"""What the simulation asks of a physics backend.

Shapes: N worlds of which m are addressed by sorted ids, K substeps, nq positions, nv velocities, nu servos.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import mujoco
import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Trace:
    """What happened during the substeps of one call."""

    qpos: Array
    """(m, K, nq) after each substep."""
    sensors: Array
    """(m, K, ns) sensor readings, each one of the state before the substep (as MuJoCo leaves them)."""


class Backend(ABC):
    """N worlds of one model, each with its own state and, where asked, its own model fields."""

    num_envs: int

    @abstractmethod
    def read(self, ids: Array) -> tuple[Array, Array]:
        """Copies of positions (m, nq) and velocities (m, nv)."""

    @abstractmethod
    def write(self, ids: Array, qpos: Array, qvel: Array) -> None:
        """Restart worlds at time 0 from positions (m, nq) and velocities (m, nv); forgets all else of their
        state.
        """

    @abstractmethod
    def advance(self, ids: Array, controls: Array) -> Trace:
        """Step worlds once per row of `controls` (m, K, nu)."""

    @abstractmethod
    def geom_poses(self, ids: Array) -> tuple[Array, Array]:
        """World positions (m, G, 3) and rotations (m, G, 3, 3) of all geoms at the present state."""

    @abstractmethod
    def set_fields(self, ids: Array, fields: dict[str, Array]) -> None:
        """Give worlds their own values (m, ...) of MjModel's fields; derived constants follow."""

    @abstractmethod
    def diverged(self, ids: Array) -> Array:
        """(m,) whether MuJoCo has given up on a world since it was last written."""

    @abstractmethod
    def get_row(self, env: int) -> Array:
        """The complete integration state of one world."""

    @abstractmethod
    def set_row(self, env: int, row: Array) -> None:
        """Restore a state taken by `get_row`."""

    @abstractmethod
    def instance(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of one world with all derived quantities, for rendering; not live."""


BAD_STATE_WARNINGS = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
