"""Sharing: what lands on the Hub is complete, and its card says what was measured."""

import json
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest

from lerobot_vtrefine.cli import share, sharing

NAME = "--repo_id=me/insertion"


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A Hub that is a folder."""

    class Api:
        def create_repo(self, repo_id: str, **_: Any) -> None:
            (tmp_path / "hub" / repo_id).mkdir(parents=True, exist_ok=True)

        def upload_folder(self, repo_id: str, folder_path: Path, **_: Any) -> None:
            for path in Path(folder_path).iterdir():
                (tmp_path / "hub" / repo_id / path.name).write_bytes(path.read_bytes())

    monkeypatch.setattr(huggingface_hub, "HfApi", Api)
    return tmp_path / "hub"


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    folder = tmp_path / "pretrained_model"
    folder.mkdir()
    for name in sharing.CHECKPOINT_FILES:
        (folder / name).write_text("{}")
    (folder / "config.json").write_text(json.dumps({"modalities": "visuo_tactile", "ft_denoising_steps": 10}))
    env = {"type": "vtrefine", "pair": "round", "clearance_m": 0.002, "start": "grasped"}
    (folder / "train_config.json").write_text(json.dumps({"env": env}))
    return folder


def evaluation(folder: Path, seeds: range) -> Path:
    """140 of 200 episodes succeed."""
    folder.mkdir()
    successes = [k % 10 < 7 for k in range(len(seeds))]
    info = {"per_task": [{"metrics": {"successes": successes}}], "overall": {"eval_s": 1.0}}
    (folder / "eval_info.json").write_text(json.dumps(info))
    rows = [
        {"seed": seed, "steps": 30, "success": done, "failure": None if done else "contact_force"}
        | {"in_hand_shift_m": 0.0005, "peak_force_n": 9.0, "time_to_success_s": 3.3 if done else None}
        for seed, done in zip(seeds, successes, strict=True)
    ]
    (folder / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_a_policy_goes_with_its_processors_and_what_was_measured(
    hub: Path, policy: Path, tmp_path: Path
) -> None:
    measured = evaluation(tmp_path / "eval", range(9_000_000, 9_000_200))
    assert share.main([str(policy), NAME, f"--evaluation={measured}"]) == 0
    pushed = hub / "me" / "insertion"
    assert {path.name for path in pushed.iterdir()} >= {*sharing.CHECKPOINT_FILES, "README.md"}
    card = (pushed / "README.md").read_text()
    assert "70 % [63, 76] (140 of 200 episodes)" in card
    assert "9000000 to 9000199" in card
    assert "contact force 60" in card
    assert "fine-tuned by DPPO" in card
    assert '"pair": "round"' in card
    assert "--policy.path=me/insertion" in card


def test_without_an_evaluation_nothing_is_claimed(hub: Path, policy: Path) -> None:
    assert share.main([str(policy), NAME]) == 0
    assert "Not evaluated: nothing is claimed." in (hub / "me" / "insertion" / "README.md").read_text()


def test_bad_input_is_one_line_and_nothing_is_pushed(
    hub: Path, policy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mixed = evaluation(tmp_path / "mixed", range(0, 200))
    (mixed / "episodes.jsonl").write_text(
        (mixed / "episodes.jsonl").read_text() + json.dumps({"seed": 9_000_000, "success": True}) + "\n"
    )
    cases = (
        ([str(policy), "--repo_id=local/demos"], "give a name on the Hub"),
        ([str(policy), "--repo_id=insertion"], "give a name on the Hub"),
        ([str(tmp_path / "nowhere"), NAME], "no such folder"),
        ([str(tmp_path), NAME], "neither a LeRobotDataset"),
        ([str(policy), NAME, f"--evaluation={tmp_path}"], "run lerobot-eval with --env.metrics_path"),
        ([str(policy), NAME, f"--evaluation={mixed}"], "is not of one evaluation"),
    )
    for arguments, message in cases:
        assert share.main(arguments) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    (policy / "policy_preprocessor.json").unlink()
    assert share.main([str(policy), NAME]) == 2
    assert "lacks policy_preprocessor.json" in capsys.readouterr().err
    assert not hub.exists()
