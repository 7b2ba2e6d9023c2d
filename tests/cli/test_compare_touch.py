"""The comparison takes means over seeds, pairs these, and says only what its interval shows."""

import json
import sys
from pathlib import Path

import compare_touch as script
import pytest
import yaml
from runs.side_by_side import shares

from lerobot_vtrefine.cli import demo

CONFIGS = Path(__file__).parents[2] / "configs" / "env"


def run_of(pretrain: int, finetune: int) -> dict:
    return {
        name: {"success": count, "episodes": 100, "rate": count / 100}
        for name, count in (("pretrain", pretrain), ("finetune", finetune))
    }


def test_pools_and_pairs() -> None:
    touch = {seed: run_of(20, 80 + seed) for seed in range(3)}
    sight = {seed: run_of(20, 50 + seed) for seed in range(3)}
    comparison = script.compare({"visuo_tactile": touch, "visual": sight})
    assert comparison["finetune"]["visuo_tactile"]["success"] == 243
    assert comparison["finetune"]["visuo_tactile"]["episodes"] == 300
    assert comparison["finetune"]["touch_minus_visual"] == {"mean": 0.3, "ci95": [0.3, 0.3]}
    assert "touch pays" in script.as_text({"demo": comparison})


def test_noise_is_called_noise() -> None:
    touch = {0: run_of(20, 90), 1: run_of(20, 40), 2: run_of(20, 60)}
    sight = {0: run_of(20, 50), 1: run_of(20, 60), 2: run_of(20, 55)}
    text = script.as_text({"demo": script.compare({"visuo_tactile": touch, "visual": sight})})
    assert "makes no difference that these seeds can show" in text
    assert "| 63 % [1, 100] (seeds: 90, 40, 60) |" in text  # over seeds; over 300 episodes it is [58, 69]
    alone = script.compare({"visuo_tactile": {0: run_of(20, 90)}, "visual": {0: run_of(20, 50)}})
    assert "| 90 % [83, 94] (seeds: 90) |" in script.as_text({"demo": alone})


FAKE_DEMO = """#!{python}
import json, os, sys
from pathlib import Path
flags = dict(flag.removeprefix("--").split("=", 1) for flag in sys.argv[1:])
if flags["seed"] == flags.get("fail"):
    sys.exit(3)
folder = Path(flags["output_dir"])
folder.mkdir(parents=True)
rate = 80 if flags["modalities"] == "visual" else 60
run = dict(success=rate, episodes=100, rate=rate / 100)
cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
gpu = os.environ.get("CUDA_VISIBLE_DEVICES")
results = dict(pretrain=run, finetune=run, flags=flags, cores=cores, gpu=gpu)
(folder / "results.json").write_text(json.dumps(results))
"""


@pytest.fixture
def fake_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "bin"
    folder.mkdir()
    command = folder / "vtrefine-demo"
    command.write_text(FAKE_DEMO.format(python=sys.executable))
    command.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(folder / "python"))


@pytest.mark.parametrize("jobs", [1, 2])
def test_passes_flags_on_and_saves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fake_demo: None, jobs: int
) -> None:
    out = tmp_path / "out"
    arguments = ["--seeds", "3", "4", f"--output_dir={out}", "--num_demos=9", f"--jobs={jobs}"]
    monkeypatch.setattr(sys, "argv", ["compare_touch.py", *arguments])
    assert script.main() == 0
    runs = [json.loads(path.read_text()) for path in sorted(out.glob("demo/*/results.json"))]
    assert [(run["flags"]["modalities"], run["flags"]["seed"]) for run in runs] == [
        ("visual", "3"),
        ("visual", "4"),
        ("visuo_tactile", "3"),
        ("visuo_tactile", "4"),
    ]
    assert all(run["flags"]["num_demos"] == "9" for run in runs)
    parts = [share.cores for share in shares(jobs)]
    assert jobs == 1 or not parts[0] or all(run["cores"] in parts for run in runs)
    assert json.loads((out / "comparison.json").read_text())["demo"]["finetune"]["visual"]["rate"] == 0.8
    assert "touch costs" in (out / "comparison.md").read_text()


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_failed_run_ends_the_comparison(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fake_demo: None, jobs: int
) -> None:
    out = tmp_path / "out"
    arguments = ["--seeds", "3", "4", f"--output_dir={out}", "--fail=4", f"--jobs={jobs}"]
    monkeypatch.setattr(sys, "argv", ["compare_touch.py", *arguments])
    assert script.main() == 3
    assert not (out / "comparison.json").exists()
    assert len(list(out.glob("demo/*_3/results.json"))) == 2  # the others went on


def test_runs_side_by_side_take_gpus_by_turns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fake_demo: None
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,7")
    monkeypatch.setattr(sys, "argv", ["compare_touch.py", f"--output_dir={tmp_path}", "--jobs=6"])
    assert script.main() == 0
    runs = [json.loads(path.read_text()) for path in tmp_path.glob("demo/*/results.json")]
    assert sorted(run["gpu"] for run in runs) == ["5", "5", "5", "7", "7", "7"]


def test_every_setting_is_a_task_that_the_demo_accepts() -> None:
    for setting, changes in script.SETTINGS.items():
        config = demo.parse_config(script.setting_flags(setting))  # parses the stages' flags too
        for part, values in changes.items():
            assert values.items() <= getattr(config, part).items()
        assert config.env["pair"] == "round"
        assert config.policy["preset"] == "small"
        assert "fusion" not in config.policy, "the paper's cloud is what is compared"


def test_many_worlds_are_the_recipe_of_the_docs() -> None:
    for setting in script.WORLDS:
        config = demo.parse_config(script.setting_flags(setting))
        assert (config.finetune_envs, config.finetune_iterations, config.device) == (1024, 36, "cuda")
        assert config.dppo == {"type": "trust_region", "encoder": "frozen"}
        assert config.policy["fusion"] == "pads"
        assert config.env["backend"] == "warp"
        assert config.env["start"] == "grasped"


def test_touch_tasks_are_the_files_with_the_tasks_encoders() -> None:
    """A twin has its task's; one that does not come with the package lies where its study leaves it."""
    tasks = [name for task in script.TOUCH_TASKS for name in (task, f"{task}_twin")]
    assert set(tasks) == set(script.WORLDS) - {"worlds_round", "worlds_square", "worlds_key"}
    for task in tasks:
        flags = dict(flag.removeprefix("--").split("=", 1) for flag in script.setting_flags(task))
        settings = yaml.safe_load((CONFIGS / f"{task}.yaml").read_text())["env"]
        assert json.loads(flags["env"]) == settings | {"backend": "warp"}
        encoder = json.loads(flags["policy"])["pretrained_encoder"]
        key = task.startswith("key_turned")
        assert encoder == (
            "outputs/information_key_turned" if key else f"vtrefine:{task.removesuffix('_twin')}"
        )


def test_settings_are_compared_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fake_demo: None
) -> None:
    out = tmp_path / "out"
    arguments = ["--seeds", "0", "--settings", "slip", "short_chunk", f"--output_dir={out}"]
    monkeypatch.setattr(sys, "argv", ["compare_touch.py", *arguments])
    assert script.main() == 0
    assert set(json.loads((out / "comparison.json").read_text())) == {"slip", "short_chunk"}
    flags = json.loads((out / "slip" / "visual_0" / "results.json").read_text())["flags"]
    assert json.loads(flags["env"])["rules"] == {"grasped": {"slip_m": 0.004, "slip_rad": 0.1}}
    assert "| short_chunk | after DPPO |" in (out / "comparison.md").read_text()


def test_a_wrong_flag_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["compare_touch.py", "--jobs=0"])
    assert script.main() == 2
    assert capsys.readouterr().err == "error: --jobs must be at least 1, got 0; --help lists the flags\n"
