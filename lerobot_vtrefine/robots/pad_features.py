"""Pads and camera models as robot features: arrays that stock `lerobot-record` carries through."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.datasets.arrays import ArraySpec
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.pads_file import load_pads

PAD_AGE = "tactile_age"
"""Age of every pad's frame [s], in the order of the pads; beyond the pad's `stale_after_s` it is stale."""

NO_NOISE = 0.0
"""Depth noise to add when the cloud is built: none, real depth has its own."""

Observation = dict[str, Any]


@dataclass
class CameraModel:
    """Camera model kept in the dataset, so that depth can be turned into points.

    Attributes:
        intrinsics: fx, fy, cx, cy of the recorded images [px]; read from the device where it is a RealSense.
        pose: x, y, z [m] and qw, qx, qy, qz of the optical frame (OpenCV) in the world, from hand-eye
            calibration.
    """

    intrinsics: list[float] = field(default_factory=list)
    pose: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        if len(self.intrinsics) not in (0, 4):
            raise ValueError(f"camera intrinsics must be [fx, fy, cx, cy], got {self.intrinsics}")
        if len(self.pose) != 7:
            raise ValueError(f"camera pose must be [x, y, z, qw, qx, qy, qz], got {self.pose}")


def configured_pads(pads: dict[str, PadConfig], pads_file: Path | None) -> dict[str, PadConfig]:
    """The robot's pads, from its configuration or from the pads file.

    Raises:
        ValueError: neither or both are given.
    """
    if bool(pads) == (pads_file is not None):
        raise ValueError(
            "give the pads either by --robot.pads_file=FILE (vtrefine-find-pads writes it) "
            "or by --robot.pads='{NAME: {port: /dev/...}}'"
        )
    return pads if pads_file is None else load_pads(pads_file)


def pad_features(pads: dict[str, PadConfig]) -> dict[str, ArraySpec]:
    """Features of the pads' counts, idle counts and ages."""
    features: dict[str, ArraySpec] = {}
    for kind in ("tactile", "tactile_baseline"):
        for name, pad in pads.items():
            info = {"array_shape": list(pad.pad_shape), "unit": "adc_counts"}
            features[f"{kind}.{name}"] = ArraySpec((int(np.prod(pad.pad_shape)),), "uint8", info)
    features[PAD_AGE] = ArraySpec((len(pads),), "float32")
    return features


def camera_features(models: dict[str, CameraModel]) -> dict[str, ArraySpec]:
    """Features of the camera models, constant columns."""
    widths = {"intrinsics": 4, "pose": 7, "noise_level": 1}
    return {
        f"camera.{name}.{part}": ArraySpec((width,), "float32")
        for name in models
        for part, width in widths.items()
    }


def camera_observation(models: dict[str, CameraModel], cameras: dict[str, Any]) -> Observation:
    """Values of the camera models; intrinsics come from the device where the configuration leaves them out.

    Raises:
        ValueError: intrinsics are neither configured nor known to the device.
    """
    values: Observation = {}
    for name, model in models.items():
        intrinsics = model.intrinsics or device_intrinsics(name, cameras.get(name))
        values[f"camera.{name}.intrinsics"] = np.array(intrinsics, np.float32)
        values[f"camera.{name}.pose"] = np.array(model.pose, np.float32)
        values[f"camera.{name}.noise_level"] = np.array([NO_NOISE], np.float32)
    return values


def device_intrinsics(name: str, camera: Any) -> list[float]:
    """fx, fy, cx, cy of a connected RealSense's depth stream [px].

    Raises:
        ValueError: the camera is no RealSense.
    """
    profile = getattr(camera, "rs_profile", None)
    if profile is None:
        raise ValueError(
            f"intrinsics of camera {name!r} are unknown to the device; "
            f"give them: --robot.camera_models='{{{name}: {{intrinsics: [fx, fy, cx, cy], pose: [...]}}}}'"
        )
    import pyrealsense2  # ty: ignore[import-not-found]  (installed with the camera)

    model = profile.get_stream(pyrealsense2.stream.depth).as_video_stream_profile().get_intrinsics()
    return [model.fx, model.fy, model.ppx, model.ppy]
