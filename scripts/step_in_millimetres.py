"""How far does an iteration of DPPO move the plug? Nats per decision beside millimetres at the hands.

    python scripts/step_in_millimetres.py --policy=outputs/pretrain/checkpoints/last/pretrained_model \\
        --task=configs/env/round_grasped.yaml --worlds=128 --results=results/step_mm.json
    make tables

From one checkpoint and one round of episodes, an iteration's update at several learning rates, without a
trust region that would end it. Prints, per rate, the divergence of whole decisions, and how far the deployed
policy then brings the hand with the plug past the other one, at the end of every executed chunk: from the
same observations and the same noise, before the update and after.
"""

import argparse
import copy
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Line
from lerobot_vtrefine.cli.results.store import check_results, save
from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.chains import chain_log_probs, decision_kl
from lerobot_vtrefine.finetune.config import DppoConfig, TrustRegionDppo
from lerobot_vtrefine.finetune.evaluation import deployed_chunks
from lerobot_vtrefine.finetune.pipeline import Practice, load_practice
from lerobot_vtrefine.finetune.protocols import Agent

UNBOUND = 1e9
"""Nats that no update reaches."""
PART = 1024
"""Decisions at once."""
TABLE = "step_mm"


@torch.no_grad()
def ways(practice: Practice, cond: Tensor, seed: int) -> Tensor:
    """Where the hand with the plug is from the one with the socket (N, 3) [m], as the deployed policy wants
    it at the end of every executed chunk.
    """
    agent, body = practice.agent, practice.env.episodes.body
    socket_hand, plug_hand = body.holders
    found = []
    for number, part in enumerate(cond.split(PART)):
        generator = torch.Generator(agent.device).manual_seed(seed + number)
        chunks = deployed_chunks(agent, part, part, generator)
        targets = practice.processors[1](chunks).cpu().double()
        hands, _ = body.tcp_poses(targets[:, -1])
        found.append(hands[:, plug_hand] - hands[:, socket_hand])
    return torch.cat(found)


@torch.no_grad()
def moved_nats(rollout: dppo.Rollout, agent: Agent, cfg: DppoConfig) -> Tensor:
    """Divergence (N,) of every decision from the policy that collected it."""
    found = []
    for ids in torch.arange(len(rollout.latents)).split(PART):
        _, mean, std = chain_log_probs(agent, rollout.latents[ids], rollout.obs["cond"][ids], cfg)
        found.append(decision_kl(rollout.means[ids], mean, std, agent.executed, cfg.noise_correlation))
    return torch.cat(found)


def millimetres(before: Tensor, after: Tensor) -> dict[str, float]:
    """How far ways (N, 3) [m] have moved: typically, and all of them alike."""
    shift = 1e3 * (after - before)
    return {
        "rms_mm": float(shift.square().sum(1).mean().sqrt()),
        "median_mm": float(shift.norm(dim=1).median()),
        "coherent_mm": float(shift.mean(0).norm()),
    }


def line(task: str, row: dict[str, Any]) -> Line:
    """A line of the table."""
    cells = {
        "task, exploration noise, learning rate": f"{task}, {row['std']:g}, {row['actor_lr']:g}",
        "nats per decision": f"{row['nats']:.2g}",
        "RMS, mm": f"{row['rms_mm']:.2f}",
        "median, mm": f"{row['median_mm']:.2f}",
        "all alike, mm": f"{row['coherent_mm']:.2f}",
    }
    return Line(table=TABLE, cells=cells, **provenance())


def measure(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row per learning rate."""
    cfg = TrustRegionDppo(
        num_envs=args.worlds,
        encoder="frozen",
        critic_warmup=1,
        kl_per_decision=UNBOUND,
        kl_per_decision_final=UNBOUND,
        target_kl=UNBOUND,
        min_sampling_std=args.std,
    )
    practice = load_practice(args.policy, args.task, cfg, args.device)
    agent, env = practice.agent, practice.env
    state = dppo.TrainState.create(agent, cfg, env.privileged_dim, args.seed)
    for first in (1, 2):  # the critic learns from the first round
        seeds = range(args.seed + first * args.worlds, args.seed + (first + 1) * args.worlds)
        rollout = dppo.collect(env, agent, cfg, state.generator, seeds)
        state.critic.update_moments(rollout.privileged[:-1][rollout.active])
        if first == 1:
            dppo.update(rollout, agent, state, cfg)
    before = ways(practice, rollout.obs["cond"], args.seed)
    weights, critic = (copy.deepcopy(net.state_dict()) for net in (agent.actor.denoiser, state.critic))
    for rate in args.rates:
        agent.actor.denoiser.load_state_dict(weights)
        tried = dataclasses.replace(cfg, actor_lr=rate)
        state = dppo.TrainState.create(agent, tried, env.privileged_dim, args.seed)
        state.critic.load_state_dict(critic)
        state.iteration = cfg.critic_warmup
        dppo.update(rollout, agent, state, tried)
        nats = float(moved_nats(rollout, agent, tried).mean())
        found = millimetres(before, ways(practice, rollout.obs["cond"], args.seed))
        yield {"actor_lr": rate, "nats": nats, **found, "std": cfg.min_sampling_std}


@run_cli
def main() -> None:
    """Prints a JSON object a line."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--policy", type=Path, required=True, help="an imitation-learned vt_dp3's folder")
    parser.add_argument("--task", type=Path, required=True, help="a file as in configs/env")
    parser.add_argument("--worlds", type=at_least(1), default=128, help="episodes of an iteration")
    parser.add_argument(
        "--rates",
        type=float,
        nargs="+",
        default=[1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4],
        help="of learning (default: %(default)s)",
    )
    parser.add_argument("--std", type=float, default=TrustRegionDppo.min_sampling_std, help="of exploration")
    parser.add_argument("--device", default="cpu", help="of simulation and policy: cpu or cuda")
    parser.add_argument("--seed", type=at_least(0), default=0, help="of the first episode")
    parser.add_argument("--results", type=Path, help="where rows of the table step_mm go, too")
    args = parser.parse_args()
    if args.results:
        check_results("--results", args.results)
    for row in measure(args):
        print(json.dumps(row), flush=True)
        if args.results:
            save(args.results, [(line(args.task.stem, row), [])], replace=False)


if __name__ == "__main__":
    raise SystemExit(main())
