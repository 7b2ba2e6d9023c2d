"""Laws of what the contact's springs bear, beside damping: closed forms, and simulated as replayed."""

import numpy as np
import pytest
import torch

from lerobot_vtrefine.tactile import BodyGeometry, Box, PadLayout, PadSensors, Poses, SensorModel
from lerobot_vtrefine.tactile.replay import column_heights, replay
from lerobot_vtrefine.tactile.stages.contact import Consistent, ContactStage, KelvinVoigt
from lerobot_vtrefine.tactile.stages.cover import CoverLaw
from lerobot_vtrefine.tactile.stages.hysteresis import Hysteresis
from lerobot_vtrefine.tactile.stages.mechanics import (
    MechanicalSpreading,
    NonlinearStiffness,
    ViscoelasticRelaxation,
)
from lerobot_vtrefine.tactile.stages.readout import Gain, Idle, Quantisation
from lerobot_vtrefine.tactile.stages.softening import FirstLoadSoftening

K_N, K_D = 400.0, 6.0
LAYOUT = PadLayout(4, 8, 0.002)
LAWS = [
    NonlinearStiffness(1.4, elastic=True),
    ViscoelasticRelaxation(0.3, 0.3, elastic=True),
    Hysteresis(0.3, 2e-4, elastic=True),
    FirstLoadSoftening(0.4, elastic=True),
]


def model(*laws: CoverLaw | MechanicalSpreading, contact: ContactStage | None = None) -> SensorModel:
    """Counts are newtons, from no idle level on."""
    contact = contact or KelvinVoigt(K_N, K_D)
    found = SensorModel((contact, Gain(1.0), Idle(0.0, 0.0), Quantisation(1e-6, 1e6)))
    for law in laws:
        found = found.with_stage(law)
    return found


def press(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth and rate (T, 1, 1) of a press that comes and goes."""
    depth, rate = 8e-4 * np.sin(3 * times), 2.4e-3 * np.cos(3 * times)
    return depth[:, None, None], rate[:, None, None]


def test_a_spring_that_hardens_beside_a_dashpot() -> None:
    times = np.linspace(0.02, 1.0, 50)
    depth, rate = press(times)
    predicted = replay(model(NonlinearStiffness(1.4, elastic=True)), times, depth, rate).numpy()
    force = K_N * 1e-3 * (depth / 1e-3) ** 1.4 + K_D * rate
    assert np.allclose(predicted, np.maximum(force, 0.0), atol=1e-5)
    whole = replay(model(NonlinearStiffness(1.4)), times, depth, rate).numpy()
    assert np.abs(whole - predicted).max() > 1e-3


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_without_damping_it_is_the_same_law(law: CoverLaw) -> None:
    times = np.linspace(0.0, 1.0, 50)
    depth, rate = press(times)
    springs = KelvinVoigt(K_N, 0.0)
    plain = type(law)(**{**vars(law), "elastic": False})
    beside, whole = (replay(model(stage, contact=springs), times, depth, rate) for stage in (law, plain))
    assert torch.equal(beside, whole.clamp(min=0.0))  # which never pulls


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_a_simulation_reads_what_a_replay_does(law: CoverLaw) -> None:
    times = np.arange(60) * 0.02
    depth, velocity = 4e-4 * np.sin(3 * times), 1.2e-3 * np.cos(3 * times)
    body, eye = BodyGeometry([Box((0.006, 0.02, 0.01))]), np.eye(3)[None, None]
    sensor = model(MechanicalSpreading(1e-3), law).with_stage(Gain(200.0)).with_stage(Idle(20.0, 0.0))
    sensor = sensor.with_stage(Quantisation(1.0, 255.0))
    sensors = PadSensors(LAYOUT, [body], 1, num_pads=1, model=sensor)
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
    predicted = replay(sensor, times, heights, rate, layout=LAYOUT, skip=()).numpy().reshape(60, -1)
    assert np.array(simulated).max() > 40
    assert np.abs(predicted - np.array(simulated))[1:].max() <= 1.0


def test_the_saved_model_keeps_it(tmp_path) -> None:
    model(*LAWS).save(tmp_path / "sensor_model.json")
    assert SensorModel.load(tmp_path / "sensor_model.json") == model(*LAWS)


def test_a_foundation_has_springs_of_its_own() -> None:
    depth, rate = torch.tensor([[[4e-4]]]), torch.tensor([[[1e-2]]])
    law = Consistent(damping_s=5e-3)
    springs = law.undamped().force(depth, rate, LAYOUT)
    assert float(springs) == pytest.approx(float(law.force(depth, torch.zeros_like(rate), LAYOUT)))
    assert float(law.force(depth, rate, LAYOUT)) > float(springs)
