"""Hulls of few vertices: what is small stays whole, what is round keeps its long sides."""

import numpy as np
from scipy.spatial import ConvexHull

from lerobot_vtrefine.sim.hulls import AZIMUTHS, MAX_VERTICES, small_hull

RADIUS, HALF = 0.0175, 0.04


def _bar(corners: int) -> np.ndarray:
    """A round bar with a rounded edge at either end (N, 3)."""
    angle = 2 * np.pi * np.arange(corners) / corners
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    rings = ((RADIUS, HALF - 1e-3), (RADIUS - 0.3e-3, HALF - 0.3e-3), (RADIUS - 1e-3, HALF))
    return np.concatenate(
        [np.c_[r * circle, np.full(corners, side * z)] for r, z in rings for side in (-1, 1)]
    )


def _reaches(vertices: np.ndarray, points: np.ndarray) -> float:
    """How far points lie outside of a hull at most [m]."""
    planes = ConvexHull(vertices).equations
    return float((points @ planes[:, :3].T + planes[:, 3]).max())


def test_few_vertices_stay_as_they_are() -> None:
    points = _bar(12)
    inside = np.random.default_rng(0).uniform(-1e-3, 1e-3, (50, 3))
    vertices, _ = small_hull(np.concatenate([points, inside]))
    np.testing.assert_allclose(np.unique(vertices, axis=0), np.unique(points.round(6), axis=0))


def test_round_bar_loses_what_a_chord_loses() -> None:
    points = _bar(144)
    vertices, _ = small_hull(points)
    chord_m = RADIUS * (1 - np.cos(np.pi / AZIMUTHS))
    assert len(vertices) <= MAX_VERTICES
    assert _reaches(points, vertices) < 2e-6
    assert _reaches(vertices, points) < chord_m + 2e-6
    assert np.ptp(vertices[:, 2]) == np.ptp(points[:, 2])


def test_round_bar_keeps_flat_sides_along_its_axis() -> None:
    """Corners of both rings at the same azimuths: a pad holds such a side along a line, not at a point."""
    vertices, _ = small_hull(_bar(144))
    outer = vertices[np.hypot(vertices[:, 0], vertices[:, 1]) > RADIUS - 1e-5]
    around = np.round(np.degrees(np.arctan2(outer[:, 1], outer[:, 0])), 1)
    above, below = (set(around[side]) for side in (outer[:, 2] > 0, outer[:, 2] < 0))
    assert above == below
    assert len(above) == AZIMUTHS


def test_faces_close_the_hull_and_look_outwards() -> None:
    vertices, faces = small_hull(_bar(144))
    corners = vertices[faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    np.testing.assert_allclose(volume, ConvexHull(vertices).volume, rtol=1e-9)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, back = (sorted(map(tuple, each)) for each in (edges, edges[:, ::-1]))
    assert there == back
