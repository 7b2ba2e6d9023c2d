"""When readings were new, and the rhythm in which they are held."""

import numpy as np
import pytest
import torch

from lerobot_vtrefine.diagnose.rhythm import Rhythm, slots
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.base import Frame
from lerobot_vtrefine.tactile.stages.host import SampleAndHold


def held_recording(period_s: float, phase: float, seed: int) -> Rhythm:
    """Noise of two taxels at 20 Hz for 10 s, held."""
    time_s = np.arange(200) * 0.05
    noise = np.random.default_rng(seed).standard_normal((200, 2))
    slot = slots(time_s, period_s, phase)
    first = np.searchsorted(slot, slot, side="left")
    return Rhythm.of(time_s, noise[first], np.ones(200, dtype=bool))


@pytest.mark.parametrize(("period_s", "phase"), [(0.13, 0.3), (0.185, 0.9), (0.21, 0.0)])
def test_the_phase_of_held_readings_is_found(period_s: float, phase: float) -> None:
    rhythm = held_recording(period_s, phase, 3)
    assert abs((rhythm.phase(period_s) - phase + 0.5) % 1.0 - 0.5) < 0.06
    due, changed, changes, repeats, late = rhythm.against(period_s, free=True)
    assert changed <= 0.03 * due
    assert late <= 0.03 * repeats
    assert changes == pytest.approx(10.0 / period_s, abs=2)


def test_another_period_is_contradicted() -> None:
    due, changed, *_ = held_recording(0.13, 0.3, 4).against(0.17, free=True)
    assert changed > 0.2 * due


def test_a_free_board_predicts_the_mean_over_its_instants() -> None:
    layout = PadLayout(1, 1, 0.002)
    time_s = torch.arange(400, dtype=torch.float64) * 0.01
    ramp = (3.0 * time_s)[:, None, None]
    stage = SampleAndHold(0.2, free=True)
    mean = stage.sequence(ramp, time_s, Frame(layout))[200:, 0, 0]
    assert torch.allclose(mean, ramp[200:, 0, 0] - 3.0 * 0.1)


def test_a_free_board_holds_from_an_instant_of_its_own_in_every_episode() -> None:
    layout = PadLayout(1, 1, 0.002)
    stage = SampleAndHold(0.2, free=True)
    traits = stage.traits(layout, 3, np.random.default_rng(0))
    assert len(set(traits["phase"].ravel().tolist())) == 3
    state = {key: torch.as_tensor(value) for key, value in {**stage.initial(layout, 3), **traits}.items()}
    changes = torch.zeros(3)
    previous = None
    for k in range(100):
        x = torch.full((3, 1, 1), float(k))
        held, state = stage.step(x, state, Frame(layout, dt_s=0.01, time_s=0.01 * k))
        changes += 0 if previous is None else (held != previous).reshape(3)
        previous = held
    assert ((changes >= 4) & (changes <= 5)).all()


def test_models_of_free_boards_survive_their_file() -> None:
    model = SensorModel.paper().with_stage(SampleAndHold(0.2, free=True))
    assert SensorModel.from_dict(model.to_dict()) == model
