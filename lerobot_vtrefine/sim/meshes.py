"""Plug-socket pairs from a user's folder of meshes (`automate/ID`): load, check, cut, cache.

A folder holds `{ID}_plug.obj` and `{ID}_socket.obj`, drawn in one frame: with both bodies at the identity
the pair is assembled. Each mesh becomes convex pieces once; the pieces lie in the user's cache directory.
Every part leaves this module in metres, with the plug leaving the socket along +z of the common frame.

Needs the optional packages trimesh and manifold3d (`pip install 'lerobot_policy_vtrefine[assets]'`),
imported lazily.
"""

import hashlib
import importlib
import os
import re
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lerobot_vtrefine.sim.hulls import small_hull
from lerobot_vtrefine.sim.mesh_fit import MeshFit, measure_fit
from lerobot_vtrefine.sim.mesh_pieces import Cut, cut_into_pieces
from lerobot_vtrefine.sim.mesh_skin import Surface

Array = NDArray[np.float64]
Triangles = NDArray[np.int64]

ROLES = ("plug", "socket")
PREFIX = "automate/"
EXTENT_RANGE_M = (0.005, 0.25)  # largest side of a part that two hands can hold
_UNIT_RANGES = {1.0: (0.002, 0.5), 1e-3: (2.0, 500.0)}  # raw extents that read as metres, as millimetres


@dataclass(frozen=True)
class MeshScale:
    """How the FlexiTac setup scales one asset: factors per axis and which file plays the plug."""

    plug: tuple[float, float, float]
    socket: tuple[float, float, float]
    swap: bool = False  # the `_socket` file is the part that moves


# FlexiTac-IsaacSim-Simulation, URDF scales per asset; its global plug factor 1.06 makes sense for 00186
# only, where it gives the paper's clearance of about 2 mm, and loosens the ring-shaped plugs of the others.
FLEXITAC_SCALES: dict[str, MeshScale] = {
    "00007": MeshScale((2.0, 2.0, 2.0), (2.0, 2.0, 2.0)),
    "00081": MeshScale((1.0, 1.0, 2.0), (1.0, 1.0, 2.0)),
    "00186": MeshScale((2.12, 2.12, 2.65), (2.0, 2.0, 2.5), swap=True),
    "00446": MeshScale((2.0, 2.0, 1.5), (2.1, 2.1, 1.5)),
    "00581": MeshScale((2.6, 2.6, 3.0), (2.5, 2.5, 2.5)),
}


CUT = Cut()


@dataclass(frozen=True)
class Hull:
    """One convex piece: vertices (V, 3) m, faces (F, 3) with outward winding."""

    vertices: Array
    faces: Triangles


@dataclass(frozen=True)
class MeshPart:
    """One part in the pair's common frame: surface mesh [m] and its convex pieces, for its counterpart and
    for hands."""

    vertices: Array
    faces: Triangles
    pieces: tuple[Hull, ...]
    sides: tuple[Hull, ...]

    @property
    def bounds_m(self) -> Array:
        """(2, 3) lower and upper corner."""
        return np.stack([self.vertices.min(0), self.vertices.max(0)])


@dataclass(frozen=True)
class MeshPair:
    """An assembled pair: both parts at the identity are seated, the plug leaves along +z."""

    name: str
    plug: MeshPart
    socket: MeshPart
    fit: MeshFit


def mesh_ids(mesh_dir: Path | str) -> list[str]:
    """Return the IDs that have both files in `mesh_dir`; FileNotFoundError when the folder is missing."""
    folder = Path(mesh_dir).expanduser()
    if not folder.is_dir():
        raise FileNotFoundError(f"mesh_dir: no folder {folder}; it must hold ID_plug.obj and ID_socket.obj")
    stems = {path.name.removesuffix("_plug.obj") for path in folder.glob("*_plug.obj")}
    return sorted(stem for stem in stems if (folder / f"{stem}_socket.obj").is_file())


def load_mesh_pair(
    name: str,
    mesh_dir: Path | str | None,
    scale: str | float = "flexitac",
    progress: bool = True,
) -> MeshPair:
    """Load `automate/ID` from `mesh_dir`, cut (or from the cache) and measured.

    `scale` is "flexitac" (the table above, 1 for other parts), "unit", or one factor for both parts.
    Raises FileNotFoundError for a missing folder or ID, ValueError for a mesh that is not solid or of an
    implausible size and for parts that overlap or are not drawn assembled, ImportError without the `assets`
    extra; each with one line that says what to do.
    """
    mesh_id = name.removeprefix(PREFIX)
    if mesh_dir is None:
        raise ValueError(
            f"pair {name} needs --env.mesh_dir: the folder with {mesh_id}_plug.obj and {mesh_id}_socket.obj"
        )
    paths = _part_paths(mesh_id, Path(mesh_dir).expanduser())
    factors = part_scales(mesh_id, scale)
    if factors.swap:
        paths = {"plug": paths["socket"], "socket": paths["plug"]}
    surfaces = {role: _surface(paths[role], np.asarray(getattr(factors, role))) for role in ROLES}
    plug, socket = (_part(name, role, surfaces, progress) for role in ROLES)
    corners = [[hull.vertices for hull in part.pieces] for part in (plug, socket)]
    key = f"fit-{_digest(*corners[0], *corners[1])}"
    both = f"{paths['plug']}, {paths['socket']}"
    try:
        fit = MeshFit.from_arrays(_cached(key, lambda: measure_fit(*corners).arrays()))
    except ValueError as error:
        raise ValueError(f"{both}: {error}") from None
    if not fit.travel_m > 0:
        raise ValueError(
            f"{both}: the plug is beside or above its socket; draw both parts in one frame, assembled"
        )
    if fit.exit_sign < 0:  # turn both parts over, so that the plug always leaves upwards
        plug, socket = _turned_over(plug), _turned_over(socket)
    return MeshPair(f"{PREFIX}{mesh_id}", plug, socket, replace(fit, exit_sign=1.0))


def part_scales(mesh_id: str, scale: str | float) -> MeshScale:
    """Return the factors of both parts for `scale`; ValueError lists the choices."""
    if scale == "flexitac" and mesh_id in FLEXITAC_SCALES:
        return FLEXITAC_SCALES[mesh_id]
    try:
        factor = 1.0 if scale in ("flexitac", "unit") else float(scale)
    except ValueError:
        raise ValueError(f"mesh_scale must be flexitac, unit or a factor, not {scale!r}") from None
    if not factor > 0:
        raise ValueError(f"mesh_scale must be above 0, not {factor}")
    return MeshScale((factor, factor, factor), (factor, factor, factor))


def cache_dir() -> Path:
    """Return the user's cache directory of pieces (`$XDG_CACHE_HOME/lerobot_vtrefine`)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lerobot_vtrefine"


def check_solid(mesh: Any, path: Path) -> None:
    """Raise ValueError with the fix unless the trimesh `mesh` bounds a volume: that of one rigid part, also
    where it is several solids, as of a plug whose pins are drawn without what holds them.
    """
    if len(mesh.faces) == 0:
        raise ValueError(f"{path}: holds no triangles; export the part as a triangle mesh")
    if not mesh.is_watertight:
        raise ValueError(
            f"{path}: the surface is not watertight; close its holes (e.g. Blender: 3D-Print > Make Manifold)"
        )
    if not mesh.is_winding_consistent:
        raise ValueError(f"{path}: faces are wound inconsistently; recalculate the normals to point outside")
    if mesh.volume <= 0:
        raise ValueError(f"{path}: the faces point inwards (volume {mesh.volume:.3g}); flip the normals")


def raw_unit_m(extents: Array, path: Path) -> float:
    """Return the file's length unit in metres (millimetres or metres, from its largest side)."""
    largest = float(np.max(extents))
    for unit, (low, high) in _UNIT_RANGES.items():
        if low <= largest < high:
            return unit
    raise ValueError(
        f"{path}: largest side {largest:.4g} is neither plausible metres nor millimetres; rescale the file"
    )


def _part_paths(mesh_id: str, folder: Path) -> dict[str, Path]:
    available = mesh_ids(folder)
    if not re.fullmatch(r"[\w.-]+", mesh_id) or mesh_id not in available:
        listed = ", ".join(available) or "none"
        raise FileNotFoundError(
            f"{PREFIX}{mesh_id}: no {mesh_id}_plug.obj with {mesh_id}_socket.obj in {folder} "
            f"(pairs there: {listed})"
        )
    return {role: folder / f"{mesh_id}_{role}.obj" for role in ROLES}


def _surface(path: Path, factors: Array) -> Surface:
    """Load, check and scale one file; metres."""
    trimesh = _optional("trimesh")
    try:
        mesh = trimesh.load(path, force="mesh")
    except (ValueError, IndexError, TypeError, KeyError) as error:
        raise ValueError(f"{path}: not a readable OBJ mesh ({error})") from None
    check_solid(mesh, path)
    vertices = np.asarray(mesh.vertices, float) * raw_unit_m(mesh.extents, path) * factors
    largest = float(np.ptp(vertices, axis=0).max())
    low, high = EXTENT_RANGE_M
    if not low <= largest <= high:
        raise ValueError(
            f"{path}: {1e3 * largest:.1f} mm long after scaling, outside {1e3 * low:.0f}-"
            f"{1e3 * high:.0f} mm; set --env.scene.mesh_scale"
        )
    return vertices, np.asarray(mesh.faces, np.int64)


def _part(name: str, role: str, surfaces: dict[str, Surface], progress: bool) -> MeshPart:
    """Cut a part into convex pieces, which depend on its counterpart, too."""
    _optional("manifold3d")
    part, other = surfaces[role], surfaces[ROLES[1 - ROLES.index(role)]]
    key = f"cut-{_digest(*part, *other, np.frombuffer(repr(CUT).encode(), np.uint8))}"

    def compute() -> dict[str, NDArray[Any]]:
        with tqdm(total=1, desc=f"{name}: convex pieces of the {role}", disable=not progress, leave=False):
            kinds = asdict(cut_into_pieces(part, other, CUT))
        return {f"{kind}_{i:03d}": corners for kind in kinds for i, corners in enumerate(kinds[kind])}

    corners = _cached(key, compute)

    def hulls(kind: str) -> tuple[Hull, ...]:
        return tuple(Hull(*small_hull(corners[name])) for name in sorted(corners) if name.startswith(kind))

    return MeshPart(*part, pieces=hulls("fitting"), sides=hulls("sides"))


def _turned_over(part: MeshPart) -> MeshPart:
    """Rotate by half a turn about x (a proper rotation: windings stay valid)."""
    flip = np.array([1.0, -1.0, -1.0])
    kinds = (
        tuple(Hull(hull.vertices * flip, hull.faces) for hull in hulls) for hulls in (part.pieces, part.sides)
    )
    return MeshPart(part.vertices * flip, part.faces, *kinds)


def _cache_file(key: str) -> Path:
    return cache_dir() / f"{key}.npz"


def _cached(key: str, compute: Callable[[], dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return `compute()`'s arrays, kept as one npz in the cache; a damaged entry is made again."""
    path = _cache_file(key)
    try:
        with np.load(path) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        arrays = compute()
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        np.savez_compressed(file, **arrays)  # ty: ignore[invalid-argument-type] (allow_pickle is no array)
    Path(file.name).replace(path)  # atomic: parallel workers never read half a file
    return arrays


def _digest(*arrays: NDArray[Any]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:24]


def _optional(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise ImportError(
            f"mesh pairs need {module}: pip install 'lerobot_policy_vtrefine[assets]'"
        ) from None
