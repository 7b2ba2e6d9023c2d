"""The contact models against MuJoCo: its solver's loads, and its own tactile sensor."""

import mujoco
import numpy as np
import pytest
from scipy.spatial import Delaunay
from touch_shapes import box_mesh, hexagon, revolved

from lerobot_vtrefine.sim.press_rig import Pressed, RigConfig, press
from lerobot_vtrefine.tactile import (
    BodyGeometry,
    Box,
    Cylinder,
    PadLayout,
    PadSensors,
    Poses,
    SensorModel,
    Sphere,
    TriangleMesh,
)
from lerobot_vtrefine.tactile.geometry import Primitive
from lerobot_vtrefine.tactile.reference import exact_forces, exact_heights
from lerobot_vtrefine.tactile.stages.contact import Consistent, ContactStage, Depth

LAYOUT = PadLayout()
SHAPES: dict[str, list[Primitive]] = {
    "sphere": [Sphere(0.01)],
    "box": [Box((0.011, 0.008, 0.01))],
    "cylinder": [Cylinder(0.009, 0.011)],
    "hull": [hexagon()],
    "union": [Box((0.012, 0.004, 0.009)), Cylinder(0.006, 0.0095)],
}
LOADS_N = (0.5, 2.0, 10.0)
SOLVERS = (
    RigConfig(mass_kg=0.02),
    RigConfig(mass_kg=0.2, time_constant_s=0.005),
    RigConfig(mass_kg=0.05, time_constant_s=0.02, timestep_s=0.002),
)


def read(stage: ContactStage, body: BodyGeometry, pressed: Pressed) -> np.ndarray:
    """What one pad at rest reads of a pressed part: (R, C)."""
    sensors = PadSensors(LAYOUT, [body], 1, 1, model=SensorModel.default().with_stage(stage))
    poses = Poses(
        *(np.zeros((1, 1, 3)), np.eye(3)[None, None], np.zeros((1, 1, 6))),
        *(pressed.position[None, None], pressed.rotation[None, None], np.zeros((1, 1, 6))),
    )
    force = sensors.forces(np.zeros(1, int), poses, 0.1, pressed.load[None, None])
    return np.asarray(force, dtype=float).reshape(LAYOUT.rows, LAYOUT.cols)


def centre_of(force: np.ndarray) -> np.ndarray:
    return force.ravel() @ LAYOUT.positions()[:, :2] / force.sum()


def is_supported(body: BodyGeometry, pressed: Pressed) -> bool:
    """Whether the load's centre lies among the centres of taxels that the body stands over."""
    fine = PadLayout(LAYOUT.rows * 2, LAYOUT.cols * 2, LAYOUT.pitch_m / 2).positions()[:, :2]
    heights = exact_heights(body, pressed.position, pressed.rotation, fine)
    over = (heights > -2e-3).reshape(LAYOUT.rows, 2, LAYOUT.cols, 2).any((1, 3))
    return bool(Delaunay(LAYOUT.positions()[over.ravel(), :2]).find_simplex(pressed.load[1:]) >= 0)


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_sum_and_centre_are_the_solvers(name: str) -> None:
    """Over loads, masses and solver settings: the sum to 1e-5; its centre to 0.01 mm, or, where the part is
    pressed outside of all centres of taxels, as close as these are; never zero; the same whatever the solver.
    """
    yaw = np.array([[0.9, -np.sqrt(0.19), 0], [np.sqrt(0.19), 0.9, 0], [0, 0, 1]])
    tilted = yaw @ np.array([[1, 0, 0], [0, 0.96, -0.28], [0, 0.28, 0.96]])
    body = BodyGeometry(SHAPES[name])
    supported = 0
    for rotation in (yaw, tilted) if name != "sphere" else (yaw,):
        for load_n in LOADS_N:
            images = []
            for solver in SOLVERS:
                config = RigConfig(load_n, solver.mass_kg, solver.time_constant_s, solver.timestep_s)
                pressed = press(SHAPES[name], rotation, (0.0013, -0.0007), config)
                force = read(Consistent(), body, pressed)
                assert np.isclose(pressed.load[0], load_n, rtol=1e-3)
                assert np.isclose(force.sum(), pressed.load[0], rtol=1e-5)
                error = np.linalg.norm(centre_of(force) - pressed.load[1:])
                if is_supported(body, pressed):
                    assert error < 1e-5
                    supported += 1
                    images.append((pressed.load[1:], force))
                assert error < 1.2e-3
            for centre, image in images:
                for other, again in images:
                    # On an edge, how deep the solver lets it sink decides what is within reach.
                    if rotation is yaw and np.allclose(centre, other, atol=1e-6):
                        assert np.abs(image - again).max() < 0.01 * image.max()
    assert supported >= len(LOADS_N) * len(SOLVERS)


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_images_are_the_exact_winkler_ones(name: str) -> None:
    """Against 100 points a taxel in double precision: at most 6 % of the force in the wrong place."""
    yaw = np.array([[0.9, -np.sqrt(0.19), 0], [np.sqrt(0.19), 0.9, 0], [0, 0, 1]])
    pressed, body = press(SHAPES[name], yaw, (0.0013, -0.0007)), BodyGeometry(SHAPES[name])
    truth = exact_forces(LAYOUT, body, pressed.position, yaw, Consistent().foundation_n_per_m3, pressed.load)
    assert np.isclose(truth.sum(), pressed.load[0], rtol=1e-9)
    assert np.abs(read(Consistent(), body, pressed) - truth).sum() / 2 / truth.sum() < 0.06


def test_reference_heights_are_of_their_shapes() -> None:
    """The offline truth itself, on shapes whose heights are known in closed form."""
    points = np.array([[0.0, 0.0], [0.003, 0.004], [0.02, 0.0]])
    ball = exact_heights(BodyGeometry([Sphere(0.01)]), np.array([0, 0, 0.0095]), np.eye(3), points)
    assert np.allclose(ball, [0.0005, np.sqrt(0.75e-4) - 0.0095, -1])
    box = exact_heights(BodyGeometry([Box((0.01, 0.01, 0.01))]), np.array([0, 0, 0.0098]), np.eye(3), points)
    assert np.allclose(box, [0.0002, 0.0002, -1])
    with pytest.raises(ValueError, match="convex pieces"):
        exact_heights(BodyGeometry([ring()]), np.zeros(3), np.eye(3), points)


def ring() -> TriangleMesh:
    profile = np.array([[6, -7], [11, -7], [12, -6], [12, 6], [11, 7], [6, 7]]) * 1e-3
    return TriangleMesh(*revolved(profile, 40))


def sensor_depths(mesh: TriangleMesh, height: float, rotation: np.ndarray) -> np.ndarray:
    """Depths (R, C) that MuJoCo's tactile sensor reads of a mesh at (0, 0, height) over a pad."""
    vertices, faces = (" ".join(f"{v:.9g}" for v in array.ravel()) for array in (mesh.vertices, mesh.faces))
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, rotation.ravel())
    # The sensor's plate lies in the geom's plane x = 0; a far sdf geom makes the mesh's octree.
    xml = f"""<mujoco><asset><mesh name="taxels" builtin="plate" params="32 12" scale=".032 .012 .0015"/>
      <mesh name="part" vertex="{vertices}" face="{faces}" inertia="exact"/></asset><worldbody>
      <body><geom name="pad" type="box" size=".0005 .013 .0333" quat=".7071068 0 -.7071068 0"/></body>
      <body pos="0 0 {height}" quat="{" ".join(map(str, quat))}"><freejoint/><geom type="mesh" mesh="part"/>
      <geom type="sdf" mesh="part" contype="0" conaffinity="0" pos="0 0 5"/></body></worldbody>
      <sensor><tactile mesh="taxels" geom="pad"/></sensor></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start = model.mesh("taxels").vertadr[0]
    places = model.mesh_vert[start : start + 384] @ data.geom("pad").xmat.reshape(3, 3).T
    rows = np.rint(places[:, 1] / LAYOUT.pitch_m + (LAYOUT.rows - 1) / 2).astype(int)
    cols = np.rint(places[:, 0] / LAYOUT.pitch_m + (LAYOUT.cols - 1) / 2).astype(int)
    depths = np.full((LAYOUT.rows, LAYOUT.cols), np.nan)
    depths[rows, cols] = data.sensordata[:384]
    return depths


@pytest.mark.parametrize("name", ["ring", "box"])
def test_depths_are_those_of_mujocos_sensor(name: str) -> None:
    """On meshes, to what the sensor's octree of distances resolves; it reads depth as `depth` means it."""
    mesh = ring() if name == "ring" else TriangleMesh(*box_mesh((0.011, 0.009, 0.008)))
    rng = np.random.default_rng(5)
    upright = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]]) if name == "ring" else np.eye(3)
    touched = 0
    for _ in range(6):
        angles = rng.uniform(-0.02, 0.02, 2)
        tilt = np.array([[1, 0, angles[0]], [0, 1, angles[1]], [-angles[0], -angles[1], 1]])
        rotation = np.linalg.qr(tilt @ upright)[0]
        rotation *= np.sign(np.diag(rotation.T @ upright))
        height = 4e-4 - (mesh.vertices @ rotation[2]).min() - 6e-4
        theirs = sensor_depths(mesh, height, rotation)
        ours = read(Depth(), BodyGeometry([mesh]), Pressed(np.array([0, 0, height]), rotation, np.zeros(3)))
        both = (ours > 1e-5) & (theirs > 1e-5)
        assert np.isfinite(theirs).all()
        assert (both != ((ours > 1e-5) | (theirs > 1e-5))).sum() <= 4
        assert np.abs(ours - theirs)[both].max() < 2e-5
        assert np.median(np.abs(ours - theirs)[both]) < 4e-6
        touched += both.sum()
    assert touched > 40
