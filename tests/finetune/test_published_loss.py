"""The loss of ``--dppo.type=paper`` against the published formulas, written out in NumPy.

Ho et al. 2020, eq. 6 and 7 (the posterior of a denoising step, from the betas); Ren et al. 2024: Gaussian
likelihoods with a floored deviation, averaged over executed actions, a clip range that grows exponentially
along the chain, advantages discounted towards its noisy end, PPO's clipped objective.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from toy import BlindPeg, ToyActor, make_agent

from lerobot_vtrefine.finetune.chains import chain_log_probs
from lerobot_vtrefine.finetune.config import PaperDppo
from lerobot_vtrefine.finetune.dppo import TrainState, collect, policy_loss

STEPS = 100
CHUNK = (4, 2)
EXECUTED = slice(0, 3)


def betas() -> np.ndarray:
    """Nichol and Dhariwal's cosine schedule."""
    share = np.cos((np.arange(STEPS + 1) / STEPS + 0.008) / 1.008 * math.pi / 2) ** 2
    return np.clip(1 - share[1:] / share[:-1], 0, 0.999)


def log_probabilities(latents: np.ndarray, eps: np.ndarray, std_floor: float) -> np.ndarray:
    """(N, K') of chains (N, K'+1, H, D) with predicted noise (N, K', H, D): steps K'-1, ..., 0."""
    beta, found = betas(), []
    kept = np.cumprod(1 - beta)
    for place in range(eps.shape[1]):
        t = eps.shape[1] - 1 - place
        before = kept[t - 1] if t else 1.0
        x, following = latents[:, place], latents[:, place + 1]
        clean = np.clip((x - math.sqrt(1 - kept[t]) * eps[:, place]) / math.sqrt(kept[t]), -1, 1)
        of_clean = math.sqrt(before) * beta[t] / (1 - kept[t])
        of_noisy = math.sqrt(1 - beta[t]) * (1 - before) / (1 - kept[t])
        std = max(math.sqrt(beta[t] * (1 - before) / (1 - kept[t])), std_floor)
        away = (following - of_clean * clean - of_noisy * x) / std
        density = -0.5 * away**2 - math.log(std) - 0.5 * math.log(2 * math.pi)
        found.append(np.clip(density, -5, 2)[:, EXECUTED].mean((1, 2)))
    return np.stack(found, 1)


def clipped_losses(log_ratio: np.ndarray, advantages: np.ndarray, cfg: PaperDppo) -> np.ndarray:
    """(N, K') of PPO."""
    count, losses = log_ratio.shape[1], np.empty_like(log_ratio)
    for place in range(count):
        growth = (math.exp(cfg.clip_rate * place / (count - 1)) - 1) / (math.exp(cfg.clip_rate) - 1)
        clip = cfg.clip_first + (cfg.clip - cfg.clip_first) * growth
        gain = advantages * cfg.gamma_denoising ** (count - 1 - place)
        ratio = np.exp(log_ratio[:, place])
        losses[:, place] = np.maximum(-gain * ratio, -gain * np.clip(ratio, 1 - clip, 1 + clip))
    return losses


def predicted_noise(agent, latents, obs):
    """(N, K', H, D) of the tuned network at every stored latent."""
    count = agent.num_tuned
    times = torch.arange(count - 1, -1, -1)
    cond = agent.actor.encode(obs)
    eps = [
        agent.actor.denoiser(latents[:, place], times[place].expand(len(latents)), cond)
        for place in range(count)
    ]
    return torch.stack(eps, 1).detach().numpy()


def test_the_papers_loss_is_the_published_one():
    # An unequal clip range at both ends, so that its growth along the chain shows.
    cfg = replace(PaperDppo(), num_envs=12, critic_width=8, clip=0.004, clip_first=0.001)
    torch.manual_seed(0)
    env = BlindPeg(cfg.num_envs, feel=True)
    agent = replace(make_agent(ToyActor(3, *CHUNK, width=32), cfg, CHUNK, STEPS), executed=EXECUTED)
    state = TrainState.create(agent, cfg, env.privileged_dim, seed=0)
    with torch.no_grad():
        for weight in agent.actor.denoiser.parameters():
            weight.mul_(3)  # so that some predicted clean actions are clamped
    rollout = collect(env, agent, cfg, state.generator, range(cfg.num_envs))
    agent.actor.double()
    latents, obs = rollout.latents.double(), {key: value.double() for key, value in rollout.obs.items()}
    sampled, expected = [], []
    for _ in range(2):
        log_probs, _, _ = chain_log_probs(agent, latents, agent.actor.encode(obs), cfg)
        sampled.append(log_probs.detach().numpy())
        eps = predicted_noise(agent, latents, obs)
        expected.append(log_probabilities(latents.numpy(), eps, cfg.min_log_prob_std))
        with torch.no_grad():
            for weight in agent.actor.denoiser.parameters():
                weight.add_(0.02 * torch.randn_like(weight))
    np.testing.assert_allclose(sampled, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rollout.log_probs, expected[0], rtol=0, atol=1e-5)
    advantages = np.random.default_rng(0).normal(size=len(latents))
    log_ratio = expected[1] - expected[0]
    losses = policy_loss(torch.tensor(log_ratio), torch.tensor(advantages), cfg).numpy()
    np.testing.assert_allclose(losses, clipped_losses(log_ratio, advantages, cfg), rtol=0, atol=1e-12)
    moved = np.abs(np.exp(log_ratio) - 1)
    assert (moved > cfg.clip).mean() > 0.1, "the clip range must bind in some rows ..."
    assert (moved < cfg.clip_first).mean() > 0.1, "... and not in all"
