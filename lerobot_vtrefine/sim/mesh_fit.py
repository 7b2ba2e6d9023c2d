"""How a plug sits in its socket, measured on the convex pieces that the simulation will use.

The pieces are handed to MuJoCo's collision detection as two bodies; the plug is displaced from the assembled
pose and the deepest overlap is read. Nothing is stepped.
"""

from dataclasses import asdict, dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

OVERLAP_M = 3e-4
"""Overlap that counts as blocked: above the error of the convex pieces."""
_LATERAL_M = 0.012  # a plug that can move this far sideways is out of its socket
_STEP_M = 0.002
_MAX_TRAVEL_M = 0.2
_DIRECTIONS = 8


@dataclass(frozen=True)
class MeshFit:
    """Geometry of the assembly.

    `travel_m`: retreat along the exit axis after which the plug is free sideways, i.e. the depth of a seated
    plug [m].
    `exit_sign`: +1 when the plug leaves along +z of the files' frame, -1 along -z.
    """

    travel_m: float
    exit_sign: float

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the fields as 0-d arrays (the cache's format)."""
        return {name: np.asarray(value) for name, value in asdict(self).items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]]) -> "MeshFit":
        """Inverse of `arrays`; entries of earlier versions hold more."""
        return cls(float(arrays["travel_m"]), float(arrays["exit_sign"]))


def measure_fit(plug: list[Array], socket: list[Array]) -> MeshFit:
    """Measure the fit of convex pieces [(V, 3) m, assembled at the identity]; ValueError if they cannot."""
    probe = OverlapProbe(plug, socket)
    if probe.overlap(np.zeros(3)) > 2 * OVERLAP_M + 2e-4:
        raise ValueError(
            "the two meshes overlap in the assembled pose, as which the files are read; check their common"
            " frame and --env.scene.mesh_scale"
        )
    exits = {sign: _free_travel(probe, sign) for sign in (1.0, -1.0)}
    sign, travel = min(exits.items(), key=lambda item: item[1])
    if not np.isfinite(travel):
        raise ValueError(
            "the plug cannot leave its socket along z; the meshes' common frame needs z as insertion axis"
        )
    return MeshFit(travel, sign)


def _free_travel(probe: "OverlapProbe", sign: float) -> float:
    """Return the retreat along sign*z until every sideways move is free; inf when the way out is blocked."""
    angles = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    for height in np.arange(0.0, _MAX_TRAVEL_M, _STEP_M):
        offset = np.array([0.0, 0.0, sign * height])
        if height > 0 and probe.overlap(offset) > 2 * OVERLAP_M:
            return float("inf")
        reach = (_LATERAL_M * np.array([np.cos(angle), np.sin(angle), 0.0]) for angle in angles)
        if all(probe.overlap(offset + side) <= OVERLAP_M for side in reach):
            return float(height)
    return float("inf")


class OverlapProbe:
    """Deepest overlap of the plug's pieces with the socket's for a displaced plug."""

    def __init__(self, plug: list[Array], socket: list[Array]) -> None:
        spec = mujoco.MjSpec()
        for role, pieces, group in (("socket", socket, (2, 1)), ("plug", plug, (1, 2))):
            body = spec.worldbody.add_body(name=role)
            if role == "plug":
                body.add_freejoint()
            for index, points in enumerate(pieces):
                mesh = spec.add_mesh(
                    name=f"{role}{index}", uservert=np.ascontiguousarray(points, np.float32).ravel()
                )
                body.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_MESH,
                    meshname=mesh.name,
                    contype=group[0],
                    conaffinity=group[1],
                )
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)

    def overlap(self, offset_m: Array) -> float:
        """Return the deepest overlap [m] (0 when apart) with the plug at `offset_m` (3,)."""
        self._data.qpos[:3] = offset_m
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        contacts = self._data.contact.dist[: self._data.ncon]
        return float(max(0.0, -contacts.min())) if len(contacts) else 0.0
