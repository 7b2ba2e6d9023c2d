"""The simulated insertion task as LeRobot environment type ``vtrefine``; importing this registers it."""

from lerobot_vtrefine.envs import gym_ids
from lerobot_vtrefine.envs.config import VtRefineEnvConfig

__all__ = ["VtRefineEnvConfig"]

gym_ids.register()
