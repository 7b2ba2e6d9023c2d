"""Where the taxels of a pad sit: a planar lattice, given directly or found on the pad's mesh."""

from dataclasses import dataclass, replace

import numpy as np

IDENTITY_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
FLATNESS_TOLERANCE_M = 5e-5
MARGIN_M = 1e-3
"""Between a lattice and the edges of the face that it lies on."""


@dataclass(frozen=True)
class PadLayout:
    """A lattice of rows x cols taxels on a flat face.

    The pad frame has its origin at the centre of the undeformed face, +x along increasing column, +y along
    increasing row and +z outward. Taxel (r, c) sits at ((c - (C-1)/2) pitch, (r - (R-1)/2) pitch, 0).
    """

    rows: int = 12
    cols: int = 32
    pitch_m: float = 0.002
    mesh_position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of the pad frame in the frame of the mesh it was found on."""
    mesh_axes: tuple[tuple[float, float, float], ...] = IDENTITY_AXES
    """Rotation from pad frame to mesh frame, row-major (columns are the pad's axes)."""

    def __post_init__(self) -> None:
        if self.rows < 1 or self.cols < 1:
            raise ValueError(f"a pad needs at least one row and one column, got {self.rows} x {self.cols}")
        if not (np.isfinite(self.pitch_m) and self.pitch_m > 0.0):
            raise ValueError(f"pitch_m must be positive, got {self.pitch_m}")

    @property
    def num_taxels(self) -> int:
        """rows * cols."""
        return self.rows * self.cols

    @property
    def taxel_area_m2(self) -> float:
        """Area that one taxel stands for [m^2]."""
        return self.pitch_m**2

    @property
    def radius_m(self) -> float:
        """Distance from the centre to the outer corner of the lattice's cells [m]."""
        return 0.5 * self.pitch_m * float(np.hypot(self.rows, self.cols))

    def axes_m(self) -> tuple[np.ndarray, np.ndarray]:
        """x of every column (C,) and y of every row (R,) [m]."""
        x = (np.arange(self.cols) - (self.cols - 1) / 2) * self.pitch_m
        y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.pitch_m
        return x, y

    def positions(self) -> np.ndarray:
        """Taxel centres in the pad frame, row-major: (R*C, 3) [m]."""
        x, y = self.axes_m()
        grid_x, grid_y = np.meshgrid(x, y)
        return np.stack([grid_x, grid_y, np.zeros_like(grid_x)], axis=-1).reshape(-1, 3)

    def mesh_positions(self) -> np.ndarray:
        """Taxel centres in the frame of the mesh: (R*C, 3) [m]."""
        return self.positions() @ np.asarray(self.mesh_axes).T + np.asarray(self.mesh_position_m)


def _ray_hits(
    origins: np.ndarray, direction: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Nearest hit of parallel rays on triangles (Moeller-Trumbore): distance (N,), inf where none, and
    triangle (N,)."""
    a, edge1, edge2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(direction, edge2)
    det = np.einsum("fi,fi->f", edge1, p)
    usable = np.abs(det) > 1e-18
    inverse = np.divide(1.0, det, out=np.zeros_like(det), where=usable)
    to_origin = origins[:, None] - a[None]
    u = np.einsum("nfi,fi->nf", to_origin, p) * inverse
    q = np.cross(to_origin, edge1[None])
    v = np.einsum("nfi,i->nf", q, direction) * inverse
    t = np.einsum("nfi,fi->nf", q, edge2) * inverse
    hit = usable & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t >= 0)
    t = np.where(hit, t, np.inf)
    best = t.argmin(axis=1)
    return t[np.arange(len(t)), best], best


def _face_axes(size: np.ndarray, lattice: PadLayout, outward: np.ndarray) -> np.ndarray:
    """Pad axes (3, 3, columns x, y, z) in the mesh frame: z outward, columns along the longer side when there
    are at least as many of them as rows."""
    thickness = int(np.argmin(size))
    sides = [axis for axis in range(3) if axis != thickness]
    longer = max(sides, key=lambda axis: size[axis])
    shorter = min(sides, key=lambda axis: size[axis]) if size[sides[0]] != size[sides[1]] else sides[1]
    x = np.eye(3)[longer if lattice.cols >= lattice.rows else shorter]
    return np.stack([x, np.cross(outward, x), outward], axis=1)


def _outward_normal(
    vertices: np.ndarray, faces: np.ndarray, axis: int, outward: np.ndarray | None
) -> np.ndarray:
    """The unit normal of the sensing face: the caller's side of the thickness axis, else the side with more
    flat area."""
    unit = np.eye(3)[axis]
    if outward is not None:
        along = float(np.asarray(outward, dtype=float) @ unit)
        if along == 0.0:
            raise ValueError("outward must have a component along the pad mesh's shortest bounding-box axis")
        return unit * np.sign(along)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    cosine = np.divide(normals[:, axis], lengths, out=np.zeros_like(lengths), where=lengths > 0)
    up, down = lengths[cosine > 0.999].sum(), lengths[cosine < -0.999].sum()
    return unit if up >= down * (1 - 1e-9) else -unit


def _require_flat(distance: np.ndarray, layout: PadLayout) -> None:
    if np.isfinite(distance).all() and np.ptp(distance) <= FLATNESS_TOLERANCE_M:
        return
    missing = int((~np.isfinite(distance)).sum())
    raise ValueError(
        f"pad mesh has no flat face under the {layout.rows} x {layout.cols} lattice: {missing} taxels miss "
        "it, the others vary in height; flatten the sensing side"
    )


def layout_from_mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    lattice: PadLayout,
    outward: np.ndarray | None = None,
) -> PadLayout:
    """Find the taxels on a pad's mesh as in the paper's appendix ("Sampling Tactile Points").

    The shortest bounding-box axis is the thickness; the lattice is laid on the middle of the face, with
    at least `MARGIN_M` to its edges, and rays along the inward normal put every taxel on the mesh.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3) vertex indices of triangles.
        lattice: its rows, columns and pitch; where it lies is what is found.
        outward: side of the thickness axis that senses; default the side with the larger flat area.

    Raises:
        ValueError: the mesh is malformed, too small for the lattice, or has no flat face under it.
    """
    vertices = np.asarray(vertices, dtype=float)
    faces = np.asarray(faces, dtype=int)
    if (
        vertices.ndim != 2
        or vertices.shape[1] != 3
        or faces.ndim != 2
        or faces.shape[1] != 3
        or not len(faces)
    ):
        raise ValueError(
            f"pad mesh must have vertices (V, 3) and triangles (F, 3), got {vertices.shape}, {faces.shape}"
        )
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    axis = int(np.argmin(high - low))
    normal = _outward_normal(vertices, faces, axis, outward)
    axes = _face_axes(high - low, lattice, normal)
    needed = (np.array([lattice.cols, lattice.rows]) - 1) * lattice.pitch_m + 2 * MARGIN_M
    available = np.abs(axes[:, :2].T @ (high - low))
    if (available + 1e-9 < needed).any():
        face, need = (" x ".join(f"{side * 1e3:.1f}" for side in size) for size in (available, needed))
        raise ValueError(
            f"pad mesh face is {face} mm, but {lattice.rows} x {lattice.cols} taxels at"
            f" {lattice.pitch_m * 1e3:g} mm with {MARGIN_M * 1e3:g} mm margin need {need} mm"
        )
    face_centre = (low + high) / 2 + normal * (high - low)[axis] / 2
    starts = lattice.positions() @ axes.T + face_centre + normal * (high - low)[axis]
    distance, _ = _ray_hits(starts, -normal, vertices[faces])
    _require_flat(distance, lattice)
    position = face_centre + normal * ((high - low)[axis] - float(distance.mean()))
    return replace(
        lattice,
        mesh_position_m=tuple(position.tolist()),
        mesh_axes=tuple(tuple(row) for row in axes.tolist()),
    )
