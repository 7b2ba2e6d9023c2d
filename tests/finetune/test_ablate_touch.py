"""``scripts/ablate_touch.py``: the shipped policy loses what its pads told it."""

import json
from pathlib import Path

import ablate_touch
import pytest

ROOT = Path(__file__).parents[2]
POLICY = ROOT / "lerobot_vtrefine" / "assets" / "policies" / "square_grasped_1mm"
TASK = ROOT / "configs" / "env" / "square_grasped_1mm.yaml"


def run(patch: pytest.MonkeyPatch, *options: str) -> int:
    """The script's exit status."""
    patch.setattr("sys.argv", ["ablate_touch.py", "--policy", str(POLICY), "--task", str(TASK), *options])
    return ablate_touch.main()


def test_one_line_for_every_kind_of_touch(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "--episodes=3", "--kinds", "none", "touch_shuffled") == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    assert [row["ablate"] for row in rows] == ["none", "touch_shuffled"]
    assert rows[0]["episodes"] == 3
    assert rows[0]["eval_success"] > 0.5


def test_touch_from_elsewhere_needs_to_know_from_where(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "--kinds", "touch_other") != 0
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith("error: --kinds touch_other needs --dataset=FOLDER")
