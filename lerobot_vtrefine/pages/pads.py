"""Pads on pages: one colour map, row 0 at the top, column 0 (the fingertip) at the left, and its scale."""

import base64
import io
from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image

COLOUR_MAP = "viridis"
DIVERGING = "RdBu_r"
GAP_TAXELS = 2
SCALE_STEPS = 64


def encode(content: bytes, mime: str) -> str:
    """Bytes as a ``data:`` URI."""
    return f"data:{mime};base64,{base64.b64encode(content).decode('ascii')}"


def pad_image(values: NDArray, top: float, *, diverging: bool = False) -> str:
    """Readings (R, C) from 0 to ``top``, or -``top`` to ``top``, as a PNG data URI, a pixel per taxel."""
    level = np.nan_to_num(values) / max(top, 1e-12)
    level = 0.5 + 0.5 * level if diverging else level
    shades = colormaps[DIVERGING if diverging else COLOUR_MAP](np.clip(level, 0, 1), bytes=True)[..., :3]
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(shades)).save(buffer, "PNG")
    return encode(buffer.getvalue(), "image/png")


def pad_film(sides: Sequence[NDArray], top: float, frame_s: float) -> str:
    """Readings (T, R, C) of several sources side by side as a looping GIF data URI, a pixel per taxel.

    All share one scale from 0 to ``top``; a black gap lies between them.
    """
    levels = [np.clip(255 * np.nan_to_num(side) / max(top, 1e-12), 1, 255).astype(np.uint8) for side in sides]
    gap = np.zeros((*levels[0].shape[:2], GAP_TAXELS), np.uint8)
    joined = np.concatenate([part for level in levels for part in (gap, level)][1:], axis=2)
    palette = colormaps[COLOUR_MAP](np.linspace(0, 1, 256), bytes=True)[:, :3]
    palette[0] = 0
    images = [Image.fromarray(frame, "P") for frame in joined]
    for image in images:
        image.putpalette(palette.tobytes())
    buffer = io.BytesIO()
    duration = max(20, round(1000 * frame_s))
    images[0].save(buffer, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0)
    return encode(buffer.getvalue(), "image/gif")


def colour_scale(top: float, unit: str) -> str:
    """The colour map as a bar with its ends named, as HTML."""
    bar = pad_image(np.linspace(0, 1, SCALE_STEPS)[None, :], 1.0)
    return (
        f'<span class="scale"><span>0</span><img src="{bar}" alt="colour scale from 0 to {top:.3g} {unit}">'
        f"<span>{top:.3g} {unit}</span></span>"
    )
