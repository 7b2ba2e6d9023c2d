"""A larger network on whole images, to tell what the sensors know from what the policy's encoder keeps of it.

It reads every pixel of the depth image as a point of the world, and every taxel. No policy starts from it.
Shapes: ``B`` samples, ``To`` frames, ``F`` = B To, ``H, W`` depth image, ``P`` pads of ``R`` x ``C`` taxels.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_vtrefine.datasets.features import (
    CAMERA_POSE_KEY,
    DEPTH_KEY,
    GRIDS_KEY,
    INTRINSICS_KEY,
    NOISE_LEVEL_KEY,
    STATE_KEY,
    SURFACE_KEY,
)
from lerobot_vtrefine.observation import VisuoTactileConfig
from lerobot_vtrefine.observation.depth import METRES_PER_MM, add_depth_noise, check_millimetres, deproject

FEATURES = 256
"""Of each sense."""
CHANNELS = (32, 64, 128, 128)


@dataclass
class SurfaceStep:
    """Makes ``SURFACE_KEY`` (B, 3, H, W) of raw frames: where every pixel's point lies, from the workspace's
    centre and in units of ``scale_m``; zeros where there is no return, or outside of the workspace.

    The same noise as in the policy's cloud, and half precision, which is 0.1 mm at most.
    """

    config: VisuoTactileConfig

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """The frame (B, ...) with the image beside the raw columns."""
        depth = observation[DEPTH_KEY].flatten(1, -3)[:, 0]
        check_millimetres(depth)
        pose = observation[CAMERA_POSE_KEY]
        points = deproject(depth * METRES_PER_MM, observation[INTRINSICS_KEY], pose).permute(1, 2, 0)
        low, high = (depth.new_tensor(corner) for corner in (self.config.crop_min_m, self.config.crop_max_m))
        inside = ((points >= low) & (points <= high)).all(-1) & (depth.flatten(1) > 0)
        points = add_depth_noise(points, observation[NOISE_LEVEL_KEY].flatten())
        scaled = (points - depth.new_tensor(self.config.center_m)) / self.config.scale_m
        image = torch.where(inside[..., None], scaled, 0.0).transpose(1, 2).unflatten(-1, depth.shape[1:])
        return {**observation, SURFACE_KEY: image.half()}


class StrongEncoder(nn.Module):
    """To frames -> (B, ``cond_dim``); with or without the depth image and the pads."""

    def __init__(
        self,
        surface: tuple[int, int] | None,
        pads: tuple[int, int, int] | None,
        state_dim: int,
        n_obs_steps: int,
    ) -> None:
        """``surface``: H and W; ``pads``: P, R and C."""
        super().__init__()
        self.surface = None if surface is None else _image_network(4, surface)
        self.pads = None if pads is None else _image_network(pads[0], pads[1:], strides=(1, 2, 2, 1))
        # The pattern of all taxels at once, as well: on pads a plain network is as good as a convolution.
        self.taxels = None if pads is None else _features(pads[0] * pads[1] * pads[2])
        self.state = _features(state_dim)
        seen = sum(part is not None for part in (self.surface, self.pads, self.taxels, self.state))
        self.cond_dim = n_obs_steps * seen * FEATURES

    @property
    def keys(self) -> tuple[str, ...]:
        """Columns that are read."""
        read = ((SURFACE_KEY, self.surface), (GRIDS_KEY, self.pads))
        return (*(key for key, part in read if part is not None), STATE_KEY)

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        """Surface (B, To, 3, H, W), readings (B, To, P, R, C), normalised state (B, To, Ds)."""
        lead = batch[STATE_KEY].shape[:2]
        found = [self.state(batch[STATE_KEY].flatten(0, 1))]
        if self.surface is not None:
            image = batch[SURFACE_KEY].flatten(0, 1).float()
            seen = (image != 0).any(1, keepdim=True)
            found.append(self.surface(torch.cat([image, seen], 1)))
        if self.pads is not None and self.taxels is not None:
            grids = batch[GRIDS_KEY].flatten(0, 1)
            found += [self.pads(grids), self.taxels(grids.flatten(1))]
        return torch.cat(found, -1).unflatten(0, lead).flatten(1)


def _image_network(
    channels: int, size: tuple[int, int], strides: tuple[int, ...] = (2, 2, 2, 1)
) -> nn.Sequential:
    """(F, channels, H, W) -> (F, FEATURES): convolutions, then a layer over the whole image, which keeps
    where everything is.
    """
    layers: list[nn.Module] = []
    for width, stride in zip(CHANNELS, strides, strict=True):
        layers += [nn.Conv2d(channels, width, 3, stride, padding=1), nn.GroupNorm(8, width), nn.ReLU()]
        channels, size = width, (-(-size[0] // stride), -(-size[1] // stride))
    return nn.Sequential(*layers, nn.Flatten(), *_features(channels * size[0] * size[1]))


def _features(in_dim: int) -> nn.Sequential:
    """(F, in_dim) -> (F, FEATURES)."""
    hidden = [nn.Linear(in_dim, 2 * FEATURES), nn.ReLU(), nn.Linear(2 * FEATURES, FEATURES)]
    return nn.Sequential(*hidden, nn.LayerNorm(FEATURES))
