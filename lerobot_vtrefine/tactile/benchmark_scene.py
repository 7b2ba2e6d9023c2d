"""Scene of the tactile benchmarks: pads pressed flat on a chamfered ring, a mesh like the assembly parts."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from lerobot_vtrefine.tactile.geometry import Primitive, TriangleMesh
from lerobot_vtrefine.tactile.layout import PadLayout

NUM_ENVS, NUM_PADS = 64, 4
PRESS_M = 2e-4
LOAD_N = 5.0
LONGEST_S = 2.0
"""After this long, a measurement is not repeated any more [s]."""
REPEATS = 40
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

    @property
    def num_taxels(self) -> int:
        """Taxels of all environments."""
        return self.load.shape[0] * NUM_PADS * PadLayout().num_taxels


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


def best_seconds(call: Callable[[], object], on_gpu: bool = False) -> float:
    """Shortest of several runs [s]: processor time of this thread, or on a GPU time by the clock.

    The minimum, and processor time, are what other load on the machine disturbs least.
    """
    clock = time.perf_counter if on_gpu else time.thread_time
    call()
    times, end = [], time.perf_counter() + LONGEST_S
    while len(times) < 3 or (len(times) < REPEATS and time.perf_counter() < end):
        begin = clock()
        call()
        times.append(clock() - begin)
    return min(times)
