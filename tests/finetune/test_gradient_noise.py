"""The share of signal in a gradient, against noise of known size."""

import math

import gradient_noise as script
import numpy as np
import pytest
import torch
from test_dppo import problem, rollout_of, small_config

from lerobot_vtrefine.policies.vt_dp3.diffusion import slice_log_prob, whiten


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


def test_advantages_that_are_all_alike_move_a_policy_by_the_ratios_bias_alone():
    """The ratio averages over n elements, each shifted by s deviations: its mean over the old policy
    is exp(-(1 - 1/n) s^2 / 2), and exp(s^2 / (2 n)) once it is centred.
    """
    count, elements, std = 400_000, 8, torch.tensor(0.1)
    latent = std * torch.randn(count, elements, 1, generator=torch.Generator().manual_seed(2))
    old, moved = torch.zeros(elements, 1), torch.full((elements, 1), 0.05, requires_grad=True)
    probs = [slice_log_prob(latent, mean[None], std, slice(0, elements), 0.0) for mean in (moved, old)]
    half_square = 0.5 * whiten(((moved - old) / std)[None], 0.0).square().mean()
    published, centred = (
        torch.autograd.grad((probs[0] - probs[1] + extra).exp().mean(), moved, retain_graph=True)[0]
        for extra in (0.0, half_square)
    )
    slope, square = 0.05 / 0.1**2 / elements, 0.5**2  # of s^2 / 2 to one element's mean; s^2
    left = 1 / elements
    assert published.mean().item() == pytest.approx(
        -(1 - left) * slope * math.exp(-(1 - left) * square / 2), rel=0.02
    )
    assert centred.mean().item() == pytest.approx(left * slope * math.exp(left * square / 2), rel=0.1)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_the_part_that_the_ratio_adds_is_the_slope_of_the_way_gone(correlation):
    cfg = small_config(noise_correlation=correlation, gamma_denoising=1.0, clip=10.0, clip_first=10.0)
    env, agent, state = problem(cfg)
    rollout = rollout_of(cfg, env, agent, state)
    advantages = torch.ones(len(rollout.latents))
    _, bias = script.moved_gradients(rollout, advantages, agent, cfg)
    assert bias.norm().item() < 1e-6  # nothing has moved
    with torch.no_grad():
        for weight in agent.trained_parameters():
            weight += 1e-3 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(3))
    _, bias = script.moved_gradients(rollout, advantages, agent, cfg)
    _, mean, std = script.chain_log_probs(agent, rollout.latents, agent.actor.encode(rollout.obs), cfg)
    way = whiten(((mean - rollout.means) / std)[:, :, agent.executed], correlation).square()
    slope = torch.autograd.grad(0.5 * way.mean(dim=(2, 3)).sum() / len(mean), agent.trained_parameters())
    expected = torch.cat([part.flatten() for part in slope])
    assert torch.cosine_similarity(bias, -expected, dim=0).abs() > 0.99
    assert bias.norm().item() == pytest.approx(expected.norm().item(), rel=0.1)
