"""Shapes and slow, independent float64 references that the tactile tests compare with."""

from collections.abc import Callable

import numpy as np
import torch

from lerobot_vtrefine.tactile.contact_query import ContactQuery
from lerobot_vtrefine.tactile.geometry import Box, ConvexHull, Cylinder, Primitive, Sphere, TriangleMesh

Inside = Callable[[np.ndarray], np.ndarray]


def box_mesh(half_size: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and outward triangles of a box."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half_size
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
    faces += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    return corners, np.array(faces)


def revolved(profile: np.ndarray, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Closed mesh of a profile (P, 2) of (radius, z), counter-clockwise, turned about z."""
    angles = np.arange(segments) * 2 * np.pi / segments
    count = len(profile)
    ring = np.stack([np.cos(angles), np.sin(angles)], -1)
    vertices = np.concatenate([np.column_stack([r * ring, np.full(segments, z)]) for r, z in profile])
    faces = []
    for p in range(count):
        for s in range(segments):
            a, b = p * segments + s, p * segments + (s + 1) % segments
            c, d = (p + 1) % count * segments + (s + 1) % segments, (p + 1) % count * segments + s
            faces += [(a, b, c), (a, c, d)]
    return vertices, np.array(faces)


def ring_mesh(segments: int = 40) -> TriangleMesh:
    """A chamfered ring: 12 mm outer radius, 6 mm bore, 14 mm high."""
    profile = np.array([[6, -7], [11, -7], [12, -6], [12, 6], [11, 7], [6, 7]]) * 1e-3
    return TriangleMesh(*revolved(profile, segments))


def hexagon(radius: float = 0.01, half_height: float = 0.012) -> ConvexHull:
    """A hexagonal prism along z."""
    profile = np.array(
        [[1e-9, -half_height], [radius, -half_height], [radius, half_height], [1e-9, half_height]]
    )
    vertices, _ = revolved(profile, 6)
    rim = np.concatenate([vertices[6:18]])
    faces = [(s, (s + 1) % 6, 6 + (s + 1) % 6) for s in range(6)] + [
        (s, 6 + (s + 1) % 6, 6 + s) for s in range(6)
    ]
    faces += [(0, s + 1, s) for s in range(1, 5)] + [(6, 6 + s, 7 + s) for s in range(1, 5)]
    return ConvexHull(rim, np.array(faces))


def inside_of(primitive: Primitive) -> Inside:
    """Membership of points (..., 3) in a convex primitive, in its own frame."""
    if isinstance(primitive, Box):
        return lambda p: (np.abs(p) <= primitive.extent()).all(-1)
    if isinstance(primitive, Sphere):
        return lambda p: (p**2).sum(-1) <= primitive.radius**2
    if isinstance(primitive, Cylinder):
        return lambda p: (
            (np.hypot(p[..., 0], p[..., 1]) <= primitive.radius)
            & (np.abs(p[..., 2]) <= primitive.half_height)
        )
    planes = primitive.planes()
    return lambda p: (p @ planes[:, :3].T <= planes[:, 3]).all(-1)


def penetration_of(primitive: Primitive) -> Callable[[np.ndarray], np.ndarray]:
    """Distance of points (N, 3) to a convex primitive's surface, positive inside and at most zero outside."""
    if isinstance(primitive, Box):
        return lambda p: (primitive.extent() - np.abs(p)).min(-1)
    if isinstance(primitive, Sphere):
        return lambda p: primitive.radius - np.linalg.norm(p, axis=-1)
    if isinstance(primitive, Cylinder):
        return lambda p: np.minimum(
            primitive.radius - np.hypot(p[..., 0], p[..., 1]), primitive.half_height - np.abs(p[..., 2])
        )
    planes = primitive.planes()
    return lambda p: (planes[:, 3] - p @ planes[:, :3].T).min(-1)


def scanned_heights(
    inside: Inside, points: np.ndarray, normal: np.ndarray, reach: float = 0.005
) -> np.ndarray:
    """Column heights (N,) by scanning lines in 20 um steps, then bisecting; nan where nothing starts."""
    steps = np.arange(-reach, reach, 2e-5)
    hits = inside(points[:, None] + steps[None, :, None] * normal)
    first = hits.argmax(axis=1)
    found = hits.any(axis=1) & (first > 0)
    low, high = steps[np.maximum(first - 1, 0)], steps[first]
    for _ in range(24):
        middle = (low + high) / 2
        within = inside(points + middle[:, None] * normal)
        low, high = np.where(within, low, middle), np.where(within, middle, high)
    return np.where(found, -high, np.nan)


def closest_distance(mesh: TriangleMesh, points: np.ndarray) -> np.ndarray:
    """Distance of points (N, 3) to the nearest point of a triangle mesh (N,), by brute force."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]][None] for i in range(3))
    p = points[:, None]
    best = np.full((len(points), len(mesh.faces)), np.inf)
    for u, v in ((a, b), (b, c), (c, a)):
        edge = v - u
        t = np.clip(((p - u) * edge).sum(-1) / (edge**2).sum(-1), 0, 1)
        best = np.minimum(best, np.linalg.norm(p - u - t[..., None] * edge, axis=-1))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    height = ((p - a) * normal).sum(-1)
    foot = p - height[..., None] * normal
    within = np.ones(height.shape, bool)
    for u, v in ((a, b), (b, c), (c, a)):
        within &= (np.cross(v - u, foot - u) * normal).sum(-1) >= 0
    return np.where(within, np.minimum(best, np.abs(height)), best).min(axis=1)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Uniformly random rotation matrix."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def single_query(
    query: ContactQuery,
    mode: str,
    body_pos: np.ndarray,
    body_rot: np.ndarray,
    body_vel: np.ndarray | None = None,
    pad: tuple[np.ndarray, np.ndarray] = (np.zeros(3), np.eye(3)),
) -> tuple[np.ndarray, np.ndarray]:
    """Depth and rate (T, rows, cols) of one body at poses (T, 3), (T, 3, 3), over a pad at rest."""
    count = len(body_pos)
    still = torch.zeros((count, 1, 6))
    velocity = still if body_vel is None else torch.as_tensor(body_vel, dtype=torch.float32).view(count, 1, 6)
    depth, rate = query(
        mode,
        torch.as_tensor(pad[0], dtype=torch.float32).expand(count, 1, 3),
        torch.as_tensor(pad[1], dtype=torch.float32).expand(count, 1, 3, 3),
        still,
        torch.as_tensor(body_pos, dtype=torch.float32).view(count, 1, 3),
        torch.as_tensor(body_rot, dtype=torch.float32).view(count, 1, 3, 3),
        velocity,
    )
    return depth[:, 0].numpy().copy(), rate[:, 0].numpy().copy()
