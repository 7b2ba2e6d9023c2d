"""LeRobot teleoperators. Importing this package registers their configurations, nothing heavier."""

from lerobot_vtrefine.teleoperators.config_aloha_leader import AlohaLeaderConfig

__all__ = ["AlohaLeaderConfig"]
