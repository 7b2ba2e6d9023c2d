"""The comparison of policies trains each on the same demonstrations, and continues where it was."""

import json
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import compare_policies as script
import pytest

from lerobot_vtrefine.cli.results.rows import Run, read_rows
from lerobot_vtrefine.cli.results.store import save
from lerobot_vtrefine.cli.results.tables import table


@pytest.fixture
def run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Run the script with these arguments beside the common ones; what it reported."""
    results = tmp_path / "results" / "policies.json"
    common = ["--episodes=8", "--device=cpu", f"--output_dir={tmp_path / 'out'}", f"--results={results}"]

    def run(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["compare_policies.py", *common, *arguments])
        assert script.main() == 0
        return capsys.readouterr().err

    return run


@pytest.mark.usefixtures("fake_commands")
def test_rows_grow_and_nothing_is_done_twice(
    run: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And each says which code trained it, not which wrote its row again."""
    code = ["0123abc"]
    monkeypatch.setattr("lerobot_vtrefine.cli.pipeline.stages.commit", lambda: code[-1])
    first = run("--seeds", "0", "--policies", "act_rgb")
    assert first.count("done before") == 1  # the demonstrations, when the policy's turn comes
    code.append("4567def")
    again = run("--seeds", "0", "1", "--policies", "act_rgb", "vt_dp3_pads_visual")
    assert again.count("done before") == 7  # five times the demonstrations, and the first policy's two stages
    rows = read_rows(tmp_path / "results" / "policies.json")
    assert [(row.policy, row.seed, row.episodes) for row in rows if isinstance(row, Run)] == [
        ("act_rgb", 0, 8),
        ("act_rgb", 1, 8),
        ("vt_dp3_pads_visual", 0, 8),
        ("vt_dp3_pads_visual", 1, 8),
    ]
    assert [row.commit for row in rows] == ["0123abc", *["4567def"] * 3]
    shown = table("policies", rows)
    assert (
        "| LeRobot's ACT: colour | 200 demonstrations, 5000 steps of 64 | 25 % [25, 25] (25, 25) | 8 |"
        in shown
    )
    logs = {path.stem: path.read_text() for path in (tmp_path / "out" / "logs").glob("*.log")}
    assert sum("vtrefine-record-demos" in log for log in logs.values()) == 1
    assert all("out/demos " in log for name, log in logs.items() if name.startswith("train"))
    assert "--policy.modalities=visual" in logs["train_vt_dp3_pads_visual_1"]
    assert "--env.rgb=true" in logs["eval_act_rgb_0"]
    assert "--env.rgb=false" in logs["eval_vt_dp3_pads_visual_0"]


def test_one_policy_alone_has_the_options_of_all() -> None:
    given = ["--seeds", "0", "1", "--jobs", "4", "--steps", "7", "--backend", "warp", "--commit", "abcdef1"]
    options = script.make_parser().parse_args(given)
    words = script.alone(options, "act_rgb", 1)
    again = vars(script.make_parser().parse_args(words[2:]))
    assert again == vars(options) | {"policies": ["act_rgb"], "seeds": [1], "jobs": 1}


def _save_rows(path: Path, first: int) -> None:
    for seed in range(first, first + 10):
        origin = dict.fromkeys(("commit", "command", "machine"))
        row = Run(
            table="policies",
            task="t",
            policy="p",
            seed=seed,
            success=1.0,
            episodes=1,
            iterations=0,
            env_steps=0,
            **origin,
        )
        save(path, [(row, [])], replace=False)


def test_rows_that_come_together_are_all_kept(tmp_path: Path) -> None:
    path = tmp_path / "results" / "policies.json"
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(partial(_save_rows, path), (0, 10, 20)))
    assert len(json.loads(path.read_text())["rows"]) == 30


def test_a_misspelt_task_is_told_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        sys, "argv", ["compare_policies.py", "--task", "rund", f"--output_dir={tmp_path / 'out'}"]
    )
    assert script.main() == 2
    assert "rund" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_gpu_that_is_not_there_is_told_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr(script, "StageRunner", lambda *_: pytest.fail("it went on"))
    monkeypatch.setattr(sys, "argv", ["compare_policies.py", f"--output_dir={tmp_path / 'out'}"])
    assert script.main() == 2
    assert "--device=cuda: no CUDA GPU with a driver here; --device=cpu" in capsys.readouterr().err
