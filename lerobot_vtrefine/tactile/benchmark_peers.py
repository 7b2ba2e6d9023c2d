"""What else there is, on the benchmark's scene: MuJoCo's and mujoco_warp's sensors, a mesh query per taxel.

Simulators are imported by name, so that the sensor model itself never comes to depend on one.
"""

import importlib
from typing import Any

import numpy as np
import torch
import warp as wp

from lerobot_vtrefine.tactile.benchmark_scene import OUTER_M, PRESS_M, Scene, best_seconds
from lerobot_vtrefine.tactile.contact_query import start_warp
from lerobot_vtrefine.tactile.geometry import TriangleMesh
from lerobot_vtrefine.tactile.kernels_benchmark import three_ray_query
from lerobot_vtrefine.tactile.layout import PadLayout


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

    return len(taxels) / best_seconds(run, device != "cpu")


def mujoco_xml(mesh: TriangleMesh, sensor: bool) -> str:
    """A pad pressed PRESS_M deep into a mesh that reaches OUTER_M below its origin, as MuJoCo reads it."""
    vertices, faces = (" ".join(f"{v:.7g}" for v in array.ravel()) for array in (mesh.vertices, mesh.faces))
    # The sensor reads the plate in the plane x = 0 of the geom; the far sdf geom makes the mesh's octree.
    return f"""<mujoco><asset><mesh name="taxels" builtin="plate" params="32 12" scale=".032 .012 .0015"/>
      <mesh name="ring" vertex="{vertices}" face="{faces}" inertia="exact"/></asset><worldbody>
      <body><geom name="pad" type="box" size=".0005 .013 .0333" quat=".7071068 0 -.7071068 0"/></body>
      <body pos="0 0 {OUTER_M - PRESS_M}"><freejoint/><geom type="mesh" mesh="ring"/>
      <geom type="sdf" mesh="ring" contype="0" conaffinity="0" pos="0 0 5"/></body></worldbody>
      <sensor>{'<tactile mesh="taxels" geom="pad"/>' if sensor else ""}</sensor></mujoco>"""


def _mujoco_seconds(mesh: TriangleMesh, sensor: bool) -> float:
    mujoco: Any = importlib.import_module("mujoco")
    model = mujoco.MjModel.from_xml_string(mujoco_xml(mesh, sensor))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    if sensor and not (data.sensordata[:384] > 0).any():
        raise RuntimeError("MuJoCo's tactile sensor reads nothing in the benchmark's scene")
    return best_seconds(lambda: [mujoco.mj_forward(model, data) for _ in range(200)]) / 200


def mujoco_rate(mesh: TriangleMesh) -> float:
    """Taxels per second of MuJoCo's C tactile sensor: time of forward dynamics with it minus that without."""
    return 384 / (_mujoco_seconds(mesh, sensor=True) - _mujoco_seconds(mesh, sensor=False))


def _mujoco_warp_seconds(mesh: TriangleMesh, num_worlds: int, sensor: bool) -> float:
    mujoco: Any = importlib.import_module("mujoco")
    mujoco_warp: Any = importlib.import_module("mujoco_warp")
    model = mujoco.MjModel.from_xml_string(mujoco_xml(mesh, sensor))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with wp.ScopedDevice("cpu"):
        worlds_model = mujoco_warp.put_model(model)
        worlds = mujoco_warp.put_data(model, data, nworld=num_worlds)
        seconds = best_seconds(lambda: mujoco_warp.sensor_vel(worlds_model, worlds))
    if sensor and not (worlds.sensordata.numpy()[:, :384] > 0).any():
        raise RuntimeError("mujoco_warp's tactile sensor reads nothing in the benchmark's scene")
    return seconds


def mujoco_warp_rate(mesh: TriangleMesh, num_worlds: int) -> float:
    """Taxels per second of mujoco_warp's tactile sensor: the pass that holds it with it less that without."""
    with_it, without = (_mujoco_warp_seconds(mesh, num_worlds, sensor) for sensor in (True, False))
    return num_worlds * 384 / (with_it - without)
