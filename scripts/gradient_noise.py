"""How much of DPPO's gradient is signal, on one task from one checkpoint?

    python scripts/gradient_noise.py --policy=outputs/pretrain/checkpoints/last/pretrained_model \\
        --task=configs/env/square_grasped_1mm.yaml --worlds=1024 --device=cuda

Prints success of the policy as deployed and with exploration noise, the critic's explained variance on
episodes that it has not seen, and the cosine between the policy gradients of two halves of the episodes: with
as many episodes as an iteration has, a step along it is a step in the right direction with about that share.

Then an iteration is made of these episodes, and at its end the gradient is taken apart. PPO's ratio is here
of probabilities averaged over action elements, whose mean over the sampling policy falls below one as the
policy moves. So even advantages that are all alike give a gradient: towards the old policy where they are
positive, and where they are negative away from it, in whatever direction it has moved. "ratio_bias" is the
length of that part, "gradient" that of the rest.
"""

import argparse
import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.chains import chain_log_probs
from lerobot_vtrefine.finetune.config import DppoConfig, TrustRegionDppo
from lerobot_vtrefine.finetune.critic import explained_variance
from lerobot_vtrefine.finetune.evaluation import evaluate
from lerobot_vtrefine.finetune.pipeline import load_practice
from lerobot_vtrefine.finetune.protocols import Agent, select
from lerobot_vtrefine.policies.vt_dp3.diffusion import whiten

GROUPS = 8
"""Groups of episodes: the halves are made of them in all ways."""


def halves_cosine(groups: Tensor) -> tuple[float, float]:
    """Cosine between the mean gradients of two halves of the groups (G, P): mean over all ways to halve them,
    and the standard deviation of these.
    """
    gram = (groups @ groups.T).double().numpy()
    count, cosines = len(gram), []
    for chosen in itertools.combinations(range(count), count // 2):
        if 0 not in chosen:
            continue  # each way once
        one = np.isin(range(count), chosen)
        a, b = one.astype(float), (~one).astype(float)
        cosines.append(a @ gram @ b / np.sqrt((a @ gram @ a) * (b @ gram @ b)))
    return float(np.mean(cosines)), float(np.std(cosines))


def whole_cosine(half: float) -> float:
    """Cosine of the whole gradient with the true one, from that of two halves (Spearman and Brown)."""
    return float(np.sqrt(2 * half / (1 + half))) if half > 0 else 0.0


def group_gradients(
    rollout: dppo.Rollout, advantages: Tensor, agent: Agent, cfg: DppoConfig, worlds: int
) -> Tensor:
    """Policy gradients (G, P) of the groups of episodes, on the host."""
    found, parameters = [], agent.trained_parameters()
    for group in range(GROUPS):
        for parameter in parameters:
            parameter.grad = None
        ids = (rollout.env * GROUPS // worlds == group).nonzero().squeeze(1)
        for part in ids.split(1024):
            cond = agent.kept_condition(agent.actor, select(rollout.obs, part))
            log_probs, _, _ = chain_log_probs(agent, rollout.latents[part], cond, cfg)
            loss = dppo.policy_loss(log_probs - rollout.log_probs[part], advantages[part], cfg)
            (loss.sum() / len(ids)).backward()
        found.append(torch.cat([p.grad.flatten() for p in parameters if p.grad is not None]).cpu())
    return torch.stack(found)


def moved_gradients(
    rollout: dppo.Rollout, advantages: Tensor, agent: Agent, cfg: DppoConfig
) -> tuple[Tensor, Tensor]:
    """Policy gradients (P,) at the actor's present weights: with a ratio whose mean is one, and what DPPO's
    ratio adds.

    The mean of DPPO's is exp(-kl / n) for Gaussian steps and many averaged elements n.
    """
    parameters, found = agent.trained_parameters(), []
    for centred in (True, False):
        total = [torch.zeros_like(parameter) for parameter in parameters]
        for part in torch.arange(len(advantages)).split(1024):
            cond = agent.kept_condition(agent.actor, select(rollout.obs, part))
            log_probs, mean, std = chain_log_probs(agent, rollout.latents[part], cond, cfg)
            log_ratio = log_probs - rollout.log_probs[part]
            if centred:
                shift = ((mean - rollout.means[part]) / std)[:, :, agent.executed]
                log_ratio = log_ratio + 0.5 * whiten(shift, cfg.noise_correlation).square().mean(dim=(2, 3))
            loss = dppo.policy_loss(log_ratio, advantages[part], cfg).sum() / len(advantages)
            gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
            total = [a if b is None else a + b for a, b in zip(total, gradients, strict=True)]
        found.append(torch.cat([gradient.flatten() for gradient in total]))
    return found[0], found[1] - found[0]


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """The figures of one task and checkpoint."""
    cfg = TrustRegionDppo(num_envs=args.worlds, encoder="frozen", critic_warmup=1)
    if args.std is not None:
        cfg = dataclasses.replace(cfg, min_sampling_std=args.std)
    if args.nats is not None:
        cfg = dataclasses.replace(cfg, kl_per_decision=args.nats, kl_per_decision_final=args.nats)
    _, agent, env, _ = load_practice(args.policy, args.task, cfg, args.device)
    state = dppo.TrainState.create(agent, cfg, env.privileged_dim, seed=args.seed)
    deployed = evaluate(env, agent, args.worlds, args.seed) if args.deployed else {}
    for first in (1, 2):  # the critic learns from the first round and is judged on the second
        seeds = range(args.seed + first * args.worlds, args.seed + (first + 1) * args.worlds)
        rollout = dppo.collect(env, agent, cfg, state.generator, seeds)
        if first == 1:
            state.critic.update_moments(rollout.privileged[:-1][rollout.active])
            dppo.update(rollout, agent, state, cfg)  # of the critic alone: it is the warm-up
    advantages, targets = dppo.decision_advantages(rollout, state, cfg)
    values = state.critic(rollout.privileged[rollout.step, rollout.env])
    half, spread = halves_cosine(group_gradients(rollout, advantages, agent, cfg, args.worlds))
    moved = dppo.update(rollout, agent, dataclasses.replace(state, iteration=cfg.critic_warmup), cfg)
    gradient, bias = moved_gradients(rollout, advantages, agent, cfg)
    return {
        "episodes": args.worlds,
        "deployed": deployed.get("eval_success"),
        "exploring": float(rollout.success.float().mean()),
        "explained_variance": explained_variance(values, targets),
        "cosine_of_halves": half,
        "spread_over_halvings": spread,
        "cosine_with_truth": whole_cosine(half),
        "std": cfg.min_sampling_std,
        "nats_moved": moved["decision_kl"],
        "gradient": float(gradient.norm()),
        "ratio_bias": float(bias.norm()),
    }


@run_cli
def main() -> None:
    """Prints a JSON object."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--policy", type=Path, required=True, help="an imitation-learned vt_dp3's folder")
    parser.add_argument("--task", type=Path, required=True, help="a file as in configs/env")
    parser.add_argument("--worlds", type=at_least(1), default=1024, help="episodes of an iteration")
    parser.add_argument("--device", default="cpu", help="of simulation and policy: cpu or cuda")
    parser.add_argument("--std", type=float, help="of the exploration noise; default: the preset's")
    parser.add_argument("--nats", type=float, help="an iteration's way, per decision; default: the preset's")
    parser.add_argument("--seed", type=at_least(0), default=0, help="of the first episode")
    parser.add_argument("--deployed", action="store_true", help="judge the deployed policy too")
    print(json.dumps(measure(parser.parse_args()), indent=2))


if __name__ == "__main__":
    raise SystemExit(main())
