"""``vtrefine-demo``: run demonstrations, imitation, DPPO and evaluations, and write a report of them.

examples:
  vtrefine-demo --quick                        # minutes: tiny numbers, to see that everything works here
  vtrefine-demo                                # about ten minutes on two cores
  vtrefine-demo --config_path=vtrefine:kinova_round_grasped --recipe=cloud --output_dir=outputs/demo_kinova
  vtrefine-demo --output_dir=outputs/square --env='{pair: square, clearance_m: 0.001, start: grasped}'

Interrupted, the same command continues. --quick stands for tiny numbers and --output_dir=outputs/demo_quick;
other flags still change them.
"""

import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

import draccus

from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.pipeline.demo_config import QUICK, DemoConfig
from lerobot_vtrefine.cli.pipeline.demo_stages import demo_stages
from lerobot_vtrefine.cli.pipeline.stages import StageRecord, StageRunner

QUICK_FLAG = "--quick"
GIF_WIDTH = 480
GIF_EVERY = 2

logger = logging.getLogger(__name__)


def parse_config(arguments: Sequence[str]) -> DemoConfig:
    """The configuration; ``--quick`` stands for tiny numbers, which later flags may still change."""
    given = [argument for argument in arguments if argument != QUICK_FLAG]
    preset = list(QUICK) if QUICK_FLAG in arguments else []
    return draccus.parse(DemoConfig, args=[*preset, *given])


def write_report(config: DemoConfig, records: Sequence[StageRecord]) -> Path:
    """Write ``results.json``, ``report.html`` and, given a video, ``demo.gif``; return the page's path."""
    from lerobot_vtrefine.cli.report.page import render_page
    from lerobot_vtrefine.cli.report.results import collect_results

    results = collect_results(config, records)
    text = json.dumps(results, indent=2)
    (config.output_dir / "results.json").write_text(text + "\n", encoding="utf-8")
    page = render_page(results, config.dataset_dir, config.output_dir / "finetune" / "progress.csv")
    path = config.output_dir / "report.html"
    path.write_text(page, encoding="utf-8")
    make_gif(config, results["finetune"]["videos"])
    print(results["summary"])
    return path


def make_gif(config: DemoConfig, videos: Sequence[dict[str, object]]) -> None:
    """A GIF of the first successful episode of the fine-tuned policy, for READMEs."""
    from lerobot_vtrefine.cli.report.gif import write_gif
    from lerobot_vtrefine.cli.report.media import shortened

    for video in videos:
        if video["success"] and Path(str(video["path"])).is_file():
            frames, frame_ms = shortened(Path(str(video["path"])), GIF_WIDTH, GIF_EVERY)
            write_gif([frames], frame_ms, config.output_dir / "demo.gif")
            return


def run_demo(config: DemoConfig) -> Path:
    """Run every stage that is not done yet and write the report; return the page's path.

    Raises:
        ValueError: a GPU is asked for and there is none; the stages would take the processor and not say so.
    """
    from lerobot_vtrefine.finetune.distributed import check_device

    check_device(config.device)
    config.output_dir.mkdir(parents=True, exist_ok=True)
    runner = StageRunner(config.output_dir, demo_stages(config))
    print(
        f"{len(runner.stages)} stages into {config.output_dir}; interrupt and run again to continue",
        flush=True,
    )
    return write_report(config, runner.run())


@run_cli
def main() -> None:
    """Console entry point."""
    path = run_demo(parse_config(sys.argv[1:]))
    print(f"report: {path}")


if __name__ == "__main__":
    raise SystemExit(main())
