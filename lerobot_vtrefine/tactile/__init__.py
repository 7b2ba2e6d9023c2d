"""The tactile sensor as mathematics: pad layout, contact geometry, and the sensor model from contact to raw
counts.

Importing it imports neither torch nor warp: layouts and shapes, which command lines ask for, need none.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from lerobot_vtrefine.tactile.geometry import BodyGeometry, Box, ConvexHull, Cylinder, Sphere, TriangleMesh
from lerobot_vtrefine.tactile.layout import PadLayout

if TYPE_CHECKING:
    from lerobot_vtrefine.tactile.model import SensorModel
    from lerobot_vtrefine.tactile.poses import Poses
    from lerobot_vtrefine.tactile.sensors import PadSensors

_ON_FIRST_USE = {"SensorModel": "model", "Poses": "poses", "PadSensors": "sensors"}

__all__ = [
    "BodyGeometry",
    "Box",
    "ConvexHull",
    "Cylinder",
    "PadLayout",
    "PadSensors",
    "Poses",
    "SensorModel",
    "Sphere",
    "TriangleMesh",
]


def __getattr__(name: str) -> Any:
    if name not in _ON_FIRST_USE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_ON_FIRST_USE[name]}"), name)
