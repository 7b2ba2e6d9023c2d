"""LeRobot robots with FlexiTac pads. Importing this package registers their configurations."""

from lerobot_vtrefine.robots.config_aloha_tactile_follower import AlohaTactileFollowerConfig
from lerobot_vtrefine.robots.config_tactile import TactileConfig
from lerobot_vtrefine.robots.config_vtrefine_sim import VtRefineSimConfig

__all__ = ["AlohaTactileFollowerConfig", "TactileConfig", "VtRefineSimConfig"]
