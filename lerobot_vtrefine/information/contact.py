"""What is known of the contact of plug and socket: whether they touch, where, and on which side.

Shapes: ``B`` samples, ``E`` episodes; a contact is (touching, x, y, z) as of ``InsertionSim.part_touch``.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

TOUCHING, SIDE, PLACES = "touching", "side", ("contact_x", "contact_y")
SHARES = (TOUCHING, SIDE)
"""What is told as a share of frames; places are told as errors."""
SIDES = 4
SIDE_FROM_M = 1e-3
"""A contact whose centre is nearer to the socket's axis has no side: it is all around, or in the middle."""
RESAMPLES = 400
"""Of the episodes, behind every interval of a study."""


class Known(NamedTuple):
    """What a regressor knows of contacts in held-out frames; what no frame tells of is missing."""

    told: dict[str, tuple[float, float, float]]
    """With 95 % intervals. ``TOUCHING`` and ``SIDE``: share of the frames in which they are told rightly, of
    all frames and of those in contact at a side. ``PLACES``: RMS error in contact [mm]."""
    unseen: dict[str, float]
    """The same of one who sees nothing: who always names what is most frequent, or the mean."""


class ContactHead(nn.Module):
    """Features (B, C) -> (B, 3): log-odds of a contact, and its place in standard deviations."""

    mean: Tensor
    std: Tensor

    def __init__(self, in_dim: int, width: int, contact: Tensor) -> None:
        """``contact`` (N, 4): of the frames that are trained on."""
        super().__init__()
        places = contact[contact[:, 0] > 0, 1:3]
        known = len(places) > 1
        self.register_buffer("mean", places.mean(0) if known else torch.zeros(2))
        self.register_buffer("std", places.std(0).clamp(min=1e-6) if known else torch.ones(2))
        self.net = nn.Sequential(nn.Linear(in_dim, width), nn.ReLU(), nn.Linear(width, 3))

    def forward(self, features: Tensor) -> Tensor:
        """(B, C) -> (B, 3)."""
        return self.net(features)

    def loss(self, features: Tensor, contact: Tensor) -> Tensor:
        """Cross-entropy of touching, and squares of the place [standard deviations] where the parts touch."""
        found, touching = self(features), contact[:, 0]
        place = (contact[:, 1:3] - self.mean) / self.std
        missed = ((found[:, 1:] - place).square().mean(-1) * touching).mean()
        return functional.binary_cross_entropy_with_logits(found[:, 0], touching) + missed

    def places(self, found: Tensor) -> Tensor:
        """Places (B, 2) [m] out of what ``forward`` gave."""
        return found[:, 1:] * self.std + self.mean


def side_of(place: Tensor) -> Tensor:
    """(B,) which side of the socket's axis a place (B, 2) is on: +x, +y, -x, -y."""
    return torch.cat([place, -place], -1).argmax(-1)


def has_side(contact: Tensor) -> Tensor:
    """(B,) bool: whether a contact (B, 4) is on a side."""
    return contact[:, 1:3].norm(dim=-1) > SIDE_FROM_M


def scores(head: ContactHead, found: Tensor, contact: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
    """Per sample: what counts for each quantity, and whether the sample counts, (B,) each."""
    touching, place = contact[:, 0] > 0, head.places(found)
    right = (found[:, 0] > 0) == touching
    sides = side_of(place) == side_of(contact[:, 1:3])
    squares = (place - contact[:, 1:3]).square()
    everyone = torch.ones_like(right)
    return {TOUCHING: (right.float(), everyone), SIDE: (sides.float(), has_side(contact))} | {
        name: (squares[:, axis], touching) for axis, name in enumerate(PLACES)
    }


def summarise(sums: dict[str, tuple[Tensor, Tensor]], contact: Tensor, seed: int) -> Known:
    """Sums and counts per episode (E,) of ``scores``, and the held-out frames' contacts (N, 4)."""
    told = {}
    for name, (total, count) in sums.items():
        if count.sum() > 0:
            low, middle, high = _with_interval(total.cpu(), count.cpu(), seed)
            told[name] = _shown(name, middle), _shown(name, low), _shown(name, high)
    touching = contact[:, 0].mean()
    unseen = {TOUCHING: _shown(TOUCHING, max(touching, 1 - touching))}
    if SIDE in told:
        often = side_of(contact[has_side(contact), 1:3]).bincount(minlength=SIDES)
        unseen[SIDE] = _shown(SIDE, often.max() / often.sum())
    for axis, name in enumerate(PLACES):
        if name in told:
            unseen[name] = _shown(name, contact[contact[:, 0] > 0, 1 + axis].var(correction=0))
    return Known(told, unseen)


def _with_interval(total: Tensor, count: Tensor, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """2.5 %, mean and 97.5 % of a ratio, by a bootstrap over episodes."""
    rows = torch.randint(len(total), (RESAMPLES, len(total)), generator=torch.Generator().manual_seed(seed))
    counts = count[rows].sum(1)
    drawn = (total[rows].sum(1) / counts)[counts > 0]
    low, high = drawn.double().quantile(torch.tensor([0.025, 0.975], dtype=torch.float64))
    return low, total.sum() / count.sum(), high


def _shown(name: str, value: Tensor) -> float:
    """A share as it is; a mean square [m^2] as RMS [mm]."""
    return round(float(value) if name in SHARES else 1e3 * float(value) ** 0.5, 4)
