"""Tangential force per taxel: the solver's tangential force on a pad, shared out with stick and slip.

FlexiTac measures pressure only, so this is no part of the counts: it is a channel of its own, for sensors
that measure shear and for whoever wants to see slip.

Shapes: m environments, P pads, R x C taxels; x, y in the pad's frame.
"""

from dataclasses import dataclass

import torch

from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.poses import Poses

NEWTON_STEPS = 30
FULL_SLIP = 1 - 1e-5
"""Share of the friction limit above which a pad counts as slipping as a whole."""


@dataclass(frozen=True)
class Shear:
    """An elastic skin under friction: each taxel sticks up to `friction` times its normal force, then slips.

    Raises ValueError unless both parameters are positive.
    """

    friction: float = 1.0
    """Coulomb's coefficient, as the solver has it for the pads."""
    stiffness_n_per_m: float = 400.0
    """Tangential stiffness of one taxel."""

    def __post_init__(self) -> None:
        for name in ("friction", "stiffness_n_per_m"):
            if not getattr(self, name) > 0:
                raise ValueError(f"shear.{name} must be positive, got {getattr(self, name)}")

    def step(
        self, normal: torch.Tensor, strain: torch.Tensor, motion: torch.Tensor, total: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """One frame: tangential forces on the taxels [N] and the skin's strain after it [m].

        Forces add up to `total` as far as friction allows, and to friction times the normal sum beyond.

        Args:
            normal: (m, P, R, C) normal force per taxel [N].
            strain: (m, P, R, C, 2) displacement of the skin that each taxel remembers [m].
            motion: (m, P, R, C, 2) displacement of the body over the pad since the last frame [m].
            total: (m, P, 2) the solver's tangential force on the pad [N].
        """
        limit = (self.friction * normal)[..., None]
        total = _capped(total[..., None, None, :], limit.sum((-3, -2), keepdim=True))
        trial = self.stiffness_n_per_m * (strain + motion)
        force = _capped(trial + self._common_force(trial, limit, total), limit)
        slipping = total.norm(dim=-1, keepdim=True) >= FULL_SLIP * limit.sum((-3, -2), keepdim=True)
        share = limit / limit.sum((-3, -2), keepdim=True).clamp(min=1e-12)
        force = torch.where(slipping, share * total, force)
        return force, force / self.stiffness_n_per_m

    @staticmethod
    def _common_force(trial: torch.Tensor, limit: torch.Tensor, total: torch.Tensor) -> torch.Tensor:
        """What must be added to every taxel's trial force for the capped forces to add up: (m, P, 1, 1, 2).

        Newton's method on a monotone function; a stuck taxel gives way in all directions, a slipping one
        only across its force.
        """
        common = torch.zeros_like(total)
        eye = torch.eye(2, dtype=trial.dtype, device=trial.device)
        for _ in range(NEWTON_STEPS):
            wanted = trial + common
            size = wanted.norm(dim=-1, keepdim=True).clamp(min=1e-12)
            missing = total - _capped(wanted, limit).sum((-3, -2), keepdim=True)
            along = (wanted / size)[..., :, None] * (wanted / size)[..., None, :]
            give = torch.where(
                (size <= limit)[..., None], eye.expand_as(along), (limit / size)[..., None] * (eye - along)
            )
            slope = give.sum((-4, -3), keepdim=True)
            step = torch.linalg.solve(slope + 1e-3 * eye, missing[..., None])[..., 0]
            # Where nearly all slip the slope vanishes: steps no longer than the way so far.
            longest = (missing.norm(dim=-1) + common.norm(dim=-1))[..., None]
            common = common + _capped(step, longest)
        return common


class ShearSensors:
    """Shear of the pads of `num_envs` environments, with each environment's memory kept here."""

    def __init__(
        self, layout: PadLayout, num_envs: int, num_pads: int = 4, model: Shear | None = None
    ) -> None:
        self.model = model or Shear()
        columns, rows = (torch.as_tensor(axis, dtype=torch.float64) for axis in layout.axes_m())
        self._place = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
        self._strain = torch.zeros((num_envs, num_pads, layout.rows, layout.cols, 2), dtype=torch.float64)

    def reset(self, ids: torch.Tensor) -> None:
        """Forget what environments `ids` (m,) had felt."""
        self._strain[ids] = 0.0

    def forces(
        self,
        ids: torch.Tensor,
        normal: torch.Tensor,
        poses: Poses,
        dt_s: float,
        total: torch.Tensor,
        body: int = 0,
    ) -> torch.Tensor:
        """Tangential force per taxel on the pad, in its frame: (m, P, R, C, 2) [N]; advances one frame.

        Args:
            normal: (m, P, R * C) normal forces, as `PadSensors.forces` gives them [N].
            poses: as for `PadSensors`.
            total: (m, P, 2) the solver's tangential force on each pad [N].
            body: which body the pads hold; its motion over the pads strains the skin.
        """
        strain = self._strain[ids]
        image = torch.as_tensor(normal, dtype=torch.float64).reshape(strain.shape[:-1])
        motion = dt_s * slip_velocity(self._place, poses, body)
        wanted = torch.as_tensor(total, dtype=torch.float64)
        force, self._strain[ids] = self.model.step(image, strain, motion, wanted)
        return force


def slip_velocity(place: torch.Tensor, poses: Poses, body: int) -> torch.Tensor:
    """Velocity of a body over points `place` (R, C, 2) of every pad, in its plane: (m, P, R, C, 2) [m/s]."""
    given = (torch.as_tensor(item, dtype=torch.float64) for item in poses)
    pad_pos, pad_rot, pad_vel, body_pos, _, body_vel = given
    to_pad = pad_pos - body_pos[:, body, None]
    turning = body_vel[:, body, None, 3:].expand_as(to_pad)
    linear = body_vel[:, body, None, :3] + torch.linalg.cross(turning, to_pad) - pad_vel[..., :3]
    back = pad_rot.transpose(-1, -2)
    sliding = (back @ linear[..., None])[..., :2, 0]
    spin = (back @ (turning - pad_vel[..., 3:])[..., None])[..., 2, 0]
    lever = torch.stack([-place[..., 1], place[..., 0]], -1)
    return sliding[..., None, None, :] + spin[..., None, None, None] * lever


def _capped(vectors: torch.Tensor, limit: torch.Tensor) -> torch.Tensor:
    """Vectors (..., 2) shortened to `limit` (..., 1) where they are longer."""
    return vectors * (limit / vectors.norm(dim=-1, keepdim=True).clamp(min=1e-30)).clamp(max=1.0)
