"""Array features through LeRobot's own recorder, with a robot made of numbers."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lerobot.scripts.lerobot_record as recorder
import lerobot.utils.feature_utils as feature_utils
import numpy as np
import pytest
from lerobot.configs.dataset import DatasetRecordConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

from lerobot_vtrefine.lerobot_compat import arrays
from lerobot_vtrefine.lerobot_compat.arrays import ArraySpec

TAXELS = {"array_shape": [12, 32], "unit": "adc_counts"}


@pytest.fixture(autouse=True)
def restore() -> Iterator[None]:
    """Leave LeRobot as it was."""
    yield
    arrays.uninstall()


@RobotConfig.register_subclass("numbers_robot")
@dataclass(kw_only=True)
class NumbersRobotConfig(RobotConfig):
    """A robot without hardware."""


class NumbersRobot(Robot):
    """One joint, one pad whose counts tell the frame's number, one constant camera column."""

    config_class = NumbersRobotConfig
    name = "numbers_robot"

    def __init__(self, config: NumbersRobotConfig) -> None:
        arrays.install()
        super().__init__(config)
        self.cameras: dict[str, Any] = {}
        self.frames = 0

    @property
    def observation_features(self) -> dict[str, Any]:
        return {
            "joint.pos": float,
            "tactile.pad": ArraySpec((384,), "uint8", TAXELS),
            "camera.front.pose": ArraySpec((7,)),
        }

    @property
    def action_features(self) -> dict[str, Any]:
        return {"joint.pos": float}

    @property
    def is_connected(self) -> bool:
        return True

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        pass

    def disconnect(self) -> None:
        pass

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def get_observation(self) -> dict[str, Any]:
        self.frames += 1
        counts = np.full((12, 32), self.frames, np.uint8)
        return {"joint.pos": 0.5, "tactile.pad": counts, "camera.front.pose": np.arange(7.0)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return action


@TeleoperatorConfig.register_subclass("numbers_teleop")
@dataclass(kw_only=True)
class NumbersTeleopConfig(TeleoperatorConfig):
    """A teleoperator without hardware."""


class NumbersTeleop(Teleoperator):
    """Always asks for the same joint position."""

    config_class = NumbersTeleopConfig
    name = "numbers_teleop"
    is_connected = True
    is_calibrated = True
    action_features = {"joint.pos": float}  # noqa: RUF012
    feedback_features = {}  # noqa: RUF012

    def connect(self, calibrate: bool = True) -> None:
        pass

    def disconnect(self) -> None:
        pass

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def get_action(self) -> dict[str, Any]:
        return {"joint.pos": 0.25}

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        pass


def record(root: Path, monkeypatch: pytest.MonkeyPatch, resume: bool = False) -> LeRobotDataset:
    """One episode of about half a second through ``lerobot-record``'s own function."""
    monkeypatch.setattr(recorder, "make_robot_from_config", NumbersRobot)
    monkeypatch.setattr(recorder, "make_teleoperator_from_config", NumbersTeleop)
    dataset = DatasetRecordConfig(
        repo_id="local/numbers",
        single_task="count",
        root=root,
        fps=20,
        episode_time_s=0.5,
        reset_time_s=0,
        num_episodes=1,
        video=False,
        push_to_hub=False,
    )
    robot, teleop = NumbersRobotConfig(), NumbersTeleopConfig()
    config = recorder.RecordConfig(
        robot=robot, dataset=dataset, teleop=teleop, play_sounds=False, resume=resume
    )
    return recorder.record(config)


def test_stock_recorder_carries_and_resumes_arrays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "numbers"
    record(root, monkeypatch)
    record(root, monkeypatch, resume=True)
    stored = LeRobotDataset("local/numbers", root=root)
    assert stored.meta.total_episodes == 2
    assert stored.meta.features["observation.tactile.pad"] == {
        "dtype": "uint8",
        "shape": (384,),
        "info": TAXELS,
    }
    first = stored[0]
    assert first["observation.camera.front.pose"].tolist() == list(range(7))
    counts = [int(stored[index]["observation.tactile.pad"].unique().item()) for index in range(len(stored))]
    start = stored.meta.episodes[1]["dataset_from_index"]
    assert counts[:start] == list(range(counts[0], counts[0] + start))
    assert first["observation.state"].item() == 0.5


def test_install_reaches_every_binding_and_uninstall_restores_them() -> None:
    stock = feature_utils.build_dataset_frame
    arrays.install()
    arrays.install()
    assert recorder.build_dataset_frame is feature_utils.build_dataset_frame is not stock
    arrays.uninstall()
    assert recorder.build_dataset_frame is feature_utils.build_dataset_frame is stock


def test_features_without_arrays_are_untouched() -> None:
    stock = feature_utils.hw_to_dataset_features
    declared = {"joint.pos": float, "top": (48, 64, 3)}
    expected = stock(declared, "observation", False)
    arrays.install()
    assert feature_utils.hw_to_dataset_features(declared, "observation", False) == expected


def test_wrong_arrays_are_named() -> None:
    with pytest.raises(ValueError, match="1-D"):
        ArraySpec((12, 32))
    arrays.install()
    features = feature_utils.hw_to_dataset_features({"pad": ArraySpec((2,), "uint8")}, "observation")
    with pytest.raises(ValueError, match=r"observation\.pad must be uint8"):
        feature_utils.build_dataset_frame(features, {"pad": np.zeros(2)}, "observation")


def test_untested_lerobot_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "is_supported", lambda: False)
    with pytest.raises(RuntimeError, match=r"needs lerobot >=0\.6\.1,<0\.7, found 0"):
        arrays.install()
