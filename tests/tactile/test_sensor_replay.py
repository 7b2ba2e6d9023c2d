"""Replay of recordings: the same code as the simulator's, and inputs that make no sense."""

import numpy as np
import pytest
import torch

from lerobot_vtrefine.tactile import BodyGeometry, Box, PadLayout, PadSensors, Poses, SensorModel, Sphere
from lerobot_vtrefine.tactile.replay import column_heights, finite_rate, replay
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.host import Latency, SampleAndHold
from lerobot_vtrefine.tactile.stages.hysteresis import Hysteresis
from lerobot_vtrefine.tactile.stages.mechanics import MechanicalSpreading, ViscoelasticRelaxation
from lerobot_vtrefine.tactile.stages.readout import BaselineDrift, Crosstalk, Idle
from lerobot_vtrefine.tactile.stages.surface import ContactOffset, PadTilt

LAYOUT = PadLayout(4, 8, 0.002)
MODEL = SensorModel.default().with_stage(KelvinVoigt()).with_stage(Idle(20.0, 0.0)).without("noise")
for added in (
    ContactOffset(offset_m=5e-5),
    PadTilt(tilt_x_rad=0.01),
    MechanicalSpreading(sigma_m=1e-3),
    ViscoelasticRelaxation(tau_s=0.4, fraction=0.2),
    Hysteresis(),
    Crosstalk(),
    BaselineDrift(rate_counts_per_s=0.5),
    Latency(tau_s=0.03),
    SampleAndHold(period_s=0.05),
):
    MODEL = MODEL.with_stage(added)


def test_replaying_a_simulated_press_gives_the_simulated_counts() -> None:
    times = np.arange(60) * 0.02
    depth = 4e-4 * np.sin(3 * times)
    velocity = 4e-4 * 3 * np.cos(3 * times)
    body = BodyGeometry([Box((0.006, 0.02, 0.01))])
    sensors = PadSensors(LAYOUT, [body], 1, num_pads=1, model=MODEL)
    eye = np.eye(3)[None, None]
    simulated = [
        sensors.counts(
            [0],
            Poses(
                np.zeros((1, 1, 3)),
                eye,
                np.zeros((1, 1, 6)),
                np.array([[[0, 0, 0.01 - d]]]),
                eye,
                np.array([[[0, 0, -v, 0, 0, 0]]]),
            ),
            0.02,
        )[0, 0]
        for d, v in zip(depth, velocity, strict=True)
    ]
    position = np.column_stack([np.zeros((60, 2)), 0.01 - depth])
    heights = column_heights(LAYOUT, body, position, np.tile(np.eye(3), (60, 1, 1)))
    rate = np.broadcast_to(velocity[:, None, None], heights.shape)
    predicted = replay(MODEL, times, heights, rate, layout=LAYOUT, skip=())
    difference = np.abs(predicted.numpy().reshape(60, -1) - np.array(simulated))
    assert np.array(simulated).max() > 60
    # The first frame's step differs: a simulation's has a duration, a recording's begins the clock.
    assert difference[1:].max() <= 1
    assert (difference[1:] > 0).mean() < 0.01


def test_batches_of_trials_equal_single_ones() -> None:
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.005, 0.03, 30))
    depth = rng.uniform(-2e-4, 5e-4, (30, 3, 4, 8))
    together = replay(MODEL, times, depth, layout=LAYOUT)
    for trial in range(3):
        assert torch.allclose(
            replay(MODEL, times, depth[:, trial], layout=LAYOUT), together[:, trial], atol=1e-3
        )


def test_force_replaces_the_contact_model() -> None:
    times = np.arange(10) * 0.1
    force = np.broadcast_to(np.linspace(0, 1, 10)[:, None, None], (10, 4, 8))
    model = SensorModel.paper().without("quantisation")
    assert np.allclose(replay(model, times, force_n=force).numpy(), 255e3 * force)
    with_offset = model.with_stage(ContactOffset(offset_m=1e-4))
    assert torch.equal(replay(with_offset, times, force_n=force), replay(model, times, force_n=force))


def test_drift_runs_on_session_time() -> None:
    model = SensorModel.paper().with_stage(BaselineDrift(rate_counts_per_s=0.1))
    predicted = replay(model, np.array([0.0, 10.0]), np.full((2, 4, 8), -1.0), start_s=100.0)
    assert np.allclose(predicted[:, 0, 0], [10.0, 11.0])
    anew = model.with_stage(BaselineDrift(rate_counts_per_s=0.1, anew=True))
    again = replay(anew, np.array([0.0, 10.0]), np.full((2, 4, 8), -1.0), start_s=100.0)
    assert np.allclose(again[:, 0, 0], [0.0, 1.0])


def test_rate_is_exact_for_quadratic_depth_and_survives_repeated_times() -> None:
    times = torch.linspace(0, 1, 11, dtype=torch.float64)
    depth = (times**2).view(-1, 1, 1).expand(11, 4, 8)
    assert torch.allclose(finite_rate(times, depth)[1:-1, 0, 0], 2 * times[1:-1], atol=1e-9)
    repeated = torch.tensor([0.0, 0.1, 0.1, 0.2], dtype=torch.float64)
    held = torch.tensor([0.0, 1e-4, 1e-4, 2e-4], dtype=torch.float64).view(-1, 1, 1).expand(4, 4, 8)
    assert torch.isfinite(finite_rate(repeated, held)).all()
    assert finite_rate(repeated, held).abs().max() < 2e-3


def test_heights_of_a_sphere_are_signed() -> None:
    heights = column_heights(
        LAYOUT, BodyGeometry([Sphere(0.01)]), np.array([[0, 0, 0.0097]]), np.eye(3)[None]
    )[0]
    x, y = (axis for axis in LAYOUT.axes_m())
    expected = np.sqrt(0.01**2 - x[None] ** 2 - y[:, None] ** 2) - 0.0097
    assert np.allclose(heights, expected, atol=1e-6)


def test_inputs_that_disagree_are_refused() -> None:
    depth = np.zeros((5, 4, 8))
    with pytest.raises(ValueError, match="exactly one of depth_m and force_n"):
        replay(MODEL, np.arange(5), depth, force_n=depth)
    with pytest.raises(ValueError, match="T = 4 times"):
        replay(MODEL, np.arange(4), depth)
    with pytest.raises(ValueError, match="for a 12 x 32 pad"):
        replay(MODEL, np.arange(5), depth, layout=PadLayout())
