"""``vtrefine-finetune``: improve a vt_dp3 checkpoint by reinforcement learning in simulation (DPPO).

example:
  vtrefine-finetune --config_path=vtrefine:round_grasped --policy.device=cpu --dppo.type=small \\
      --policy.path=outputs/pretrain/checkpoints/last/pretrained_model --output_dir=outputs/finetune

--policy.path=FOLDER names the checkpoint to start from, --dppo.type a preset: trust_region (many
worlds on a GPU), fine (the same for tight or gentle tasks and imitations that often succeed), small (a
laptop) or paper. Ctrl-C and SIGTERM let the iteration that runs be finished and saved, a second one stops at
once; --resume=true continues an interrupted run exactly. A policy that is fine-tuned already may practise
on, say in a diagnosed simulator, with a critic of its own (--output_dir is another one then).
With --push_to_hub=true --repo_id=USER/NAME the result is evaluated by lerobot-eval on unseen seeds and
uploaded, with its processors and a card that says what was found; a finished run is shared by repeating its
command with --resume=true.
"""

import os

from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_vtrefine.cli.errors import after_interrupt, run_cli
from lerobot_vtrefine.cli.hub import check_upload
from lerobot_vtrefine.cli.pipeline.stages import trained_policy
from lerobot_vtrefine.cli.report.results import verdict
from lerobot_vtrefine.cli.report.statistics import proportion
from lerobot_vtrefine.cli.results.provenance import write_provenance
from lerobot_vtrefine.finetune.checkpoint import last_checkpoint
from lerobot_vtrefine.finetune.logger import CSV_NAME, read_progress
from lerobot_vtrefine.finetune.pipeline import FinetunePipelineConfig, run

LEROBOTS_SHARING = ("--push_to_hub=true", "--repo_id=")


@parser.wrap()
def finetune(cfg: FinetunePipelineConfig) -> None:
    """Parse the command line as LeRobot's commands do, and run."""
    _check_sharing(cfg)
    with after_interrupt(lambda: way_on(cfg)):
        run(cfg)
    write_provenance(cfg.output_dir)
    first = os.environ.get("RANK", "0") == "0"
    if first:
        checkpoint = trained_policy(cfg.output_dir)
        print(outcome(cfg))
        print(f"policy: {checkpoint}")
        print(f"evaluate it by lerobot-eval, see it by vtrefine-play, with --policy.path={checkpoint}")
    if cfg.push_to_hub and first:
        from lerobot_vtrefine.cli.card_evaluation import evaluate_and_push

        evaluate_and_push(cfg)


def way_on(cfg: FinetunePipelineConfig) -> str:
    """What to do after an interruption; before the first checkpoint there is nothing to go on from."""
    last = last_checkpoint(cfg.output_dir)
    if last is None:
        return f"no checkpoint yet, by --save_freq={cfg.save_freq}; the same command begins anew"
    return f"the same command with --resume=true goes on from iteration {int(last.name)}"


def outcome(cfg: FinetunePipelineConfig) -> str:
    """Held-out success before and after, in a sentence; DPPO can unlearn, too."""
    rows = {int(row["iteration"]): row for row in read_progress(cfg.output_dir)}
    if 1 not in rows:  # checkpoints may have been moved without it
        return (
            f"{cfg.output_dir / CSV_NAME} does not go back to the start, so nothing is told of the whole run"
        )
    ends = [row for row in (rows.get(0, {}), rows[max(rows)]) if "eval_episodes" in row]
    if len(ends) < 2:
        return "success was not measured before and after; --eval_freq=10 does so"
    counts = [(row["eval_success"], int(row["eval_episodes"])) for row in ends]
    before, after = (proportion(round(rate * episodes), episodes) for rate, episodes in counts)
    return verdict(before, after)


def _check_sharing(cfg: FinetunePipelineConfig) -> None:
    """Refuse, before hours of training, what could not be shared after them."""
    if any(item.startswith(LEROBOTS_SHARING) for item in parser.get_cli_overrides("policy") or ()):
        raise ValueError(
            "share the result with --push_to_hub=true --repo_id=USER/NAME, without policy. before them"
        )
    if cfg.push_to_hub:
        check_upload(cfg.repo_id or "")


@run_cli
def main() -> None:
    """Console entry point."""
    init_logging()
    register_third_party_plugins()
    finetune()


if __name__ == "__main__":
    raise SystemExit(main())
