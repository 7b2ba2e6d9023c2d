"""Every stage after the contact law against an analytic result or an independent computation."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from lerobot_vtrefine.tactile import PadLayout
from lerobot_vtrefine.tactile.stages.base import STAGES, Frame, Stage
from lerobot_vtrefine.tactile.stages.dividers import LaggingDroop, RowSharing, SupplyDroop
from lerobot_vtrefine.tactile.stages.host import Delay, Latency, SampleAndHold, ScanSkew
from lerobot_vtrefine.tactile.stages.hysteresis import (
    DuhemHysteresis,
    Hysteresis,
    LoadingHysteresis,
    Loop,
    PeakHysteresis,
    ProportionalHysteresis,
    RestingHysteresis,
)
from lerobot_vtrefine.tactile.stages.mechanics import (
    MechanicalSpreading,
    NonlinearStiffness,
    ViscoelasticRelaxation,
)
from lerobot_vtrefine.tactile.stages.readout import (
    BaselineDrift,
    Crosstalk,
    DeadTaxels,
    Gain,
    Idle,
    Noise,
    Quantisation,
    Saturation,
    TaxelGainSpread,
)
from lerobot_vtrefine.tactile.stages.softening import FirstLoadSoftening, PathSoftening
from lerobot_vtrefine.tactile.stages.surface import ContactOffset, PadTilt, UnevenFace

LAYOUT = PadLayout(6, 10, 0.002)
FRAME = Frame(layout=LAYOUT, stiffness_n_per_m=800.0)


def image(seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random((2, 6, 10))).float()


def once(stage: Stage, x: torch.Tensor, frame: Frame = FRAME) -> torch.Tensor:
    return stage.step(x, {}, frame)[0]


def ramp(times: torch.Tensor, values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values).float()[:, None, None].expand(len(times), 6, 10)


def test_contact_offset_delays_contact() -> None:
    assert torch.allclose(once(ContactOffset(offset_m=0.1), image()), image() - 0.1)


def test_pad_tilt_moves_taxels_as_a_rotation_does() -> None:
    tilt_x, tilt_y = 1e-4, -2e-4
    lifted = once(PadTilt(tilt_x_rad=tilt_x, tilt_y_rad=tilt_y), torch.zeros(6, 10, dtype=torch.float64))
    turned = np.cross([tilt_x, tilt_y, 0.0], LAYOUT.positions())[:, 2]
    assert np.allclose(lifted.numpy().ravel(), turned, atol=1e-12)
    hinged = PadTilt(tilt_x, tilt_y, pivot_x_m=LAYOUT.positions()[9, 0], pivot_y_m=LAYOUT.positions()[9, 1])
    moved = once(hinged, torch.zeros(6, 10, dtype=torch.float64)).numpy().ravel()
    assert np.allclose(moved, turned - turned[9], atol=1e-12)


def test_an_uneven_face_is_met_later_where_it_lies_deeper() -> None:
    lower = np.arange(60.0).reshape(6, 10) * 1e-6
    met = once(UnevenFace(tuple(map(tuple, lower.tolist()))), torch.zeros(6, 10, dtype=torch.float64))
    assert np.allclose(met.numpy(), -lower, atol=1e-12)
    assert torch.equal(once(UnevenFace(2e-5), image()), image() - 2e-5)
    with pytest.raises(ValueError, match="equally long rows"):
        UnevenFace(((1e-5,), (1e-5, 2e-5)))


def test_nonlinear_stiffness_is_a_power_law_of_depth() -> None:
    depth = image() * 1e-3
    force = once(NonlinearStiffness(exponent=1.3), 800.0 * depth)
    assert torch.allclose(force, 800.0 * 1e-3 * (depth / 1e-3) ** 1.3, rtol=1e-4)


def test_nonlinear_stiffness_keeps_a_given_load() -> None:
    frame = Frame(layout=LAYOUT, stiffness_n_per_m=800.0, load_conserving=True)
    x = image()
    y = once(NonlinearStiffness(exponent=1.5), x, frame)
    assert torch.allclose(y.sum((-1, -2)), x.sum((-1, -2)), rtol=1e-5)
    assert not torch.allclose(y, x, rtol=1e-2)


@pytest.mark.parametrize("sigma_m", [0.5e-3, 2e-3, 3e-3])
def test_spreading_is_a_mirrored_gaussian_that_keeps_sums(sigma_m: float) -> None:
    x = image()
    y = once(MechanicalSpreading(sigma_m=sigma_m), x)
    expected = gaussian_filter(
        x.numpy().astype(float), (0, sigma_m / 0.002, sigma_m / 0.002), mode="reflect", truncate=8
    )
    assert np.allclose(y.numpy(), expected, atol=2e-4)
    assert torch.allclose(y.sum((-1, -2)), x.sum((-1, -2)), rtol=1e-5)


def test_no_spreading_is_the_identity() -> None:
    assert torch.allclose(once(MechanicalSpreading(sigma_m=0.0), image()), image(), atol=1e-6)


def test_relaxation_under_a_held_load_is_exponential() -> None:
    times = torch.linspace(0, 3, 61, dtype=torch.float64)
    values = np.minimum(times.numpy() / 0.5, 1.0)
    y = ViscoelasticRelaxation(tau_s=0.7, fraction=0.3).sequence(ramp(times, values), times, FRAME)[:, 0, 0]
    t, tau = times.numpy(), 0.7
    # Low-pass of a ramp that stops at 0.5 s, in closed form.
    rising = (t - tau * (1 - np.exp(-t / tau))) / 0.5
    held = 1 + ((0.5 - tau * (1 - math.exp(-0.5 / tau))) / 0.5 - 1) * np.exp(-(t - 0.5) / tau)
    slow = np.where(t <= 0.5, rising, held)
    assert np.allclose(y.numpy(), values - 0.3 * slow, atol=1e-5)


def test_prony_branches_add_up() -> None:
    times = torch.linspace(0, 3, 31, dtype=torch.float64)
    x = ramp(times, np.sin(times.numpy()))
    both = ViscoelasticRelaxation(tau_s=(0.3, 2.0), fraction=(0.1, 0.2)).sequence(x, times, FRAME)
    one = ViscoelasticRelaxation(tau_s=0.3, fraction=0.1).sequence(x, times, FRAME)
    two = ViscoelasticRelaxation(tau_s=2.0, fraction=0.2).sequence(x, times, FRAME)
    assert torch.allclose(both, one + two - x, atol=1e-6)
    with pytest.raises(ValueError, match=r"same number"):
        ViscoelasticRelaxation(tau_s=(0.3, 2.0), fraction=0.1)


def test_hysteresis_loop_has_the_stated_width_at_any_speed() -> None:
    stage = Hysteresis(fraction=0.4, width_m=2e-4)
    for frames in (101, 401):
        depth = np.concatenate([np.linspace(0, 1e-3, frames), np.linspace(1e-3, 0, frames)[1:]])
        times = torch.arange(len(depth), dtype=torch.float64)
        y = stage.sequence(ramp(times, 800.0 * depth), times, FRAME)[:, 0, 0].numpy()
        middle = (frames - 1) // 2
        loop = y[-1 - middle] - y[middle]
        assert np.isclose(loop, 0.4 * 2e-4 * 800.0, rtol=1e-3)
        assert y[-1] == 0.0


def test_gain_and_its_spread() -> None:
    assert torch.allclose(once(Gain(counts_per_n=300.0), image()), 300 * image())
    factors = 1.0 + image()[0].numpy()
    assert torch.allclose(once(TaxelGainSpread(map=factors), image()), image() * torch.from_numpy(factors))
    deviate = TaxelGainSpread().traits(PadLayout(), 40, np.random.default_rng(0))["deviate"]
    spread = TaxelGainSpread(sigma=0.2).step(
        torch.ones(40, 12, 32), {"deviate": torch.from_numpy(deviate)}, FRAME
    )[0]
    assert np.isclose(np.log(spread.numpy()).std(), 0.2, rtol=0.02)


def test_dead_taxels_do_not_answer() -> None:
    y = once(DeadTaxels(taxels=[[1, 2]], rows=[5], cols=[0]), image() + 1)
    dead = y.numpy() == 0
    assert dead[:, 1, 2].all()
    assert dead[:, 5].all()
    assert dead[:, :, 0].all()
    assert dead[0].sum() == 1 + 10 + 5
    with pytest.raises(ValueError, match=r"\(6, 0\) is not on a 6 x 10 pad"):
        once(DeadTaxels(rows=[6]), image())
    faint = once(DeadTaxels(taxels=[[1, 2], [3, 4]], left=[0.25, 0.0]), image() + 1) / (image() + 1)
    assert torch.allclose(faint[..., [1, 3, 5], [2, 4, 5]], torch.tensor([0.25, 0.0, 1.0]))
    with pytest.raises(ValueError, match="1 numbers in left for 2 taxels"):
        DeadTaxels(taxels=[[1, 2], [3, 4]], left=[0.25])


def test_saturation_levels_off_at_the_knee() -> None:
    stage = Saturation(knee_counts=150.0)
    assert np.isclose(float(once(stage, torch.full((6, 10), 1.0))[0, 0]), 1.0, rtol=1e-4)
    assert np.isclose(float(once(stage, torch.full((6, 10), 1e4))[0, 0]), 150.0)


def test_row_sharing_is_the_divider_of_a_resistor_network() -> None:
    """Nodal analysis of one row: the driven column at V, the others at 0, the row's node pulled down."""
    conductance = np.array([0.2, 0.5, 0.0, 1.0])
    pull_down, supply = 2.0, 255.0
    nodal = [supply * g / (conductance.sum() + pull_down) for g in conductance]
    alone = torch.from_numpy(supply * conductance / pull_down).float().view(1, 1, 4)
    shared = once(RowSharing(conductance_per_count=1 / 255.0), alone)
    assert np.allclose(shared.numpy().ravel(), nodal, rtol=1e-5)


def test_what_taxels_conduct_at_rest_loads_the_row_and_is_lowered_with_it() -> None:
    """The same analysis where every taxel conducts at rest, too."""
    conductance, at_rest = np.array([0.2, 0.5, 0.0, 1.0]), np.array([0.05, 0.1, 0.02, 0.08])
    pull_down, supply = 2.0, 255.0
    rest = at_rest.sum() + pull_down
    nodal = supply * (conductance + at_rest) / (conductance.sum() + rest)
    idle = supply * at_rest / rest
    alone = torch.from_numpy(supply * conductance / rest).view(1, 1, 4)
    stage = RowSharing(conductance_per_count=1 / 255.0, idle_counts=((*idle.tolist(),),))
    assert np.allclose(once(stage, alone).numpy().ravel() + idle, nodal, rtol=1e-5)


def test_row_sharing_lowers_the_row_and_leaves_the_column() -> None:
    x = torch.zeros(6, 10)
    x[2, 3] = 100.0
    alone = float(once(RowSharing(), x)[2, 3])
    x[2, 7] = 100.0
    assert float(once(RowSharing(), x)[2, 3]) < alone
    x[2, 7], x[4, 3] = 0.0, 100.0
    assert float(once(RowSharing(), x)[2, 3]) == alone


def test_supply_droop_is_a_supply_with_resistance_that_sees_the_scans_mean_current() -> None:
    """Columns are driven in turn; the mean of their currents lowers the voltage that drives them."""
    conductance = np.random.default_rng(0).uniform(0.0, 0.01, (6, 10))
    source_ohm, voltage = 10.0, 5.0
    for _ in range(200):
        current = np.mean([voltage * conductance[:, col].sum() for col in range(10)])
        voltage = 5.0 - source_ohm * current
    stiff = torch.from_numpy(1000.0 * 5.0 * conductance)[None]
    drooping = once(SupplyDroop(droop_per_count=source_ohm / 10 / 5000.0), stiff)
    assert np.allclose(drooping[0].numpy(), 1000.0 * voltage * conductance, rtol=1e-6)


def test_supply_droop_reaches_taxels_of_other_rows_and_columns() -> None:
    x = torch.zeros(6, 10)
    x[2, 3] = 100.0
    alone = float(once(SupplyDroop(), x)[2, 3])
    x[4, 7] = 100.0
    assert float(once(SupplyDroop(), x)[2, 3]) < alone


def test_what_taxels_read_at_rest_sags_with_them() -> None:
    level = np.random.default_rng(1).uniform(10.0, 40.0, (6, 10))
    x = torch.zeros(6, 10, dtype=torch.float64)
    x[2, 3] = 100.0
    total = once(SupplyDroop(droop_per_count=1e-3, idle_counts=tuple(map(tuple, level))), x) + level
    assert np.allclose(total, (x.numpy() + level) / 1.1, rtol=1e-6)


def test_a_supply_that_lags_sags_as_a_capacitor_discharges() -> None:
    x = torch.zeros(401, 6, 10)
    x[1:, 2, 3] = 100.0
    times = torch.arange(401, dtype=torch.float64) * 1e-3
    stage = LaggingDroop(droop_per_count=1e-3, tau_s=0.05)
    found = stage.sequence(x, times, FRAME)[:, 2, 3].numpy()
    # The load rises within the first millisecond.
    seen = 100.0 * -np.expm1(-(times.numpy()[1:] - 5e-4) / 0.05)
    assert np.allclose(found[1:], 100.0 / (1.0 + 1e-3 * seen), atol=1e-3)
    by_frames = Stage.sequence(stage, x, times, FRAME)
    assert torch.allclose(by_frames, stage.sequence(x, times, FRAME), atol=1e-4)


def test_crosstalk_leaks_to_the_row_and_column_only() -> None:
    x = torch.zeros(6, 10)
    x[2, 3] = 100.0
    y = once(Crosstalk(row=0.01, col=0.02), x)
    assert float(y[2, 3]) == 100.0
    assert float(y[0, 0]) == 0.0
    assert np.isclose(float(y[2, 9]), 1.0)
    assert np.isclose(float(y[0, 3]), 2.0)


def test_idle_drift_and_quantisation() -> None:
    x = torch.zeros(2, 6, 10)
    assert (once(Idle(level_counts=20.0), x) == 20).all()
    level = np.arange(60.0).reshape(6, 10)
    assert np.allclose(once(Idle(level_counts=level), x).numpy(), level)
    times = torch.tensor([0.0, 10.0, 20.0], dtype=torch.float64)
    drifted = BaselineDrift(rate_counts_per_s=0.5).sequence(torch.zeros(3, 6, 10), times, FRAME)
    assert np.allclose(drifted[:, 0, 0].numpy(), [0, 5, 10])
    values = torch.tensor([[-3.0, 0.4, 0.6, 254.7, 300.0]])
    assert once(Quantisation(), values).tolist() == [[0, 0, 1, 255, 255]]
    assert once(Quantisation(step_counts=4.0), values).tolist() == [[0, 0, 0, 255, 255]]


def test_maps_of_another_pad_are_refused() -> None:
    assert (once(Idle(level_counts=[[7.0]]), torch.zeros(2, 6, 10)) == 7).all()
    with pytest.raises(ValueError, match="a map of 4 x 4 taxels, but the pad has 6 x 10"):
        once(Idle(level_counts=np.zeros((4, 4))), torch.zeros(2, 6, 10))


def test_noise_is_white_and_a_function_of_seed_and_frame() -> None:
    stage, x = Noise(sigma_counts=2.0), torch.zeros(3, 12, 32)
    state = {"seed": torch.tensor([1, 2, 1]), "frame": torch.tensor([0, 0, 0])}
    first, state = stage.step(x, state, FRAME)
    second, _ = stage.step(x, state, FRAME)
    assert torch.equal(first[0], first[2])
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first, second)
    frames = []
    for _ in range(200):
        y, state = stage.step(x, state, FRAME)
        frames.append(y[:2].numpy())
    samples = np.stack(frames)
    assert np.isclose(samples.std(), 2.0, rtol=0.01)
    assert abs(samples.mean()) < 0.02
    lag = np.corrcoef(samples[1:].ravel(), samples[:-1].ravel())[0, 1]
    assert abs(lag) < 0.02


def test_latency_shifts_by_tau_and_scan_skew_by_row() -> None:
    times = torch.linspace(0, 1, 101, dtype=torch.float64)
    x = ramp(times, times.numpy())
    late = Latency(tau_s=0.033).sequence(x, times, FRAME)[:, 0, 0].numpy()
    assert np.allclose(late, np.maximum(times.numpy() - 0.033, 0), atol=1e-6)
    skewed = ScanSkew(skew_s=0.05).sequence(x, times, FRAME)[60, :, 0].numpy()
    assert np.allclose(skewed, 0.6 - 0.05 * np.arange(6) / 5, atol=1e-6)


@pytest.mark.parametrize("stage", [Latency(tau_s=0.033), ScanSkew(skew_s=0.05), Latency(tau_s=0.0)])
def test_delays_are_the_same_frame_by_frame(stage: Stage) -> None:
    times = torch.arange(40, dtype=torch.float64) * 0.01
    x = torch.from_numpy(np.random.default_rng(0).random((40, 6, 10))).float()
    whole = stage.sequence(x, times, FRAME)
    stepped = Stage.sequence(stage, x, times, FRAME)
    assert torch.allclose(whole, stepped, atol=1e-5)


def test_a_delay_beyond_the_memory_is_refused() -> None:
    stage = Latency(tau_s=0.5)
    state = {key: torch.from_numpy(value) for key, value in stage.initial(LAYOUT, 1).items()}
    with pytest.raises(ValueError, match=r"latency: a delay of 0.5 s exceeds 15 frames of 0.01 s"):
        stage.step(torch.zeros(1, 6, 10), state, Frame(layout=LAYOUT, dt_s=0.01))


def test_sample_and_hold_repeats_for_its_period() -> None:
    times = torch.arange(20, dtype=torch.float64) * 0.01
    y = SampleAndHold(period_s=0.04).sequence(ramp(times, times.numpy()), times, FRAME)[:, 0, 0].numpy()
    assert np.allclose(y, np.floor(times.numpy() / 0.04 + 1e-9) * 0.04, atol=1e-6)


def test_groups_of_rows_are_held_each_from_an_instant_of_its_own() -> None:
    stage = SampleAndHold(0.13, free=True, groups=(0, 1, 0, 2, 2, 2))
    rng = np.random.default_rng(8)
    times, x = np.cumsum(rng.uniform(0.01, 0.06, 60)), rng.standard_normal((60, 6, 10))
    found = {**stage.initial(LAYOUT, 1), **stage.traits(LAYOUT, 1, rng)}
    phase = found["phase"][0, :, 0]
    assert phase[0] == phase[2] != phase[1] != phase[3] == phase[4] == phase[5]
    state = {key: torch.as_tensor(value[0]) for key, value in found.items()}
    shown, slots = x[0].copy(), np.full(6, -1.0)
    for now, image in zip(times, x, strict=True):
        for row in range(6):
            if (slot := np.floor(now / 0.13 + phase[row])) != slots[row]:
                shown[row], slots[row] = image[row], slot
        y, state = stage.step(torch.from_numpy(image), state, replace(FRAME, time_s=float(now)))
        assert np.array_equal(y.numpy(), shown)
    with pytest.raises(ValueError, match=r"sample_and_hold.groups needs a free board"):
        SampleAndHold(0.13, groups=(0, 1))


@pytest.mark.parametrize("name", sorted(STAGES))
def test_parameters_have_units_and_ranges_hold_defaults_apart(name: str) -> None:
    from dataclasses import fields

    for item in fields(STAGES[name]):
        if "range" in item.metadata:
            low, high = item.metadata["range"]
            assert low <= high
            if "minimum" in item.metadata and item.metadata["minimum"] is not None:
                assert low >= item.metadata["minimum"] or name in ("saturation",)


def test_invalid_parameters_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"kelvin_voigt.k_n must be at least 0, got -1"):
        STAGES["kelvin_voigt"](k_n=-1.0)
    with pytest.raises(ValueError, match=r"latency.tau_s must be a finite number"):
        Latency(tau_s=float("nan"))


LOADS = np.array([0.0, 0.3, 0.8, 0.5, 0.9, 0.2, 0.0, 0.0, 0.4, 0.1])
LOOPS = {
    # Band 0.4 wide: by hand from the law. Play follows 0.2 (all 0.4 where it lies behind) and is reset at 0.
    "hysteresis": (Hysteresis(0.5, 5e-4), [0, 0.1, 0.6, 0.6, 0.7, 0.4, 0, 0, 0.2, 0.2]),
    "resting": (RestingHysteresis(0.5, 5e-4), [0, 0.1, 0.6, 0.6, 0.7, 0.4, 0.2, 0.2, 0.2, 0.2]),
    "loading": (LoadingHysteresis(0.5, 5e-4), [0, 0, 0.4, 0.4, 0.5, 0.2, 0, 0, 0, 0]),
}


@pytest.mark.parametrize("name", LOOPS)
def test_play_operators_by_hand(name: str) -> None:
    stage, play = LOOPS[name]
    times = torch.arange(len(LOADS), dtype=torch.float64)
    found = stage.sequence(ramp(times, LOADS), times, FRAME)[:, 0, 0].numpy()
    assert np.allclose(found, 0.5 * LOADS + 0.5 * np.array(play), atol=1e-6)


def test_proportional_and_peak_loops_by_hand() -> None:
    times = torch.arange(len(LOADS), dtype=torch.float64)
    x = ramp(times, LOADS)
    back = np.array([0, 0, 0, 0.75, 0, 1, 0, 0, 0, 0.75])
    found = ProportionalHysteresis(0.5, 5e-4).sequence(x, times, FRAME)[:, 0, 0].numpy()
    assert np.allclose(found, LOADS * (1 + 0.5 * back), atol=1e-6)
    first = 1 - np.exp(-0.75)
    second = 1 - (1 - first * np.exp(-1.0)) * np.exp(-1.75)
    back = np.array([0, 0, 0, first, first * np.exp(-1.0), second, 0, 0, 0, first])
    found = DuhemHysteresis(0.5, 5e-4).sequence(x, times, FRAME)[:, 0, 0].numpy()
    assert np.allclose(found, LOADS * (1 + 0.5 * back), atol=1e-6)
    share = np.array([0, 1, 1, 5 / 8, 1, 2 / 9, 0, 0, 1, 1 / 4])
    found = PeakHysteresis(0.5).sequence(x, times, FRAME)[:, 0, 0].numpy()
    assert np.allclose(found, LOADS * (1 + 2 * share * (1 - share)), atol=1e-6)


WITH_MEMORY = [
    *(stage for stage, _ in LOOPS.values()),
    Hysteresis((0.3, -0.2), (2e-4, 6e-4)),
    ProportionalHysteresis(0.5, 5e-4),
    DuhemHysteresis(0.5, 5e-4),
    PeakHysteresis(-0.4),
    ViscoelasticRelaxation((0.3, 2.0), (0.3, 0.2)),
    ViscoelasticRelaxation(0.3, 0.9, pushes_only=True),
    FirstLoadSoftening(0.4, 1.5, 0.5, recovery_s=3.0),
    PathSoftening(0.4, 1e-3),
    PathSoftening(0.4, 1e-3, peak=True, width_m=3e-4),
    Latency(0.12, smoothing=0.4),
    Latency(0.1, growth=0.05),
    ScanSkew(0.05, cols_s=0.02),
    ScanSkew(0.0, rows_s=(0.0, 0.05, 0.02)),
    SampleAndHold(0.13),
]


@pytest.mark.parametrize("stage", WITH_MEMORY, ids=lambda stage: stage.name)
def test_a_recording_at_once_is_its_frames_one_by_one(stage: Stage) -> None:
    rng = np.random.default_rng(4)
    # Frames of even length: a delay's memory while simulating is of frames. All else takes any times.
    steps = np.full(60, 0.04) if isinstance(stage, Delay) else rng.uniform(0.01, 0.06, 60)
    times = torch.from_numpy(np.cumsum(steps))
    walk = np.abs(np.cumsum(rng.normal(0, 0.15, (60, 6, 10)), axis=0)) - 0.1
    x = torch.from_numpy(walk)
    state = {key: torch.as_tensor(value[0]) for key, value in stage.initial(LAYOUT, 1).items()}
    one_by_one = []
    for k in range(60):
        dt_s = float(times[k] - times[k - 1]) if k else 0.0
        y, state = stage.step(x[k], state, replace(FRAME, time_s=times[k], dt_s=dt_s))
        one_by_one.append(y)
    exact = isinstance(stage, Loop | SampleAndHold) and not isinstance(stage, DuhemHysteresis)
    rounding = 0.0 if exact else 1e-5
    assert torch.allclose(stage.sequence(x, times, FRAME), torch.stack(one_by_one), rounding, rounding)
