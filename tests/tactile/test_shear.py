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


def spinning_pad() -> Poses:
    """One pad at rest, and a body in its frame that turns about its normal."""
    eye, still = np.eye(3)[None, None], np.zeros((1, 1, 6))
    spin = np.array([[[0, 0, 0, 0, 0, 0.5]]])
    return Poses(np.zeros((1, 1, 3)), eye, still, np.zeros((1, 1, 3)), eye, spin)


def test_twisting_strains_the_skin_around_the_centre_and_slips_outside_first() -> None:
    """A body spinning on a pad without a net pull: forces circle, grow outwards up to friction, and stay."""
    sensors, poses = ShearSensors(LAYOUT, 1, [0], MODEL), spinning_pad()
    normal, none = torch.full((1, 1, 48), 0.2), torch.zeros((1, 1, 2))
    ids = torch.arange(1)
    force = sensors.advance(ids, normal, poses, 0.1, none)[0, 0]
    place = torch.from_numpy(LAYOUT.positions()).reshape(6, 8, 3)[..., :2].float()
    expected = 500 * 0.05 * torch.stack([-place[..., 1], place[..., 0]], -1)
    stuck = expected.norm(dim=-1) < 0.16
    assert 0 < stuck.sum() < 48
    assert torch.allclose(force[stuck], expected[stuck])
    assert torch.allclose(force.norm(dim=-1)[~stuck], torch.tensor(0.16))
    at_rest = poses._replace(body_vel=np.zeros((1, 1, 6)))
    assert torch.allclose(sensors.advance(ids, normal, at_rest, 0.1, none)[0, 0], force)
    assert torch.equal(sensors.forces(ids)[0, 0], sensors.advance(ids, normal, at_rest, 0.1, none)[0, 0])
    sensors.reset(ids)
    assert sensors.forces(ids).abs().max() == 0
    assert sensors.advance(ids, normal, at_rest, 0.1, none).abs().max() == 0


def test_moving_the_whole_scene_changes_nothing() -> None:
    """Poses turned, shifted, and carried along at a common velocity: shear is the pad's own matter."""
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    shift, drift, whirl = rng.normal(size=(3, 3))
    still = spinning_pad()._replace(body_pos=np.array([[[0.01, 0.02, 0.03]]]))

    def carried(pos: np.ndarray, rot: np.ndarray, vel: np.ndarray) -> tuple[np.ndarray, ...]:
        place = pos @ turn.T + shift
        linear = vel[..., :3] @ turn.T + drift + np.cross(whirl, place)
        return place, turn @ rot, np.concatenate([linear, vel[..., 3:] @ turn.T + whirl], -1)

    moved = Poses(*carried(*still[:3]), *carried(*still[3:]))
    normal, pull = torch.full((1, 1, 48), 0.2), torch.tensor([[[1.0, -2.0]]])
    forces = [
        ShearSensors(LAYOUT, 1, [0], MODEL).advance(np.arange(1), normal, poses, 0.1, pull)
        for poses in (still, moved)
    ]
    assert torch.allclose(*forces, atol=1e-7)
    assert torch.allclose(forces[0].sum((-3, -2)), pull, atol=1e-5)


def test_each_pad_follows_its_own_body_and_each_environment_its_own_friction() -> None:
    sensors, one = ShearSensors(LAYOUT, 3, [1, 0], MODEL), spinning_pad()
    bodies = [np.repeat(np.repeat(item, 2, 1), 2, 0) for item in one]
    bodies[5][:, 0] = 0.0  # body 0 is at rest: only the first pad, which holds body 1, is twisted
    ids, normal = np.array([0, 2]), np.full((2, 2, 48), 0.2)
    sensors.reset(ids, friction=np.array([0.8, 0.4]))
    force = sensors.advance(ids, normal, Poses(*bodies), 0.1, np.zeros((2, 2, 2))).norm(dim=-1)
    assert force[:, 1].max() == 0
    assert torch.allclose(force[:, 0].amax((-2, -1)), torch.tensor([0.16, 0.08]))
    assert sensors.forces(np.array([1])).abs().max() == 0
    kept = sensors.get_state(2)
    sensors.reset(np.array([2]))
    assert sensors.forces(ids).norm(dim=-1)[0].max() > 0
    sensors.set_state(1, kept)
    assert torch.equal(sensors.forces(np.array([1]))[0].norm(dim=-1), force[1])


def test_no_pressure_no_shear() -> None:
    force, strain = MODEL.step(torch.zeros_like(NORMAL), STILL + 1e-3, STILL, torch.ones((2, 3, 2)).double())
    assert force.abs().max() == 0
    assert strain.abs().max() == 0


@pytest.mark.parametrize("field", ["friction", "stiffness_n_per_m"])
def test_parameters_must_be_positive(field: str) -> None:
    with pytest.raises(ValueError, match=f"shear.{field} must be positive, got -1"):
        Shear(**{"friction": 1.0, "stiffness_n_per_m": 400.0, field: -1.0})
