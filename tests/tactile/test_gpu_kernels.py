"""The contact kernels on a GPU against the same source on CPU: every shape and model, large pads, graphs."""

import numpy as np
import pytest
import torch
import warp as wp
from touch_shapes import hexagon, random_rotation, ring_mesh

from lerobot_vtrefine.tactile import BodyGeometry, Box, Cylinder, PadLayout, Sphere
from lerobot_vtrefine.tactile.contact_query import ContactQuery
from lerobot_vtrefine.tactile.foundation import ContactSolver
from lerobot_vtrefine.tactile.geometry import Primitive

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]

ENVS, PADS = 16, 2
SHAPES: dict[str, list[Primitive]] = {
    "sphere": [Sphere(0.01)],
    "box": [Box((0.017, 0.02, 0.012))],
    "cylinder": [Cylinder(0.009, 0.011)],
    "hull": [hexagon()],
    "ring": [ring_mesh()],
    "fine ring": [ring_mesh(200)],
    "many": [Box((0.001, 0.004, 0.01), pos=(0.0025 * (i - 20), 0, 0.0002 * (i % 3))) for i in range(40)],
    "mixed": [Box((0.012, 0.004, 0.009)), Cylinder(0.006, 0.01), ring_mesh()],
}
LAYOUTS = {"small": PadLayout(), "large": PadLayout(40, 72, 0.001)}
"""The large one does not fit into a multiprocessor's memory."""


def scene(layout: PadLayout, shape: list[Primitive]) -> tuple[tuple[torch.Tensor, ...], torch.Tensor]:
    """Poses and loads of pads that touch, or nearly, a turned and moving body; one pad without load."""
    rng = np.random.default_rng(3)
    turn = np.stack([random_rotation(rng) if env % 2 else np.eye(3) for env in range(ENVS)])[:, None]
    eye = np.broadcast_to(np.eye(3), (ENVS, PADS, 3, 3))
    place = np.zeros((ENVS, PADS, 3))
    place[..., :2] = rng.uniform(-3e-3, 3e-3, (ENVS, PADS, 2))
    body = np.tile([0.0, 0.0, 0.0115], (ENVS, 1, 1))
    speeds = [rng.normal(0, 0.02, (ENVS, count, 6)) for count in (PADS, 1)]
    arrays = [place, eye, speeds[0], body, turn, speeds[1]]
    # Contiguous, as copies that the solver would have to make could not be captured in a graph.
    poses = tuple(torch.tensor(np.ascontiguousarray(array), dtype=torch.float32) for array in arrays)
    heights, _ = ContactQuery(layout, [BodyGeometry(shape)])("column", *poses)
    depth = torch.tensor(rng.uniform(-1e-4, 6e-4, (ENVS, PADS)), dtype=torch.float32)
    highest = heights.flatten(2).max(2).values
    poses[0][..., 2] += torch.where(highest > -0.5, depth - highest, 0.0)
    load = torch.tensor(rng.uniform(0.5, 10, (ENVS, PADS, 3)), dtype=torch.float32)
    load[..., 1:] = (load[..., 1:] - 5) * 1e-4 - poses[0][..., :2]
    load[0, 0] = 0
    return poses, load


def answers(device: str, layout: PadLayout, shape: list[Primitive]) -> dict[str, np.ndarray]:
    """What every kernel says, by name."""
    poses, load = scene(layout, shape)
    poses, load = tuple(pose.to(device) for pose in poses), load.to(device)
    found = {}
    for subdivision in (1, 2):
        query = ContactQuery(layout, [BodyGeometry(shape)], device, subdivision)
        solver = ContactSolver(layout, query)
        found[f"foundation {subdivision}"] = solver.foundation(poses, load, 800.0, 3e-3)[0].clone()
        for mode in ("closest", "column"):
            depth, rate = (item.clone() for item in query(mode, *poses))
            found[f"{mode} {subdivision}"] = depth
            found[f"{mode} rate {subdivision}"] = torch.where(
                depth > (-0.5 if mode == "column" else 0), rate, 0
            )
            if subdivision == 1:
                found[f"penalty {mode}"] = solver.penalty(mode, poses, 400.0, 1.2, 9.0).clone()
        depth, rate = query("column", *poses, load=load)
        heights = (depth.clone(), rate.clone())
        found[f"given heights {subdivision}"] = solver.foundation(poses, load, 800.0, 3e-3, heights)[
            0
        ].clone()
    return {name: value.cpu().numpy() for name, value in found.items()}


@pytest.mark.parametrize("size", sorted(LAYOUTS))
@pytest.mark.parametrize("name", sorted(SHAPES))
def test_gpu_agrees_with_cpu(name: str, size: str) -> None:
    """But for points that rounding may put on either side: of a body's edge, or of the line between two
    facets, which move otherwise."""
    truth, found = (answers(device, LAYOUTS[size], SHAPES[name]) for device in ("cpu", "cuda"))
    for what, expected in truth.items():
        error = np.abs(found[what] - expected) / np.abs(expected).max()
        # The foundation is solved to 1e-5 of the load.
        solved = what.startswith(("foundation", "given"))
        moving = "rate" in what or "penalty" in what
        assert (error <= (1e-4 if solved else 1e-5)).mean() > (0.99 if moving else 0.9995), what


def test_two_runs_and_a_graph_give_the_same_bits() -> None:
    layout, shape = LAYOUTS["small"], SHAPES["mixed"]
    poses, load = scene(layout, shape)
    poses, load = tuple(pose.to("cuda") for pose in poses), load.to("cuda")
    solver = ContactSolver(layout, ContactQuery(layout, [BodyGeometry(shape)], "cuda", 2))
    first = solver.foundation(poses, load, 800.0, 3e-3)[0].clone()
    again = solver.foundation(poses, load, 800.0, 3e-3)[0]
    assert torch.equal(first, again)
    with wp.ScopedCapture("cuda") as capture:
        again = solver.foundation(poses, load, 800.0, 3e-3)[0]
    again.zero_()
    wp.capture_launch(capture.graph)
    wp.synchronize_device("cuda")
    assert torch.equal(first, again)


def test_sums_equal_the_loads() -> None:
    poses, load = scene(LAYOUTS["small"], SHAPES["ring"])
    query = ContactQuery(LAYOUTS["small"], [BodyGeometry(SHAPES["ring"])], "cuda", 2)
    force, _ = ContactSolver(LAYOUTS["small"], query).foundation(
        tuple(pose.to("cuda") for pose in poses), load.to("cuda"), 800.0, 3e-3
    )
    assert np.allclose(force.sum((2, 3)).cpu(), load[..., 0], rtol=1e-5, atol=1e-7)
