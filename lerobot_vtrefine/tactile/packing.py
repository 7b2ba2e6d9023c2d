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
MAX_TRIANGLES = 1 << 24


@dataclass(frozen=True, eq=False)
class PackedBodies:
    """K primitives, Q planes, T triangles in C clusters; a primitive's frame has its origin at its bounding
    box's centre."""

    num_bodies: int
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
    triangle_owner: np.ndarray
    """(T,) int32 primitive of each triangle."""
    cluster_start: np.ndarray
    """(C + 1,) int32 into the triangles."""
    cluster_owner: np.ndarray
    """(C,) int32 primitive of each cluster."""
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


def _pack_triangles(primitives: list[Primitive]) -> dict[str, np.ndarray]:
    corners, owners, starts, cluster_owner = [np.zeros((0, 3, 3))], [np.zeros(0, int)], [0], []
    for k, primitive in enumerate(primitives):
        if not isinstance(primitive, TriangleMesh):
            continue
        triangles = primitive.vertices[primitive.faces] - _frame(primitive)[0]
        groups = split_clusters(triangles.mean(axis=1), TRIANGLES_PER_CLUSTER)
        corners.append(triangles[np.concatenate(groups)])
        owners.append(np.full(len(triangles), k))
        starts += (starts[-1] + np.cumsum([len(group) for group in groups])).tolist()
        cluster_owner += [k] * len(groups)
    soup = np.concatenate(corners)
    if len(soup) >= MAX_TRIANGLES:
        raise ValueError(
            f"bodies hold {len(soup)} triangles, more than the {MAX_TRIANGLES} that fit; simplify the meshes"
        )
    boxes = [
        (soup[a:b].reshape(-1, 3).min(axis=0), soup[a:b].reshape(-1, 3).max(axis=0))
        for a, b in pairwise(starts)
    ]
    low, high = (np.array([box[side] for box in boxes]).reshape(-1, 3) for side in (0, 1))
    return {
        "corners": soup.reshape(-1, 3).astype(np.float32),
        "normals": _unit_normals(soup).astype(np.float32),
        "triangle_owner": np.concatenate(owners).astype(np.int32),
        "cluster_start": np.array(starts, dtype=np.int32),
        "cluster_owner": np.array(cluster_owner, dtype=np.int32),
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
        num_bodies=len(bodies),
        owner=np.repeat(np.arange(len(bodies)), [len(body.primitives) for body in bodies]).astype(np.int32),
        kind=np.array([primitive.kind for primitive in primitives], dtype=np.int32),
        position=np.array([frame[0] for frame in frames], dtype=np.float32),
        rotation=np.array([frame[1] for frame in frames], dtype=np.float32),
        extent=np.array([frame[2] for frame in frames], dtype=np.float32),
        plane_start=np.cumsum([0, *map(len, planes)]).astype(np.int32),
        planes=np.concatenate(planes).astype(np.float32),
        **_pack_triangles(primitives),
    )
