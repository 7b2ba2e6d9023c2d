"""What an indenter does to every taxel of a recorded press: column heights, or shares of the load."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.recordings import Trial
from lerobot_vtrefine.tactile.geometry import BodyGeometry, TriangleMesh, quaternion_matrix
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.replay import NO_BODY_M, column_heights

NOWHERE_M = -1.0
"""Height at taxels over which no part of the indenter stands [m]."""
EDGE_M = 1e-9
"""A taxel this far outside a punch's edge still lies under it: lattices put taxels exactly on edges [m]."""


def rotations(tilt_x_rad: np.ndarray, tilt_y_rad: np.ndarray) -> np.ndarray:
    """Turn about the pad's +x, then about its +y: (N, 3, 3)."""
    cx, sx, cy, sy = np.cos(tilt_x_rad), np.sin(tilt_x_rad), np.cos(tilt_y_rad), np.sin(tilt_y_rad)
    zero, one = np.zeros_like(cx), np.ones_like(cx)
    about_x = np.stack([one, zero, zero, zero, cx, -sx, zero, sx, cx], axis=-1).reshape(-1, 3, 3)
    about_y = np.stack([cy, zero, sy, zero, one, zero, -sy, zero, cy], axis=-1).reshape(-1, 3, 3)
    return about_y @ about_x


def trial_heights(trial: Trial, layout: PadLayout) -> np.ndarray:
    """How far the indenter's surface lies below the undeformed face at every taxel: (N, R, C) [m].

    Negative where there is a gap, -1 where no part of the indenter stands over the taxel. ValueError for a
    trial without `depth_m`.
    """
    if trial.depth_m is None:
        raise ValueError(f"{trial.file}: has no depth_m, so heights are unknown")
    return _heights(trial, trial.depth_m, layout)


def trial_forces(trial: Trial, layout: PadLayout) -> np.ndarray:
    """The measured load shared evenly by the taxels under the indenter (the nearest one if there is none):
    (N, R, C) [N].

    For trials without `depth_m`; a rounded or unknown contact shares over its whole outline.
    """
    if trial.force_n is None:
        raise ValueError(f"{trial.file}: has no force_n")
    under = (_heights(trial, np.zeros_like(trial.x_m), layout) > NO_BODY_M).reshape(len(trial.x_m), -1)
    positions = layout.positions()[:, :2]
    for frame in np.flatnonzero(~under.any(axis=1)):
        distance = np.hypot(*(positions - [trial.x_m[frame], trial.y_m[frame]]).T)
        under[frame, int(np.argmin(distance))] = True
    share = under / under.sum(axis=1, keepdims=True)
    return (share * trial.force_n[:, None]).reshape(-1, layout.rows, layout.cols)


def _heights(trial: Trial, depth_m: np.ndarray, layout: PadLayout) -> np.ndarray:
    shape = trial.object["shape"]
    x, y = layout.axes_m()
    east = x[None, None, :] - trial.x_m[:, None, None]
    north = y[None, :, None] - trial.y_m[:, None, None]
    depth = depth_m[:, None, None]
    if shape == "sphere":
        radius = trial.object["radius_m"]
        left = radius**2 - east**2 - north**2
        return np.where(left > 0, np.sqrt(np.maximum(left, 0.0)) - radius + depth, NOWHERE_M)
    if shape == "mesh":
        return _mesh_heights(trial, depth_m, layout)
    turn = rotations(trial.tilt_x_rad, trial.tilt_y_rad)
    return _punch_heights(trial.object, turn, east, north, depth)


def _punch_heights(
    spec: dict[str, Any], turn: np.ndarray, east: np.ndarray, north: np.ndarray, depth: np.ndarray
) -> np.ndarray:
    """Flat end of a rectangular or round punch, turned by `turn`; its outline is taken as upright."""
    normal = turn[:, :, 2][:, None, None, :]
    # Height of the end face at each taxel, relative to the axis' foot.
    rise = -(normal[..., 0] * east + normal[..., 1] * north) / normal[..., 2]
    slope_u, slope_v = np.abs(turn[:, 2, 0])[:, None, None], np.abs(turn[:, 2, 1])[:, None, None]
    if spec["shape"] == "flat":
        half_x, half_y = (0.5 * side for side in spec["size_m"])
        inside = (np.abs(east) <= half_x + EDGE_M) & (np.abs(north) <= half_y + EDGE_M)
        lowest = half_x * slope_u + half_y * slope_v
    else:
        inside = np.hypot(east, north) <= spec["radius_m"] + EDGE_M
        lowest = spec["radius_m"] * np.hypot(slope_u, slope_v)
    return np.where(inside, depth - lowest - rise, NOWHERE_M)


@lru_cache(maxsize=8)
def _mesh(file: str, scale: float | tuple[float, ...], quat: tuple[float, ...]) -> TriangleMesh:
    import trimesh  # optional extra, slow to import

    mesh = trimesh.load_mesh(file)
    turn = quaternion_matrix(quat)  # ty: ignore[invalid-argument-type]
    vertices = (np.asarray(mesh.vertices) * np.asarray(scale)) @ turn.T
    try:
        return TriangleMesh(vertices, np.asarray(mesh.faces))
    except ValueError as error:
        raise ValueError(f"{Path(file)}: {error}") from error


def mesh_extent_m(spec: dict[str, Any]) -> float:
    """Longest side of the box around a mesh, as scaled and turned [m]; ValueError where it cannot be used."""
    return float(np.ptp(_mesh_of(spec).vertices, axis=0).max())


def _mesh_of(spec: dict[str, Any]) -> TriangleMesh:
    scale = spec.get("scale", 1.0)
    return _mesh(spec["file"], tuple(scale) if isinstance(scale, list) else scale, tuple(spec["quat_wxyz"]))


def _mesh_heights(trial: Trial, depth_m: np.ndarray, layout: PadLayout) -> np.ndarray:
    mesh = _mesh_of(trial.object)
    turn = rotations(trial.tilt_x_rad, trial.tilt_y_rad)
    lowest = np.concatenate(
        [(turn[start : start + 64, 2] @ mesh.vertices.T).min(axis=1) for start in range(0, len(turn), 64)]
    )
    position = np.column_stack([trial.x_m, trial.y_m, -depth_m - lowest])
    return column_heights(layout, BodyGeometry([mesh]), position, turn).astype(float)
