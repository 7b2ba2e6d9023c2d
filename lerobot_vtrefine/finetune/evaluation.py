"""Evaluation with the deployment sampler, on seeds that training never uses."""

import torch
from torch import Tensor

from lerobot_vtrefine.finetune.distributed import mean_over_ranks, num_ranks, rank_index
from lerobot_vtrefine.finetune.noise import forked_rng, policy_noise
from lerobot_vtrefine.finetune.protocols import (
    Agent,
    DecisionEnv,
    execute,
    latest,
    select,
    start,
)
from lerobot_vtrefine.finetune.seeds import EVALUATION_SEEDS
from lerobot_vtrefine.policies.vt_dp3.diffusion import deploy, predictor


@torch.no_grad()
def evaluate(
    env: DecisionEnv, agent: Agent, num_episodes: int, first_seed: int = EVALUATION_SEEDS
) -> dict[str, float]:
    """Mean success, return and episode metrics of the deployment sampler, as ``eval_<name>``; the number of
    these episodes, as ``eval_episodes``.

    At least ``num_episodes`` held-out seeds over all ranks; each rank has its own. Repeatable, and without
    effect on training: torch's global generator (sensor noise in preprocessors) is seeded here and then
    restored.
    """
    with forked_rng(agent.device):
        return _evaluate(env, agent, num_episodes, first_seed)


def _evaluate(env: DecisionEnv, agent: Agent, num_episodes: int, first_seed: int) -> dict[str, float]:
    device, batches = agent.device, -(-num_episodes // (env.num_envs * num_ranks()))
    columns: dict[str, list[Tensor]] = {}
    for batch in range(batches):
        first = first_seed + (batch * num_ranks() + rank_index()) * env.num_envs
        obs, _ = start(env, range(first, first + env.num_envs), device)
        torch.manual_seed(first)
        generator = policy_noise(device, first)
        running = torch.ones(env.num_envs, dtype=torch.bool, device=device)
        total, info = torch.zeros(env.num_envs, device=device), {}
        for _ in range(env.max_decisions):
            ids = running.nonzero().squeeze(1)
            chunks = deployed_chunks(agent, *agent.conditions(select(obs, ids)), generator)
            obs, _, reward, terminated, truncated, news = execute(env, chunks, ids)
            total += reward * running
            info = latest(info, news, running)
            running = running & ~terminated & ~truncated
            if not running.any():
                break
        for key, values in {"return": total, **info}.items():
            columns.setdefault(f"eval_{key}", []).append(values)
    means = mean_over_ranks({key: torch.cat(parts) for key, parts in columns.items()})
    return means | {"eval_episodes": float(batches * env.num_envs * num_ranks())}


def deployed_chunks(agent: Agent, cond: Tensor, cond_base: Tensor, generator: torch.Generator) -> Tensor:
    """Executed actions (B, Ta, D) of the deployment sampler; conditions (B, C) of actor and base."""
    noise = torch.randn((len(cond), *agent.action_shape), generator=generator, device=cond.device)
    chunks = deploy(
        agent.process,
        predictor(agent.actor.denoiser, cond),
        noise,
        num_tuned=agent.num_tuned,
        predict_noise_base=predictor(agent.base.denoiser, cond_base),
        eta=agent.deploy_eta,
        correlation=agent.deploy_correlation,
        generator=generator,
    )
    return chunks[:, agent.executed]
