"""Video frames of single environments through the simulator's renderer, made on first use."""

from typing import TYPE_CHECKING

from lerobot_vtrefine.envs.episodes import Array

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.render import VideoRenderer
    from lerobot_vtrefine.sim.simulation import InsertionSim


class FrameSource:
    """One renderer per environment that was ever asked for a frame."""

    def __init__(self, sim: "InsertionSim") -> None:
        self._sim = sim
        self._renderers: dict[int, VideoRenderer] = {}

    def frame(self, index: int) -> Array:
        """uint8 (H, W, 3) frame of environment ``index``."""
        if index not in self._renderers:
            from lerobot_vtrefine.sim.render import VideoRenderer

            self._renderers[index] = VideoRenderer(self._sim, index)
        return self._renderers[index].frame()

    def close(self) -> None:
        """Free the rendering contexts."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers = {}
