"""A video of the twin while it replays an episode."""

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_vtrefine.datasets.features import Array
from lerobot_vtrefine.pages.pads import encode

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.simulation import InsertionSim


class TwinFilm:
    """Frames (H, W, 3) uint8 of world 0 of a simulation: the scene beside its pads, one per control step."""

    def __init__(self, sim: "InsertionSim", menagerie_dir: Path | None) -> None:
        from lerobot_vtrefine.sim.render import VideoRenderer

        self._renderer = VideoRenderer(sim, 0, menagerie_dir=menagerie_dir)
        self.frames: list[Array] = []

    def watch(self) -> None:
        """Take a frame; the simulation goes on as if nobody had looked."""
        self.frames.append(self._renderer.frame())

    def close(self) -> None:
        """Free the renderer; frames stay."""
        self._renderer.close()


def video_uri(frames: list[Array], fps: float) -> str:
    """Frames as an MP4 data URI, at `fps` frames per second."""
    from lerobot.utils.io_utils import write_video

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "twin.mp4"
        write_video(path, frames, round(fps))
        return encode(path.read_bytes(), "video/mp4")
