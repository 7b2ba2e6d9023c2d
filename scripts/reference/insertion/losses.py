"""The losses of both implementations, term by term, on chains that were sampled here."""

import argparse
import dataclasses
from typing import Any

import torch
from torch import Tensor, nn

from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.chains import chain_log_probs
from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.pipeline import load_practice
from lerobot_vtrefine.finetune.protocols import Agent
from lerobot_vtrefine.finetune.seeds import TRAINING_SEEDS
from reference.checkout import Reference
from reference.insertion.theirs import model_to_tune, moments, state_of


@dataclasses.dataclass(frozen=True)
class Batch:
    """Decisions of one rollout, in double precision, so that formulas differ and not roundings."""

    agent: Agent
    latents: Tensor  # (N, K'+1, H, D)
    cond: Tensor  # (N, C)
    state: Tensor  # (N, 1, C + P) as the reference sees it
    advantages: Tensor  # (N,)
    returns: Tensor  # (N,)
    privileged_dim: int

    @classmethod
    def collect(cls, args: argparse.Namespace, cfg: DppoConfig) -> "Batch":
        """A round of episodes."""
        practice = load_practice(args.policy, args.task, cfg, args.device, args.backend)
        agent, env = practice.agent, practice.env
        state = dppo.TrainState.create(agent, cfg, env.privileged_dim, args.seed)
        first = TRAINING_SEEDS + args.seed
        rollout = dppo.collect(env, agent, cfg, state.generator, range(first, first + args.worlds))
        state.critic.update_moments(rollout.privileged[:-1][rollout.active])
        advantages, returns = dppo.decision_advantages(rollout, state, cfg)
        agent.actor.denoiser.double()
        cond = rollout.obs["cond"].double()
        seen = rollout.privileged[rollout.step, rollout.env].double()
        return cls(
            agent,
            rollout.latents.double(),
            cond,
            state_of(cond, seen, *(value.double() for value in moments(rollout))),
            advantages.double(),
            returns.double(),
            env.privileged_dim,
        )

    def log_probs(self, cfg: DppoConfig) -> Tensor:
        """(N, K') by this package."""
        return chain_log_probs(self.agent, self.latents, self.cond, cfg)[0]

    def sliced(self, log_probs: Tensor) -> Tensor:
        """The reference's (N K', H, D), as its loss averages them: (N, K')."""
        mean = log_probs.clamp(-5, 2)[:, self.agent.executed].mean(dim=(1, 2))
        return mean.view(len(self.latents), -1)

    def reference_loss(self, model: Any, old: Tensor) -> tuple[Any, ...]:
        """What the reference's loss returns for all rows; ``old`` (N K', H, D) when sampled."""
        batch, steps = len(self.latents), self.agent.num_tuned
        ids = torch.arange(batch, device=old.device).repeat_interleave(steps)
        positions = torch.arange(steps, device=old.device).repeat(batch)
        return model.loss(
            {"state": self.state[ids]},
            self.latents[ids, positions],
            self.latents[ids, positions + 1],
            positions,
            self.returns[ids],
            self.returns[ids],  # old values: unused where they are not clipped
            self.advantages[ids],
            old.view(batch, steps, *old.shape[1:])[ids, positions],
            reward_horizon=self.agent.executed.stop,
        )


def compare(
    args: argparse.Namespace, reference: Reference, cfg: DppoConfig, changes: dict[str, Any]
) -> dict[str, dict[str, float]]:
    """Both losses of one rollout, after the tuned network has moved away from the sampler's."""
    batch = Batch.collect(args, cfg)
    changes |= {
        "gamma_denoising": cfg.gamma_denoising,
        "clip_ploss_coef": cfg.clip,
        "clip_ploss_coef_base": cfg.clip_first,
        "clip_ploss_coef_rate": cfg.clip_rate,
        "min_sampling_denoising_std": cfg.min_sampling_std,
        "norm_adv": False,
    }
    with reference.double_schedule():
        model = model_to_tune(
            reference, batch.agent, batch.privileged_dim, batch.cond.shape[1], **changes
        ).double()
    weights = [list(net.parameters()) for net in (batch.agent.actor.denoiser, model.actor_ft)]
    with torch.no_grad():
        old_theirs, old = model.get_logprobs({"state": batch.state}, batch.latents), batch.log_probs(cfg)
        move(weights, args.move, args.seed)
        now_theirs = model.get_logprobs({"state": batch.state}, batch.latents)
        values = model.critic({"state": batch.state}).view(-1)
    now = batch.log_probs(cfg)
    log_ratio = now - old
    loss = dppo.policy_loss(log_ratio, batch.advantages, cfg).mean()
    theirs = batch.reference_loss(model, old_theirs)
    gradients = [
        torch.cat([part.flatten() for part in torch.autograd.grad(value, own)])
        for value, own in zip((loss, theirs[0]), weights, strict=True)
    ]
    clipped = log_ratio.expm1().abs() > dppo.clip_ranges(log_ratio, cfg)
    pairs = {
        "log-probability when sampled": (old, batch.sliced(old_theirs)),
        "log-probability now": (now, batch.sliced(now_theirs)),
        "policy loss": (loss, theirs[0]),
        "gradient of the policy loss": gradients,
        "value loss": (0.5 * (values - batch.returns).square().mean(), theirs[2]),
        "clip fraction": (clipped.double().mean(), loss.new_tensor(theirs[3])),
        "approx_kl": ((log_ratio.expm1() - log_ratio).mean(), loss.new_tensor(theirs[4])),
    }
    return {
        name: {
            "largest difference": float((one.detach() - two.detach()).abs().max()),
            "largest value": float(one.detach().abs().max()),
        }
        for name, (one, two) in pairs.items()
    }


def move(weights: list[list[nn.Parameter]], share: float, seed: int) -> None:
    """Add the same noise to both networks, whose weights are the same: ``share`` of their mean size."""
    generator = torch.Generator(weights[0][0].device).manual_seed(seed)
    for one, two in zip(*weights, strict=True):
        noise = torch.randn(one.shape, generator=generator, device=one.device, dtype=one.dtype)
        one += share * one.abs().mean() * noise
        two.copy_(one)
