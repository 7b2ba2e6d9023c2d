"""Convex pieces of a part: those that leave its counterpart the room it has, and the few that hands meet.

A hole between convex pieces is smaller than the hole that was drawn, for each piece fills what its surface
leaves hollow, and parts that fit with a millimetre or two have none of that to spare. So a part is cut, by
planes across and along the axis of insertion, until no piece holds a point of the part's skin
(`lerobot_vtrefine.sim.mesh_skin`); then neighbours that can be one become one. A hand that closes on a
round wall would meet many of these pieces, each in contacts of its own, so for hands the part is cut once
more, with its holes filled. Needs manifold3d.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from lerobot_vtrefine.sim.mesh_skin import Skin, Surface, skin_of, solid_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cut:
    """How a part is cut; belongs to the cache's key."""

    skin: Skin = field(default_factory=Skin)
    most: int = 128
    """Pieces before neighbours become one; those that hold most of the skin are cut first."""


QUANTILES = (0.25, 0.5, 0.75)
"""Planes go through these of the points that a piece should not hold."""
ROUND_RAD = np.pi / 2
"""Where those points lie around more than this of the axis, only cuts through the axis help."""
SPARSE = 32
"""One point of the skin in so many is looked at first."""
TOUCHING_M = 1e-5


@dataclass(frozen=True)
class Pieces:
    """Corners (N, 3) of each convex piece [m]."""

    fitting: list[Array]
    """What the counterpart meets."""
    sides: list[Array]
    """What hands meet."""


def cut_into_pieces(part: Surface, other: Surface, cut: Cut) -> Pieces:
    """Cut a part into convex pieces.

    Args:
        part: the solid.
        other: its counterpart, assembled.
        cut: how finely.
    """
    return Pieces(*(_pieces(part, skin, cut) for skin in skin_of(part, other, cut.skin)))


def _pieces(part: Surface, skin: Array, cut: Cut) -> list[Array]:
    """Pieces that hold no point of the skin (N, 3)."""
    waiting, done = [_Piece.of(solid_of(part), skin)], list[_Piece]()
    while waiting and len(waiting) + len(done) < cut.most:
        worst = waiting.pop(int(np.argmax([len(piece.held) for piece in waiting])))
        halves = _halves(worst) if len(worst.held) else None
        if halves:
            waiting += halves
        else:
            done.append(worst)
    return [piece.corners for piece in _merged(waiting + done, skin)]


@dataclass(frozen=True, eq=False)
class _Piece:
    """A convex piece."""

    corners: Array
    held: Array
    """What of the skin it holds."""
    solid: Any = None
    """What of the part it stands for, as long as it may be cut."""

    @classmethod
    def of(cls, solid: Any, skin: Array) -> "_Piece":
        hull = ConvexHull(np.asarray(solid.to_mesh64().vert_properties)[:, :3])
        return cls(hull.points[hull.vertices], _within(hull, skin), solid)

    @property
    def size(self) -> float:
        return float(np.ptp(self.corners, axis=0).prod())


def _halves(piece: _Piece) -> tuple[_Piece, _Piece] | None:
    """Both sides of the plane after which they hold least; None where nothing can be cut."""
    best, least = None, np.inf
    for normal, offset in _planes(piece):
        halves = _cut(piece, normal, offset)
        if halves and sum(len(half.held) for half in halves) < least:
            best, least = halves, sum(len(half.held) for half in halves)
    return best


def _cut(piece: _Piece, normal: Array, offset: float) -> tuple[_Piece, _Piece] | None:
    solids = piece.solid.split_by_plane(tuple(normal), float(offset))
    if any(solid.is_empty() for solid in solids):
        return None
    try:
        first, second = (_Piece.of(solid, piece.held) for solid in solids)
    except QhullError:  # a sliver
        return None
    return first, second


def _planes(piece: _Piece) -> Iterator[tuple[Array, float]]:
    """Planes, normal (3,) and offset, through the axis, across it, and beside it."""
    held = piece.held
    middle = np.arctan2(*held[:, 1::-1].mean(0))
    azimuth = (np.arctan2(held[:, 1], held[:, 0]) - middle + np.pi) % (2 * np.pi) - np.pi
    for angle in middle + np.quantile(azimuth, QUANTILES):
        yield np.array([-np.sin(angle), np.cos(angle), 0.0]), 0.0
    if np.ptp(azimuth) > ROUND_RAD:
        return
    for normal in (np.array([0.0, 0.0, 1.0]), np.array([np.cos(middle), np.sin(middle), 0.0])):
        edges = np.unique((piece.corners @ normal).round(6))
        wanted = np.quantile(held @ normal, (0.0, *QUANTILES, 1.0))
        nearest = edges[np.abs(edges - wanted[:, None]).argmin(1)]
        yield from ((normal, offset) for offset in np.unique([*nearest, *wanted]))


def _merged(pieces: list[_Piece], skin: Array) -> list[_Piece]:
    """Neighbours become one, the smallest first, as long as that holds no more of the skin."""
    waiting, final = sorted(pieces, key=lambda piece: piece.size), list[_Piece]()
    few = skin[::SPARSE].copy()
    while waiting:
        piece = waiting.pop(0)
        for other in [*waiting, *final]:
            both = _joined(piece, other, skin, few)
            if both:
                waiting = sorted([both, *(w for w in waiting if w is not other)], key=lambda p: p.size)
                final = [kept for kept in final if kept is not other]
                break
        else:
            final.append(piece)
    return final


def _joined(first: _Piece, second: _Piece, skin: Array, few: Array) -> _Piece | None:
    low = np.maximum(first.corners.min(0), second.corners.min(0))
    high = np.minimum(first.corners.max(0), second.corners.max(0))
    if np.any(low > high + TOUCHING_M):
        return None
    hull = ConvexHull(np.vstack([first.corners, second.corners]))
    most = len(first.held) + len(second.held)
    if len(_within(hull, few)) > most:  # as most joints are refused, and by many points
        return None
    held = _within(hull, skin)
    return _Piece(hull.points[hull.vertices], held) if len(held) <= most else None


def _within(hull: ConvexHull, points: Array) -> Array:
    """Which of the points (N, 3) lie in a hull."""
    for column, low, high in zip(range(3), hull.min_bound, hull.max_bound, strict=True):
        points = points[(points[:, column] > low) & (points[:, column] < high)]
    # A plane a row: reductions over long rows are far faster than over as many short ones.
    beyond = hull.equations[:, :3] @ points.T + hull.equations[:, 3:]
    return points[beyond.max(0, initial=-np.inf) < 0]
