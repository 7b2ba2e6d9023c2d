"""Any robot plus pads by composition, and a pad that poses as a depth camera."""

import time
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import pytest
from lerobot.cameras.configs import CameraConfig
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils import feature_utils
from rig import boards_of

from lerobot_vtrefine.cameras import FlexitacCameraConfig
from lerobot_vtrefine.drivers.emulator import PadEmulator
from lerobot_vtrefine.drivers.ports import PortError
from lerobot_vtrefine.drivers.sources import check_pattern
from lerobot_vtrefine.lerobot_compat import pad_ages


@RobotConfig.register_subclass("stub_arm")
@dataclass(kw_only=True)
class StubArmConfig(RobotConfig):
    port: str = "none"


class StubCamera:
    """Somebody else's depth camera, which does not know its intrinsics."""

    use_depth = True
    config = None


class StubArm(Robot):
    """A robot of somebody else's, with one joint."""

    config_class = StubArmConfig
    name = "stub_arm"
    is_connected = False
    is_calibrated = True

    def __init__(self, config: StubArmConfig) -> None:
        super().__init__(config)
        self.position = 0.25
        self.cameras = {"top": StubCamera()}

    @property
    def action_features(self) -> dict[str, Any]:
        return {"joint.pos": float}

    observation_features = action_features

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def calibrate(self) -> None:
        self.position = 0.0

    def configure(self) -> None:
        pass

    def get_observation(self) -> dict[str, Any]:
        return {"joint.pos": self.position}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.position = action["joint.pos"]
        return action

    def disconnect(self) -> None:
        self.is_connected = False


@pytest.fixture
def boards(tmp_path: Path) -> Generator[dict[str, PadEmulator]]:
    with boards_of(tmp_path, ("thumb", "index")) as built:
        yield built


def tactile_robot(boards: dict[str, PadEmulator], folder: Path, **changes: Any) -> Any:
    settings = {
        "type": "tactile",
        "id": "rig",
        "calibration_dir": str(folder),
        "base": {"type": "stub_arm"},
        "pads": {name: {"port": board.port} for name, board in boards.items()},
        "camera_models": {"top": {"intrinsics": [1, 2, 3, 4], "pose": [0, 0, 1, 1, 0, 0, 0]}},
    }
    return make_robot_from_config(draccus.decode(RobotConfig, settings | changes))


def test_base_robot_and_pads_speak_as_one(boards: dict[str, PadEmulator], tmp_path: Path) -> None:
    robot = tactile_robot(boards, tmp_path)
    assert robot.base.id == "rig"
    robot.connect()
    robot.send_action({"joint.pos": 0.5})
    observation = robot.get_observation()
    robot.disconnect()
    assert set(observation) == set(robot.observation_features)
    assert observation["joint.pos"] == 0.5
    assert check_pattern(observation["tactile.thumb"]) is not None
    assert observation["camera.top.intrinsics"].tolist() == [1, 2, 3, 4]
    assert observation["camera.top.noise_level"].tolist() == [0]
    assert robot.action_features == {"joint.pos": float}
    assert not robot.base.is_connected
    assert not robot.pads.is_connected


def test_the_order_in_which_pads_are_named_makes_no_difference(
    boards: dict[str, PadEmulator], tmp_path: Path
) -> None:
    either, other = (
        tactile_robot(dict(order), tmp_path) for order in (boards.items(), reversed(boards.items()))
    )
    assert list(either.observation_features) == list(other.observation_features)
    for robot in (either, other):
        robot.connect()
        boards["thumb"].stall(1.0)
        time.sleep(0.3)
        ages = robot.get_observation()["tactile_age"]
        robot.disconnect()
        assert ages[0] < ages[1]  # index, thumb
        boards["thumb"].stall(0.0)


def test_a_recording_with_pads_in_another_order_is_resumed_in_its_own(
    boards: dict[str, PadEmulator], tmp_path: Path
) -> None:
    """As they were recorded when pads came in the order of the pads file."""
    robot = tactile_robot(boards, tmp_path)
    columns = feature_utils.hw_to_dataset_features(robot.observation_features, "observation")
    pads = {key: columns.pop(f"observation.{key}") for key in ("tactile.thumb", "tactile.index")}
    earlier = {f"observation.{key}": feature for key, feature in pads.items()} | columns
    robot.connect()
    boards["thumb"].stall(1.0)
    time.sleep(0.3)
    values = robot.get_observation()
    robot.disconnect()
    frame = feature_utils.build_dataset_frame(earlier, values, "observation")
    assert frame["observation.tactile_age"].tolist() == values["tactile_age"][::-1].tolist()
    assert frame["observation.tactile_age"][0] > 0.2  # thumb
    assert frame["observation.tactile_age"][1] < 0.2
    for pad in ("thumb", "index"):
        assert (frame[f"observation.tactile.{pad}"] == values[f"tactile.{pad}"]).all()
    known = pad_ages._order.cache_info().misses
    feature_utils.build_dataset_frame(earlier, values, "observation")
    assert pad_ages._order.cache_info().misses == known  # names are compared once for a recording


def test_failing_pad_leaves_nothing_connected(boards: dict[str, PadEmulator], tmp_path: Path) -> None:
    pads = {"thumb": {"port": boards["thumb"].port}, "index": {"port": str(tmp_path / "nowhere")}}
    robot = tactile_robot(boards, tmp_path, pads=pads)
    with pytest.raises(PortError, match="nowhere does not exist"):
        robot.connect()
    assert not robot.base.is_connected
    tactile_robot(boards, tmp_path).connect()  # the thumb's port is free again


def test_making_a_robot_extends_the_stock_commands(boards: dict[str, PadEmulator], tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.utils import feature_utils, visualization_utils

    from lerobot_vtrefine.lerobot_compat import arrays, card, live_view

    for part in (arrays, card, live_view):
        part.uninstall()
    before = feature_utils.build_dataset_frame, visualization_utils.log_rerun_data, LeRobotDataset.push_to_hub
    tactile_robot(boards, tmp_path)
    after = feature_utils.build_dataset_frame, visualization_utils.log_rerun_data, LeRobotDataset.push_to_hub
    assert not set(before) & set(after)


@pytest.mark.parametrize(
    ("base", "message"),
    [
        ({}, "one of .*stub_arm"),
        ({"type": "no_such_arm"}, "got 'no_such_arm'"),
        ({"type": "tactile"}, "got 'tactile'"),
        ({"type": "stub_arm", "prot": "x"}, "of type stub_arm: .*prot"),
    ],
)
def test_wrong_base_is_explained(
    boards: dict[str, PadEmulator], tmp_path: Path, base: dict[str, str], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        tactile_robot(boards, tmp_path, base=base)


def test_pad_as_depth_camera_is_exact(boards: dict[str, PadEmulator]) -> None:
    config = draccus.decode(CameraConfig, {"type": "flexitac", "port": boards["thumb"].port})
    camera: Any = make_cameras_from_configs({"thumb": config})["thumb"]
    camera.connect()
    frames = [camera.async_read(timeout_ms=5000), camera.read_latest_depth(max_age_ms=5000), camera.read()]
    boards["thumb"].unplug()
    time.sleep(0.3)
    with pytest.raises(TimeoutError, match="thumb"):
        camera.read_latest_depth(max_age_ms=200)
    camera.disconnect()
    for frame in frames:
        assert frame.shape == (12, 32, 1)
        assert frame.dtype == np.uint16
        assert check_pattern(frame.astype(np.uint8)) is not None
    assert (config.height, config.width, config.use_rgb) == (12, 32, False)


def test_depth_camera_takes_a_pads_settings() -> None:
    settings = {"type": "flexitac", "port": "x", "rows": 16, "pad_rows": 12, "row_offset": 4}
    config = draccus.decode(CameraConfig, settings | {"protocol": "ascii", "stale_after_s": 0.5})
    assert isinstance(config, FlexitacCameraConfig)
    assert (config.height, config.width, config.fps) == (12, 32, 100)
    assert (config.protocol, config.stale_after_s) == ("ascii", 0.5)
    with pytest.raises(ValueError, match="row_offset=16"):
        FlexitacCameraConfig(port="x", row_offset=16)


def test_depth_camera_refuses_what_it_is_not() -> None:
    for wrong in ({"use_rgb": True}, {"width": 640, "height": 480}):
        with pytest.raises(ValueError, match="flexitac camera"):
            FlexitacCameraConfig(port="x", **wrong)
