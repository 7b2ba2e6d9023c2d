"""The demo's stages: the command lines that its numbers make."""

from dataclasses import replace

from lerobot_vtrefine.cli.arguments import flags
from lerobot_vtrefine.cli.pipeline.demo_config import REPO_ID, SEED_STRIDE, TRAIN_SEED_OFFSET, DemoConfig
from lerobot_vtrefine.cli.pipeline.stages import Stage, evaluation_stage


def record_stage(config: DemoConfig) -> Stage:
    """Scripted, imperfect demonstrations -> LeRobot dataset."""
    command = [
        "vtrefine-record-demos",
        f"--root={config.dataset_dir}",
        f"--repo_id={REPO_ID}",
        f"--num_episodes={config.num_demos}",
        f"--num_envs={config.demo_envs}",
        f"--seed={config.seed * SEED_STRIDE}",
        *flags("env", {"type": "vtrefine"} | config.task),
        *flags("degradation", config.degradation),
    ]
    product = config.dataset_dir / "meta" / "info.json"
    return Stage(
        "record", "Record demonstrations", tuple(command), config.dataset_dir, product, resumable=True
    )


def pretrain_stage(config: DemoConfig) -> Stage:
    """Imitation learning with LeRobot's own trainer."""
    command = [
        "lerobot-train",
        f"--dataset.repo_id={REPO_ID}",
        f"--dataset.root={config.dataset_dir}",
        *flags("policy", {"type": "vt_dp3"} | config.policy),
        f"--policy.modalities={config.modalities}",
        f"--policy.device={config.device}",
        "--policy.push_to_hub=false",
        f"--output_dir={config.output_dir / 'pretrain'}",
        f"--steps={config.pretrain_steps}",
        f"--save_freq={config.pretrain_steps}",
        f"--batch_size={config.pretrain_batch}",
        "--num_workers=0",
        "--log_freq=100",
        "--env_eval_freq=0",
        f"--seed={config.seed}",
    ]
    product = config.checkpoint("pretrain") / "model.safetensors"
    return Stage(
        "pretrain",
        "Imitation learning (lerobot-train)",
        tuple(command),
        config.output_dir / "pretrain",
        product,
        ("record",),
    )


def judging_stage(config: DemoConfig, policy: str, ablation: str = "none") -> Stage:
    """LeRobot's own evaluation on unseen seeds, optionally with one sense replaced by its mean."""
    output, whole = config.evaluation_dir(policy, ablation), ablation == "none"
    judging = [
        f"--policy.path={config.checkpoint(policy)}",
        f"--policy.device={config.device}",
        *flags("env", {"type": "vtrefine"} | config.task),
        f"--env.metrics_path={output / 'episodes.jsonl'}",
        f"--env.video_episodes={config.videos if whole else 0}",
    ]
    title = {"pretrain": "Evaluate imitation", "finetune": "Evaluate DPPO"}[policy]
    episodes = config.eval_episodes if whole else config.ablation_episodes
    stage = evaluation_stage(title, judging, output, episodes, config.eval_envs, config.eval_seed, (policy,))
    if whole:
        return stage
    ablated = (f"--env.ablate={ablation}", f"--env.ablate_dataset={config.dataset_dir}")
    return replace(
        stage,
        title=f"{title} without {ablation}",
        command=stage.command + ablated,
        needs=(policy, "record"),
    )


def finetune_stage(config: DemoConfig) -> Stage:
    """DPPO from the pre-trained checkpoint."""
    command = [
        "vtrefine-finetune",
        f"--policy.path={config.checkpoint('pretrain')}",
        f"--policy.device={config.device}",
        *flags("env", {"type": "vtrefine"} | config.env),
        *flags("dppo", config.dppo),
        f"--dppo.iterations={config.finetune_iterations}",
        f"--dppo.num_envs={config.finetune_envs}",
        f"--seed={config.seed * SEED_STRIDE + TRAIN_SEED_OFFSET}",
        f"--output_dir={config.output_dir / 'finetune'}",
        "--resume=true",
    ]
    product = config.checkpoint("finetune") / "model.safetensors"
    return Stage(
        "finetune",
        "DPPO fine-tuning",
        tuple(command),
        config.output_dir / "finetune",
        product,
        ("pretrain",),
        resumable=True,
    )


def demo_stages(config: DemoConfig) -> list[Stage]:
    """All stages in the order in which they run."""
    return [
        record_stage(config),
        pretrain_stage(config),
        judging_stage(config, "pretrain"),
        finetune_stage(config),
        judging_stage(config, "finetune"),
        *(judging_stage(config, policy, modality) for policy, modality in config.ablations()),
    ]
