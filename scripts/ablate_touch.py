"""Does a fine-tuned policy use what it feels? Success with touch replaced, on the same episodes.

    python scripts/ablate_touch.py --policy=outputs/finetune/checkpoints/last/pretrained_model \\
        --task=configs/env/cross_gentle.yaml --dataset=outputs/demos --device=cuda --episodes=512

``--env.ablate`` says what the replacements are; ``touch`` and ``touch_other`` take theirs from --dataset.
``lerobot-eval --env.ablate=...`` tells the same, and draws its episodes; this one runs all of them at once on
a GPU without a display.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.pipeline.demo_config import EVAL_SEED_OFFSET
from lerobot_vtrefine.finetune.config import TrustRegionDppo
from lerobot_vtrefine.finetune.evaluation import evaluate
from lerobot_vtrefine.finetune.pipeline import load_practice

KINDS = ("none", "touch", "touch_shuffled", "touch_other")


def measure(args: argparse.Namespace, kind: str) -> dict[str, Any]:
    """Success and what went with it, of one kind of touch."""
    dataset = args.dataset if kind in ("touch", "touch_other") else None
    cfg = TrustRegionDppo(num_envs=args.episodes, encoder="frozen")
    practice = load_practice(args.policy, args.task, cfg, args.device, ablate=kind, ablate_dataset=dataset)
    found = evaluate(practice.env, practice.agent, args.episodes, EVAL_SEED_OFFSET)
    return {"ablate": kind, "episodes": args.episodes, **found}


@run_cli
def main() -> None:
    """Prints a JSON object a line."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--policy", type=Path, required=True, help="a fine-tuned vt_dp3's folder")
    parser.add_argument("--task", type=Path, required=True, help="a file as in configs/env")
    parser.add_argument("--dataset", type=Path, help="recordings of the task, for the replaced touch")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS, help="default: all")
    parser.add_argument("--episodes", type=at_least(1), default=512, help="run side by side")
    parser.add_argument("--device", default="cpu", help="of simulation and policy: cpu or cuda")
    args = parser.parse_args()
    wanting = [kind for kind in args.kinds if kind in ("touch", "touch_other") and not args.dataset]
    if wanting:
        raise ValueError(f"--kinds {' '.join(wanting)} needs --dataset=FOLDER, whose touch is put in place")
    for kind in args.kinds:
        print(json.dumps(measure(args, kind)), flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
