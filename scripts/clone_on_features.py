"""Behaviour cloning of a vt_dp3 whose encoder is frozen, on features that are computed once.

    python scripts/clone_on_features.py --dataset=outputs/demos_cross --steps=6000 --seed=31 --device=cuda \\
        --policy='{"pretrained_encoder": "vtrefine:cross_gentle", "down_dims": [512, 512, 512, 512]}' \\
        --output_dir=outputs/pretrain_cross

Loss, optimiser, schedule and batches are those of lerobot-train with configs/policy/vt_dp3_pads.yaml; what a
training step costs there is mostly the encoder, which sees the same frames again and again. Here it sees
every frame --passes times, each with a draw of its own of points and of sensor noise. The result lies in
OUTPUT_DIR/pretrained_model, for lerobot-eval and vtrefine-finetune.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import draccus
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.utils.random_utils import set_seed
from torch import Tensor
from tqdm import trange

from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import check_folder
from lerobot_vtrefine.datasets.features import ACTION_KEY, LIMITS_KEY, STATE_KEY, TRUTH_KEY
from lerobot_vtrefine.files.text import read_yaml
from lerobot_vtrefine.finetune.distributed import check_device
from lerobot_vtrefine.lerobot_compat.completeness import check_complete
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy
from lerobot_vtrefine.policies.vt_dp3.observation_encoder import PERCEIVED_KEY

CONFIG = Path(__file__).parents[1] / "configs" / "policy" / "vt_dp3_pads.yaml"
ENCODED_AT_ONCE = 512


@torch.no_grad()
def perceived(
    policy: VtDp3Policy, preprocessor: Any, dataset: LeRobotDataset, passes: int
) -> list[dict[str, Tensor]]:
    """Every pass's frames (N, ...): features, state, limits and truth if any, and actions to come."""
    kept = (STATE_KEY, LIMITS_KEY, TRUTH_KEY, ACTION_KEY)
    found = []
    for _ in range(passes):
        parts: dict[str, list[Tensor]] = {}
        for raw in torch.utils.data.DataLoader(dataset, batch_size=ENCODED_AT_ONCE):
            batch = preprocessor(raw)
            seen = {PERCEIVED_KEY: policy.model.encoder.perceive(batch)}
            for key, value in (seen | {key: batch[key] for key in kept if key in batch}).items():
                parts.setdefault(key, []).append(value)
        found.append({key: torch.cat(values) for key, values in parts.items()})
    return found


def clone(policy: VtDp3Policy, passes: list[dict[str, Tensor]], steps: int, batch_size: int) -> float:
    """Train in place, as lerobot-train does; the last step's loss."""
    config = policy.config
    weights = policy.get_optim_params()
    optimizer = config.get_optimizer_preset().build(weights)
    schedule = config.get_scheduler_preset().build(optimizer, steps)
    frames = {key: torch.stack([one[key] for one in passes]) for key in passes[0]}
    device, number = frames[ACTION_KEY].device, len(passes[0][ACTION_KEY])
    policy.train()
    loss = torch.zeros(())
    for _ in trange(steps, desc="cloning", unit="step"):
        draw = torch.randint(len(passes), (batch_size,), device=device)
        index = torch.randint(number, (batch_size,), device=device)
        loss, _ = policy.forward({key: values[draw, index] for key, values in frames.items()})
        loss.backward()
        torch.nn.utils.clip_grad_norm_(weights, config.optimizer_grad_clip_norm)
        optimizer.step()
        schedule.step()
        optimizer.zero_grad()
        policy.update()
    policy.eval()
    return float(loss.detach())


def load(args: argparse.Namespace) -> tuple[VtDp3Policy, tuple[Any, Any], LeRobotDataset]:
    """A fresh policy, its processors and the dataset.

    Raises: ValueError for a policy whose encoder is trained; for a dataset as `check_complete`.
    """
    fields = read_yaml(CONFIG)["policy"] | {"device": args.device} | args.policy
    config = draccus.decode(PreTrainedConfig, fields)
    if not getattr(config, "freeze_encoder", False):
        raise ValueError("--policy: features can be kept where freeze_encoder is true")
    check_complete(args.dataset)
    repo_id = f"local/{args.dataset.name}"
    meta = LeRobotDataset(repo_id, root=args.dataset).meta
    times = resolve_delta_timestamps(config, meta)
    dataset = LeRobotDataset(repo_id, root=args.dataset, delta_timestamps=times)
    policy = make_policy(config, ds_meta=dataset.meta)
    return policy, make_pre_post_processors(config, dataset_stats=dataset.meta.stats), dataset  # ty: ignore


def settings(text: str) -> dict[str, Any]:
    """Settings by name, as a flag's JSON."""
    try:
        given = json.loads(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text} is not valid JSON ({error})") from error
    if not isinstance(given, dict):
        raise argparse.ArgumentTypeError(f"give settings by name, such as '{{\"horizon\": 8}}', got {text}")
    return given


def make_parser() -> CommandParser:
    """The command line."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--dataset", type=Path, required=True, help="folder of the demonstrations")
    parser.add_argument(
        "--policy", type=settings, default={}, help="settings that differ from vt_dp3_pads.yaml, as JSON"
    )
    parser.add_argument("--steps", type=at_least(1), default=6000, help="default %(default)s")
    parser.add_argument("--batch_size", type=at_least(1), default=128, help="default %(default)s")
    parser.add_argument(
        "--passes", type=at_least(1), default=4, help="times that the encoder sees every frame"
    )
    parser.add_argument("--seed", type=at_least(0), default=0, help="default %(default)s")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--output_dir", type=Path, required=True, help="of pretrained_model")
    return parser


@run_cli
def main() -> None:
    """Writes the policy with its processors."""
    args = make_parser().parse_args()
    check_device(args.device)
    check_folder("--output_dir", args.output_dir)
    folder = args.output_dir / "pretrained_model"
    if folder.exists():
        raise FileExistsError(f"{folder} exists; choose another --output_dir or remove it")
    set_seed(args.seed)
    policy, processors, dataset = load(args)
    loss = clone(policy, perceived(policy, processors[0], dataset, args.passes), args.steps, args.batch_size)
    for part in (policy, *processors):
        part.save_pretrained(folder)
    print(f"last loss {loss:.4f}; policy: {folder}")


if __name__ == "__main__":
    raise SystemExit(main())
