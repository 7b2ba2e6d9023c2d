"""Commands that make and judge one policy: encoder, demonstrations, imitation, DPPO, evaluations."""

import argparse
import json
from pathlib import Path
from typing import Any

from compare_touch import MODALITIES

from lerobot_vtrefine.cli.arguments import flags
from lerobot_vtrefine.cli.pipeline.demo_config import (
    EVAL_SEED_OFFSET,
    RECIPES,
    SEED_STRIDE,
    TRAIN_SEED_OFFSET,
    default_degradation,
)
from lerobot_vtrefine.cli.pipeline.stages import Stage, evaluation_stage, trained_policy
from lerobot_vtrefine.shipped import PREFIX
from paper.trained import Trained, first_seed, iterations_of

CLONE = Path(__file__).parents[1] / "clone_on_features.py"
TASKS = {
    "00081": "automate_00081",
    "00186": "automate_00186",
    "00007": "automate_00007",
    "00446": "automate_00446",
    "00581": "automate_00581_stands",
}
"""Files of configs/env. The shaft of 00581 stays on the table, as the paper's robot leaves it."""
TRAINED_HERE = "own"
"""Of --encoder."""
POLICY = {
    "pads": {"down_dims": [512] * 4, "feature_noise": 0.3},
    "cloud": {"down_dims": [512] * 4, "n_action_steps": 4, "horizon": 8},
}
DPPO = {
    "type": "trust_region",
    "sampler": "ddim",
    "sampler_steps": 10,
    "ft_denoising_steps": 5,
    "micro_batch_decisions": 1024,
}
"""The tables' recipes on a GPU, where they differ from the demo's (docs/learning-tried.md says why)."""
BANK_SEED_OFFSET = EVAL_SEED_OFFSET + 1_000_000
"""Past the episodes of an evaluation, which no bank may have seen."""
NEVER_IN_HAND = ("00446", "00581")
"""Pairs that the hands cannot hold above each other at the start."""


def task_flags(options: argparse.Namespace, pair: str) -> list[str]:
    """The pair's task, from the table."""
    meshes = [f"--env.mesh_dir={options.mesh_dir}"]
    return [f"--config_path={PREFIX}{TASKS[pair]}", *meshes, *flags("env", options.env)]


def dataset(options: argparse.Namespace, policy: Trained) -> Path:
    """Demonstrations of a pair and seed; fewer are the first of more."""
    return options.output_dir / f"demos_{policy.pair}_{policy.seed}_{policy.learnt_from}"


def record_stage(options: argparse.Namespace, policy: Trained) -> Stage:
    """The demonstrations, which policies share."""
    root = dataset(options, policy)
    command = (
        "vtrefine-record-demos",
        *task_flags(options, policy.pair),
        f"--root={root}",
        f"--num_episodes={policy.learnt_from}",
        f"--num_envs={options.demo_envs}",
        f"--seed={policy.seed * SEED_STRIDE}",
        *flags("degradation", default_degradation()),
    )
    product = root / "meta" / "info.json"
    return Stage(root.name, f"Record {root.name}", command, root, product, resumable=True)


def trains_encoder(options: argparse.Namespace) -> bool:
    """Whether encoders are trained here. One for each pair comes with the package."""
    is_named = "pretrained_encoder" in options.policy
    return options.recipe == "pads" and options.encoder == TRAINED_HERE and not is_named


def encoder_stage(options: argparse.Namespace, pair: str) -> Stage:
    """What a pair's policies see and feel with, from the table on."""
    out = options.output_dir / f"encoder_{pair}"
    command = (
        "vtrefine-information",
        *task_flags(options, pair),
        f"--env.backend={options.backend}",
        f"--senses=[{','.join(MODALITIES)}]",
        f"--effort.device={options.device}",
        f"--effort.episodes={options.encoder_episodes}",
        f"--effort.num_envs={min(options.worlds, options.encoder_episodes // 2)}",
        f"--effort.steps={options.encoder_steps}",
        "--effort.batch_size=1024",
        "--effort.history=[1]",
        "--effort.closed_loop_episodes=0",
        "--effort.tolerance_episodes=0",
        f"--output_dir={out}",
    )
    return Stage(out.name, f"Encoder of {pair}", command, out, out / "information.json")


def policy_settings(options: argparse.Namespace, policy: Trained) -> dict[str, Any]:
    """Of vt_dp3."""
    recipe: dict[str, Any] = RECIPES[options.recipe]["policy"] | (
        POLICY[options.recipe] if on_a_gpu(options) else {}
    )
    if options.recipe == "pads":
        trained = trains_encoder(options)
        named = options.encoder or f"{PREFIX}{TASKS[policy.pair]}"
        recipe["pretrained_encoder"] = (
            str(encoder_stage(options, policy.pair).output) if trained else named.format(pair=policy.pair)
        )
    return recipe | options.policy


def on_a_gpu(options: argparse.Namespace) -> bool:
    """Whether many worlds practise at once."""
    return options.backend == "warp"


def imitation_stage(options: argparse.Namespace, policy: Trained) -> Stage:
    """Imitation of the first demonstrations, or one step of it: random weights."""
    out = options.output_dir / f"imitation_{policy.name}"
    recipe = policy_settings(options, policy)
    steps = options.steps if policy.demonstrations else 1
    frozen = recipe.get("freeze_encoder", False)
    command = (clone_command if frozen else train_command)(options, policy, recipe, steps, out)
    encoder = [encoder_stage(options, policy.pair).name] if trains_encoder(options) else []
    needs = (dataset(options, policy).name, *encoder)
    return Stage(
        out.name, f"Imitation {policy.name}", command, out, trained_policy(out) / "model.safetensors", needs
    )


def clone_command(
    options: argparse.Namespace, policy: Trained, recipe: dict[str, Any], steps: int, out: Path
) -> tuple[str, ...]:
    """What a frozen encoder makes of a frame is computed once."""
    return (
        "python",
        str(CLONE),
        f"--dataset={dataset(options, policy)}",
        f"--policy={json.dumps(recipe | {'modalities': policy.senses})}",
        f"--device={options.device}",
        f"--output_dir={trained_policy(out).parent}",
        f"--steps={steps}",
        f"--batch_size={options.batch_size}",
        f"--seed={policy.seed}",
    )


def train_command(
    options: argparse.Namespace, policy: Trained, recipe: dict[str, Any], steps: int, out: Path
) -> tuple[str, ...]:
    """Stock lerobot-train."""
    return (
        "lerobot-train",
        "--dataset.repo_id=local/vtrefine_demos",
        f"--dataset.root={dataset(options, policy)}",
        *flags("policy", {"type": "vt_dp3"} | recipe),
        f"--policy.modalities={policy.senses}",
        f"--policy.device={options.device}",
        "--policy.push_to_hub=false",
        f"--output_dir={out}",
        f"--steps={steps}",
        f"--save_freq={steps}",
        f"--batch_size={options.batch_size}",
        f"--seed={policy.seed}",
        "--num_workers=0",  # items come from memory
        "--env_eval_freq=0",
    )


def uses_bank(options: argparse.Namespace, policy: Trained) -> bool:
    """Whether DPPO starts from states of a bank."""
    return options.tune_start == "bank" and policy.demonstrations > 0


def practice_flags(options: argparse.Namespace, *, bank: bool) -> list[str]:
    """How practice differs from the task that is judged: physics steps, and when episodes from a bank end.

    Grasps that come after that are none of the bank's states.
    """
    step = [f"--env.scene.timestep_s={options.tune_timestep_s}"] if options.tune_timestep_s else []
    end = [f"--env.episode_steps={options.tune_steps}"] if bank and options.tune_steps else []
    return [*step, *end]


def bank_stage(options: argparse.Namespace, policy: Trained) -> Stage:
    """States with both parts in hand: the imitation's own, then the expert's."""
    out = options.output_dir / f"starts_{policy.name}"
    start = options.output_dir / f"imitation_{policy.name}"
    product = out / "starts.npz"
    command = (
        "vtrefine-record-starts",
        *task_flags(options, policy.pair),
        f"--env.backend={options.backend}",
        *practice_flags(options, bank=True),
        f"--path={product}",
        f"--policy.path={trained_policy(start)}",
        f"--policy.device={options.device}",
        f"--num_starts={options.starts}",
        f"--num_envs={options.eval_envs}",
        f"--seed={policy.seed * SEED_STRIDE + BANK_SEED_OFFSET}",
        *flags("degradation", default_degradation()),
    )
    return Stage(out.name, f"Grasps of {policy.name}", command, out, product, (start.name,))


def finetune_stage(options: argparse.Namespace, policy: Trained) -> Stage:
    """DPPO, in a folder from which an interrupted run goes on."""
    out = options.output_dir / f"finetune_{policy.name}"
    grasped = options.tune_start == "grasped" and policy.pair not in NEVER_IN_HAND
    start = options.output_dir / f"imitation_{policy.name}"
    bank = [bank_stage(options, policy)] if uses_bank(options, policy) else []
    command = (
        "vtrefine-finetune",
        *task_flags(options, policy.pair),
        *(["--env.start=grasped"] if grasped else []),
        *(f"--env.start_bank={stage.product}" for stage in bank),
        *practice_flags(options, bank=bool(bank)),
        f"--env.backend={options.backend}",
        f"--policy.path={trained_policy(start)}",
        f"--policy.device={options.device}",
        *flags("dppo", dppo_settings(options)),
        f"--dppo.iterations={iterations_of(options, policy)}",
        f"--dppo.num_envs={options.worlds}",
        "--eval_freq=0",
        "--save_freq=4",
        f"--seed={policy.seed * SEED_STRIDE + TRAIN_SEED_OFFSET}",
        f"--output_dir={out}",
        "--resume=true",
    )
    product = trained_policy(out) / "model.safetensors"
    needs = (start.name, *(stage.name for stage in bank))
    return Stage(out.name, f"DPPO {policy.name}", command, out, product, needs, resumable=True)


def dppo_settings(options: argparse.Namespace) -> dict[str, Any]:
    """The demo's, or the table's with many worlds on a GPU."""
    return RECIPES[options.recipe]["dppo"] | (DPPO if on_a_gpu(options) else {}) | options.dppo


def judging_stage(options: argparse.Namespace, policy: Trained, stage: str) -> Stage:
    """Stock lerobot-eval of ``imitation`` or ``finetune``, from the table."""
    trained = options.output_dir / f"{stage}_{policy.name}"
    out = options.output_dir / f"eval_{trained.name}"
    judging = (
        *task_flags(options, policy.pair),
        f"--env.backend={options.backend}",
        f"--policy.path={trained_policy(trained)}",
        f"--policy.device={options.device}",
        "--env.video_episodes=0",
        f"--env.metrics_path={out / 'episodes.jsonl'}",
    )
    counts = options.episodes, options.eval_envs, first_seed(policy)
    return evaluation_stage(f"Evaluate {trained.name}", judging, out, *counts, (trained.name,))


def shared_stages(options: argparse.Namespace, policy: Trained) -> list[Stage]:
    """What several policies use."""
    encoder = [encoder_stage(options, policy.pair)] if trains_encoder(options) else []
    return [*encoder, record_stage(options, policy)]


def stages(options: argparse.Namespace, policy: Trained) -> list[Stage]:
    """All of one policy's. Random weights are not judged before DPPO."""
    before = [*shared_stages(options, policy), imitation_stage(options, policy)]
    if policy.demonstrations:
        before.append(judging_stage(options, policy, "imitation"))
    if uses_bank(options, policy):
        before.append(bank_stage(options, policy))
    return [*before, finetune_stage(options, policy), judging_stage(options, policy, "finetune")]
