"""The demo's stages: the command lines that its numbers make."""

from lerobot_vtrefine.cli.arguments import flags
from lerobot_vtrefine.cli.pipeline.demo_config import REPO_ID, SEED_STRIDE, TRAIN_SEED_OFFSET, DemoConfig
from lerobot_vtrefine.cli.pipeline.stages import Stage


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


def evaluation_stage(config: DemoConfig, policy: str, ablation: str = "none") -> Stage:
    """LeRobot's own evaluation on unseen seeds, optionally with one sense replaced by its mean."""
    output = config.evaluation_dir(policy, ablation)
    episodes = config.eval_episodes if ablation == "none" else config.ablation_episodes
    command = [
        "lerobot-eval",
        f"--policy.path={config.checkpoint(policy)}",
        f"--policy.device={config.device}",
        *flags("env", {"type": "vtrefine"} | config.task),
        f"--env.metrics_path={output / 'episodes.jsonl'}",
        f"--env.video_episodes={config.videos if ablation == 'none' else 0}",
        f"--eval.n_episodes={episodes}",
        f"--eval.batch_size={min(config.eval_envs, episodes)}",
        f"--seed={config.eval_seed}",
        f"--output_dir={output}",
    ]
    title = {"pretrain": "Evaluate imitation", "finetune": "Evaluate DPPO"}[policy]
    needs = [policy]
    if ablation != "none":
        command += [f"--env.ablate={ablation}", f"--env.ablate_dataset={config.dataset_dir}"]
        title += f" without {ablation}"
        needs.append("record")
    return Stage(output.name, title, tuple(command), output, output / "eval_info.json", tuple(needs))


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
        evaluation_stage(config, "pretrain"),
        finetune_stage(config),
        evaluation_stage(config, "finetune"),
        *(evaluation_stage(config, policy, modality) for policy, modality in config.ablations()),
    ]
