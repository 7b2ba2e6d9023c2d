"""What stages can do beyond their plain form, each against its formula."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lerobot_vtrefine.tactile import PadLayout
from lerobot_vtrefine.tactile.stages.base import Frame, Stage
from lerobot_vtrefine.tactile.stages.dividers import RowSharing
from lerobot_vtrefine.tactile.stages.host import Latency, ScanSkew
from lerobot_vtrefine.tactile.stages.mechanics import (
    MechanicalSpreading,
    NonlinearStiffness,
    YieldingStiffness,
)
from lerobot_vtrefine.tactile.stages.readout import BaselineDrift, Crosstalk, DeadTaxels, Saturation

LAYOUT = PadLayout(6, 10, 0.002)
FRAME = Frame(layout=LAYOUT, stiffness_n_per_m=800.0)


def once(stage: Stage, x: torch.Tensor) -> torch.Tensor:
    return stage.step(x, {}, FRAME)[0]


def pressed_at(row: int, col: int, value: float = 100.0) -> torch.Tensor:
    x = torch.zeros(6, 10)
    x[row, col] = value
    return x


def test_taxels_die_as_often_as_stated() -> None:
    stage = DeadTaxels(probability=0.2)
    traits = stage.traits(PadLayout(), 40, np.random.default_rng(0))
    state = {name: torch.from_numpy(value) for name, value in traits.items()}
    y, _ = stage.step(torch.ones(40, 12, 32), state, Frame(layout=PadLayout(), stiffness_n_per_m=800.0))
    assert set(y.unique().tolist()) == {0.0, 1.0}
    assert (y == 0).float().mean().item() == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("side", [1, -1])
def test_crosstalk_falls_with_distance_on_the_side_stated(side: int) -> None:
    stage = Crosstalk(row=0.1, col=0.2, reach=2.0, row_side=side, col_side=side)
    y = once(stage, pressed_at(2, 4))
    decay = np.exp(-1 / 2.0)
    along = y[2, 4 + side :: side][:3].tolist() if side > 0 else y[2, :4].flip(0)[:3].tolist()
    down = y[2 + side :: side, 4][:2].tolist() if side > 0 else y[:2, 4].flip(0).tolist()
    assert along == pytest.approx([10.0, 10.0 * decay, 10.0 * decay**2], rel=1e-5)
    assert down == pytest.approx([20.0, 20.0 * decay], rel=1e-5)
    other = (y[2, :4], y[:2, 4]) if side > 0 else (y[2, 5:], y[3:, 4])
    assert all(torch.count_nonzero(values) == 0 for values in other)


def test_crosstalk_may_be_weaker_to_one_side() -> None:
    y = once(Crosstalk(row=0.1, col=0.2, reach=0.1, row_side=0.6, col_side=-0.25), pressed_at(2, 4))
    assert [y[2, 3].item(), y[2, 5].item()] == pytest.approx([4.0, 10.0])
    assert [y[1, 4].item(), y[3, 4].item()] == pytest.approx([20.0, 15.0])
    with pytest.raises(ValueError, match="between -1 and 1"):
        Crosstalk(row_side=1.5)


def test_drift_is_straight_between_its_knots_and_level_beyond() -> None:
    stage = BaselineDrift(rate_counts_per_s=0.1, knots_s=(10.0, 20.0, 40.0), knot_counts=(1.0, 3.0, -1.0))
    times = torch.tensor([0.0, 10.0, 15.0, 20.0, 30.0, 40.0, 100.0], dtype=torch.float64)
    drift = stage.sequence(torch.zeros(7, 6, 10), times, FRAME)[:, 0, 0]
    knots = [1.0, 1.0, 2.0, 3.0, 1.0, -1.0, -1.0]
    assert drift.tolist() == pytest.approx([k + 0.1 * t for k, t in zip(knots, times.tolist(), strict=True)])


def test_drift_follows_the_temperature_around_its_reference() -> None:
    stage = BaselineDrift(counts_per_c=2.0, reference_c=25.0)
    warm = replace(FRAME, temperature_c=torch.tensor([25.0, 27.0, 20.0], dtype=torch.float64))
    times = torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)
    assert stage.sequence(torch.zeros(3, 6, 10), times, warm)[:, 3, 3].tolist() == [0.0, 4.0, -10.0]
    assert stage.sequence(torch.zeros(3, 6, 10), times, FRAME)[:, 3, 3].tolist() == [0.0, 0.0, 0.0]


def test_sharpness_goes_from_a_divider_to_a_cut() -> None:
    x = torch.tensor([[0.0, 75.0, 150.0, 600.0]])
    divider = once(Saturation(knee_counts=150.0, sharpness=1.0), x)
    assert divider.flatten().tolist() == pytest.approx([0.0, 50.0, 75.0, 120.0])
    middle = once(Saturation(knee_counts=150.0, sharpness=2.0), x)
    assert middle.flatten().tolist() == pytest.approx((x / (1 + (x / 150) ** 2) ** 0.5).flatten().tolist())
    cut = once(Saturation(knee_counts=150.0, sharpness=50.0), x)
    assert cut.flatten().tolist() == pytest.approx([0.0, 75.0, 150.0, 150.0], rel=0.02)


def test_a_cover_beyond_the_taxels_keeps_a_part_of_what_leaves_the_pad() -> None:
    rings = (0.5, 0.3, 0.2, 0.1, 0.0, 0.0)
    corner, middle = pressed_at(0, 0), torch.zeros(12, 20)
    middle[6, 10] = 100.0
    whole, half, none = (once(MechanicalSpreading(rings=rings, kept=kept), corner) for kept in (1, 0.5, 0))
    assert whole.sum().item() == pytest.approx(100.0, rel=1e-5)
    assert none.sum() < 0.6 * whole.sum()
    torch.testing.assert_close(half, (whole + none) / 2)
    lost = once(MechanicalSpreading(rings=rings, kept=0.0), middle)
    assert lost.sum().item() == pytest.approx(100.0, rel=1e-5)  # nothing leaves from there
    assert (lost[6, 11] / lost[6, 10]).item() == pytest.approx(0.5, rel=1e-5)


def test_a_gaussian_loses_beyond_the_taxels_what_a_cover_that_ends_there_keeps() -> None:
    corner, middle = pressed_at(0, 0), torch.zeros(12, 20)
    middle[6, 10] = 100.0
    whole, half, none = (once(MechanicalSpreading(1e-3, kept=kept), corner) for kept in (1.0, 0.5, 0.0))
    assert whole.sum().item() == pytest.approx(100.0, rel=1e-5)
    assert none.sum() < half.sum() < whole.sum()
    # Away from the rim it makes no difference, nor does it to what a taxel inside gets of one at the rim.
    inside = [once(MechanicalSpreading(1e-3, kept=kept), middle) for kept in (1.0, 0.0)]
    torch.testing.assert_close(*inside)
    assert (none[0, 1] / none[0, 0]).item() == pytest.approx((inside[0][6, 11] / inside[0][6, 10]).item())


def test_a_smoothed_reading_is_as_old_as_a_delayed_one() -> None:
    """On a ramp a one-pole filter lags by its time constant."""
    times = torch.linspace(0, 2, 201, dtype=torch.float64)
    x = times.float()[:, None, None].expand(-1, 6, 10)
    for smoothing in (0.0, 0.4, 1.0):
        y = Latency(tau_s=0.05, smoothing=smoothing).sequence(x, times, FRAME)
        assert y[-1, 0, 0].item() == pytest.approx(2.0 - 0.05, abs=1e-5)


def test_scan_skew_along_columns_and_in_a_rhythm_of_its_own() -> None:
    times = torch.linspace(0, 1, 101, dtype=torch.float64)
    x = times.float()[:, None, None].expand(-1, 6, 10)
    y = ScanSkew(skew_s=0.05, cols_s=0.02).sequence(x, times, FRAME)[80]
    late = 0.05 * torch.arange(6)[:, None] / 5 + 0.02 * torch.arange(10) / 9
    torch.testing.assert_close(y, 0.8 - late, atol=1e-5, rtol=0)
    y = ScanSkew(skew_s=0.05, rows_s=(0.0, 0.04, 0.05)).sequence(x, times, FRAME)[80, :, 0]
    expected = 0.8 - np.interp(np.arange(6) / 5, [0, 0.5, 1], [0, 0.04, 0.05])
    assert y.tolist() == pytest.approx(expected.tolist(), abs=1e-5)


def test_a_taxel_loads_itself_as_much_as_stated() -> None:
    x = pressed_at(1, 1) + pressed_at(1, 5, 50.0)
    for own in (0.0, 0.5, 1.0):
        y = once(RowSharing(conductance_per_count=1e-3, own=own), x)
        assert y[1, 1].item() == pytest.approx(100.0 / (1 + 1e-3 * (50.0 + own * 100.0)))


def test_a_share_of_the_force_follows_the_power_law() -> None:
    x = torch.full((6, 10), 0.4)  # half of the reference force, 800 N/m times 1 mm
    for share in (0.0, 0.25, 1.0):
        y = once(NonlinearStiffness(exponent=1.5, share=share), x)
        assert y[0, 0].item() == pytest.approx((1 - share) * 0.4 + share * 0.8 * 0.5**1.5)


def test_a_cover_gives_way_gradually_or_at_once_and_keeps_a_known_load() -> None:
    x = pressed_at(1, 1, 0.8) + pressed_at(3, 4, 0.2)  # as 1 mm and 0.25 mm do, with 800 N/m
    for sharpness in (1.0, 3.0):
        y = once(YieldingStiffness(yield_m=5e-4, sharpness=sharpness), x)
        for (row, col), load in (((1, 1), 0.8), ((3, 4), 0.2)):
            expected = load / (1 + (load / 0.4) ** sharpness) ** (1 / sharpness)
            assert y[row, col].item() == pytest.approx(expected)
    y, _ = YieldingStiffness(yield_m=5e-4).step(x, {}, replace(FRAME, load_conserving=True))
    assert y.sum().item() == pytest.approx(1.0)
    assert y[1, 1].item() / y[3, 4].item() == pytest.approx(4.0 / 2.0)
