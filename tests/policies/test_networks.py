"""Point encoder and denoisers: exact gradients, invariances, shapes."""

import copy

import pytest
import torch
from torch import nn

from lerobot_vtrefine.datasets.features import CLOUD_KEY, GRIDS_KEY, STATE_KEY
from lerobot_vtrefine.policies.vt_dp3.denoisers import MLPDenoiser, UNetDenoiser
from lerobot_vtrefine.policies.vt_dp3.ema import Ema
from lerobot_vtrefine.policies.vt_dp3.observation_encoder import ObservationEncoder
from lerobot_vtrefine.policies.vt_dp3.pad_encoder import PadEncoder
from lerobot_vtrefine.policies.vt_dp3.point_encoder import PointEncoder


def encoder() -> PointEncoder:
    """A small encoder with a fixed seed."""
    torch.manual_seed(0)
    return PointEncoder((8, 16, 24), 6, center_m=(0.1, 0.0, 0.2), scale_m=0.1)


def test_gradients_through_the_winners_are_those_of_the_plain_network() -> None:
    points, cloud = encoder(), torch.randn(4, 50, 5)
    target = torch.randn(4, 6)
    fast = (points(cloud) - target).square().sum()
    fast_gradients = torch.autograd.grad(fast, list(points.parameters()))
    scaled = (cloud - points.offset) * points.inverse_scale
    plain = (points.project(points.last(points.hidden(scaled)).amax(dim=1)) - target).square().sum()
    plain_gradients = torch.autograd.grad(plain, list(points.parameters()))
    assert torch.allclose(fast, plain, rtol=1e-5)
    for one, other in zip(fast_gradients, plain_gradients, strict=True):
        assert torch.allclose(one, other, rtol=1e-4, atol=1e-5)
    with torch.no_grad():
        assert torch.allclose(points(cloud), points.project(points.last(points.hidden(scaled)).amax(1)))


def test_encoder_ignores_the_order_and_repetition_of_points() -> None:
    points, cloud = encoder().eval(), torch.randn(2, 30, 5)
    with torch.no_grad():
        feature = points(cloud)
        assert torch.allclose(feature, points(cloud[:, torch.randperm(30)]), atol=1e-6)
        assert torch.allclose(feature, points(torch.cat([cloud, cloud[:, :7]], dim=1)), atol=1e-6)


def test_one_metric_scale_for_all_axes() -> None:
    points = encoder()
    assert points.inverse_scale.tolist() == pytest.approx([10, 10, 10, 1, 1])
    assert points.offset.tolist() == pytest.approx([0.1, 0.0, 0.2, 0, 0])


def test_pads_share_a_network_but_for_an_offset_of_their_own() -> None:
    torch.manual_seed(0)
    pads, grids = PadEncoder(2, (12, 32), 8, 5), torch.rand(1, 1, 12, 32).expand(1, 2, -1, -1)
    with torch.no_grad():
        pads.offset.copy_(torch.randn(2, 8))
        hidden = pads.shared(grids[0].unsqueeze(1)) + pads.offset
        assert torch.allclose(pads(grids), pads.join(hidden.flatten()[None]), atol=1e-6)


def test_condition_keeps_frames_apart() -> None:
    encode = ObservationEncoder(encoder(), PadEncoder(4, (12, 32), 8, 5), state_dim=3, n_obs_steps=2)
    batch = {CLOUD_KEY: torch.randn(2, 2, 20, 5), GRIDS_KEY: torch.rand(2, 2, 4, 12, 32)}
    batch[STATE_KEY] = torch.randn(2, 2, 3)
    assert set(encode.keys) == set(batch)
    cond = encode(batch)
    assert cond.shape == (2, encode.cond_dim) == (2, 2 * (6 + 5 + 64))
    swapped = encode({key: value.flip(1) for key, value in batch.items()})
    assert torch.allclose(cond.view(2, 2, -1).flip(1), swapped.view(2, 2, -1), atol=1e-6)


@pytest.mark.parametrize(
    "denoiser",
    [UNetDenoiser(5, 12, (16, 32, 64), 5, 16), MLPDenoiser(5, 16, 12, 32, 2, 16)],
    ids=["unet", "mlp"],
)
def test_denoisers_depend_on_all_inputs(denoiser: nn.Module) -> None:
    x, t, cond = torch.randn(3, 16, 5), torch.tensor([0, 50, 99]), torch.randn(3, 12)
    with torch.no_grad():
        eps = denoiser(x, t, cond)
        assert eps.shape == x.shape
        for other in (denoiser(x + 1, t, cond), denoiser(x, t + 1, cond), denoiser(x, t, cond + 1)):
            assert (other - eps).abs().flatten(1).amax(1).min() > 1e-4
        assert torch.allclose(denoiser(x[1:2], t[1:2], cond[1:2]), eps[1:2], atol=1e-5)


@pytest.mark.parametrize(
    "denoiser",
    [UNetDenoiser(5, 12, (16, 32), 5, 16), MLPDenoiser(5, 16, 12, 32, 2, 16)],
    ids=["unet", "mlp"],
)
@pytest.mark.parametrize("adapted", [False, True], ids=["plain", "adapted"])
def test_neighbours_may_share_a_condition(denoiser: nn.Module, adapted: bool) -> None:
    denoiser = copy.deepcopy(denoiser)
    if adapted:  # as adapters do, a layer in place of the Linear, which adds to what that gives
        for film in [part.film for part in denoiser.modules() if hasattr(part, "film")]:
            film[1] = Adapted(film[1])
    x, t, cond = torch.randn(6, 16, 5), torch.randint(100, (6,)), torch.randn(2, 12)
    once, each = cond.clone().requires_grad_(), cond.clone().requires_grad_()
    shared, whole = denoiser(x, t, once), denoiser(x, t, each.repeat_interleave(3, dim=0))
    torch.testing.assert_close(shared, whole, atol=1e-5, rtol=1e-5)
    for result in (shared, whole):
        result.square().sum().backward()
    torch.testing.assert_close(once.grad, each.grad, atol=1e-4, rtol=1e-4)


class Adapted(nn.Module):
    """A Linear and a matrix of low rank beside it."""

    def __init__(self, linear: nn.Linear) -> None:
        super().__init__()
        self.linear = linear
        self.low_rank = nn.Sequential(nn.Linear(linear.in_features, 1), nn.Linear(1, linear.out_features))

    @property
    def weight(self) -> torch.Tensor:
        return self.linear.weight

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.linear(x) + self.low_rank(x)


def test_unet_of_the_paper_has_the_size_that_was_counted() -> None:
    with torch.device("meta"):
        unet = UNetDenoiser(14, 256, (512, 1024, 2048), 5, 128)
    millions = sum(parameter.numel() for parameter in unet.parameters()) / 1e6
    assert millions == pytest.approx(255.1, abs=0.5)  # DPPO's code with a single-Linear FiLM


def test_average_follows_the_power_schedule() -> None:
    average, trained = nn.Linear(1, 1, bias=False), nn.Linear(1, 1, bias=False)
    ema = Ema(power=0.75, max_decay=0.9)
    expected = 0.0
    for step in range(40):
        trained.weight.data.fill_(float(step))
        decay = min(0.9, 1 - (1 + step) ** -0.75)
        expected = decay * expected + (1 - decay) * step
        ema.update(average, trained)
        assert average.weight.item() == pytest.approx(expected, rel=1e-5)
    assert ema.decay == 0.9
