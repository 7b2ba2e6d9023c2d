"""LeRobot teleoperators. Importing this package registers their configurations, nothing heavier."""

from lerobot_vtrefine.teleoperators.config_aloha_leader import AlohaLeaderConfig
from lerobot_vtrefine.teleoperators.config_vtrefine_ee import VtRefineEeConfig

__all__ = ["AlohaLeaderConfig", "VtRefineEeConfig"]
