"""The reference implementation of DPPO beside this one on a task of its own: Hopper.

    git clone https://github.com/irom-princeton/dppo DPPO
    python scripts/compare_reference_hopper.py data --folder=hopper
    python scripts/compare_reference_hopper.py pretrain --folder=hopper --reference=DPPO
    python scripts/compare_reference_hopper.py train --folder=hopper --reference=DPPO --by=reference --seed=1
    python scripts/compare_reference_hopper.py train --folder=hopper --reference=DPPO --by=paper --seed=1
    python scripts/compare_reference_hopper.py rows --folder=hopper

``data`` and ``pretrain`` make what stands in for D4RL's hopper-medium-v2 and for the checkpoint that the
reference ships (``hopper_standin.py``). ``train`` fine-tunes that one checkpoint: the reference's agent, with
its loop, loss, critic, optimisers and schedules unchanged and the hyper-parameters of its
``ft_ppo_diffusion_mlp.yaml`` for Hopper, or ours, ``paper`` with the same hyper-parameters, ``trust_region``
with its own. Every line of a learning curve lies on disk at once. ``rows`` makes the table of
results/reference_hopper.json from the curves that are there.

Ours learns from whole episodes and the reference from segments of 500 decisions that go on where the last
one stopped. So an iteration of ours has as many worlds as make the same 20 000 decisions, by the mean length
of the episodes before. Environment steps count alike, and both are evaluated after the same of them, on the
same 40 held-out episodes, each by its own deployment sampler.
"""

import argparse
import contextlib
import dataclasses
import importlib
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from hopper_curves import TABLE, Curve, lines_of, read_curves
from hopper_dppo import (
    CHUNK,
    DENOISING_STEPS,
    HORIZON,
    TUNED_STEPS,
    HopperDecisions,
    ReferenceHoppers,
    hopper_agent,
)
from hopper_standin import Scales, imitate, record
from hopper_worlds import ACTION_DIM, MAX_STEPS, OBS_DIM, SpreadWorlds, Worlds, make_worlds
from reference_dppo import Reference, Settings
from torch import Tensor, nn

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.collect import save
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Row
from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.evaluation import evaluate

ROOT = Path(__file__).parents[1]
NUM_ENVS, N_STEPS, BATCH_ROWS = 40, 500, 50000
SAME = {"gamma": 0.99, "timeout": "bootstrap", "encoder": "frozen", "reward_scaling": True}
"""Of every preset: the task's discount and time limit, and rewards that are not a success."""
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "ft_denoising_steps": TUNED_STEPS,
        "min_sampling_std": 0.1,
        "min_log_prob_std": 0.1,
        "gae_lambda": 0.95,
        "gamma_denoising": 0.99,
        "clip": 0.01,
        "clip_first": 0.01,
        "target_kl": 1.0,
        "epochs": 5,
        "minibatches": NUM_ENVS * N_STEPS * TUNED_STEPS // BATCH_ROWS,
        "critic_warmup": 0,
        "actor_lr": 1e-4,
        "actor_lr_final": 1e-4,
        "critic_lr": 1e-3,
        "critic_lr_final": 1e-3,
        "lr_warmup": 0,
        "critic_width": 256,
        "critic_blocks": 1,
    },
    "trust_region": {"ft_denoising_steps": TUNED_STEPS},
}


class Steps(Tensor):
    """Denoising steps that are gone through as numbers.

    The reference's loss goes through them in Python, one by one, which on a GPU took longer than all else.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # ty: ignore[incompatible-method-override]

    def __iter__(self) -> Any:
        return iter(self.tolist())


def network(reference: Reference) -> nn.Module:
    """A fresh diffusion MLP of the reference's, as its configurations for Hopper have it."""
    return importlib.import_module("model.diffusion.mlp_diffusion").DiffusionMLP(
        action_dim=ACTION_DIM,
        horizon_steps=HORIZON,
        cond_dim=OBS_DIM,
        time_dim=16,
        mlp_dims=[512, 512, 512],
        activation_type="ReLU",
        residual_style=True,
    )


def pretrained(reference: Reference, checkpoint: Path, device: str) -> nn.Module:
    """The network of a checkpoint that ``pretrain`` made."""
    weights = torch.load(checkpoint, map_location=device, weights_only=True)["ema"]
    made = network(reference).to(device)
    made.load_state_dict({key.removeprefix("network."): value for key, value in weights.items()})
    return made


def pretrain(args: argparse.Namespace) -> None:
    """Imitate the recorded episodes; saves the checkpoint and the scales."""
    reference = Reference(args.reference)
    torch.manual_seed(args.seed)
    model = importlib.import_module("model.diffusion.diffusion").DiffusionModel(
        network=network(reference),
        horizon_steps=HORIZON,
        obs_dim=OBS_DIM,
        action_dim=ACTION_DIM,
        denoising_steps=DENOISING_STEPS,
        predict_epsilon=True,
        denoised_clip_value=1.0,
        device=args.device,
    )
    episodes = args.folder / "episodes.npz"
    weights = imitate(model, episodes, horizon=HORIZON, updates=args.updates, batch=128, seed=args.seed)
    torch.save({"ema": weights}, args.folder / "pretrained.pt")
    Scales.of(episodes).save(args.folder / "scales.npz")


def train_reference(args: argparse.Namespace, worlds: Worlds | SpreadWorlds, curve: Curve) -> None:
    """The reference's agent's own run."""
    reference, val_freq = Reference(args.reference), args.every + 1
    envs = ReferenceHoppers(
        worlds,
        Scales.of(args.folder / "scales.npz"),
        curve,
        num_envs=NUM_ENVS,
        n_steps=N_STEPS,
        val_freq=val_freq,
        first_seed=10_000_000 * args.seed,
    )

    class Model(reference.Model):
        def loss(
            self, obs: Any, before: Tensor, after: Tensor, steps: Tensor, *rest: Any, **more: Any
        ) -> Any:
            return super().loss(obs, before, after, steps.as_subclass(Steps), *rest, **more)

    torch.manual_seed(args.seed)
    model = Model(
        actor=network(reference),
        critic=reference.Critic(OBS_DIM, [256, 256, 256], activation_type="Mish", residual_style=True),
        network_path=str(args.folder / "pretrained.pt"),
        gamma_denoising=0.99,
        clip_ploss_coef=0.01,
        clip_ploss_coef_base=0.01,
        clip_ploss_coef_rate=3,
        randn_clip_value=3,
        min_sampling_denoising_std=0.1,
        min_logprob_denoising_std=0.1,
        ft_denoising_steps=TUNED_STEPS,
        denoising_steps=DENOISING_STEPS,
        horizon_steps=HORIZON,
        obs_dim=OBS_DIM,
        action_dim=ACTION_DIM,
        device=args.device,
    )
    schedule = {"first_cycle_steps": 1000, "warmup_steps": 10}
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(
            device=args.device,
            seed=args.seed,
            wandb=None,
            env=Settings(
                name=envs,
                n_envs=NUM_ENVS,
                max_episode_steps=MAX_STEPS,
                reset_at_iteration=False,
                best_reward_threshold_for_success=3,
            ),
            obs_dim=OBS_DIM,
            action_dim=ACTION_DIM,
            horizon_steps=HORIZON,
            act_steps=CHUNK,
            cond_steps=1,
            model=model,
            logdir=folder,
            train=Settings(
                batch_size=BATCH_ROWS,
                n_train_itr=args.iterations + args.iterations // args.every + 1,
                n_critic_warmup_itr=0,
                n_steps=N_STEPS,
                val_freq=val_freq,
                save_model_freq=10**9,
                render=Settings(freq=1, num=0),
                gamma=0.99,
                gae_lambda=0.95,
                actor_lr=1e-4,
                actor_weight_decay=0,
                actor_lr_scheduler=Settings(schedule, min_lr=1e-4),
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
        agent = reference.Agent(settings)
        with contextlib.redirect_stdout(Progress()):
            agent.run()


class Progress(io.StringIO):
    """Keeps what the curve prints; the reference prints every tenth step."""

    def write(self, text: str, /) -> int:
        """To the terminal, if it is a line of the curve."""
        return sys.__stdout__.write(text + "\n") if text.startswith("{") and sys.__stdout__ else len(text)


def train_ours(args: argparse.Namespace, worlds: Worlds | SpreadWorlds, curve: Curve) -> None:
    """This package's loop with a preset."""
    cfg = dataclasses.replace(
        DppoConfig.get_choice_class(args.by)(), iterations=args.iterations, **SAME, **PRESETS[args.by]
    )
    reference, scales = Reference(args.reference), Scales.of(args.folder / "scales.npz")
    tuned, base = (pretrained(reference, args.folder / "pretrained.pt", args.device) for _ in range(2))
    agent = hopper_agent(tuned, base, cfg.deploy_eta)
    practice, held_out = (HopperDecisions(worlds, scales, NUM_ENVS) for _ in range(2))
    state = dppo.TrainState.create(agent, cfg, OBS_DIM, args.seed)

    def note(state: dppo.TrainState, metrics: dppo.Metrics) -> None:
        if metrics:
            told = {name: metrics[name] for name in ("return", "decisions", "decision_kl", "rollout_s")}
            curve.add(state.iteration, state.env_steps, **told, episodes=practice.num_envs)
        length = metrics.get("decisions", 0.0)
        if state.iteration % args.every == 0:
            found = evaluate(held_out, agent, NUM_ENVS)
            told = {name: found[f"eval_{name}"] for name in ("return", "decisions")}
            curve.add(
                state.iteration,
                state.env_steps,
                eval_return=told["return"],
                decisions=told["decisions"],
                episodes=NUM_ENVS,
            )
            length = length or told["decisions"]
        practice.fill(NUM_ENVS * N_STEPS, length)

    note(state, {})
    dppo.train(practice, agent, state, cfg, seed=10_000_000 * args.seed, after_iteration=note)


def train(args: argparse.Namespace) -> None:
    """One run, to ``curves/BY_SEED.jsonl`` of the folder."""
    if args.iterations % args.every:
        raise ValueError(f"--iterations={args.iterations} is no multiple of --every={args.every}")
    worlds = make_worlds(args.workers)
    torch.set_num_threads(args.threads)
    curve = Curve(args.folder / "curves" / f"{args.by}_{args.seed}.jsonl", by=args.by, seed=args.seed)
    (train_reference if args.by == "reference" else train_ours)(args, worlds, curve)


def rows(args: argparse.Namespace) -> None:
    """Rows of all curves that lie in the folder, at the evaluations' steps that all have reached."""
    curves = read_curves(args.folder / "curves")
    if not curves:
        raise ValueError(f"{args.folder / 'curves'} holds no evaluation")
    reached = min(points[-1][0] for runs in curves.values() for points in runs.values())
    round_steps = args.every * NUM_ENVS * N_STEPS * CHUNK
    budgets = [i * round_steps for i in range(round(reached / round_steps) + 1)]
    origin = provenance() | {"machine": args.machine or provenance()["machine"]}
    found: list[tuple[Row, list[dict[str, float]]]] = [
        (line, []) for line in lines_of(curves, budgets, **origin)
    ]
    save(args.results, TABLE, found, replace=True)


@run_cli
def main() -> int:
    """``data``, ``pretrain``, ``train`` or ``rows``."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("what", choices=("data", "pretrain", "train", "rows"))
    parser.add_argument("--folder", type=Path, required=True, help="of episodes, checkpoint and curves")
    parser.add_argument("--reference", type=Path, help="a checkout of irom-princeton/dppo")
    parser.add_argument("--by", default="reference", choices=("reference", *PRESETS), help="who trains")
    parser.add_argument("--device", default="cpu", help="of the policy: cpu or cuda")
    parser.add_argument("--threads", type=int, default=1, help="of the policy on a CPU")
    parser.add_argument("--workers", type=int, default=1, help="processes that simulate")
    parser.add_argument("--iterations", type=int, default=45, help="of training, 80 000 steps each")
    parser.add_argument("--every", type=int, default=9, help="iterations from evaluation to evaluation")
    parser.add_argument("--goal", type=float, default=1500.0, help="return at which the search ends")
    parser.add_argument("--noise", type=float, default=0.2, help="on the recorded actions, full scale 1")
    parser.add_argument("--steps", type=int, default=100_000, help="to record")
    parser.add_argument("--updates", type=int, default=20_000, help="of the imitation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--machine", help="that trained, for the rows; default: this one")
    parser.add_argument("--results", type=Path, default=ROOT / "results" / "reference_hopper.json")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    if args.reference is None and args.what in ("pretrain", "train"):
        raise ValueError(f"{args.what} needs --reference")
    if args.what == "data":
        made = args.folder / "episodes.npz"
        found = record(made, goal=args.goal, noise=args.noise, steps=args.steps, seed=args.seed)
        print(json.dumps(found))
    else:
        {"pretrain": pretrain, "train": train, "rows": rows}[args.what](args)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
