"""Plug-socket pairs by name: procedural ones from primitives here, those of meshes from `mesh_pairs`."""

import numpy as np

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.sim.config import MESH_PAIR_PREFIX, PROCEDURAL_PAIRS, SceneConfig
from lerobot_vtrefine.sim.parts import Grip, Part, PartPair
from lerobot_vtrefine.sim.profiles import make_profile, offset_outline, wall_boxes
from lerobot_vtrefine.tactile.geometry import Box

HOLE_DEPTH_M = 0.025
PEG_SURPLUS_M = 0.002
"""The peg is longer than the hole, so that it seats on the base and the handle misses the rim."""
WALL_M = 0.006
HANDLE_M = (0.034, 0.034, 0.040)
BASE_M = (0.044, 0.044, 0.050)


def load_pair(config: SceneConfig) -> PartPair:
    """The pair that a scene asks for.

    Raises:
        ValueError: unknown pair, or a clearance that does not suit the plug.
        FileNotFoundError: missing folder or meshes of automate/ID.
    """
    if config.pair.startswith(MESH_PAIR_PREFIX):
        from lerobot_vtrefine.sim.mesh_pairs import load_mesh_parts  # its packages are optional

        return load_mesh_parts(config.pair, config.mesh_dir, config.mesh_scale)
    check_choice("pair", config.pair, PROCEDURAL_PAIRS, f" or {MESH_PAIR_PREFIX}ID")
    return procedural_pair(config.pair, config.hole_clearance_m)


def procedural_pair(name: str, clearance_m: float) -> PartPair:
    """Plug and socket built from primitives; a negative clearance makes the hole smaller than the plug."""
    peg_length = HOLE_DEPTH_M + PEG_SURPLUS_M
    profile = make_profile(name, peg_length)
    if abs(clearance_m) >= profile.smallest_width_m:
        raise ValueError(
            f"clearance_m = {clearance_m} is too large for the {name} plug: it must be below "
            f"{profile.smallest_width_m:.4f} m, the plug's smallest width"
        )
    handle_z = peg_length + HANDLE_M[2] / 2
    handle = Box(_half(HANDLE_M), (0.0, 0.0, handle_z))
    plug = Part((*profile.pieces, handle), Grip((0.0, 0.0, handle_z), _half(HANDLE_M)), rest_height_m=0.0)
    outline = offset_outline(profile.outline, clearance_m / 2)
    walls = wall_boxes(outline, WALL_M, -HOLE_DEPTH_M, 0.0)
    base_z = -HOLE_DEPTH_M - BASE_M[2] / 2
    base = Box(_half(BASE_M), (0.0, 0.0, base_z))
    # The hand takes the base at its upper edge: on the table the lower edge leaves no room for a pitched
    # hand.
    grip = Grip((0.0, 0.0, -0.040), (BASE_M[0] / 2, BASE_M[1] / 2, 0.015))
    socket = Part((base, *walls), grip, rest_height_m=HOLE_DEPTH_M + BASE_M[2])
    return PartPair(name, plug, socket, seated_z_m=-HOLE_DEPTH_M, travel_m=HOLE_DEPTH_M)


def _half(size: tuple[float, float, float]) -> tuple[float, float, float]:
    x, y, z = np.asarray(size) / 2
    return float(x), float(y), float(z)
