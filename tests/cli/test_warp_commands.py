"""The commands on the warp backend, on the CPU: too slow for every run."""

import json
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from tiny_commands import TINY_DPPO, TINY_ENV

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="needs the gpu extra"),
]

WARP = (*TINY_ENV, "--env.backend=warp", "--env.warp.device=cpu", "--env.episode_steps=4")


def test_finetuning_and_evaluating_on_mujoco_warp(checkpoint: Path, tmp_path: Path, monkeypatch) -> None:
    from lerobot.scripts import lerobot_eval

    from lerobot_vtrefine.cli import finetune

    tuned, evaluated = tmp_path / "tuned", tmp_path / "evaluated"
    sizes = ("--eval.n_episodes=2", "--eval.batch_size=2")
    named = (f"--policy.path={checkpoint}", f"--output_dir={tuned}", "--eval_freq=1", "--save_freq=1")
    flags = [*named, *sizes, *WARP, *TINY_DPPO]
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr(sys, "argv", ["vtrefine-finetune", *flags])
    assert finetune.main() == 0
    policy = tuned / "checkpoints" / "last" / "pretrained_model"
    flags = [f"--policy.path={policy}", "--policy.device=cpu", f"--output_dir={evaluated}", *sizes, *WARP]
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *flags])
    lerobot_eval.main()
    assert json.loads((evaluated / "eval_info.json").read_text())["overall"]["n_episodes"] == 2
