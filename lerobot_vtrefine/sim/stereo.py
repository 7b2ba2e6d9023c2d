"""A stereo camera's depth images, made of true depths where these lie."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import warp as wp

from lerobot_vtrefine.sim.camera import Camera
from lerobot_vtrefine.sim.depth_sensors import DepthSensor
from lerobot_vtrefine.sim.host import to_device
from lerobot_vtrefine.sim.stereo_kernels import FRACTION, Stereo, draw, match, read

Develop = Callable[[int, int, torch.Tensor, torch.Tensor], None]
"""Makes images (m, H, W) int16 [mm] of true depths (m, H, W) [m], in their place, for worlds begin..end."""


class StereoSensor:
    """A sensor in the place of a simulated camera, whose image is a part of the sensor's: of its pixels the
    nearest to each of the camera's rays, and nothing averaged.

    Raises:
        ValueError: the camera sees more than the sensor does.
    """

    def __init__(self, sensor: DepthSensor, camera: Camera, device: str) -> None:
        self._device = device
        spacing = sensor.focal_px / camera.fx
        _check_view(sensor, camera, spacing)
        self._figures = figures = Stereo()
        figures.pixel_metres, figures.nearest_m = sensor.pixel_metres, sensor.nearest_m
        figures.left_px = sensor.size_px[0] / 2 - 0.5 - camera.cx * spacing
        figures.spacing_px, figures.spacing = spacing, round(FRACTION * spacing)
        figures.window = round(FRACTION * sensor.window_px)
        figures.half_window = sensor.window_px / 2 / spacing
        figures.systematic_px, figures.edge = sensor.systematic_px, sensor.edge_px / spacing
        figures.fresh_px = sensor.noise_px * (1.0 - sensor.fixed_share) ** 0.5
        figures.fixed_px = sensor.noise_px * sensor.fixed_share**0.5
        figures.steps_per_px = float(sensor.steps_per_px)

    def start(self, moments: np.ndarray, height: int, width: int) -> Develop:
        """Make ready for images of worlds at `moments` (m, 2) int64: seed and control step."""
        when = wp.from_torch(to_device(np.ascontiguousarray(moments, np.int64), self._device))
        matched = torch.empty((len(moments), height, width), dtype=torch.float32, device=self._device)
        disparity, figures = wp.from_torch(matched), self._figures
        options: dict[str, Any] = {"device": self._device, "record_tape": False}

        def develop(begin: int, end: int, depth: torch.Tensor, pixels: torch.Tensor) -> None:
            rows = (end - begin, height)
            true = noise = wp.from_torch(depth)  # once it is matched, its room is free
            wp.launch(match, rows, [begin, true, figures, disparity], **options)
            wp.launch(draw, rows, [begin, when, figures, noise], **options)
            wp.launch(read, rows, [begin, when, disparity, noise, figures, wp.from_torch(pixels)], **options)

        return develop


def _check_view(sensor: DepthSensor, camera: Camera, spacing_px: float) -> None:
    sides = {"wide": camera.width, "high": camera.height}
    for (side, ours), theirs in zip(sides.items(), sensor.size_px, strict=True):
        ratio = ours * spacing_px / theirs
        if ratio > 1.0 + 1.0 / theirs:
            raise ValueError(
                f"scene.camera's view is {ratio:.2f} times as {side} as its depth_sensor's:"
                " give it a smaller fov_y_rad, or use depth_sensor=ideal"
            )
