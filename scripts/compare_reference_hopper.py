"""The reference implementation of DPPO beside this one on a task of its own: Hopper.

    git clone https://github.com/irom-princeton/dppo DPPO
    python scripts/compare_reference_hopper.py data --folder=hopper
    python scripts/compare_reference_hopper.py pretrain --folder=hopper --reference=DPPO
    python scripts/compare_reference_hopper.py train --folder=hopper --reference=DPPO --by=reference --seed=1
    python scripts/compare_reference_hopper.py train --folder=hopper --reference=DPPO --by=paper --seed=1
    python scripts/compare_reference_hopper.py rows --folder=hopper --start=C

``data`` and ``pretrain`` make what stands in for D4RL's hopper-medium-v2 and for the checkpoint that the
reference ships (``reference/hopper/standin.py``). ``train`` fine-tunes that one checkpoint: the reference's
agent, with its loop, loss, critic, optimisers and schedules unchanged and the hyper-parameters of its
``ft_ppo_diffusion_mlp.yaml`` for Hopper, or ours, ``paper`` with the same hyper-parameters, ``trust_region``
with its own. Every line of a learning curve lies on disk at once. ``rows`` adds those of the
curves that are there to results/reference_hopper.json.

Ours learns from whole episodes and the reference from segments of 500 decisions that go on where the last
one stopped. So an iteration of ours has as many worlds as make the same 20 000 decisions, by the mean length
of the episodes before. Environment steps count alike, and both are evaluated after the same of them, on the
same 40 held-out episodes, each by its own deployment sampler. ``--by=reference_quiet`` and the like give the
reference one of the things in which ours differs (``reference/hopper/theirs.py``).
"""

import argparse
import json
from pathlib import Path

import torch
from reference.checkout import Reference
from reference.hopper.curves import Curve, lines_of, read_curves
from reference.hopper.network import imitation
from reference.hopper.ours import PRESETS, train_ours
from reference.hopper.standin import Scales, imitate, record
from reference.hopper.theirs import VARIANTS, train_reference
from reference.hopper.worlds import CHUNK, N_STEPS, NUM_ENVS, make_worlds

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Row
from lerobot_vtrefine.cli.results.store import save

ROOT = Path(__file__).parents[1]


def pretrain(args: argparse.Namespace) -> None:
    """Imitate the recorded episodes; saves the checkpoint and the scales."""
    reference, episodes = Reference(args.reference), args.folder / "episodes.npz"
    torch.manual_seed(args.seed)
    model = imitation(reference, args.device)
    weights = imitate(model, episodes, horizon=CHUNK, updates=args.updates, batch=128, seed=args.seed)
    torch.save({"ema": weights}, args.folder / "pretrained.pt")
    Scales.of(episodes).save(args.folder / "scales.npz")


def train(args: argparse.Namespace) -> None:
    """One run, to ``curves/BY_SEED.jsonl`` of the folder."""
    if args.iterations % args.every:
        raise ValueError(f"--iterations={args.iterations} is no multiple of --every={args.every}")
    worlds = make_worlds(args.workers)
    torch.set_num_threads(args.threads)
    curve = Curve(args.folder / "curves" / f"{args.by}_{args.seed}.jsonl", by=args.by, seed=args.seed)
    (train_reference if args.by in VARIANTS else train_ours)(args, worlds, curve)


def rows(args: argparse.Namespace) -> None:
    """Rows of all curves that lie in the folder, at the evaluations' steps that all have reached."""
    curves = read_curves(args.folder / "curves")
    if not curves:
        raise ValueError(f"{args.folder / 'curves'} holds no evaluation")
    origin = provenance() | {"machine": args.machine or provenance()["machine"]}
    found: list[tuple[Row, list[dict[str, float]]]] = [
        (line, []) for line in lines_of(curves, args.every * NUM_ENVS * N_STEPS * CHUNK, args.start, **origin)
    ]
    save(args.results, found, replace=False)


@run_cli
def main() -> None:
    """``data``, ``pretrain``, ``train`` or ``rows``."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("what", choices=("data", "pretrain", "train", "rows"))
    parser.add_argument("--folder", type=Path, required=True, help="of episodes, checkpoint and curves")
    parser.add_argument("--reference", type=Path, help="a checkout of irom-princeton/dppo")
    parser.add_argument("--by", default="reference", choices=(*VARIANTS, *PRESETS), help="who trains")
    parser.add_argument("--device", default="cpu", help="of the policy: cpu or cuda")
    parser.add_argument("--threads", type=int, default=1, help="of the policy on a CPU")
    parser.add_argument("--workers", type=int, default=1, help="processes that simulate")
    parser.add_argument("--iterations", type=int, default=45, help="of training, 80 000 steps each")
    parser.add_argument("--every", type=int, default=9, help="iterations from evaluation to evaluation")
    parser.add_argument(
        "--goal", type=float, default=1200.0, help="return with noise at which the search ends"
    )
    parser.add_argument("--noise", type=float, default=0.1, help="on the recorded actions, full scale 1")
    parser.add_argument("--steps", type=int, default=100_000, help="to record")
    parser.add_argument("--updates", type=int, default=20_000, help="of the imitation")
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="of the search, the imitation or the training (default %(default)s)",
    )
    parser.add_argument("--start", help="name of the folder's imitation, in its rows; A and B are published")
    parser.add_argument("--machine", help="that trained, for the rows; default: this one")
    parser.add_argument(
        "--results", type=Path, default=ROOT / "results" / "reference_hopper.json", help="file of the rows"
    )
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    if args.reference is None and args.what in ("pretrain", "train"):
        raise ValueError(f"{args.what} needs --reference")
    if args.start is None and args.what == "rows":
        raise ValueError("rows needs --start: a name for the imitation, of which earlier rows are replaced")
    if args.what == "data":
        made = args.folder / "episodes.npz"
        found = record(made, goal=args.goal, noise=args.noise, steps=args.steps, seed=args.seed)
        print(json.dumps(found))
    else:
        {"pretrain": pretrain, "train": train, "rows": rows}[args.what](args)


if __name__ == "__main__":
    raise SystemExit(main())
