"""Shear: the solver's tangential force shared out, against friction's limit and closed forms."""

import numpy as np
import pytest
import torch

from lerobot_vtrefine.tactile import PadLayout, Poses
from lerobot_vtrefine.tactile.shear import Shear, ShearSensors

LAYOUT = PadLayout(6, 8, 0.002)
MODEL = Shear(friction=0.8, stiffness_n_per_m=500.0)
NORMAL = torch.rand((2, 3, 6, 8), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
STILL = torch.zeros((2, 3, 6, 8, 2), dtype=torch.float64)
LIMIT = 0.8 * NORMAL.sum((-2, -1))


def test_forces_add_up_and_respect_friction() -> None:
    """From rest and from a strained skin, at a tenth to nearly all of what friction allows."""
    rng = torch.Generator().manual_seed(1)
    strain = 1e-3 * torch.randn(STILL.shape, generator=rng, dtype=torch.float64)
    for share in (0.1, 0.5, 0.9, 0.99):
        angle = 6.28 * torch.rand((2, 3), generator=rng, dtype=torch.float64)
        total = (share * LIMIT)[..., None] * torch.stack([angle.cos(), angle.sin()], -1)
        for start in (STILL, strain):
            force, _ = MODEL.step(NORMAL, start, STILL, total)
            assert torch.allclose(force.sum((-3, -2)), total, rtol=1e-6, atol=1e-7)
            assert (force.norm(dim=-1) <= 0.8 * NORMAL * (1 + 1e-9)).all()


def test_a_small_pull_is_shared_evenly_and_a_full_slip_by_pressure() -> None:
    pressed = torch.ones_like(NORMAL)
    force, strain = MODEL.step(pressed, STILL, STILL, torch.tensor([0.48, 0.0]).expand(2, 3, 2).double())
    assert torch.allclose(force[..., 0], torch.full_like(pressed, 0.01))
    assert torch.allclose(strain[..., 0], torch.full_like(pressed, 0.01 / 500))
    pull = torch.zeros((2, 3, 2), dtype=torch.float64)
    pull[..., 1] = 2 * LIMIT
    force, _ = MODEL.step(NORMAL, STILL, STILL, pull)
    assert torch.allclose(force[..., 1], 0.8 * NORMAL)


def test_twisting_strains_the_skin_around_the_centre_and_slips_outside_first() -> None:
    """A body spinning on a pad without a net pull: forces circle, grow outwards up to friction, and stay."""
    sensors = ShearSensors(LAYOUT, 1, 1, MODEL)
    eye, still = np.eye(3)[None, None], np.zeros((1, 1, 6))
    spin = np.array([[[0, 0, 0, 0, 0, 0.5]]])
    poses = Poses(np.zeros((1, 1, 3)), eye, still, np.zeros((1, 1, 3)), eye, spin)
    normal, none = torch.full((1, 1, 48), 0.2), torch.zeros((1, 1, 2))
    ids = torch.arange(1)
    force = sensors.forces(ids, normal, poses, 0.1, none)[0, 0]
    place = torch.from_numpy(LAYOUT.positions()).reshape(6, 8, 3)[..., :2]
    expected = 500 * 0.05 * torch.stack([-place[..., 1], place[..., 0]], -1)
    stuck = expected.norm(dim=-1) < 0.16
    assert 0 < stuck.sum() < 48
    assert torch.allclose(force[stuck], expected[stuck])
    assert torch.allclose(force.norm(dim=-1)[~stuck], torch.tensor(0.16, dtype=torch.float64))
    at_rest = poses._replace(body_vel=still)
    assert torch.allclose(sensors.forces(ids, normal, at_rest, 0.1, none)[0, 0], force)
    sensors.reset(ids)
    assert sensors.forces(ids, normal, at_rest, 0.1, none).abs().max() == 0


def test_no_pressure_no_shear() -> None:
    force, strain = MODEL.step(torch.zeros_like(NORMAL), STILL + 1e-3, STILL, torch.ones((2, 3, 2)).double())
    assert force.abs().max() == 0
    assert strain.abs().max() == 0


@pytest.mark.parametrize("field", ["friction", "stiffness_n_per_m"])
def test_parameters_must_be_positive(field: str) -> None:
    with pytest.raises(ValueError, match=f"shear.{field} must be positive, got -1"):
        Shear(**{field: -1.0})
