"""Calibrations of arms take minutes by hand: what interrupts writing them leaves the one that was there."""

import errno
import os
from pathlib import Path
from typing import Any

import draccus
import pytest
from aloha_columns import PADS
from lerobot.motors import MotorCalibration

from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.robots import AlohaTactileFollowerConfig
from lerobot_vtrefine.robots.aloha_tactile_follower import AlohaTactileFollower
from lerobot_vtrefine.teleoperators.aloha_leader import AlohaLeader
from lerobot_vtrefine.teleoperators.config_aloha_leader import AlohaLeaderConfig

ENTRY = MotorCalibration(id=1, drive_mode=0, homing_offset=7, range_min=100, range_max=3000)


def follower(folder: Path) -> AlohaTactileFollower:
    pads = {name: PadConfig(f"/dev/{name}") for name in PADS}
    arms = {"left_port": "/dev/left", "right_port": "/dev/right"}
    return AlohaTactileFollower(AlohaTactileFollowerConfig(id="x", calibration_dir=folder, pads=pads, **arms))


def leader(folder: Path) -> AlohaLeader:
    arms = {"left_port": "/dev/left", "right_port": "/dev/right"}
    return AlohaLeader(AlohaLeaderConfig(id="x", calibration_dir=folder, **arms))


@pytest.mark.parametrize("make", [follower, leader])
def test_a_full_disk_leaves_the_calibration_that_was_there(
    make: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = make(tmp_path)
    device.calibration = {"left_waist": ENTRY}
    device._save_calibration()

    def full(_calibration: Any, file: Any, **_: Any) -> None:
        file.write("{")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(draccus, "dump", full)
        with pytest.raises(OSError, match="No space"):
            device._save_calibration()
    assert make(tmp_path).calibration == {"left_waist": ENTRY}
    assert [path.name for path in tmp_path.iterdir()] == ["x.json"]
