"""``vtrefine-replay`` on datasets with and without touch; bad input ends in one line."""

import base64
import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from lerobot_vtrefine.cli.record_demos import RecordDemosConfig, record
from lerobot_vtrefine.cli.replay import ReplayConfig, SourceConfig, describe, replay
from lerobot_vtrefine.datasets.importers.joint_episodes import JointEpisode, write_dataset
from lerobot_vtrefine.diagnose.episode_replay.reach import (
    describe_reach,
    hand_reaches,
    lowest_edges,
    part_top_m,
)
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.pairs import load_pair

ROBOT = get_embodiment("aloha")


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("replay") / "demos"
    env = VtRefineEnvConfig(start="grasped", pair="square", episode_steps=12)
    record(RecordDemosConfig(root=root, num_episodes=2, num_envs=2, seed=3, env=env, include_failures=True))
    return root


@pytest.fixture(scope="module")
def joints_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("replay") / "joints"
    rng = np.random.default_rng(0)
    episodes = []
    for frames in (25, 18):
        command = ROBOT.home + rng.normal(0, 0.01, (frames, 16)).cumsum(0)
        command[:, [6, 7, 14, 15]] = ROBOT.home[[6, 7, 14, 15]]
        episodes.append(JointEpisode(command.astype(np.float32), command.astype(np.float32)))
    write_dataset(episodes, ROBOT.joint_names, root, "local/joints", 10, "move")
    return root


def test_a_simulated_recording_is_reproduced_touch_included(demos: Path, tmp_path: Path) -> None:
    comparison = replay(ReplayConfig(tmp_path / "out", SourceConfig(demos)))
    assert comparison.parts == "recorded"
    assert [pad.identical_frames for pad in comparison.touch] == [24] * 4
    assert all(pad.touched[0] > 0 for pad in comparison.touch)
    assert max(row.peak for row in comparison.tracking) == 0.0
    summary = json.loads((tmp_path / "out" / "replay.json").read_text())
    assert summary["schema"] == "vtrefine/replay@1"
    assert "24 of 24 frames identical" in "\n".join(describe(comparison))
    page = (tmp_path / "out" / "report.html").read_text()
    source = re.search(r'src="data:video/mp4;base64,([^"]+)"', page)
    assert source is not None
    with av.open(io.BytesIO(base64.b64decode(source[1]))) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(frames) == 12 + 1  # and the twin was the same, though somebody looked
    assert all(frame.std() > 20 for frame in frames)


def test_another_sensor_model_shows(demos: Path, tmp_path: Path) -> None:
    env = VtRefineEnvConfig(start="grasped", pair="square", sensor_model="paper")
    comparison = replay(ReplayConfig(tmp_path / "out", SourceConfig(demos), episodes=[1], env=env))
    assert len(comparison.pairs) == 1
    assert all(pad.identical_frames == 0 for pad in comparison.touch)
    assert max(row.peak for row in comparison.tracking) == 0.0  # the motion is the same
    assert comparison.remarks == []


def test_a_twin_of_another_task_is_told(demos: Path, tmp_path: Path) -> None:
    env = VtRefineEnvConfig(sensor_model="paper")  # of a dataset that starts in hand, with square parts
    remarks = replay(ReplayConfig(tmp_path / "out", SourceConfig(demos), episodes=[1], env=env)).remarks
    told = "the twin has --env.pair=round, --env.start=table; for the task that was recorded add"
    assert f"{told} --env.pair=square --env.start=grasped" in remarks


def test_tracking_alone(joints_only: Path, tmp_path: Path) -> None:
    comparison = replay(ReplayConfig(tmp_path / "out", SourceConfig(joints_only)))
    assert (comparison.parts, comparison.touch) == ("none", [])
    assert [len(pair.position) for pair in comparison.pairs] == [25, 18]
    waist = comparison.tracking[0]
    assert 0 < waist.rmse < 0.05  # the twin's servo lags behind a recording without lag
    assert waist.recorded_lag_s == 0.0
    assert (tmp_path / "out" / "report.html").stat().st_size > 50_000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episodes": [5]}, "has episodes 0 to 1, episode 5 was asked for"),
        ({"parts": "recorded"}, "--parts=recorded needs seeds"),
        ({"parts": "grasp"}, "none of 2 episodes can be replayed: a gripper never closes"),
        ({"env": VtRefineEnvConfig(fps=20), "parts": "grasp"}, "10 frames/s, the twin --env.fps=20"),
    ],
)
def test_what_cannot_be_replayed(joints_only: Path, tmp_path: Path, change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replay(ReplayConfig(tmp_path / "out", SourceConfig(joints_only), **change))
    assert not (tmp_path / "out").exists()


def test_a_dataset_without_episodes_is_told(joints_only: Path, tmp_path: Path) -> None:
    """As a recording leaves it whose robot did not connect."""
    info = json.loads((joints_only / "meta" / "info.json").read_text()) | {"total_episodes": 0}
    (tmp_path / "empty" / "meta").mkdir(parents=True)
    (tmp_path / "empty" / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match="empty holds no episode yet"):
        replay(ReplayConfig(tmp_path / "out", SourceConfig(tmp_path / "empty")))


def test_the_twin_runs_at_the_datasets_rate(tmp_path: Path) -> None:
    still = np.tile(ROBOT.home, (4, 1)).astype(np.float32)
    write_dataset([JointEpisode(still, still)], ROBOT.joint_names, tmp_path / "fast", "local/fast", 30, "x")
    with pytest.raises(ValueError, match="none of 1 episode can be replayed"):
        replay(ReplayConfig(tmp_path / "out", SourceConfig(tmp_path / "fast"), parts="grasp"))


def test_another_robot_and_another_order_are_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0, 1, (4, 6)).astype(np.float32)
    write_dataset(
        [JointEpisode(values, values)], [f"j{i}" for i in range(6)], tmp_path / "six", "local/six", 10, "x"
    )
    with pytest.raises(ValueError, match="6 joints, the twin aloha has 16"):
        replay(ReplayConfig(tmp_path / "out", SourceConfig(tmp_path / "six")))
    values = rng.normal(0, 1, (4, 16)).astype(np.float32)
    names = ROBOT.joint_names[::-1]
    write_dataset([JointEpisode(values, values)], names, tmp_path / "other", "local/other", 10, "x")
    with pytest.raises(ValueError, match="joint 0 is right_right_finger, in the twin left_waist"):
        replay(ReplayConfig(tmp_path / "out", SourceConfig(tmp_path / "other")))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dataset": SourceConfig()}, "say what to replay"),
        ({"parts": "some"}, "--parts=some is unknown"),
        ({"hold": "spline"}, "--hold=spline is unknown; choose from zero_order, linear"),
        ({"episodes": []}, "--episodes is empty"),
    ],
)
def test_wrong_flags(arguments: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        ReplayConfig(**{"output_dir": tmp_path, "dataset": SourceConfig(tmp_path), **arguments})


def damage(root: Path, name: str, change: Callable[[str], str]) -> None:
    path = root / "meta" / name
    path.write_text(change(path.read_text()))


def test_broken_folders(joints_only: Path, tmp_path: Path) -> None:
    import shutil

    with pytest.raises(FileNotFoundError, match="holds no LeRobot dataset"):
        replay(ReplayConfig(tmp_path / "out", SourceConfig(tmp_path)))
    copy = tmp_path / "copy"
    shutil.copytree(joints_only, copy)
    data = min((copy / "data").rglob("*.parquet"))  # the first episode's, whatever the file system's order
    data.write_bytes(data.read_bytes()[:200])
    with pytest.raises(ValueError, match=rf"{data.name} cannot be read"):
        replay(ReplayConfig(tmp_path / "out", SourceConfig(copy)))
    data.unlink()
    with pytest.raises(ValueError, match="data files lack episode 0"):
        replay(ReplayConfig(tmp_path / "out", SourceConfig(copy)))
    damage(copy, "info.json", lambda text: text.replace('"features"', '"columns"'))
    with pytest.raises(ValueError, match=r"does not describe a LeRobot dataset: .* lacks 'features'"):
        replay(ReplayConfig(tmp_path / "out", SourceConfig(copy)))
    damage(copy, "info.json", lambda text: text.replace('"columns"', '"features"'))
    damage(copy, "info.json", lambda text: text.replace('"v3.0"', '"v2.1"'))
    with pytest.raises(ValueError, match=r"version v2\.1 is not v3\.0"):
        replay(ReplayConfig(tmp_path / "out", SourceConfig(copy)))


def test_reports_are_not_overwritten(joints_only: Path, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(FileExistsError, match=r"report\.html exists"):
        replay(ReplayConfig(tmp_path, SourceConfig(joints_only)))
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]
    replay(ReplayConfig(tmp_path, SourceConfig(joints_only), overwrite=True))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["replay.json", "report.html"]


def test_notes_of_other_recordings_are_refused(demos: Path, tmp_path: Path) -> None:
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(demos, copy)
    whole = json.loads((copy / "meta" / "recording.json").read_text())

    def refuse(content: object, message: str) -> None:
        (copy / "meta" / "recording.json").write_text(json.dumps(content))
        with pytest.raises(ValueError, match=message):
            replay(ReplayConfig(tmp_path / "out", SourceConfig(copy)))

    refuse({**whole, "episodes": whole["episodes"][:1]}, "notes 1 episode, the dataset has 2: it was edited")
    edited = ReplayConfig(tmp_path / "arms", SourceConfig(copy), parts="none")
    assert replay(edited).touch == []  # the arms alone need no starts
    refuse({"episodes": []}, "is not a note of vtrefine-record-demos")
    refuse([1, 2], "is not a note of vtrefine-record-demos")
    other = {**whole["settings"], "scene": {**whole["settings"]["scene"], "gravity_m_s2": 3.7}}
    refuse({**whole, "settings": other}, "written by another version")
    del other["rules"]
    refuse({**whole, "settings": other}, "settings lacks 'rules'")


def test_positions_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    values = np.tile(ROBOT.home, (5, 1)).astype(np.float32)
    broken = values.copy()
    broken[3, 2] = np.nan
    for name, command, position in (("a", broken, values), ("b", values, broken)):
        write_dataset(
            [JointEpisode(command, position)], ROBOT.joint_names, tmp_path / name, "local/x", 10, "x"
        )
        with pytest.raises(ValueError, match=r"episode 0, frame 3: .* left_elbow is not a number"):
            replay(ReplayConfig(tmp_path / "out", SourceConfig(tmp_path / name)))


def test_hands_that_never_reach_the_twins_table_are_reported(tmp_path: Path) -> None:
    """Recorded beside a table 45 mm higher than the twin's: the same hands pick parts that stand higher."""
    raised = VtRefineEnvConfig(start="table", episode_steps=70, scene=SceneConfig(table_height_m=0.045))
    record(
        RecordDemosConfig(
            root=tmp_path / "demos", num_episodes=1, num_envs=1, seed=11, env=raised, include_failures=True
        )
    )
    (tmp_path / "demos" / "meta" / "recording.json").unlink()  # nothing tells what the scene was
    source, flat = SourceConfig(tmp_path / "demos"), VtRefineEnvConfig(start="table", episode_steps=70)
    comparison = replay(ReplayConfig(tmp_path / "flat", source, parts="grasp", env=flat, video=False))
    assert min(row.lowest_m for row in comparison.reach) == pytest.approx(0.05, abs=0.006)
    told = "\n".join(describe(comparison))
    assert "note: no finger ever came closer than 5" in told
    wanted = float(told.split("table_height_m=")[1].split()[0])
    assert "to the twin&#39;s table" in (tmp_path / "flat" / "report.html").read_text()
    fitting = replace(flat, scene=SceneConfig(table_height_m=wanted))
    again = replay(ReplayConfig(tmp_path / "again", source, parts="grasp", env=fitting, video=False))
    assert again.remarks == []
    assert [row.held for row in again.reach] == [1, 1]
    over = [
        after.over_part_m - before.over_part_m
        for before, after in zip(comparison.reach, again.reach, strict=True)
    ]
    assert over == pytest.approx([wanted] * 2, abs=1e-3)
    assert json.loads((tmp_path / "again" / "replay.json").read_text())["remarks"] == []
    alone = replay(ReplayConfig(tmp_path / "alone", source, parts="none"))
    assert f"--env.scene.table_height_m={wanted:.3f} is the highest" in "\n".join(alone.remarks)


def test_hands_that_hold_nothing_in_the_twin_are_counted() -> None:
    """Two episodes: the left hand closes 30 mm above the table; the twin's pads feel something in one."""
    closing = np.tile(ROBOT.home, (30, 1))
    closing[10:, 6], closing[10:, 7] = 0.02, -0.02
    touch = np.zeros((2, 30, 4))
    touch[:, :, :] = 4.0  # noise
    touch[1, 12:, :2] = 50.0
    height = float(lowest_edges(ROBOT, closing)[0, 0])
    rows = hand_reaches(ROBOT, [closing, closing], height - 0.03, (0.04, 0.08), list(touch), fps=10)
    assert [(row.arm, row.episodes, row.held) for row in rows] == [("left", 2, 1)]
    assert rows[0].over_part_m == pytest.approx(0.01)
    told = describe_reach(rows, height - 0.03)
    assert told[0].startswith(
        "the twin's left hand holds its part in 1 of 2 episodes: when its gripper closes"
    )
    assert f"table_height_m={height:.3f}" in told[1]


def test_lowest_edges_are_pad_corners() -> None:
    joints = ROBOT.home + np.random.default_rng(0).normal(0, 0.2, (5, 16))
    position, rotation = (item.numpy() for item in ROBOT.pad_poses(torch.as_tensor(joints)))
    length, width, _ = ROBOT.fingers.pad.size_m
    corners = np.array([[x * length / 2, y * width / 2, 0] for x in (-1, 1) for y in (-1, 1)])
    heights = (position[..., None, :] + corners @ np.swapaxes(rotation, -1, -2))[..., 2]
    assert lowest_edges(ROBOT, joints) == pytest.approx(heights.reshape(5, 2, 8).min(-1))


def test_upper_end_of_parts() -> None:
    pair = load_pair(SceneConfig())
    assert part_top_m(pair.plug) == pytest.approx(pair.plug.grip.centre_m[2] + pair.plug.grip.half_size_m[2])
    assert part_top_m(pair.socket) == pytest.approx(pair.socket.rest_height_m + pair.mouth_z_m)


def test_no_remark_where_the_twin_is_the_recordings_own(demos: Path, tmp_path: Path) -> None:
    assert replay(ReplayConfig(tmp_path / "out", SourceConfig(demos))).remarks == []
