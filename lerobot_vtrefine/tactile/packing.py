"""Bodies as the flat arrays that the kernels read."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lerobot_vtrefine.tactile.geometry import (
    BodyGeometry,
    Box,
    ConvexHull,
    Primitive,
    TriangleMesh,
    quaternion_matrix,
)

TRIANGLES_PER_CLUSTER = 16


@dataclass(frozen=True, eq=False)
class PackedBodies:
    """K primitives, Q planes, T triangles in C clusters; a primitive's frame has its origin at its bounding
    box's centre."""

    owner: np.ndarray
    """(K,) int32 body of each primitive."""
    kind: np.ndarray
    """(K,) int32, the primitives' `kind`."""
    position: np.ndarray
    """(K, 3) origin in the body frame [m]."""
    rotation: np.ndarray
    """(K, 3, 3) primitive frame to body frame."""
    extent: np.ndarray
    """(K, 3) half-lengths of the bounding box in the primitive frame [m]."""
    plane_start: np.ndarray
    """(K + 1,) int32 into `planes`."""
    planes: np.ndarray
    """(Q, 4) outward normal and offset, in the primitive frame."""
    corners: np.ndarray
    """(3 T, 3) triangles' corners in the primitive frame, cluster after cluster [m]."""
    normals: np.ndarray
    """(T, 3) triangles' outward unit normals."""
    edge_normals: np.ndarray
    """(3 T, 3) directions halfway between the two faces at the edge opposite to each corner."""
    corner_normals: np.ndarray
    """(3 T, 3) at each corner the mean of its faces' normals, weighted by their angles there."""
    cluster_start: np.ndarray
    """(C + 1,) int32 into the triangles."""
    cluster_range: np.ndarray
    """(K, 2) int32 clusters (begin, end) of each primitive."""
    cluster_centre: np.ndarray
    """(C, 3) centre of its bounding box [m]."""
    cluster_half: np.ndarray
    """(C, 3) half-lengths of its bounding box [m]."""


def split_clusters(centroids: np.ndarray, size: int) -> list[np.ndarray]:
    """Indices of points (T, 3) in spatially compact groups of at most `size`, by halving along the longest
    side."""
    groups: list[np.ndarray] = []
    pending: list[np.ndarray] = [np.arange(len(centroids))]
    while pending:
        group = pending.pop()
        if len(group) <= size:
            groups.append(group)
            continue
        points = centroids[group]
        order = group[np.argsort(points[:, int(np.ptp(points, axis=0).argmax())], kind="stable")]
        pending += [order[len(order) // 2 :], order[: len(order) // 2]]
    return groups


def _frame(primitive: Primitive) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, rotation and half-lengths of a primitive's frame in its body."""
    if isinstance(primitive, ConvexHull | TriangleMesh):
        low, high = primitive.vertices.min(axis=0), primitive.vertices.max(axis=0)
        return (low + high) / 2, np.eye(3), (high - low) / 2
    return np.asarray(primitive.pos, dtype=float), quaternion_matrix(primitive.quat), primitive.extent()


def _planes(primitive: Primitive) -> np.ndarray:
    if isinstance(primitive, Box):
        return primitive.planes()
    if isinstance(primitive, ConvexHull):
        planes = primitive.planes()
        planes[:, 3] -= planes[:, :3] @ _frame(primitive)[0]
        return planes
    return np.zeros((0, 4))


def _unit_normals(triangles: np.ndarray) -> np.ndarray:
    """(T, 3) of triangles (T, 3, 3)."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)


def _edge_normals(faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(F, 3, 3): for each corner of a closed mesh's faces, its own and the neighbour's normal across the edge
    opposite, added."""
    ends = np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1).reshape(-1, 2)
    count = int(faces.max()) + 1
    own, opposite = ends[:, 0] * count + ends[:, 1], ends[:, 1] * count + ends[:, 0]
    order = np.argsort(own)
    neighbour = order[np.searchsorted(own, opposite, sorter=order)] // 3
    return normals[:, None] + normals[neighbour].reshape(-1, 3, 3)


def _corner_normals(triangles: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(F, 3, 3): the angle-weighted normal at every corner's vertex."""
    total = np.zeros((int(faces.max()) + 1, 3))
    for corner in range(3):
        u, v = (triangles[:, (corner + step) % 3] - triangles[:, corner] for step in (1, 2))
        cosine = (u * v).sum(-1) / np.maximum(np.linalg.norm(u, axis=-1) * np.linalg.norm(v, axis=-1), 1e-30)
        np.add.at(total, faces[:, corner], np.arccos(np.clip(cosine, -1, 1))[:, None] * normals)
    return total[faces]


def _pack_mesh(mesh: TriangleMesh) -> tuple[list[int], dict[str, np.ndarray]]:
    """Sizes of a mesh's clusters, and its triangles' arrays (T, ...) cluster after cluster."""
    triangles = mesh.vertices[mesh.faces] - _frame(mesh)[0]
    normals = _unit_normals(triangles)
    groups = split_clusters(triangles.mean(axis=1), TRIANGLES_PER_CLUSTER)
    order = np.concatenate(groups)
    arrays = {
        "corners": triangles,
        "normals": normals,
        "edge_normals": _edge_normals(mesh.faces, normals),
        "corner_normals": _corner_normals(triangles, mesh.faces, normals),
    }
    return [len(group) for group in groups], {name: array[order] for name, array in arrays.items()}


def _pack_triangles(primitives: list[Primitive]) -> dict[str, np.ndarray]:
    soup: dict[str, list[np.ndarray]] = {
        name: [np.zeros((0, 3))] for name in ("corners", "normals", "edge_normals", "corner_normals")
    }
    sizes: list[int] = []
    ranges = []
    for primitive in primitives:
        begin = len(sizes)
        if isinstance(primitive, TriangleMesh):
            own, arrays = _pack_mesh(primitive)
            sizes += own
            for name, array in arrays.items():
                soup[name].append(array.reshape(-1, 3))
        ranges.append((begin, len(sizes)))
    starts = np.concatenate([[0], np.cumsum(sizes, dtype=int)])
    flat = {name: np.concatenate(arrays).astype(np.float32) for name, arrays in soup.items()}
    pieces = [flat["corners"][3 * a : 3 * b] for a, b in pairwise(starts.tolist())]
    low, high = (
        np.array([side(piece) for piece in pieces]).reshape(-1, 3)
        for side in (lambda piece: piece.min(axis=0), lambda piece: piece.max(axis=0))
    )
    return {
        **flat,
        "cluster_start": starts.astype(np.int32),
        "cluster_range": np.array(ranges, dtype=np.int32),
        "cluster_centre": ((low + high) / 2).astype(np.float32),
        "cluster_half": ((high - low) / 2 + 1e-7).astype(np.float32),
    }


def pack_bodies(bodies: list[BodyGeometry]) -> PackedBodies:
    """Flatten bodies into arrays; ValueError when there is none."""
    if not bodies:
        raise ValueError("at least one body is needed")
    primitives = [primitive for body in bodies for primitive in body.primitives]
    frames = [_frame(primitive) for primitive in primitives]
    planes = [_planes(primitive) for primitive in primitives]
    return PackedBodies(
        owner=np.repeat(np.arange(len(bodies)), [len(body.primitives) for body in bodies]).astype(np.int32),
        kind=np.array([primitive.kind for primitive in primitives], dtype=np.int32),
        position=np.array([frame[0] for frame in frames], dtype=np.float32),
        rotation=np.array([frame[1] for frame in frames], dtype=np.float32),
        extent=np.array([frame[2] for frame in frames], dtype=np.float32),
        plane_start=np.cumsum([0, *map(len, planes)]).astype(np.int32),
        planes=np.concatenate(planes).astype(np.float32),
        **_pack_triangles(primitives),
    )
