"""Depth images of a LeRobot dataset with what belongs to them, a few frames of every episode."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from lerobot_vtrefine.datasets.features import CAMERA_POSE_KEY, DEPTH_KEY, INTRINSICS_KEY, STATE_KEY
from lerobot_vtrefine.files import inside
from lerobot_vtrefine.files.tables import read_columns
from lerobot_vtrefine.sim.rotations import quat_to_matrix

Array = np.ndarray

FRAMES_PER_EPISODE = 3
MILLIMETRES = 1e-3


@dataclass(frozen=True)
class DepthFrames:
    """F frames of several episodes; shapes (F, ...)."""

    episode: Array
    """(F,) index of the episode."""
    depth_m: Array
    """(F, H, W) along the optical axis, 0 where there is no return."""
    intrinsics: Array
    """(4,) fx, fy, cx, cy [pixels], equal in all frames."""
    position_m: Array
    """(F, 3) where the dataset says the camera is, in the world."""
    rotation: Array
    """(F, 3, 3) optical frame in the world."""
    joints: Array
    """(F, J) [rad, m]."""

    def of(self, episodes: Array | Sequence[int]) -> "DepthFrames":
        """Only some episodes."""
        keep = np.isin(self.episode, episodes)
        arrays = (self.episode[keep], self.depth_m[keep])
        return DepthFrames(
            *arrays, self.intrinsics, self.position_m[keep], self.rotation[keep], self.joints[keep]
        )


def has_depth(root: Path) -> bool:
    """Whether a dataset holds the depth images and the camera's stated pose that this needs."""
    files = sorted((root / "data").rglob("*.parquet"))
    wanted = {DEPTH_KEY, INTRINSICS_KEY, CAMERA_POSE_KEY, STATE_KEY}
    return bool(files) and wanted <= set(pq.read_schema(files[0]).names)


def read_frames(root: Path) -> DepthFrames:
    """Frames spread evenly over every episode.

    Raises ValueError if the dataset lacks depth, the camera's pose or its intrinsics, or these change.
    """
    if not has_depth(root):
        raise ValueError(
            f"{root}: needs {DEPTH_KEY}, {INTRINSICS_KEY} and {CAMERA_POSE_KEY} to judge a camera"
        )
    columns = ["episode_index", "frame_index", STATE_KEY, INTRINSICS_KEY, CAMERA_POSE_KEY, DEPTH_KEY]
    parts = []
    for path in sorted((root / "data").rglob("*.parquet")):
        table = read_columns(path, columns)
        parts.append(table.take(pa.array(_chosen(table))))
    table = pa.concat_tables(parts)
    intrinsics = _matrix(table[INTRINSICS_KEY])
    if np.abs(intrinsics - intrinsics[0]).max() > 1e-3:
        raise ValueError(f"{root}: the camera's intrinsics change between frames")
    pose = _matrix(table[CAMERA_POSE_KEY])
    images = [_image(root, row) for row in table[DEPTH_KEY].to_pylist()]
    return DepthFrames(
        episode=table["episode_index"].to_numpy(),
        depth_m=np.stack(images) * MILLIMETRES,
        intrinsics=intrinsics[0],
        position_m=pose[:, :3],
        rotation=quat_to_matrix(pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)),
        joints=_matrix(table[STATE_KEY]),
    )


def _chosen(table: pa.Table) -> Array:
    episode = table["episode_index"].to_numpy()
    rows = []
    for index in np.unique(episode):
        own = np.flatnonzero(episode == index)
        rows.append(own[np.linspace(0, len(own) - 1, min(FRAMES_PER_EPISODE, len(own))).round().astype(int)])
    return np.concatenate(rows)


def _matrix(column: pa.ChunkedArray) -> Array:
    return np.asarray(column.to_pylist(), dtype=float)


def _image(root: Path, row: dict[str, bytes | str | None]) -> Array:
    data = row.get("bytes")
    source = io.BytesIO(data) if isinstance(data, bytes) else inside(root, str(row.get("path")))
    return np.asarray(Image.open(source), dtype=float)
