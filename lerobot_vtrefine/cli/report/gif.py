"""Small looping GIFs in few colours, among which the rare ones of an outcome survive."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

LAST_MS = 1500
"""How long the last picture of an episode rests."""


def write_gif(episodes: Sequence[Sequence[Image.Image]], frame_ms: int, target: Path) -> None:
    """A looping GIF that rests at the end of every episode; pictures of one size, ``frame_ms`` ms each."""
    # An outcome's colour is that of few pixels, and only at the end.
    shown = [frames[at] for frames in episodes for at in (len(frames) // 2, -1)]
    whole = Image.fromarray(np.concatenate([np.asarray(frame) for frame in shown]))
    palette = whole.quantize(256, Image.Quantize.MAXCOVERAGE)
    images = [
        frame.quantize(palette=palette, dither=Image.Dither.NONE) for frames in episodes for frame in frames
    ]
    durations = [duration for frames in episodes for duration in [*[frame_ms] * (len(frames) - 1), LAST_MS]]
    target.parent.mkdir(parents=True, exist_ok=True)
    images[0].save(target, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True)
