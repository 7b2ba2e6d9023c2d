"""``scripts/ablate_touch.py``: the shipped policy loses what its pads told it."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
POLICY = ROOT / "lerobot_vtrefine" / "assets" / "policies" / "square_grasped_1mm"
COMMAND = [
    *(sys.executable, ROOT / "scripts" / "ablate_touch.py"),
    *("--policy", POLICY, "--task", ROOT / "configs" / "env" / "square_grasped_1mm.yaml"),
]


def run(*options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*map(str, COMMAND), *options], capture_output=True, text=True, check=False, timeout=300
    )


def test_one_line_for_every_kind_of_touch() -> None:
    found = run("--episodes=3", "--kinds", "none", "touch_shuffled")
    rows = [json.loads(line) for line in found.stdout.splitlines() if line.startswith("{")]
    assert [row["ablate"] for row in rows] == ["none", "touch_shuffled"], found.stderr
    assert rows[0]["episodes"] == 3
    assert rows[0]["eval_success"] > 0.5


def test_touch_from_elsewhere_needs_to_know_from_where() -> None:
    found = run("--kinds", "touch_other")
    assert found.returncode != 0
    assert found.stderr.splitlines()[-1].startswith("error: --kinds touch_other needs --dataset=FOLDER")
