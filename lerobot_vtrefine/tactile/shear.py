"""Tangential force per taxel: the solver's tangential force on a pad, shared out with stick and slip.

FlexiTac measures pressure only, so shear does not enter the counts: it is a channel of its own, for sensors
that measure shear and for those who want to see slip.

Shapes: m environments of n, P pads, B bodies, R x C taxels; x, y in the pad's frame, forces on the pad.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.poses import ArrayLike, Poses

NEWTON_STEPS = 50
ENOUGH_N = 1e-9
"""Forces that add up to their total this well are good enough."""
FULL_SLIP = 1 - 1e-5
"""Share of the friction limit above which a pad counts as slipping as a whole."""


@dataclass(frozen=True)
class Shear:
    """An elastic skin under friction: each taxel sticks up to `friction` times its normal force, then slips.

    Raises ValueError unless both parameters are positive.
    """

    friction: float | torch.Tensor
    """Coulomb's coefficient, as the solver has it for the pads; one, or one per environment (m, 1, 1, 1)."""
    stiffness_n_per_m: float
    """Tangential stiffness of one taxel."""

    def __post_init__(self) -> None:
        for name in ("friction", "stiffness_n_per_m"):
            value = getattr(self, name)
            if not bool(torch.as_tensor(value > 0).all()):
                raise ValueError(f"shear.{name} must be positive, got {value}")

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
        only across its force. Steps that leave more missing are halved.
        """
        loaded = (limit > 0).to(trial.dtype)
        count = loaded.sum((-3, -2), keepdim=True).clamp(min=1.0)
        best = trial_common = (total - (loaded * trial).sum((-3, -2), keepdim=True)) / count
        step, least = torch.zeros_like(best), torch.full_like(best[..., :1], torch.inf)
        for _ in range(NEWTON_STEPS):
            wanted = trial + trial_common
            missing = total - _capped(wanted, limit).sum((-3, -2), keepdim=True)
            size = missing.norm(dim=-1, keepdim=True)
            better = size < least
            best, least = torch.where(better, trial_common, best), torch.minimum(least, size)
            if least.numel() == 0 or float(least.max()) < ENOUGH_N:
                break
            step = torch.where(better, _solve(_slope(wanted, limit), missing), 0.5 * step)
            trial_common = best + step
        return best


class ShearSensors:
    """Shear of the pads of n environments, with each environment's memory kept here.

    Args:
        layout: taxels of every pad.
        num_envs: n.
        held: for each of the P pads, which of the B bodies it holds; that body's motion over the pad strains
            the skin.
        model: friction and stiffness.
        device: torch device on which everything is computed.
    """

    def __init__(
        self, layout: PadLayout, num_envs: int, held: Sequence[int], model: Shear, device: str = "cpu"
    ) -> None:
        self.model, self._held, self._device = model, list(held), device
        columns, rows = (
            torch.as_tensor(axis, dtype=torch.float64, device=device) for axis in layout.axes_m()
        )
        self._place = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
        shape = (num_envs, len(self._held), layout.rows, layout.cols, 2)
        self._strain = torch.zeros(shape, dtype=torch.float64, device=device)
        self._force = torch.zeros(shape, dtype=torch.float32, device=device)
        self._friction = torch.ones(num_envs, dtype=torch.float64, device=device) * model.friction

    def reset(self, ids: ArrayLike, friction: ArrayLike | None = None) -> None:
        """Forget what environments `ids` (m,) had felt, and give them their own friction (m,)."""
        index = self._index(ids)
        self._strain[index], self._force[index] = 0.0, 0.0
        if friction is not None:
            self._friction[index] = torch.as_tensor(friction, dtype=torch.float64, device=self._device)

    def advance(
        self, ids: ArrayLike, normal: ArrayLike, poses: Poses, dt_s: float, total: ArrayLike
    ) -> torch.Tensor:
        """One frame of environments `ids` (m,).

        Args:
            ids: (m,) without repetition.
            normal: (m, P, R * C) normal forces, as `PadSensors.forces` gives them [N].
            poses: as for `PadSensors`.
            dt_s: time since the previous frame [s].
            total: (m, P, 2) the solver's tangential force on each pad [N].

        Returns:
            Tangential force per taxel on the pad, in its frame: (m, P, R, C, 2) float32 [N].
        """
        index = self._index(ids)
        strain = self._strain[index]
        motion = dt_s * slip_velocity(self._place, Poses(*map(self._tensor, poses)), self._held)
        model = replace(self.model, friction=self._friction[index].view(-1, 1, 1, 1))
        image = self._tensor(normal).reshape(strain.shape[:-1])
        force, self._strain[index] = model.step(image, strain, motion, self._tensor(total))
        self._force[index] = force.to(torch.float32)
        return self._force[index]

    def forces(self, ids: ArrayLike) -> torch.Tensor:
        """What the last frame gave: (m, P, R, C, 2) float32 [N], zeros after a reset."""
        return self._force[self._index(ids)]

    def get_state(self, env: int) -> dict[str, torch.Tensor]:
        """Everything that one environment's next readings depend on, apart from its poses and forces."""
        parts = {"strain": self._strain, "force": self._force, "friction": self._friction}
        return {name: part[env].clone() for name, part in parts.items()}

    def set_state(self, env: int | ArrayLike, state: dict[str, ArrayLike]) -> None:
        """Inverse of `get_state`; of several environments (m,), values are (m, ...)."""
        for name, own in (("strain", self._strain), ("force", self._force), ("friction", self._friction)):
            own[env] = torch.as_tensor(state[name], device=self._device)

    def _index(self, ids: ArrayLike) -> torch.Tensor:
        return torch.as_tensor(ids, dtype=torch.long, device=self._device)

    def _tensor(self, array: ArrayLike) -> torch.Tensor:
        return torch.as_tensor(array, dtype=torch.float64, device=self._device)


def slip_velocity(place: torch.Tensor, poses: Poses, held: Sequence[int]) -> torch.Tensor:
    """Velocity of the body that each pad holds over points `place` (R, C, 2) of the pad, in its plane.

    Args:
        place: points in the pads' frames [m].
        poses: float64 tensors.
        held: (P,) bodies.

    Returns:
        (m, P, R, C, 2) [m/s].
    """
    pad_pos, pad_rot, pad_vel, body_pos, _, body_vel = (torch.as_tensor(item) for item in poses)
    chosen = torch.as_tensor(held, device=body_pos.device)
    body_pos, body_vel = body_pos[:, chosen], body_vel[:, chosen]
    turning = body_vel[..., 3:]
    linear = body_vel[..., :3] + torch.linalg.cross(turning, pad_pos - body_pos) - pad_vel[..., :3]
    back = pad_rot.transpose(-1, -2)
    sliding = (back @ linear[..., None])[..., :2, 0]
    spin = (back @ (turning - pad_vel[..., 3:])[..., None])[..., 2, 0]
    lever = torch.stack([-place[..., 1], place[..., 0]], -1)
    return sliding[..., None, None, :] + spin[..., None, None, None] * lever


def _slope(wanted: torch.Tensor, limit: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Derivative of the sum of capped forces: xx, xy, yy of a symmetric matrix, each (m, P, 1, 1, 1)."""
    size = wanted.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    x, y = (wanted / size).split(1, dim=-1)
    stuck, give = size <= limit, limit / size
    parts = (torch.where(stuck, 1.0, give * y * y), torch.where(stuck, 0.0, -give * x * y))
    parts += (torch.where(stuck, 1.0, give * x * x),)
    xx, xy, yy = (part.sum((-3, -2), keepdim=True) for part in parts)
    return xx + 1e-3, xy, yy + 1e-3


def _solve(slope: tuple[torch.Tensor, torch.Tensor, torch.Tensor], right: torch.Tensor) -> torch.Tensor:
    """Solution (..., 2) of 2 x 2 systems with a positive definite matrix."""
    xx, xy, yy = slope
    x, y = right.split(1, dim=-1)
    return torch.cat([yy * x - xy * y, xx * y - xy * x], -1) / (xx * yy - xy * xy)


def _capped(vectors: torch.Tensor, limit: torch.Tensor) -> torch.Tensor:
    """Vectors (..., 2) shortened to `limit` (..., 1) where they are longer."""
    return vectors * (limit / vectors.norm(dim=-1, keepdim=True).clamp(min=1e-30)).clamp(max=1.0)
