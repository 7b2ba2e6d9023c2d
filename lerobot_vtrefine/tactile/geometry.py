"""Rigid bodies that pads touch, as unions of convex primitives and closed meshes, in the body's frame."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

PLANE_MERGE_TOLERANCE = 1e-6

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]


def quaternion_matrix(quat_wxyz: Quat) -> np.ndarray:
    """Rotation matrix (3, 3) of a quaternion (w, x, y, z), normalised first."""
    quat = np.asarray(quat_wxyz, dtype=float)
    norm = np.linalg.norm(quat)
    if quat.shape != (4,) or not norm > 0:
        raise ValueError(f"quat_wxyz must be four numbers, not all zero, got {quat_wxyz}")
    w, x, y, z = quat / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _require_positive(shape: str, **sizes: float) -> None:
    for name, value in sizes.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{shape}: {name} must be positive, got {value}")


@dataclass(frozen=True)
class Box:
    """Box with half-lengths `half_size` [m] at `pos` [m], turned by `quat` (w, x, y, z)."""

    half_size: Vec3
    pos: Vec3 = (0.0, 0.0, 0.0)
    quat: Quat = (1.0, 0.0, 0.0, 0.0)
    kind: ClassVar[int] = 0

    def __post_init__(self) -> None:
        _require_positive("Box", **{f"half_size[{i}]": float(v) for i, v in enumerate(self.half_size)})

    def extent(self) -> np.ndarray:
        """Half-lengths of the bounding box in the primitive's frame (3,) [m]."""
        return np.asarray(self.half_size, dtype=float)

    def planes(self) -> np.ndarray:
        """Its six faces as planes (6, 4): outward normal and offset, in the primitive's frame."""
        normals = np.concatenate([np.eye(3), -np.eye(3)])
        return np.column_stack([normals, np.tile(self.extent(), 2)])


@dataclass(frozen=True)
class Cylinder:
    """Solid cylinder along its z, of `radius` and `half_height` [m]."""

    radius: float
    half_height: float
    pos: Vec3 = (0.0, 0.0, 0.0)
    quat: Quat = (1.0, 0.0, 0.0, 0.0)
    kind: ClassVar[int] = 1

    def __post_init__(self) -> None:
        _require_positive("Cylinder", radius=self.radius, half_height=self.half_height)

    def extent(self) -> np.ndarray:
        """Half-lengths of the bounding box in the primitive's frame (3,) [m]."""
        return np.array([self.radius, self.radius, self.half_height])


@dataclass(frozen=True)
class Sphere:
    """Solid sphere of `radius` [m]."""

    radius: float
    pos: Vec3 = (0.0, 0.0, 0.0)
    kind: ClassVar[int] = 2
    quat: ClassVar[Quat] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        _require_positive("Sphere", radius=self.radius)

    def extent(self) -> np.ndarray:
        """Half-lengths of the bounding box in the primitive's frame (3,) [m]."""
        return np.full(3, float(self.radius))


def _clean_mesh(shape: str, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vertices = np.ascontiguousarray(vertices, dtype=float)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    if (
        vertices.ndim != 2
        or vertices.shape[1] != 3
        or faces.ndim != 2
        or faces.shape[1] != 3
        or len(faces) < 4
    ):
        raise ValueError(
            f"{shape}: needs vertices (V, 3) and at least 4 triangles, got {vertices.shape}, {faces.shape}"
        )
    if not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"{shape}: vertices must be finite and faces must index them")
    # Files often repeat a vertex per face (for shading); edges only match once equal corners share an index.
    merged, index = np.unique(vertices.round(9), axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    keep = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return merged, faces[keep]


def _require_closed(shape: str, faces: np.ndarray) -> None:
    """Every directed edge must have exactly one opposite: closed, consistently wound, manifold."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = int(edges.max()) + 1
    forward = np.sort(edges[:, 0] * count + edges[:, 1])
    backward = np.sort(edges[:, 1] * count + edges[:, 0])
    if not np.array_equal(forward, backward):
        unmatched = len(np.setxor1d(forward, backward))
        raise ValueError(
            f"{shape}: mesh is open or inconsistently wound ({unmatched} edges without partner); repair it"
        )


def _signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    corners = vertices[faces]
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Closed triangle mesh with outward winding: vertices (V, 3) [m], faces (F, 3), in the body's frame.

    Raises ValueError when it is open or inconsistently wound; a mesh that is inside out is turned.
    """

    vertices: np.ndarray
    faces: np.ndarray
    kind: ClassVar[int] = 4

    def __post_init__(self) -> None:
        vertices, faces = _clean_mesh("TriangleMesh", self.vertices, self.faces)
        _require_closed("TriangleMesh", faces)
        if _signed_volume(vertices, faces) < 0:
            faces = faces[:, ::-1].copy()
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @property
    def volume_m3(self) -> float:
        """What the surface encloses."""
        return _signed_volume(self.vertices, self.faces)


@dataclass(frozen=True, eq=False)
class ConvexHull:
    """Convex solid given by a closed triangle mesh: vertices (V, 3) [m], faces (F, 3), in the body's
    frame."""

    vertices: np.ndarray
    faces: np.ndarray
    kind: ClassVar[int] = 3

    def __post_init__(self) -> None:
        vertices, faces = _clean_mesh("ConvexHull", self.vertices, self.faces)
        if _signed_volume(vertices, faces) < 0:
            faces = faces[:, ::-1].copy()
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        beyond = (vertices @ normals.T).max(axis=0) - np.einsum("fi,fi->f", corners[:, 0], normals)
        if beyond.max() > 1e-3 * np.ptp(vertices, axis=0).max():
            raise ValueError(
                "ConvexHull: the mesh is not convex; use TriangleMesh or decompose it into convex pieces"
            )

    def planes(self) -> np.ndarray:
        """Faces' planes without repetition (K, 4): outward unit normal and offset, n.x <= offset inside."""
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        keep = lengths > 1e-14
        normals = normals[keep] / lengths[keep, None]
        # The supporting plane of each normal keeps thin, slightly bent faces from cutting the solid.
        planes = np.column_stack([normals, (self.vertices @ normals.T).max(axis=0)])
        order = np.argsort(-lengths[keep], kind="stable")
        kept: list[np.ndarray] = []
        for plane in planes[order]:
            if all(plane[:3] @ other[:3] < 1 - PLANE_MERGE_TOLERANCE for other in kept):
                kept.append(plane)
        return np.array(kept)


Primitive = Box | Cylinder | Sphere | ConvexHull | TriangleMesh


@dataclass(frozen=True, eq=False)
class BodyGeometry:
    """One rigid body: the union of its primitives, in the body's frame [m]."""

    primitives: list[Primitive]

    def __post_init__(self) -> None:
        if not self.primitives:
            raise ValueError("BodyGeometry needs at least one primitive")
