"""Noise of policies is a stream of its own."""

import pytest
import torch

from lerobot_vtrefine.finetune.noise import forked_rng, policy_noise

CPU = torch.device("cpu")


@pytest.mark.parametrize("seed", [0, 7, 878_000_000])
def test_a_policy_draws_other_noise_than_sensors_with_the_same_seed(seed: int) -> None:
    """Both had the same numbers: a latent was a depth error."""
    torch.manual_seed(seed)
    sensors = torch.randn(64, 1024)
    policy = torch.randn(64, 1024, generator=policy_noise(CPU, seed))
    assert torch.corrcoef(torch.stack([sensors.flatten(), policy.flatten()]))[0, 1].abs() < 0.02


def test_noise_of_ranks_and_neighbouring_seeds_differs_and_comes_again() -> None:
    drawn = [
        torch.randn(1000, generator=policy_noise(CPU, seed, rank)) for seed in range(3) for rank in range(3)
    ]
    assert torch.corrcoef(torch.stack(drawn)).fill_diagonal_(0).abs().max() < 0.2
    assert torch.equal(drawn[4], torch.randn(1000, generator=policy_noise(CPU, 1, 1)))


def test_global_generators_are_put_back() -> None:
    torch.manual_seed(3)
    wanted = torch.rand(3)
    torch.manual_seed(3)
    with forked_rng(CPU):
        torch.manual_seed(4)
    assert torch.equal(torch.rand(3), wanted)
