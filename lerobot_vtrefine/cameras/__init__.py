"""LeRobot cameras. Importing this package registers their configurations, nothing heavier."""

from lerobot_vtrefine.cameras.config_flexitac_camera import FlexitacCameraConfig

__all__ = ["FlexitacCameraConfig"]
