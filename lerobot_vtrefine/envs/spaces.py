"""Gymnasium spaces of the environment, from the one table of features and the embodiment."""

import numpy as np
from gymnasium import spaces

from lerobot_vtrefine.datasets.features import CAMERA, env_observation_shapes
from lerobot_vtrefine.envs.config import VtRefineEnvConfig


def action_space(config: VtRefineEnvConfig) -> spaces.Box:
    """Absolute joint targets (J,) within the joint limits of the configured embodiment, rad and m.

    Raises:
        ValueError: ``scene.embodiment`` is unknown.
    """
    robot = config.body
    return spaces.Box(robot.lower.astype(np.float32), robot.upper.astype(np.float32), dtype=np.float32)


def observation_space(config: VtRefineEnvConfig) -> spaces.Dict:
    """One environment's raw observation: joints, pad counts, depth, camera, and colour where it is on."""
    shapes = env_observation_shapes(*config.camera_size, config.body, config.limited)
    found: dict[str, spaces.Space] = {key: _box(shape, highest) for key, (shape, highest) in shapes.items()}
    if config.colour_size is not None:
        found["pixels"] = spaces.Dict({CAMERA: spaces.Box(0, 255, (*config.colour_size, 3), np.uint8)})
    return spaces.Dict(found)


def _box(shape: tuple[int, ...], highest: float) -> spaces.Box:
    return spaces.Box(0.0 if np.isfinite(highest) else -np.inf, highest, shape, np.float32)
