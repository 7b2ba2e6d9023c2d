"""The point cloud of one recorded frame, as the policy gets it, for a page to draw."""

import io
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from PIL import Image

from lerobot_vtrefine.datasets.features import (
    CAMERA_POSE_KEY,
    DEPTH_KEY,
    INTRINSICS_KEY,
    STATE_KEY,
    TACTILE_PREFIX,
    baseline_keys,
    tactile_keys,
)
from lerobot_vtrefine.embodiments import Embodiment, embodiment_with_pads

SEEN_POINTS, STRIDE, POOL_ROWS, POOL_COLS = 512, 1, 1, 1
"""The paper's cloud, whatever the demo's small network takes."""


def body_of(columns: Collection[str]) -> Embodiment | None:
    """Whose dataset this is, by its columns; None if one is missing that the cloud needs."""
    body = embodiment_with_pads([key.removeprefix(TACTILE_PREFIX) for key in columns])
    return body if body is not None and set(needed(body)) <= set(columns) else None


def needed(body: Embodiment) -> tuple[str, ...]:
    """The columns that a body's cloud is made of."""
    pads = (*tactile_keys(body), *baseline_keys(body))
    return (STATE_KEY, DEPTH_KEY, INTRINSICS_KEY, CAMERA_POSE_KEY, *pads)


def recorded_cloud(dataset_root: Path) -> str | None:
    """Points [x mm, y mm, z mm, reading in per cent, felt] of the frame with the strongest contact, as JSON.

    None for a dataset without depth or joints, or of a robot that is not known.
    """
    files = sorted((dataset_root / "data").rglob("*.parquet"))
    body = body_of(pq.read_schema(files[0]).names) if files else None
    if body is None:
        return None
    table = pq.read_table(files[0], columns=list(needed(body)))
    columns = [table[key].to_numpy(zero_copy_only=False) for key in tactile_keys(body)]
    pressed = sum(np.stack(column).sum(axis=1) for column in columns)
    row = table.slice(int(np.argmax(pressed)), 1).to_pylist()[0]
    return json.dumps(cloud_of(row, body), separators=(",", ":"))


def cloud_of(row: dict[str, Any], body: Embodiment) -> list[list[int]]:
    """The cloud of a dataset's row as whole numbers: mm and per cent."""
    return np.rint(build_cloud(row, body) * [1e3, 1e3, 1e3, 100.0, 1.0]).astype(int).tolist()


def build_cloud(row: dict[str, Any], body: Embodiment) -> np.ndarray:
    """The cloud (N, 5) of a row of a body's dataset: x, y, z [m], reading, whether it was felt."""
    import torch

    from lerobot_vtrefine.observation.visuo_tactile import VisuoTactileConfig, build_visuo_tactile

    def tensor(key: str) -> torch.Tensor:
        return torch.tensor(row[key], dtype=torch.float32)

    config = VisuoTactileConfig(
        embodiment=body.name,
        num_visual_points=SEEN_POINTS,
        pixel_stride=STRIDE,
        pool_rows=POOL_ROWS,
        pool_cols=POOL_COLS,
    )
    return build_visuo_tactile(
        tensor(STATE_KEY),
        torch.stack([tensor(key) for key in tactile_keys(body)]),
        torch.stack([tensor(key) for key in baseline_keys(body)]),
        torch.from_numpy(depth_mm(row)),
        tensor(INTRINSICS_KEY),
        tensor(CAMERA_POSE_KEY),
        config,
        generator=torch.Generator().manual_seed(0),
    ).numpy()


def depth_mm(row: dict[str, Any]) -> np.ndarray:
    """The depth image (H, W) float32 [mm] of a dataset's row."""
    return np.asarray(Image.open(io.BytesIO(row[DEPTH_KEY]["bytes"]))).astype(np.float32)
