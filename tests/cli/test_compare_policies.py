"""The comparison of policies trains each on the same demonstrations, and continues where it was."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from lerobot_vtrefine.cli.results.rows import Run, read_rows
from lerobot_vtrefine.cli.results.tables import table

SCRIPT = Path(__file__).parents[2] / "scripts" / "compare_policies.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("compare_policies", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.usefixtures("fake_commands")
def test_rows_grow_and_nothing_is_done_twice(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    results = tmp_path / "results" / "policies.json"
    common = ["--episodes=8", "--device=cpu", f"--output_dir={tmp_path / 'out'}", f"--results={results}"]

    def run(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["compare_policies.py", *common, *arguments])
        assert script.main() == 0
        return capsys.readouterr().err

    first = run("--seeds", "0", "--policies", "act_rgb")
    assert "done before" not in first
    again = run("--seeds", "0", "--policies", "act_rgb", "vt_dp3_paper")
    assert again.count("done before") == 4  # act_rgb's three stages, and the demonstrations for the other
    rows = read_rows(results)
    assert [(row.policy, row.seed, row.episodes) for row in rows if isinstance(row, Run)] == [
        ("act_rgb", 0, 8),
        ("vt_dp3_paper", 0, 8),
    ]
    assert "| LeRobot's ACT, colour | imitation, 100 demonstrations, 20000 steps |" in table("policies", rows)
    logs = {path.stem: path.read_text() for path in (tmp_path / "out" / "logs").glob("*.log")}
    assert logs["train_act_rgb_0"].count("demos_0") == logs["train_vt_dp3_paper_0"].count("demos_0") == 1
    assert "--env.rgb=true" in logs["eval_act_rgb_0"]
    assert "--env.rgb=false" in logs["eval_vt_dp3_paper_0"]


def test_a_misspelt_policy_is_told_before_anything_runs(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        sys, "argv", ["compare_policies.py", "--policies", "atc", f"--output_dir={tmp_path / 'out'}"]
    )
    assert script.main() == 2
    assert "atc" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
