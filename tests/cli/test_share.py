"""Sharing: what lands on the Hub is complete, and its card says what was measured."""

import json
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import draccus
import httpx
import huggingface_hub
import pytest
from lerobot.envs.configs import EnvConfig
from lerobot.scripts import lerobot_eval
from local_hub import use_folder_as_hub
from tiny_commands import TINY_DPPO, TINY_ENV

from lerobot_vtrefine.cli import finetune, share, sharing
from lerobot_vtrefine.cli.card_evaluation import card_stage
from lerobot_vtrefine.cli.record_demos import RecordDemosConfig
from lerobot_vtrefine.cli.report.results import load_evaluation, percent
from lerobot_vtrefine.embodiments import CameraConfig
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.evaluation_note import changed_settings
from lerobot_vtrefine.envs.vectorization import make_vector_env
from lerobot_vtrefine.files import read_json_lines
from lerobot_vtrefine.finetune.pipeline import FinetunePipelineConfig
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.sim.config import SceneConfig

NAME = "--repo_id=me/insertion"


@dataclass
class EnvOnly:
    """What LeRobot's commands parse from ``--env.*``."""

    env: EnvConfig


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A Hub that is a folder."""

    use_folder_as_hub(monkeypatch, tmp_path / "hub")
    return tmp_path / "hub"


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    folder = tmp_path / "pretrained_model"
    folder.mkdir()
    for name in sharing.CHECKPOINT_FILES:
        (folder / name).write_text("{}")
    (folder / "config.json").write_text(json.dumps({"modalities": "visuo_tactile", "ft_denoising_steps": 10}))
    env = {"type": "vtrefine", "pair": "round", "clearance_m": 0.002, "start": "grasped"}
    dppo = {"type": "small", "iterations": 30, "num_envs": 128}
    (folder / "train_config.json").write_text(json.dumps({"env": env, "dppo": dppo, "seed": 7}))
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
    assert "30 iterations of 128 worlds; environment seeds from 1000007 on" in card
    assert "--policy.path=me/insertion" in card
    assert "--seed" not in card  # in which environment it was evaluated, nobody noted


def test_the_card_repeats_the_evaluation_where_its_environment_was_noted(
    hub: Path, policy: Path, tmp_path: Path
) -> None:
    measured = evaluation(tmp_path / "eval", range(70, 80))
    scene = SceneConfig(pad_friction=0.7, camera=CameraConfig(16, 12, 0.4, (-0.4, 0.0, 0.4), (0.0, 0.0, 0.1)))
    config = VtRefineEnvConfig(
        pair="square", task="put it in", scene=scene, metrics_path=measured / "episodes.jsonl"
    )
    make_vector_env(config, num_envs=5, use_async=False)
    assert share.main([str(policy), NAME, f"--evaluation={measured}"]) == 0
    card = (hub / "me" / "insertion" / "README.md").read_text()
    command = shlex.split(card.split("sim]'\n")[1].split("```")[0].replace("\\\n", " "))
    assert command[:3] == ["lerobot-eval", "--policy.path=me/insertion", "--policy.device=cpu"]
    assert command[-3:] == ["--eval.n_episodes=10", "--eval.batch_size=5", "--seed=70"]
    repeated = draccus.parse(EnvOnly, args=command[3:-3])
    assert changed_settings(repeated.env) == changed_settings(config)
    assert repeated.env.scene_config == config.scene_config
    assert len(command) == 3 + 3 + 1 + 3 + 5  # nothing that is as ever: type, pair, task, friction, camera


def test_without_an_evaluation_nothing_is_claimed(hub: Path, policy: Path) -> None:
    assert share.main([str(policy), NAME]) == 0
    card = (hub / "me" / "insertion" / "README.md").read_text()
    assert "Not evaluated: nothing is claimed." in card
    assert "--config_path=vtrefine:NAME" in card  # not just any task


def test_a_network_that_does_not_answer_leaves_no_card_behind(
    hub: Path, policy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unreachable(*_: object, **__: object) -> None:
        raise httpx.ConnectError("no route")

    monkeypatch.setattr(huggingface_hub.HfApi, "create_repo", unreachable)
    assert share.main([str(policy), NAME]) == 2
    assert "the network did not answer" in capsys.readouterr().err
    assert not (policy / "README.md").exists()


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
        ([str(tmp_path), NAME], f"nor a checkpoint: take {policy}"),
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


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_fine_tuned_policy_on_the_hub_repeats_what_its_card_claims(
    hub: Path, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = (*TINY_ENV, "--env.episode_steps=8", "--eval.n_episodes=6", "--eval.batch_size=3")
    start = (f"--policy.path={checkpoint}", "--policy.device=cpu", f"--output_dir={tmp_path / 'run'}")
    arguments = ["vtrefine-finetune", *start, *task, *TINY_DPPO, "--eval_freq=0"]
    monkeypatch.setattr(sys, "argv", [*arguments, "--push_to_hub=true", NAME])
    assert finetune.main() == 0
    pushed = hub / "me" / "insertion"
    assert {path.name for path in pushed.iterdir()} >= {*sharing.CHECKPOINT_FILES, "train_config.json"}
    card = (pushed / "README.md").read_text()
    command = shlex.split(card.split("sim]'\n")[1].split("```")[0].replace("\\\n", " "))
    assert command[1] == "--policy.path=me/insertion"
    command[1] = f"--policy.path={pushed}"
    again = tmp_path / "again"
    log = f"--env.metrics_path={again / 'episodes.jsonl'}"
    monkeypatch.setattr(sys, "argv", [*command, log, f"--output_dir={again}"])
    lerobot_eval.main()
    assert f"| {percent(load_evaluation(again, 9_000_000))} |" in card
    first, second = (
        read_json_lines(folder / "episodes.jsonl")
        for folder in (tmp_path / "run" / "evaluation_000001", again)
    )
    assert [row["seed"] for row in first] == list(range(9_000_000, 9_000_006))
    assert first == second  # the same forces and shifts, not only the same count


def test_finetuning_refuses_to_share_under_no_name_before_it_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cases = (
        (["--push_to_hub=true"], "give a name on the Hub"),
        (["--policy.push_to_hub=true"], "share the result with --push_to_hub=true --repo_id=USER/NAME"),
    )
    for flags, message in cases:
        output = tmp_path / "run"
        common = ["--env.type=vtrefine", "--policy.path=nowhere", f"--output_dir={output}"]
        monkeypatch.setattr(sys, "argv", ["vtrefine-finetune", *common, *flags])
        assert finetune.main() == 2
        assert message in capsys.readouterr().err
        assert not output.exists()


def test_who_is_not_logged_in_is_told_before_anything_is_made(monkeypatch, tmp_path: Path, capsys) -> None:
    monkeypatch.delenv("HF_TOKEN", raising=False)
    monkeypatch.setattr("huggingface_hub.get_token", lambda: None)
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    assert share.main([str(tmp_path), "--repo_id=me/demos"]) == 2
    assert "run hf auth login first" in capsys.readouterr().err
    with pytest.raises(ValueError, match="hf auth login"):
        RecordDemosConfig(root=tmp_path / "x", env=VtRefineEnvConfig(), push_to_hub=True, repo_id="me/demos")


def test_a_policy_that_practised_from_a_bank_is_judged_from_the_table(tmp_path: Path) -> None:
    env = VtRefineEnvConfig(start="table", fps=20, start_bank=tmp_path / "starts.npz")
    run = FinetunePipelineConfig(env, VtDp3Config(device="cpu"), output_dir=tmp_path)
    line = card_stage(run, tmp_path / "checkpoints" / "000001").line
    assert "--env.fps=20" in line
    assert "start_bank" not in line
