"""Physics backends behind one interface."""

import mujoco

from lerobot_vtrefine.sim.backends.base import Backend, Trace
from lerobot_vtrefine.sim.backends.batch import BatchBackend
from lerobot_vtrefine.sim.backends.single import SingleBackend
from lerobot_vtrefine.sim.config import BACKENDS

__all__ = ["Backend", "Trace", "get_backend"]


def get_backend(name: str, model: mujoco.MjModel, num_envs: int, num_threads: int = 0) -> Backend:
    """Create `num_envs` worlds of `model`.

    Raises:
        ValueError: unknown backend, or one that is not built in.
    """
    if name == "single":
        return SingleBackend(model, num_envs)
    if name == "batch":
        return BatchBackend(model, num_envs, num_threads)
    if name == "warp":
        raise ValueError("backend 'warp' is not available in this version: use single or batch")
    raise ValueError(f"unknown backend {name!r}: use one of {', '.join(BACKENDS)}")
