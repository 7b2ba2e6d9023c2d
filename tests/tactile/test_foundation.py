"""The load-consistent foundation against exact Winkler solutions and the load, and Hertz by a half-space."""

import gc

import numpy as np
import pytest
import torch
import warp as wp
from scipy.integrate import dblquad
from scipy.optimize import brentq
from touch_shapes import hexagon, random_rotation, ring_mesh, single_query

from lerobot_vtrefine.tactile import (
    BodyGeometry,
    Box,
    Cylinder,
    PadLayout,
    PadSensors,
    Poses,
    SensorModel,
    Sphere,
)
from lerobot_vtrefine.tactile.contact_query import ContactQuery
from lerobot_vtrefine.tactile.foundation import ContactSolver
from lerobot_vtrefine.tactile.geometry import Primitive
from lerobot_vtrefine.tactile.stages.contact import Consistent

LAYOUT = PadLayout()
MODULUS = 2e8
MODEL = SensorModel.default().with_stage(Consistent(foundation_n_per_m3=MODULUS))


def press(
    bodies: list[list[Primitive]],
    position: np.ndarray,
    load: np.ndarray,
    rotation: np.ndarray | None = None,
    velocity: np.ndarray | None = None,
) -> np.ndarray:
    """Forces (m, rows, cols) of one pad at rest; position (m, B, 3), load (m, 3)."""
    count, number = position.shape[:2]
    sensors = PadSensors(LAYOUT, [BodyGeometry(body) for body in bodies], count, num_pads=1, model=MODEL)
    eye = np.broadcast_to(np.eye(3), (count, 1, 3, 3))
    poses = Poses(
        np.zeros((count, 1, 3)),
        eye,
        np.zeros((count, 1, 6)),
        position,
        np.broadcast_to(np.eye(3), (count, number, 3, 3)) if rotation is None else rotation,
        np.zeros((count, number, 6)) if velocity is None else velocity,
    )
    forces = sensors.forces(np.arange(count), poses, 0.1, load[:, None])
    return np.asarray(forces).reshape(count, LAYOUT.rows, LAYOUT.cols).astype(float)


def centre_of(force: np.ndarray) -> np.ndarray:
    """Centre of pressure (m, 2) [m]."""
    weights = force.reshape(len(force), -1)
    return weights @ LAYOUT.positions()[:, :2] / weights.sum(1, keepdims=True)


@pytest.mark.parametrize("penetration", [0.0, 5e-4, -5e-5])
def test_sphere_is_the_exact_winkler_solution(penetration: float) -> None:
    """The peak taxel within 1 % (2 % off the symmetry), whatever the solver's penetration, even a gap."""
    radius, load = 0.01, 5.0
    # Force of a sphere pressed delta deep into a Winkler foundation: k pi (R delta^2 - delta^3 / 3).
    delta = brentq(lambda d: MODULUS * np.pi * (radius * d**2 - d**3 / 3) - load, 0, 0.005)
    rng = np.random.default_rng(0)
    centre = rng.uniform(-1e-3, 1e-3, (12, 2))
    centre[:3] = 0.0
    position = np.column_stack([centre, np.full(12, radius - penetration)])
    force = press([[Sphere(radius)]], position[:, None], np.column_stack([np.full(12, load), centre]))
    for image, (x0, y0) in zip(force, centre, strict=True):
        row, col = np.unravel_index(image.argmax(), image.shape)
        x, y, _ = LAYOUT.positions().reshape(12, 32, 3)[row, col]

        def pressure(b: float, a: float, x0: float = x0, y0: float = y0) -> float:
            r2 = (a - x0) ** 2 + (b - y0) ** 2
            return MODULUS * max(0.0, delta - radius + np.sqrt(radius**2 - r2))

        exact = dblquad(pressure, x - 1e-3, x + 1e-3, y - 1e-3, y + 1e-3, epsabs=1e-6)[0]
        assert np.isclose(image.max(), exact, rtol=0.01 if (x0, y0) == (0.0, 0.0) else 0.02)


def test_delta_of_a_sphere() -> None:
    radius, load = 0.01, 5.0
    delta = brentq(lambda d: MODULUS * np.pi * (radius * d**2 - d**3 / 3) - load, 0, 0.005)
    query = ContactQuery(LAYOUT, [BodyGeometry([Sphere(radius)])], subdivision=2)
    still, eye = torch.zeros((1, 1, 6)), torch.eye(3)[None, None]
    poses = (torch.zeros((1, 1, 3)), eye, still, torch.tensor([[[0, 0, radius - 3e-4]]]), eye, still)
    stiffness = torch.tensor([MODULUS * LAYOUT.taxel_area_m2])
    load = torch.tensor([[[load, 0.0, 0.0]]])
    _, solution = ContactSolver(LAYOUT, query).foundation(poses, load, stiffness, torch.zeros(1))
    assert np.isclose(float(solution[0, 0, 0]) + 3e-4, delta, rtol=0.01)
    assert np.allclose(solution[0, 0, 1:], 0, atol=1e-5)


def test_room_for_other_numbers_of_environments_is_let_go() -> None:
    """Worlds whose episodes end leave fewer and fewer: room for each number filled a GPU."""
    query = ContactQuery(LAYOUT, [BodyGeometry([Sphere(0.01)])])
    solver = ContactSolver(LAYOUT, query)

    def arrays_after(count: int) -> int:
        zeros, eye = np.zeros((count, 1, 6)), np.broadcast_to(np.eye(3), (count, 1, 3, 3))
        poses = Poses(zeros[..., :3], eye, zeros, np.full((count, 1, 3), 0.009), eye, zeros)
        tensors = tuple(torch.as_tensor(pose.copy()) for pose in poses)
        solver.foundation(tensors, torch.ones((count, 1, 3)), 2.0, 0.0)
        query("column", *tensors)
        gc.collect()
        return sum(isinstance(item, wp.array) for item in gc.get_objects())

    first = arrays_after(1)
    assert [arrays_after(count) - first for count in (2, 5, 3, 2)] == [0, 0, 0, 0]


def test_flat_box_is_uniform() -> None:
    force = press([[Box((0.016, 0.008, 0.01))]], np.array([[[0, 0, 0.0097]]]), np.array([[6.4, 0.0, 0.0]]))
    touched = force[0] > 0
    assert touched.sum() == 16 * 8
    assert np.allclose(force[0][touched], 6.4 / 128, rtol=1e-4)


SHAPES = {
    "sphere": [Sphere(0.01)],
    "box": [Box((0.012, 0.008, 0.01))],
    "cylinder": [Cylinder(0.009, 0.011)],
    "hull": [hexagon()],
    "ring": [ring_mesh()],
    "union": [Box((0.012, 0.004, 0.009)), Cylinder(0.006, 0.01)],
}


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_sum_and_centre_equal_the_load(name: str) -> None:
    """Random poses, 0.5 to 10 N: the sum always, the centre wherever the body can be pressed on around it."""
    rng = np.random.default_rng(1)
    count = 60
    rotation = np.stack([random_rotation(rng) for _ in range(count)])
    query = ContactQuery(LAYOUT, [BodyGeometry(SHAPES[name])], subdivision=2)
    far = np.column_stack([rng.uniform(-5e-3, 5e-3, (count, 2)), np.full(count, 0.0115)])
    height = single_query(query, "column", far, rotation)[0].reshape(count, -1)
    fine = PadLayout(24, 64, 0.001).positions()[:, :2]
    depth = rng.uniform(-2e-4, 8e-4, count)
    highest = height.max(1)
    keep = highest > -0.0029
    position = far - np.column_stack([np.zeros((count, 2)), depth - highest])
    weight = np.where(height > -0.5, np.maximum(height - highest[:, None] + 1e-3, 0), 0)
    centre = weight @ fine / weight.sum(1, keepdims=True) + rng.normal(0, 1e-4, (count, 2))
    load = np.column_stack([rng.uniform(0.5, 10, count), centre])[keep]
    force = press([SHAPES[name]], position[keep, None], load, rotation[keep, None])
    assert keep.sum() > 20
    assert np.allclose(force.sum((1, 2)), load[:, 0], rtol=1e-5)
    error = np.linalg.norm(centre_of(force) - load[:, 1:], axis=1)
    assert np.percentile(error, 80) < 1e-5


def test_never_zero_under_load_even_where_no_body_is_near() -> None:
    load = np.array([[2.0, 0.0101, -0.0042], [3.0, 0.05, 0.0]])
    force = press([[Sphere(0.01)]], np.array([[[0, 0, 0.5]], [[0, 0, 0.5]]]), load)
    assert np.allclose(force.sum((1, 2)), [2, 3], rtol=1e-6)
    assert np.allclose(centre_of(force[:1])[0], load[0, 1:], atol=1e-7)


def test_an_impossible_centre_still_carries_the_load() -> None:
    force = press([[Sphere(0.003)]], np.array([[[0, 0, 0.003]]]), np.array([[4.0, 0.02, 0.01]]))
    assert np.isclose(force.sum(), 4.0, rtol=1e-5)
    assert np.isfinite(force).all()


def test_no_load_no_reading() -> None:
    assert press([[Sphere(0.003)]], np.array([[[0, 0, 0.002]]]), np.zeros((1, 3))).max() == 0


def test_two_bodies_superpose() -> None:
    """Two boxes side by side under their joint load read as each alone under its own."""
    boxes = [[Box((0.005, 0.005, 0.01))], [Box((0.006, 0.004, 0.01))]]
    place = np.array([[[-0.015, 0, 0.0098], [0.014, 0.001, 0.0098]]])
    away = np.array([[0, 0, 1.0]])
    share = np.array([[25 / 49 * 4.9, -0.015, 0.0], [24 / 49 * 4.9, 0.014, 0.001]])
    alone = [
        press(boxes, np.stack([place[:, 0], away], 1), share[:1]),
        press(boxes, np.stack([away, place[:, 1]], 1), share[1:]),
    ]
    total = share[:, 0].sum()
    centre = share[:, 0] @ share[:, 1:] / total
    both = press(boxes, place, np.array([[total, *centre]]))
    assert np.allclose(both, alone[0] + alone[1], rtol=2e-3, atol=1e-4)


def test_viscous_part_leans_towards_the_side_that_closes() -> None:
    load = np.array([[5.0, 0.0, 0.0]])
    place = np.array([[[0, 0, 0.0197]]])
    closing = press([[Sphere(0.02)]], place, load, velocity=np.array([[[0, 0, -0.05, 0, 0, 0]]]))
    # A common rate is taken up by the face's offset.
    assert np.allclose(closing, press([[Sphere(0.02)]], place, load), atol=2e-3)
    two = [[Box((0.005, 0.005, 0.01))], [Box((0.005, 0.005, 0.01))]]
    place = np.array([[[-0.01, 0, 0.0098], [0.01, 0, 0.0098]]])
    closing = np.zeros((1, 2, 6))
    closing[0, 0, 2] = -0.02
    # With free tilts the face turns towards the faster body, so only the sum and centre are prescribed.
    forces = press(two, place, load, velocity=closing)
    assert np.isclose(forces.sum(), 5.0, rtol=1e-5)
    assert np.allclose(centre_of(forces), 0, atol=1e-5)


def patch_influence(x: np.ndarray, y: np.ndarray, half: float) -> np.ndarray:
    """Love's deflection at (x, y) under unit pressure on a square of half-side `half`, times E*: (N, M)."""

    def term(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a * np.arcsinh(b / np.abs(a))

    total = 0.0
    for sx, sy in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        u, v = x + sx * half, y + sy * half
        total = total + sx * sy * (term(u, v) + term(v, u))
    return total / np.pi


def test_heights_on_an_elastic_half_space_give_hertz() -> None:
    """Offline reference: the same column heights under a Boussinesq half-space reproduce Hertz within 2 %."""
    radius, modulus, pitch = 0.04, 1e6, 0.001
    load = 4 / 3 * modulus * np.sqrt(radius) * 1e-3**1.5
    query = ContactQuery(LAYOUT, [BodyGeometry([Sphere(radius)])], subdivision=2)
    height = single_query(query, "column", np.array([[0, 0, radius]]), np.eye(3)[None])[0][0].ravel()
    points = PadLayout(24, 64, pitch).positions()[:, :2]
    chosen = np.hypot(*points.T) < 9e-3
    x, y = points[chosen].T
    influence = patch_influence(x[:, None] - x, y[:, None] - y, pitch / 2) / modulus
    active = np.hypot(x, y) < 7e-3
    for _ in range(30):
        n = active.sum()
        matrix = np.zeros((n + 1, n + 1))
        matrix[:n, :n], matrix[:n, n] = influence[np.ix_(active, active)], -1
        matrix[n, :n] = pitch**2
        pressure = np.linalg.solve(matrix, np.append(height[chosen][active], load))
        if (pressure[:n] >= 0).all():
            break
        active[np.flatnonzero(active)[pressure[:n] < 0]] = False
    assert np.isclose(pressure[n], 1e-3, rtol=0.02)
    assert np.isclose(pressure[:n].max(), 3 * load / (2 * np.pi * radius * 1e-3), rtol=0.02)
