"""Evaluation with the deployment sampler, on seeds that training never uses."""

import torch

from lerobot_vtrefine.finetune.distributed import sum_over_ranks
from lerobot_vtrefine.finetune.protocols import Agent, DecisionEnv, execute, latest, predictor, select
from lerobot_vtrefine.policies.vt_dp3.diffusion import deploy

EVALUATION_SEEDS = 500_000
"""First seed of the evaluations during training (``lerobot-eval`` counts up from its own --seed)."""


@torch.no_grad()
def evaluate(
    env: DecisionEnv, agent: Agent, num_episodes: int, first_seed: int = EVALUATION_SEEDS
) -> dict[str, float]:
    """Success and return of the deployment sampler over at least ``num_episodes`` held-out seeds per rank."""
    sums: dict[str, float] = {}
    episodes = 0
    while episodes < num_episodes:
        seeds = range(first_seed + episodes, first_seed + episodes + env.num_envs)
        obs, privileged = env.reset(list(seeds))
        generator = torch.Generator(privileged.device).manual_seed(seeds.start)
        running = torch.ones(env.num_envs, dtype=torch.bool, device=privileged.device)
        total, info = torch.zeros(env.num_envs, device=privileged.device), {}
        for _ in range(env.max_decisions):
            ids = running.nonzero().squeeze(1)
            cond, cond_base = agent.conditions(select(obs, ids))
            noise = torch.randn(
                (len(ids), *agent.action_shape), generator=generator, device=privileged.device
            )
            actions = deploy(
                agent.process,
                predictor(agent.actor, cond),
                noise,
                num_tuned=agent.num_tuned,
                predict_noise_base=predictor(agent.base, cond_base),
            )
            obs, _, reward, terminated, truncated, news = execute(env, actions[:, agent.executed], ids)
            total += reward * running
            info = latest(info, news, running)
            running = running & ~terminated & ~truncated
            if not running.any():
                break
        for key, value in {"return": total, **info}.items():
            sums[key] = sums.get(key, 0.0) + float(value.sum())
        episodes += env.num_envs
    totals = torch.tensor([*sums.values(), float(episodes)], dtype=torch.float64, device=total.device)
    *values, count = sum_over_ranks(totals).tolist()
    return {f"eval_{key}": value / count for key, value in zip(sums, values, strict=True)} | {
        "eval_episodes": count
    }
