"""Configuration of the `tactile` robot: any LeRobot robot plus FlexiTac pads."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.robots.config import RobotConfig

from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.robots.camera_models import CameraModel


@RobotConfig.register_subclass("tactile")
@dataclass(kw_only=True)
class TactileConfig(RobotConfig):
    """Any registered LeRobot robot plus pads: `--robot.base="{type: so101_follower, port: /dev/...}"`.

    Attributes:
        base: Configuration of the robot that carries the pads, `type` included.
        pads_file: Pads file written by vtrefine-find-pads.
        pads: Pads by name, instead of a pads file.
        camera_models: Intrinsics and poses of depth cameras of the base robot, kept in the dataset.
    """

    base: dict[str, Any]
    pads_file: Path | None = None
    pads: dict[str, PadConfig] = field(default_factory=dict)
    camera_models: dict[str, CameraModel] = field(default_factory=dict)
