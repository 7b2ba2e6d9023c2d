"""Builds the grids in which `kernels_grid` looks nearest triangles up. Imports warp."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from lerobot_vtrefine.tactile import kernels, kernels_grid
from lerobot_vtrefine.tactile.packing import PackedBodies

FINEST_M = 2.5e-4
"""Smallest cell [m]."""
MOST_CELLS = 600_000
MARGIN_M = 1e-5


@dataclass(frozen=True, eq=False)
class MeshGrid:
    """Cells of one mesh, x-major, and the triangles that can be nearest in them."""

    count: tuple[int, int, int]
    low: np.ndarray
    """(3,) lowest corner in the primitive's frame [m]."""
    size_m: float
    cells: np.ndarray
    """(cells, 2) int32 ranges of `candidates`; (0, 0) outside, (-1, -1) deeper inside than was asked for."""
    candidates: np.ndarray
    """int32 numbers of triangles."""


def build_grid(
    bodies: kernels.Bodies, triangles: tuple[int, int], half: np.ndarray, reach_m: float, device: str
) -> MeshGrid:
    """The grid over a mesh's bounding box of half-lengths `half` (3,) [m], exact up to `reach_m` inside.

    Args:
        triangles: first and one past the last of the mesh's triangles in `bodies`.
    """
    extent = 2 * (np.asarray(half, dtype=float) + MARGIN_M)
    size = max(FINEST_M, float(np.prod(extent) / MOST_CELLS) ** (1 / 3))
    levels = max(1, int(math.log2(extent.max() / size)) - 1)
    base = np.ceil(extent / (size * 2**levels)).astype(int)
    low = -base * size * 2**levels / 2
    begin, end = triangles
    cells = np.tile(np.array([[0, end - begin]], dtype=np.int32), (int(base.prod()), 1))
    items = np.arange(begin, end, dtype=np.int32)
    for level in range(1, levels + 1):
        count = base * 2**level
        cells, items = _refine(
            bodies, count, low, size * 2 ** (levels - level), reach_m, (cells, items), device
        )
    count = base * 2**levels
    return MeshGrid((int(count[0]), int(count[1]), int(count[2])), low, size, cells, items)


def _refine(
    bodies: kernels.Bodies,
    count: np.ndarray,
    low: np.ndarray,
    size: float,
    reach_m: float,
    parents: tuple[np.ndarray, np.ndarray],
    device: str,
) -> tuple[np.ndarray, np.ndarray]:
    """Cells and candidates one level finer."""
    number = int(count.prod())
    cells = wp.zeros(number, dtype=wp.vec2i, device=device)
    kept = wp.zeros(1, dtype=int, device=device)
    given = [
        *(bodies, wp.vec3i(*(int(n) for n in count)), wp.vec3(*low.tolist()), float(size), float(reach_m)),
        wp.array(parents[0], dtype=wp.vec2i, device=device),
        wp.array(parents[1], dtype=int, device=device),
    ]
    wp.launch(kernels_grid.refine, number, [*given, 0, cells, kept], device=device, record_tape=False)
    amount = cells.numpy()[:, 0]
    ends = np.cumsum(np.maximum(amount, 0))
    begins = ends - np.maximum(amount, 0)
    ranges = np.where(amount[:, None] > 0, np.stack([begins, ends], 1), np.minimum(amount, 0)[:, None])
    cells = wp.array(ranges.astype(np.int32), dtype=wp.vec2i, device=device)
    kept = wp.zeros(max(int(ends[-1]), 1), dtype=int, device=device)
    wp.launch(kernels_grid.refine, number, [*given, 1, cells, kept], device=device, record_tape=False)
    return ranges.astype(np.int32), kept.numpy()


def in_blocks(cells: np.ndarray, grid: MeshGrid) -> np.ndarray:
    """Cells (x-major, as the grid's own) in the order of `kernels_grid.cell_of`: 2 x 2 x 2 together."""
    x, y, z = (count // 2 for count in grid.count)
    return cells.reshape(x, 2, y, 2, z, 2, 2).transpose(0, 2, 4, 1, 3, 5, 6).reshape(-1, 2)


def add_grids(bodies: kernels.Bodies, packed: PackedBodies, reach_m: float, device: str) -> None:
    """Give the meshes among the bodies their grids, in place."""
    grids: list[Any] = []
    cells: list[np.ndarray] = [np.zeros((0, 2), np.int32)]
    items: list[np.ndarray] = [np.zeros(0, np.int32)]
    for k, (begin, end) in enumerate(packed.cluster_range):
        grid = kernels.Grid()
        if begin < end:
            triangles = int(packed.cluster_start[begin]), int(packed.cluster_start[end])
            built = build_grid(bodies, triangles, packed.extent[k], reach_m, device)
            offset = sum(map(len, items))
            grid.first = sum(map(len, cells))
            grid.count, grid.low = wp.vec3i(*built.count), wp.vec3(*built.low.tolist())
            grid.inverse = 1 / built.size_m
            cells.append(
                in_blocks(np.where(built.cells[:, 1:] > 0, built.cells + offset, built.cells), built)
            )
            items.append(built.candidates)
        grids.append(grid)
    bodies.grids = wp.array(grids, dtype=kernels.Grid, device=device)
    bodies.cells = wp.array(np.concatenate(cells).astype(np.int32), dtype=wp.vec2i, device=device)
    bodies.candidates = wp.array(np.concatenate(items).astype(np.int32), dtype=int, device=device)
