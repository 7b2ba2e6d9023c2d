"""Adapters (--peft.*): what is trained is what acts, and a checkpoint of adapters loads again."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import nn

from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY
from lerobot_vtrefine.policies.vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy

BIN = Path(sys.executable).parent
TINY = ("--policy.type=vt_dp3", "--policy.preset=small", "--policy.point_dims=[8,16]")
RUN = ("--batch_size=4", "--num_workers=0", "--wandb.enable=false", "--policy.push_to_hub=false")


def policy_of(denoiser: str) -> VtDp3Policy:
    config = VtDp3Config(
        preset="small", denoiser=denoiser, point_dims=(8, 16), down_dims=(32, 32), device="cpu"
    )
    config.input_features = {key: PolicyFeature(FeatureType.STATE, (384,)) for key in config.required_keys}
    config.input_features[STATE_KEY] = PolicyFeature(FeatureType.STATE, (16,))
    config.output_features = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (16,))}
    return VtDp3Policy(config)


@pytest.mark.parametrize("denoiser", ["mlp", "unet"])
def test_targets_are_layers_of_the_network_that_acts_and_of_no_copy(denoiser: str) -> None:
    policy = policy_of(denoiser)
    pattern = re.compile(policy._get_default_peft_targets()["target_modules"])
    hit = {name: part for name, part in policy.named_modules() if pattern.fullmatch(name)}
    assert all(isinstance(part, nn.Linear | nn.Conv1d | nn.Conv2d) for part in hit.values())
    assert all(name.startswith("model.") for name in hit)
    assert any(name.startswith("model.encoder.") for name in hit)
    adapted = sum(part.weight.numel() for part in hit.values())
    assert adapted > 0.8 * sum(weight.numel() for weight in policy.model.parameters())


def test_adapters_need_a_checkpoint_from_before_dppo() -> None:
    policy = policy_of("mlp")
    with pytest.raises(ValueError, match="Training from scratch using PEFT"):
        policy._validate_peft_config(None)
    policy.config.pretrained_path = Path("somewhere")
    assert policy.online is not None
    policy._validate_peft_config(None)
    assert policy.online is None  # no average that would not follow the adapters
    policy.prepare_finetuning("ddim", 4, 2, 2, 0.0)
    with pytest.raises(ValueError, match="start from the checkpoint before DPPO"):
        policy._validate_peft_config(None)


def command(*words: object) -> str:
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    line = [str(BIN / str(words[0])), *map(str, words[1:])]
    done = subprocess.run(line, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_lerobot_train_makes_steps_with_adapters(tiny_dataset: Path, tmp_path: Path) -> None:
    peft = pytest.importorskip("peft", reason="pip install 'lerobot[peft]'")
    data = ("--dataset.repo_id=local/tiny", f"--dataset.root={tiny_dataset}", *RUN)
    first, second = (tmp_path / name / "checkpoints" / "last" / "pretrained_model" for name in ("bc", "peft"))
    command(
        "lerobot-train", *TINY, *data, "--policy.device=cpu", f"--output_dir={tmp_path / 'bc'}", "--steps=2"
    )
    start = (f"--policy.path={first}", "--policy.device=cpu", f"--output_dir={tmp_path / 'peft'}")
    command("lerobot-train", *data, *start, "--peft.method_type=LORA", "--peft.r=4", "--steps=3")
    assert (second / "adapter_model.safetensors").is_file()
    assert not (second / "model.safetensors").exists()

    base = VtDp3Policy.from_pretrained(first)
    base._stop_averaging()
    before = {name: weight.clone() for name, weight in base.model.named_parameters()}
    adapted = peft.PeftModel.from_pretrained(base, str(second))
    layers = [part for part in adapted.modules() if isinstance(part, peft.tuners.lora.LoraLayer)]
    assert any(torch.any(part.lora_B["default"].weight != 0) for part in layers)  # zero before training
    merged = adapted.merge_and_unload()
    changed = [
        name for name, weight in merged.model.named_parameters() if not torch.equal(weight, before[name])
    ]
    assert any(name.startswith("denoiser") for name in changed)
    assert any(name.startswith("encoder") for name in changed)
