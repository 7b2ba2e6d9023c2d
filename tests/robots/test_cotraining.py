"""Recorded and simulated demonstrations in one dataset, as the paper's co-training needs them."""

from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest
from aloha_columns import TACTILE_KEYS
from commands import dataset_flags, flags, follower_flags, leader_flags, run_command, train
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from realsense import FakeDepthCamera, camera_flag, plug_in
from rig import Rig, allow_slow_answers, aloha_rig

from lerobot_vtrefine.cli.record_demos import RecordDemosConfig
from lerobot_vtrefine.cli.record_demos import record as simulate
from lerobot_vtrefine.datasets.features import ACTION_KEY, AGE_KEY, DEPTH_KEY, NOISE_LEVEL_KEY, STATE_KEY
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.robots.aloha_tactile_follower import AlohaTactileFollower
from lerobot_vtrefine.sim.config import CameraConfig, SceneConfig

FPS = 10
CAMERA = FakeDepthCamera()
POSE = "{front: {pose: [0.0, 0.0, 0.75, 0.0, 1.0, 0.0, 0.0]}}"


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[Rig]:
    allow_slow_answers(monkeypatch)
    plug_in(monkeypatch, CAMERA)
    with aloha_rig(tmp_path / "rig") as built:
        yield built


def record_on_hardware(rig: Rig, root: Path, patch: pytest.MonkeyPatch) -> LeRobotDataset:
    camera = flags(robot__cameras=camera_flag(CAMERA), robot__camera_models=POSE)
    command = [*follower_flags(rig), *camera, *leader_flags(rig), *dataset_flags(root, 1, 1.5, FPS)]
    run_command(patch, "record", command)
    return LeRobotDataset("local/recorded", root=root)


def record_in_simulation(root: Path) -> LeRobotDataset:
    lens = CameraConfig(CAMERA.width, CAMERA.height, 0.384, (-0.44, 0.0, 0.42), (0.0, 0.0, 0.145))
    env = VtRefineEnvConfig(
        fps=FPS, start="grasped", pair="square", episode_steps=12, scene=SceneConfig(camera=lens)
    )
    simulate(RecordDemosConfig(root=root, num_episodes=1, num_envs=1, env=env, include_failures=True))
    return LeRobotDataset("local/simulated", root=root)


def column(dataset: LeRobotDataset, key: str) -> np.ndarray:
    return np.stack([dataset[index][key].numpy() for index in range(len(dataset))])


def test_recorded_and_simulated_demonstrations_merge_and_train(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    real = record_on_hardware(rig, tmp_path / "real", monkeypatch)
    simulated = record_in_simulation(tmp_path / "simulated")
    merge = flags(
        operation__type="merge",
        operation__repo_ids="[local/recorded, local/simulated]",
        operation__roots=f"[{real.root}, {simulated.root}]",
        new_repo_id="local/both",
        new_root=tmp_path / "both",
    )
    run_command(monkeypatch, "edit_dataset", merge)
    both = LeRobotDataset("local/both", root=tmp_path / "both")
    assert (both.meta.total_episodes, len(both)) == (2, len(real) + len(simulated))
    for key in (STATE_KEY, ACTION_KEY, *TACTILE_KEYS, AGE_KEY, DEPTH_KEY):
        parts = np.concatenate([column(real, key), column(simulated, key)])
        assert np.array_equal(column(both, key), parts), key
    assert (column(both, NOISE_LEVEL_KEY).ravel() > 0).tolist() == [False] * len(real) + [True] * len(
        simulated
    )
    checkpoint = train(monkeypatch, tmp_path / "both", tmp_path / "run", steps=3)
    assert (checkpoint / "model.safetensors").is_file()
    replay_on_hardware(rig, simulated, monkeypatch)


def replay_on_hardware(rig: Rig, simulated: LeRobotDataset, patch: pytest.MonkeyPatch) -> None:
    """What was simulated moves the arms, by LeRobot's own command."""
    sent: list[dict[str, float]] = []
    send = AlohaTactileFollower.send_action

    def noting(robot: AlohaTactileFollower, action: dict[str, float]) -> dict[str, float]:
        sent.append(send(robot, action))
        return sent[-1]

    patch.setattr(AlohaTactileFollower, "send_action", noting)
    episode = flags(dataset__repo_id="local/simulated", dataset__root=simulated.root, dataset__episode=0)
    run_command(patch, "replay", [*follower_flags(rig), *episode, "--play_sounds=false"])
    wanted = column(simulated, ACTION_KEY)
    assert len(sent) == len(wanted)
    assert list(sent[-1].values()) == pytest.approx(wanted[-1].tolist(), abs=1e-3)


def test_the_simulated_robot_is_called_as_the_recorded_one() -> None:
    assert get_embodiment("aloha").robot_type == AlohaTactileFollower.name
