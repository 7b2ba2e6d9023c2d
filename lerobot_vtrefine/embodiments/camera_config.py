"""One depth camera, as a body carries it or a scene sets it up."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraConfig:
    """One depth camera; a ray grid, no lens."""

    width: int
    """Pixels of the depth image."""
    height: int
    """Pixels of the depth image."""
    fov_y_rad: float
    """Vertical field of view."""
    position_m: tuple[float, float, float]
    """Where its rays begin, in the world's frame."""
    target_m: tuple[float, float, float]
    """Point that lies on the optical axis."""

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera needs at least one pixel, got {self.width} x {self.height}")
        if not 0.0 < self.fov_y_rad < 3.0:
            raise ValueError(f"camera.fov_y_rad must lie between 0 and 3 rad, got {self.fov_y_rad}")
