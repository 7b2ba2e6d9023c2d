"""The reference implementation of DPPO beside this one, from one checkpoint, on one task.

    git clone https://github.com/irom-princeton/dppo DPPO
    python scripts/compare_reference_dppo.py losses --reference=DPPO --policy=IMITATION/pretrained_model
    python scripts/compare_reference_dppo.py train --reference=DPPO --policy=IMITATION/pretrained_model \\
        --worlds=1024 --iterations=101 --device=cuda

``losses`` prints, term by term, how far the reference's loss and ours lie apart on chains that were sampled
here, for our preset ``paper`` and for the reference's own sampler. ``train`` runs the reference's agent, its
loop, loss, critic, optimisers and schedules unchanged, with the hyper-parameters of its furniture tasks, on
our environment and our network; then ours, with each of --dppo. Rows, of the last evaluation of each, and
learning curves are added to results/reference.json.

``reference/insertion/theirs.py`` says what the reference sees of our environments.
"""

import argparse
import dataclasses
import json
from pathlib import Path

from reference.checkout import Reference
from reference.insertion.losses import compare
from reference.insertion.ours import preset, train_ours
from reference.insertion.theirs import train_reference

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.collect import largest_fall, read_json_or_none, steps_to
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Row, Run
from lerobot_vtrefine.cli.results.store import save
from lerobot_vtrefine.finetune.pipeline import Practice

ROOT = Path(__file__).parents[1]
TASK = ROOT / "configs" / "env" / "round_grasped.yaml"
BATCH_ROWS = 17600
"""Rows, of a decision and a denoising step each, of one of the reference's minibatches."""


def row_of(variant: str, practice: Practice, curve: list[dict[str, float]], args: argparse.Namespace) -> Run:
    """The last evaluation, where the run was then."""
    last = [row for row in curve if "eval_success" in row][-1]
    return Run(
        table="reference",
        task=args.task.stem,
        policy=practice.policy.config.modalities,
        variant=variant,
        seed=args.seed,
        success=last["eval_success"],
        episodes=args.worlds,
        iterations=int(last["iteration"]),
        env_steps=int(last["env_steps"]),
        extra={
            "largest_fall": largest_fall(curve),
            "seconds": round(curve[-1]["seconds"], 1),
            **steps_to(curve),
        },
        **provenance(),
    )


def train(args: argparse.Namespace) -> None:
    """The reference, then ours."""
    found: list[tuple[Row, list[dict[str, float]]]] = []
    if not args.skip_reference:
        practice, curve = train_reference(args, Reference(args.reference))
        found.append((row_of("reference DPPO", practice, curve, args), curve))
    for name in filter(None, args.dppo.split(",")):
        practice, curve = train_ours(name, args)
        found.append((row_of(f"--dppo.type={name}", practice, curve, args), curve))
    save(args.results, found, replace=False)
    print(json.dumps([dataclasses.asdict(row) for row, _ in found], indent=2))


def losses(args: argparse.Namespace) -> None:
    """Prints, per sampler and term, the largest difference and the largest value."""
    reference = Reference(args.reference)
    samplers = {
        "preset paper: the last 10 of 100 steps": (
            preset("paper", args),
            {"use_ddim": False, "ddim_steps": None, "ft_denoising_steps": 10},
        ),
        "furniture: 5 steps of DDIM": (
            preset(
                "paper", args, sampler="ddim", sampler_steps=5, ft_denoising_steps=5, min_sampling_std=0.04
            ),
            {},
        ),
    }
    for name, (cfg, changes) in samplers.items():
        terms = compare(args, reference, cfg, changes)
        print(json.dumps({"sampler": name, "terms": terms}, indent=2), flush=True)


@run_cli
def main() -> None:
    """``losses`` or ``train``."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("what", choices=("losses", "train"))
    parser.add_argument("--reference", type=Path, required=True, help="a checkout of irom-princeton/dppo")
    parser.add_argument("--policy", type=Path, required=True, help="an imitation-learned vt_dp3's folder")
    parser.add_argument("--task", type=Path, default=TASK, help="a file as in configs/env")
    parser.add_argument("--device", default="cpu", help="of simulation and policy: cpu or cuda")
    parser.add_argument("--backend", help="of the simulation; default: warp on cuda, else the file's")
    parser.add_argument("--worlds", type=int, default=8, help="episodes of an iteration and of an evaluation")
    parser.add_argument(
        "--iterations", type=int, default=101, help="of the reference, evaluations among them"
    )
    parser.add_argument("--our_iterations", type=int, default=36, help="of ours")
    parser.add_argument("--minutes", type=float, default=600.0, help="of each run, which ends there")
    parser.add_argument("--val_freq", type=int, default=10, help="iterations from evaluation to evaluation")
    parser.add_argument("--batch_rows", type=int, default=BATCH_ROWS, help="of the reference's minibatches")
    parser.add_argument("--dppo", default="paper,trust_region", help="presets of ours to run")
    parser.add_argument("--skip_reference", action="store_true", help="run ours alone")
    parser.add_argument("--move", type=float, default=0.05, help="how far weights move before losses compare")
    parser.add_argument("--seed", type=int, default=0, help="of training (default %(default)s)")
    parser.add_argument(
        "--results",
        type=Path,
        default=ROOT / "results" / "reference.json",
        help="file of the rows, curves beside it",
    )
    args = parser.parse_args()
    saved = read_json_or_none(args.policy / "config.json") or {}
    if saved.get("type") != "vt_dp3" or saved["ft_denoising_steps"]:
        raise ValueError(f"--policy={args.policy} is not a vt_dp3 from imitation, before DPPO")
    {"losses": losses, "train": train}[args.what](args)


if __name__ == "__main__":
    raise SystemExit(main())
