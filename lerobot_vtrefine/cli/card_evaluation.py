"""What a fine-tuned policy's card reports: one run of ``lerobot-eval`` that anybody can repeat."""

from dataclasses import replace
from pathlib import Path

from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR

from lerobot_vtrefine.cli.arguments import flags
from lerobot_vtrefine.cli.pipeline.stages import Stage, StageRunner, evaluation_stage
from lerobot_vtrefine.cli.sharing import EPISODES, push_policy
from lerobot_vtrefine.envs.config import checked_env
from lerobot_vtrefine.envs.evaluation_note import changed_settings
from lerobot_vtrefine.finetune.pipeline import FinetunePipelineConfig

FIRST_SEED = 9_000_000
"""Of the evaluation of a run with seed 0; further from its training's seeds than any run has episodes."""


def card_stage(cfg: FinetunePipelineConfig, checkpoint: Path) -> Stage:
    """``lerobot-eval`` of a run's checkpoint in the environment that it was tuned in, on seeds of its own.

    A policy that practised from a bank of states is judged from the table.
    """
    assert cfg.policy is not None
    env = replace(checked_env(cfg.env), start_bank=None)
    output = cfg.output_dir / f"evaluation_{checkpoint.name}"
    judging = (
        f"--policy.path={checkpoint / PRETRAINED_MODEL_DIR}",
        f"--policy.device={cfg.policy.device}",
        *flags("env", {"type": cfg.env.type} | changed_settings(env)),
        f"--env.metrics_path={output / EPISODES}",
    )
    episodes, at_once = cfg.eval.n_episodes, cfg.eval.batch_size
    return evaluation_stage(
        "Evaluate for the card", judging, output, episodes, at_once, FIRST_SEED + cfg.seed
    )


def evaluate_and_push(cfg: FinetunePipelineConfig) -> None:
    """Evaluate a finished run's last checkpoint and upload it with a card that says what was found.

    Raises:
        ChildProcessError: ``lerobot-eval`` failed.
    """
    assert cfg.repo_id is not None
    checkpoint = (cfg.output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK).resolve()
    stage = card_stage(cfg, checkpoint)
    StageRunner(cfg.output_dir, [stage]).run()
    push_policy(checkpoint / PRETRAINED_MODEL_DIR, cfg.repo_id, stage.output, private=cfg.private)
