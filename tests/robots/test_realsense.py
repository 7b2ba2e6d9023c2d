"""LeRobot's RealSense camera on our robots: depth in millimetres, with its intrinsics and pose."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from lerobot.cameras.configs import CameraConfig
from lerobot.cameras.realsense import RealSenseCameraConfig  # noqa: F401  (registers its type)
from lerobot.cameras.utils import make_cameras_from_configs
from realsense import INTRINSICS, FakeDepthCamera, camera_flag, plug_in

from lerobot_vtrefine.robots.camera_models import (
    CameraModel,
    CameraModels,
    rotated_intrinsics,
    to_millimetres,
)

POSE = [0.1, 0.2, 0.9, 0.0, 1.0, 0.0, 0.0]


def connected(patch: pytest.MonkeyPatch, camera: FakeDepthCamera, rotation: int = 0) -> dict[str, Any]:
    import draccus

    plug_in(patch, camera)
    settings = yaml.safe_load(camera_flag(camera, rotation))["front"]
    cameras = make_cameras_from_configs({"front": draccus.decode(CameraConfig, settings)})
    for one in cameras.values():
        one.connect(warmup=False)
    return cameras


def observed(cameras: dict[str, Any], model: CameraModel) -> dict[str, Any]:
    models = CameraModels({"front": model}, cameras)
    models.connected()
    cameras["front"].new_frame_event.wait(5.0)
    depth = cameras["front"].read_latest_depth()
    for camera in cameras.values():
        camera.disconnect()
    return models.observe({"front_depth": depth, "raw": depth})


def test_intrinsics_come_from_the_device_and_depth_is_untouched(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = FakeDepthCamera()
    seen = observed(connected(monkeypatch, camera), CameraModel(pose=POSE))
    assert seen["camera.front.intrinsics"].tolist() == list(INTRINSICS.values())
    assert seen["camera.front.pose"].tolist() == pytest.approx(POSE)
    assert seen["camera.front.noise_level"].tolist() == [0]
    assert seen["front_depth"].dtype == np.uint16
    assert seen["front_depth"].shape == (24, 32, 1)
    assert (seen["front_depth"] == seen["raw"]).all()


def test_configured_intrinsics_win(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = observed(connected(monkeypatch, FakeDepthCamera()), CameraModel([1, 2, 3, 4], POSE))
    assert seen["camera.front.intrinsics"].tolist() == [1, 2, 3, 4]


def test_tenths_of_a_millimetre_become_millimetres(monkeypatch: pytest.MonkeyPatch) -> None:
    """A D405 counts tenths of a millimetre, which LeRobot would store as millimetres."""
    seen = observed(connected(monkeypatch, FakeDepthCamera(scale_m=1e-4, first=5004)), CameraModel(pose=POSE))
    assert seen["raw"][5, 5, 0] >= 5004
    assert seen["front_depth"][5, 5, 0] == round(seen["raw"][5, 5, 0] / 10)
    assert seen["front_depth"][0, 3, 0] == 0
    assert to_millimetres(np.array([[[60000]]], np.uint16), 0.01)[0, 0, 0] == 65535


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
def test_intrinsics_turn_with_the_image(monkeypatch: pytest.MonkeyPatch, rotation: int) -> None:
    """The pixel that sees a point is where the turned image shows it, and the point turns with the frame."""
    camera = FakeDepthCamera()
    seen = observed(connected(monkeypatch, camera, rotation), CameraModel(pose=POSE))
    fx, fy, cx, cy = seen["camera.front.intrinsics"]
    column, row = 20, 7
    pixels = np.zeros((camera.height, camera.width))
    pixels[row, column] = 1
    turned = np.rot90(pixels, -rotation // 90 % 4)
    (turned_row,), (turned_column,) = np.nonzero(turned)
    before = np.array(
        [(column - INTRINSICS["ppx"]) / INTRINSICS["fx"], (row - INTRINSICS["ppy"]) / INTRINSICS["fy"]]
    )
    angle = np.deg2rad(rotation)
    clockwise = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])  # y points down
    after = np.array([(turned_column - cx) / fx, (turned_row - cy) / fy])
    assert after == pytest.approx(clockwise @ before, abs=1e-6)


def test_turning_four_times_changes_nothing() -> None:
    intrinsics = [1.0, 2.0, 3.0, 4.0]
    once = rotated_intrinsics(intrinsics, 32, 24, 90)
    assert rotated_intrinsics(once, 24, 32, -90) == intrinsics
    assert rotated_intrinsics(once, 24, 32, 90) == rotated_intrinsics(intrinsics, 32, 24, 180)


def test_wrong_models_are_explained(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unit quaternion"):
        CameraModel(pose=[0, 0, 1, 1, 1, 0, 0])
    with pytest.raises(ValueError, match="names top, but the robot's cameras are: none"):
        CameraModels({"top": CameraModel(pose=POSE)}, {})

    class Plain:
        use_depth = True
        config = None

    blind = CameraModels({"front": CameraModel(pose=POSE)}, {"front": Plain()})
    with pytest.raises(ValueError, match="intrinsics of camera 'front' are unknown"):
        blind.connected()
    with caplog.at_level(logging.WARNING):
        CameraModels({}, {"front": Plain()})
    assert "camera front records depth without its model" in caplog.text
