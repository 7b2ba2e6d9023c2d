"""Stock `lerobot-record` in a process of its own, killed: what it announced loads, and it can be resumed."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from aloha_columns import TACTILE_KEYS
from commands import dataset_flags, follower_flags, leader_flags, run_command
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from rig import Rig

from lerobot_vtrefine.drivers.sources import check_pattern
from lerobot_vtrefine.lerobot_compat import safe_recording

FPS = 10
RECORD = """
import dynamixel_sdk.port_handler
from lerobot.scripts.lerobot_record import main

dynamixel_sdk.port_handler.LATENCY_TIMER = 120  # emulated motors share the processors with everything else
main()
"""


def announced(root: Path) -> int:
    path = root / "meta" / "info.json"
    return int(json.loads(path.read_text())["total_episodes"]) if path.is_file() else 0


def episodes_with_exact_pads(root: Path) -> int:
    dataset = LeRobotDataset("local/emulated", root=root)
    rows = dataset.hf_dataset.with_format("numpy")
    assert len(rows) >= len(dataset)
    for key in TACTILE_KEYS:
        assert None not in [check_pattern(counts.astype(np.uint8)) for counts in rows[key]]
    return dataset.num_episodes


def test_killed_recording_keeps_every_announced_episode(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "dataset"
    devices = [*follower_flags(rig), *leader_flags(rig)]
    command = [sys.executable, "-c", RECORD, *devices, *dataset_flags(root, 60, 0.5, FPS)]
    output = tmp_path / "output.txt"
    with output.open("w") as stream:
        running = subprocess.Popen(
            command, stdout=stream, stderr=stream, env={**os.environ, "HF_HUB_OFFLINE": "1"}
        )
    deadline = time.monotonic() + 240
    while announced(root) < 3:
        assert running.poll() is None, output.read_text()[-2000:]
        assert time.monotonic() < deadline
        time.sleep(0.02)
    running.kill()
    running.wait()
    before = announced(root)
    assert before >= 3
    assert episodes_with_exact_pads(root) == before
    told: list[str] = []
    monkeypatch.setattr(safe_recording.logger, "info", lambda text, *values: told.append(text % values))
    run_command(monkeypatch, "record", [*devices, *dataset_flags(root, 1, 0.5, FPS), "--resume=true"])
    assert len(told) == 1
    assert told[0].startswith(f"{root} holds ")
    there = int(told[0].split(" holds ")[1].split()[0])
    assert there in (before, before + 1)
    assert episodes_with_exact_pads(root) == announced(root) == there + 1
