"""What was found about a camera, as a file."""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lerobot_vtrefine.diagnose.verdict import write_atomically
from lerobot_vtrefine.files import decode, limits, read_json

SCHEMA = "vtrefine/camera-model@1"


@dataclass(frozen=True)
class CameraModel:
    """Where the camera is against where the dataset says, in its own optical axes, and its depths' scale."""

    translation_m: tuple[float, float, float] = limits(maximum=10.0, default=(0.0, 0.0, 0.0))
    """x right, y down, z forward."""
    rotation_rad: tuple[float, float, float] = limits(maximum=2 * math.pi, default=(0.0, 0.0, 0.0))
    """About x, then y, then z."""
    depth_scale: float = limits(above=0.0, maximum=1e4, default=1.0)
    """Measured over true depth."""

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form."""
        return {"schema": SCHEMA, **asdict(self)}

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        write_atomically(path, json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> "CameraModel":
        """Read the file; ValueError names it and what is wrong with it."""
        data = read_json(path)
        try:
            if not isinstance(data, dict) or data.pop("schema", None) != SCHEMA:
                raise ValueError(f'camera model must hold "schema": "{SCHEMA}"')
            return decode(cls, data, "camera model")
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
