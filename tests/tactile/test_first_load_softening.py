"""First-load softening and element-by-element scanning, against closed forms."""

from dataclasses import replace
from math import erf

import numpy as np
import pytest
import torch

from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import Frame
from lerobot_vtrefine.tactile.stages.host import ScanSkew
from lerobot_vtrefine.tactile.stages.softening import FirstLoadSoftening, PathSoftening, Remembering

FRAME = Frame(PadLayout(1, 1, 0.002), stiffness_n_per_m=1000.0)


def course(values: list[float]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64).view(-1, 1, 1)


def softened(stage: Remembering, values: list[float], step_s: float = 0.1) -> np.ndarray:
    times = step_s * torch.arange(len(values), dtype=torch.float64)
    return stage.sequence(course(values), times, FRAME).numpy().ravel()


def test_first_load_is_virgin_and_reloading_is_softer_until_the_largest_load() -> None:
    found = softened(FirstLoadSoftening(0.4), [0.0, 0.5, 1.0, 0.5, 0.0, 0.5, 1.0, 1.2])
    below = 0.5 * (1 - 0.4 * 0.5)
    assert np.allclose(found, [0.0, 0.5, 1.0, below, 0.0, below, 1.0, 1.2])


def test_sharpness_and_growth() -> None:
    assert softened(FirstLoadSoftening(0.4, sharpness=2.0), [1.0, 0.5])[1] == pytest.approx(
        0.5 * (1 - 0.4 * 0.25)
    )
    # The load of a press of 1 mm is 1 N here: half of it softens half as much.
    stage = FirstLoadSoftening(0.4, growth=1.0)
    assert softened(stage, [0.5, 0.25])[1] == pytest.approx(0.25 * (1 - 0.4 * 0.5 * 0.5))


def test_what_was_softened_recovers() -> None:
    values = [1.0, *[0.0] * 30, 0.5]
    late = softened(FirstLoadSoftening(0.4, recovery_s=1.0), values)
    largest = max(0.5, np.exp(-3.1))
    assert late[-1] == pytest.approx(0.5 * (1 - 0.4 * (1 - 0.5 / largest)))
    assert late[-1] > softened(FirstLoadSoftening(0.4), values)[-1]


@pytest.mark.parametrize("recovery_s", [0.0, 3.0])
def test_a_first_load_is_virgin_whatever_the_sharpness(recovery_s: float) -> None:
    # A share of rounding, 1e-16, would be 0.16 to the power of 0.05.
    rising = np.linspace(0.1, 1.0, 60).tolist()
    found = softened(FirstLoadSoftening(0.3, sharpness=0.05, recovery_s=recovery_s), rising, 0.033)
    assert found.tolist() == rising


@pytest.mark.parametrize("recovery_s", [0.0, 0.7])
def test_a_recording_is_what_single_frames_give(recovery_s: float) -> None:
    stage = FirstLoadSoftening(0.3, 0.6, 0.5, recovery_s)
    rng = np.random.default_rng(0)
    x, times = (
        torch.from_numpy(rng.uniform(0, 2, (40, 3, 4))),
        torch.from_numpy(np.cumsum(rng.uniform(0.02, 0.2, 40))),
    )
    state, previous = {"largest": torch.zeros(3, 4, dtype=torch.float64)}, times[0]
    for value, time, whole in zip(x, times, stage.sequence(x, times, FRAME), strict=True):
        frame = Frame(FRAME.layout, float(time - previous), stiffness_n_per_m=1000.0)
        one, state = stage.step(value, state, frame)
        previous = time
        assert torch.allclose(one, whole)


def in_session(stage: Remembering, values: list[float], borne_m: float, age_s: float) -> np.ndarray:
    """After an earlier recording that pressed so deep, so long ago."""
    earlier = (torch.tensor([[[borne_m]]]), torch.tensor([[[age_s]]]), torch.tensor([[[borne_m]]]))
    frame = replace(FRAME, borne=earlier)
    times = 0.1 * torch.arange(len(values), dtype=torch.float64)
    return stage.sequence(course(values), times, frame).numpy().ravel()


def test_a_session_remembers_what_earlier_recordings_pressed() -> None:
    # 1 mm bore 1 N here: below that even the first load of this recording is a second one.
    found = in_session(FirstLoadSoftening(0.4, session=True), [0.0, 0.5, 1.5, 0.5], 1e-3, 50.0)
    assert np.allclose(found, [0.0, 0.5 * (1 - 0.4 * 0.5), 1.5, 0.5 * (1 - 0.4 * 2 / 3)])


def test_what_a_session_remembers_fades() -> None:
    stage = FirstLoadSoftening(0.4, recovery_s=20.0, session=True)
    largest = np.exp(-(10.0 + 0.1) / 20.0)
    assert in_session(stage, [0.0, 0.5], 1e-3, 10.0)[1] == pytest.approx(
        0.5 * (1 - 0.4 * (1 - 0.5 / largest))
    )
    assert in_session(stage, [0.0, 0.5], 1e-3, 1e4)[1] == pytest.approx(0.5)


def test_a_virgin_cover_remembers_no_session() -> None:
    values = [0.0, 0.5, 0.2]
    assert np.array_equal(
        in_session(FirstLoadSoftening(0.4), values, 1e-3, 1.0), softened(FirstLoadSoftening(0.4), values)
    )


def test_every_rise_of_the_load_softens_and_letting_go_does_not() -> None:
    # A path of 2 mm is 2 N here.
    stage, values = PathSoftening(0.4, 2e-3), [0.0, 1.0, 0.5, 0.0, 1.0, 1.5]
    path = np.array([0.0, 1.0, 1.0, 1.0, 2.0, 2.5])
    left = 1 - 0.4 * (1 - np.exp(-path / 2))
    assert np.allclose(softened(stage, values), values * left)
    # The earlier recording went 2 mm.
    session = PathSoftening(0.4, 2e-3, session=True)
    assert in_session(session, [0.0, 1.0], 2e-3, 5.0)[1] == pytest.approx(1 - 0.4 * (1 - np.exp(-3 / 2)))
    assert in_session(stage, [0.0, 1.0], 2e-3, 5.0)[1] == pytest.approx(left[1])


def test_only_a_larger_load_than_ever_softens() -> None:
    # A path of 2 mm is 2 N here.
    stage, values = PathSoftening(0.4, 2e-3, peak=True), [0.0, 1.0, 0.5, 0.0, 1.0, 1.5]
    largest = np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.5])
    left = 1 - 0.4 * (1 - np.exp(-largest / 2))
    assert np.allclose(softened(stage, values), values * left)
    # An earlier recording pressed 2 mm deep.
    session = replace(stage, session=True)
    assert in_session(session, [0.0, 1.0], 2e-3, 5.0)[1] == pytest.approx(1 - 0.4 * (1 - np.exp(-1)))


def test_damage_may_show_only_below_the_largest_load() -> None:
    # A path of 2 mm is 2 N here, and damage shows within some 0.5 N of letting go.
    values = [0.0, 1.0, 0.5, 0.0, 1.0, 1.5, 1.4]
    stage = PathSoftening(0.4, 2e-3, peak=True, width_m=5e-4)
    largest = np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.5, 1.5])
    shown = np.array([0.0, 0.0, erf(1.0), erf(2.0), 0.0, 0.0, erf(0.2)])
    left = 1 - 0.4 * (1 - np.exp(-largest / 2)) * shown
    assert np.allclose(softened(stage, values), values * left)
    # Without a path it is the same after all loads; an earlier recording pressed 2 mm deep.
    session = replace(stage, path_m=0.0, session=True)
    assert in_session(session, [0.0, 1.5], 2e-3, 5.0)[1] == pytest.approx(1.5 * (1 - 0.4 * erf(1.0)))


def test_what_was_let_go_is_below_the_largest_load() -> None:
    with pytest.raises(ValueError, match="needs peak"):
        PathSoftening(0.4, 2e-3, width_m=5e-4)


def test_a_board_may_scan_along_the_columns_too() -> None:
    times = torch.linspace(0, 1, 101, dtype=torch.float64)
    ramp = times.view(-1, 1, 1).expand(-1, 3, 5)
    late = ScanSkew(0.02, cols_s=0.04).sequence(ramp, times, Frame(PadLayout(3, 5, 0.002)))
    rows, cols = torch.meshgrid(torch.arange(3) / 2, torch.arange(5) / 4, indexing="ij")
    assert torch.allclose(ramp[50] - late[50], (0.02 * rows + 0.04 * cols).to(late))
