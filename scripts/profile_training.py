"""Steps per second of ``lerobot-train`` with vt_dp3, as LeRobot's own log tells them.

    python scripts/profile_training.py --device=cuda

A dataset of random numbers, with the columns and sizes of a recording, stands in for demonstrations: speed
does not depend on what they show. Every policy is trained by the command itself, once; what it takes to
start, and the first quarter of the steps, do not count.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import check_file
from lerobot_vtrefine.cli.pipeline.stages import end, own_sessions
from lerobot_vtrefine.finetune.distributed import check_device
from lerobot_vtrefine.lerobot_compat.benchmark import record_noise

FRAMES = 50
"""Of an episode."""
POLICIES = {
    "small": ("--policy.preset=small",),
    "pads": (
        "--policy.preset=small",
        "--policy.fusion=pads",
        "--policy.pretrained_encoder=vtrefine:square_grasped_1mm",
        "--policy.freeze_encoder=true",
        "--policy.n_action_steps=4",
        "--policy.horizon=8",
    ),
    "paper": ("--policy.preset=paper",),
}
TIMES = re.compile(r"updt_s:([\d.]+) data_s:([\d.]+) smp/s:(\d+)")


def train(name: str, root: Path, args: argparse.Namespace) -> dict[str, Any]:
    """One row: the command, and the median of what it logged."""
    log_freq = max(args.steps // 20, 1)
    with tempfile.TemporaryDirectory() as folder:
        command = [
            *(sys.executable, "-m", "lerobot.scripts.lerobot_train"),
            *("--dataset.repo_id=local/frames", f"--dataset.root={root}"),
            *("--policy.type=vt_dp3", *POLICIES[name], f"--policy.device={args.device}"),
            *("--policy.push_to_hub=false", f"--output_dir={folder}/run", "--save_checkpoint=false"),
            *(f"--batch_size={args.batch_size}", f"--steps={args.steps}", f"--log_freq={log_freq}"),
            *(f"--num_workers={args.num_workers}", "--env_eval_freq=0"),
        ]
        with own_sessions(end) as start:
            child = start(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
            said = str(child.communicate()[0])
    times = [[float(value) for value in found] for found in TIMES.findall(said)]
    if child.returncode or not times:
        raise ChildProcessError(f"lerobot-train failed: {said[-2000:]}")
    update_s, data_s, samples_per_s = np.median(times[len(times) // 4 :], axis=0)
    return {
        "policy": name,
        "steps_per_s": round(samples_per_s / args.batch_size, 1),
        "update_s": float(update_s),
        "data_s": float(data_s),
        "batch_size": args.batch_size,
        "num_workers": args.num_workers,
        "steps": args.steps,
    }


@run_cli
def main() -> None:
    """Prints a JSON object per policy."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--policies", default=",".join(POLICIES), help=f"of {', '.join(POLICIES)}")
    parser.add_argument("--steps", type=at_least(1), default=1000, help="default %(default)s")
    parser.add_argument("--batch_size", type=at_least(1), default=128, help="default %(default)s")
    parser.add_argument(
        "--num_workers", type=at_least(0), default=4, help="of the data loader; LeRobot's default"
    )
    parser.add_argument("--episodes", type=at_least(1), default=20, help="of the dataset, 50 frames each")
    parser.add_argument("--json", type=Path, help="where to write the rows, too")
    args = parser.parse_args()
    check_device(args.device)
    names = args.policies.split(",")
    for name in names:
        check_choice("--policies", name, POLICIES)
    if args.json is not None:
        check_file("--json", args.json)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "frames"
        record_noise(root, args.episodes, FRAMES)
        for name in names:
            rows.append(train(name, root, args))
            print(json.dumps(rows[-1]), flush=True)
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    raise SystemExit(main())
