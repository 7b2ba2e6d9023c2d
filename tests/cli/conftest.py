import multiprocessing
import sys
from pathlib import Path

import pytest
from tiny_commands import lerobot_here, record


@pytest.fixture
def fake_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins for the commands of the demo's stages."""
    from lerobot_vtrefine.cli.pipeline import stages

    fakes = Path(__file__).with_name("fake_commands.py")

    def find(name: str) -> str:
        script = tmp_path / "bin" / name
        script.parent.mkdir(exist_ok=True)
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{fakes}" {name} "$@"\n')
        script.chmod(0o755)
        return str(script)

    monkeypatch.setattr(stages, "find_command", find)


@pytest.fixture
def started_quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes that this one starts are copies of one that has imported LeRobot, seconds each otherwise.

    What they are given is pickled, and this package imported, as in processes that begin with nothing.
    """
    copies = multiprocessing.get_context("forkserver")
    copies.set_forkserver_preload(["lerobot.envs"])
    monkeypatch.setattr(multiprocessing, "get_context", lambda method=None: copies)


@pytest.fixture(scope="session")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small recorded dataset; tests copy it before they change it."""
    root = tmp_path_factory.mktemp("recorded") / "demos"
    assert record(root, "--num_episodes=3", "--num_envs=4", "--seed=5") == 0
    return root


@pytest.fixture(scope="session")
def checkpoint(demos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that stock ``lerobot-train`` trained for two steps on ``demos``."""
    out = tmp_path_factory.mktemp("trained") / "run"
    lerobot_here(
        "train",
        "--policy.type=vt_dp3",
        "--policy.preset=small",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--dataset.repo_id=local/vtrefine_demos",
        f"--dataset.root={demos}",
        f"--output_dir={out}",
        "--steps=2",
        "--save_freq=2",
        "--batch_size=4",
        "--num_workers=0",
        "--wandb.enable=false",
    )
    return out / "checkpoints" / "last" / "pretrained_model"
