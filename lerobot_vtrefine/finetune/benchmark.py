"""Cost of the DPPO update against a plain loop; rows for ``vtrefine-bench``.

The plain loop is the common way to write the update: rows are (decision, denoising step) pairs in random
order, and each row encodes its observation again and asks the critic again. Both do the same optimiser
steps on the same number of rows.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from lerobot_vtrefine.datasets.features import CLOUD_KEY, STATE_KEY
from lerobot_vtrefine.finetune.agents import make_agent
from lerobot_vtrefine.finetune.benchmark_busy import random_policy
from lerobot_vtrefine.finetune.chains import chain_log_probs
from lerobot_vtrefine.finetune.config import SmallDppo
from lerobot_vtrefine.finetune.dppo import (
    Rollout,
    TrainState,
    decision_advantages,
    policy_loss,
    update,
)
from lerobot_vtrefine.finetune.protocols import Agent, select
from lerobot_vtrefine.observation import num_points
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.diffusion import slice_log_prob

DECISIONS = 64
PRIVILEGED = 60
ROUNDS = 3

Row = tuple[str, float, str]


def run() -> list[Row]:
    """(what, ratio, explanation) with the encoder trained and with it frozen; policy preset ``small``."""
    return [_row("trained"), _row("frozen")]


def _row(encoder: str) -> Row:
    cfg = SmallDppo(
        encoder=encoder,
        epochs=1,
        minibatches=2,
        minibatch_decisions=DECISIONS // 2,
        critic_warmup=0,
        kl_per_decision=0.0,  # both loops do all their steps
        kl_per_decision_final=0.0,
    )
    policy = random_policy()
    agent = make_agent(policy, cfg)
    state = TrainState.create(agent, cfg, PRIVILEGED, seed=0)
    rollout = _rollout(policy.config, agent, cfg)
    ours, plain = [], []
    for _ in range(ROUNDS + 1):  # by turns; the first round warms up
        ours.append(_seconds(lambda: update(_for_update(rollout, agent), agent, state, cfg)))
        plain.append(_seconds(lambda: _plain_update(rollout, agent, state, cfg)))
    times = [1e3 * min(part[1:]) / DECISIONS for part in (ours, plain)]
    explanation = f"{times[0]:.2f} ms per decision and epoch against {times[1]:.2f} ms (CPU time)"
    return f"DPPO update, plain loop / ours, encoder {encoder}", times[1] / times[0], explanation


def _seconds(function: Callable[[], object]) -> float:
    started = time.process_time()
    function()
    return time.process_time() - started


@torch.no_grad()
def _rollout(config: VtDp3Config, agent: Agent, cfg: SmallDppo) -> Rollout:
    """One random decision in each of ``DECISIONS`` environments, with raw observations."""
    points = num_points(config.observation)
    obs = {
        STATE_KEY: torch.randn(DECISIONS, config.n_obs_steps, config.state_dim),
        CLOUD_KEY: torch.rand(DECISIONS, config.n_obs_steps, points, 5),
    }
    latents = 0.5 * torch.randn(DECISIONS, cfg.ft_denoising_steps + 1, *agent.action_shape)
    log_probs, means, _ = chain_log_probs(agent, latents, agent.actor.encode(obs), cfg)
    once = torch.ones(1, DECISIONS, dtype=torch.bool)
    return Rollout(
        obs=obs,
        latents=latents,
        log_probs=log_probs,
        means=means,
        step=torch.zeros(DECISIONS, dtype=torch.long),
        env=torch.arange(DECISIONS),
        privileged=torch.randn(2, DECISIONS, PRIVILEGED),
        reward=torch.rand(1, DECISIONS),
        terminated=once,
        truncated=~once,
        active=once,
        success=once[0],
        info={},
    )


@torch.no_grad()
def _for_update(rollout: Rollout, agent: Agent) -> Rollout:
    """What the update reads: with a frozen encoder, the conditions that were computed while sampling."""
    if not agent.frozen_encoder:
        return rollout
    return replace(rollout, obs={"cond": agent.actor.encode(rollout.obs)})


def _plain_update(rollout: Rollout, agent: Agent, state: TrainState, cfg: SmallDppo) -> None:
    """One epoch over shuffled (decision, denoising step) rows."""
    advantages, targets = decision_advantages(rollout, state, cfg)
    steps, process = cfg.ft_denoising_steps, agent.process
    first = process.num_steps - steps
    for rows in torch.randperm(DECISIONS * steps).split(cfg.minibatch_decisions * steps):
        ids, step = rows // steps, rows % steps
        cond = agent.actor.encode(select(rollout.obs, ids))
        latent = rollout.latents[ids, step]
        eps = agent.actor.denoiser(latent, process.times(first + step), cond)
        mean, std = process.posterior(latent, eps, first + step, cfg.eta)
        following = rollout.latents[ids, step + 1]
        log_prob = slice_log_prob(following, mean, std.clamp(min=cfg.min_log_prob_std), agent.executed)
        loss = _row_loss(log_prob - rollout.log_probs[ids, step], advantages[ids], step, cfg)
        values = state.critic(rollout.privileged[0, ids])
        state.actor_optimizer.zero_grad()
        state.critic_optimizer.zero_grad()
        (loss + cfg.value_coef * 0.5 * (values - targets[ids]).square().mean()).backward()
        state.actor_optimizer.step()
        state.critic_optimizer.step()


def _row_loss(log_ratio: Tensor, advantages: Tensor, step: Tensor, cfg: SmallDppo) -> Tensor:
    """The clipped loss of single rows: that of whole decisions, picked at each row's step."""
    every = policy_loss(log_ratio.unsqueeze(1).expand(-1, cfg.ft_denoising_steps), advantages, cfg)
    return every.gather(1, step.unsqueeze(1)).mean()
