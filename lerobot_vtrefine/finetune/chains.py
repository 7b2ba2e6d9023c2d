"""Densities of stored denoising chains: log-probabilities, divergences, the frozen network's opinion.

Shapes: B or N decisions, K' tuned steps, H horizon, D action dimension, C condition.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.protocols import Actor, Agent, Observation, select
from lerobot_vtrefine.policies.vt_dp3.diffusion import (
    Chain,
    PredictNoise,
    denoise_prefix,
    predictor,
    sample_chain,
    slice_log_prob,
    whiten,
)


def explore(
    agent: Agent, predict_noise: PredictNoise, latent: Tensor, cfg: DppoConfig, generator: torch.Generator
) -> Chain:
    """Sample the tuned steps from ``latent`` (B, H, D) with the exploration noise of ``cfg``."""
    return sample_chain(
        agent.process,
        predict_noise,
        latent,
        num_tuned=agent.num_tuned,
        executed=agent.executed,
        eta=cfg.eta,
        min_sampling_std=cfg.min_sampling_std,
        min_log_prob_std=cfg.min_log_prob_std,
        correlation=cfg.noise_correlation,
        generator=generator,
    )


@dataclass
class Regulariser:
    """What the frozen base network would do in the visited decisions, for the optional KL and BC terms."""

    means: Tensor | None = None  # (N, K', H, D) base means at the stored latents
    latents: Tensor | None = None  # (N, K'+1, H, D) chains sampled from the base

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        obs: Observation,
        latents: Tensor,
        agent: Agent,
        cfg: DppoConfig,
        generator: torch.Generator,
    ) -> "Regulariser":
        """Computed once per iteration, and only what a non-zero coefficient needs."""
        if not (cfg.kl_coef or cfg.bc_coef):
            return cls()
        means, chains = [], []
        for ids in torch.arange(len(latents)).split(cfg.minibatch_decisions):
            cond = agent.kept_condition(agent.base, select(obs, ids))
            if cfg.kl_coef:
                means.append(_reverse_steps(agent, agent.base, latents[ids], cond, cfg.eta)[0])
            if cfg.bc_coef:
                noise = torch.randn((len(ids), *agent.action_shape), generator=generator, device=cond.device)
                base = predictor(agent.base.denoiser, cond)
                start = denoise_prefix(agent.process, base, noise, agent.num_tuned)
                chains.append(explore(agent, base, start, cfg, generator).latents)
        return cls(torch.cat(means) if means else None, torch.cat(chains) if chains else None)


def _reverse_steps(
    agent: Agent, network: Actor, latents: Tensor, cond: Tensor, eta: float
) -> tuple[Tensor, Tensor]:
    """Means (B, K', H, D) and stds (B, K', 1, 1) of all tuned steps of B decisions, in one network call."""
    batch, steps = latents.shape[0], agent.num_tuned
    positions = torch.arange(
        agent.process.num_steps - steps, agent.process.num_steps, device=latents.device
    ).repeat(batch)
    rows = latents[:, :-1].flatten(0, 1)
    eps = network.denoiser(rows, agent.process.times(positions), cond)
    mean, std = agent.process.posterior(rows, eps, positions, eta)
    return mean.unflatten(0, (batch, steps)), std.unflatten(0, (batch, steps))


def chain_log_probs(
    agent: Agent, latents: Tensor, cond: Tensor, cfg: DppoConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Log-probabilities (B, K') of stored chains under the current actor, with means and floored stds."""
    mean, std = _reverse_steps(agent, agent.actor, latents, cond, cfg.eta)
    std = std.clamp(min=cfg.min_log_prob_std)
    rows = slice_log_prob(
        latents[:, 1:].flatten(0, 1),
        mean.flatten(0, 1),
        std.flatten(0, 1),
        agent.executed,
        cfg.noise_correlation,
    )
    return rows.view(latents.shape[0], agent.num_tuned), mean, std


@torch.no_grad()
def decision_kl(old_mean: Tensor, mean: Tensor, std: Tensor, executed: slice, correlation: float) -> Tensor:
    """KL divergence (B,) [nats] of whole decisions between two policies that share their noise.

    old_mean, mean (B, K', H, D); std broadcastable to them. Exact for Gaussian steps of these deviations: the
    sum over tuned steps and executed action elements of half the squared shift of the mean in them. DPPO's
    are those of its log-probabilities, not below ``min_log_prob_std``. Where actions are drawn with less
    noise (``min_sampling_std``), the policies that act are further apart, by up to the ratio's square.
    """
    shift = whiten(((mean - old_mean) / std)[:, :, executed], correlation)
    return 0.5 * shift.square().sum(dim=(1, 2, 3))
