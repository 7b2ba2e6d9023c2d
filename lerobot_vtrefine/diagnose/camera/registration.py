"""Fit the camera's pose and the scale of its depths to what the twin's arms and table would look like.

Every pixel compares the measured depth with the twin's, rendered at the recorded joints. To first order a
camera that moves by t and turns by w (both in its own axes) changes the depth of a surface point p with
normal n, seen along the ray d, by -(n.t + w.(p x n)) / (n.d); after each step the twin is rendered anew.
Parts that the twin does not hold are outliers and cut off.

Shapes: F frames, H x W pixels, parameters (7,): t [m], w [rad], log of the scale.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from lerobot_vtrefine.diagnose.camera.frames import DepthFrames
from lerobot_vtrefine.diagnose.camera.rules import CUT_M, EDGE_M, FIRST_CUT_M, GRAZING
from lerobot_vtrefine.diagnose.core.normal_equations import solved
from lerobot_vtrefine.sim.camera import Camera
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.depth import DepthCamera
from lerobot_vtrefine.sim.rotations import about_axis
from lerobot_vtrefine.sim.scene import build_arms

Array = np.ndarray

PARAMETERS = 7
EXTRINSICS = np.array([True] * 6 + [False])
SCALE = ~EXTRINSICS
_ITERATIONS = 8


class Twin:
    """Renders the twin's arms and table for recorded frames."""

    def __init__(self, frames: DepthFrames) -> None:
        self.frames = frames
        self.model, _, address = build_arms(SceneConfig())
        count, height, width = frames.depth_m.shape
        fx, fy, cx, cy = (float(value) for value in frames.intrinsics)
        eye = Camera(width, height, fx, fy, cx, cy, frames.position_m[0], frames.rotation[0])
        self.rays = eye.directions().reshape(height, width, 3)
        self.camera = DepthCamera(self.model, eye, count)
        data = mujoco.MjData(self.model)
        position, rotation = [], []
        for joints in frames.joints:
            data.qpos[address] = joints
            mujoco.mj_kinematics(self.model, data)
            position.append(data.geom_xpos.copy())
            rotation.append(data.geom_xmat.reshape(-1, 3, 3).copy())
        self.poses = np.stack(position), np.stack(rotation)

    def render(self, theta: Array) -> Array:
        """z-depth (F, H, W) [m] from the stated camera moved by theta; NaN where nothing is hit."""
        stated = self.frames.rotation
        turn = rotation_of(theta[3:6])
        position = self.frames.position_m + stated @ theta[:3]
        ids = np.arange(len(stated))
        self.camera.set_cameras(ids, position, stated @ turn)
        depth = self.camera.render(ids, *self.poses).astype(float)
        return np.where(depth > 0, depth, np.nan)


def rotation_of(vector: Array) -> Array:
    """Rotation (3, 3) by small angles about x, then y, then z."""
    x, y, z = vector
    return about_axis(0, x) @ about_axis(1, y) @ about_axis(2, z)


@dataclass(frozen=True)
class Registration:
    """A fit: its parameters, and curvature and gradient of every frame there."""

    theta: Array
    free: Array
    normal: Array
    """(F, 7, 7)"""
    slope: Array
    """(F, 7)"""

    def reweighted(self, weights: Array) -> Array:
        """Parameters (7,) if every frame counted `weights` (F,) times, to first order."""
        return self.theta + _step(self.normal, self.slope, weights, self.free)


def register(twin: Twin, free: Array) -> Registration:
    """Fit the free parameters (7,) bool to the frames."""
    theta = np.zeros(PARAMETERS)
    weights = np.ones(len(twin.frames.depth_m))
    for iteration in range(_ITERATIONS):
        cut = max(CUT_M, FIRST_CUT_M * 0.6**iteration)
        normal, slope = _equations(twin, theta, cut)
        if not free.any():
            break
        step = _step(normal, slope, weights, free)
        theta = theta + step
        if np.abs(step).max() < 1e-6:
            break
    normal, slope = _equations(twin, theta, CUT_M)
    return Registration(theta, free, normal, slope)


def errors(twin: Twin, theta: Array) -> Array:
    """Mean squared depth error (F,) [m^2] of every frame; differences beyond the cut count as the cut."""
    left, _ = _residual(twin, theta)
    return np.nanmean(np.minimum(left**2, CUT_M**2), axis=(1, 2))


def _residual(twin: Twin, theta: Array) -> tuple[Array, Array]:
    """Measured minus predicted (F, H, W), NaN where either is missing; and the twin's depth."""
    depth = twin.render(theta)
    measured = np.where(twin.frames.depth_m > 0, twin.frames.depth_m, np.nan)
    return measured - np.exp(theta[6]) * depth, depth


def _equations(twin: Twin, theta: Array, cut: float) -> tuple[Array, Array]:
    left, depth = _residual(twin, theta)
    point = depth[..., None] * twin.rays
    normal = np.full(point.shape, np.nan)
    across, down = (np.full(point.shape, np.nan) for _ in range(2))
    across[:, :, 1:-1] = point[:, :, 2:] - point[:, :, :-2]
    down[:, 1:-1] = point[:, 2:] - point[:, :-2]
    normal = np.cross(across, down)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    facing = (normal * twin.rays).sum(-1)
    bend = np.full(depth.shape, np.nan)
    bend[:, 1:-1, 1:-1] = np.maximum(
        np.abs(depth[:, 1:-1, 2:] + depth[:, 1:-1, :-2] - 2 * depth[:, 1:-1, 1:-1]),
        np.abs(depth[:, 2:, 1:-1] + depth[:, :-2, 1:-1] - 2 * depth[:, 1:-1, 1:-1]),
    )
    good = (bend < EDGE_M) & (np.abs(facing) > GRAZING) & (np.abs(left) < cut) & np.isfinite(left)
    scale = np.exp(theta[6])
    jacobian = np.zeros((*left.shape, PARAMETERS))
    safe = np.where(good, facing, 1.0)[..., None]
    jacobian[..., :3] = -scale * normal / safe
    jacobian[..., 3:6] = -scale * np.cross(point, normal) / safe
    jacobian[..., 6] = scale * depth
    jacobian = np.where(good[..., None], jacobian, 0.0).reshape(len(left), -1, PARAMETERS)
    left = np.where(good, left, 0.0).reshape(len(left), -1)
    return jacobian.transpose(0, 2, 1) @ jacobian, np.einsum("fpk,fp->fk", jacobian, left)


def _step(normal: Array, slope: Array, weights: Array, free: Array) -> Array:
    total, right = np.tensordot(weights, normal, 1)[np.ix_(free, free)], (weights @ slope)[free]
    out = np.zeros(PARAMETERS)
    out[free] = solved(total, right, 1e-9)
    return out
