"""Tactile pads drawn as labelled heat maps, and the text beside a video frame (PIL and numpy only)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lerobot_vtrefine.tactile.layout import PadLayout

Frame = NDArray[np.uint8]

FULL_SCALE_COUNTS = 160  # counts above the idle level that get the brightest colour
_TAXEL_PX = 6
_TEXT_PX = 14
_GAP_PX = 6
_TEXT_WIDTH_PX = 160
_BACKGROUND = (24, 26, 32)
_INK = (226, 228, 232)
_GOOD, _BAD, _FAINT = (96, 214, 132), (240, 110, 96), (78, 82, 92)
_RING_PX = 4


@dataclass(frozen=True)
class Progress:
    """How far the episode is."""

    step: int
    seated_s: float
    """For how long the plug has been seated without interruption; NaN while it is not."""
    hold_s: float
    """Seated for this long is a success."""
    outcome: str = ""
    """How the episode ended; empty while it runs."""

    @property
    def held(self) -> float:
        """Share of the hold that is done, 0 to 1."""
        return min(self.seated_s / self.hold_s, 1.0) if self.hold_s > 0 and self.seated_s > 0 else 0.0


def panel_size(names: Sequence[str], layout: PadLayout) -> tuple[int, int]:
    """Return (height, width) in pixels of the panel for pads of these names and this layout."""
    height = len(names) * (layout.rows * _TAXEL_PX + _TEXT_PX + _GAP_PX) + 2 * _TEXT_PX + _GAP_PX
    return height, max(layout.cols * _TAXEL_PX, _TEXT_WIDTH_PX) + 2 * _GAP_PX


def pad_panel(
    counts: NDArray, baseline: NDArray, names: Sequence[str], layout: PadLayout, progress: Progress
) -> Frame:
    """Draw `counts` - `baseline`, both (pads, taxels) uint8, below each other, with the progress above.

    Row 0 of a pad is drawn at the top and column 0, the fingertip, on the left. Returns uint8 (H, W, 3).
    """
    height, width = panel_size(names, layout)
    image = Image.new("RGB", (width, height), _BACKGROUND)
    draw = ImageDraw.Draw(image)
    _draw_progress(draw, width, progress)
    top = 2 * _TEXT_PX + _GAP_PX
    for name, reading, idle in zip(names, counts, baseline, strict=True):
        above = np.clip(reading.astype(float) - idle, 0, None)
        draw.text((_GAP_PX, top), f"{_label(name)}   sum {above.sum():.0f}", fill=_INK)
        image.paste(
            Image.fromarray(_heat_map(above.reshape(layout.rows, layout.cols))), (_GAP_PX, top + _TEXT_PX)
        )
        top += layout.rows * _TAXEL_PX + _TEXT_PX + _GAP_PX
    return np.asarray(image)


def _label(name: str) -> str:
    """A short text for a pad's name: "left_arm_right_finger" -> "L arm, R finger"."""
    words = name.replace("left", "L").replace("right", "R").split("_")
    return f"{' '.join(words[:2])}, {' '.join(words[2:])}" if len(words) > 2 else name


def _draw_progress(draw: ImageDraw.ImageDraw, width: int, progress: Progress) -> None:
    """Step, and hold or outcome, in two lines; beside them a ring that fills while the plug is seated."""
    colour = _BAD if progress.outcome not in ("", "success") else _GOOD
    seated = f"seated {progress.seated_s:.1f} of {progress.hold_s:.1f} s" if progress.seated_s >= 0 else ""
    draw.text((_GAP_PX, _GAP_PX // 2), f"step {progress.step:3d}", fill=_INK)
    draw.text((_GAP_PX, _GAP_PX // 2 + _TEXT_PX), progress.outcome.upper() or seated, fill=colour)
    size = 2 * _TEXT_PX
    ring = (width - _GAP_PX - size, _GAP_PX // 2, width - _GAP_PX, _GAP_PX // 2 + size)
    draw.arc(ring, 0, 360, fill=_FAINT, width=_RING_PX)
    if progress.held > 0:
        draw.arc(ring, -90, -90 + 360 * progress.held, fill=colour, width=_RING_PX)


def _heat_map(above: NDArray) -> Frame:
    level = np.clip(above / FULL_SCALE_COUNTS, 0, 1) ** 0.5  # light touch must be visible too
    colours = _viridis()[(255 * level).astype(np.uint8)]
    return colours.repeat(_TAXEL_PX, axis=0).repeat(_TAXEL_PX, axis=1)


@cache
def _viridis() -> Frame:
    from matplotlib import colormaps  # slow to import, needed for videos only

    return (255 * colormaps["viridis"](np.linspace(0, 1, 256))[:, :3]).astype(np.uint8)
