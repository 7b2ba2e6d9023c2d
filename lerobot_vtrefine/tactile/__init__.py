"""The tactile sensor as mathematics: pad layout, contact geometry, and the sensor model from contact to raw
counts.

Importing it does not import warp; the first use of `PadSensors` does.
"""

from lerobot_vtrefine.tactile.geometry import BodyGeometry, Box, ConvexHull, Cylinder, Sphere, TriangleMesh
from lerobot_vtrefine.tactile.layout import PadLayout, layout_from_mesh
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.poses import Poses
from lerobot_vtrefine.tactile.sensors import PadSensors

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
    "layout_from_mesh",
]
