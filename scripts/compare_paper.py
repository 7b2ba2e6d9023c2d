"""The paper's tables in simulation: AutoMate pairs from the table, with vision and with touch, by DPPO.

    python scripts/compare_paper.py --mesh_dir=MESHES --seeds 0 1 2 --jobs 12
    python scripts/compare_paper.py --mesh_dir=MESHES --pairs 00186 --demonstrations 10 30 50 --jobs 12
    make tables

MESHES holds ID_plug.obj and ID_socket.obj. Per pair and seed demonstrations are recorded once. Policies with
touch and with vision only learn from them and are fine-tuned by DPPO, once more from random weights (one step
of imitation); stock lerobot-eval judges each, always from the table, on episodes that are the same for all.

By --recipe=cloud (default), the paper's own network, all of it learns from the demonstrations, by stock
lerobot-train. By --recipe=pads policies see and feel through an encoder, which comes with the package for
each pair, or, by --encoder=own, learns here, and imitate on features that are computed once. On a GPU noise,
steps and chain are those of the tables in docs/paper-pairs.md.

Where DPPO practises is --tune_start: on whole episodes (table); from states that the imitation reached with
both parts in hand, or the expert where it reaches too few (bank); or with parts that are put into the hands
(grasped), where a pair can be. Random weights, which never get that far, practise on whole episodes in place
of a bank. On a GPU worlds wait for the one that runs out of time: --tune_steps=120 ends episodes from a bank
earlier, counted from the table. --tune_timestep_s=0.005 practises in longer physics steps than those in
which policies are judged.

Every evaluation becomes a row of results/paper.json, or of results/demonstrations.json, as soon as it is done
(by --recipe=pads of paper_pads.json and demonstrations_pads.json). The same command again goes on where
it was: finished stages are not repeated, nor policies whose rows are there with these numbers of episodes
and iterations, so that it may go on on another machine.
"""

import argparse
import json
import sys
from itertools import chain, zip_longest
from pathlib import Path

from paper.outcome import is_done, row_of
from paper.stages import TASKS, shared_stages, stages
from paper.trained import PAPERS_OWN, Trained, chosen, table_of, variants
from runs.side_by_side import run_all

from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.pipeline.demo_config import RECIPES
from lerobot_vtrefine.cli.pipeline.stages import StageRunner
from lerobot_vtrefine.cli.results.published import DEMONSTRATIONS
from lerobot_vtrefine.cli.results.store import save
from lerobot_vtrefine.finetune.distributed import check_device

RESULTS = Path(__file__).parents[1] / "results"


def make_parser() -> CommandParser:
    """The command line."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--mesh_dir", type=Path, required=True, help="folder of the meshes")
    parser.add_argument("--pairs", nargs="+", choices=list(TASKS), default=list(TASKS), help="default: all")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="default: %(default)s")
    parser.add_argument(
        "--demonstrations",
        type=int,
        nargs="+",
        default=[DEMONSTRATIONS],
        help="numbers to imitate (default: %(default)s)",
    )
    parser.add_argument("--no_scratch", action="store_true", help="leave out DPPO without pre-training")
    parser.add_argument(
        "--recipe", choices=list(RECIPES), default=PAPERS_OWN, help="default %(default)s; see above"
    )
    parser.add_argument(
        "--encoder",
        help="of --recipe=pads; {pair} stands for the pair's number (default: what comes with the package for"
        " the pair; own: one trained here)",
    )
    parser.add_argument(
        "--encoder_episodes", type=at_least(1), default=4096, help="that an encoder learns from"
    )
    parser.add_argument("--encoder_steps", type=at_least(1), default=4000, help="of an encoder's training")
    parser.add_argument("--steps", type=at_least(1), default=6000, help="of imitation")
    parser.add_argument(
        "--batch_size", type=at_least(1), default=128, help="of imitation (default %(default)s)"
    )
    parser.add_argument("--iterations", type=at_least(1), default=14, help="of DPPO (default %(default)s)")
    parser.add_argument(
        "--scratch_iterations", type=at_least(1), default=20, help="of DPPO without pre-training"
    )
    parser.add_argument("--worlds", type=at_least(1), default=1024, help="of DPPO (default %(default)s)")
    parser.add_argument("--tune_start", choices=["table", "bank", "grasped"], default="table", help="of DPPO")
    parser.add_argument("--tune_steps", type=int, help="control step at which episodes from a bank end")
    parser.add_argument("--tune_timestep_s", type=float, help="longest physics step [s] of DPPO")
    parser.add_argument("--starts", type=at_least(1), default=512, help="states in a bank")
    parser.add_argument("--episodes", type=at_least(1), default=512, help="of an evaluation")
    parser.add_argument("--eval_envs", type=int, default=512, help="episodes evaluated at once")
    parser.add_argument("--demo_envs", type=int, default=16, help="episodes recorded at once")
    for name, words in (("env", "environment"), ("policy", "policy"), ("dppo", "update")):
        parser.add_argument(
            f"--{name}", type=json.loads, default={}, help=f"more flags of the {words}, as JSON"
        )
    parser.add_argument("--device", default="cuda", help="of the networks")
    parser.add_argument("--backend", choices=["batch", "warp"], help="default: warp on cuda, else batch")
    parser.add_argument("--jobs", type=at_least(1), default=1, help="policies side by side (default 1)")
    parser.add_argument("--commit", help="of the code, where no checkout tells it")
    parser.add_argument(
        "--output_dir",
        type=Path,
        default=Path("outputs/compare_paper"),
        help="of all runs (default: %(default)s)",
    )
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the rows")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    return parser


def side_by_side(options: argparse.Namespace, left: list[Trained]) -> None:
    """This script again for every stage that policies share, and for every policy once these are done."""
    folder, again = options.output_dir / "runs", [sys.executable, __file__, *sys.argv[1:]]
    needs = {
        folder / policy.name: [folder / stage.name for stage in shared_stages(options, policy)]
        for policy in left
    }
    # Encoders of all pairs before demonstrations: they take longest, and GPUs are dealt out by turns.
    shared = filter(None, chain.from_iterable(zip_longest(*needs.values())))
    names = dict.fromkeys([*shared, *needs])
    run_all({name: [*again, f"--only={name.name}"] for name in names}, options.jobs, needs)


@run_cli
def main() -> None:
    """Every policy that has no rows yet, after its encoder and its demonstrations."""
    parser = make_parser()
    options = parser.parse_args()
    if options.encoder and options.recipe == PAPERS_OWN:
        parser.error(f"--encoder: the network of --recipe={PAPERS_OWN} takes none; add --recipe=pads")
    check_device(options.device)
    options.backend = options.backend or ("warp" if options.device == "cuda" else "batch")
    left = [policy for policy in chosen(options) if not is_done(options, policy)]
    shared = {stage.name: stage for policy in left for stage in shared_stages(options, policy)}
    if options.only in shared:
        StageRunner(options.output_dir, [shared[options.only]]).run()
    elif options.only is not None:
        (policy,) = (policy for policy in left if policy.name == options.only)
        finish(options, policy)
    elif options.jobs > 1:
        side_by_side(options, left)
    else:
        for policy in left:
            finish(options, policy)


def finish(options: argparse.Namespace, policy: Trained) -> None:
    """One policy's stages; each evaluation is a row as soon as it is done."""
    commits: dict[str, str | None] = {}
    for record in StageRunner(options.output_dir, stages(options, policy)).records():
        commits[record.name] = record.commit
        for stage in variants(policy):
            trained = f"{stage}_{policy.name}"
            if record.name == f"eval_{trained}":
                row = row_of(options, policy, stage, commits[trained])
                save(options.results / f"{table_of(policy)}.json", [row], replace=False)


if __name__ == "__main__":
    raise SystemExit(main())
