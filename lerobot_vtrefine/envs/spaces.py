"""Gymnasium spaces of the environment, from the one table of features and the embodiment."""

import numpy as np
from gymnasium import spaces

from lerobot_vtrefine.datasets.features import env_observation_shapes
from lerobot_vtrefine.envs.config import VtRefineEnvConfig


def action_space(config: VtRefineEnvConfig) -> spaces.Box:
    """Absolute joint targets (J,) within the joint limits of the configured embodiment, rad and m.

    Raises:
        ValueError: ``scene.embodiment`` is unknown.
    """
    robot = config.body
    return spaces.Box(robot.lower.astype(np.float32), robot.upper.astype(np.float32), dtype=np.float32)


def observation_space(config: VtRefineEnvConfig) -> spaces.Dict:
    """One environment's raw observation: joints, pad counts, depth, camera."""
    height, width = config.camera_size
    shapes = env_observation_shapes(height, width, config.body)
    return spaces.Dict({key: _box(shape, highest) for key, (shape, highest) in shapes.items()})


def _box(shape: tuple[int, ...], highest: float) -> spaces.Box:
    return spaces.Box(0.0 if np.isfinite(highest) else -np.inf, highest, shape, np.float32)
