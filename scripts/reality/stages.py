"""Commands of a comparison: what makes a simulator, what is learnt in it, and where that is judged."""

import json
from dataclasses import replace
from pathlib import Path

from lerobot_vtrefine.cli.arguments import flags
from lerobot_vtrefine.cli.pipeline.demo_config import SEED_STRIDE, TRAIN_SEED_OFFSET
from lerobot_vtrefine.cli.pipeline.demo_stages import pretrain_stage, record_stage
from lerobot_vtrefine.cli.pipeline.stages import Stage, evaluation_stage, trained_policy
from reality.budget import Budget, folder_name, recipe, world_env
from reality.hidden import of_robot

MOTION_SEED_OFFSET = 500_000
"""Between the seeds of demonstrations and those of fine-tuning."""
MOTION_S, MOTION_HZ = 14, 10
"""Of one motion of a hidden robot."""


def env_flags(budget: Budget, world: str) -> list[str]:
    """The environment's flags of a world."""
    return flags("env", {"type": "vtrefine"} | world_env(budget, world))


def imitation_stages(budget: Budget, world: str) -> list[Stage]:
    """What fine-tuning in a simulator starts from: its encoder, demonstrations, and the policy they teach."""
    config = recipe(budget, budget.seeds[0], world)
    encoder = [encoder_stage(budget, world)] if budget.own_encoder else []
    record = record_stage(config)
    command = (*(word for word in record.command if not word.startswith("--env.")), *env_flags(budget, world))
    record = replace(
        record, name=folder_name("record", world), command=command, needs=diagnosis_needed(world)
    )
    needs = (record.name, *(stage.name for stage in encoder))
    return [
        *encoder,
        record,
        replace(pretrain_stage(config), name=folder_name("pretrain", world), needs=needs),
    ]


def diagnosis_needed(world: str) -> tuple[str, ...]:
    """The stage that makes a simulator, where one does."""
    name = world.partition(":")[2]
    return (output_name(name),) if name else ()


def encoder_stage(budget: Budget, world: str) -> Stage:
    """What the policy sees and feels with."""
    output = budget.encoder(world)
    command = (
        "vtrefine-information",
        *env_flags(budget, world),
        "--senses=[visuo_tactile]",
        f"--effort.device={budget.device}",
        f"--effort.episodes={budget.encoder_episodes}",
        f"--effort.num_envs={min(budget.envs, budget.encoder_episodes // 2)}",
        f"--effort.steps={budget.encoder_steps}",
        "--effort.history=[1]",
        "--effort.closed_loop_episodes=0",
        "--effort.tolerance_episodes=0",
        f"--output_dir={output}",
    )
    title = f"Train the encoder ({world})"
    return Stage(output.name, title, command, output, output / "information.json", diagnosis_needed(world))


def diagnosis_stages(budget: Budget, name: str) -> list[Stage]:
    """Recordings in a stand-in reality, and what diagnosis makes of them."""
    output = budget.diagnosis(name)
    recorded = motion_stage(budget, name) if of_robot(name) else press_stage(budget, name)
    source = "dataset.root" if of_robot(name) else "recording"
    diagnose = ("vtrefine-diagnose", f"--{source}={recorded.output}", f"--output_dir={output}")
    product = output / "verdict.json"
    return [
        recorded,
        Stage(output_name(name), f"Diagnose {name}", diagnose, output, product, (recorded.name,)),
    ]


def press_stage(budget: Budget, name: str) -> Stage:
    """Presses of a hidden pad."""
    folder = budget.output_dir / folder_name(name)
    press = ("vtrefine-press", f"--reality={folder / 'reality.json'}", f"--trials={budget.presses}")
    press, output = (*press, f"--output_dir={folder / 'presses'}"), folder / "presses"
    return Stage(f"press_{folder.name}", f"Press the pad of {name}", press, output, output / "recording.json")


def motion_stage(budget: Budget, name: str) -> Stage:
    """Motions of a hidden robot, recorded as a real one's are: by stock lerobot-record, in real time."""
    output = budget.output_dir / folder_name(name) / "motions"
    whole = {"start": "table", "episode_steps": MOTION_S * MOTION_HZ}  # the recorder stops where episodes end
    env = world_env(budget, f"real:{name}") | whole
    command = (
        "lerobot-record",
        "--robot.type=vtrefine_sim",
        f"--robot.env={json.dumps({key: value for key, value in env.items() if key != 'backend'})}",
        f"--robot.seed={budget.seeds[0] * SEED_STRIDE + MOTION_SEED_OFFSET}",
        "--teleop.type=vtrefine_ee",
        "--teleop.input=excitation",
        "--dataset.repo_id=local/motions",
        f"--dataset.root={output}",
        f"--dataset.num_episodes={budget.motions}",
        f"--dataset.episode_time_s={MOTION_S}",
        "--dataset.reset_time_s=0",
        f"--dataset.fps={MOTION_HZ}",
        "--dataset.single_task=move",
        "--dataset.video=false",
        "--dataset.push_to_hub=false",
        "--play_sounds=false",
    )
    stage, title = f"record_{folder_name(name)}", f"Record the robot of {name}"
    return Stage(stage, title, command, output, output / "meta" / "info.json")


def output_name(name: str) -> str:
    """Name of a diagnosis' stage."""
    return f"diagnose_{folder_name(name)}"


def finetune_dir(budget: Budget, world: str, seed: int) -> Path:
    """Folder of one fine-tuning."""
    return budget.output_dir / folder_name("finetune", world, str(seed))


def finetune_stage(budget: Budget, world: str, seed: int) -> Stage:
    """DPPO in a simulator, from the imitation learned there."""
    config, output = recipe(budget, seed, world), finetune_dir(budget, world, seed)
    command = (
        "vtrefine-finetune",
        f"--policy.path={budget.imitation(world)}",
        f"--policy.device={budget.device}",
        *env_flags(budget, world),
        *flags("dppo", config.dppo),
        f"--dppo.iterations={budget.iterations}",
        f"--dppo.num_envs={budget.envs}",
        f"--seed={seed * SEED_STRIDE + TRAIN_SEED_OFFSET}",
        f"--output_dir={output}",
        "--resume=true",
    )
    product = trained_policy(output) / "model.safetensors"
    title, needs = f"Fine-tune in {world}, seed {seed}", (folder_name("pretrain", world),)
    return Stage(output.name, title, command, output, product, needs, resumable=True)


def evaluation_dir(budget: Budget, trained: str, world: str, seed: int) -> Path:
    """Where an evaluation leaves its results."""
    return budget.output_dir / folder_name("eval", trained, "in", world, str(seed))


def judging_stage(budget: Budget, trained: str, world: str, seed: int) -> Stage:
    """A policy, named by the world that it was fine-tuned in, on this seed's episodes of a world."""
    output, tuned = evaluation_dir(budget, trained, world, seed), finetune_dir(budget, trained, seed)
    judging = (
        f"--policy.path={trained_policy(tuned)}",
        f"--policy.device={budget.device}",
        *env_flags(budget, world),
        f"--env.metrics_path={output / 'episodes.jsonl'}",
        "--env.video_episodes=0",
    )
    counts = budget.eval_episodes, budget.eval_envs, recipe(budget, seed).eval_seed
    title = f"Evaluate {trained} in {world}, seed {seed}"
    return evaluation_stage(title, judging, output, *counts, (tuned.name,))
