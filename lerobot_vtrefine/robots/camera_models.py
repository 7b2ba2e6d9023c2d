"""Camera models that robots keep in their datasets, so that recorded depth can be turned into points.

Depth itself takes LeRobot's own way (uint16 images). LeRobot's RealSense camera hands out depth as the device
counts it and forgets intrinsics; both are read here from the device that is streaming.
"""

import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.datasets.features import CAMERA_PREFIX, OBS_PREFIX
from lerobot_vtrefine.lerobot_compat.arrays import ArraySpec

logger = logging.getLogger(__name__)

NO_NOISE = 0.0
"""Depth noise to add when the cloud is built: none, real depth has its own."""

MILLIMETRE_M = 1e-3
"""What LeRobot takes one count of a uint16 depth image for [m]."""

CAMERA = CAMERA_PREFIX.removeprefix(OBS_PREFIX)
"""What the names of a camera model's columns begin with."""

WIDTHS = {"intrinsics": 4, "pose": 7, "noise_level": 1}
"""Columns of one camera and their lengths."""

Observation = dict[str, Any]


@dataclass
class CameraModel:
    """Camera model kept in the dataset.

    Attributes:
        intrinsics: fx, fy, cx, cy of the recorded images [px]; read from the device where it is a RealSense.
        pose: x, y, z [m] and qw, qx, qy, qz of the optical frame (OpenCV) of the recorded images in the
            world, from hand-eye calibration.
    """

    intrinsics: list[float] = field(default_factory=list)
    pose: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        if len(self.intrinsics) not in (0, 4):
            raise ValueError(f"camera intrinsics must be [fx, fy, cx, cy], got {self.intrinsics}")
        if len(self.pose) != 7:
            raise ValueError(f"camera pose must be [x, y, z, qw, qx, qy, qz], got {self.pose}")
        if not np.isclose(np.linalg.norm(self.pose[3:]), 1.0, atol=1e-3):
            raise ValueError(f"camera pose must end in a unit quaternion [qw, qx, qy, qz], got {self.pose}")


class CameraModels:
    """The camera models of one robot: their features, their values, and depth in millimetres."""

    def __init__(self, models: dict[str, CameraModel], cameras: dict[str, Any]) -> None:
        """Raise ValueError where a model belongs to no camera; warn where a depth camera has no model."""
        if unknown := sorted(set(models) - set(cameras)):
            raise ValueError(
                f"--robot.camera_models names {', '.join(unknown)}, but the robot's cameras are: "
                f"{', '.join(cameras) or 'none'}"
            )
        depth = {name for name, camera in cameras.items() if getattr(camera, "use_depth", False)}
        pads = {name for name, camera in cameras.items() if getattr(camera.config, "type", "") == "flexitac"}
        for name in sorted(depth - pads - set(models)):
            logger.warning(
                "camera %s records depth without its model, so no points can be made of it: give "
                "--robot.camera_models='{%s: {pose: [x, y, z, qw, qx, qy, qz]}}'",
                name,
                name,
            )
        self._models, self._cameras = models, cameras
        self._values: Observation | None = None
        self._scales: dict[str, float] = {}

    @property
    def features(self) -> dict[str, ArraySpec]:
        """Constant columns of all models."""
        return {
            f"{CAMERA}{name}.{part}": ArraySpec((width,), "float32")
            for name in self._models
            for part, width in WIDTHS.items()
        }

    def connected(self) -> None:
        """Read what the devices know; to be called when the cameras are connected.

        Raises:
            ValueError: intrinsics are neither configured nor known to the device.
        """
        self._values = {}
        for name, model in self._models.items():
            camera = self._cameras[name]
            intrinsics = model.intrinsics or device_intrinsics(name, camera)
            self._values[f"{CAMERA}{name}.intrinsics"] = np.array(intrinsics, np.float32)
            self._values[f"{CAMERA}{name}.pose"] = np.array(model.pose, np.float32)
            self._values[f"{CAMERA}{name}.noise_level"] = np.array([NO_NOISE], np.float32)
            self._scales[name] = depth_scale_m(camera)

    def observe(self, observation: Observation) -> Observation:
        """The observation with the models' values, and with depth in millimetres.

        Raises:
            RuntimeError: `connected` was not called.
        """
        if self._values is None:
            raise RuntimeError("the camera models are read when the cameras are connected")
        completed = observation | self._values
        for name, scale_m in self._scales.items():
            key = f"{name}_depth"
            if key in completed:
                completed[key] = to_millimetres(completed[key], scale_m)
        return completed


def to_millimetres(depth: NDArray[np.uint16], scale_m: float) -> NDArray[np.uint16]:
    """Depth, uint16 (H, W, 1), of counts of `scale_m` metres, in millimetres; 0 stays "no return"."""
    if np.isclose(scale_m, MILLIMETRE_M, rtol=1e-4):
        return depth
    return np.clip(np.rint(depth * (scale_m / MILLIMETRE_M)), 0, np.iinfo(np.uint16).max).astype(np.uint16)


def depth_scale_m(camera: Any) -> float:
    """Metres per count of a camera's depth: what a RealSense says, otherwise LeRobot's millimetre."""
    profile = getattr(camera, "rs_profile", None)
    if profile is None:
        return MILLIMETRE_M
    return float(profile.get_device().first_depth_sensor().get_depth_scale())


def device_intrinsics(name: str, camera: Any) -> list[float]:
    """fx, fy, cx, cy of a connected RealSense's depth images as LeRobot hands them out [px].

    Raises:
        ValueError: the camera is not a RealSense.
    """
    profile = getattr(camera, "rs_profile", None)
    if profile is None:
        raise ValueError(
            f"intrinsics of camera {name!r} are unknown to the device; "
            f"give them: --robot.camera_models='{{{name}: {{intrinsics: [fx, fy, cx, cy], pose: [...]}}}}'"
        )
    import pyrealsense2  # ty: ignore[import-not-found]  (installed with the camera)

    stream = profile.get_stream(pyrealsense2.stream.depth).as_video_stream_profile()
    model = stream.get_intrinsics()
    turn = int(getattr(camera.config.rotation, "value", camera.config.rotation))
    return rotated_intrinsics([model.fx, model.fy, model.ppx, model.ppy], model.width, model.height, turn)


def rotated_intrinsics(intrinsics: list[float], width: int, height: int, turn_deg: int) -> list[float]:
    """fx, fy, cx, cy of an image after turning it clockwise.

    Args:
        intrinsics: fx, fy, cx, cy of the image of `width` x `height` pixels, pixel centres at integers [px].
        width: Width before turning [px].
        height: Height before turning [px].
        turn_deg: 0, 90, 180 or -90 (270), LeRobot's `rotation` of a camera.
    """
    fx, fy, cx, cy = intrinsics
    turned = {
        0: [fx, fy, cx, cy],
        90: [fy, fx, height - 1 - cy, cx],
        180: [fx, fy, width - 1 - cx, height - 1 - cy],
        270: [fy, fx, cy, width - 1 - cx],
    }
    return turned[turn_deg % 360]
