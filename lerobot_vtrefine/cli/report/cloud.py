"""The point cloud of one recorded frame, as the policy gets it, for a page to draw."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from PIL import Image

from lerobot_vtrefine.datasets.features import (
    BASELINE_KEYS,
    CAMERA_POSE_KEY,
    DEPTH_KEY,
    INTRINSICS_KEY,
    STATE_KEY,
    TACTILE_KEYS,
)

SEEN_POINTS, STRIDE, POOL_ROWS, POOL_COLS = 512, 1, 1, 1
"""The paper's cloud, whatever the demo's small network takes."""
NEEDED = (STATE_KEY, DEPTH_KEY, INTRINSICS_KEY, CAMERA_POSE_KEY, *TACTILE_KEYS, *BASELINE_KEYS)


def recorded_cloud(dataset_root: Path) -> str | None:
    """Points [x mm, y mm, z mm, reading in per cent, felt] of the frame with the strongest contact, as JSON.

    None for a dataset without depth or joints.
    """
    files = sorted((dataset_root / "data").rglob("*.parquet"))
    if not files or not set(NEEDED) <= set(pq.read_schema(files[0]).names):
        return None
    table = pq.read_table(files[0], columns=list(NEEDED))
    pressed = sum(np.stack(table[key].to_numpy(zero_copy_only=False)).sum(axis=1) for key in TACTILE_KEYS)
    row = table.slice(int(np.argmax(pressed)), 1).to_pylist()[0]
    return json.dumps(cloud_of(row), separators=(",", ":"))


def cloud_of(row: dict[str, Any]) -> list[list[int]]:
    """The cloud of a dataset's row as whole numbers: mm and per cent."""
    return np.rint(build_cloud(row) * [1e3, 1e3, 1e3, 100.0, 1.0]).astype(int).tolist()


def build_cloud(row: dict[str, Any]) -> np.ndarray:
    """The cloud (N, 5) of a dataset's row: x, y, z [m], reading, whether it was felt."""
    import torch

    from lerobot_vtrefine.observation.visuo_tactile import VisuoTactileConfig, build_visuo_tactile

    def tensor(key: str) -> torch.Tensor:
        return torch.tensor(row[key], dtype=torch.float32)

    config = VisuoTactileConfig(
        num_visual_points=SEEN_POINTS, pixel_stride=STRIDE, pool_rows=POOL_ROWS, pool_cols=POOL_COLS
    )
    return build_visuo_tactile(
        tensor(STATE_KEY),
        torch.stack([tensor(key) for key in TACTILE_KEYS]),
        torch.stack([tensor(key) for key in BASELINE_KEYS]),
        torch.from_numpy(depth_mm(row)),
        tensor(INTRINSICS_KEY),
        tensor(CAMERA_POSE_KEY),
        config,
        generator=torch.Generator().manual_seed(0),
    ).numpy()


def depth_mm(row: dict[str, Any]) -> np.ndarray:
    """The depth image (H, W) float32 [mm] of a dataset's row."""
    return np.asarray(Image.open(io.BytesIO(row[DEPTH_KEY]["bytes"]))).astype(np.float32)
