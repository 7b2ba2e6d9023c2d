"""A study of a task becomes a line of the table, with the verdict that the study itself gives."""

import json
import sys
from pathlib import Path

import draccus
import judge_tasks as script
import pytest

from lerobot_vtrefine.cli.information import InformationConfig
from lerobot_vtrefine.cli.results.rows import read_rows
from lerobot_vtrefine.information.contact import SIDE
from lerobot_vtrefine.information.estimator import POLICY, STRONG
from lerobot_vtrefine.information.quantities import NAMES
from lerobot_vtrefine.information.study import Effort, Finding, Study, as_json


def finding(senses: str, history: int, error: float, successes: int, network: str = POLICY) -> Finding:
    rms, side = dict.fromkeys(NAMES, (error, error, error)), {SIDE: (1 - error / 10, 0.0, 1.0)}
    return Finding(senses, history, rms, (successes, 100), network, side)


def write_study(folder: Path, vision: int) -> None:
    found = Study(
        dict.fromkeys(NAMES, 9.0),
        [
            finding("visual", 1, 4.0, vision - 20),
            finding("visual", 10, 3.5, vision - 10),
            finding("visual", 10, 3.0, vision, STRONG),
            finding("visuo_tactile", 1, 0.5, 94),
            finding("visuo_tactile", 10, 0.7, 91),
        ],
        (100, 100),
        contact_unseen={SIDE: 0.3},
    )
    folder.mkdir(parents=True)
    (folder / "information.json").write_text(json.dumps(as_json(found, Effort())))


def test_rows_hold_the_best_of_each_sense_and_the_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_study(tmp_path / "information_hard", vision=60)
    write_study(tmp_path / "information_easy", vision=80)
    results = tmp_path / "touch_tasks.json"
    arguments = ["hard", "easy", f"--outputs={tmp_path}", f"--results={results}"]
    monkeypatch.setattr(sys, "argv", ["judge_tasks.py", *arguments])
    assert script.main() == 0
    rows = {row.cells["task"]: row.cells for row in read_rows(results)}
    assert rows["hard"]["vision and touch, %"].startswith("94 [")
    assert rows["hard"]["vision, %"].startswith("60 [")
    assert rows["hard"]["joints alone, %"] == "-"
    assert "9.0, 0.5, 3.0" in rows["hard"].values()
    assert "30, 95, 70" in rows["hard"].values()
    assert (rows["hard"][""], rows["easy"][""]) == ("needs touch", "vision suffices")


def test_a_study_has_both_networks_unless_told_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []

    def run(commands: dict[Path, list[str]], jobs: int) -> None:
        ((folder, command),) = commands.items()
        asked.append(command)
        write_study(folder, vision=60)

    monkeypatch.setattr(script, "run_all", run)
    arguments = ["hard", f"--outputs={tmp_path}", f"--results={tmp_path / 'touch_tasks.json'}"]
    monkeypatch.setattr(sys, "argv", ["judge_tasks.py", *arguments, "--effort.networks=[policy]"])
    assert script.main() == 0
    both, given = (word for word in asked[0] if word.startswith("--effort.networks="))
    assert (both, given) == ("--effort.networks=[policy, strong]", "--effort.networks=[policy]")
    # LeRobot's parser takes the last of them.
    task = ["--env.type=vtrefine", "--env.start=grasped"]
    assert draccus.parse(InformationConfig, args=[*task, both, given]).effort.networks == ("policy",)
    assert draccus.parse(InformationConfig, args=[*task, both]).effort.networks == ("policy", "strong")
