"""The skin of a part: points above its surface that a convex piece of it may not hold.

They lie above the surface where the counterpart passes on its way into the pair and out, and where hands take
hold, and nowhere else: a cavity that neither reaches may fill up. Needs manifold3d.

Lengths in metres; both parts in the pair's frame, assembled, whose z axis is that of insertion.
"""

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import KDTree

Array = NDArray[np.float64]
Triangles = NDArray[np.int64]
Surface = tuple[Array, Triangles]
"""Vertices (V, 3) and faces (F, 3) of a solid, wound outwards."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Skin:
    """How closely pieces follow the surface."""

    touched_m: float = 2e-4
    """Height above the surface where the counterpart passes, for pieces that it meets, and where hands take
    hold, for pieces that they meet."""
    seen_m: float = 1e-3
    """The same where hands take hold, for pieces that only cameras see there."""
    levels: int = 5
    """Points lie in so many layers, each twice as high as the one below: a piece holds the more of them, the
    further it is from following the surface."""
    reach_m: float = 0.002
    """The counterpart passes where it comes this close at least on its straight way ..."""
    beyond_play_m: float = 0.001
    """... or closer than its play and this."""
    samples: int = 50_000
    """Points of the surface."""


STEP_M, LARGEST_PLAY_M = 0.002, 0.012
OVERLAP_M3 = 1e-9
"""Parts that share less than a cubic millimetre touch."""
LEAF = 32
"""Points in a leaf of the search for nearest ones: twice as fast here as the usual ten."""
CELLS = 4
"""Of the map of the way, within a reach."""
LEVEL_NORMAL = 0.9
"""A surface whose normal points along the axis so much is a floor or a lid."""
DIRECTIONS, STOREYS_M, OUTERMOST_M = 72, 0.002, 0.002
"""Hands meet what lies within so much of the outermost point in its direction, and at its height."""


def solid_of(surface: Surface) -> Any:
    """The solid as a `manifold3d.Manifold`."""
    vertices, faces = surface
    manifold = importlib.import_module("manifold3d")
    mesh = manifold.Mesh64(np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces, np.uint64))
    return manifold.Manifold(mesh)


def skin_of(part: Surface, other: Surface, skin: Skin) -> tuple[Array, Array]:
    """Points that no piece of `part` may hold that its counterpart `other` meets (N, 3), or hands (M, 3)."""
    points, normals = sampled(part, skin.samples)
    there, _ = sampled(other, skin.samples)
    solids = solid_of(part), solid_of(other)
    reach = max(skin.reach_m, _play(*solids) + skin.beyond_play_m)
    passed = _faces_counterpart(points, normals, there) & _on_the_way(
        points, there, reach, _ways_out(*solids)
    )
    beside = _seen_from_beside(points, normals)

    def above(where: Mask, height_m: float) -> Array:
        heights = height_m * 2 ** np.arange(skin.levels)[:, None, None]
        return _outside((points[where] + heights * normals[where]).reshape(-1, 3), points, normals)

    counterparts = np.concatenate([above(passed, skin.touched_m), above(beside & ~passed, skin.seen_m)])
    return counterparts, above(beside, skin.touched_m)


def sampled(surface: Surface, count: int) -> tuple[Array, Array]:
    """Points (count, 3) spread evenly over a surface, and its outward normals there."""
    vertices, faces = surface
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    rng = np.random.default_rng(0)
    index = rng.choice(len(faces), count, p=area / area.sum())
    marks = np.sort(rng.random((count, 2)), axis=1)
    shares = np.stack([marks[:, 0], marks[:, 1] - marks[:, 0], 1 - marks[:, 1]], 1)
    return np.einsum("nk,nki->ni", shares, corners[index]), cross[index] / area[index, None]


def _outside(skin: Array, points: Array, normals: Array) -> Array:
    """The skin less what came to lie within the part: above one wall of a groove may be behind the other."""
    _, nearest = KDTree(points, leafsize=LEAF).query(skin)
    return skin[np.einsum("ni,ni->n", skin - points[nearest], normals[nearest]) > 0]


def _on_the_way(points: Array, other: Array, reach_m: float, ways: tuple[int, ...]) -> Mask:
    """Which points the counterpart, its surface at `other`, comes close to when it leaves along `ways`."""
    cell = reach_m / CELLS
    low = np.minimum(points.min(0), other.min(0))[:2]
    size = ((np.maximum(points.max(0), other.max(0))[:2] - low) / cell).astype(int) + 1
    here, there = (tuple(((some[:, :2] - low) / cell).astype(int).T) for some in (points, other))
    disc = np.hypot(*np.mgrid[-CELLS : CELLS + 1, -CELLS : CELLS + 1]) <= CELLS
    on_the_way = np.zeros(len(points), bool)
    for way in ways:
        first = np.full(size, np.inf)
        np.minimum.at(first, there, way * other[:, 2])
        closest = minimum_filter(first, footprint=disc, mode="constant", cval=np.inf)
        on_the_way |= closest[here] <= way * points[:, 2] + reach_m
    return on_the_way


def _faces_counterpart(points: Array, normals: Array, other: Array) -> Mask:
    """Which points look along the axis, or to where the counterpart is nearest across it."""
    _, nearest = KDTree(other[:, :2], leafsize=LEAF).query(points[:, :2])
    towards = other[nearest, :2] - points[:, :2]
    sight = np.einsum("ni,ni->n", towards, normals[:, :2])
    return (np.abs(normals[:, 2]) > LEVEL_NORMAL) | (sight > -0.2 * np.linalg.norm(towards, axis=1))


def _seen_from_beside(points: Array, normals: Array) -> Mask:
    """Which points hands can meet."""
    radius = np.linalg.norm(points[:, :2], axis=1)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    place = np.stack([(azimuth + np.pi) / (2 * np.pi) * DIRECTIONS, points[:, 2] / STOREYS_M], 1).astype(int)
    place -= place.min(0)
    outermost = np.zeros(place.max(0) + 1)
    np.maximum.at(outermost, tuple(place.T), radius)
    outwards = np.einsum("ni,ni->n", points[:, :2], normals[:, :2]) > -0.1 * radius
    return outwards & (radius >= outermost[tuple(place.T)] - OUTERMOST_M)


def _ways_out(part: Any, other: Any) -> tuple[int, ...]:
    """Along which the counterpart can leave straight: up (1), down (-1)."""
    boxes = np.reshape([part.bounding_box(), other.bounding_box()], (2, 2, 3))
    steps = np.arange(0.0, np.ptp(boxes[..., 2]), STEP_M)
    return tuple(way for way in (1, -1) if not any(_meet(part, other, (0.0, 0.0, way * s)) for s in steps))


def _play(part: Any, other: Any) -> float:
    """How far the assembled counterpart can go sideways."""
    angles = 2 * np.pi * np.arange(8) / 8
    for play in np.arange(STEP_M / 4, LARGEST_PLAY_M, STEP_M / 4):
        if any(_meet(part, other, (play * np.cos(a), play * np.sin(a), 0.0)) for a in angles):
            return float(play - STEP_M / 4)
    return LARGEST_PLAY_M


def _meet(part: Any, other: Any, shift_m: tuple[float, float, float]) -> bool:
    return (part ^ other.translate(shift_m)).volume() > OVERLAP_M3
