"""The trust region in nats per decision, and exploration noise that is smooth in time."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_dppo import problem, rollout_of, small_config
from torch.distributions import MultivariateNormal, kl_divergence

from lerobot_vtrefine.finetune.chains import chain_log_probs, decision_kl
from lerobot_vtrefine.finetune.config import PaperDppo, SmallDppo
from lerobot_vtrefine.finetune.dppo import train, update
from lerobot_vtrefine.finetune.trust_region import TrustRegion
from lerobot_vtrefine.policies.vt_dp3.diffusion import correlated_noise, slice_log_prob, whiten

RHO = 0.8
TRUSTED = {"kl_per_decision": 0.5, "kl_per_decision_final": 0.1, "clip": 0.5, "clip_first": 0.5}


def covariance(horizon: int, std: float) -> torch.Tensor:
    """Covariance over time of an AR(1) process: std^2 rho^|i - j|."""
    lag = (torch.arange(horizon)[:, None] - torch.arange(horizon)).abs()
    return std**2 * RHO ** lag.double()


def test_noise_has_the_stated_covariance_and_is_made_white_again():
    white = torch.randn(200_000, 6, 1, generator=torch.Generator().manual_seed(0))
    noise = correlated_noise(white, RHO)
    measured = np.cov(noise.squeeze(-1).numpy().T)
    np.testing.assert_allclose(measured, covariance(6, 1.0).numpy(), atol=0.01)
    torch.testing.assert_close(whiten(noise, RHO), white, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(whiten(noise[:, :3], RHO), white[:, :3], atol=1e-5, rtol=1e-5)
    assert correlated_noise(white, 0.0) is white


def test_log_ratio_is_that_of_a_correlated_gaussian():
    """Between two means, against torch's multivariate normal over the executed steps."""
    generator = torch.Generator().manual_seed(1)
    latent, one, other = 0.02 * torch.randn(3, 4, 8, 2, generator=generator, dtype=torch.float64)
    executed, std = slice(0, 5), torch.full((4, 1, 1), 0.06, dtype=torch.float64)
    ours = [slice_log_prob(latent, mean, std, executed, RHO) for mean in (one, other)]
    expected = []
    for mean in (one, other):
        columns = mean[:, executed].transpose(1, 2)
        density = MultivariateNormal(columns, covariance(5, 0.06))
        expected.append(density.log_prob(latent[:, executed].transpose(1, 2)).sum(1) / 10)
    torch.testing.assert_close(ours[0] - ours[1], expected[0] - expected[1])


def test_divergence_of_a_decision_is_that_of_correlated_gaussians():
    generator = torch.Generator().manual_seed(2)
    old, new = 0.05 * torch.randn(2, 3, 4, 8, 2, generator=generator, dtype=torch.float64)
    std = torch.tensor([0.06, 0.08, 0.1, 0.06], dtype=torch.float64).view(1, 4, 1, 1).expand(3, 4, 1, 1)
    expected = torch.zeros(3, dtype=torch.float64)
    for step in range(4):
        spread = covariance(5, std[0, step].item())
        a, b = (MultivariateNormal(m[:, step, :5].transpose(1, 2), spread) for m in (new, old))
        expected += kl_divergence(a, b).sum(1)
    torch.testing.assert_close(decision_kl(old, new, std, slice(0, 5), RHO), expected)


def test_stored_probabilities_and_means_are_those_of_the_update_with_smooth_noise():
    cfg = small_config(noise_correlation=RHO)
    env, agent, state = problem(cfg)
    rollout = rollout_of(cfg, env, agent, state)
    log_probs, means, _ = chain_log_probs(agent, rollout.latents, agent.actor.encode(rollout.obs), cfg)
    torch.testing.assert_close(log_probs, rollout.log_probs, atol=1e-5, rtol=0)
    torch.testing.assert_close(means, rollout.means, atol=1e-5, rtol=0)


def test_target_falls_geometrically_and_the_rate_follows_it_within_bounds():
    cfg = SmallDppo(iterations=11, kl_per_decision=16.0, kl_per_decision_final=1.0, actor_lr=1e-4)
    region = TrustRegion(cfg)
    assert [region.target(i) for i in (0, 5, 10, 20)] == pytest.approx([16.0, 4.0, 1.0, 1.0])
    region.adapt([3.0, 12.8], stopped=False, iteration=0)  # divergence grows with the square of the rate
    assert region.actor_lr(1) == pytest.approx(1e-4 * math.sqrt(16 / 12.8))
    for reached, factor in ((1e-9, 1.5), (1e9, 0.5)):
        before = region.actor_lr(0)
        region.adapt([reached], stopped=False, iteration=0)
        assert region.actor_lr(0) == pytest.approx(factor * before)
    assert region.left(32.1, 0)
    assert not region.left(31.9, 0)


def test_the_rate_does_not_wind_up_where_no_rate_reaches_the_target():
    region = TrustRegion(SmallDppo(actor_lr=1e-4, actor_lr_max=3e-4))
    rates = []
    for iteration in range(9):
        region.adapt([1e-3], stopped=False, iteration=iteration)
        rates.append(region.actor_lr(iteration))
    assert rates[:2] == pytest.approx([1.5e-4, 2.25e-4])
    assert rates[2:] == pytest.approx([3e-4] * 7)
    region.adapt([1e3], stopped=False, iteration=9)
    assert region.actor_lr(10) == pytest.approx(1.5e-4)  # and comes down at once where a step went too far
    faster = TrustRegion(SmallDppo(actor_lr=1e-3, actor_lr_max=3e-4))
    faster.adapt([1e-3], stopped=False, iteration=0)
    assert faster.actor_lr(1) == pytest.approx(1e-3)  # where it was told to begin


def test_a_lower_limit_of_the_rate_holds_when_a_run_is_resumed():
    cfg = replace(SmallDppo(), actor_lr=1e-4, actor_lr_max=2e-4)
    before = TrustRegion(cfg)
    before.rate = 2e-4
    same, slower = (TrustRegion(changed) for changed in (cfg, replace(cfg, actor_lr=1e-5, actor_lr_max=1e-5)))
    for region in (same, slower):
        region.load_state_dict(before.state_dict())
    assert (same.actor_lr(5), slower.actor_lr(5)) == (2e-4, 1e-5)
    assert slower.slower == "--dppo.actor_lr and --dppo.actor_lr_max"
    assert TrustRegion(PaperDppo()).slower == "--dppo.actor_lr"


def test_without_a_trust_region_the_schedule_stands():
    cfg = PaperDppo()
    region = TrustRegion(cfg)
    region.adapt([1e9], stopped=True, iteration=3)
    assert region.actor_lr(7) == cfg.actor_lr_at(7)
    assert not region.left(1e9, 0)


@pytest.mark.parametrize("rate", [3e-4, 3e-2])
def test_training_finds_the_learning_rate(rate):
    """From a rate ten times too low, and as much too high, the last iterations move by about the target."""
    cfg = small_config(iterations=22, num_envs=24, minibatches=2, critic_warmup=1, actor_lr=rate, **TRUSTED)
    env, agent, state = problem(cfg)
    moved = []
    train(env, agent, state, cfg, seed=0, after_iteration=lambda _, m: moved.append(m["decision_kl"]))
    shares = [kl / state.trust_region.target(i) for i, kl in enumerate(moved)]  # means over an iteration
    assert all(0.1 < share < 1.0 for share in shares[-6:])
    assert 1e-3 < state.trust_region.rate < 1e-2


def test_an_iteration_ends_where_it_leaves_the_region():
    cfg = small_config(minibatches=3, epochs=5, critic_warmup=0, actor_lr=1e-2, **TRUSTED)
    env, agent, state = problem(cfg)
    metrics = update(rollout_of(cfg, env, agent, state), agent, state, cfg)
    assert metrics["stopped_early"] == 1.0
    assert metrics["updates"] < 15
    assert state.trust_region.rate < cfg.actor_lr
    free = replace(cfg, kl_per_decision=0.0, kl_per_decision_final=0.0)
    env, agent, state = problem(free)
    assert update(rollout_of(free, env, agent, state), agent, state, free)["updates"] == 15


@pytest.mark.parametrize(
    "wrong",
    [
        {"noise_correlation": 1.0},
        {"noise_correlation": -0.1},
        {"kl_per_decision": 1.0},
        {"kl_per_decision_final": 1.0},
        {"kl_per_decision": -1.0, "kl_per_decision_final": 1.0},
        {"minibatches": -1},
        {"actor_lr_max": -1e-4},
    ],
)
def test_settings_out_of_range_are_named(wrong):
    with pytest.raises(ValueError, match=f"--dppo.{next(iter(wrong))}"):
        PaperDppo(**wrong)
