"""What was computed from the worlds' state, or is being computed: forgotten when the state changes."""

from collections.abc import Callable

import numpy as np
import torch

from lerobot_vtrefine.sim.backends import Backend
from lerobot_vtrefine.sim.depth import DepthCamera
from lerobot_vtrefine.sim.kinematics import Kinematics
from lerobot_vtrefine.sim.scene import Scene

Array = np.ndarray


class StateCache:
    """Kinematics and depth images of a backend's worlds, m of them addressed by sorted ids."""

    def __init__(self, scene: Scene, backend: Backend, camera: DepthCamera) -> None:
        self._scene, self._backend, self._camera = scene, backend, camera
        self._seen: tuple[Array, Kinematics] | None = None
        self._coming: tuple[Array, Callable[[], torch.Tensor]] | None = None

    def forget(self) -> None:
        """To be called before any change of state, cameras or shapes."""
        self._seen = self._coming = None

    def see(self, ids: Array, state: tuple[Array, Array] | None = None) -> Kinematics:
        """Kinematics of worlds `ids`; `state` is what the backend's `read` would give now."""
        if self._seen is None or not np.array_equal(self._seen[0], ids):
            self._seen = ids, Kinematics(self._scene, *(state or self._backend.read(ids)))
        return self._seen[1]

    def start_images(self, ids: Array, moments: Array) -> None:
        """Begin the depth images of worlds `ids` at their moments (m, 2), for the next `images`."""
        self._coming = ids, self._camera.start_mm(ids, *self._backend.geom_poses(ids), moments)

    def images(self, ids: Array, moments: Array) -> torch.Tensor:
        """Depth images (m, H, W) int16 [mm] of worlds `ids` at their moments (m, 2), on their device."""
        if self._coming is None or not np.array_equal(self._coming[0], ids):
            self.start_images(ids, moments)
        assert self._coming is not None
        finish, self._coming = self._coming[1], None
        return finish()
