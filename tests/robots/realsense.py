"""A stand-in for `pyrealsense2`: what LeRobot's RealSense camera calls, with one depth camera behind it."""

import itertools
import sys
import time
from dataclasses import dataclass
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

INTRINSICS = {"fx": 31.0, "fy": 33.0, "ppx": 15.25, "ppy": 11.75}


@dataclass
class FakeDepthCamera:
    """Depth that tells which frame it is: every pixel of frame n counts `first` + n, and one says its row."""

    width: int = 32
    height: int = 24
    fps: int = 60
    scale_m: float = 0.001
    first: int = 500

    def frame(self, number: int) -> np.ndarray:
        depth = np.full((self.height, self.width), self.first + number % 400, np.uint16)
        depth[:, 0] = np.arange(self.height)
        depth[0, :8] = 0
        return depth


def fake_sdk(camera: FakeDepthCamera) -> ModuleType:
    """A module with the SDK's names."""

    class Config:
        def enable_device(self, serial: str) -> None: ...
        def enable_stream(self, *_: object) -> None: ...

    stream = SimpleNamespace(
        fps=lambda: camera.fps,
        width=lambda: camera.width,
        height=lambda: camera.height,
        get_intrinsics=lambda: SimpleNamespace(width=camera.width, height=camera.height, **INTRINSICS),
    )
    device = SimpleNamespace(
        first_depth_sensor=lambda: SimpleNamespace(get_depth_scale=lambda: camera.scale_m)
    )
    profile = SimpleNamespace(
        get_stream=lambda kind: SimpleNamespace(as_video_stream_profile=lambda: stream),
        get_device=lambda: device,
    )

    class Pipeline:
        def __init__(self) -> None:
            self.numbers = itertools.count()

        def start(self, config: Config) -> Any:
            return profile

        def stop(self) -> None: ...

        def try_wait_for_frames(self, timeout_ms: int) -> tuple[bool, Any]:
            time.sleep(1 / camera.fps)
            depth = camera.frame(next(self.numbers))
            frame = SimpleNamespace(get_data=lambda: depth)
            return True, SimpleNamespace(get_depth_frame=lambda: frame)

    sdk: Any = ModuleType("pyrealsense2")
    sdk.config, sdk.pipeline = Config, Pipeline
    sdk.stream = SimpleNamespace(depth="depth", color="color")
    sdk.format = SimpleNamespace(z16="z16", rgb8="rgb8")
    return sdk


def plug_in(patch: pytest.MonkeyPatch, camera: FakeDepthCamera) -> None:
    """Lets LeRobot find the SDK and the camera."""
    from lerobot.cameras.realsense import camera_realsense

    sdk = fake_sdk(camera)
    patch.setitem(sys.modules, "pyrealsense2", sdk)
    patch.setattr(camera_realsense, "rs", sdk)
    patch.setattr(camera_realsense, "require_package", lambda *_, **__: None)


def camera_flag(camera: FakeDepthCamera, rotation: int = 0) -> str:
    """Value of --robot.cameras."""
    width, height = (camera.width, camera.height) if rotation in (0, 180) else (camera.height, camera.width)
    return (
        f"{{front: {{type: intelrealsense, serial_number_or_name: '123', width: {width}, height: {height}, "
        f"fps: {camera.fps}, use_rgb: false, use_depth: true, rotation: {rotation}}}}}"
    )
