"""Configuration of two ViperX-300s arms with FlexiTac pads on all four fingers."""

from dataclasses import dataclass, field
from pathlib import Path

from lerobot.cameras.configs import CameraConfig
from lerobot.robots.config import RobotConfig

from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.robots.camera_models import CameraModel


@RobotConfig.register_subclass("aloha_tactile_follower")
@dataclass(kw_only=True)
class AlohaTactileFollowerConfig(RobotConfig):
    """Two ViperX-300s arms, four pads, cameras.

    Attributes:
        left_port: Serial port of the left arm, best by a stable path such as /dev/serial/by-id/...
        right_port: Serial port of the right arm.
        pads_file: Pads file written by vtrefine-find-pads, with ALOHA's four pad names.
        pads: Pads by name, instead of a pads file.
        cameras: LeRobot cameras by name; the policy's depth camera is called `front`, with use_depth.
        camera_models: Intrinsics and poses of depth cameras, kept in the dataset.
        gripper_current_ma: Current limit of the grippers, which limits their force [mA].
        torque_limit: Largest share of the arm joints' full torque (their PWM limit), 0..1.
        max_step_rad: Largest distance of a joint target from where the joint is; farther targets are cut off.
        rest_on_disconnect: Move to the rest pose before torque goes off; the arms drop otherwise.
        rest_s: Time for that [s].
    """

    left_port: str
    right_port: str
    pads_file: Path | None = None
    pads: dict[str, PadConfig] = field(default_factory=dict)
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    camera_models: dict[str, CameraModel] = field(default_factory=dict)
    gripper_current_ma: float = 400.0
    torque_limit: float = 1.0
    max_step_rad: float = 0.5
    rest_on_disconnect: bool = True
    rest_s: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("gripper_current_ma", "max_step_rad", "rest_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"--robot.{name} must be positive, got {getattr(self, name)}")
        if not 0 < self.torque_limit <= 1:
            raise ValueError(
                f"--robot.torque_limit must lie within 0 .. 1, and above 0, got {self.torque_limit}"
            )
