"""The depth camera: pinhole intrinsics, pose, and its grid of rays."""

from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.embodiments import CameraConfig, Embodiment
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.rotations import matrix_to_quat

MAX_DEPTH_M = 2.0


@dataclass(frozen=True)
class Camera:
    """Intrinsics [pixels] and pose of the OpenCV optical frame (x right, y down, z forward) in the world."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    position_m: np.ndarray
    """(3,)"""
    rotation: np.ndarray
    """(3, 3), columns are the optical axes in the world frame."""

    @property
    def intrinsics(self) -> np.ndarray:
        """(4,) float32: fx, fy, cx, cy."""
        return np.array([self.fx, self.fy, self.cx, self.cy], np.float32)

    @property
    def quat_wxyz(self) -> np.ndarray:
        """(4,) orientation of the optical frame."""
        return matrix_to_quat(self.rotation)

    def directions(self) -> np.ndarray:
        """Ray of every pixel's centre in the optical frame (H * W, 3), scaled to z = 1: distances are
        z-depths.
        """
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        rays = np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)], -1)
        return rays.reshape(-1, 3)


def make_camera(config: SceneConfig, embodiment: Embodiment) -> Camera:
    """The camera of a scene, the body's own unless the scene sets one up; square pixels, principal point in
    the middle, image upright.
    """
    settings = config.camera or embodiment.cameras[config.start]
    focal = settings.height / 2 / np.tan(settings.fov_y_rad / 2)
    rotation = _look_at(settings)
    return Camera(
        width=settings.width,
        height=settings.height,
        fx=float(focal),
        fy=float(focal),
        cx=(settings.width - 1) / 2,
        cy=(settings.height - 1) / 2,
        position_m=np.asarray(settings.position_m, float),
        rotation=rotation,
    )


def _look_at(settings: CameraConfig) -> np.ndarray:
    forward = np.subtract(settings.target_m, settings.position_m)
    distance = np.linalg.norm(forward)
    if not distance > 0.0 or abs(forward[2]) / distance > 0.9999:
        raise ValueError("camera.position_m and camera.target_m must differ, and not only in height")
    forward = forward / distance
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], 1)
