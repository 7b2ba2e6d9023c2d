"""Does diagnosis pay where it matters, in the policy? Train in the plain and in the diagnosed simulator.

    .venv/bin/python scripts/compare_reality.py --seeds 0 1 2
    .venv/bin/python scripts/compare_reality.py --seeds 0 1 2 3 4 5 --jobs 24 --device=cuda
    .venv/bin/python scripts/compare_reality.py --task=cross_gentle --recipe=pads --num_demos=300 \\
        --realities row_sharing+hysteresis+drift --device=cuda --env='{"backend": "warp"}'

A simulation with hidden physics stands in for reality (``--env.reality``); nothing is ever trained in it. The
same recipe (an encoder where the policy has one, demonstrations by the scripted expert, imitation, DPPO) is
followed in the plain simulator and in the one that ``vtrefine-diagnose`` made from recordings: presses of the
hidden pad, or motions of the hidden robot. Budgets and seeds are the same. All policies are then evaluated
in the stand-in reality and in their own simulator, on the same episodes. Every stage is a command that users
run; interrupted and started again, it continues. With ``--jobs`` several run side by side, each on cores of
its own and on the GPUs by turns; one that fails does not stop the others, and the comparison is of the seeds
that are whole. Results: ``comparison.json`` and ``comparison.md``.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from reality.budget import Budget, write_worlds
from reality.hidden import REALITIES
from reality.lanes import Lanes, lanes, needed
from reality.outcome import compare
from reality.telling import as_text
from runs.comparison import save
from runs.side_by_side import run_all

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.pipeline.demo_config import RECIPES, default_degradation
from lerobot_vtrefine.cli.pipeline.stages import StageRunner
from lerobot_vtrefine.cli.results.provenance import write_provenance
from lerobot_vtrefine.files import read_yaml
from lerobot_vtrefine.finetune.distributed import check_device
from lerobot_vtrefine.shipped import find


def parse() -> tuple[argparse.Namespace, Budget]:
    """Options, and the budget among them."""
    parser = CommandParser(description=__doc__)
    parser.add_argument(
        "--output_dir", type=Path, default=Path("outputs/compare_reality"), help="default: %(default)s"
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0, 1, 2], help="of fine-tuning and its episodes"
    )
    parser.add_argument(
        "--jobs", type=int, default=1, help="runs side by side, each on its share of the cores"
    )
    parser.add_argument(
        "--realities",
        nargs="+",
        choices=list(REALITIES),
        default=list(REALITIES),
        help="what is hidden (default: all)",
    )
    parser.add_argument("--device", default="cpu", help="of the networks: cpu or cuda")
    parser.add_argument("--env", type=json.loads, default={}, help="more flags of the environment, as JSON")
    for name, default in (
        ("num_demos", 80),
        ("pretrain_steps", 1000),
        ("iterations", 20),
        ("envs", 128),
        ("eval_episodes", 200),
        ("eval_envs", 50),
        ("presses", 16),
        ("motions", 12),
    ):
        parser.add_argument(f"--{name}", type=int, default=default, help=f"default {default}")
    parser.add_argument("--lane", help=argparse.SUPPRESS)
    parser.add_argument("--task", help="a file of configs/env (default: the demo's task)")
    parser.add_argument("--recipe", choices=list(RECIPES), default=Budget.recipe, help="as vtrefine-demo's")
    for name, words in (("policy", "policy"), ("dppo", "update")):
        parser.add_argument(f"--{name}", type=json.loads, default={}, help=f"flags of the {words}, as JSON")
    parser.add_argument(
        "--degradation",
        type=json.loads,
        default=default_degradation(),
        help="the expert's imperfections, as JSON; {} for none (default %(default)s)",
    )
    for name in ("encoder_episodes", "encoder_steps"):
        default = getattr(Budget, name)
        parser.add_argument(f"--{name}", type=int, default=default, help=f"of recipe pads; default {default}")
    options = parser.parse_args()
    if options.jobs < 1:
        parser.error(f"--jobs must be at least 1, got {options.jobs}")
    if options.task:
        own = read_yaml(find("--config_path", options.task))["env"]
        options.env = {name: value for name, value in own.items() if name != "type"} | options.env
    fields: dict[str, Any] = {name: getattr(options, name) for name in Budget.__dataclass_fields__}
    fields["realities"], fields["seeds"] = tuple(options.realities), tuple(options.seeds)
    return options, Budget(**fields)


@run_cli
def main() -> None:
    """Prepare, run every policy, compare."""
    options, budget = parse()
    check_device(budget.device)
    before, policies = lanes(budget)
    if options.lane is not None:
        check_choice("--lane", options.lane, before | policies)
        StageRunner(budget.output_dir, (before | policies)[options.lane]).run()
        return
    write_worlds(budget)
    failed = run_lanes(budget, before, policies, options.jobs)
    results = compare(budget)
    save(budget.output_dir, results, as_text(results))
    write_provenance(budget.output_dir)
    if failed is not None:
        raise failed


def run_lanes(
    budget: Budget, before: Lanes, policies: Lanes, jobs: int
) -> subprocess.CalledProcessError | None:
    """Run these lanes, as many side by side; one of the failures, if there was any."""
    folder, again = budget.output_dir, [sys.executable, str(Path(__file__)), *sys.argv[1:]]
    commands = {folder / name: [*again, f"--lane={name}"] for name in before | policies}
    needs = {
        folder / name: [folder / world for world in worlds]
        for name, worlds in needed(before, policies).items()
    }
    try:
        run_all(commands, jobs, needs)
    except subprocess.CalledProcessError as error:
        return error
    return None


if __name__ == "__main__":
    raise SystemExit(main())
