"""Video frames of single environments through the simulator's renderer, made on first use."""

from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.envs.episodes import Array, Episodes

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.render import VideoRenderer

BLANK_SHAPE = (16, 16, 3)


class FrameSource:
    """Draws the environments of ``episodes``; a frame is drawn again only after its environment moved."""

    def __init__(self, episodes: Episodes) -> None:
        self._episodes = episodes
        self._renderers: dict[int, VideoRenderer] = {}
        self._drawn: dict[int, tuple[tuple[int, int], Array]] = {}
        self._shape = BLANK_SHAPE

    def frame(self, index: int) -> Array:
        """uint8 (H, W, 3) frame of environment ``index``."""
        moment = (int(self._episodes.seeds[index]), int(self._episodes.steps[index]))
        if self._drawn.get(index, (None,))[0] != moment:
            frame = self._renderer(index).frame()
            self._drawn[index] = (moment, frame)
            self._shape = frame.shape
        return self._drawn[index][1]

    def blank(self) -> Array:
        """A black frame of the size of the frames drawn so far; starts no renderer."""
        return np.zeros(self._shape, np.uint8)

    def close(self) -> None:
        """Free the rendering contexts."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers, self._drawn = {}, {}

    def _renderer(self, index: int) -> "VideoRenderer":
        if index not in self._renderers:
            from lerobot_vtrefine.sim.render import VideoRenderer

            self._renderers[index] = VideoRenderer(self._episodes.sim, index)
        return self._renderers[index]
