"""Tactile pads drawn as labelled heat maps, and the text beside a video frame (PIL and numpy only)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.picture import FULL_SCALE, colours

Frame = NDArray[np.uint8]

_TAXEL_PX = 6
_TEXT_PX = 14
_GAP_PX = 6
_TEXT_WIDTH_PX = 160
_SCALE_TAXELS = 12
BACKGROUND = (24, 26, 32)
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
    height = len(names) * (layout.rows * _TAXEL_PX + _TEXT_PX + _GAP_PX) + 3 * _TEXT_PX + _GAP_PX
    return height, max(layout.cols * _TAXEL_PX, _TEXT_WIDTH_PX) + 2 * _GAP_PX


def pad_panel(
    counts: NDArray, baseline: NDArray, names: Sequence[str], layout: PadLayout, progress: Progress
) -> Frame:
    """Draw `counts` above `baseline`, both (pads, taxels) uint8, below each other; above them the progress,
    below them what the colours mean.

    Row 0 of a pad is drawn at the top and column 0, the fingertip, on the left. Returns uint8 (H, W, 3).
    """
    height, width = panel_size(names, layout)
    image = Image.new("RGB", (width, height), BACKGROUND)
    draw = ImageDraw.Draw(image)
    _draw_progress(draw, width, progress)
    top = 2 * _TEXT_PX + _GAP_PX
    for name, reading, idle in zip(names, counts, baseline, strict=True):
        total = np.clip(reading.astype(float) - idle, 0, None).sum()
        draw.text((_GAP_PX, top), f"{_label(name)}   sum {total:.0f}", fill=_INK)
        picture = colours(*(value.reshape(layout.rows, layout.cols) for value in (reading, idle)))
        image.paste(_enlarged(picture), (_GAP_PX, top + _TEXT_PX))
        top += layout.rows * _TAXEL_PX + _TEXT_PX + _GAP_PX
    _draw_scale(image, draw, top)
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


def _draw_scale(image: Image.Image, draw: ImageDraw.ImageDraw, top: int) -> None:
    """The colours from none to the brightest, and its counts."""
    counts = np.linspace(0, FULL_SCALE, _SCALE_TAXELS).astype(np.uint8)[None]
    image.paste(_enlarged(colours(counts, np.zeros_like(counts))), (_GAP_PX, top + _TAXEL_PX // 2))
    draw.text((2 * _GAP_PX + _SCALE_TAXELS * _TAXEL_PX, top), f"{FULL_SCALE:.0f} counts", fill=_INK)


def _enlarged(picture: Frame) -> Image.Image:
    return Image.fromarray(picture.repeat(_TAXEL_PX, axis=0).repeat(_TAXEL_PX, axis=1))
