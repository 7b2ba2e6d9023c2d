import json
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from tiny_commands import TINY_ENV

from lerobot_vtrefine.cli.results.collect import run_rows
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episode_log import read_episode_log
from lerobot_vtrefine.finetune.config import SmallDppo
from lerobot_vtrefine.finetune.logger import ProgressLog
from lerobot_vtrefine.finetune.pipeline import CONFIG_NAME, FinetunePipelineConfig, write_config


@pytest.fixture
def evaluate(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Run stock ``lerobot-eval`` in this process -> (its result, our metrics)."""
    from lerobot.scripts import lerobot_eval

    def run(name: str, *arguments: str) -> tuple[dict, list[dict]]:
        out = tmp_path / name
        flags = (
            f"--policy.path={checkpoint}",
            "--policy.device=cpu",
            "--eval.n_episodes=2",
            "--eval.batch_size=2",
            "--seed=40",
            f"--output_dir={out}",
            f"--env.metrics_path={out}/episodes.jsonl",
            *TINY_ENV,
            "--env.episode_steps=5",
            *arguments,
        )
        monkeypatch.setattr(sys, "argv", ["lerobot-eval", *flags])
        monkeypatch.setenv("HF_HUB_OFFLINE", "1")
        lerobot_eval.main()
        info = json.loads((out / "eval_info.json").read_text())
        return info, read_episode_log(out / "episodes.jsonl", 40, 2)

    return run


VECTORISATIONS = {
    "native": ("--env.vectorization=native",),
    "sync": ("--env.vectorization=gym", "--eval.use_async_envs=false"),
    "async": ("--env.vectorization=gym", "--eval.use_async_envs=true"),
}


@pytest.mark.usefixtures("started_quickly")
def test_lerobot_eval_plays_the_same_episodes_in_every_vectorisation(evaluate, tmp_path):
    played = {}
    for name, flags in VECTORISATIONS.items():
        info, rows = evaluate(name, *flags, "--env.video_episodes=1")
        assert info["overall"]["n_episodes"] == 2
        assert [row["seed"] for row in rows] == [40, 41]
        assert all(0 < row["steps"] <= 5 and row["failure"] != "none" for row in rows)
        assert all(row["in_hand_shift_m"] >= 0 and row["peak_force_n"] >= 0 for row in rows)
        videos = sorted((tmp_path / name / "videos").rglob("*.mp4"))
        assert [str(video) for video in videos] == info["overall"]["video_paths"]
        pictures = [list(av.open(str(video)).decode(video=0)) for video in videos]
        assert [len(frames) for frames in pictures] == [rows[0]["steps"]]
        assert all(frame.to_ndarray(format="rgb24").std() > 20 for frame in pictures[0])
        played[name] = [row["in_hand_shift_m"] for row in rows]
    assert played["sync"] == pytest.approx(played["native"], rel=1e-3, abs=1e-6)
    assert played["async"] == pytest.approx(played["native"], rel=1e-3, abs=1e-6)


def test_recording_by_lerobot_eval_can_be_loaded(evaluate, tmp_path):
    from lerobot.datasets import LeRobotDataset

    _, rows = evaluate("recorded", "--eval.recording=true")
    for number, row in enumerate(rows):
        root = tmp_path / "recorded" / "recordings" / "vtrefine_0" / f"env_{number}"
        dataset = LeRobotDataset("local/recorded", root=root)
        assert (dataset.num_episodes, len(dataset)) == (1, row["steps"])
        frame = dataset[0]
        assert frame["images.front_depth"].shape == (1, 12, 16)
        assert frame["images.front_depth"].max() > 300  # mm
        counts = frame["tactile.left_arm_left_finger"]
        assert counts.shape == (384,)
        assert counts.max() > 10
        assert not (counts % 1).any()
    assert not list((tmp_path / "recorded").rglob("*.mp4"))


def test_frames_that_were_not_read_cannot_be_scored(evaluate, capsys, tmp_path):
    with pytest.raises(SystemExit) as ended:
        evaluate("skipping", "--env.read_every=16")
    assert ended.value.code == 2
    assert "unrecognized arguments: --env.read_every=16" in capsys.readouterr().err
    assert not (tmp_path / "skipping").exists()


def test_surplus_episodes_are_dropped_and_the_others_are_a_fine_tunings_result(evaluate, tmp_path):
    info, rows = evaluate("run/eval", "--eval.n_episodes=3", "--env.video_episodes=0")
    assert [row["seed"] for row in rows] == [40, 41]

    folder, dppo = tmp_path / "run", SmallDppo(iterations=1)
    write_config(
        FinetunePipelineConfig(VtRefineEnvConfig(), dppo=dppo, output_dir=folder, seed=7),
        folder / CONFIG_NAME,
    )
    ProgressLog(folder, 0, None).add(1, {"success": 0.9, "env_steps": 1000.0, "seconds": 2.0})
    common = {"table": "converges", "task": "round_2mm", "policy": "visual"}
    ((row, _),) = run_rows(folder, common, dict.fromkeys(("commit", "command", "machine")))
    assert (row.seed, row.episodes, row.iterations, row.env_steps) == (7, 3, 1, 1000)
    assert row.success == pytest.approx(info["overall"]["pc_success"] / 100)
    assert row.commit is None


@pytest.mark.parametrize("part", ["touch", "vision"])
def test_ablated_evaluation(evaluate, demos, part):
    info, rows = evaluate(part, f"--env.ablate={part}", f"--env.ablate_dataset={demos}")
    assert info["overall"]["n_episodes"] == len(rows) == 2
    assert np.isfinite([row["in_hand_shift_m"] for row in rows]).all()
