"""Speed of the contact models beside what else there is: rows for ``vtrefine-bench``.

All on one scene in one process and one CPU thread. Imports warp and MuJoCo.
"""

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterator

import numpy as np
import torch
import warp as wp

from lerobot_vtrefine.tactile.benchmark_peers import mujoco_rate, mujoco_warp_rate, three_ray_rate
from lerobot_vtrefine.tactile.benchmark_scene import (
    NUM_ENVS,
    NUM_PADS,
    OUTER_M,
    Scene,
    best_seconds,
    make_scene,
    ring_mesh,
)
from lerobot_vtrefine.tactile.engine import ContactEngine
from lerobot_vtrefine.tactile.geometry import BodyGeometry, Box, TriangleMesh
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.base import STAGES, Frame
from lerobot_vtrefine.tactile.stages.contact import ContactStage

CALLS_PER_WAIT = 20
"""On a GPU, launches that are queued before their end is awaited."""
CUDA_ENVS = 4096
LAWS = ("kelvin_voigt", "consistent")
START_S = 2.0
"""What the second start of a process may cost at most [s]."""

Row = tuple[str, float, str]

FIRST_READING = """
import time
import numpy as np
from lerobot_vtrefine.tactile import BodyGeometry, Box, PadLayout, PadSensors, Poses
imported = time.process_time()
eye, still = np.eye(3)[None, None], np.zeros((1, 1, 6))
poses = Poses(np.zeros((1, 1, 3)), eye, still, np.array([[[0, 0, 0.0098]]]), eye, still)
sensors = PadSensors(PadLayout(), [BodyGeometry([Box((0.01, 0.01, 0.01))])], 1, 1)
sensors.counts([0], poses, 0.1, np.array([[[5.0, 0, 0]]]))
print(time.process_time() - imported)
"""
"""Prints the processor seconds from its imports to the first reading: warp, and kernels from its cache."""


def model_call(scene: Scene, law: str, device: str) -> Callable[[], object]:
    """Compute the forces of a contact stage, by name, on a scene."""
    contact = STAGES[law]()
    if not isinstance(contact, ContactStage):
        raise ValueError(f"{law!r} is not a contact stage")
    model = SensorModel.default().with_stage(contact)
    layout = PadLayout()
    engine = ContactEngine(layout, [BodyGeometry([scene.body])], model, contact.load_conserving, device)
    frame = Frame(layout=layout)
    return lambda: engine(contact, scene.poses, scene.load, frame)


def model_rate(scene: Scene, law: str) -> float:
    """Taxels per second of a contact stage on one CPU thread."""
    return scene.num_taxels / best_seconds(model_call(scene, law, "cpu"))


def cuda_rate(scene: Scene, law: str, captured: bool) -> float:
    """The same on the present CUDA device, launches queued, or captured in a graph as a simulator's are."""
    call = model_call(scene, law, "cuda")
    call()
    if captured:
        with wp.ScopedCapture("cuda") as capture:
            call()

    def run() -> None:
        for _ in range(CALLS_PER_WAIT):
            if captured:
                wp.capture_launch(capture.graph)
            else:
                call()
        wp.synchronize_device("cuda")

    return scene.num_taxels * CALLS_PER_WAIT / best_seconds(run, on_gpu=True)


def body_scenes(num_envs: int, device: str) -> dict[str, Scene]:
    """The ring, a mesh, and the flat side of a box handle."""
    ring, box = ring_mesh(), Box((0.017, 0.02, 0.017))
    return {
        "a ring": make_scene(ring, OUTER_M * np.cos(np.pi / 60), num_envs, device),
        "a box handle": make_scene(box, 0.017, num_envs, device),
    }


def measure_rates() -> dict[str, float]:
    """Taxels per second on one CPU thread, pads on the ring: the contact models and their peers by name."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        ring = body_scenes(NUM_ENVS, "cpu")["a ring"]
        rates = {law: model_rate(ring, law) for law in LAWS}
        rates["MuJoCo's C tactile sensor"] = mujoco_rate(ring_mesh())
        if importlib.util.find_spec("mujoco_warp") is not None:  # an optional extra
            rates["mujoco_warp's tactile sensor"] = mujoco_warp_rate(ring_mesh(), NUM_ENVS)
        return {**rates, "a three-ray mesh query": three_ray_rate(ring)}
    finally:
        torch.set_num_threads(threads)


def run() -> list[Row]:
    """Rows (name, ratio, explanation) for `vtrefine-bench`."""
    rates, rows = measure_rates(), []
    for law in LAWS:
        for peer, other in rates.items():
            if peer not in LAWS:
                text = f"{rates[law] / 1e6:.1f} against {other / 1e6:.2f} M taxels/s on a ring"
                rows.append((f"tactile {law} / {peer}", rates[law] / other, text))
    box = body_scenes(NUM_ENVS, "cpu")["a box handle"]
    for law in LAWS:
        milliseconds = 1e3 * box.num_taxels / model_rate(box, law)
        text = f"{milliseconds:.2f} ms for {NUM_ENVS} environments of 1536 taxels on a box handle"
        rows.append((f"tactile {law}: 2 ms / its time", 2 / milliseconds, text))
    return [*rows, start_row()]


def start_row() -> Row:
    """How long a process that is not the first on this machine waits for its first reading."""
    seconds = []
    for _ in range(2):  # the first may still have to compile
        answer = subprocess.run(
            [sys.executable, "-c", FIRST_READING], capture_output=True, text=True, check=True, env=os.environ
        )
        seconds.append(float(answer.stdout.split()[-1]))
    text = f"{seconds[-1]:.2f} s from imports to the first reading in a second process; target {START_S:g}"
    return f"tactile start: {START_S:g} s / its time", START_S / seconds[-1], text


def run_cuda() -> Iterator[Row]:
    """Rows (name, 1e9 taxels per second, explanation) on the present CUDA device, as they are measured."""
    for where, scene in body_scenes(CUDA_ENVS, "cuda").items():
        for captured in (False, True):
            for law in LAWS:
                how = "one graph launch each" if captured else "launches queued"
                text = f"G taxels/s, {CUDA_ENVS} environments of {NUM_PADS} pads pressed on {where}, {how}"
                yield f"tactile {law} on CUDA, {where}", cuda_rate(scene, law, captured) / 1e9, text
        if isinstance(scene.body, TriangleMesh):
            rate = three_ray_rate(scene, "cuda")
            yield "a three-ray mesh query on CUDA", rate / 1e9, f"G taxels/s, {where} too"
