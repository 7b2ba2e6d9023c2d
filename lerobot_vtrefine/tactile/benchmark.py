"""Speed of the contact models beside what else there is: MuJoCo's tactile sensor and a mesh query per taxel.

All on one scene in one process: pads pressed flat against the side of a chamfered ring (a mesh, like the
assembly parts), one CPU thread. Imports warp and mujoco.
"""

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from lerobot_vtrefine.tactile.contact_query import start_warp
from lerobot_vtrefine.tactile.engine import ContactEngine
from lerobot_vtrefine.tactile.geometry import BodyGeometry, Box, Primitive, TriangleMesh
from lerobot_vtrefine.tactile.kernels_benchmark import three_ray_query
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.base import STAGES, Frame
from lerobot_vtrefine.tactile.stages.contact import ContactStage

NUM_ENVS, NUM_PADS = 64, 4
PRESS_M = 2e-4
LOAD_N = 5.0
OUTER_M = 0.012


def ring_mesh(segments: int = 60) -> TriangleMesh:
    """Ring about y, 24 mm across and 14 mm long, with chamfers: 12 * segments triangles."""
    profile = np.array([[6, -7], [11, -7], [12, -6], [12, 6], [11, 7], [6, 7]]) * 1e-3
    # A facet, not an edge, faces the pad.
    angles = (np.arange(segments) + 0.5) * 2 * np.pi / segments
    x, z = (np.outer(profile[:, 0], wave(angles)) for wave in (np.cos, np.sin))
    vertices = np.stack([x, np.broadcast_to(-profile[:, 1:], x.shape), z], axis=-1).reshape(-1, 3)
    p, s = (index.ravel() for index in np.meshgrid(np.arange(6), np.arange(segments), indexing="ij"))
    a, b = p * segments + s, p * segments + (s + 1) % segments
    c, d = (p + 1) % 6 * segments + (s + 1) % segments, (p + 1) % 6 * segments + s
    return TriangleMesh(vertices, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]))


@dataclass(frozen=True)
class Scene:
    """Pads pressed against one body: poses as `ContactQuery` takes them, and the load."""

    body: Primitive
    poses: list[torch.Tensor]
    load: torch.Tensor


def make_scene(body: Primitive, lowest_m: float, num_envs: int, device: str) -> Scene:
    """`num_envs` times four pads, PRESS_M deep in a body that reaches `lowest_m` below its origin."""
    generator = torch.Generator().manual_seed(0)
    position = torch.zeros(num_envs, NUM_PADS, 3)
    position[..., :2] = (torch.rand(num_envs, NUM_PADS, 2, generator=generator) - 0.5) * 2e-3
    eye = torch.eye(3)
    velocity = torch.zeros(num_envs, NUM_PADS, 6)
    body_position = torch.zeros(num_envs, 1, 3)
    body_position[..., 2] = lowest_m - PRESS_M
    load = torch.cat([torch.full((num_envs, NUM_PADS, 1), LOAD_N), -position[..., :2]], -1)
    poses = [position, eye.expand(num_envs, NUM_PADS, 3, 3), velocity]
    poses += [body_position, eye.expand(num_envs, 1, 3, 3), torch.zeros(num_envs, 1, 6)]
    return Scene(body, [pose.to(device).contiguous() for pose in poses], load.to(device))


def best_seconds(call: Callable[[], object], repeats: int = 20, budget_s: float = 2.0) -> float:
    """Shortest of several runs [s]; the minimum is what other load on the machine disturbs least."""
    call()
    times, end = [], time.perf_counter() + budget_s
    while len(times) < 3 or (len(times) < repeats and time.perf_counter() < end):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


def model_rate(scene: Scene, law: str, device: str = "cpu") -> float:
    """Taxels per second of a contact stage by name."""
    contact = STAGES[law]()
    if not isinstance(contact, ContactStage):
        raise ValueError(f"{law!r} is not a contact stage")
    model = SensorModel.default().with_stage(contact)
    layout = PadLayout()
    engine = ContactEngine(layout, [BodyGeometry([scene.body])], model, contact.load_conserving, device)
    frame = Frame(layout=layout)

    def run() -> None:
        engine(contact, scene.poses, scene.load, frame)
        if device != "cpu":
            torch.cuda.synchronize()

    return scene.load.shape[0] * NUM_PADS * layout.num_taxels / best_seconds(run)


def three_ray_rate(scene: Scene, device: str = "cpu") -> float:
    """Taxels per second of the mesh query with three-ray voting."""
    start_warp()
    mesh = scene.body
    if not isinstance(mesh, TriangleMesh):
        raise ValueError("the three-ray query needs a mesh")
    points = wp.array(mesh.vertices.astype(np.float32), dtype=wp.vec3, device=device)
    handle = wp.Mesh(points, wp.array(mesh.faces.astype(np.int32).ravel(), dtype=int, device=device))
    taxels = torch.from_numpy(PadLayout().positions()).float().to(device) + scene.poses[0][:2].unsqueeze(-2)
    taxels = (taxels - scene.poses[3][:2].unsqueeze(-2)).reshape(-1, 3).contiguous()
    wanted, depth = wp.from_torch(taxels, dtype=wp.vec3), wp.zeros(len(taxels), dtype=float, device=device)

    def run() -> None:
        wp.launch(three_ray_query, dim=len(taxels), inputs=[handle.id, wanted, depth], device=device)
        wp.synchronize_device(device)

    return len(taxels) / best_seconds(run)


def _mujoco_seconds(mesh: TriangleMesh, sensor: bool) -> float:
    # By name, so that the sensor model itself never comes to depend on a simulator.
    mujoco: Any = importlib.import_module("mujoco")
    vertices, faces = (" ".join(f"{v:.7g}" for v in array.ravel()) for array in (mesh.vertices, mesh.faces))
    # The sensor reads the plate in the plane x = 0 of the geom; the far sdf geom makes the mesh's octree.
    xml = f"""<mujoco><asset><mesh name="taxels" builtin="plate" params="32 12" scale=".032 .012 .0015"/>
      <mesh name="ring" vertex="{vertices}" face="{faces}" inertia="exact"/></asset><worldbody>
      <body><geom name="pad" type="box" size=".0005 .013 .0333" quat=".7071068 0 -.7071068 0"/></body>
      <body pos="0 0 {OUTER_M - PRESS_M}"><freejoint/><geom type="mesh" mesh="ring"/>
      <geom type="sdf" mesh="ring" contype="0" conaffinity="0" pos="0 0 5"/></body></worldbody>
      <sensor>{'<tactile mesh="taxels" geom="pad"/>' if sensor else ""}</sensor></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    if sensor and not (data.sensordata[:384] > 0).any():
        raise RuntimeError("MuJoCo's tactile sensor reads nothing in the benchmark's scene")
    return best_seconds(lambda: [mujoco.mj_forward(model, data) for _ in range(20)]) / 20


def mujoco_rate(mesh: TriangleMesh) -> float:
    """Taxels per second of MuJoCo's C tactile sensor: forward dynamics with it less those without."""
    return 384 / (_mujoco_seconds(mesh, sensor=True) - _mujoco_seconds(mesh, sensor=False))


def run(device: str = "cpu", num_envs: int = NUM_ENVS) -> list[tuple[str, float, str]]:
    """Rows (name, ratio, explanation) for `vtrefine-bench`; about ten seconds on a CPU."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        mesh = ring_mesh()
        ring = make_scene(mesh, OUTER_M * np.cos(np.pi / 60), num_envs, device)
        box = make_scene(Box((0.017, 0.02, 0.017)), 0.017, num_envs, device)
        rates = {law: model_rate(ring, law, device) for law in ("kelvin_voigt", "consistent")}
        boxes = {law: model_rate(box, law, device) for law in ("kelvin_voigt", "consistent")}
        peers = {
            "MuJoCo's C tactile sensor": mujoco_rate(mesh),
            "a three-ray mesh query": three_ray_rate(ring, device),
        }
    finally:
        torch.set_num_threads(threads)
    rows = []
    for law, rate in rates.items():
        for peer, other in peers.items():
            text = f"{rate / 1e6:.1f} against {other / 1e6:.2f} M taxels/s on a ring"
            rows.append((f"tactile {law} / {peer}", rate / other, text))
    for law, rate in boxes.items():
        milliseconds = 1e3 * 64 * NUM_PADS * 384 / rate
        text = f"{milliseconds:.2f} ms for 64 environments of 1536 taxels on a box handle"
        rows.append((f"tactile {law}: 2 ms / its time", 2 / milliseconds, text))
    return rows
