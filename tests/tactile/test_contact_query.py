"""Contact geometry against float64 references: depths, column heights, rates, moves of the whole scene."""

import numpy as np
import pytest
import warp as wp
from touch_shapes import (
    box_mesh,
    closest_distance,
    hexagon,
    inside_of,
    penetration_of,
    random_rotation,
    ring_mesh,
    scanned_heights,
    single_query,
)

from lerobot_vtrefine.tactile import BodyGeometry, Box, ConvexHull, Cylinder, PadLayout, Sphere, TriangleMesh
from lerobot_vtrefine.tactile.contact_query import REACH_M, ContactQuery, start_warp
from lerobot_vtrefine.tactile.geometry import Primitive

LAYOUT = PadLayout(6, 12, 0.002)
CONVEX = {
    "box": Box((0.008, 0.006, 0.01)),
    "cylinder": Cylinder(0.008, 0.01),
    "sphere": Sphere(0.009),
    "hull": hexagon(),
}


def touching_poses(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random orientations near the pad's face."""
    rng = np.random.default_rng(seed)
    rotation = np.stack([random_rotation(rng) for _ in range(count)])
    position = np.column_stack([rng.uniform(-6, 6, (count, 2)), rng.uniform(4, 12, count)]) * 1e-3
    return position, rotation


def taxels_in_body(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    return (LAYOUT.positions() - position) @ rotation


@pytest.mark.parametrize("name", sorted(CONVEX))
def test_penetration_is_exact(name: str) -> None:
    position, rotation = touching_poses(20, 0)
    depth, _ = single_query(
        ContactQuery(LAYOUT, [BodyGeometry([CONVEX[name]])]), "closest", position, rotation
    )
    expected = [
        penetration_of(CONVEX[name])(taxels_in_body(p, r)) for p, r in zip(position, rotation, strict=True)
    ]
    expected = np.maximum(np.array(expected), 0).reshape(depth.shape)
    assert (expected > 0).sum() > 100
    assert np.abs(depth - np.minimum(expected, REACH_M)).max() < 1e-6


@pytest.mark.parametrize("name", sorted(CONVEX))
def test_column_heights_are_exact(name: str) -> None:
    position, rotation = touching_poses(12, 1)
    heights, _ = single_query(
        ContactQuery(LAYOUT, [BodyGeometry([CONVEX[name]])]), "column", position, rotation
    )
    checked = 0
    for p, r, height in zip(position, rotation, heights.reshape(12, -1), strict=True):
        expected = scanned_heights(inside_of(CONVEX[name]), taxels_in_body(p, r), r.T @ [0, 0, 1], REACH_M)
        both = np.isfinite(expected) & (height > -0.5) & (height < 0.99 * REACH_M)
        assert np.abs(height - expected)[both].max(initial=0) < 1e-6
        # Columns that graze an edge may be seen by one method only; no others.
        assert (np.isfinite(expected) & (height <= -0.5)).sum() <= 1
        checked += both.sum()
    assert checked > 150


def test_a_box_a_hull_and_a_mesh_of_the_same_box_agree() -> None:
    half = (0.008, 0.006, 0.01)
    shapes: list[Primitive] = [Box(half), ConvexHull(*box_mesh(half)), TriangleMesh(*box_mesh(half))]
    position, rotation = touching_poses(20, 2)
    position[:, 2] = -(rotation @ box_mesh(half)[0].T)[:, 2].min(axis=1) - 0.002
    velocity = np.random.default_rng(3).normal(0, 0.1, (20, 6))
    for mode in ("closest", "column"):
        results = [
            single_query(ContactQuery(LAYOUT, [BodyGeometry([shape])]), mode, position, rotation, velocity)
            for shape in shapes
        ]
        for depth, rate in results[1:]:
            same = np.abs(depth - results[0][0]) < 1e-6
            assert (~same).sum() <= 2
            touched = same & (depth > (1e-5 if mode == "closest" else -0.5)) & (depth < 0.99 * REACH_M)
            # Two faces may be equally near; then the rate is of either.
            assert (np.abs(rate - results[0][1])[touched] > 1e-4).mean() < 0.02


def test_a_concave_mesh_is_exact_in_both_modes() -> None:
    mesh = ring_mesh()
    position, rotation = touching_poses(12, 4)
    position[:, 2] += 0.003
    query = ContactQuery(LAYOUT, [BodyGeometry([mesh])])
    heights, _ = single_query(query, "column", position, rotation)
    depths, _ = single_query(query, "closest", position, rotation)
    corners = mesh.vertices[mesh.faces]
    touched = 0
    for p, r, height, depth in zip(
        position, rotation, heights.reshape(12, -1), depths.reshape(12, -1), strict=True
    ):
        points, normal = taxels_in_body(p, r), r.T @ np.array([0, 0, 1.0])
        expected = lowest_crossing(corners, points, normal)
        both = np.isfinite(expected) & (height > -0.5)
        assert np.abs(height - expected)[both].max(initial=0) < 1e-6
        assert (np.isfinite(expected) != (height > -0.5)).sum() <= 1
        distance = closest_distance(mesh, points[depth > 0])
        assert np.abs(depth[depth > 0] - distance).max(initial=0) < 1e-6
        touched += (depth > 0).sum()
    assert touched > 30


def winding_number(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How often triangles (F, 3, 3) go round points (N,), by solid angles: 1 inside, 0 outside."""
    a, b, c = (corners[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(item, axis=-1) for item in (a, b, c))
    volume = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
    scale = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return np.arctan2(volume, scale).sum(1) / (2 * np.pi)


def test_a_mesh_is_felt_wherever_a_taxel_is_inside_and_nowhere_else() -> None:
    """Whole pads in and around a ring: sign and depth at edges, in the bore and deeper than the reach."""
    mesh, thick = ring_mesh(), TriangleMesh(*box_mesh((0.012, 0.011, 0.01)))
    rng = np.random.default_rng(11)
    for shape in (mesh, thick):
        query = ContactQuery(LAYOUT, [BodyGeometry([shape])])
        rotation = np.stack([random_rotation(rng) for _ in range(12)])
        position = rng.uniform(-6e-3, 6e-3, (12, 3))
        depths, _ = single_query(query, "closest", position, rotation)
        for p, r, depth in zip(position, rotation, depths.reshape(12, -1), strict=True):
            points = taxels_in_body(p, r)
            inside = winding_number(shape.vertices[shape.faces], points) > 0.5
            expected = np.where(inside, np.minimum(closest_distance(shape, points), REACH_M), 0)
            assert np.abs(depth - expected).max() < 2e-6


def lowest_crossing(corners: np.ndarray, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Height (N,) of the lowest crossing within reach of lines through points with those facing the pad."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    facing = np.cross(u, v) @ normal < 0
    heights = np.full(len(points), np.nan)
    for a, e, f in zip(corners[facing, 0], u[facing], v[facing], strict=True):
        solution = np.linalg.solve(np.stack([e, f, -normal], 1), (points - a).T)
        s = solution[2]
        hit = (solution[0] >= 0) & (solution[1] >= 0) & (solution[:2].sum(0) <= 1) & (np.abs(s) <= REACH_M)
        heights = np.where(hit, np.fmax(heights, -s), heights)
    return heights


@pytest.mark.parametrize("name", [*sorted(CONVEX), "mesh"])
@pytest.mark.parametrize("mode", ["closest", "column"])
def test_rates_are_the_derivative_of_depth(name: str, mode: str) -> None:
    shape = ring_mesh() if name == "mesh" else CONVEX[name]
    query = ContactQuery(LAYOUT, [BodyGeometry([shape])])
    position, rotation = touching_poses(16, 5)
    rng = np.random.default_rng(6)
    linear, angular = rng.normal(0, 0.1, (16, 3)), rng.normal(0, 2.0, (16, 3))
    _, rate = single_query(query, mode, position, rotation, np.concatenate([linear, angular], 1))
    step = 2e-4
    ends = []
    for sign in (-1, 1):
        spin = np.stack([rotation_of(sign * step * w) for w in angular])
        ends.append(single_query(query, mode, position + sign * step * linear, spin @ rotation)[0])
    slope = (ends[1] - ends[0]) / (2 * step)
    usable = (np.minimum(*ends) > (1e-6 if mode == "closest" else -0.0025)) & (
        np.maximum(*ends) < 0.99 * REACH_M
    )
    assert usable.sum() > 60
    # Where the nearest face changes within the step, or the wall is steep, differences mean nothing.
    assert np.median(np.abs(rate - slope)[usable]) < 2e-3
    assert (np.abs(rate - slope)[usable] < 0.02).mean() > 0.85


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_moving_the_whole_scene_changes_nothing() -> None:
    rng = np.random.default_rng(7)
    query = ContactQuery(LAYOUT, [BodyGeometry([CONVEX["box"], ring_mesh()])])
    position, rotation = touching_poses(8, 8)
    still, _ = single_query(query, "column", position, rotation)
    turn, shift = random_rotation(rng), rng.normal(0, 0.3, 3)
    moved, _ = single_query(query, "column", position @ turn.T + shift, turn @ rotation, pad=(shift, turn))
    assert ((still > -0.5) == (moved > -0.5)).mean() > 0.995
    both = (still > -0.5) & (moved > -0.5)
    assert both.sum() > 100
    assert np.percentile(np.abs(still - moved)[both], 99) < 2e-6


def test_a_body_behind_the_face_or_far_away_is_not_felt() -> None:
    query = ContactQuery(LAYOUT, [BodyGeometry([Sphere(0.005)])])
    position = np.array([[0, 0, -0.0051], [0, 0, 0.02], [0.1, 0, 0.0]])
    depth, _ = single_query(query, "column", position, np.tile(np.eye(3), (3, 1, 1)))
    assert (depth == -1).all()


def test_shapes_that_make_no_sense_are_refused() -> None:
    vertices, faces = box_mesh((0.01, 0.01, 0.01))
    with pytest.raises(ValueError, match="TriangleMesh: mesh is open or inconsistently wound"):
        TriangleMesh(vertices, faces[:-1])
    with pytest.raises(ValueError, match="not convex"):
        ConvexHull(ring_mesh().vertices, ring_mesh().faces)
    with pytest.raises(ValueError, match=r"Box: half_size\[1\] must be positive, got -1"):
        Box((1.0, -1.0, 1.0))
    with pytest.raises(ValueError, match="at least one body"):
        ContactQuery(LAYOUT, [])
    with pytest.raises(ValueError, match="at least one primitive"):
        BodyGeometry([])


def test_an_inside_out_mesh_is_turned() -> None:
    vertices, faces = box_mesh((0.01, 0.01, 0.01))
    query = ContactQuery(LAYOUT, [BodyGeometry([TriangleMesh(vertices, faces[:, ::-1])])])
    depth, _ = single_query(query, "column", np.array([[0, 0, 0.0098]]), np.eye(3)[None])
    assert np.isclose(depth.max(), 2e-4, atol=1e-7)


def test_warp_stays_as_talkative_as_its_user_made_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for chosen, then in (
        (wp.LOG_DEBUG, wp.LOG_DEBUG),
        (wp.LOG_ERROR, wp.LOG_ERROR),
        (wp.LOG_INFO, wp.LOG_WARNING),
    ):
        monkeypatch.setattr(wp.config, "log_level", chosen)
        start_warp.__wrapped__()
        assert wp.config.log_level == then
