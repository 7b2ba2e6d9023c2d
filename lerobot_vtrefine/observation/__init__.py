"""Raw readings to the visuo-tactile point cloud: the one code path of simulation, datasets and hardware."""

from lerobot_vtrefine.observation.visuo_tactile import (
    MODALITIES,
    VisuoTactileConfig,
    build_visuo_tactile,
    num_points,
)

__all__ = ["MODALITIES", "VisuoTactileConfig", "build_visuo_tactile", "num_points"]
