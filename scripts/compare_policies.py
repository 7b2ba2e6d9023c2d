#!/usr/bin/env python
"""vt_dp3 beside LeRobot's ACT and diffusion policy, trained by imitation on the same demonstrations.

    .venv/bin/python scripts/compare_policies.py --seeds 0 1 2 --device=cuda
    make tables

Demonstrations of each seed are recorded once, with colour images; every policy is a configuration of
configs/policy and trains on them as stock lerobot-train does, then stock lerobot-eval plays it on unseen
seeds. Finished stages are not repeated: interrupted, or called again with more seeds or policies, it
continues. Each evaluation becomes a row of results/policies.json. The diffusion policy needs
pip install 'lerobot[diffusion]'.
"""

import argparse
from pathlib import Path

from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.pipeline.stages import Stage, StageRunner
from lerobot_vtrefine.cli.report.results import load_evaluation
from lerobot_vtrefine.cli.results.collect import save
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Run
from lerobot_vtrefine.cli.results.tables import IMITATION
from lerobot_vtrefine.shipped import PREFIX, find

RESULTS = Path(__file__).parents[1] / "results" / "policies.json"
POLICIES = ("vt_dp3_paper", "vt_dp3_visual", "act_rgb", "diffusion_rgb")
SEED_STRIDE = 10_000_000
"""Between the demonstrations of two seeds, which then share no episode."""
FIRST_EVALUATION_SEED = 8_000_000


def record_stage(options: argparse.Namespace, seed: int) -> Stage:
    """The demonstrations of a seed."""
    root = options.output_dir / f"demos_{seed}"
    command = (
        "vtrefine-record-demos",
        f"--config_path={PREFIX}{options.task}",
        "--env.rgb=true",
        f"--root={root}",
        f"--num_episodes={options.num_demos}",
        f"--seed={seed * SEED_STRIDE}",
        "--degradation.lateral_std_m=0.0008",
        "--degradation.tilt_std_rad=0.0175",
    )
    name = f"record_{seed}"
    return Stage(name, f"Record seed {seed}", command, root, root / "meta" / "info.json", resumable=True)


def policy_stages(options: argparse.Namespace, policy: str, seed: int) -> list[Stage]:
    """Training and evaluation of one policy on the demonstrations of a seed."""
    name = f"{policy}_{seed}"
    out, judged = options.output_dir / name, options.output_dir / f"eval_{name}"
    checkpoint = out / "checkpoints" / "last" / "pretrained_model"
    train = (
        "lerobot-train",
        f"--config_path={PREFIX}{policy}",
        "--dataset.repo_id=local/vtrefine_demos",
        f"--dataset.root={options.output_dir / f'demos_{seed}'}",
        f"--policy.device={options.device}",
        f"--output_dir={out}",
        f"--steps={options.steps}",
        f"--save_freq={options.steps}",
        f"--batch_size={options.batch_size}",
        f"--seed={seed}",
        "--env_eval_freq=0",
    )
    evaluate = (
        "lerobot-eval",
        f"--config_path={PREFIX}{options.task}",
        f"--policy.path={checkpoint}",
        f"--policy.device={options.device}",
        f"--env.rgb={str(policy.endswith('_rgb')).lower()}",
        "--env.video_episodes=3",
        f"--env.metrics_path={judged / 'episodes.jsonl'}",
        f"--eval.n_episodes={options.episodes}",
        f"--eval.batch_size={min(50, options.episodes)}",
        f"--seed={seed * SEED_STRIDE + FIRST_EVALUATION_SEED}",
        f"--output_dir={judged}",
    )
    trained, needs = f"train_{name}", (f"record_{seed}",)
    return [
        Stage(trained, f"Train {policy}, seed {seed}", train, out, checkpoint / "model.safetensors", needs),
        Stage(
            f"eval_{name}",
            f"Evaluate {policy}, seed {seed}",
            evaluate,
            judged,
            judged / "eval_info.json",
            (trained,),
        ),
    ]


def row(options: argparse.Namespace, policy: str, seed: int) -> Run:
    """What an evaluation found."""
    first = seed * SEED_STRIDE + FIRST_EVALUATION_SEED
    found = load_evaluation(options.output_dir / f"eval_{policy}_{seed}", first)
    origin = provenance()
    return Run(
        table="policies",
        task=options.task,
        policy=policy,
        variant=f"{IMITATION}, {options.num_demos} demonstrations, {options.steps} steps",
        seed=seed,
        success=found["success"] / found["episodes"],
        episodes=found["episodes"],
        iterations=0,
        env_steps=0,
        commit=origin["commit"],
        command=origin["command"],
        machine=origin["machine"],
    )


def make_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--policies", nargs="+", default=list(POLICIES), metavar="NAME")
    parser.add_argument("--task", default="round_grasped", help="a file of configs/env (default %(default)s)")
    parser.add_argument("--num_demos", type=int, default=100)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--batch_size", type=int, default=64)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/compare_policies"))
    parser.add_argument("--results", type=Path, default=RESULTS)
    return parser


@run_cli
def main() -> None:
    """Run what is not done yet; every evaluation becomes a row as soon as it is there."""
    options = make_parser().parse_args()
    for name in (options.task, *options.policies):
        find("--config_path", name)  # a misspelt name is told now
    for seed in options.seeds:
        for policy in options.policies:
            stages = [record_stage(options, seed), *policy_stages(options, policy, seed)]
            StageRunner(options.output_dir, stages).run()
            save(options.results, "policies", [(row(options, policy, seed), [])], replace=False)


if __name__ == "__main__":
    raise SystemExit(main())
