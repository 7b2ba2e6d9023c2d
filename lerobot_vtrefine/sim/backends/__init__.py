"""Physics backends behind one interface."""

import importlib.metadata
import importlib.util
from contextlib import suppress

import mujoco

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.sim.backends.base import Backend, Trace
from lerobot_vtrefine.sim.backends.batch import BatchBackend
from lerobot_vtrefine.sim.backends.single import SingleBackend
from lerobot_vtrefine.sim.config import BACKENDS, WarpConfig

__all__ = ["Backend", "Trace", "get_backend"]

INSTALL = "pip install 'lerobot_policy_vtrefine[gpu]'"
RELEASE = "4.0."
"""Of mujoco_warp: `warp_step` builds a step of its own from functions of it that are not public."""


def get_backend(
    name: str, model: mujoco.MjModel, num_envs: int, num_threads: int = 0, warp: WarpConfig | None = None
) -> Backend:
    """Create `num_envs` worlds of `model`; `num_threads` is batch's, `warp` is warp's.

    Raises:
        ValueError: unknown backend, one that is not installed, or no GPU where one is asked for.
    """
    check_choice("backend", name, BACKENDS)
    if name == "single":
        return SingleBackend(model, num_envs)
    if name == "batch":
        return BatchBackend(model, num_envs, num_threads)
    _check_mujoco_warp()
    from lerobot_vtrefine.sim.backends.warp import WarpBackend  # seconds to import

    return WarpBackend(model, num_envs, warp or WarpConfig())


def _check_mujoco_warp() -> None:
    if importlib.util.find_spec("mujoco_warp") is None:
        raise ValueError(f"backend 'warp' needs mujoco_warp: {INSTALL}, or use single or batch")
    with suppress(importlib.metadata.PackageNotFoundError):  # where it was copied instead of installed
        found = importlib.metadata.version("mujoco-warp")
        if not found.startswith(RELEASE):
            raise ValueError(
                f"backend 'warp' knows mujoco_warp {RELEASE}x, not {found}: "
                f"pip install 'mujoco-warp=={RELEASE}*', or use single or batch"
            )
