"""Make the trained policy that comes with the package from a fine-tuned checkpoint: at most 5 MB.

    python scripts/ship_policy.py outputs/square/finetune/checkpoints/last/pretrained_model \\
        lerobot_vtrefine/assets/policies/square_grasped_1mm

Weights are kept as 16-bit floats, those of the frozen network, which only does the first few coarse denoising
steps, as 8-bit ones; PyTorch widens them when it loads them into the policy.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli

LARGEST_BYTES = 5_000_000
WEIGHTS = "model.safetensors"
FROZEN = "base.denoiser."
ORIGIN = {"device": "cpu", "pretrained_path": None, "pretrained_encoder": "", "freeze_encoder": False}
"""Entries of config.json that say where the policy came from: folders that others lack."""


def ship(checkpoint: Path, folder: Path) -> int:
    """Write a policy's configuration, processors and shortened weights; returns the weights' bytes.

    Raises:
        FileNotFoundError: the checkpoint holds no policy.
        FileExistsError: the folder exists.
        ValueError: the weights are too large to come with a package.
    """
    if not (checkpoint / WEIGHTS).is_file():
        raise FileNotFoundError(f"{checkpoint} holds no {WEIGHTS}; give a pretrained_model folder")
    if folder.exists():
        raise FileExistsError(f"{folder} exists; delete it first")
    weights = {key: _shortened(key, value) for key, value in load_file(checkpoint / WEIGHTS).items()}
    size = sum(value.numel() * value.element_size() for value in weights.values())
    if size > LARGEST_BYTES:
        raise ValueError(
            f"the weights are {size / 1e6:.2f} MB, at most {LARGEST_BYTES / 1e6:.0f} are shipped"
        )
    folder.mkdir(parents=True)
    save_file(weights, folder / WEIGHTS, metadata={"format": "pt"})
    for path in checkpoint.glob("policy_*.safetensors"):
        shutil.copyfile(path, folder / path.name)
    for path in checkpoint.glob("policy_*.json"):
        processor = _read(path)
        for step in processor["steps"]:
            if "device" in step.get("config", {}):
                step["config"]["device"] = ORIGIN["device"]
        _write(folder / path.name, processor)
    _write(folder / "config.json", _read(checkpoint / "config.json") | ORIGIN)
    return size


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


def _write(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _shortened(key: str, value: torch.Tensor) -> torch.Tensor:
    if not value.is_floating_point():
        return value
    return value.to(torch.float8_e4m3fn) if key.startswith(FROZEN) else value.half()


@run_cli
def main() -> None:
    """Console entry point."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path, help="pretrained_model folder of a fine-tuned policy")
    parser.add_argument("folder", type=Path, help="where the package keeps it")
    arguments = parser.parse_args()
    size = ship(arguments.checkpoint, arguments.folder)
    print(f"{arguments.folder}: {size / 1e6:.2f} MB of weights")


if __name__ == "__main__":
    raise SystemExit(main())
