"""Fixtures that several tests of emulated arms share."""

from collections.abc import Generator
from pathlib import Path

import pytest
from rig import Rig, allow_slow_answers, aloha_rig, follower_config

from lerobot_vtrefine.robots.aloha_tactile_follower import AlohaTactileFollower


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[Rig]:
    """Followers, leaders and boards on ports of their own."""
    allow_slow_answers(monkeypatch)
    with aloha_rig(tmp_path) as built:
        yield built


@pytest.fixture
def follower(rig: Rig) -> Generator[AlohaTactileFollower]:
    """A connected follower with pads, released at the end."""
    robot = AlohaTactileFollower(follower_config(rig))
    robot.connect()
    yield robot
    if robot.is_connected:
        robot.disconnect()
