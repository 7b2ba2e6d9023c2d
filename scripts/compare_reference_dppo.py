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

What the reference sees as its state is the policy's condition, from an encoder that nobody tunes, and the
privileged state, standardised; its actor reads the one, its critic the other. Worlds whose episode has ended
wait, terminated and without reward, for the next iteration. Its evaluations count as iterations, as they do
there: iteration 0 is one, and the last should be.
"""

import argparse
import contextlib
import copy
import dataclasses
import functools
import io
import json
import sys
import tempfile
import time
from collections.abc import Generator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.collect import largest_fall, read_json, save
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Row, Run
from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.chains import chain_log_probs
from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.evaluation import evaluate
from lerobot_vtrefine.finetune.pipeline import Practice, load_practice
from lerobot_vtrefine.finetune.protocols import Agent, DecisionEnv, Observation
from lerobot_vtrefine.finetune.seeds import EVALUATION_SEEDS, TRAINING_SEEDS

ROOT = Path(__file__).parents[1]
TASK = ROOT / "configs" / "env" / "round_grasped.yaml"
FURNITURE = {
    "gamma_denoising": 0.9,
    "clip_ploss_coef": 0.001,
    "clip_ploss_coef_base": 0.001,
    "clip_ploss_coef_rate": 3,
    "randn_clip_value": 3,
    "min_sampling_denoising_std": 0.04,
    "denoising_steps": 100,
}
"""Of its diffusion model, for the furniture tasks; with five steps of DDIM, all of them tuned."""
DDIM_STEPS = 5
BATCH_ROWS = 17600
"""Rows, of a decision and a denoising step each, of one of its minibatches."""
CRITIC_WIDTHS = (512, 512, 512)
STATE_CLIP = 5.0


class Settings(dict[str, Any]):
    """What the reference reads of its configuration: a mapping whose values are attributes, too."""

    __getattr__ = dict.__getitem__


class Reference:
    """The classes of a checkout, imported with stand-ins for what it only configures and logs with.

    Raises: FileNotFoundError where the folder holds no checkout.
    """

    def __init__(self, root: Path) -> None:
        if not (root / "model" / "diffusion" / "diffusion_ppo.py").is_file():
            raise FileNotFoundError(f"--reference={root} is no checkout of irom-princeton/dppo")
        stubs = {name: ModuleType(name) for name in ("hydra", "omegaconf", "wandb", "env", "env.gym_utils")}
        vars(stubs["hydra"])["utils"] = Settings(instantiate=lambda made: made)
        vars(stubs["omegaconf"])["OmegaConf"] = object
        vars(stubs["env.gym_utils"])["make_async"] = lambda made, **_: made
        sys.modules.update(stubs)
        sys.path.insert(0, str(root))
        from agent.finetune.train_ppo_diffusion_agent import (  # ty: ignore[import-not-found]
            TrainPPODiffusionAgent,
        )
        from model.common.critic import CriticObs  # ty: ignore[import-not-found]
        from model.diffusion import diffusion  # ty: ignore[import-not-found]
        from model.diffusion.diffusion_ppo import PPODiffusion  # ty: ignore[import-not-found]
        from model.diffusion.eta import EtaFixed  # ty: ignore[import-not-found]

        self.Agent, self.Model = TrainPPODiffusionAgent, PPODiffusion
        self.Critic, self.Eta = CriticObs, EtaFixed
        self._diffusion = diffusion

    @contextlib.contextmanager
    def double_schedule(self) -> Generator[None]:
        """Models made meanwhile have their noise schedule in double precision."""
        single = self._diffusion.cosine_beta_schedule
        self._diffusion.cosine_beta_schedule = functools.partial(single, dtype=torch.float64)
        yield
        self._diffusion.cosine_beta_schedule = single

    def model(self, agent: Agent, privileged_dim: int, cond_dim: int, **changes: Any) -> Any:
        """Its ``PPODiffusion`` around a copy of our network."""
        horizon, action_dim = agent.action_shape
        settings = FURNITURE | {"use_ddim": True, "ddim_steps": DDIM_STEPS, "ft_denoising_steps": DDIM_STEPS}
        settings |= changes
        eta = {"eta": self.Eta(base_eta=1, min_eta=0.1, max_eta=1.0)} if settings["use_ddim"] else {}
        critic = self.Critic(privileged_dim, list(CRITIC_WIDTHS), residual_style=True)
        return self.Model(
            actor=ActorOfState(agent.actor.denoiser, cond_dim),
            critic=CriticOfState(critic, cond_dim),
            horizon_steps=horizon,
            obs_dim=cond_dim + privileged_dim,
            action_dim=action_dim,
            device=str(agent.device),
            **eta,
            **settings,
        )


class TimeIsUpError(Exception):
    """Ends a run whose --minutes are over."""


class ActorOfState(nn.Module):
    """Our denoiser as the reference calls its own: condition (B, 1, C + P) as a state."""

    def __init__(self, denoiser: nn.Module, cond_dim: int) -> None:
        super().__init__()
        self.denoiser, self.cond_dim = copy.deepcopy(denoiser).requires_grad_(True), cond_dim

    def forward(self, x: Tensor, time: Tensor, cond: dict[str, Tensor]) -> Tensor:
        """Noise (B, H, D)."""
        return self.denoiser(x, time, cond["state"][:, 0, : self.cond_dim])


class CriticOfState(nn.Module):
    """The reference's critic, on the privileged part of the state."""

    def __init__(self, critic: nn.Module, cond_dim: int) -> None:
        super().__init__()
        self.critic, self.cond_dim = critic, cond_dim

    def forward(self, cond: dict[str, Tensor]) -> Tensor:
        """Values (B, 1)."""
        return self.critic({"state": cond["state"][:, :, self.cond_dim :].contiguous()})


class ReferenceEnvs:
    """Our environments as the reference's agent steps its own; keeps the learning curve.

    ``mean`` and ``std`` (P,) standardise the privileged state.
    """

    pairs_to_assemble = (0,)  # what counts as success: a reward of one

    def __init__(
        self, env: DecisionEnv, agent: Agent, mean: Tensor, std: Tensor, args: argparse.Namespace
    ) -> None:
        self.env, self.agent, self.mean, self.std = env, agent, mean, std
        self.seed, self.val_freq, self.seconds = args.seed, args.val_freq, 60 * args.minutes
        self.iteration, self.env_steps, self.began = -1, 0, time.perf_counter()
        self.curve: list[dict[str, float]] = []
        self.over = self.success = np.ones(env.num_envs, bool)

    def reset_arg(self, options_list: object) -> dict[str, np.ndarray]:
        """New episodes in all worlds: held-out ones where the agent evaluates."""
        self.note()
        if time.perf_counter() - self.began > self.seconds:
            raise TimeIsUpError
        self.iteration += 1
        held_out = self.iteration % self.val_freq == 0
        worlds = self.env.num_envs
        first = EVALUATION_SEEDS if held_out else TRAINING_SEEDS + self.seed + self.iteration * worlds
        obs, privileged = self.env.reset(range(first, first + worlds))
        self.over, self.success = np.zeros((2, worlds), bool)
        return self._state(obs, privileged)

    def note(self) -> None:
        """Add the episodes that have ended to the curve."""
        if self.iteration < 0:
            return
        name = "eval_success" if self.iteration % self.val_freq == 0 else "success"
        row = {"iteration": float(self.iteration), "env_steps": float(self.env_steps)}
        row |= {name: float(self.success.mean()), "seconds": time.perf_counter() - self.began}
        self.curve.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        """Executes chunks (n, Ta, D); what has ended stays terminated."""
        if self.iteration % self.val_freq:
            self.env_steps += int((~self.over).sum()) * actions.shape[1]
        chunk = torch.as_tensor(actions, device=self.agent.device)
        obs, privileged, reward, terminated, truncated, info = self.env.step_chunk(chunk)
        reward = np.where(self.over, 0.0, reward.cpu().numpy())
        self.success = self.success | (info["success"].cpu().numpy().astype(bool) & ~self.over)
        self.over = self.over | (terminated | truncated).cpu().numpy()
        return self._state(obs, privileged), reward, self.over, np.zeros_like(self.over), {}

    @torch.no_grad()
    def _state(self, obs: Observation, privileged: Tensor) -> dict[str, np.ndarray]:
        device = self.agent.device
        cond = self.agent.actor.encode({key: value.to(device) for key, value in obs.items()})
        return {"state": state_of(cond, privileged.to(device), self.mean, self.std).cpu().numpy()}


def state_of(cond: Tensor, privileged: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """The reference's state (B, 1, C + P)."""
    known = ((privileged - mean) / std).clamp(-STATE_CLIP, STATE_CLIP)
    return torch.cat([cond, known], dim=1).unsqueeze(1)


def moments(rollout: dppo.Rollout) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (P,) of the privileged states of a rollout; constant ones keep theirs."""
    states = rollout.privileged[:-1][rollout.active]
    return states.mean(0), states.std(0).clamp(min=1e-6)


def train_reference(
    args: argparse.Namespace, reference: Reference
) -> tuple[Practice, list[dict[str, float]]]:
    """The reference's agent's own run; its learning curve."""
    cfg = preset("paper", args)
    practice = load_practice(args.policy, args.task, cfg, args.device, args.backend)
    agent, env = practice.agent, practice.env
    generator = torch.Generator(agent.device).manual_seed(args.seed)
    first = TRAINING_SEEDS + args.seed
    seen = dppo.collect(env, agent, cfg, generator, range(first, first + args.worlds))
    mean, std = moments(seen)
    envs = ReferenceEnvs(env, agent, mean, std, args)
    cond_dim = seen.obs["cond"].shape[1]
    model = reference.model(agent, env.privileged_dim, cond_dim)
    schedule = {"first_cycle_steps": 10000, "warmup_steps": 10}
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(
            device=args.device,
            seed=args.seed,
            wandb=None,
            env=Settings(
                name=envs,
                env_type="furniture",
                n_envs=args.worlds,
                max_episode_steps=env.max_decisions * (agent.executed.stop - agent.executed.start),
                specific=Settings(sparse_reward=True),
            ),
            obs_dim=cond_dim + env.privileged_dim,
            action_dim=agent.action_shape[1],
            horizon_steps=agent.action_shape[0],
            act_steps=agent.executed.stop - agent.executed.start,
            cond_steps=1,
            model=model,
            logdir=folder,
            train=Settings(
                batch_size=args.batch_rows,
                n_train_itr=args.iterations,
                n_critic_warmup_itr=1,
                n_steps=env.max_decisions,
                val_freq=args.val_freq,
                save_model_freq=10**9,
                render=Settings(freq=10**9, num=0),
                logprob_batch_size=args.worlds * max(1, 10000 // args.worlds),
                gamma=0.999,
                gae_lambda=0.95,
                actor_lr=1e-5,
                actor_weight_decay=0,
                actor_lr_scheduler=Settings(schedule, min_lr=1e-6),
                critic_lr=1e-3,
                critic_weight_decay=0,
                critic_lr_scheduler=Settings(schedule, min_lr=1e-3),
                reward_scale_running=True,
                reward_scale_const=1.0,
                update_epochs=5,
                vf_coef=0.5,
                target_kl=1,
            ),
        )
        # It prints every step.
        with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(TimeIsUpError):
            reference.Agent(settings).run()
            envs.note()
    return practice, envs.curve


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


def preset(name: str, args: argparse.Namespace, **changes: Any) -> DppoConfig:
    """A preset of ours, with the encoder left alone, as the reference has it here."""
    return dataclasses.replace(
        DppoConfig.get_choice_class(name)(),
        **{"num_envs": args.worlds, "iterations": args.our_iterations, "encoder": "frozen", **changes},
    )


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
        extra={"largest_fall": largest_fall(curve), "seconds": round(curve[-1]["seconds"], 1)},
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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
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
        raise ValueError(f"--policy={args.policy} is no vt_dp3 as imitation left it, before DPPO")
    if args.backend is None and args.device != "cpu":
        args.backend = "warp"
    return losses(args) if args.what == "losses" else train(args)


if __name__ == "__main__":
    raise SystemExit(main())
