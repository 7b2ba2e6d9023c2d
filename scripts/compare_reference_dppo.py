"""The reference implementation of DPPO beside this one, from one checkpoint, on one task.

    git clone https://github.com/irom-princeton/dppo DPPO
    python scripts/compare_reference_dppo.py losses --reference=DPPO --policy=IMITATION/pretrained_model
    python scripts/compare_reference_dppo.py train --reference=DPPO --policy=IMITATION/pretrained_model \\
        --worlds=1024 --iterations=101 --device=cuda

``losses`` prints, term by term, how far the reference's loss and ours lie apart on chains that were sampled
here, for our preset ``paper`` and for the reference's own sampler. ``train`` runs the reference's agent, its
loop, loss, critic, optimisers and schedules unchanged, with the hyper-parameters of its furniture tasks, on
our environment and our network; then ours, with each of --dppo. Rows, of the last evaluation of each, and
learning curves are added to results/reference.json.

``reference_dppo.py`` says what the reference sees of our environments.
"""

import argparse
import contextlib
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
from reference_dppo import Reference, TimeIsUpError, moments, preset, state_of, train_reference
from torch import Tensor, nn

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.collect import largest_fall, read_json, save, steps_to
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Row, Run
from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.chains import chain_log_probs
from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.evaluation import evaluate
from lerobot_vtrefine.finetune.pipeline import Practice, load_practice
from lerobot_vtrefine.finetune.protocols import Agent
from lerobot_vtrefine.finetune.seeds import TRAINING_SEEDS

ROOT = Path(__file__).parents[1]
TASK = ROOT / "configs" / "env" / "round_grasped.yaml"
BATCH_ROWS = 17600
"""Rows, of a decision and a denoising step each, of one of the reference's minibatches."""


def train_ours(name: str, args: argparse.Namespace) -> tuple[Practice, list[dict[str, float]]]:
    """This package's loop with a preset; its learning curve."""
    cfg = preset(name, args)
    practice = load_practice(args.policy, args.task, cfg, args.device, args.backend)
    env, agent = practice.env, practice.agent
    state = dppo.TrainState.create(agent, cfg, env.privileged_dim, args.seed)
    curve: list[dict[str, float]] = []
    began = time.perf_counter()

    def note(state: dppo.TrainState, metrics: dppo.Metrics) -> None:
        row = {"iteration": float(state.iteration), "env_steps": float(state.env_steps)}
        row |= {key: metrics[key] for key in ("success",) if key in metrics}
        over = time.perf_counter() - began > 60 * args.minutes
        if state.iteration % args.val_freq == 0 or state.iteration == cfg.iterations or over:
            row["eval_success"] = evaluate(env, agent, args.worlds)["eval_success"]
        row["seconds"] = time.perf_counter() - began
        curve.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
        if over:
            raise TimeIsUpError

    note(state, {})
    with contextlib.suppress(TimeIsUpError):
        dppo.train(env, agent, state, cfg, seed=args.seed, after_iteration=note)
    return practice, curve


def row_of(variant: str, practice: Practice, curve: list[dict[str, float]], args: argparse.Namespace) -> Run:
    """The last evaluation, where the run was then."""
    last = [row for row in curve if "eval_success" in row][-1]
    return Run(
        table="reference",
        task=args.task.stem,
        policy=practice.policy.config.modalities,
        variant=variant,
        seed=args.seed,
        success=last["eval_success"],
        episodes=args.worlds,
        iterations=int(last["iteration"]),
        env_steps=int(last["env_steps"]),
        extra={
            "largest_fall": largest_fall(curve),
            "seconds": round(curve[-1]["seconds"], 1),
            **steps_to(curve),
        },
        **provenance(),
    )


def train(args: argparse.Namespace) -> int:
    """The reference, then ours."""
    found: list[tuple[Row, list[dict[str, float]]]] = []
    if not args.skip_reference:
        practice, curve = train_reference(args, Reference(args.reference))
        found.append((row_of("reference DPPO", practice, curve, args), curve))
    for name in filter(None, args.dppo.split(",")):
        practice, curve = train_ours(name, args)
        found.append((row_of(f"--dppo.type={name}", practice, curve, args), curve))
    save(args.results, "reference", found, replace=False)
    print(json.dumps([dataclasses.asdict(row) for row, _ in found], indent=2))
    return 0


def losses(args: argparse.Namespace) -> int:
    """Prints, per sampler and term, the largest difference and the largest value."""
    reference = Reference(args.reference)
    samplers = {
        "preset paper: the last 10 of 100 steps": (
            preset("paper", args),
            {"use_ddim": False, "ddim_steps": None, "ft_denoising_steps": 10},
        ),
        "furniture: 5 steps of DDIM": (
            preset(
                "paper", args, sampler="ddim", sampler_steps=5, ft_denoising_steps=5, min_sampling_std=0.04
            ),
            {},
        ),
    }
    for name, (cfg, changes) in samplers.items():
        terms = compare(args, reference, cfg, changes)
        print(json.dumps({"sampler": name, "terms": terms}, indent=2), flush=True)
    return 0


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
        model = reference.model(batch.agent, batch.privileged_dim, batch.cond.shape[1], **changes).double()
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
    clip = log_ratio.new_tensor([cfg.clip_range(step) for step in range(batch.agent.num_tuned)])
    pairs = {
        "log-probability when sampled": (old, batch.sliced(old_theirs)),
        "log-probability now": (now, batch.sliced(now_theirs)),
        "policy loss": (loss, theirs[0]),
        "gradient of the policy loss": gradients,
        "value loss": (0.5 * (values - batch.returns).square().mean(), theirs[2]),
        "clip fraction": ((log_ratio.expm1().abs() > clip).double().mean(), loss.new_tensor(theirs[3])),
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


@run_cli
def main() -> int:
    """``losses`` or ``train``."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("what", choices=("losses", "train"))
    parser.add_argument("--reference", type=Path, required=True, help="a checkout of irom-princeton/dppo")
    parser.add_argument("--policy", type=Path, required=True, help="an imitation-learned vt_dp3's folder")
    parser.add_argument("--task", type=Path, default=TASK, help="a file as in configs/env")
    parser.add_argument("--device", default="cpu", help="of simulation and policy: cpu or cuda")
    parser.add_argument("--backend", help="of the simulation; default: warp on cuda, else the file's")
    parser.add_argument("--worlds", type=int, default=8, help="episodes of an iteration and of an evaluation")
    parser.add_argument(
        "--iterations", type=int, default=101, help="of the reference, evaluations among them"
    )
    parser.add_argument("--our_iterations", type=int, default=36)
    parser.add_argument("--minutes", type=float, default=600.0, help="of each run, which ends there")
    parser.add_argument("--val_freq", type=int, default=10, help="iterations from evaluation to evaluation")
    parser.add_argument("--batch_rows", type=int, default=BATCH_ROWS, help="of the reference's minibatches")
    parser.add_argument("--dppo", default="paper,trust_region", help="presets of ours to run")
    parser.add_argument("--skip_reference", action="store_true", help="run ours alone")
    parser.add_argument("--move", type=float, default=0.05, help="how far weights move before losses compare")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, default=ROOT / "results" / "reference.json")
    args = parser.parse_args()
    saved = read_json(args.policy / "config.json") or {}
    if saved.get("type") != "vt_dp3" or saved["ft_denoising_steps"]:
        raise ValueError(f"--policy={args.policy} is not a vt_dp3 from imitation, before DPPO")
    if args.backend is None and args.device != "cpu":
        args.backend = "warp"
    return losses(args) if args.what == "losses" else train(args)


if __name__ == "__main__":
    raise SystemExit(main())
