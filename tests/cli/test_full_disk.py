"""``vtrefine-record-demos`` on a disk that really is full: a file system of 3 MB in a mount namespace."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tiny_commands import TINY_ENV

NAMESPACE = ("unshare", "--user", "--map-root-user", "--mount", "sh", "-c")
SCRIPT = """
mount -t tmpfs -o size=3m tmpfs "$1" || exit 99
shift
"$@"
status=$?
cp -r disk/demos kept
exit $status
"""


def test_full_disk_is_one_line_and_saved_episodes_stay_readable(tmp_path: Path) -> None:
    if shutil.which("unshare") is None:
        pytest.skip("needs the command unshare")
    (tmp_path / "disk").mkdir()
    record = Path(sys.executable).with_name("vtrefine-record-demos")
    sizes = ("--num_episodes=60", "--num_envs=20")  # 20 episodes, the first commit, take 2.8 MB
    command = [
        *NAMESPACE,
        SCRIPT,
        "sh",
        str(tmp_path / "disk"),
        str(record),
        "--root=disk/demos",
        *sizes,
        *TINY_ENV,
    ]
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    if not (tmp_path / "kept").is_dir() and done.returncode in (1, 99):
        pytest.skip(f"no file system of its own here: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 2
    line = done.stderr.strip().splitlines()[-1]
    assert line.startswith("error: the disk is full: disk/demos keeps 20 episodes;")
    dataset = LeRobotDataset("local/vtrefine_demos", root=tmp_path / "kept")
    assert dataset.num_episodes == 20
    assert int(dataset[len(dataset) - 1]["episode_index"]) == 19
