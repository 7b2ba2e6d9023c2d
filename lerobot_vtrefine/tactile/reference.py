"""Offline truth for the contact models: exact heights and Winkler forces in double precision, slow and plain.

Shares no code with the kernels.
"""

import numpy as np

from lerobot_vtrefine.tactile.geometry import (
    BodyGeometry,
    Box,
    ConvexHull,
    Cylinder,
    Primitive,
    Sphere,
    quaternion_matrix,
)
from lerobot_vtrefine.tactile.layout import PadLayout

Array = np.ndarray
NO_BODY_M = -1.0
FINENESS = 10
"""Points along each side of a taxel over which its exact force is averaged."""


def _slab(inside: Array, slope: Array, half: float) -> tuple[Array, Array]:
    """Where lines are within half-spaces |inside + s slope| <= half: (enter, leave)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort((np.stack([-half - inside, half - inside])) / slope, axis=0)
    parallel = np.abs(slope) < 1e-12
    within = np.abs(inside) <= half
    enter = np.where(parallel, np.where(within, -np.inf, np.inf), ends[0])
    return enter, np.where(parallel, np.inf, ends[1])


def _round(p: Array, e: Array, radius: float) -> tuple[Array, Array]:
    """Where lines p + s e are within a circle or sphere around the origin, by the components given."""
    a, b, c = e @ e, p @ e, (p * p).sum(-1) - radius**2
    if a < 1e-18:
        return np.where(c <= 0, -np.inf, np.inf), np.full(len(p), np.inf)
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    hit = b * b >= a * c
    return np.where(hit, (-b - root) / a, np.inf), np.where(hit, (-b + root) / a, -np.inf)


def _interval(primitive: Primitive, p: Array, e: Array) -> tuple[Array, Array]:
    """Where lines p (N, 3) + s e are inside a convex primitive, in its own frame: (enter, leave) (N,)."""
    if isinstance(primitive, Sphere):
        return _round(p, e, primitive.radius)
    if isinstance(primitive, Cylinder):
        sides, caps = _round(p[:, :2], e[:2], primitive.radius), _slab(p[:, 2], e[2], primitive.half_height)
        return np.maximum(sides[0], caps[0]), np.minimum(sides[1], caps[1])
    if not isinstance(primitive, Box | ConvexHull):
        raise ValueError(f"no exact reference for {type(primitive).__name__}: give its convex pieces")
    enter, leave = np.full(len(p), -np.inf), np.full(len(p), np.inf)
    for *normal, offset in primitive.planes():
        distance, slope = offset - p @ np.array(normal), float(np.array(normal) @ e)
        if abs(slope) < 1e-12:
            enter = np.where(distance < 0, np.inf, enter)
        elif slope < 0:
            enter = np.maximum(enter, distance / slope)
        else:
            leave = np.minimum(leave, distance / slope)
    return enter, leave


def exact_heights(body: BodyGeometry, position_m: Array, rotation: Array, points_m: Array) -> Array:
    """Column heights (N,) [m] of a body at a pose in the pad's frame, over points (N, 2); -1 for none.

    Raises:
        ValueError: the body holds a mesh.
    """
    starts = np.column_stack([points_m, np.zeros(len(points_m))]) - position_m
    heights = np.full(len(points_m), -np.inf)
    for primitive in body.primitives:
        own = np.eye(3), np.zeros(3)
        if isinstance(primitive, Box | Cylinder | Sphere):
            own = quaternion_matrix(primitive.quat), np.asarray(primitive.pos, dtype=float)
        axes = rotation @ own[0]
        enter, leave = _interval(
            primitive, starts @ axes - own[1] @ own[0], axes.T @ np.array([0.0, 0.0, 1.0])
        )
        heights = np.where((enter <= leave) & (leave >= 0), np.maximum(heights, -enter), heights)
    return np.where(np.isfinite(heights), heights, NO_BODY_M)


def winkler_forces(heights_m: Array, points_m: Array, stiffness_n_per_m: float, load: Array) -> Array:
    """Forces (N,) [N] of points (N, 2) on an elastic foundation that carry a load (force, centre x, y).

    Minimises the strain energy less the load's work over the face's offset and two tilts.

    Raises:
        ValueError: no offset and tilts balance the load.
    """
    basis = np.column_stack([np.ones(len(points_m)), points_m / 1e-3])
    target = load[0] / stiffness_n_per_m * np.array([1.0, load[1] / 1e-3, load[2] / 1e-3])
    heights = np.where(heights_m > NO_BODY_M / 2, heights_m, -np.inf)
    face = np.array([1e-3 - heights.max(), 0.0, 0.0])

    def merit(trial: Array) -> float:
        return 0.5 * float((np.maximum(heights + basis @ trial, 0) ** 2).sum()) - float(target @ trial)

    for _ in range(100):
        give = np.maximum(heights + basis @ face, 0)
        gradient = give @ basis - target
        if np.abs(gradient).max() <= 1e-11 * target[0]:
            return stiffness_n_per_m * give
        active = basis[give > 0]
        step = np.linalg.lstsq(active.T @ active + 1e-12 * np.eye(3), -gradient, rcond=None)[0]
        scale = 1.0
        while merit(face + scale * step) > merit(face) + 1e-15 and scale > 1e-6:
            scale /= 2
        face = face + scale * step
    if np.abs(gradient).max() <= 1e-7 * target[0]:
        return stiffness_n_per_m * np.maximum(heights + basis @ face, 0)
    raise ValueError("no position of the face balances this load: its centre lies outside of the contact")


def exact_forces(
    layout: PadLayout,
    body: BodyGeometry,
    position_m: Array,
    rotation: Array,
    foundation_n_per_m3: float,
    load: Array,
) -> Array:
    """Winkler forces (R, C) [N] of every taxel under a load, averaged over `FINENESS`^2 points per taxel."""
    fine = PadLayout(layout.rows * FINENESS, layout.cols * FINENESS, layout.pitch_m / FINENESS)
    points = fine.positions()[:, :2]
    heights = exact_heights(body, position_m, rotation, points)
    forces = winkler_forces(heights, points, foundation_n_per_m3 * fine.taxel_area_m2, load)
    return forces.reshape(layout.rows, FINENESS, layout.cols, FINENESS).sum((1, 3))
