"""vt_dp3 beside LeRobot's ACT and diffusion policy, trained by imitation on the same demonstrations.

    .venv/bin/python scripts/compare_policies.py --seeds 0 1 2 --device=cuda --jobs 12 --backend=warp
    make tables

Demonstrations are recorded once, with colour images. A seed is one of training: every policy trains on these
demonstrations as stock lerobot-train does, then stock lerobot-eval plays it on unseen episodes, the same for
all. Each executes four actions a decision; ACT and the diffusion policy start from scratch, since LeRobot
would download the weights of their image network, and ACT with a learning rate that suits that. Finished
stages are not repeated: interrupted, or called again with more seeds or policies, it continues. Each
evaluation becomes a row of results/policies.json. ``--jobs`` runs several policies side by side, on the GPUs
by turns. The diffusion policy needs pip install 'lerobot[diffusion]'.
"""

import argparse
import sys
from pathlib import Path

from runs.side_by_side import run_all

from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.pipeline.demo_config import EVAL_SEED_OFFSET
from lerobot_vtrefine.cli.pipeline.stages import Stage, StageRunner, evaluation_stage, trained_policy
from lerobot_vtrefine.cli.report.results import load_evaluation
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Run
from lerobot_vtrefine.cli.results.store import check_results, save
from lerobot_vtrefine.finetune.distributed import check_device
from lerobot_vtrefine.shipped import PREFIX, find

RESULTS = Path(__file__).parents[1] / "results" / "policies.json"
FOUR_ACTIONS = "--policy.n_action_steps=4"
SCRATCH = "--policy.pretrained_backbone_weights=null"
POLICIES: dict[str, tuple[str, ...]] = {
    "vt_dp3_pads": ("vt_dp3_pads",),
    "vt_dp3_pads_visual": ("vt_dp3_pads", "--policy.modalities=visual"),
    "act_rgb": (
        "act_rgb",
        FOUR_ACTIONS,
        SCRATCH,
        "--policy.optimizer_lr=1e-4",
        "--policy.optimizer_lr_backbone=1e-4",
    ),
    "diffusion_rgb": ("diffusion_rgb", FOUR_ACTIONS, SCRATCH),
}
"""A file of configs/policy, and flags beside it. vt_dp3_pads executes four actions by itself."""


def record_stage(options: argparse.Namespace) -> Stage:
    """The demonstrations."""
    root = options.output_dir / "demos"
    command = (
        "vtrefine-record-demos",
        f"--config_path={PREFIX}{options.task}",
        "--env.rgb=true",
        f"--root={root}",
        f"--num_episodes={options.num_demos}",
        f"--num_workers={options.workers}",
        "--seed=0",
        "--degradation.lateral_std_m=0.0008",
        "--degradation.tilt_std_rad=0.0175",
    )
    return Stage("record", "Record", command, root, root / "meta" / "info.json", resumable=True)


def policy_stages(options: argparse.Namespace, policy: str, seed: int) -> list[Stage]:
    """Training and evaluation of one policy."""
    name = f"{policy}_{seed}"
    out, judged = options.output_dir / name, options.output_dir / f"eval_{name}"
    checkpoint = trained_policy(out)
    config, *flags = POLICIES[policy]
    train = (
        "lerobot-train",
        f"--config_path={PREFIX}{config}",
        *flags,
        "--dataset.repo_id=local/vtrefine_demos",
        f"--dataset.root={options.output_dir / 'demos'}",
        f"--policy.device={options.device}",
        f"--output_dir={out}",
        f"--steps={options.steps}",
        f"--save_freq={options.steps}",
        f"--batch_size={options.batch_size}",
        f"--seed={seed}",
        "--num_workers=0",  # items come from memory
        "--env_eval_freq=0",
    )
    judging = (
        f"--config_path={PREFIX}{options.task}",
        f"--policy.path={checkpoint}",
        f"--policy.device={options.device}",
        f"--env.backend={options.backend}",
        f"--env.rgb={str(config.endswith('_rgb')).lower()}",
        "--env.video_episodes=0",
        f"--env.metrics_path={judged / 'episodes.jsonl'}",
    )
    trained, counts = f"train_{name}", (options.episodes, options.eval_envs, EVAL_SEED_OFFSET)
    return [
        Stage(trained, f"Train {name}", train, out, checkpoint / "model.safetensors", ("record",)),
        evaluation_stage(f"Evaluate {name}", judging, judged, *counts, (trained,)),
    ]


def row(options: argparse.Namespace, policy: str, seed: int, commit: str | None) -> Run:
    """What an evaluation found; ``commit`` of the code that trained the policy."""
    found = load_evaluation(options.output_dir / f"eval_{policy}_{seed}", EVAL_SEED_OFFSET)
    return Run(
        table="policies",
        task=options.task,
        policy=policy,
        variant=f"{options.num_demos} demonstrations, {options.steps} steps of {options.batch_size}",
        seed=seed,
        success=found["success"] / found["episodes"],
        episodes=found["episodes"],
        iterations=0,
        env_steps=0,
        commit=commit or options.commit,
        command=provenance()["command"],
        machine=provenance()["machine"],
    )


def make_parser() -> CommandParser:
    """The command line."""
    parser = CommandParser(description=__doc__)
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0, 1, 2], help="of training (default: %(default)s)"
    )
    parser.add_argument(
        "--policies", nargs="+", choices=list(POLICIES), default=list(POLICIES), help="default: all"
    )
    parser.add_argument("--task", default="round_grasped", help="a file of configs/env (default %(default)s)")
    parser.add_argument("--num_demos", type=at_least(1), default=200, help="default %(default)s")
    parser.add_argument("--steps", type=at_least(1), default=5000, help="of training (default %(default)s)")
    parser.add_argument("--batch_size", type=at_least(1), default=64, help="default %(default)s")
    parser.add_argument(
        "--episodes", type=at_least(1), default=500, help="of an evaluation (default %(default)s)"
    )
    parser.add_argument(
        "--device", default="cuda", help="of the networks: cpu or cuda (default: %(default)s)"
    )
    parser.add_argument("--backend", choices=["batch", "warp"], default="batch", help="of the evaluation")
    parser.add_argument("--eval_envs", type=at_least(1), default=50, help="episodes evaluated at once")
    parser.add_argument("--workers", type=int, default=0, help="processes that record (default none)")
    parser.add_argument("--jobs", type=at_least(1), default=1, help="policies side by side (default 1)")
    parser.add_argument("--commit", help="of the code, where no checkout tells it")
    parser.add_argument(
        "--output_dir",
        type=Path,
        default=Path("outputs/compare_policies"),
        help="of all runs (default: %(default)s)",
    )
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of the rows")
    return parser


def alone(options: argparse.Namespace, policy: str, seed: int) -> list[str]:
    """This script's command line for one policy."""
    chosen = vars(options) | {"policies": policy, "seeds": seed, "jobs": 1}
    words = [
        word for name, value in chosen.items() if value is not None for word in (f"--{name}", str(value))
    ]
    return [sys.executable, __file__, *words]


@run_cli
def main() -> None:
    """Run what is not done yet; every evaluation becomes a row as soon as it is there."""
    options = make_parser().parse_args()
    find("--config_path", options.task)  # a misspelt name is told now
    check_results("--results", options.results)
    check_device(options.device)
    record = record_stage(options)
    StageRunner(options.output_dir, [record]).run()
    runs = [(policy, seed) for policy in options.policies for seed in options.seeds]  # GPUs by turns
    if options.jobs > 1:
        names = {run: options.output_dir / "_".join(map(str, run)) for run in runs}
        run_all({folder: alone(options, *run) for run, folder in names.items()}, options.jobs)
        return
    for run in runs:
        _, trained, _ = StageRunner(options.output_dir, [record, *policy_stages(options, *run)]).run()
        save(options.results, [(row(options, *run, trained.commit), [])], replace=False)


if __name__ == "__main__":
    raise SystemExit(main())
