"""``vtrefine-finetune``: improve a vt_dp3 checkpoint by reinforcement learning in simulation (DPPO).

example:
  vtrefine-finetune --config_path=vtrefine:round_grasped --policy.device=cpu --dppo.type=small \\
      --policy.path=outputs/pretrain/checkpoints/last/pretrained_model --output_dir=outputs/finetune

--policy.path=FOLDER names the checkpoint to start from, --dppo.type a preset: paper, seed_literal,
trust_region (many worlds on a GPU) or small (a laptop). --resume=true continues an interrupted run exactly.
"""

from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.provenance import write_provenance
from lerobot_vtrefine.finetune.pipeline import FinetunePipelineConfig, run


@parser.wrap()
def finetune(cfg: FinetunePipelineConfig) -> None:
    """Parse the command line as LeRobot's commands do, and run."""
    run(cfg)
    write_provenance(cfg.output_dir)


@run_cli
def main() -> None:
    """Console entry point."""
    init_logging()
    register_third_party_plugins()
    finetune()


if __name__ == "__main__":
    raise SystemExit(main())
