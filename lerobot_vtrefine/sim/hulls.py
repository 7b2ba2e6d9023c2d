"""Convex hulls of few vertices, as collision detection wants them.

A search for contacts walks over a hull's vertices, and cuts its faces against each other: a round part that
is drawn with hundreds of them costs many times what one with tens does.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Array = NDArray[np.float64]
Triangles = NDArray[np.int64]

AZIMUTHS, ELEVATIONS_DEG = 24, (-80.0, -45.0, -5.0, 5.0, 45.0, 80.0)
"""Of a round bar: chords 0.9 % of its radius deep, flat ends, and rounded edges of two facets."""
MAX_VERTICES = AZIMUTHS * len(ELEVATIONS_DEG) + 2


def small_hull(points: Array) -> tuple[Array, Triangles]:
    """Hull of points (N, 3), of `MAX_VERTICES` at most: it lies within the whole one.

    Where there are more, only those stay that are outermost along z, the axis of insertion, and in
    directions around it: a bar keeps long flat sides, on which pads find two points to hold it by. (Qhull's
    own limit, which MuJoCo's `maxhullvert` uses, stops wherever it happens to be: the plug of 00186 loses an
    edge of 2 mm.)

    Returns:
        Vertices (V, 3), and faces (F, 3) with outward winding.
    """
    points = np.unique(points.round(6), axis=0)  # no slivers of nanometres, whose normals say nothing
    hull = ConvexHull(points)
    if len(hull.vertices) > MAX_VERTICES:
        corners = points[hull.vertices]
        hull = ConvexHull(corners[np.unique((corners @ _directions().T).argmax(0))])
    number = np.full(len(hull.points), -1)
    number[hull.vertices] = np.arange(len(hull.vertices))
    first, second, third = np.moveaxis(hull.points[hull.simplices], 1, 0)
    normals = np.cross(second - first, third - first)
    inwards = np.einsum("fi,fi->f", normals, hull.equations[:, :3]) < 0
    faces = np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)
    return hull.points[hull.vertices], number[faces].astype(np.int64)


def _directions() -> Array:
    """(MAX_VERTICES, 3) unit vectors."""
    azimuth = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    elevation = np.radians(ELEVATIONS_DEG)[:, None]
    across = np.cos(elevation)
    along = np.broadcast_to(np.sin(elevation), (len(elevation), AZIMUTHS))
    around = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), along], -1).reshape(-1, 3)
    return np.vstack([around, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
