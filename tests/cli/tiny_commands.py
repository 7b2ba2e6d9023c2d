"""Commands on a task that is quick to simulate, in this process or one of their own."""

import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

TINY_ENV = (
    "--env.type=vtrefine",
    "--env.start=grasped",
    "--env.num_threads=1",
    "--env.scene.camera={width: 16, height: 12, fov_y_rad: 0.384, position_m: [-0.44, 0.0, 0.42],"
    " target_m: [0.0, 0.0, 0.145]}",
)
"""Flags of a task that is quick to simulate."""
TINY_DPPO = (
    "--dppo.type=small",
    "--dppo.num_envs=2",
    "--dppo.epochs=1",
    "--dppo.minibatch_decisions=2",
    "--dppo.critic_width=16",
    "--dppo.iterations=1",
)
"""Flags of one iteration of fine-tuning that is quick to run."""

Lerobot = Callable[..., subprocess.Popen[str]]


def lerobot(command: str, *arguments: str, cache: Path) -> subprocess.Popen[str]:
    """Start a stock LeRobot command offline, in a process of its own."""
    environment = {
        **os.environ,
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(cache),
        "OMP_NUM_THREADS": "1",
        "CUDA_VISIBLE_DEVICES": "",
    }
    program = Path(sys.executable).with_name(f"lerobot-{command}")
    return subprocess.Popen(
        [str(program), *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> str:
    """Output of a command that must succeed."""
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output[-3000:]
    return output


def lerobot_here(command: str, *arguments: str) -> None:
    """Run a stock LeRobot command in this process, which has imported LeRobot; raises what it raises."""
    module = importlib.import_module(f"lerobot.scripts.lerobot_{command}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_HUB_OFFLINE", "1")
        patch.setattr(sys, "argv", [f"lerobot-{command}", *arguments])
        module.main()


def record(root: Path, *arguments: str) -> int:
    """Run ``vtrefine-record-demos`` in this process -> its exit status."""
    from lerobot_vtrefine.cli import record_demos

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["vtrefine-record-demos", f"--root={root}", *TINY_ENV, *arguments])
        return record_demos.main()
