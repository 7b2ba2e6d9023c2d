"""Constraint rows of the GPU step against MuJoCo's costs in double precision, differentiated by torch."""

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco_warp")
wp = pytest.importorskip("warp")
pytestmark = pytest.mark.timeout(900)

WORLDS, ROWS, SPEEDS = 400, 7, 4
FRICTION = np.array([0.8, 0.6, 0.3])
EQUALITY, DRY, LIMIT, CONTACT = 0, 1, 2, slice(3, 7)
RATIO = 0.9


def cost(residual, stiffness, loss):
    """MuJoCo's cost (WORLDS, 4) of an equality, dry friction, a limit and a contact, float64."""
    squares = 0.5 * stiffness * residual**2
    edge = loss / stiffness[:, DRY]
    size = residual[:, DRY].abs()
    dry = torch.where(size < edge, squares[:, DRY], loss * (size - 0.5 * edge))
    limit = torch.where(residual[:, LIMIT] < 0, squares[:, LIMIT], 0.0)
    mu = FRICTION[0] * RATIO
    n = mu * residual[:, 3]
    t = torch.linalg.norm(torch.from_numpy(FRICTION) * residual[:, 4:], dim=1)
    scale = stiffness[:, 3] / (mu**2 * (1 + mu**2))
    slide = torch.where(mu * n + t <= 0, squares[:, CONTACT].sum(1), 0.5 * scale * (n - mu * t) ** 2)
    return torch.stack([squares[:, EQUALITY], dry, limit, torch.where(n >= mu * t, 0.0, slide)], 1)


@pytest.fixture(scope="module")
def drawn():
    """Residuals, slopes, stiffness, Jacobians and losses in all worlds."""
    rng = np.random.default_rng(0)
    residual, slope = rng.normal(size=(2, WORLDS, ROWS))
    residual[:, 3] *= 2.0
    stiffness = np.exp(rng.normal(0, 1, (WORLDS, ROWS)))
    mu = FRICTION[0] * RATIO  # the solver ties the stiffness of a contact's rows to each other
    stiffness[:, 4:] = stiffness[:, 3:4] * FRICTION**2 / mu**2
    jacobian = rng.normal(size=(WORLDS, ROWS, SPEEDS))
    return [
        item.astype(np.float32)
        for item in (residual, slope, stiffness, jacobian, rng.uniform(0.2, 1, WORLDS))
    ]


def on_warp(drawn):
    """The rows as the solver has them."""
    from lerobot_vtrefine.sim.backends import warp_rows_kernels as kernels

    residual, slope, stiffness, jacobian, loss = drawn
    rows, cones, kinds = kernels.Rows(), kernels.Cones(), np.zeros((WORLDS, ROWS), np.int32)
    kinds[:, CONTACT] = kernels.ELLIPTIC
    losses = np.zeros((WORLDS, ROWS), np.float32)
    losses[:, DRY] = loss
    numbers = {"residual": residual, "slope": slope, "stiffness": stiffness, "loss": losses}
    numbers["force"] = 0 * residual
    contact = np.repeat(np.arange(WORLDS)[:, None], ROWS, 1)
    counts = {"equalities": np.ones(WORLDS), "frictions": np.ones(WORLDS), "count": np.full(WORLDS, ROWS)}
    integers = {"kind": kinds, "contact": contact, "state": 0 * contact} | counts
    for name, values in numbers.items():
        setattr(rows, name, wp.array(values, dtype=float, device="cpu"))
    for name, values in integers.items():
        setattr(rows, name, wp.array(values.astype(np.int32), dtype=int, device="cpu"))
    lone = np.tile(np.arange(ROWS, dtype=np.int32), (WORLDS, 1))
    rows.lone = wp.array(lone, dtype=int, device="cpu")
    rows.line = wp.zeros((WORLDS, ROWS, 3), dtype=wp.vec4, device="cpu")
    rows.quads = wp.array(jacobian.reshape(WORLDS, ROWS, 1, SPEEDS), dtype=wp.vec4, device="cpu")
    cones.row = wp.array(np.tile(np.arange(3, 7, dtype=np.int32), (WORLDS, 1)), dtype=int, device="cpu")
    cones.dim = wp.full(WORLDS, 4, dtype=int, device="cpu")
    frictions = np.tile(np.append(FRICTION, [0, 0]).astype(np.float32), (WORLDS, 1))
    cones.friction = wp.array(frictions, dtype=float, device="cpu")
    cones.ratio = wp.full(1, RATIO, dtype=float, device="cpu")
    return rows, cones


def run(drawn, step):
    """Per world: along the line (4, 3), forces (ROWS,), states (ROWS,), curvature (4, SPEEDS, SPEEDS)."""
    from lerobot_vtrefine.sim.backends import warp_rows_kernels as kernels

    @wp.kernel(module="unique", enable_backward=False)
    def look(
        step: float,
        rows: kernels.Rows,
        cones: kernels.Cones,
        line: wp.array(dtype=wp.vec3, ndim=2),
        bend: wp.array(dtype=wp.mat44, ndim=2),
    ) -> None:
        world, row = wp.tid()
        kernels.lay(world, row, rows, cones)
        line[world, row] = kernels.along_line(world, row, step, rows)
        kernels.push(world, row, rows, cones)
        bent = kernels.bent(world, row, 0, rows, cones)
        bend[world, row] = wp.outer(bent, bent)

    rows, cones = on_warp(drawn)
    line = wp.zeros((WORLDS, ROWS), dtype=wp.vec3, device="cpu")
    bend = wp.zeros((WORLDS, ROWS), dtype=wp.mat44, device="cpu")
    for _ in range(2):  # the curvature is that of the states of the first time
        wp.launch(look, (WORLDS, ROWS), [step, rows, cones, line, bend], device="cpu")
    parts = [EQUALITY, DRY, LIMIT, 3]
    bend = bend.numpy()
    curves = np.concatenate([bend[:, :3], bend[:, CONTACT].sum(1, keepdims=True)], 1)
    return line.numpy()[:, parts], rows.force.numpy(), rows.state.numpy(), curves


@pytest.mark.parametrize("step", [0.0, 0.4, 3.0])
def test_cost_along_a_line(drawn, step):
    residual, slope, stiffness, _, loss = (torch.from_numpy(item).double() for item in drawn)
    at = torch.full((WORLDS, 1), step, dtype=torch.float64, requires_grad=True)
    costs = cost(residual + at * slope, stiffness, loss)
    change = (costs - cost(residual, stiffness, loss)).detach().numpy()
    line = run(drawn, step)[0]
    for part in range(4):
        (rate,) = torch.autograd.grad(costs[:, part].sum(), at, create_graph=True)
        (bend,) = torch.autograd.grad(rate.sum(), at, retain_graph=True)
        truth = np.stack([change[:, part], rate.detach().numpy()[:, 0], bend.numpy()[:, 0]], 1)
        np.testing.assert_allclose(line[:, part], truth, rtol=1e-4, atol=1e-4, err_msg=str(part))


def test_forces_and_curvature(drawn):
    residual, _, stiffness, jacobian, loss = (torch.from_numpy(item).double() for item in drawn)
    residual.requires_grad_()
    (slope,) = torch.autograd.grad(cost(residual, stiffness, loss).sum(), residual, create_graph=True)
    rows = [torch.autograd.grad(slope[:, row].sum(), residual, retain_graph=True)[0] for row in range(ROWS)]
    bent = jacobian.mT @ torch.stack(rows, 1) @ jacobian
    _, forces, states, curves = run(drawn, 0.0)
    assert np.bincount(states[:, 3], minlength=5)[[0, 1, 4]].min() > 30  # free, sticking, sliding contacts
    assert set(states[:, DRY]) == {1, 2, 3}
    np.testing.assert_allclose(forces, -slope.detach().numpy(), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(curves.sum(1), bent.detach().numpy(), rtol=1e-3, atol=1e-3)
