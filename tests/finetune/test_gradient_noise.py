"""The share of signal in a gradient, against noise of known size."""

import gradient_noise as script
import numpy as np
import pytest
import torch


@pytest.mark.parametrize("noise", [0.3, 1.0, 3.0])
def test_cosines_are_those_of_signal_and_noise(noise):
    """Groups are a unit vector and white noise of length ``noise``: E|mean of n|^2 = 1 + noise^2 / n."""
    generator = torch.Generator().manual_seed(0)
    size = 200_000
    truth = torch.randn(size, generator=generator)
    truth /= truth.norm()
    groups = truth + noise * size**-0.5 * torch.randn(script.GROUPS, size, generator=generator)
    half, _ = script.halves_cosine(groups)
    assert half == pytest.approx(1 / (1 + noise**2 / (script.GROUPS / 2)), abs=0.02)
    true_cosine = torch.cosine_similarity(groups.mean(0), truth, dim=0).item()
    assert script.whole_cosine(half) == pytest.approx(true_cosine, abs=0.02)


def test_noise_alone_points_nowhere():
    groups = torch.randn(script.GROUPS, 100_000, generator=torch.Generator().manual_seed(1))
    half, spread = script.halves_cosine(groups)
    assert abs(half) < 0.02
    assert np.isfinite(spread)
    assert script.whole_cosine(-0.1) == 0.0
